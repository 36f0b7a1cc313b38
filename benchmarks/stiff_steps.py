"""Matrices of one stiff step, and the solvers outside the library that they are compared on.

Each rival is a function of a SciPy matrix and a right-hand side; what it can prepare without the numbers is timed apart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

import jaxspring as js
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix, isotropic
from jaxspring.progress import Stopwatch

from .scenes import FAMILIES

STIFFNESS, MASS = 1e4, 1e-2
DT_OVER_LIMIT = 100.0


class Problem(NamedTuple):
    """One linear system in both forms.

    `flat` turns a `Vector` into the order of `sparse`.
    """

    name: str
    net: Any
    matrix: SpringMatrix
    sparse: scipy.sparse.csr_array
    b: js.Vector
    right_side: np.ndarray
    reference: np.ndarray

    def flat(self, v: js.Vector) -> np.ndarray:
        return np.stack([np.asarray(self.matrix.layout.flatten(a)) for a in v], axis=-1).ravel()


def cloth(n: int) -> Problem:
    """An n x n sheet with structural, shear and bend springs, two corners pinned, bent into gentle waves in space."""
    net = js.lattice((n, n), FAMILIES)
    free = np.ones(n * n, bool)
    free[[0, n - 1]] = False
    return _problem(f"cloth {n} x {n}", net, np.c_[net.grid(), np.zeros(n * n)], float(n), free)


def mesh(n_nodes: int) -> Problem:
    """Random points in a square joined by Delaunay's triangulation, the two lower corners pinned, bent likewise."""
    side = float(np.sqrt(n_nodes))
    points = np.random.default_rng(0).random((n_nodes, 2)) * side
    free = np.ones(n_nodes, bool)
    for corner in ((0.0, 0.0), (side, 0.0)):
        free[np.argmin(np.sum((points - corner) ** 2, axis=1))] = False
    return _problem(f"Delaunay {n_nodes}", js.delaunay(points), np.c_[points, np.zeros(n_nodes)], side, free)


def _problem(name: str, net: Any, rest: np.ndarray, side: float, free: np.ndarray) -> Problem:
    """M/dt + dt K with the clamped tangent stiffness; dt is 100 times 2 / omega_max, by power iteration."""
    rng = np.random.default_rng(1)
    wave = 4 * np.pi / side
    x, y, _ = rest.T
    points = rest + np.stack([0.02 * np.sin(wave * y), 0.02 * np.sin(wave * x), 0.3 * np.sin(wave * x) * np.cos(wave * y)], axis=-1) / wave
    position = net.vector_field(points + 0.01 * rng.standard_normal(points.shape))
    d, rest_length = net.difference(position), net.edge_field(net.lengths(rest))
    length = d.map(lambda a: jnp.maximum(a.norm(), 1e-12))  # a lattice keeps places of springs that do not exist, of length zero
    u = d.map(lambda a, r: a / r, length)
    weight = length.map(lambda r, l: STIFFNESS * jnp.maximum(1 - l / r, 0.0), rest_length)
    springs = SpringBlocks(net, weight, weight.map(lambda w: STIFFNESS - w), u)
    mask = net.node_field(free)
    stiffness = SpringMatrix(Blocks(springs=(springs,)), (mask,) * 3, position, net.layout)
    b = stiffness.pick(net.vector_field(rng.standard_normal(points.shape)), js.Vector.zeros_like(position))
    dt = DT_OVER_LIMIT * 2 / np.sqrt(_largest_eigenvalue(stiffness, b) / MASS)
    blocks = Blocks((isotropic(MASS / dt, position),), (), (springs.scaled(dt),))
    matrix = SpringMatrix(blocks, (mask,) * 3, position, net.layout)
    draft = Problem(name, net, matrix, matrix.to_scipy(), b, np.zeros(0), np.zeros(0))
    right_side = draft.flat(b)
    return draft._replace(right_side=right_side, reference=_tight(draft.sparse, right_side))


def _largest_eigenvalue(matrix: SpringMatrix, start: js.Vector) -> float:
    """By 60 power iterations."""

    @jax.jit
    def iterate(matrix: SpringMatrix, v: js.Vector) -> tuple[js.Vector, jax.Array]:
        w = matrix(v)
        size = jnp.sqrt(sum(jnp.sum(a * a) for a in w))
        return w / size, size

    v, size = start, jnp.zeros(())
    for _ in range(60):
        v, size = iterate(matrix, v)
    return float(size)


