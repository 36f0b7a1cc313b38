"""Springs and dampers that are too short or too long for the square of their length: what a law makes of it is no number to trust.

r.r <= tiny         the square underflows: no direction is left            COINCIDENT, where the spring needs one
r.r = inf           the square overflows                                   NONFINITE
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from ..numerics import tiny
from ..state import State
from ..status import Flag
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from ..vector import Vector
from .base import Finding
from .living import map_living


def too_short_or_long(
    net: Topology, state: State, needs: Callable[[Vector, Array], Array], d: EdgeField, l: Array | EdgeField
) -> tuple[Finding, Finding]:
    """COINCIDENT and NONFINITE: how many springs of each kind, broken ones left out, counted in one pass over the memory.

    Args:
        net: the topology.
        state: with `alive`, which is heeded.
        needs: whether springs of a family need a direction, of their differences and their `l`.
        d: differences along the springs.
        l: a number, or one for each spring.
    """

    def of_family(d: Vector, l: Array) -> tuple[Array, Array]:
        squared = d.dot(d)
        return (squared <= tiny(squared.dtype)) & needs(d, l), jnp.isinf(squared)

    found = map_living(net, state, of_family, d, l)
    short, long = net.counts(*(found.map(lambda pair, i=i: pair[i]) for i in (0, 1)))
    nowhere = jnp.asarray(-1, jnp.int32)
    return Finding(Flag.COINCIDENT, short, nowhere), Finding(Flag.NONFINITE, long, nowhere)


def are_apart(d: Vector) -> Array:
    """Whether the ends of springs are at two places, however near."""
    return jnp.max(jnp.abs(jnp.stack(tuple(d))), axis=0) > 0


__all__ = ["are_apart", "too_short_or_long"]
