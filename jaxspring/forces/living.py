"""What acts along springs heeds `state.alive` here, and here alone: a broken spring does nothing, whatever its constants are.

Before a law sees them, the inputs of a broken spring give way to those of a spring of length 1 whose constants are 1; what the law makes
of these gives way to zero. The inputs, since a NaN or an infinity left in them would reach derivatives (zero times infinity is NaN), and
the results, since a law of one's own may pull whatever its constants are. A scene in which nothing breaks pays nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, ZeroOutside, field_of
from ..vector import Vector

OfSprings = Callable[..., Any]


def living(net: Topology, state: State) -> EdgeField | None:
    """Which springs of this net hold; None where none breaks, or where those of another net do."""
    return field_of(net, state.alive)


def heeding(net: Topology, state: State, function: OfSprings, *fields: Any) -> tuple[OfSprings, tuple[Any, ...]]:
    """`function` of the fields of one family, and the fields, such that broken springs give zero. For `net_pull` and `map_springs`."""
    alive = living(net, state)
    return (function, fields) if alive is None else (_OfLiving(function), (*fields, alive))


def existing(net: Topology, function: OfSprings, *fields: Any) -> tuple[OfSprings, tuple[Any, ...]]:
    """The same for a function that does not vanish of itself where there is no spring: for `net_pull` of a net without margins."""
    return _OfLiving(function), (*fields, net.exists)


def vanishing(net: Topology, constant: Array | EdgeField) -> Array | EdgeField:
    """A constant as `net_pull` reads it, zero where there is no spring, so that pulls vanish there of themselves and need no mask.

    One number for a whole lattice stays, and needs one.
    """
    if isinstance(constant, ZeroOutside):
        return constant
    if not isinstance(constant, EdgeField):
        return constant if net.has_margins else net.vanishing(net.everywhere(constant))
    return net.vanishing(constant)


def map_living(net: Topology, state: State, function: OfSprings, *fields: Any) -> EdgeField:
    """As `net.map_springs`, with zero for broken springs, of whose values nothing is read."""
    function, fields = heeding(net, state, function, *fields)
    return net.map_springs(function, *fields)


class _OfLiving(eqx.Module):
    """The function of the springs that hold."""

    function: OfSprings

    def __call__(self, *inputs: Any) -> Any:
        *given, alive = inputs
        found = self.function(*(_sound(a, alive) for a in given))
        return jax.tree.map(lambda a: jnp.where(alive, a, jnp.zeros((), a.dtype)), found)


def _sound(a: Array | Vector, alive: Array) -> Array | Vector:
    """The input of a spring that holds; 1, or the unit vector along x, of one that does not."""
    if not isinstance(a, Vector):
        return jnp.where(alive, a, jnp.ones((), a.dtype))
    return Vector(tuple(jnp.where(alive, v, jnp.full((), float(i == 0), v.dtype)) for i, v in enumerate(a)))


def counted(value: Array, constant: Array, alive: Array) -> Array:
    """`value` of a spring that holds, and `constant` (zero where that is not finite) of one that is broken but may come back."""
    finite = jnp.where(jnp.isfinite(constant), constant, jnp.zeros((), constant.dtype))
    return jnp.where(alive, value, finite)


__all__ = ["counted", "existing", "heeding", "living", "map_living", "vanishing"]
