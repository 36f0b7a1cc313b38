"""What springs and dampers have to say about the periods of their net: see `topology.periods`."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._checks import is_concrete
from ..status import Flag
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from ..topology.periods import box_of, half_period, longest, turned
from ..vector import Vector
from .base import Finding


def long_springs(net: Topology, position: Vector, alive: EdgeField | None) -> tuple[Finding, ...]:
    """BOX: springs of half a period. Nothing where the net has none."""
    if box_of(net) is None:
        return ()
    return (Finding(Flag.BOX, half_period(net, net.difference(position), alive), jnp.asarray(-1, jnp.int32)),)


def turned_springs(net: Topology, start: Vector, now: Vector, alive: EdgeField | None) -> tuple[Finding, ...]:
    """BOX: springs that pull to another image than at the start. Nothing where the net has none."""
    if box_of(net) is None:
        return ()
    return (Finding(Flag.BOX, turned(net, start, now, alive), jnp.asarray(-1, jnp.int32)),)


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


__all__ = ["check_rest_length", "long_springs", "turned_springs"]
