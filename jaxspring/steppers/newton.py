"""Newton's method for an implicit stage, with a line search on what the stage minimises.

    Phi(y) = sum M (y - v0)^2 / 2 + sum over forces of their potential at x0 + h y        grad Phi = h r(y)

    A d = -r         A exact; where it shows a curvature that is not positive, A = M/h + G + h K clamped: Phi falls along d
    y <- y + a d     a = 1, 1/2, 1/4, ... until Phi falls enough

Near the solution the exact matrix doubles the digits in every step; the clamped one gains a factor of two or so where springs are
squeezed. Where a force has no potential, |r|^2 takes the place of Phi and only the clamped matrix is used. The derivative of the result
always takes the exact one: with the clamped one in its place every gradient of a squeezed net would be silently wrong.

Source: Gast and others (2015), "Optimization Integrator for Large Time Steps", for the potential.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

from ..forces.linearisation import Tangent
from ..linalg.base import LinearSolver, SolveInfo
from ..linalg.exact import Converged
from ..linalg.implicit import SOLUTION, implicitly
from ..linalg.iterative import IterativeSolver
from ..linalg.operators import SpringMatrix
from ..linalg.preconditioners import BlockJacobi
from ..numerics import stopped
from ..status import Flag, Status
from ..vector import Vector
from .stage import Stage
from .truncated import truncated_cg


class Newton(eqx.Module):
    """How far Newton's method goes.

    Attributes:
        tolerance: wanted residual over the size of the forces; None is 1e-10 in float64 and 1e-5 in float32. No less than rounding of the
            positions allows.
        max_iter: most iterations.
        max_halvings: most halvings of a step in the line search.
    """

    tolerance: float | None = eqx.field(static=True, default=None)
    max_iter: int = eqx.field(static=True, default=100)
    max_halvings: int = eqx.field(static=True, default=20)


class _Progress(eqx.Module):
    """Where the iteration stands."""

    y: Vector
    r: Vector
    norm: Array
    merit: Array
    newton_iterations: Array
    iterations: Array
    status: Status
    memory: Any


class NewtonStage(Converged):
    """The stage solved to convergence.

    Attributes:
        solver: for the directions.
        options: when to stop.
    """

    solver: LinearSolver
    options: Newton

    def residual(self, stage: Stage, y: Vector) -> Vector:
        """M (y - v0) / h - f(x0 + h y, y, t) [N]."""
        return stage.on_free(self.unbalanced(stage, None, y), y)

    def given(self, stage: Stage) -> None:
        """Nothing that stays from one solve of a step to the next."""

    def unbalanced(self, stage: Stage, given: None, y: Vector) -> Vector:
        """The same everywhere [N]: where nodes are held, what holds them."""
        return stage.inertia(y) - stage.system.force(stage.reached(y))

    def nearby(self, stage: Stage, y: Vector) -> tuple[SpringMatrix, bool]:
        """The clamped matrix."""
        state = stopped(stage.reached(y))
        return stage.matrix(state, Tangent()), stage.system.is_symmetric

    def solve(self, stage: Stage, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """The stage's velocity with its derivative, how the solve ended, and what the solver carries on."""
        y, info, memory = self.find(stopped(stage), None, memory)
        return self.derived(stage, y, info), info, memory

    def derived(self, stage: Stage, y: Vector, info: SolveInfo) -> Vector:
        """A solution that `find` gave, with its derivative: NaN where it did not converge."""
        one = jnp.ones_like(info.residual)
        trust = checkpoint_name(jnp.where(info.status.is_ok, one, jnp.full_like(one, jnp.nan)), SOLUTION)
        return implicitly(NewtonStage(self.adjoint, trust, self.solver, self.options), stage, y)

    def find(self, still: Stage, given: None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """The stage's velocity without a derivative, how the solve ended, and what the solver carries on."""
        start = still.system.hold(still.predictor.velocity)
        scale = self.scale(still, None)
        tolerance = self.options.tolerance or (1e-10 if start.dtype == jnp.float64 else 1e-5)
        goal = tolerance * scale + still.rounding()
        merit = self._merit(still)

        def goes_on(at: _Progress) -> Array:
            is_done = at.norm <= goal
            return ~is_done & (at.newton_iterations < self.options.max_iter) & jnp.isfinite(at.norm) & ~at.status.has(Flag.LINE_SEARCH)

        first = self.residual(still, start)
        zero = jnp.zeros((), jnp.int32)
        begin = _Progress(start, first, _norm(first), merit(start, first), zero, zero, Status.ok(), memory)
        end = lax.while_loop(goes_on, lambda at: self._iterate(still, merit, at), begin)
        converged = end.norm <= goal
        failed = end.status.then(Status.when(Flag.SOLVER, ~converged))
        status = jax.tree.map(lambda ok, bad: jnp.where(converged, ok, bad), Status.ok(), failed)
        relative = end.norm / jnp.where(scale > 0, scale, jnp.ones_like(scale))
        return end.y, SolveInfo(relative, end.iterations, status), end.memory

    def _iterate(self, stage: Stage, merit: Any, at: _Progress) -> _Progress:
        direction, iterations, failed, memory = self._direction(stage, at)
        # Phi falls along d at the rate h r.d; |r|^2 is taken to fall at the rate -2 |r|^2 times the step.
        slope = stage.h * _dot(at.r, direction) if self._has_potential(stage) else -2 * at.norm * at.norm
        # Phi is a difference of large numbers: below this, its fall is rounding.
        rounding = jnp.asarray(16 * float(jnp.finfo(at.norm.dtype).eps), at.norm.dtype) * jnp.abs(at.merit)

        def trial(step: Array) -> tuple[Vector, Vector, Array, Array]:
            y = at.y + step * direction
            r = self.residual(stage, y)
            value = merit(y, r)
            # Near the solution the fall of Phi, a sum of terms that cancel, drowns in rounding; the residual still tells.
            falls = (value <= at.merit + 1e-4 * step * slope + rounding) | (_norm(r) <= 0.5 * at.norm)
            return y, r, value, falls & jnp.isfinite(value)

        def halve(found: Any) -> Any:
            step, count, *_ = found
            return 0.5 * step, count + 1, *trial(0.5 * step)

        one = jnp.ones((), at.norm.dtype)
        begin = (one, jnp.zeros((), jnp.int32), *trial(one))
        _, _, y, r, value, falls = lax.while_loop(lambda f: ~f[-1] & (f[1] < self.options.max_halvings), halve, begin)
        status = at.status.then(failed).then(Status.when(Flag.LINE_SEARCH, ~falls))
        y, r, value = jax.tree.map(lambda new, old: jnp.where(falls, new, old), (y, r, value), (at.y, at.r, at.merit))
        return _Progress(y, r, _norm(r), value, at.newton_iterations + 1, at.iterations + iterations, status, memory)

    def _direction(self, stage: Stage, at: _Progress) -> tuple[Vector, Array, Status, Any]:
        """Newton's direction, its iterations, how its solve ended, and what the solver carries on.

        With the exact matrix, as long as conjugate gradients meet no curvature that is not positive: that converges fast. Else with the
        clamped one, which is sure to lead down.
        """
        matrix = stage.matrix(stage.reached(at.y), Tangent())

        def clamped(_: None) -> tuple[Vector, Array, Status, Any]:
            d, info, memory = self.solver.find_in_step(matrix, -at.r, None, at.memory)
            return d, jnp.maximum(info.iterations, 0), info.status, memory

        if not self._has_potential(stage):
            return clamped(None)
        _, jacobian = jax.linearize(lambda y: self.residual(stage, y), at.y)
        # Loose far from the solution, tight near it: the number of digits then doubles with every step.
        loose = jnp.minimum(jnp.asarray(0.1, at.norm.dtype), jnp.sqrt(at.norm / (at.norm + self.scale(stage, None))))
        precondition = self.solver.preconditioner if isinstance(self.solver, IterativeSolver) else BlockJacobi()
        infinite = jnp.full_like(at.norm, jnp.inf)
        exact = truncated_cg(jacobian, -at.r, matrix.within(precondition.build(matrix)), infinite, loose * at.norm)

        def found(_: None) -> tuple[Vector, Array, Status, Any]:
            return exact.d, jnp.zeros((), jnp.int32), Status.ok(), at.memory

        d, iterations, status, memory = lax.cond(exact.is_cut, clamped, found, None)
        return d, exact.iterations + iterations, status, memory

    def _has_potential(self, stage: Stage) -> bool:
        return stage.system.incremental_potential(stage.predictor, stage.h) is not None

    def _merit(self, stage: Stage) -> Any:
        """What the line search wants to fall: (y, r) -> Phi, or |r|^2 without a potential."""
        if not self._has_potential(stage):
            return lambda y, r: _dot(r, r)
        mass = stage.system.mass.astype(stage.h.dtype)

        def potential(y: Vector, r: Vector) -> Array:
            change = stage.full(y) - stage.velocity
            of_forces = stage.system.incremental_potential(stage.reached(y), stage.h)
            inertia = 0.5 * jnp.sum(mass * change.dot(change))
            return inertia if of_forces is None else inertia + of_forces

        return potential

    def scale(self, stage: Stage, given: None) -> Array:
        """Size of the forces where free [N], each effect by itself, so that a balance of large forces is not taken for their absence."""
        at = stage.predictor
        sizes = [_norm(stage.system.hold(force.force(at))) for force in stage.system.forces]
        inertia = _norm((stage.system.mass.astype(stage.h.dtype) / stage.h) * stage.velocity)
        return sum(sizes, start=inertia)


def _dot(a: Vector, b: Vector) -> Array:
    return jnp.sum(a.dot(b))


def _norm(a: Vector) -> Array:
    return jnp.sqrt(_dot(a, a))


__all__ = ["Newton", "NewtonStage"]
