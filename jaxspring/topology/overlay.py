"""A further net over the nodes of another: bending springs, a seam, another graph. It reads only the nodes that it touches.

    x_t = x[touched]        d = D x_t        f[touched] = -D' p, zero elsewhere

The node set owns the order of nodes, chosen by its first net. Each net over it has springs, damping and breaking of its own.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._arrays import Edges
from .._checks import node_indices
from ..numerics import linear_call
from .base import NodeLayout
from .ends import Ends
from .listed import ListedSprings, arranged, digest_of, of_one
from .permutation import Permutation

# Nodes per touched node from which on writing to the touched ones is faster than having every node read.
SPARSE = 8
# Every place is in range by construction.
_SURE: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False}


class Overlay(ListedSprings):
    """Springs over the nodes of another net. Build it with `net.with_edges`.

    Attributes:
        ends: the springs as each of the touched nodes reads them.
        where: (T,) places of the touched nodes in a flat node array.
        back: (N,) for each node its place among the touched ones, or T; None where few nodes are touched.
        box: (D,) period of each coordinate [m], or None.
        nodes: how fields of all nodes are stored (static).
        springs: from the user's order of the springs to the one in which they are kept (static).
        digest: of the springs in the user's numbering and order (static).
        name: tells it from other nets of the same springs, or None (static).
    """

    ends: Ends
    where: Int[Array, " T"]
    back: Int[Array, " N"] | None
    box: Array | None
    nodes: NodeLayout = eqx.field(static=True)
    springs: Permutation = eqx.field(static=True)
    digest: str = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    @staticmethod
    def on(nodes: NodeLayout, box: Array | None, edges: Edges, name: str | None = None) -> Overlay:
        """A net of these springs over nodes that are stored like this; see `Topology.with_edges`."""
        count = math.prod(nodes.shape)
        pairs = node_indices("edges", edges, count)
        places = np.arange(count) if nodes.permutation is None else nodes.permutation.inverse
        touched, local = np.unique(places[pairs] if len(pairs) else np.zeros((0, 2), int), return_inverse=True)
        if not len(touched):
            touched = np.zeros(1, int)  # arrays of no length compile nowhere
        local = local.reshape(-1, 2)
        ends, order, springs = arranged(local, len(touched))
        where = touched[order].astype(np.int32)
        back = np.full(count, len(touched), np.int32)
        back[where] = np.arange(len(touched), dtype=np.int32)
        reads = len(touched) * SPARSE >= count
        return Overlay(
            ends=ends,
            where=jnp.asarray(where),
            back=jnp.asarray(back) if reads else None,
            box=box,
            nodes=nodes,
            springs=springs,
            digest=digest_of(pairs),
            name=name,
        )

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field of the net below."""
        return self.nodes.shape

    @property
    def node_permutation(self) -> Permutation | None:
        """That of the net below."""
        return self.nodes.permutation

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) tail and head of each spring, in the user's order and numbering."""
        places = of_one(self.where)[self._ends()]
        users = places if self.node_permutation is None else self.node_permutation.order[places]
        return users[self.springs.inverse]

    def with_edges(self, edges: Edges, name: str | None = None) -> Overlay:
        """A further net over the same nodes: see `Topology.with_edges`."""
        return Overlay.on(self.layout, self.box, edges, name)

    def _taken(self, a: Array) -> Array:
        """Node array -> (T,)."""
        return linear_call(partial(_take, self.node_shape), partial(_put, self.node_shape), (self.where, self.back), a)

    def _put(self, a: Array) -> Array:
        """(T,) -> node array, zero elsewhere."""
        return linear_call(partial(_put, self.node_shape), partial(_take, self.node_shape), (self.where, self.back), a)


def _take(shape: tuple[int, ...], tables: Any, a: Array) -> Array:
    return jnp.ravel(a).at[tables[0]].get(**_SURE)


def _put(shape: tuple[int, ...], tables: Any, v: Array) -> Array:
    where, back = tables
    if back is None:
        return jnp.zeros(math.prod(shape), v.dtype).at[where].set(v, unique_indices=True, **_SURE).reshape(shape)
    return jnp.concatenate([v, jnp.zeros(1, v.dtype)]).at[back].get(**_SURE).reshape(shape)


__all__ = ["Overlay"]
