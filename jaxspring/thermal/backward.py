"""One backward step of heat: the temperatures at its end, by linear solves.

    r(y) = C (y0 - y) + dt P(theta(y)) = 0        [J]      where the temperature is free

    (C + dt (S + K)) dtheta = r        over the nodes that are neither held nor melting; dtheta = 0 for those
    dy = dtheta                        for the former,     dy = (r - dt K dtheta) / C    for nodes that melt

S are the slopes of boundaries, K the conductances. Where the power is linear this is one solve; with latent heat or radiation it is
Newton's method, all of whose matrices are symmetric and positive definite; `phase.py` keeps it from cycling where nodes melt.

Solves end at a tolerance, but heat must not be lost to it: at the end y rises everywhere by the one number that makes the sum of the
equations hold, sum(r) = 0 (a Galerkin correction by a constant). The sum then holds to rounding, whatever the tolerance and dt.

Source: backward Euler, in the conservative form of the slide "Heating and Melting".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..linalg.base import LinearSolver, SolveInfo
from ..linalg.implicit import ImplicitProblem, implicitly
from ..linalg.iterative import norm
from ..linalg.operators import SpringMatrix
from ..numerics import stopped
from ..status import Flag, Status
from ..vector import Vector
from .flow import Flow
from .phase import Equation, relaxed, searched

SolveInStep = Callable[..., tuple[Vector, SolveInfo, Any]]


class HeatIteration(eqx.Module):
    """How far the iteration of a nonlinear heat step goes.

    Attributes:
        tolerance: heat that may be missing in the nodes' balances, over the heat that there is; None is 1e-8 in float64 and 1e-5 in
            float32. No less than rounding of the temperatures allows.
        max_iter: most iterations; where they do not suffice the status is SOLVER.

    Raises:
        ValueError: a tolerance or a number of iterations that is not positive.
    """

    tolerance: float | None = eqx.field(static=True, default=None)
    max_iter: int = eqx.field(static=True, default=100)

    def __check_init__(self) -> None:
        if self.tolerance is not None and not self.tolerance > 0:
            raise ValueError(f"tolerance = {self.tolerance}, but must be positive. Pass e.g. tolerance=1e-6.")
        if self.max_iter < 1:
            raise ValueError(f"max_iter = {self.max_iter}: without an iteration nothing is solved. Pass 1 or more.")


class _Stand(NamedTuple):
    """Where the iteration stands: y, what is missing, iterations, how the last solve ended."""

    y: Array
    missing: Array
    n_done: Array
    status: Status


class BackwardStep(ImplicitProblem):
    """A backward step by a linear solver, with its derivative by the implicit function theorem."""

    solver: LinearSolver
    iteration: HeatIteration

    def solve(self, flow: Flow, start: Array, dt: Array) -> tuple[Array, Status]:
        """The unknown y at the end of a step of dt [s], and how it was found; `flow` is at the end of the step."""
        equation = Equation(flow, start, dt, jnp.ones((), start.dtype))
        still = stopped(equation)
        first = still.flow.hold(still.start)
        stand = _Stand(first, still.missing(first), jnp.zeros((), jnp.int32), Status.ok())
        if flow.is_linear:
            stand = self._improved(still, stand)
            status = stand.status
        else:
            stand = lax.while_loop(lambda s: self._goes_on(still, s), lambda s: self._improved(still, s), stand)
            status = Status.when(Flag.SOLVER, ~self._is_done(still, stand))
        trust = jnp.where(status.is_ok, jnp.ones_like(dt), jnp.full_like(dt, jnp.nan))
        equation = dataclasses.replace(equation, trust=trust)
        return balanced(equation, implicitly(self, equation, stand.y)), status

    def residual(self, equation: Equation, y: Array) -> Array:
        """Minus r(y) where free, y less what is given elsewhere."""
        held = equation.flow.held()
        missing = -equation.missing(y)
        return missing if held is None else jnp.where(held, y - equation.flow.hold(y), missing)

    def solve_linearised(self, equation: Equation, y: Array, right_side: Array) -> Array:
        """The change of y for a change of the residual."""
        flow, matrix = equation.flow, equation.matrix(y)
        held, melting = flow.held(), flow.is_melting(y)
        given = jnp.zeros_like(right_side) if held is None else jnp.where(held, right_side, jnp.zeros_like(right_side))
        pushed = right_side if held is None else right_side - _times(matrix, self._warmed(given, melting))
        dtheta = self._change(matrix, pushed, self.solver.solve_in_step, None)[0]
        if held is not None:
            dtheta = jnp.where(held, self._warmed(given, melting), dtheta)
        change = dtheta if held is None else jnp.where(held, given, dtheta)
        if melting is not None:
            taken = (right_side - _times(matrix, dtheta)) / flow.capacity
            change = jnp.where(melting & (True if held is None else ~held), taken, change)
        return change * equation.trust

    def _warmed(self, dy: Array, melting: Array | None) -> Array:
        """Change of temperature of a change of y."""
        return dy if melting is None else jnp.where(melting, jnp.zeros_like(dy), dy)

    def _change(self, matrix: SpringMatrix, right_side: Array, solve: SolveInStep, guess: Array | None) -> tuple[Array, Status]:
        """The matrix' solution over the free nodes by one of the solver's two ways, zero for the others."""
        zero = Vector((jnp.zeros_like(right_side),))
        start = None if guess is None else Vector((guess,))
        b = matrix.pick(Vector((right_side,)), zero)
        x, info, _ = solve(matrix, b, start, self.solver.init(matrix))
        return matrix.pick(x, zero)[0], info.status

    def _improved(self, equation: Equation, stand: _Stand) -> _Stand:
        """One solve over the nodes that do not melt, and what those that do take up.

        The unknown of the first is the temperature over the middle of all, so that a tolerance is one of differences; later ones
        correct what is missing.
        """
        flow = equation.flow
        y, missing = stand.y, stand.missing
        if flow.latent is not None:
            y = relaxed(equation, relaxed(equation, y))
            missing = equation.missing(y)
        matrix = lax.optimization_barrier(equation.matrix(y))
        theta = flow.temperature(y)
        zero = Vector((jnp.zeros_like(theta),))
        over = theta - 0.5 * (jnp.max(theta) + jnp.min(theta))
        is_first = stand.n_done == 0
        before = matrix.pick(Vector((jnp.where(is_first, over, zero[0]),)), zero)
        right_side = jnp.where(is_first, _afresh(equation, matrix, y, over), missing)
        guess = matrix.pick(before + _rise(matrix, missing), zero)[0]
        after, status = self._change(matrix, right_side, self.solver.find_in_step, guess)
        dtheta = after - before[0]
        y = y + dtheta if flow.latent is None else searched(equation, matrix, y, missing, dtheta)
        return _Stand(y, equation.missing(y), stand.n_done + 1, status)

    def _goes_on(self, equation: Equation, stand: _Stand) -> Array:
        return ~self._is_done(equation, stand) & (stand.n_done < self.iteration.max_iter) & jnp.all(jnp.isfinite(stand.missing))

    def _is_done(self, equation: Equation, stand: _Stand) -> Array:
        """Whether what is missing is small beside the heat there is, or no larger than rounding."""
        flow, y = equation.flow, stand.y
        theta = flow.temperature(y)
        eps = float(jnp.finfo(y.dtype).eps)
        tolerance = self.iteration.tolerance or (1e-8 if y.dtype == jnp.float64 else 1e-5)
        over = y - 0.5 * (jnp.max(y) + jnp.min(y))
        heat = norm(flow.capacity * over) + norm(flow.capacity * (y - equation.start))
        rounding = 4 * eps * (norm(equation.matrix(y).diagonal()[0] * jnp.abs(theta)) + norm(flow.capacity * y))
        return norm(stand.missing) <= tolerance * heat + rounding


def balanced(equation: Equation, y: Array) -> Array:
    """The unknown y raised by one number, so that the nodes' balances add up to zero."""
    flow = equation.flow
    held, melting = flow.held(), flow.is_melting(y)
    one, zero = jnp.ones_like(y), jnp.zeros_like(y)
    warmed = one if melting is None else jnp.where(melting, zero, one)
    warmed = warmed if held is None else jnp.where(held, zero, warmed)
    matrix = equation.matrix(y)
    # What the matrix says of a uniform rise of y; nodes that melt take it up without getting warmer.
    weight = _times(matrix, warmed) + flow.capacity * (one - warmed)
    weight = weight if held is None else jnp.where(held, zero, weight)
    total = jnp.sum(weight)
    rise = jnp.sum(equation.missing(y)) / jnp.where(total > 0, total, jnp.ones_like(total))
    return y + rise if held is None else jnp.where(held, y, y + rise)


