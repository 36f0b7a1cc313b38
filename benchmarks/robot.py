"""How many steps of walking robots a second, forward and with the gradient by all weights of their controllers, beside Taichi?

    python -m benchmarks.peers --setup     once, for Taichi's environment
    python -m benchmarks.robot [--quick]

Sixty-four robots of the default scene at once, in float32, each with a network of its own in a closed loop, on the ground with friction.
Both programs do the same steps: commands, springs, dashpots, symplectic Euler, the step split where a node meets the ground, sliding and
sticking. jaxspring by `js.batch`, statuses on; Taichi by five kernels a step over all robots, its gradient by its own tape.

Read: `M` is million robot-steps a second, the median of interleaved rounds on two threads; `ratio` is jaxspring's time over the
contender's, so that 5 means five times slower than it and 0.2 five times faster; `error` is the largest difference after 20 steps from
float64 NumPy: of the distances over their range, of the gradients over the largest entry (there: central differences). A slide that stops
within a step goes v^2 / (2 mu g) with jaxspring, and half of v dt with NumPy and Taichi, which shows in the error.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import jax
import numpy as np

import jaxspring as js

from .measure import show, write
from .others import robots
from .others.contest import contest
from .others.layouts import Scene
from .others.workloads import Workload

N_ROBOTS = 64


def scene(kind: str) -> Scene:
    """The default robot, with weights of their own for all."""
    robot = js.robot.walking_robot(dtype=jax.numpy.dtype(np.float32))
    s, springs, order = robot.settings, robot.system.forces[0], robot.net.node_permutation
    assert isinstance(springs, js.Springs)
    assert springs.actuation is not None
    assert order is not None
    n_nodes, n_groups = robot.net.n_nodes, springs.actuation.n_groups or 0
    keys = jax.random.split(jax.random.key(0), N_ROBOTS)
    network = js.robot.NeuralController.random
    many = [network(key, robot.state, n_groups, s.n_hidden, s.frequency, s.cell, s.reach) for key in keys]
    parts = {name: np.stack([np.asarray(getattr(one, name)) for one in many]) for name in robots.PARTS}
    first = parts["first"].copy()
    first[..., 4:] = 0
    for d in range(4):  # from the net's own order of nodes to that of the points
        first[..., 4 + d * n_nodes + order.order] = parts["first"][..., 4 + d * n_nodes : 4 + (d + 1) * n_nodes]
    constants = {"k": s.stiffness, "mass": s.node_mass, "size": s.cell, "n_groups": n_groups}
    constants |= {name: getattr(s, name) for name in ("damping", "friction", "gravity", "frequency", "reach")} | {"dt": s.step}
    body = {
        "x": np.asarray(robot.state.points),
        "edges": np.asarray(robot.net.edges, np.int32),
        "groups": np.asarray(springs.actuation.groups),
    }
    return Scene({"kind": kind, **body, "l": np.asarray(springs.rest_length, np.float32), **constants, **parts, "first": first})


def workloads() -> list[Workload]:
    """Forward, and the gradient."""
    unit, who = "million robot-steps / s", ("jaxspring", "taichi")
    return [
        Workload("robots", "robots", N_ROBOTS, lambda: scene("robots"), 500, 100, who, robots.distances, unit=unit),
        Workload("gradient robots", "robots", N_ROBOTS, lambda: scene("gradient robots"), 500, 100, who, robots.gradients, unit=unit),
    ]


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps and rounds, for a look")
    given = parser.parse_args()
    found = {}
    for workload in workloads():
        n_steps = workload.quick_steps if given.quick else workload.n_steps
        with tempfile.TemporaryDirectory() as folder:
            result = contest(workload, n_steps, 3 if given.quick else 9, Path(folder))
        show(f"{workload.name}, {N_ROBOTS} at once, {n_steps} steps, M in {workload.unit}", result["rows"])
        found[workload.name] = result
    write("robot", {"dtype": "float32", "threads": 2, "robots": N_ROBOTS, "quick": given.quick}, {"workloads": found})


if __name__ == "__main__":
    main()
