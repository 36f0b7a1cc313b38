"""What does the direct solver cost beside SciPy's, and what does keeping its factor save?

    python -m benchmarks.skyline [--quick]

The matrices are M/dt + dt K of a step 100 times the explicit limit, in float64, with random springs: `blocks` couples three coordinates,
`scalar` leaves them decoupled (one factor, three right-hand sides). Read: `over_banded` and `over_superlu` are our seconds over those of
`scipy.linalg.solveh_banded` (LAPACK, in the same order of elimination) and of `scipy.sparse.linalg.splu` (its own order), for factoring and
one solve, in the same interleaved rounds; `gflops` is twice the counted multiply-adds over the seconds of a factorisation, so that a fixed
cost per panel shows at small sizes. The residuals are |b - A x| / |b| in NumPy.

The second table is a linear rollout of 200 steps, x <- A^-1 (M/dt) x: `kept_over_anew` is the time with the factor in memory over that of
factoring in every step; solve, true residual and reading of the entries are in both, their comparison in the first only.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from jax import lax

import jaxspring as js
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix
from jaxspring.linalg.skyline import Skyline
from jaxspring.progress import Stopwatch

from .measure import arguments, show, write
from .scenes import FAMILIES

N_STEPS = 200
DT_OVER_LIMIT = 100.0


class Problem(NamedTuple):
    """A matrix, the same for SciPy in the order of elimination, and a right-hand side in both forms."""

    name: str
    skyline: Skyline
    matrix: SpringMatrix
    sparse: Any
    b: js.Vector
    right_side: np.ndarray
    coupled: int


def problem(name: str, net: Any, points: np.ndarray, scalar: bool) -> Problem:
    """A stiff step on a net at these (N, 3) points."""
    rng = np.random.default_rng(0)
    weight, slope, mass = rng.random(net.n_springs), 0.5 + rng.random(net.n_springs), 0.5 + rng.random(net.n_nodes)
    at_node = np.bincount(net.edges.ravel(), np.repeat(weight + (0 if scalar else slope), 2), net.n_nodes)
    dt = DT_OVER_LIMIT * 2 / np.sqrt(2 * (at_node / mass).max())
    like = net.vector_field(points)
    springs = SpringBlocks(net, net.edge_field(dt * weight), None, None)
    if not scalar:
        # Where a lattice keeps room for springs that do not exist, the difference is zero.
        direction = net.map_springs(lambda d: d / jnp.where(d.norm() > 0, d.norm(), 1.0), net.difference(like))
        springs = SpringBlocks(net, net.edge_field(dt * weight), net.edge_field(dt * slope), direction)
    mass_over_dt = net.node_field(mass / dt)
    matrix = SpringMatrix(Blocks((js.Vector((mass_over_dt,) * 3),), (), (springs,)), (None,) * 3, like, net.layout)
    numbers = rng.standard_normal((net.n_nodes, 3))
    skyline = Skyline(net)
    nodes = skyline.envelope.order.order
    order = (nodes[:, None] * 3 + np.arange(3)).ravel()
    sparse = matrix.to_scipy()[order][:, order]
    if scalar:
        return Problem(name, skyline, matrix, sparse[::3, ::3].tocsc(), net.vector_field(numbers), numbers[nodes], 1)
    return Problem(name, skyline, matrix, sparse.tocsc(), net.vector_field(numbers), numbers[nodes].reshape(-1, 1), 3)


def shared(matrix: SpringMatrix, change: Any = 0.0) -> SpringMatrix:
    """The matrix with one array of masses for all coordinates, whose copies are told apart when it is passed into `jit`."""
    mass = matrix.blocks.diagonal[0].x + change
    return SpringMatrix(Blocks((js.Vector((mass,) * 3),), (), matrix.blocks.springs), matrix.free, matrix.like, matrix.layout)


def problems(sizes: list[int], graph_sizes: list[int]) -> list[Problem]:
    """Cloths of n x n nodes, and Delaunay meshes."""
    rng = np.random.default_rng(1)
    found = []
    for scalar in (True, False):
        kind = "scalar" if scalar else "blocks"
        for n in sizes:
            net = js.lattice((n, n), springs=FAMILIES)
            points = np.c_[net.grid(), np.zeros(n * n)] + 0.2 * rng.standard_normal((n * n, 3))
            found.append(problem(f"cloth {n} x {n}, {kind}", net, points, scalar))
        for n in graph_sizes:
            points = np.c_[rng.random((n, 2)) * np.sqrt(n), 0.1 * rng.standard_normal(n)]
            found.append(problem(f"mesh of {n}, {kind}", js.delaunay(points[:, :2]), points, scalar))
    return found


def solve_once(case: Problem, rounds: int) -> dict[str, Any]:
    """Factor and solve, ours and SciPy's, in interleaved rounds."""
    lower = scipy.sparse.tril(case.sparse).tocoo()
    banded = np.zeros((int((lower.row - lower.col).max()) + 1, case.sparse.shape[0]))
    banded[lower.row - lower.col, lower.col] = lower.data
    clock = Stopwatch()
    factor = jax.jit(lambda matrix: case.skyline.factor(shared(matrix))).lower(case.matrix).compile()
    ours = jax.block_until_ready(factor(case.matrix))
    solve = jax.jit(lambda factor, b: factor.solve(b)).lower(ours, case.b).compile()
    compile_s = clock.seconds
    kept = scipy.linalg.cholesky_banded(banded, lower=True)
    decomposed = _superlu(case.sparse)
    times = interleaved(
        {
            "factor": lambda: factor(case.matrix),
            "banded_factor": lambda: scipy.linalg.cholesky_banded(banded, lower=True, check_finite=False),
            "superlu_factor": lambda: _superlu(case.sparse),
            "solve": lambda: solve(ours, case.b),
            "banded_solve": lambda: scipy.linalg.cho_solve_banded((kept, True), case.right_side, check_finite=False),
            "superlu_solve": lambda: decomposed.solve(case.right_side),
        },
        rounds,
    )
    profile = case.skyline.profile(case.coupled)
    x = np.stack([np.asarray(case.skyline.nodes.inward(a.ravel())) for a in ours.solve(case.b)], axis=-1).reshape(case.right_side.shape)
    whole = times["factor"] + times["solve"]
    return {
        "case": case.name,
        "order": type(case.skyline.ordering).__name__,
        "unknowns": case.sparse.shape[0],
        "entries": profile.entries,
        "multiply_adds": profile.factor_work,
        "stored_over": profile.stored / profile.entries,
        "factor_s": times["factor"],
        "solve_s": times["solve"],
        "gflops": 2e-9 * profile.factor_work / times["factor"],
        "banded_factor_s": times["banded_factor"],
        "banded_solve_s": times["banded_solve"],
        "superlu_factor_s": times["superlu_factor"],
        "superlu_solve_s": times["superlu_solve"],
        "over_banded": whole / (times["banded_factor"] + times["banded_solve"]),
        "over_superlu": whole / (times["superlu_factor"] + times["superlu_solve"]),
        "compile_s": compile_s,
        "residual": _residual(case, x),
        "banded_residual": _residual(case, scipy.linalg.cho_solve_banded((kept, True), case.right_side)),
        "superlu_residual": _residual(case, decomposed.solve(case.right_side)),
    }


