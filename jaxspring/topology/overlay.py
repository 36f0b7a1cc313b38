"""A further net over the nodes of another: bending springs, a seam, another graph. It reads only the nodes that it touches.

    x_t = x[touched]        d = D x_t        f[touched] = -D' p, zero elsewhere

The node set owns the order of nodes, chosen by its first net. Each net over it has springs, damping and breaking of its own.
"""

from __future__ import annotations

import hashlib
import math
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._checks import node_indices
from ..numerics import linear_call
from ..vector import Vector
from .base import NodeLayout, Topology
from .edge_field import EdgeField
from .graph import Graph
from .identity import NetIdentity
from .permutation import Permutation

# Nodes per touched node from which on writing to the touched ones is faster than having every node read.
SPARSE = 8
# Every place is in range by construction.
_SURE: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False}


class Overlay(Topology):
    """Springs over the nodes of another net. Build it with `net.with_edges`.

    Attributes:
        inner: the springs as a graph of the touched nodes alone.
        where: (T,) places in a flat node array of the nodes of `inner`, in its order.
        back: (N,) for each node its place in `inner`, or T; None where few nodes are touched.
        nodes: how fields of all nodes are stored (static).
        touched: user's numbers of the touched nodes (static, as bytes).
        digest: of the springs in the user's numbering and order (static).
        name: tells it from other nets of the same springs, or None (static).
    """

    inner: Graph
    where: Int[Array, " T"]
    back: Int[Array, " N"] | None
    nodes: NodeLayout = eqx.field(static=True)
    touched: bytes = eqx.field(static=True)
    digest: str = eqx.field(static=True)
    name: str | None = eqx.field(static=True, default=None)

    @staticmethod
    def on(net: Topology, edges: Any, name: str | None = None) -> Overlay:
        """A net of these springs over the nodes of `net`; see `Topology.with_edges`."""
        count = net.n_nodes
        pairs = node_indices("edges", edges, count)
        touched, local = np.unique(pairs, return_inverse=True)
        if not len(touched):
            touched, local = np.zeros(1, np.int64), np.zeros((0, 2), np.int64)
        inner = Graph.from_edges(local.reshape(-1, 2), len(touched), box=getattr(net, "box", None))
        places = np.arange(count) if net.node_permutation is None else net.node_permutation.inverse
        where = places[touched[inner.nodes.order]].astype(np.int32)
        back = np.full(count, len(touched), np.int32)
        back[where] = np.arange(len(touched), dtype=np.int32)
        digest = hashlib.sha256(np.ascontiguousarray(pairs, "<i4").data).hexdigest()[:16] if len(pairs) else ""
        reads = len(touched) * SPARSE >= count
        stored = np.ascontiguousarray(touched, "<i4").tobytes()
        return Overlay(inner, jnp.asarray(where), jnp.asarray(back) if reads else None, net.layout, stored, digest, name)

    @property
    def box(self) -> Array | None:
        """(D,) period of each coordinate [m], or None."""
        return self.inner.box

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field of the net below."""
        return self.nodes.shape

    @property
    def node_permutation(self) -> Permutation | None:
        """That of the net below."""
        return self.nodes.permutation

    @property
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """((E,),)"""
        return self.inner.family_shapes

    @property
    def family_sizes(self) -> tuple[int, ...]:
        """(E,)"""
        return self.inner.family_sizes

    @property
    def identity(self) -> NetIdentity:
        """The springs' digest, and the name."""
        sizes = (f"{math.prod(self.node_shape)} nodes", f"{self.inner.n_springs} springs", f"digest {self.digest}")
        return NetIdentity("Overlay", sizes, self.name, self.inner.springs)

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) tail and head of each spring, in the user's order and numbering."""
        return np.frombuffer(self.touched, "<i4")[self.inner.edges]

    def unboxed(self) -> Overlay:
        """The same springs without periods."""
        return eqx.tree_at(lambda net: net.inner, self, self.inner.unboxed())

    def inside(self, field: EdgeField, fill: float) -> EdgeField:
        """The field itself: no margins are kept."""
        return field

    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail along each spring."""
        return self.own(self.inner.difference(x.map(self._taken)).families)

    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node: each pull on its tail, the opposite on its head; zero on nodes that no spring touches."""
        return self.inner.accumulate(pulls).map(self._spread_out)

    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node."""
        return self._spread_out(self.inner.incident_sum(values))

    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""
        return self.own(self.inner.average(self._taken(a)).families)

    def split(self, flat: Array) -> EdgeField:
        """(E,) array in the user's order -> edge field."""
        return self.own(self.inner.split(flat).families)

    def _flatten(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array in the user's order."""
        return self.inner._flatten(field)

    def _taken(self, a: Array) -> Array:
        """Node array -> (T,)."""
        return linear_call(partial(_take, self.node_shape), partial(_put, self.node_shape), (self.where, self.back), a)

    def _spread_out(self, v: Array) -> Array:
        """(T,) -> node array, zero elsewhere."""
        return linear_call(partial(_put, self.node_shape), partial(_take, self.node_shape), (self.where, self.back), v)


def _take(shape: tuple[int, ...], tables: Any, a: Array) -> Array:
    return jnp.ravel(a).at[tables[0]].get(**_SURE)


def _put(shape: tuple[int, ...], tables: Any, v: Array) -> Array:
    where, back = tables
    if back is None:
        return jnp.zeros(math.prod(shape), v.dtype).at[where].set(v, unique_indices=True, **_SURE).reshape(shape)
    return jnp.concatenate([v, jnp.zeros(1, v.dtype)]).at[back].get(**_SURE).reshape(shape)


__all__ = ["Overlay"]
