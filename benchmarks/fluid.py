"""How many pairs a second does the particle fluid evaluate, with a list that is ready and in full steps that remake it?

    python -m benchmarks.fluid [--quick]

Lennard-Jones, its force shifted to zero at 2.5 sigma, skin 0.3, liquid density 0.8, float32, 1e3 to 1e5 particles in open space. Beside it,
where they are installed: jax-md, Warp's hash grid, a list in numba. Read: `M` is million pairs within the cut-off a second, each counted
once, the median of interleaved rounds, each a burst of at least 20 ms; `error` is the largest difference from the float64 sum over all
pairs, over the largest force. `gradient` is that of the squared forces by the positions, in forces. `compile_s` is the first run, in
which others compile as well.
In full steps (100 of velocity Verlet, speeds of temperature 1) the list is remade when it must be, Warp's grid in each; `apart` is how far
the points end from ours, in sigma; the pairs are those at the start. Draws rates and steps.
"""

from __future__ import annotations

import dataclasses
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
from .measure import RESULTS, Panel, arguments, draw, show, write

REACH, SKIN, DENSITY, CAPACITY = 2.5, 0.3, 0.8, 96
DT, N_STEPS = 2e-3, 100
BURST_S = 0.02
STYLES = {"jaxspring": "o-", "jax_md": "s--", "warp": "^--", "numba": "x:"}


def liquid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points of a jittered lattice at liquid density in no order, and speeds."""
    rng = np.random.default_rng(0)
    side = int(np.ceil(n ** (1 / 3)))
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)[:n] * DENSITY ** (-1 / 3)
    return rng.permutation(grid + rng.uniform(-0.12, 0.12, (n, 3))).astype(np.float32), rng.normal(size=(n, 3)).astype(np.float32)


def exact(points: np.ndarray) -> tuple[np.ndarray, int]:
    """(N, 3) forces in float64, and how many pairs are nearer than the cut-off."""
    from scipy.spatial import KDTree

    at = points.astype(np.float64)
    i, j = KDTree(at).query_pairs(REACH, output_type="ndarray").T
    d = at[i] - at[j]
    squared = np.sum(d * d, axis=1)
    weight = 24 / squared * (2 * squared**-6 - squared**-3) - fluid_peers.end_force(REACH) / np.sqrt(squared)
    forces = np.stack([np.bincount(i, weight * a, minlength=len(at)) - np.bincount(j, weight * a, minlength=len(at)) for a in d.T], axis=-1)
    return forces, len(i)


def begun(points: np.ndarray, speeds: np.ndarray) -> tuple[js.System, js.BoundSystem, js.State]:
    """The same fluid here, also bound, its list begun."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), len(points))
    fluid = js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.ShiftedForce(REACH), js.fluid.NeighbourList(CAPACITY, SKIN))
    system = js.System(net, mass=1.0, forces=fluid)
    return system, system.bind(jnp.float32), eqx.filter_jit(lambda s: system.begin(s))(js.State.from_points(net, points, speeds))


def ours(points: np.ndarray, speeds: np.ndarray) -> fluid_peers.Peer:
    """Our own fluid, asked as the others are."""
    system, bound, state = begun(points, speeds)
    force = jax.jit(lambda s: bound.force(s))

    def steps(dt: float, n_steps: int) -> Callable[[], tuple[Any, int]]:
        def run() -> tuple[Any, int]:
            end = jax.block_until_ready(js.rollout(system, state, js.VelocityVerlet(), dt, n_steps))
            js.raise_for_status(end)
            return end.state.points, int(end.state.memory[0].value.rebuilds)

        return run

    def forces() -> np.ndarray:
        return np.stack([np.asarray(state.layout.flatten(a)) for a in force(state)], axis=-1)

    return fluid_peers.Peer(lambda: force(state).components, forces, steps)


def costs(points: np.ndarray, speeds: np.ndarray, rounds: int) -> dict[str, float]:
    """What a new list and a gradient cost, in forces of the same rounds."""
    _, system, state = begun(points, speeds)

    def squared_forces(x: js.Vector) -> jax.Array:
        return jnp.sum(jnp.stack([jnp.sum(a * a) for a in system.force(state.moved(x, state.velocity))]))

    force, gradient = jax.jit(lambda s: system.force(s)), jax.jit(lambda s: jax.grad(squared_forces)(s.position))
    begin = jax.jit(lambda s: system.begin(dataclasses.replace(s, memory=None)))
    runs = {"force": lambda: force(state), "list": lambda: begin(state), "gradient": lambda: gradient(state)}
    taken, first = seconds(runs, rounds)
    return {**{name: taken[name] / taken["force"] for name in ("list", "gradient")}, "first_gradient_s": first["gradient"]}


