"""How fast is one stiff implicit step solved, here and elsewhere?

    python -m benchmarks.implicit [--quick]

One linear system M/dt + dt K, dt = 100 times the explicit limit, to a residual of 1e-6 |b| in float64, on n x n cloths and on Delaunay
meshes in space: every solver and preconditioner of the library, against SciPy (SuperLU in symmetric mode, conjugate gradients), pyamg
(conjugate gradients with smoothed aggregation) and CHOLMOD (cvxopt), on the same matrix, in interleaved rounds.

Read: `seconds` is what must be done again when the numbers change, for all alike: preconditioner or factorisation, and the solve. `once`
is done once per net: CHOLMOD's symbolic part, the host part of Multigrid or Skyline; `compile_s` is XLA's. `residual` is |b - A x| / |b|
in NumPy; `error` is the distance from CHOLMOD's solution, refined, over its length. In the second table a ratio below 1 means that the
library's best is faster. The third counts products with the matrix, in million nodes a second.

Needs: pip install 'jaxspring[bench]'
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import lax

from jaxspring.linalg.base import LinearSolver
from jaxspring.linalg.cg import CG, JaxCG
from jaxspring.linalg.multigrid import Multigrid
from jaxspring.linalg.preconditioners import BlockJacobi, Jacobi
from jaxspring.linalg.skyline import Skyline
from jaxspring.progress import Stopwatch

from .measure import Panel, arguments, draw, show, write
from .stiff_steps import Problem, cloth, mesh, rivals

TOLERANCE = 1e-6
# Unknowns up to which the envelope is kept: beyond, it is gigabytes.
SKYLINE_UP_TO = 13_000
SECONDS_PER_CASE = 3.0


class Case(NamedTuple):
    """One solver on one problem: `run()` gives the solution and the iterations."""

    name: str
    run: Callable[[], tuple[np.ndarray, int]]
    once: float | None
    compile_s: float | None


def ours(problem: Problem) -> list[Case]:
    """The library's solvers, each compiled as one program of matrix and right-hand side."""
    clock = Stopwatch()
    multigrid = Multigrid(problem.net)
    host = clock.seconds
    solvers: list[tuple[str, LinearSolver, float | None]] = [
        ("JaxCG, BlockJacobi", JaxCG(TOLERANCE, preconditioner=BlockJacobi()), None),
        ("JaxCG, Multigrid", JaxCG(TOLERANCE, preconditioner=multigrid), host),
        ("CG, Jacobi", CG(TOLERANCE, preconditioner=Jacobi()), None),
        ("CG, BlockJacobi", CG(TOLERANCE, preconditioner=BlockJacobi()), None),
        ("CG, Multigrid", CG(TOLERANCE, preconditioner=multigrid), host),
    ]
    if problem.right_side.size <= SKYLINE_UP_TO:
        clock = Stopwatch()
        skyline = Skyline(problem.net)
        solvers.append(("Skyline", skyline, clock.seconds))
    return [_compiled(problem, *solver) for solver in solvers]


def _compiled(problem: Problem, name: str, solver: LinearSolver, once: float | None) -> Case:
    def solve(solver: LinearSolver, matrix: Any, b: Any) -> Any:
        return solver.solve_in_step(matrix, b, None, None)[:2]

    clock = Stopwatch()
    program = jax.jit(solve).lower(solver, problem.matrix, problem.b).compile()
    seconds = clock.seconds

    def run() -> tuple[np.ndarray, int]:
        x, info = jax.block_until_ready(program(solver, problem.matrix, problem.b))
        return x, int(info.iterations) if hasattr(info, "iterations") else -1

    return Case(name, run, once, seconds)


def compare(problem: Problem, quick: bool) -> list[dict[str, Any]]:
    """One row per solver; slow ones get fewer rounds."""
    cases = [*ours(problem), *(Case(r.name, r.run, r.once, None) for r in rivals(problem, TOLERANCE))]
    found, times, rounds = {}, {case.name: [] for case in cases}, {}
    for case in cases:
        clock = Stopwatch()
        found[case.name] = case.run()
        rounds[case.name] = 3 if quick else int(np.clip(SECONDS_PER_CASE / clock.seconds, 1, 9))
    for number in range(max(rounds.values())):
        for case in cases:
            if number < rounds[case.name]:
                clock = Stopwatch()
                case.run()
                times[case.name].append(clock.seconds)
    rows = []
    for case in cases:
        x, iterations = found[case.name]
        flat = x if isinstance(x, np.ndarray) else problem.flat(x)
        low, median, high = np.quantile(times[case.name], [0.1, 0.5, 0.9])
        rows.append(
            {
                "solver": case.name,
                "seconds": float(median),
                "low": float(low),
                "high": float(high),
                "iterations": iterations if iterations >= 0 else None,
                "residual": _distance(problem.sparse @ flat, problem.right_side),
                "error": _distance(flat, problem.reference),
                "once": case.once,
                "compile_s": case.compile_s,
            }
        )
    return rows


