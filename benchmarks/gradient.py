"""What does the gradient with respect to every stiffness and rest length cost, in time and memory?

    python -m benchmarks.gradient [--quick]

The loss is the sum of squares of the last positions of a rollout in float32. Read: `over_bare` is the time of loss and gradient over one
bare forward scan of the same steps, timed in the same interleaved rounds; `temporary_mib` is the compiled program's own count of temporary
memory; the error is that of the gradient against float64, relative to its largest entry, after the checked number of steps.
"""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch

from . import scenes
from .measure import Case, Panel, arguments, draw, measure, show, write

DT = np.float32(0.05)
CHECKED_STEPS = 30


def lattices(sizes: list[tuple[int, int]], rounds: int) -> list[dict]:
    """One row per size."""
    rows = []
    for n, n_steps in sizes:
        system, state = scenes.sheet(n)
        bare, k, l = scenes.bare_sheet(system, n_steps)
        timed = measure(
            [
                Case("bare", bare, (list(state.position), list(state.velocity), k, l, DT)),
                Case("gradient", *scenes.gradient_program(system, state, DT, n_steps)),
            ],
            rounds,
        )
        rows.append({"n": n, "steps": n_steps, **_row(timed, "bare"), "error": error(system, state)})
    return rows


def graphs(sizes: list[tuple[int, int]], rounds: int) -> list[dict]:
    """One row per size: the gradient, and the autodiff of the bare scatter form."""
    rows = []
    for n_nodes, n_steps in sizes:
        system, state = scenes.mesh(n_nodes)
        bare, arrays = scenes.bare_mesh(system, state, DT, n_steps)
        by_hand = jax.jit(jax.grad(lambda x, v, k, l, dt, bare=bare: sum((a * a).sum() for a in bare(x, v, k, l, dt)), argnums=(2, 3)))
        cases = [Case("bare", bare, arrays), Case("autodiff", by_hand, arrays)]
        timed = measure([*cases, Case("gradient", *scenes.gradient_program(system, state, DT, n_steps))], rounds)
        seconds = {name: one.run_s for name, one in timed.items()}
        rows.append(
            {
                "nodes": n_nodes,
                "steps": n_steps,
                "over_bare": seconds["gradient"] / seconds["bare"],
                "autodiff_over_bare": seconds["autodiff"] / seconds["bare"],
                "over_autodiff": seconds["gradient"] / seconds["autodiff"],
                "compile_s": timed["gradient"].compile_s,
                "first_gradient_s": timed["gradient"].first_s,
                "temporary_mib": timed["gradient"].temporary_mib,
                "autodiff_mib": timed["autodiff"].temporary_mib,
                "error": error(system, state),
            }
        )
    return rows


def memory() -> list[dict]:
    """Temporary memory of gradients over many steps of a 10 x 10 cloth, float64, by the compiled program's own analysis."""
    rows = []
    with jax.enable_x64(True):
        system, state = _in_float64(*scenes.sheet(10))
        for n_steps, observe in ((1_000, False), (10_000, False), (10_007, False), (10_000, True)):
            function, arrays = scenes.gradient_program(system, state, 0.01, n_steps, observe)
            clock = Stopwatch()
            program = function.lower(*arrays).compile()
            mib = program.memory_analysis().temp_size_in_bytes / 2**20
            rows.append({"nodes": 100, "steps": n_steps, "observe": observe, "compile_s": clock.seconds, "temporary_mib": mib})
    return rows


def error(system: js.System, state: js.State) -> float:
    """Largest error of the float32 gradient against float64, over its largest entry."""
    function, arrays = scenes.gradient_program(system, state, DT, CHECKED_STEPS)
    found = function(*arrays)
    with jax.enable_x64(True):
        function, arrays = scenes.gradient_program(*_in_float64(system, state), np.float64(DT), CHECKED_STEPS)
        expected = function(*arrays)
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    return max(float(np.abs(np.asarray(a, float) - np.asarray(b)).max() / np.abs(np.asarray(b)).max()) for a, b in pairs)


def picture(lattice_rows: list[dict], graph_rows: list[dict], path: Path) -> None:
    """Cost of the gradient against size."""
    cells, nodes = [row["n"] ** 2 for row in lattice_rows], [row["nodes"] for row in graph_rows]
    cloth = {("loss and gradient", "o-"): (cells, [row["over_bare"] for row in lattice_rows])}
    styles = {("loss and gradient", "o-"): "over_bare", ("autodiff of the bare scan", "^:"): "autodiff_over_bare"}
    mesh = {style: (nodes, [row[name] for row in graph_rows]) for style, name in styles.items()}
    cost = "time / bare forward scan"
    draw([Panel("cloth, 6 spring families", cost, cloth, bound=6), Panel("Delaunay mesh", cost, mesh)], path)


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    rounds = 3 if quick else 9
    lattice_rows = lattices([(32, 1000)] if quick else [(32, 1000), (128, 400), (512, 100)], rounds)
    graph_rows = graphs([(1000, 200)] if quick else [(1000, 1000), (10_000, 200), (100_000, 100)], rounds)
    memory_rows = memory()
    show("lattices", lattice_rows)
    show("graphs", graph_rows)
    show("memory", memory_rows)
    tables = {"lattices": lattice_rows, "graphs": graph_rows, "memory": memory_rows}
    path = write("gradient", {"dt": DT, "dtype": "float32", "rounds": rounds}, tables)
    picture(lattice_rows, graph_rows, path.with_suffix(".png"))


def _row(timed: dict, base: str) -> dict:
    gradient = timed["gradient"]
    return {
        "over_bare": gradient.run_s / timed[base].run_s,
        "seconds": gradient.run_s,
        "low_s": gradient.low_s,
        "high_s": gradient.high_s,
        "compile_s": gradient.compile_s,
        "first_gradient_s": gradient.first_s,
        "temporary_mib": gradient.temporary_mib,
    }


def _in_float64(system: js.System, state: js.State) -> tuple[js.System, js.State]:
    def widen(leaf):
        return leaf.astype(np.float64) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(widen, system), jax.tree.map(widen, state)


if __name__ == "__main__":
    main()
