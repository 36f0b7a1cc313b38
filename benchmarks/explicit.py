"""How fast is an explicit rollout, and what do its statuses cost?

    python -m benchmarks.explicit [--quick]

Lattices of n x n (structural + shear + bend) and Delaunay meshes, symplectic Euler, float32. Beside `rollout` stand the bare scan of
the same arithmetic and the edge-list form on stacked positions. Read: `ratio` is `rollout` over the bare scan, the median of nine
interleaved pairs of whole runs with statuses on; `M` is million node-steps a second; the error is the largest distance from a float64
NumPy run after the checked number of steps, over the mesh's size.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import jaxspring as js

from . import scenes
from .measure import Case, Panel, arguments, draw, measure, ratio_of_pairs, show, write

DT = np.float32(0.05)
CHECKED_STEPS = 20


def lattices(sizes: list[tuple[int, int]], rounds: int) -> list[dict]:
    """One row per size."""
    rows = []
    for n, n_steps in sizes:
        system, state = scenes.sheet(n)
        bare, k, l = scenes.bare_sheet(system, n_steps)
        x, v = list(state.position), list(state.velocity)
        edge_list = scenes.bare_edge_list(system.net.edges, max(n_steps // 10, 1))
        springs = scenes.springs_of(system)

        def run(system: js.System = system, state: js.State = state, n_steps: int = n_steps) -> js.Result:
            return scenes.rollout_positions(system, state, DT, n_steps)

        def by_hand(bare=bare, x=x, v=v, k=k, l=l):
            return bare(x, v, k, l, DT)

        ratio, low, high = ratio_of_pairs(run, by_hand, rounds)
        timed = measure(
            [
                Case("bare", bare, (x, v, k, l, DT)),
                Case("edge list", edge_list, (state.points, state.velocities, springs.stiffness, springs.rest_length, DT)),
            ],
            max(rounds // 3, 3),
        )
        per_step = timed["bare"].run_s / n_steps
        rows.append(
            {
                "n": n,
                "steps": n_steps,
                "bare_M": n * n / per_step / 1e6,
                "rollout_M": n * n / (per_step * ratio) / 1e6,
                "ratio": ratio,
                "ratio_low": low,
                "ratio_high": high,
                "over_edge_list": timed["edge list"].run_s / max(n_steps // 10, 1) / (per_step * ratio),
                "compile_s": compile_seconds(system, state, n_steps),
                "bare_compile_s": timed["bare"].compile_s,
                "memory_mib": timed["bare"].temporary_mib,
                "error": error(system, state),
            }
        )
    return rows


def graphs(sizes: list[tuple[int, int]], rounds: int) -> list[dict]:
    """One row per size: the rollout and the bare scatter form."""
    rows = []
    for n_nodes, n_steps in sizes:
        system, state = scenes.mesh(n_nodes)
        cases = [Case("bare", *scenes.bare_mesh(system, state, DT, n_steps)), Case("rollout", *scenes.program(system, state, DT, n_steps))]
        timed = measure(cases, rounds)
        bare, run = timed["bare"].run_s, timed["rollout"].run_s
        rows.append(
            {
                "nodes": n_nodes,
                "steps": n_steps,
                "bare_M": n_nodes * n_steps / bare / 1e6,
                "rollout_M": n_nodes * n_steps / run / 1e6,
                "over_bare": run / bare,
                "compile_s": timed["rollout"].compile_s,
                "memory_mib": timed["rollout"].temporary_mib,
                "error": error(system, state),
            }
        )
    return rows


def compile_seconds(system: js.System, state: js.State, n_steps: int) -> float:
    """Seconds to trace and compile the rollout."""
    return measure([Case("rollout", *scenes.program(system, state, DT, n_steps))], 1)["rollout"].compile_s


def error(system: js.System, state: js.State) -> float:
    """Largest distance from the float64 NumPy run, over the mesh's size."""
    points = np.asarray(scenes.rollout_positions(system, state, DT, CHECKED_STEPS).state.points, float)
    expected = scenes.numpy_positions(system, state, float(DT), CHECKED_STEPS)
    return float(np.abs(points - expected).max() / np.ptp(expected, axis=0).max())


def picture(lattice_rows: list[dict], graph_rows: list[dict], path: Path) -> None:
    """Throughput against size."""
    cells, nodes = [row["n"] ** 2 for row in lattice_rows], [row["nodes"] for row in graph_rows]
    cloth = {
        ("rollout, statuses on", "o-"): (cells, [row["rollout_M"] for row in lattice_rows]),
        ("bare scan, padded slices", "s--"): (cells, [row["bare_M"] for row in lattice_rows]),
        ("edge list, stacked, scatter-add", "^:"): (cells, [row["rollout_M"] / row["over_edge_list"] for row in lattice_rows]),
    }
    styles = {("rollout, statuses on", "o-"): "rollout_M", ("bare scan, scatter-add", "^:"): "bare_M"}
    mesh = {style: (nodes, [row[name] for row in graph_rows]) for style, name in styles.items()}
    speed = "million node-steps / s"
    draw([Panel("cloth, 6 spring families", speed, cloth, log=True), Panel("Delaunay mesh", speed, mesh, log=True)], path)


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    rounds = 3 if quick else 9
    lattice_rows = lattices([(32, 1000)] if quick else [(32, 1000), (128, 1000), (512, 4000)], rounds)
    graph_rows = graphs([(1000, 200)] if quick else [(1000, 1000), (10_000, 300), (100_000, 200)], rounds)
    show("lattices", lattice_rows)
    show("graphs", graph_rows)
    path = write("explicit", {"dt": DT, "dtype": "float32", "rounds": rounds}, {"lattices": lattice_rows, "graphs": graph_rows})
    picture(lattice_rows, graph_rows, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
