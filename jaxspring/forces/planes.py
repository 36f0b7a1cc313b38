"""What an impact on a plane is made of: heights, the time of meeting, directions taken away, the share that friction takes.

Source: the stable root of a quadratic as in Press and others, Numerical Recipes (2007), 5.6.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import tiny
from ..vector import Vector

ROUNDING = 16  # of the terms of a height, in units of the last place


class Plane(eqx.Module):
    """A plane as an impact sees it.

    Attributes:
        point: D numbers [m], 0-d arrays.
        normal: D numbers, of length one.
        friction: mu.
        restitution: e.
    """

    point: Vector
    normal: Vector
    friction: Array
    restitution: Array

    def height(self, position: Vector) -> Array:
        """(x - p) . n [m]."""
        return (position - self.point).dot(self.normal)

    def rounding(self, position: Vector) -> Array:
        """Below which a height is rounding [m]."""
        size = position.map(jnp.abs) + self.point.map(jnp.abs)
        return ROUNDING * float(jnp.finfo(position.dtype).eps) * size.dot(self.normal.map(jnp.abs))


def meeting(s: Array, u: Array, a: Array, left: Array, at_once: Array) -> tuple[Array, Array]:
    """First time in which s + u t + a t^2 / 2 comes down through 0 [s], and whether it does within `left`; 0 where it does not, and 0
    without a derivative where it does `at_once`: that of a node at rest is infinite and means nothing.
    """
    sinks = (s + left * (u + 0.5 * left * a) < 0) & ((u <= 0) | (a < 0))
    square = u * u - 2 * a * s
    dips = (a > 0) & (u < 0) & (u + a * left > 0) & (square > 0)
    meets = sinks | dips
    one, zero = jnp.ones_like(s), jnp.zeros_like(s)
    # Chosen before the root and the quotient, so that their derivatives are finite everywhere.
    is_real = meets & (square > 0)
    root = jnp.where(is_real, jnp.sqrt(jnp.where(is_real, square, one)), zero)
    falls = meets & (u > 0)
    top, bottom = jnp.where(falls, u + root, 2 * s), jnp.where(falls, -a, root - u)
    is_apart = meets & ~at_once & (bottom > 0)
    return jnp.where(is_apart, top / jnp.where(is_apart, bottom, one), zero), meets


def counted_from(height: Array, rounding: Array) -> Array:
    """Where a node counts from [m]: the surface, or its own place inside. What is inside by rounding only is on the surface."""
    return jnp.where(height < -rounding, height, jnp.zeros_like(height))


def is_slow(speed: Array, bend: Array, dt: Array, rounding: Array) -> Array:
    """Whether a speed along a normal is rounding of places, or nothing beside what the acceleration `bend` makes of it in the step."""
    part = float(jnp.finfo(speed.dtype).eps) ** 0.5
    return jnp.abs(speed) * dt <= rounding + part * jnp.abs(bend) * dt * dt


def bounces(e: Array, out: Array, bend: Array, left: Array, more: Array) -> tuple[Array, Array, Array]:
    """All further bounces that fit into the time left, where there are `more`.

    Args:
        e: restitution.
        out: speed after the first of them [m/s].
        bend: acceleration along the normal, below zero where there are more [m/s^2].
        left: time [s].
        more: where they are asked for.

    Returns:
        How long they last [s]; 1 + e + e^2 + ..., a term for each; e to their number.
    """
    one, zero = jnp.ones_like(left), jnp.zeros_like(left)
    decays = e < 1
    ratio = jnp.where(decays, e, jnp.full_like(e, 0.5))
    flight = jnp.where(more, 2 * out / jnp.where(more, -bend, one), one)
    log = jnp.log(jnp.maximum(e, tiny(left.dtype)))
    # The last bounce but rounding: which side of it is left to rounding makes no difference to where the node is.
    by_ratio = jnp.log1p(-jnp.where(more & decays, left * (1 - ratio) / flight, zero)) / jnp.where(log < 0, log, jnp.full_like(log, -1))
    n = jnp.where(more, jnp.floor(lax.stop_gradient(jnp.where(decays, by_ratio, left / flight))), zero)
    power = jnp.where(more, jnp.exp(n * log), one)
    spread = jnp.where(decays, (1 - power) / (1 - ratio), n)
    return jnp.where(more, flight * spread, zero), spread, power


def without(v: Vector, basis: tuple[Vector, ...]) -> Vector:
    """`v` without its parts along these directions of length one (or zero)."""
    for e in basis:
        v = v - v.dot(e) * e
    return v


def braked(pull: Array, along: Vector) -> Array:
    """Which part of a tangential velocity friction takes that could take `pull` of it [m/s]. What does not slide it holds: were that
    none, a node at rest would have the derivative of one that nothing holds.
    """
    speed = along.norm()
    is_sliding, one = speed > 0, jnp.ones_like(speed)
    share = jnp.minimum(pull / jnp.where(is_sliding, speed, one), one)
    return jnp.where(is_sliding, share, jnp.where(pull > 0, one, jnp.zeros_like(speed)))


def halted(pull: Array, along: Vector, begun: Vector) -> Array:
    """Which part of a time passes until friction of a constant force has stopped a slide; 1 where it does not.

    Args:
        pull: tangential velocity that friction can take in that time [m/s].
        along: the velocity that the slide would have after it, without friction [m/s].
        begun: the velocity at its begin [m/s].
    """
    speed, reserve = begun.norm(), pull - along.norm()
    one, zero = jnp.ones_like(reserve), jnp.zeros_like(reserve)
    # A speed of rounding is none: what rests stays where it is, bit by bit.
    moves = speed > 64 * float(jnp.finfo(speed.dtype).eps) * pull
    stops = (reserve > 0) & moves
    return jnp.where(reserve > 0, jnp.where(stops, speed / jnp.where(stops, speed + reserve, one), zero), one)


def pick(chosen: tuple[Array, ...], values: tuple[Array, ...]) -> Array:
    """The value of the chosen plane; one plane's alone is no choice."""
    found = values[0]
    for c, value in zip(chosen[1:], values[1:], strict=True):
        found = jnp.where(c, value, found)
    return found


__all__ = ["ROUNDING", "Plane", "bounces", "braked", "counted_from", "halted", "is_slow", "meeting", "pick", "without"]
