"""What springs and dampers have to say about the periods of their net: see `topology.periods`."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import is_concrete
from ..status import Flag
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from ..topology.periods import box_of, longest, turns_of
from ..vector import Vector
from .base import Finding

# A spring of this share of a period or more may have either image after the slightest motion.
NEARLY_HALF = 0.499


def long_springs(net: Topology, position: Vector, alive: EdgeField | None) -> tuple[Finding, ...]:
    """BOX: springs of half a period. Nothing where the net has none."""
    if box_of(net) is None:
        return ()
    return (Finding(Flag.BOX, _half_period(net, net.difference(position), alive), jnp.asarray(-1, jnp.int32)),)


def turned_springs(net: Topology, start: Vector, now: Vector, alive: EdgeField | None) -> tuple[Finding, ...]:
    """BOX: springs that pull to another image than at the start. Nothing where the net has none."""
    if box_of(net) is None:
        return ()
    return (Finding(Flag.BOX, _turned(net, start, now, alive), jnp.asarray(-1, jnp.int32)),)


def check_rest_length(net: Topology, rest_length: Any) -> None:
    """Raise ValueError for a rest length that no nearest image of the net's box has."""
    most = longest(box_of(net))
    if most == np.inf or not all(is_concrete(leaf) for leaf in jax.tree.leaves(rest_length)):
        return
    lengths = np.asarray(net.flatten(rest_length) if isinstance(rest_length, EdgeField) else rest_length)
    bad = lengths > most
    if bad.any():
        spring = int(np.argmax(bad))
        where = f"[{spring}]" if lengths.ndim else ""
        raise ValueError(
            f"rest_length{where} = {np.ravel(lengths)[spring]} m, but in a box of {np.asarray(box_of(net))} m no two nodes are more than "
            f"{most:.9g} m apart: a spring takes the nearest image, and its pull would turn. Use a larger box, or shorter springs."
        )


def along_axes(net: Topology, axes: tuple[int, ...] | None) -> Topology:
    """The net as differences of these coordinates alone see it: with their periods."""
    if axes is None or box_of(net) is None:
        return net
    return eqx.tree_at(box_of, net, box_of(net)[np.asarray(axes)])


def _half_period(net: Topology, d: EdgeField, alive: EdgeField | None) -> Array:
    """How many springs are half a period long along a coordinate, or nearly so."""
    box = box_of(net)

    def of_family(d: Vector, counts: Any) -> Array:
        long = jnp.zeros(d.shape, bool)
        for along, period in zip(d, box, strict=True):
            period = period.astype(along.dtype)
            long = long | ((period > 0) & (jnp.abs(along) >= NEARLY_HALF * period))
        return (long & counts).astype(jnp.int32)

    return net.sum(net.map_springs(of_family, d, jnp.ones((), bool) if alive is None else alive))


def _turned(net: Topology, start: Vector, now: Vector, alive: EdgeField | None) -> Array:
    """How many springs have another image than at the start: between the two they have been longer than half a period."""
    box, plain = box_of(net), net.unboxed()

    def of_family(before: Vector, after: Vector, counts: Any) -> Array:
        is_other = jnp.zeros(after.shape, bool)
        for a, b, period in zip(before, after, box, strict=True):
            is_other = is_other | (turns_of(a, period) != turns_of(b, period))
        return (is_other & counts).astype(jnp.int32)

    fields = plain.difference(start), plain.difference(now), jnp.ones((), bool) if alive is None else alive
    return net.sum(net.map_springs(of_family, *fields))


__all__ = ["along_axes", "check_rest_length", "long_springs", "turned_springs"]