def reuse(case: Problem, rounds: int) -> dict[str, Any]:
    """A rollout of linear solves with a constant matrix: the factor kept in memory, or made in every step."""
    clock = Stopwatch()

    def run(is_kept: bool) -> Any:
        def program(matrix: SpringMatrix, b: js.Vector) -> tuple[js.Vector, Any]:
            def step(carry: Any, _: None) -> tuple[Any, Any]:
                x, memory = carry
                # A matrix that the compiler cannot see to be constant, as in a real step; its entries are.
                now = shared(matrix, 0 * x.x)
                b = now.blocks.diagonal[0].x * x
                x, info, renewed = case.skyline.solve_in_step(now, b, None, memory if is_kept else None)
                return (x, renewed), info.residual

            (x, _), residuals = lax.scan(step, (b, case.skyline.init(shared(matrix))), None, length=N_STEPS)
            return x, jnp.max(residuals)

        return jax.jit(program).lower(case.matrix, case.b).compile()

    kept = run(True)
    compile_s, anew = clock.seconds, run(False)
    times = interleaved({"kept": lambda: kept(case.matrix, case.b), "anew": lambda: anew(case.matrix, case.b)}, rounds)
    (x, residual), (other, _) = kept(case.matrix, case.b), anew(case.matrix, case.b)
    return {
        "case": case.name,
        "steps": N_STEPS,
        "kept_s": times["kept"],
        "anew_s": times["anew"],
        "kept_over_anew": times["kept"] / times["anew"],
        "compile_s": compile_s,
        "largest_residual": float(residual),
        "difference": float(max(jnp.max(jnp.abs(a - b)) for a, b in zip(x, other, strict=True))),
    }


