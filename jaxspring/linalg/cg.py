"""Conjugate gradients that say when they failed: `JaxCG` and `CG`.

`jax.scipy.sparse.linalg.cg` tells nothing about how it ended: it "converges" on indefinite matrices, its recursive residual drifts from the
true one, and tiny right-hand sides underflow to NaN. `JaxCG` runs it inside the guards of `iterative.py`. `CG` is a loop of our own inside
the same guards: it also counts its iterations and stops where the matrix shows a direction of no or negative curvature.

Source: Hestenes and Stiefel (1952); preconditioned form as in Saad, Iterative Methods for Sparse Linear Systems (2003), algorithm 9.1.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array

from ..status import Flag, Status
from .base import SolveInfo
from .iterative import Ended, IterativeSolver, Operator, PyTree, dot, identity


class JaxCG(IterativeSolver):
    """Preconditioned conjugate gradients by JAX, for a symmetric positive definite operator; does not tell its iterations.

    Attributes:
        tolerance: wanted residual over |b|; None is 1e-8 in float64 and 1e-5 in float32.
        max_iter: most iterations; None is ten times the number of unknowns, at most 10,000.
        adjoint_tolerance: the same for the solves of reverse-mode derivatives; None is that of the forward solve.
        preconditioner: made anew from every matrix in a step.

    Raises:
        ValueError: a tolerance or a number of iterations that is not positive.

    >>> x, info = JaxCG().solve(lambda x: 2 * x, jnp.array([2.0, 4.0]))
    >>> print(x, info.status.describe())
    [1. 2.] OK
    """

    def iterate(self, matvec: Operator, b: PyTree, start: PyTree, residual: PyTree, precondition: Operator, tolerance: float) -> Ended:
        """Run `jax.scipy.sparse.linalg.cg`."""
        # Given its own identity it spares a product of vectors.
        chosen = None if precondition is identity else precondition
        x, _ = cg(matvec, b, x0=start, tol=tolerance, maxiter=self.limit(b), M=chosen)
        return Ended(x, jnp.asarray(-1, jnp.int32), Status.ok())


class CG(IterativeSolver):
    """Preconditioned conjugate gradients that count their iterations and stop at a direction p with p'A p <= 0.

    There x is the last iterate before, which Newton's method can still use, and the status is CG_INDEFINITE.

    Attributes:
        tolerance: wanted residual over |b|; None is 1e-8 in float64 and 1e-5 in float32.
        max_iter: most iterations; None is ten times the number of unknowns, at most 10,000.
        adjoint_tolerance: the same for the solves of reverse-mode derivatives; None is that of the forward solve.
        preconditioner: made anew from every matrix in a step.

    Raises:
        ValueError: a tolerance or a number of iterations that is not positive.

    >>> x, info = CG().solve(lambda x: jnp.array([1.0, 2.0]) * x, jnp.array([2.0, 4.0]))
    >>> print(x.round(5), info.iterations)
    [2. 2.] 2
    """

    def iterate(self, matvec: Operator, b: PyTree, start: PyTree, residual: PyTree, precondition: Operator, tolerance: float) -> Ended:
        """Iterate until the recursive residual is below the tolerance, or a curvature is not positive."""
        squared = dot(residual, residual)
        one = jnp.ones_like(squared)
        # Below rounding squared the recursion only shrinks towards underflow.
        goal = max(tolerance, float(jnp.finfo(squared.dtype).eps) ** 2) ** 2
        limit = self.limit(b)
        zero = jax.tree.map(jnp.zeros_like, b)

        def goes_on(s: _Iteration) -> Array:
            return (s.squared > goal) & (s.n_done < limit) & (s.curvature > 0)

        def step(s: _Iteration) -> _Iteration:
            z = precondition(s.r)
            energy = dot(s.r, z)
            p = _add(z, jnp.where(s.n_done == 0, jnp.zeros_like(energy), energy / s.energy), s.p)
            image = matvec(p)
            curvature = dot(p, image)
            # No step where the curvature is not positive (or NaN): x stays what it was.
            length = jnp.where(curvature > 0, energy / curvature, jnp.zeros_like(energy))
            r = _add(s.r, -length, image)
            return _Iteration(_add(s.x, length, p), r, p, energy, dot(r, r), curvature, s.n_done + 1)

        first = _Iteration(start, residual, zero, one, squared, one, jnp.asarray(0, jnp.int32))
        last = lax.while_loop(goes_on, step, first)
        is_number = jnp.isfinite(last.curvature) & jnp.isfinite(last.squared)
        status = Status.when(Flag.CG_INDEFINITE, is_number & ~(last.curvature > 0)).then(Status.when(Flag.NONFINITE, ~is_number))
        return Ended(last.x, last.n_done, status)


class _Iteration(NamedTuple):
    """Solution, residual, search direction, r'M r and r'r, p'A p, and iterations done."""

    x: PyTree
    r: PyTree
    p: PyTree
    energy: Array
    squared: Array
    curvature: Array
    n_done: Array


def _add(a: PyTree, factor: Array, b: PyTree) -> PyTree:
    return jax.tree.map(lambda u, v: u + factor * v, a, b)


__all__ = ["CG", "JaxCG", "SolveInfo"]
