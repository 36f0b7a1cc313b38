"""What has become of springs for good, as rules remember it, and as the springs read it.

    rest length    l + e_p       e_p plastic stretch [m]                  left by `Yielding`
    stiffness      s k           s share of the stiffness that is left    left by `Tearing` with a band
    rest angle     theta_0 + q   q plastic angle of a hinge [rad]         left by `PlasticHinges`

Several rules on one net act in a row: their stretches add up, and their shares multiply. A state in which nothing of the kind is
remembered adds no operation.
"""

from __future__ import annotations

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from .living import map_living

Kind = TypeVar("Kind")


class Yielded(eqx.Module):
    """What `Yielding` remembers of each spring.

    Attributes:
        stretch: e_p, by how much its rest length has grown [m], negative where it was squeezed.
        slip: a, the sum of all plastic stretch, forth and back [m].
        since: time of the step in which it first yielded [s], infinite where it never has.
    """

    stretch: EdgeField
    slip: EdgeField
    since: EdgeField


class Torn(eqx.Module):
    """What `Tearing` remembers of each spring.

    Attributes:
        since: time of the step in which it tore [s], infinite where it never has.
        worst: the largest strain, or pull [N], so far; None without a band.
        share: s, what is left of its stiffness, from 1 to 0; None without a band.
    """

    since: EdgeField
    worst: EdgeField | None
    share: EdgeField | None


class Creased(eqx.Module):
    """What `PlasticHinges` remembers of each hinge, in the order of `Hinges.nodes`.

    Attributes:
        angle: by how much its rest angle has changed [rad].
        slip: a, the sum of all that it has changed by, forth and back [rad].
        since: time of the step in which it first yielded [s], infinite where it never has.
    """

    angle: Array
    slip: Array
    since: Array


class Onset(eqx.Module):
    """How many springs (or hinges) have yielded or torn, and where it began.

    Attributes:
        count: how many have, ever (0-d integer).
        spring: number of the first in the user's order, the lowest where several began in one step; -1 where none has.
        time: at the end of the step in which it did [s]; infinite where none has.
    """

    count: Array
    spring: Array
    time: Array

    @staticmethod
    def of(net: Topology, since: EdgeField) -> Onset:
        """From the time of each spring."""
        return Onset.first(net.flatten(since) if net.n_springs else jnp.full(1, jnp.inf))

    @staticmethod
    def first(flat: Array) -> Onset:
        """From an array of times."""
        first = jnp.argmin(flat).astype(jnp.int32)
        has_begun = jnp.isfinite(flat)
        count = jnp.sum(has_begun, dtype=jnp.int32)
        return Onset(count, jnp.where(count > 0, first, jnp.asarray(-1, jnp.int32)), jnp.min(flat))


def lengthened(net: Topology, state: State, rest_length: Any) -> Any:
    """Rest lengths with what each spring has yielded by [m]."""
    for yielded in remembered(net, state, Yielded):
        rest_length = map_living(net, state, lambda l, q: l + q, rest_length, yielded.stretch)
    return rest_length


def weakened(net: Topology, state: State, stiffness: Any) -> Any:
    """Stiffnesses less what each spring has lost [N/m]."""
    for torn in remembered(net, state, Torn):
        if torn.share is not None:
            stiffness = map_living(net, state, lambda k, s: k * s, stiffness, torn.share)
    return stiffness


def has_yielded(net: Topology, state: State) -> bool:
    """Whether a rule remembers plastic stretch of these springs; known from what is static."""
    return bool(remembered(net, state, Yielded))


def remembered(net: Topology, state: State, kind: type[Kind]) -> list[Kind]:
    """What rules of a kind remember of the springs of this net, in the order of the rules."""
    entries = [entry for entry in state.memory or () if entry is not None and isinstance(entry.value, kind)]
    return [entry.value for entry in entries if entry.owner.net == net.identity]


def of_springs(state: State) -> list[Array]:
    """Whatever of a state rules change for good and forces read: which springs hold, rest lengths, plastic stretch, shares of the
    stiffness, rest angles.
    """
    values = [entry.value for entry in state.memory or () if entry is not None]
    read = [v.stretch if isinstance(v, Yielded) else v.share for v in values if isinstance(v, Yielded | Torn)]
    read += [v.angle for v in values if isinstance(v, Creased)]
    return jax.tree.leaves((state.alive, state.rest_length, read))


def never(net: Topology, state: State) -> EdgeField:
    """The time of what has not begun, for each spring [s]."""
    return net.everywhere(jnp.full((), jnp.inf, state.dtype))


def begun(net: Topology, since: EdgeField, now: EdgeField, time: Array) -> EdgeField:
    """Times at which it began, with those where it begins now [s]."""

    def moment(then: Array, starts: Array) -> Array:
        return jnp.where(starts & jnp.isinf(then), time.astype(then.dtype), then)

    return net.map_springs(moment, since, now)


__all__ = ["Creased", "Onset", "Torn", "Yielded", "begun", "has_yielded", "lengthened", "never", "of_springs", "remembered", "weakened"]
