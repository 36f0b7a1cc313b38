"""Which nodes are solid, melting or liquid after a backward step: a convex problem, and two steps that lower it.

    F(theta) = theta' A theta / 2 - b' theta + sum_i L_i max(theta_i - theta_m, 0)        A = C + dt (S + K)

The balance of the nodes is F's derivative; `h` between 0 and L is its slope at the kink. Newton's method alone may cycle between phases.

    relaxed     D theta' + h' = D theta + h + r      D >= A: each node melts or freezes by itself; F never rises
    searched    theta + s dtheta, s = 1, 1/2, ...    Newton's step over the nodes off the kink, as far as F falls most

Source: Graeser and Kornhuber (2009), "Multigrid methods for obstacle problems" (truncated nonsmooth Newton steps).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..linalg.operators import SpringMatrix
from ..vector import Vector
from .flow import Flow
from .latent import LatentHeat

# Shortest step tried is 2**-12: beyond, the relaxation does better.
_HALVINGS = 12


class Equation(eqx.Module):
    """What is given of a step.

    Attributes:
        flow: what heats the nodes at the end of the step.
        start: y at its beginning [K].
        dt: [s].
        trust: 1, or NaN where y was not found: a derivative of it is then NaN, never a wrong number.
    """

    flow: Flow
    start: Array
    dt: Array
    trust: Array

    def missing(self, y: Array) -> Array:
        """What is missing, r(y) [J], zero where held."""
        flow = self.flow
        r = flow.capacity * (self.start - y) + self.dt * flow.power(flow.temperature(y))
        held = flow.held()
        return r if held is None else jnp.where(held, jnp.zeros_like(r), r)

    def matrix(self, y: Array) -> SpringMatrix:
        """The matrix C + dt (S + K), identity where held or melting."""
        return self.flow.matrix(y, self.dt)


def relaxed(equation: Equation, y: Array) -> Array:
    """The unknown y after every node has taken up what it misses, as if its neighbours stood still."""
    flow, latent = equation.flow, _latent(equation)
    missing = equation.missing(y)
    theta, h = flow.temperature(y), latent.enthalpy(y, flow.capacity)
    # Twice the conductances bound the matrix: no node overshoots.
    around = equation.dt * sum(link.net.incident_sum(link.weight) for link in flow.links)
    slope = flow.slope(theta)
    stiff = flow.capacity + 2 * around + (0 if slope is None else equation.dt * slope)
    z = latent.joined(theta, h + missing, stiff)
    return _kept(flow, y, latent.joined(latent.temperature(z, stiff), latent.enthalpy(z, stiff), flow.capacity))


def searched(equation: Equation, matrix: SpringMatrix, y: Array, missing: Array, dtheta: Array) -> Array:
    """The unknown after a change of temperature, shortened to where F falls most; nodes that melt take up what then reaches them.

    Tried are the step, its halves and quarters, and the step in which every node stops where it would cross the melting point.
    """
    flow, latent = equation.flow, _latent(equation)
    h, over = latent.enthalpy(y, flow.capacity), latent.above(y, flow.capacity)
    crosses = (over * (over + dtheta) < 0) | ((over != 0) & (over + dtheta == 0))
    steps = (dtheta, jnp.where(crosses, -over, dtheta))
    pushes = tuple(matrix.blocks.product(Vector((step,)))[0] for step in steps)
    slopes = tuple(-jnp.sum((missing + h) * step) for step in steps)
    curvatures = tuple(jnp.sum(step * push) for step, push in zip(steps, pushes, strict=True))

    def merit(which: int, s: Array) -> Array:
        kink = jnp.maximum(over + s * steps[which], jnp.zeros_like(over)) - jnp.maximum(over, jnp.zeros_like(over))
        return s * slopes[which] + 0.5 * s * s * curvatures[which] + jnp.sum(latent.latent * kink)

    lengths = 0.5 ** jnp.arange(_HALVINGS + 1, dtype=y.dtype)
    merits = lax.map(lambda s: merit(0, s), lengths)
    # Without a change of phase the whole step is the lowest; rounding of F must not shorten it.
    s = jnp.where(jnp.any(crosses), lengths[jnp.argmin(merits)], jnp.ones_like(lengths[0]))
    stops = jnp.any(crosses) & (merit(1, jnp.ones_like(s)) <= jnp.min(merits))
    reached = jnp.where(stops, jnp.where(crosses, jnp.zeros_like(over), over + dtheta), over + s * dtheta)
    pushed = jnp.where(stops, pushes[1], s * pushes[0])
    zero, full = jnp.zeros_like(h), jnp.broadcast_to(latent.latent, h.shape)
    h = jnp.where(reached > 0, full, jnp.where(reached < 0, zero, jnp.clip(h + missing - pushed, zero, full)))
    return _kept(flow, y, reached + h / flow.capacity)


def _kept(flow: Flow, y: Array, changed: Array) -> Array:
    held = flow.held()
    return changed if held is None else jnp.where(held, y, changed)


def _latent(equation: Equation) -> LatentHeat:
    if equation.flow.latent is None:
        raise ValueError("a step without latent heat knows no phases.")
    return equation.flow.latent


__all__ = ["Equation", "relaxed", "searched"]
