"""Which nodes are joined by a spring: asked of many pairs at once.

Neighbours of each node in rising order, one row after the other; whether j is among those of i is found by halving the row. The rows are
made once, on the host.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import BUILD_OUTSIDE
from .._checks import kind
from ..forces.cells import Neighbourhood
from ..forces.neighbour_list import NeighbourList, NeighbourMemory
from ..forces.pair_sums import Fields
from ..forces.pairs import AllPairs, PairFunction
from ..numerics import is_traced
from ..topology.base import NodeLayout, Topology


class Joined(eqx.Module):
    """Neighbours by springs, in the order in which node fields are stored.

    Attributes:
        start: (N + 2,) where the row of each node begins; that of node N, which stands for none, is empty.
        other: (2 E + 1,) the neighbours, row after row.
        n_halvings: how often the longest row must be halved (static).
        layout: how node fields are stored (static).
    """

    start: Array
    other: Array
    n_halvings: int = eqx.field(static=True)
    layout: NodeLayout = eqx.field(static=True)

    @staticmethod
    def of(nets: Any) -> Joined:
        """The springs of a net, or of several over the same nodes. On the host.

        Raises:
            TypeError: what is no net; nets that are traced.
            ValueError: nets over different nodes.
        """
        if isinstance(nets, Joined):
            return nets
        nets = tuple(nets) if isinstance(nets, list | tuple) else (nets,)
        for net in nets:
            kind("net", net, Topology, "lattice((4, 4))")
        if not nets or any(net.layout != nets[0].layout for net in nets):
            raise ValueError("expected one net, or several over the same nodes: make the others by net.with_edges(edges).")
        if is_traced(nets):
            raise TypeError(f"the net is traced, but the pairs that it joins are listed on the host. {BUILD_OUTSIDE}")
        n = nets[0].n_nodes
        edges = np.concatenate([np.asarray(net.edges, np.int64).reshape(-1, 2) for net in nets])
        if nets[0].node_permutation is not None:
            edges = nets[0].node_permutation.inverse[edges]
        both = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
        start = np.searchsorted(both[:, 0], np.arange(n + 2))
        longest = int(np.max(np.diff(start), initial=0))
        other = np.append(both[:, 1], n).astype(np.int32)
        return Joined(jnp.asarray(start.astype(np.int32)), jnp.asarray(other), longest.bit_length(), nets[0].layout)

    def holds(self, i: Array, j: Array) -> Array:
        """Whether nodes i and j are joined, for arrays of places in stored fields that broadcast."""
        shape = jnp.broadcast_shapes(i.shape, j.shape)
        i, j = jnp.broadcast_to(i, shape), jnp.broadcast_to(j, shape)
        low, end = _read(self.start, i), _read(self.start, i + 1)
        high = end
        # The first neighbour that is not below j.
        for _ in range(self.n_halvings):
            middle = (low + high) // 2
            is_below = (low < high) & (_read(self.other, middle) < j)
            low, high = jnp.where(is_below, middle + 1, low), jnp.where(is_below, high, middle)
        return (low < end) & (_read(self.other, low) == j)


class UnjoinedPairs(AllPairs):
    """Every pair that no spring joins: N**2 evaluations.

    Attributes:
        joined: which are.
    """

    joined: Joined

    def __init__(self, pairs: AllPairs, joined: Joined):
        super().__init__(pairs.tile)
        self.joined = joined

    def visit(self, function: PairFunction, fields: Fields, memory: None = None) -> Fields:
        """Sum over all others but those that are joined."""

        def unjoined(own: Fields, other: Fields, distinct: Array | None) -> Fields:
            are_two = ~self.joined.holds(own[-1], other[-1])
            return function(own[:-1], other[:-1], are_two if distinct is None else distinct & are_two)

        numbers = jnp.arange(fields[0].shape[0], dtype=jnp.int32)
        return super().visit(unjoined, (*fields, numbers), memory)


class UnjoinedList(NeighbourList):
    """A neighbour list without the pairs that a spring joins: they are left out when it is made.

    Attributes:
        joined: which are.
    """

    joined: Joined

    def __init__(self, pairs: NeighbourList, joined: Joined):
        super().__init__(pairs.capacity, pairs.skin)
        self.joined = joined

    def _made(self, position: Fields, reach: Array | None, rebuilds: Array, box: Array | None) -> NeighbourMemory:
        memory = super()._made(position, reach, rebuilds, box)
        return eqx.tree_at(lambda m: m.near.table, memory, self._without(memory.near))

    def _without(self, near: Neighbourhood) -> Array:
        """The table, with no entry where a spring joins the two."""
        n = near.order.shape[0]
        order = jnp.append(near.order.astype(jnp.int32), jnp.asarray(n, jnp.int32))
        are_joined = self.joined.holds(order[None, :n], _read(order, near.table))
        return jnp.where(are_joined, jnp.asarray(n, near.table.dtype), near.table)

    def everyone(self) -> AllPairs:
        """All pairs that no spring joins, which are summed where the list cannot be trusted."""
        return UnjoinedPairs(AllPairs(), self.joined)


def _read(array: Array, index: Array) -> Array:
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
