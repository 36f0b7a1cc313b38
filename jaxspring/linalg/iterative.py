"""What every iterative solver here does around its iterations, so that its answer can be trusted.

    A x = b        residual = |b - A x| / |b|        x'A x > 0 where A is positive definite

The right-hand side is scaled to unit norm, so that nothing underflows; a guess that is no better than zero is dropped; afterwards the
true residual and the sign of the energy are looked at. The derivative is implicit (`lax.custom_linear_solve`): one more solve with the
same matrix, whatever the number of iterations; where that fails in reverse mode, the gradient is NaN.
"""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._checks import shape_of
from ..numerics import stopped, tied
from ..status import Flag, Status
from ..vector import Vector
from .base import LinearSolver, SolveInfo
from .operators import SpringMatrix
from .preconditioners import BlockJacobi, Preconditioner

PyTree = Any
Operator = Callable[[PyTree], PyTree]

# The true residual may exceed the tolerance by rounding, which the recursion does not see; more than this factor is a failure.
_SLACK = 10.0
# Without a limit a solve that cannot converge would run for hours on a large mesh.
_MOST_ITERATIONS = 10_000


class Ended(NamedTuple):
    """How an iteration ended: its last iterate, how many there were (-1 where it does not tell), and what it noticed itself."""

    x: PyTree
    iterations: Array
    status: Status


class IterativeSolver(LinearSolver):
    """A solver that multiplies by the matrix until the residual is small. Abstract: `JaxCG`, `CG` and `Lineax` are final.

    Attributes:
        tolerance: wanted residual over |b|; None is 1e-8 in float64 and 1e-5 in float32.
        adjoint_tolerance: the same for the solves of reverse-mode derivatives; None is that of the forward solve.
        max_iter: most iterations; None is ten times the number of unknowns, at most 10,000.
        preconditioner: made anew from every matrix in `solve_in_step`.
    """

    tolerance: float | None = eqx.field(static=True, default=None)
    max_iter: int | None = eqx.field(static=True, default=None)
    adjoint_tolerance: float | None = eqx.field(static=True, default=None)
    preconditioner: Preconditioner = BlockJacobi()

    unconverged: ClassVar[Flag] = Flag.CG_MAXITER

    def __check_init__(self) -> None:
        for name in ("tolerance", "adjoint_tolerance"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} = {value}, but a relative residual must be positive and finite. Pass e.g. {name}=1e-6.")
        if self.max_iter is not None and self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter}: without an iteration nothing is solved. Pass 1 or more.")

    @abc.abstractmethod
    def iterate(self, matvec: Operator, b: PyTree, start: PyTree, residual: PyTree, precondition: Operator, tolerance: float) -> Ended:
        """Iterate from `start`, whose residual b - A start is given, until that is below `tolerance`; |b| is 1, or 0."""

    def limit(self, b: PyTree) -> int:
        """Most iterations for this right-hand side."""
        unknowns = sum(math.prod(shape_of(leaf)) for leaf in jax.tree.leaves(b))
        return self.max_iter or min(10 * unknowns, _MOST_ITERATIONS)

    def solve(
        self, matvec: Operator, b: PyTree, preconditioner: Operator | None = None, x0: PyTree | None = None
    ) -> tuple[PyTree, SolveInfo]:
        """Solve A x = b.

        Differentiable in `b` and in whatever `matvec` closes over. In reverse mode a backward solve that fails gives NaN, never a
        half-converged gradient. A forward-mode tangent is solved to the same tolerance but cannot report.

        Args:
            matvec: x -> A x, linear, symmetric and positive definite; on arrays or pytrees (a `Vector`) like `b`.
            b: right-hand side.
            preconditioner: r -> approximately A^-1 r, symmetric positive definite too; None is none. It changes the work, not the answer.
            x0: where to start, unless zero is better; its derivative is not taken.

        Returns:
            x like `b`, and a `SolveInfo`. A zero right-hand side gives zeros.
        """
        start = None if x0 is None else lax.stop_gradient(x0)
        precondition = identity if preconditioner is None else preconditioner
        tolerance = self._goal(b)

        def forward(operator: Operator, rhs: PyTree) -> tuple[PyTree, SolveInfo]:
            return self._guarded(operator, rhs, start, precondition, tolerance)

        def backward(operator: Operator, rhs: PyTree) -> tuple[PyTree, SolveInfo]:
            # The guess belongs to the forward problem; the adjoint starts from zero.
            x, info = self._guarded(operator, rhs, None, precondition, self.adjoint_tolerance or tolerance)
            return jax.tree.map(lambda a: jnp.where(info.status.is_ok, a, jnp.nan), x), info

        return lax.custom_linear_solve(matvec, tied(b), forward, backward, symmetric=True, has_aux=True)

    def solve_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """Solve with a `SpringMatrix`; held coordinates of x are those of b, exactly, and take no part in the iteration."""
        zero = Vector.zeros_like(b)
        start = None if guess is None else matrix.pick(guess, zero)
        still = stopped(matrix)
        precondition = still.within(self.preconditioner.build(still))
        x, info = self.solve(matrix, matrix.pick(b, zero), precondition, start)
        return matrix.pick(x, b), info, memory

    def find_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """As `solve_in_step`, without a derivative."""
        matrix, b, guess = stopped((matrix, b, guess))
        zero = Vector.zeros_like(b)
        start = None if guess is None else matrix.pick(guess, zero)
        precondition = matrix.within(self.preconditioner.build(matrix))
        x, info = self._guarded(matrix, matrix.pick(b, zero), start, precondition, self._goal(b))
        return matrix.pick(x, b), info, memory

    def _goal(self, b: PyTree) -> float:
        """Wanted residual of a solution of unit right-hand side."""
        return self.tolerance or (1e-8 if norm(b).dtype == jnp.float64 else 1e-5)

    def _guarded(
        self, matvec: Operator, b: PyTree, guess: PyTree | None, precondition: Operator, tolerance: float
    ) -> tuple[PyTree, SolveInfo]:
        size = norm(b)
        is_zero = size == 0
        scale = jnp.maximum(size, jnp.finfo(size.dtype).tiny)
        unit = jax.tree.map(lambda a: a / scale, b)
        start, residual = jax.tree.map(jnp.zeros_like, unit), unit
        if guess is not None:
            scaled = jax.tree.map(lambda a: a / scale, guess)
            left = _minus(unit, matvec(scaled))
            # A guess of another problem, or of one much larger, would only cost digits. NaN compares false.
            is_better = (norm(left) < 1) & ~is_zero
            start, residual = _select(is_better, (scaled, left), (start, residual))
        ended = self.iterate(matvec, unit, start, residual, precondition, tolerance)
        info = self._judge(matvec, unit, size, ended, tolerance)
        return jax.tree.map(lambda a: jnp.where(is_zero, jnp.zeros_like(a), a * scale), ended.x), info

    def _judge(self, matvec: Operator, unit: PyTree, size: Array, ended: Ended, tolerance: float) -> SolveInfo:
        """The true residual, and the worst of what can be said."""
        is_zero = size == 0
        has_numbers = _reduced(jnp.logical_and, jnp.all, jax.tree.map(jnp.isfinite, ended.x))
        # Where the iteration broke down to NaN, one product with b tells whether the matrix holds NaN itself.
        image = matvec(_select(has_numbers, ended.x, unit))
        residual = norm(_minus(unit, image))
        is_finite = jnp.isfinite(size) & jnp.isfinite(residual)
        # x'A x < 0 proves that A is indefinite; so does a breakdown without NaN in A or b.
        is_indefinite = is_finite & (~has_numbers | (dot(ended.x, image) < 0)) & ~is_zero
        is_definite = is_finite & ~is_indefinite & ended.status.is_ok
        status = Status.when(Flag.NONFINITE, ~is_finite).then(Status.when(Flag.CG_INDEFINITE, is_indefinite))
        status = status.then(ended.status.only_if(status.is_ok))
        status = status.then(Status.when(self.unconverged, is_definite & ~(residual <= _SLACK * tolerance)))
        shown = jnp.where(has_numbers, residual, jnp.full_like(residual, jnp.nan))
        return SolveInfo(jnp.where(is_zero, jnp.zeros_like(shown), shown), jnp.where(is_zero, 0, ended.iterations), status)