def verdict(problem: Problem, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The library's best against SciPy's best and CHOLMOD, and multigrid's iterations."""
    seconds = {row["solver"]: row["seconds"] for row in rows if row["residual"] < 10 * TOLERANCE}
    best = min((name for name in seconds if name.startswith(("CG", "JaxCG", "Skyline"))), key=seconds.__getitem__)
    scipy_best = min((name for name in seconds if name.startswith("SciPy")), key=seconds.__getitem__)
    return {
        "problem": problem.name,
        "nodes": problem.net.n_nodes,
        "best here": best,
        "seconds": seconds[best],
        "best of SciPy": scipy_best,
        "over_scipy": seconds[best] / seconds[scipy_best],
        "over_cholmod": seconds[best] / seconds["CHOLMOD"],
        "over_pyamg": seconds[best] / seconds["pyamg, CG"],
        "multigrid_iterations": next(row["iterations"] for row in rows if row["solver"] == "CG, Multigrid"),
    }


def products(problem: Problem) -> dict[str, Any]:
    """Million nodes a second, for products with the matrix here and in SciPy."""
    repeats = 10

    @jax.jit
    def repeat(matrix: Any, v: Any) -> Any:
        return lax.fori_loop(0, repeats, lambda _, v: 1e-3 * matrix(v), v)

    clock = Stopwatch()
    program = repeat.lower(problem.matrix, problem.b).compile()
    compile_s = clock.seconds
    jax.block_until_ready(program(problem.matrix, problem.b))
    here, there = [], []
    for _ in range(9):
        clock = Stopwatch()
        jax.block_until_ready(program(problem.matrix, problem.b))
        here.append(clock.seconds / repeats)
        clock = Stopwatch()
        for _ in range(repeats):
            _ = problem.sparse @ problem.right_side
        there.append(clock.seconds / repeats)
    n = problem.net.n_nodes / 1e6
    return {
        "problem": problem.name,
        "here_M": n / float(np.median(here)),
        "scipy_M": n / float(np.median(there)),
        "over_scipy": float(np.median(np.divide(here, there))),
        "compile_s": compile_s,
    }


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def _panels(title: str, nodes: list[float], tables: dict[str, list[dict[str, Any]]]) -> Panel:
    styles = {
        "CG, Multigrid": "o-",
        "CG, BlockJacobi": "s-",
        "Skyline": "^-",
        "SciPy SuperLU": "x--",
        "SciPy CG, Jacobi": "+--",
        "pyamg, CG": "v:",
        "CHOLMOD": "d:",
    }
    curves = {}
    for name, style in styles.items():
        points = [(n, row["seconds"]) for n, rows in zip(nodes, tables.values(), strict=True) for row in rows if row["solver"] == name]
        if points:
            curves[name, style] = ([p[0] for p in points], [p[1] for p in points])
    return Panel(title, "seconds", curves, log=True)


def main() -> None:
    """Measure, print, write the tables and the picture."""
    quick = arguments(__doc__).quick
    sizes = {"cloth": [32, 64] if quick else [32, 64, 128, 256], "mesh": [1000] if quick else [1000, 10_000, 100_000]}
    with jax.enable_x64(True):
        tables, verdicts, rates, panels = {}, [], [], []
        for kind, make in (("cloth", cloth), ("mesh", mesh)):
            nodes, part = [], {}
            for size in sizes[kind]:
                problem = make(size)
                rows = compare(problem, quick)
                show(problem.name, rows)
                part[problem.name] = rows
                nodes.append(float(problem.net.n_nodes))
                verdicts.append(verdict(problem, rows))
                rates.append(products(problem))
            tables |= part
            panels.append(_panels(f"{kind}: one stiff step", nodes, part))
        show("the library's best over the others'", verdicts)
        show("products with the matrix", rates)
        settings = {"tolerance": TOLERANCE, "dtype": "float64", "dt_over_limit": 100}
        path = write("implicit", settings, {"problems": tables, "verdicts": verdicts, "products": rates})
        draw(panels, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