def _afresh(equation: Equation, matrix: SpringMatrix, y: Array, over: Array) -> Array:
    """What is missing, plus the matrix times `over` where free, without the difference of large terms that these two are."""
    flow, zero = equation.flow, jnp.zeros_like(over)
    given = flow.capacity * (equation.start - y) + equation.dt * flow.supplied(flow.temperature(y))
    for diagonal in matrix.blocks.diagonal:
        given = given + diagonal[0] * over
    if matrix.free[0] is None:
        return given
    stuck = matrix.pick(Vector((zero,)), Vector((over,)))
    for link in matrix.blocks.springs:
        given = given - link.product(stuck)[0]
    return given


def _rise(matrix: SpringMatrix, missing: Array) -> Array:
    """The uniform change of temperature that balances the sum over the free nodes."""
    zero = Vector((jnp.zeros_like(missing),))
    one = matrix.pick(Vector((jnp.ones_like(missing),)), zero)
    weight = jnp.sum(matrix.pick(matrix(one), zero)[0])
    return jnp.sum(matrix.pick(Vector((missing,)), zero)[0]) / jnp.where(weight > 0, weight, jnp.ones_like(weight))


def _times(matrix: SpringMatrix, v: Array) -> Array:
    """The product without identity rows."""
    return matrix.blocks.product(Vector((v,)))[0]


__all__ = ["BackwardStep", "Equation", "HeatIteration", "balanced"]
