"""Conjugate gradients that say when they failed: `JaxCG`.

`jax.scipy.sparse.linalg.cg` tells nothing about how it ended: it "converges" on indefinite matrices, its recursive residual drifts from the
true one, and tiny right-hand sides underflow to NaN. Here the right-hand side is scaled to unit norm, and afterwards the true residual and
the sign of the energy are looked at:

    A x = b        residual = |b - A x| / |b|        x'b = x'A x > 0 where A is positive definite

The derivative is implicit (`lax.custom_linear_solve`): one more solve with the same matrix, whatever the number of iterations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array

from .._checks import shape_of
from ..status import Flag, Status

PyTree = Any
Operator = Callable[[PyTree], PyTree]

# The true residual may exceed the tolerance by rounding, which the recursion does not see; more than this factor is a failure.
_SLACK = 10.0


class SolveInfo(eqx.Module):
    """How a linear solve ended.

    Attributes:
        residual: true residual over the norm of the right-hand side; 0 where that is zero.
        status: OK, CG_MAXITER (the tolerance was not reached) or CG_INDEFINITE (negative energy, or NaN).
    """

    residual: Array
    status: Status


class JaxCG(eqx.Module):
    """Preconditioned conjugate gradients for a symmetric positive definite operator.

    Attributes:
        tolerance: wanted residual over |b|; None is 1e-10 in float64 and 1e-5 in float32.
        max_iter: most iterations; None is ten times the number of unknowns.

    Raises:
        ValueError: a tolerance or a number of iterations that is not positive.

    >>> x, info = JaxCG().solve(lambda x: 2 * x, jnp.array([2.0, 4.0]))
    >>> print(x, info.status.describe())
    [1. 2.] OK
    """

    tolerance: float | None = eqx.field(static=True)
    max_iter: int | None = eqx.field(static=True)

    def __init__(self, tolerance: float | None = None, max_iter: int | None = None):
        if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0):
            raise ValueError(f"tolerance = {tolerance}, but a relative residual must be positive and finite. Pass e.g. tolerance=1e-6.")
        if max_iter is not None and max_iter < 1:
            raise ValueError(f"max_iter = {max_iter}: without an iteration nothing is solved. Pass 1 or more.")
        self.tolerance = tolerance
        self.max_iter = max_iter

    def solve(
        self, matvec: Operator, b: PyTree, preconditioner: Operator | None = None, x0: PyTree | None = None
    ) -> tuple[PyTree, SolveInfo]:
        """Solve A x = b.

        Differentiable in `b` and in whatever `matvec` closes over. In reverse mode a backward solve that fails gives NaN, never a
        half-converged gradient. A forward-mode tangent is solved to the same tolerance but cannot report.

        Args:
            matvec: x -> A x, linear, symmetric and positive definite; on arrays or pytrees (a `Vector`) like `b`.
            b: right-hand side.
            preconditioner: r -> approximately A^-1 r, symmetric positive definite too. It changes the work, not the answer.
            x0: where to start; its derivative is not taken.

        Returns:
            x like `b`, and a `SolveInfo`. A zero right-hand side gives zeros.
        """
        start = None if x0 is None else lax.stop_gradient(x0)

        def forward(operator: Operator, rhs: PyTree) -> tuple[PyTree, SolveInfo]:
            return self._run(operator, rhs, preconditioner, start)

        def backward(operator: Operator, rhs: PyTree) -> tuple[PyTree, SolveInfo]:
            # The guess belongs to the forward problem; the adjoint starts from zero.
            x, info = self._run(operator, rhs, preconditioner, None)
            return jax.tree.map(lambda a: jnp.where(info.status.is_ok, a, jnp.nan), x), info

        return lax.custom_linear_solve(matvec, b, forward, backward, symmetric=True, has_aux=True)

    def _run(self, matvec: Operator, b: PyTree, preconditioner: Operator | None, x0: PyTree | None) -> tuple[PyTree, SolveInfo]:
        norm = _norm(b)
        dtype = norm.dtype
        is_zero = norm == 0
        scale = jnp.where(is_zero, jnp.ones((), dtype), norm)
        unit = _scaled(b, 1 / scale)
        guess = None if x0 is None else _scaled(x0, jnp.where(is_zero, jnp.zeros((), dtype), 1 / scale))
        tolerance = self.tolerance or (1e-10 if dtype == jnp.float64 else 1e-5)
        limit = self.max_iter or 10 * sum(math.prod(shape_of(leaf)) for leaf in jax.tree.leaves(b))
        x, _ = cg(matvec, unit, x0=guess, tol=tolerance, maxiter=limit, M=preconditioner)
        residual = _norm(jax.tree.map(jnp.subtract, unit, matvec(x)))
        # x'b is the energy of the solution; with a positive definite matrix it is positive, and NaN is a breakdown.
        is_definite = (_dot(x, unit) > 0) & jnp.isfinite(residual) | is_zero
        status = Status.when(Flag.CG_INDEFINITE, ~is_definite).then(Status.when(Flag.CG_MAXITER, ~(residual <= _SLACK * tolerance)))
        x = jax.tree.map(lambda a: jnp.where(is_zero, jnp.zeros_like(a), a * scale), x)
        return x, SolveInfo(residual, status)


def _dot(a: PyTree, b: PyTree) -> Array:
    return jax.tree.reduce(jnp.add, jax.tree.map(lambda p, q: jnp.sum(p * q), a, b))


def _norm(a: PyTree) -> Array:
    """Euclidean norm that neither underflows nor overflows where the entries do not."""
    largest = jax.tree.reduce(jnp.maximum, jax.tree.map(lambda p: jnp.max(jnp.abs(p)), a))
    safe = jnp.where((largest > 0) & jnp.isfinite(largest), largest, jnp.ones_like(largest))
    return safe * jnp.sqrt(_dot(_scaled(a, 1 / safe), _scaled(a, 1 / safe)))


def _scaled(a: PyTree, factor: Array) -> PyTree:
    return jax.tree.map(lambda p: p * factor, a)


__all__ = ["JaxCG", "SolveInfo"]
