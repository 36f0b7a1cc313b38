"""Lengths of all springs of a net in one array, for the looks of a status: one loop serves all families, and compiles sooner.

Springs and dampers so long that the square of their length overflows have no number to trust:

    |r| <= 2 sqrt(D) max |x|        none is counted before the coordinates are large enough for the longest to be beyond the range
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import any_lane, tiny
from ..state import State
from ..status import Flag
from ..topology.base import Topology
from ..vector import Vector
from .base import Finding
from .living import living


def squared_lengths(net: Topology, near: Topology, state: State, seen: Vector) -> Array:
    """(E,) squares [m^2] in the net's own order, 1 of a broken spring.

    Args:
        net: the topology.
        near: the same with the periods of the coordinates between which the springs run.
        state: with `alive`, which is heeded.
        seen: these coordinates.
    """
    return _of_living(net, state, net.joined(near.difference(seen).map(lambda d: d.dot(d))))


def are_apart(net: Topology, near: Topology, state: State, seen: Vector) -> Array:
    """(E,) whether the ends of each spring are at two places, however near."""
    largest = net.joined(near.difference(seen).map(lambda d: jnp.max(jnp.abs(jnp.stack(tuple(d))), axis=0)))
    return _of_living(net, state, largest) > 0


def blind(squared: Array, counts: Array | bool) -> Finding:
    """COINCIDENT: how many springs of those that count are so short that their square underflows: they have no direction."""
    is_short = (squared <= tiny(squared.dtype)) & counts
    return Finding(Flag.COINCIDENT, jnp.sum(is_short.astype(jnp.int32), dtype=jnp.int32), jnp.asarray(-1, jnp.int32))


def beyond_range(squared: Array, seen: Vector) -> Finding:
    """NONFINITE: how many springs are too long."""
    largest = seen.largest()
    safe = (float(jnp.finfo(largest.dtype).max) / (8 * seen.dim)) ** 0.5
    is_far = any_lane(~(largest < safe))
    n = lax.cond(is_far, lambda s: jnp.sum(jnp.isinf(s).astype(jnp.int32), dtype=jnp.int32), lambda _: jnp.zeros((), jnp.int32), squared)
    return Finding(Flag.NONFINITE, n, jnp.asarray(-1, jnp.int32))


def _of_living(net: Topology, state: State, values: Array) -> Array:
    alive = living(net, state)
    return values if alive is None else jnp.where(net.joined(alive), values, jnp.ones((), values.dtype))


__all__ = ["are_apart", "beyond_range", "blind", "squared_lengths"]
