"""How many pairs a second does the particle fluid evaluate, with a list that is ready and in full steps that remake it?

    python -m benchmarks.fluid [--quick]

Lennard-Jones, its force shifted to zero at 2.5 sigma, skin 0.3, liquid density 0.8, float32, 1e3 to 1e5 particles in open space. Beside it,
where they are installed: jax-md, Warp's hash grid, a list in numba. Read: `M` is million pairs within the cut-off a second, each counted
once, the median of interleaved rounds; `error` is the largest difference from the float64 sum over all pairs, over the largest force.
In full steps (velocity Verlet, speeds of temperature 1) the list is remade when it must be; `rebuilds` says how often, `build`
how many forces one costs.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch

from . import fluid_peers
from .measure import arguments, show, write

REACH, SKIN, DENSITY, CAPACITY = 2.5, 0.3, 0.8, 96
DT, N_STEPS = 2e-3, 50


def liquid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points of a jittered lattice at liquid density in no order, and speeds."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(n ** (1 / 3)))
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:n] * DENSITY ** (-1 / 3)
    return rng.permutation(grid + rng.uniform(-0.12, 0.12, (n, 3))).astype(np.float32), rng.normal(size=(n, 3)).astype(np.float32)


def exact(points: np.ndarray) -> tuple[np.ndarray, int]:
    """(N, 3) forces in float64, and how many pairs are nearer than the cut-off."""
    from scipy.spatial import cKDTree

    at = points.astype(np.float64)
    i, j = cKDTree(at).query_pairs(REACH, output_type="ndarray").T
    d = at[i] - at[j]
    squared = np.sum(d * d, axis=1)
    weight = 24 / squared * (2 * squared**-6 - squared**-3) - fluid_peers.end_force(REACH) / np.sqrt(squared)
    forces = np.stack([np.bincount(i, weight * a, minlength=len(at)) - np.bincount(j, weight * a, minlength=len(at)) for a in d.T], axis=-1)
    return forces, len(i)


def ours(points: np.ndarray, speeds: np.ndarray) -> tuple[js.System, js.State]:
    """The same fluid here, its list begun."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), len(points))
    fluid = js.Fluid(js.LennardJones(1.0, 1.0), js.ShiftedForce(REACH), js.NeighbourList(CAPACITY, SKIN))
    system = js.System(net, mass=1.0, forces=fluid).prepare(jnp.float32)
    return system, eqx.filter_jit(lambda s: system.begin(s))(js.State.from_points(net, points, speeds))


def seconds(runs: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median time of each, in interleaved rounds."""
    for run in runs.values():
        jax.block_until_ready(run())
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            clock = Stopwatch()
            jax.block_until_ready(run())
            times[name].append(clock.seconds)
    return {name: statistics.median(taken) for name, taken in times.items()}


def one_size(n: int, rounds: int) -> tuple[list[dict], dict]:
    """Rows of forces with a list that is ready, and the row of full steps."""
    points, speeds = liquid(n)
    reference, n_pairs = exact(points)
    system, state = ours(points, speeds)
    force = eqx.filter_jit(lambda s: system.force(s))
    begin = eqx.filter_jit(lambda s: system.begin(eqx.tree_at(lambda s: s.neighbours, s, None)))
    runs = {"jaxspring": lambda: force(state).components, "build": lambda: begin(state).position.x}
    results = {"jaxspring": lambda: np.stack([np.asarray(state.layout.flatten(a)) for a in force(state)], axis=-1)}
    for name in ("jax_md", "warp", "numba"):
        peer = getattr(fluid_peers, name)(points, REACH, SKIN)
        if peer is not None:
            runs[name], results[name] = peer
    taken = seconds(runs, rounds)
    rows = []
    for name, result in results.items():
        error = float(np.abs(result() - reference).max() / np.abs(reference).max())
        rows.append({"n": n, "program": name, "ms": taken[name] * 1e3, "M": n_pairs / taken[name] / 1e6, "error": error})

    def steps() -> js.Result:
        return js.rollout(system, state, js.VelocityVerlet(), DT, N_STEPS)

    end = steps()
    each = seconds({"steps": lambda: steps().state.position.x}, max(rounds // 3, 3))["steps"] / N_STEPS
    full = {
        "n": n,
        "ms": each * 1e3,
        "M": n_pairs / each / 1e6,
        "rebuilds": int(end.state.neighbours.rebuilds),
        "steps": N_STEPS,
        "build": taken["build"] / taken["jaxspring"],
        "status": end.status.describe(),
    }
    return rows, full


def main() -> None:
    options = arguments(__doc__)
    sizes, rounds = ([1_000, 10_000], 5) if options.quick else ([1_000, 10_000, 100_000], 9)
    forces, steps = [], []
    for n in sizes:
        rows, full = one_size(n, rounds)
        forces += rows
        steps.append(full)
    show("forces, the list ready", forces)
    show("full steps, the list remade when it must be", steps)
    settings = {"reach": REACH, "skin": SKIN, "density": DENSITY, "capacity": CAPACITY, "dt": DT}
    write("fluid", settings, {"forces": forces, "steps": steps})


if __name__ == "__main__":
    main()
