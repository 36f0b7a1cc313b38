"""Solves with an exact Jacobian, for derivatives: it need not be symmetric, nor positive definite.

Conjugate gradients where the Jacobian is symmetric, stopping at negative curvature; the stabilised bi-conjugate gradients of
`jax.scipy` where it is not. Both are preconditioned by the clamped, positive definite matrix of the same step. A solve that fails
gives NaN, never a half-converged derivative.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import bicgstab
from jaxtyping import Array

from ..numerics import stopped
from ..vector import Vector
from .cg import CG
from .implicit import ImplicitProblem
from .iterative import norm
from .operators import SpringMatrix

Operator = Callable[[Vector], Vector]


class ExactSolver(eqx.Module):
    """How derivatives of converged solutions are solved for.

    Attributes:
        cg: for symmetric Jacobians; its preconditioner serves both.
        allow_nonsymmetric: False refuses systems with non-symmetric forces instead of changing the method.
    """

    cg: CG
    allow_nonsymmetric: bool = eqx.field(static=True)

    def __init__(self, cg: CG | None = None, allow_nonsymmetric: bool = True):
        self.cg = CG() if cg is None else cg
        self.allow_nonsymmetric = allow_nonsymmetric

    def solve_exact(self, jacobian: Operator, b: Vector, nearby: SpringMatrix, is_symmetric: bool) -> Vector:
        """Solve `jacobian` x = b, linear in b.

        Args:
            jacobian: x -> J x.
            b: right-hand side.
            nearby: a positive definite matrix close to J.
            is_symmetric: whether J is.

        Raises:
            TypeError: J is not symmetric, and only conjugate gradients were allowed.
        """
        nearby = lax.stop_gradient(nearby)
        precondition = nearby.within(self.cg.preconditioner.build(nearby))
        if is_symmetric:
            return self.cg.solve(jacobian, b, precondition)[0]
        if not self.allow_nonsymmetric:
            raise TypeError(
                "A force of this system has a Jacobian that is not symmetric (DataSprings that pull z alone, a stiffness that follows an "
                "image, Dashpots, or a force of your own without an energy), and conjugate gradients need symmetry. "
                "Allow bi-conjugate gradients: ExactSolver(allow_nonsymmetric=True)."
            )

        def solve(operator: Operator, rhs: Vector) -> Vector:
            return self._stabilised(operator, rhs, precondition)

        return lax.custom_linear_solve(jacobian, b, solve, transpose_solve=solve)

    def _stabilised(self, operator: Operator, b: Vector, precondition: Operator) -> Vector:
        size = norm(b)
        scale = jnp.maximum(size, jnp.finfo(size.dtype).tiny)
        unit = b / scale
        tolerance = self.cg.tolerance or (1e-8 if size.dtype == jnp.float64 else 1e-5)
        x, _ = bicgstab(operator, unit, tol=tolerance, maxiter=self.cg.max_iter, M=precondition)
        left = unit - operator(x)
        is_solved = jnp.sum(left.dot(left)) <= (10 * tolerance) ** 2
        return jax.tree.map(lambda a: jnp.where(is_solved, a * scale, jnp.full_like(a, jnp.nan)), x)


class Converged(ImplicitProblem):
    """Equations whose solution was found by an iteration that may have failed. Abstract.

    Attributes:
        adjoint: for derivatives, whose matrix is exact and may be indefinite.
        trust: 1 where the solution converged, else NaN, which its derivatives are multiplied by; None before it is known.
    """

    adjoint: ExactSolver
    trust: Array | None

    @abc.abstractmethod
    def nearby(self, theta: Any, y: Vector, /) -> tuple[SpringMatrix, bool]:
        """A positive definite matrix close to the Jacobian, and whether the Jacobian is symmetric."""

    def solve_linearised(self, theta: Any, y: Vector, right_side: Vector) -> Vector:
        """(dr/dy)^-1 right_side, with the exact derivative."""

        def jacobian(u: Vector) -> Vector:
            return jax.jvp(lambda y: self.residual(theta, y), (y,), (u,))[1]

        x = self.adjoint.solve_exact(jacobian, right_side, *self.nearby(theta, stopped(y)))
        return x if self.trust is None else self.trust * x


__all__ = ["Converged", "ExactSolver"]