def seconds(runs: dict[str, Callable[[], Any]], rounds: int) -> tuple[dict[str, float], dict[str, float]]:
    """Median time of each, in interleaved rounds of bursts: a simulation asks again at once; and that of the first run of each."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    counts, first = {}, {}
    for name, run in runs.items():
        clock = Stopwatch()
        jax.block_until_ready(run())
        first[name], clock = clock.seconds, Stopwatch()
        jax.block_until_ready(run())
        counts[name] = max(1, round(BURST_S / max(clock.seconds, 1e-9)))
    for _ in range(rounds):
        for name, run in runs.items():
            clock = Stopwatch()
            for _ in range(counts[name]):
                jax.block_until_ready(run())
            times[name].append(clock.seconds / counts[name])
    return {name: statistics.median(taken) for name, taken in times.items()}, first


def one_size(n: int, rounds: int) -> tuple[list[dict], list[dict], dict]:
    """Rows of forces with a list that is ready, rows of full steps, and what a list and a gradient cost."""
    points, speeds = liquid(n)
    reference, n_pairs = exact(points)
    peers = {name: getattr(fluid_peers, name)(points, speeds, REACH, SKIN) for name in ("jax_md", "warp", "numba")}
    programs = {"jaxspring": ours(points, speeds), **{name: peer for name, peer in peers.items() if peer is not None}}
    taken, first = seconds({name: peer.force for name, peer in programs.items()}, rounds)
    forces = []
    for name, peer in programs.items():
        error = float(np.abs(peer.forces() - reference).max() / np.abs(reference).max())
        row = {"n": n, "program": name, "ms": taken[name] * 1e3, "M": n_pairs / taken[name] / 1e6, "error": error}
        forces.append(row | {"compile_s": first[name]})

    runs = {name: peer.steps(DT, N_STEPS) for name, peer in programs.items()}
    ends, steps = {}, []
    for name, run in runs.items():
        clock = Stopwatch()
        ends[name] = (*run(), clock.seconds)
    taken, _ = seconds(runs, max(rounds // 3, 3))
    for name, (end, rebuilds, compile_s) in ends.items():
        each = taken[name] / N_STEPS
        apart = float(np.abs(end - ends["jaxspring"][0]).max())
        row = {"n": n, "program": name, "ms": each * 1e3, "M": n_pairs / each / 1e6, "rebuilds": rebuilds, "apart": apart}
        steps.append(row | {"compile_s": compile_s})
    return forces, steps, {"n": n, **costs(points, speeds, rounds)}


def main() -> None:
    options = arguments(__doc__)
    sizes, rounds = ([1_000, 10_000], 5) if options.quick else ([1_000, 10_000, 100_000], 9)
    forces, steps, others = [], [], []
    for n in sizes:
        of_forces, of_steps, of_others = one_size(n, rounds)
        forces += of_forces
        steps += of_steps
        others.append(of_others)
    show("forces, the list ready", forces)
    show(f"full steps, the list remade when it must be ({N_STEPS} steps)", steps)
    show("a new list, and a gradient, in forces", others)
    settings = {"reach": REACH, "skin": SKIN, "density": DENSITY, "capacity": CAPACITY, "dt": DT}
    write("fluid", settings, {"forces": forces, "steps": steps, "others": others})
    panels = [
        Panel(title, "million pairs a second", curves(rows), xlabel="particles")
        for title, rows in (("forces, the list ready", forces), ("full steps, lists remade", steps))
    ]
    draw(panels, RESULTS / "fluid.png")


def curves(rows: list[dict]) -> dict[tuple[str, str], tuple[list[float], list[float]]]:
    """Rate over the number of particles, one curve for each program."""
    found = {}
    for name, style in STYLES.items():
        of_name = [row for row in rows if row["program"] == name]
        if of_name:
            found[name.replace("_", "-"), style] = ([row["n"] for row in of_name], [row["M"] for row in of_name])
    return found


if __name__ == "__main__":
    main()
