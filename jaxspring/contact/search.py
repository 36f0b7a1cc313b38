"""When a node on its way through a step first meets an obstacle.

The distance cannot fall faster than the node and the obstacle approach each other, V: from a distance d nothing is met for the time d / V.
The search goes by such times, or by a 64th of what is left where they are shorter. Where the distance falls at one end of an interval
and rises at the other, it is looked at between them too, where the two tangents cross, and again in the part that still falls and rises:
along a straight way the distance to a convex obstacle lies above its tangents, so that this ends at the lowest point, or where the
tangents cross above zero. The first interval in which the distance becomes negative holds the root, which Newton's method finds, kept
between bounds.

Source: marching by distances as in Hart (1996), "Sphere tracing"; tangents as in Kelley (1960), "The cutting-plane method"; Newton's method
with bisection as in Press and others, Numerical Recipes (2007), 9.4.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import tiny

SHORTEST = 64  # intervals in what is left of a step, at most
NARROWINGS = 24  # looks at a dip, at most
ITERATIONS = 60  # of Newton's method: a bisection alone would need as many as a number has digits


class _Seen(NamedTuple):
    """A time, the distance there and its slope."""

    s: Array
    value: Array
    slope: Array

    def or_else(self, condition: Array, other: _Seen) -> _Seen:
        """What was seen here where the condition holds, else there."""
        return jax.tree.map(partial(jnp.where, condition), self, other)


class _March(NamedTuple):
    """Where the search stands; the end of a dip that is looked into, and how often it was looked at, 0 where there is none; the interval
    of the root, whether it is found, whether the search goes on.
    """

    here: _Seen
    beyond: _Seen
    looks: Array
    low: Array
    high: Array
    is_found: Array
    is_open: Array


def first_root(
    distance: Callable[[Array], tuple[Array, Array]], begin: Array, end: Array, speed: Array, rounding: Array, is_wanted: Array
) -> tuple[Array, Array]:
    """First time between 0 and `end` at which the distance of each node becomes negative [s], and whether there is one.

    Args:
        distance: times -> distances [m] and their slopes [m/s].
        begin: up to here none is met, unless the distance is negative here.
        end: [s].
        speed: V [m/s].
        rounding: a distance that is negative by less is rounding [m].
        is_wanted: which nodes are looked at.
    """
    least, speed = end / SHORTEST, jnp.maximum(speed, tiny(speed.dtype))
    here = _Seen(begin, *distance(begin))
    is_passed = is_wanted & (here.value < -rounding)
    never = jnp.zeros(jnp.shape(begin), jnp.int32)
    start = _March(here, here, never, jnp.zeros_like(begin), begin, is_passed, is_wanted & ~is_passed & (begin < end))

    def further(at: _March) -> _March:
        within = at.looks > 0
        ahead = jnp.minimum(at.here.s + jnp.maximum(at.here.value / speed, least), end)
        s = jnp.where(within, _crossing(at.here, at.beyond)[0], ahead)
        seen = _Seen(s, *distance(s))
        is_in = at.is_open & (seen.value < -rounding)
        # The part that falls at its begin and rises at its end.
        falls = within & (seen.slope <= 0)
        left, right = seen.or_else(falls, at.here), at.beyond.or_else(falls, seen)
        lowest, bottom = _crossing(left, right)
        dips = (left.slope < 0) & (right.slope > 0) & (left.s < lowest) & (lowest < right.s)
        looks_on = at.is_open & ~is_in & dips & ((at.looks == 0) | (bottom < -rounding)) & (at.looks < NARROWINGS)
        low, high = (jnp.where(is_in, new, old) for new, old in ((at.here.s, at.low), (s, at.high)))
        here = left.or_else(looks_on, right)
        ended = ~looks_on & ~(here.s < end)  # NaN ends it
        looks = jnp.where(looks_on, at.looks + 1, 0)
        return _March(here, right, looks, low, high, at.is_found | is_in, at.is_open & ~is_in & ~ended)

    found = lax.while_loop(lambda at: jnp.any(at.is_open), further, start)
    return _polished(distance, found), found.is_found


def _crossing(a: _Seen, b: _Seen) -> tuple[Array, Array]:
    """Where the tangents at the ends of an interval cross [s], and how high [m]; at its end where they do not cross within."""
    turns = (a.slope < 0) & (b.slope > 0)
    steps = jnp.where(turns, a.slope - b.slope, -jnp.ones_like(b.slope))
    lowest = jnp.where(turns, jnp.clip(a.s + (b.value - a.value - b.slope * (b.s - a.s)) / steps, a.s, b.s), b.s)
    return lowest, b.value + b.slope * (lowest - b.s)


def _polished(distance: Callable[[Array], tuple[Array, Array]], found: _March) -> Array:
    """The root in the interval that was found."""

    def newton(at: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
        s, low, high, is_open, count = at
        value, slope = distance(s)
        low, high = jnp.where(value >= 0, s, low), jnp.where(value < 0, s, high)
        ahead = s - value / jnp.where(slope == 0, jnp.ones_like(slope), slope)
        is_between = (ahead >= low) & (ahead <= high) & (slope != 0)
        new = jnp.where(is_between, ahead, 0.5 * (low + high))
        enough = 2 * float(jnp.finfo(s.dtype).eps) * high
        return jnp.where(is_open, new, s), low, high, is_open & (jnp.abs(new - s) > enough), count + 1

    start = (0.5 * (found.low + found.high), found.low, found.high, found.is_found, jnp.zeros((), jnp.int32))
    return lax.while_loop(lambda at: jnp.any(at[3]) & (at[4] < ITERATIONS), newton, start)[0]


__all__ = ["first_root"]