def dot(a: PyTree, b: PyTree) -> Array:
    """Sum of products over all entries."""
    return _reduced(jnp.add, jnp.sum, jax.tree.map(jnp.multiply, a, b))


def norm(a: PyTree) -> Array:
    """Euclidean norm that neither underflows nor overflows where the entries do not.

    Scaled by constants, never by the largest entry: where everything fits in registers, as with a single node, XLA computes the entries
    anew for every use, with other roundings. A residual may then be 1e-17 where it is divided and zero where it is divided by.
    """
    info = jnp.finfo(jax.tree.leaves(a)[0].dtype)
    # Squares of entries up to 1 / eps below a sum of this size are still normal numbers.
    low = float(info.tiny) ** 0.5 / float(info.eps)
    # A power of two: no rounding.
    scale = 2.0 ** round(-0.55 * math.log2(float(info.tiny)))
    plain = _root(dot(a, a))
    # Bounded, so that it stays small where the entries that it is given are not those that chose it.
    raised = jax.tree.map(lambda p: jnp.clip(p * scale, -1 / low, 1 / low), a)
    lowered = jax.tree.map(lambda p: p / scale, a)
    small, large = _root(dot(raised, raised)) / scale, _root(dot(lowered, lowered)) * scale
    return jnp.where(plain > low, jnp.where(jnp.isfinite(plain), plain, large), small)


def _root(squared: Array) -> Array:
    """The square root, 0 with derivative 0 below the smallest normal number."""
    least = jnp.finfo(squared.dtype).tiny
    return jnp.where(squared <= least, jnp.zeros_like(squared), jnp.sqrt(jnp.maximum(squared, least)))


def _reduced(combine: Any, reduce: Any, tree: PyTree) -> Array:
    """One number of all entries. Arrays of one shape are combined first: one pass over the memory, and one kernel to compile."""
    leaves = jax.tree.leaves(tree)
    if len({shape_of(leaf) for leaf in leaves}) > 1:
        leaves = [reduce(leaf) for leaf in leaves]
    return reduce(functools.reduce(combine, leaves))


def _minus(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.subtract, a, b)


def _select(condition: Array, a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(lambda p, q: jnp.where(condition, p, q), a, b)


def identity(r: PyTree) -> PyTree:
    """What stands for a preconditioner where there is none."""
    return r


__all__ = ["Ended", "IterativeSolver", "Operator", "PyTree", "dot", "identity", "norm"]