def interleaved(cases: dict[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of each, one run of every case in each round."""
    taken: dict[str, list[float]] = {name: [] for name in cases}
    for function in cases.values():
        jax.block_until_ready(function())
    for _ in range(rounds):
        for name, function in cases.items():
            clock = Stopwatch()
            jax.block_until_ready(function())
            taken[name].append(clock.seconds)
    return {name: float(np.median(values)) for name, values in taken.items()}


def picture(rows: list[dict], reused: list[dict], path: Path) -> None:
    """Seconds of a factorisation against its multiply-adds, and of a step with and without its factor."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    counts = np.array([row["multiply_adds"] for row in rows])
    is_mesh = np.array([row["case"].startswith("mesh") for row in rows])
    for prefix, label, color in (("", "Skyline", "C0"), ("banded_", "LAPACK, banded", "C1"), ("superlu_", "SuperLU", "C2")):
        seconds = np.array([row[f"{prefix}factor_s"] for row in rows])
        for kind, marker, where in (("cloth", "o", ~is_mesh), ("mesh", "^", is_mesh)):
            left.loglog(counts[where], seconds[where], marker, color=color, label=f"{label}, {kind}")
    left.loglog(np.sort(counts), 2e-9 * np.sort(counts), "--", color="0.6", label="1 Gflop/s")
    left.set(xlabel="counted multiply-adds, half the sum of h^2", ylabel="seconds of one factorisation", title="stiff steps, float64")
    place = np.arange(len(reused))
    for shift, key, label in ((-0.2, "anew_s", "factored in every step"), (0.2, "kept_s", "factor kept")):
        right.bar(place + shift, [1e3 * row[key] / row["steps"] for row in reused], 0.4, label=label)
    right.set(ylabel="milliseconds per step", title=f"linear rollout of {N_STEPS} steps")
    right.set_xticks(place, [row["case"].replace(", ", "\n") for row in reused])
    right.set_xlabel("net and kind of matrix")
    for axes in (left, right):
        axes.legend(fontsize=8)
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    rounds = 3 if quick else 7
    with jax.enable_x64(True):
        cases = problems([16, 32] if quick else [16, 32, 64], [1000] if quick else [1000, 5000])
        rows = [solve_once(case, rounds) for case in cases]
        chosen = ("cloth 32 x 32, blocks",) if quick else ("cloth 64 x 64, scalar", "cloth 32 x 32, blocks", "mesh of 5000, scalar")
        reused = [reuse(case, 3) for case in cases if case.name in chosen]
    columns = (
        "case",
        "order",
        "entries",
        "stored_over",
        "factor_s",
        "solve_s",
        "gflops",
        "over_banded",
        "over_superlu",
        "compile_s",
        "residual",
    )
    show("factor and solve", [{name: row[name] for name in columns} for row in rows])
    show(
        "the same of SciPy",
        [{name: row[name] for name in ("case", *(k for k in row if "banded_" in k or "superlu_" in k))} for row in rows],
    )
    show("factor reuse", reused)
    path = write("skyline", {"rounds": rounds, "dt_over_limit": DT_OVER_LIMIT, "dtype": "float64"}, {"solves": rows, "reuse": reused})
    picture(rows, reused, path.with_suffix(".png"))


def _superlu(matrix: Any) -> Any:
    """SuperLU in its symmetric mode, which is the faster for these."""
    options = {"SymmetricMode": True}
    return scipy.sparse.linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def _residual(case: Problem, x: np.ndarray) -> float:
    return float(np.linalg.norm(case.right_side - case.sparse @ x) / np.linalg.norm(case.right_side))


if __name__ == "__main__":
    main()