def _tight(sparse: Any, b: np.ndarray) -> np.ndarray:
    """CHOLMOD's solution, refined once."""
    solve = Cholmod(sparse).factor()
    x = solve(b)
    return x + solve(b - sparse @ x)


class Cholmod:
    """Sparse Cholesky of SuiteSparse, through cvxopt: symbolic at construction, numeric by `factor`."""

    def __init__(self, sparse: Any):
        import cvxopt
        import cvxopt.cholmod

        lower = scipy.sparse.tril(sparse).tocoo()
        self._lower = cvxopt.spmatrix(lower.data, lower.row.astype(int), lower.col.astype(int), lower.shape)
        clock = Stopwatch()
        self._factor = cvxopt.cholmod.symbolic(self._lower)
        self.once = clock.seconds

    def factor(self) -> Callable[[np.ndarray], np.ndarray]:
        """Numeric factorisation; returns the solve."""
        import cvxopt
        import cvxopt.cholmod

        cvxopt.cholmod.numeric(self._lower, self._factor)

        def solve(b: np.ndarray) -> np.ndarray:
            x = cvxopt.matrix(b)
            cvxopt.cholmod.solve(self._factor, x)
            return np.asarray(x).ravel()

        return solve


class Rival(NamedTuple):
    """A solver outside the library: `run()` gives the solution and the iterations (-1: none); `once` is its preparation in seconds."""

    name: str
    run: Callable[[], tuple[np.ndarray, int]]
    once: float | None = None


def rivals(problem: Problem, tolerance: float) -> list[Rival]:
    """SciPy's direct and iterative solvers, pyamg and CHOLMOD, on the same matrix. Conversions between formats are not timed."""
    a, b = problem.sparse, problem.right_side
    columns, bsr = a.tocsc(), scipy.sparse.bsr_array(a, blocksize=(3, 3))
    cholmod = Cholmod(a)

    def superlu() -> tuple[np.ndarray, int]:
        options = {"SymmetricMode": True}
        return scipy.sparse.linalg.splu(columns, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve(b), -1

    def by_cholmod() -> tuple[np.ndarray, int]:
        return cholmod.factor()(b), -1

    def jacobi() -> tuple[np.ndarray, int]:
        inverse = 1 / a.diagonal()
        return _scipy_cg(a, b, tolerance, lambda r: inverse * r)

    def block_jacobi() -> tuple[np.ndarray, int]:
        inverse = np.linalg.inv(_diagonal_blocks(bsr))
        return _scipy_cg(a, b, tolerance, lambda r: np.einsum("nij,nj->ni", inverse, r.reshape(-1, 3)).ravel())

    def amg() -> tuple[np.ndarray, int]:
        import pyamg

        translations = np.tile(np.eye(3), (len(b) // 3, 1))
        hierarchy = pyamg.smoothed_aggregation_solver(scipy.sparse.bsr_matrix(bsr), B=translations)
        residuals: list[float] = []
        x: Any = hierarchy.solve(b, tol=tolerance, accel="cg", maxiter=500, residuals=residuals)
        return x, len(residuals) - 1

    return [
        Rival("SciPy SuperLU", superlu),
        Rival("SciPy CG, Jacobi", jacobi),
        Rival("SciPy CG, block-Jacobi", block_jacobi),
        Rival("pyamg, CG", amg),
        Rival("CHOLMOD", by_cholmod, cholmod.once),
    ]


def _scipy_cg(a: Any, b: np.ndarray, tolerance: float, precondition: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, int]:
    count = 0

    def counted(_: np.ndarray) -> None:
        nonlocal count
        count += 1

    preconditioner = scipy.sparse.linalg.LinearOperator(a.shape, precondition)
    x, _ = scipy.sparse.linalg.cg(a, b, rtol=tolerance, maxiter=10_000, M=preconditioner, callback=counted)
    return x, count


def _diagonal_blocks(bsr: Any) -> np.ndarray:
    rows = np.repeat(np.arange(len(bsr.indptr) - 1), np.diff(bsr.indptr))
    return bsr.data[rows == bsr.indices]
