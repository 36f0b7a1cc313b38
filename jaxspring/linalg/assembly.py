"""The entries of a `SpringMatrix`, read into a flat array, and where they go in the storage of a factor.

Coordinates that no block couples are read, and factored, apart. Those that are alike by construction (the same masks, the same diagonals,
the same springs) share one factor.
"""

from __future__ import annotations

import dataclasses
import hashlib

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..topology.base import NodeLayout, Topology
from ..topology.identity import NetIdentity
from ..topology.permutation import Permutation
from .envelope import Panels
from .operators import CellDyads, SpringBlocks, SpringMatrix

Group = tuple[int, ...]
Alike = tuple[Group, ...]


class SpringPlaces:
    """Which end of each spring of a net comes later in the order of elimination, and which earlier.

    Compared and hashed by content, so that it can be static under `jit`.

    Attributes:
        net: what tells the net from others: its springs, and how its nodes are numbered inside.
        later: (E,) place of the later end, springs in the user's order.
        earlier: (E,) place of the earlier end.
        is_tail_later: (E,) whether the later end is the tail.
    """

    def __init__(self, net: Topology, places: np.ndarray):
        place = np.argsort(places)
        ends = place[net.edges]
        self.net = _key(net)
        self.later, self.earlier, self.is_tail_later = ends.max(axis=1), ends.min(axis=1), ends[:, 0] > ends[:, 1]
        self._digest = hashlib.sha256(ends.tobytes()).hexdigest()

    def __hash__(self) -> int:
        return hash((self.net, self._digest))

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, SpringPlaces) and self._digest == other._digest and self.net == other.net)


def _key(net: Topology) -> tuple[NetIdentity, NodeLayout]:
    """Compared by content, also after pickling; the same whether the net's arrays are traced or not."""
    return dataclasses.replace(net.identity, name=None), net.layout


def alike_coordinates(matrix: SpringMatrix) -> tuple[Alike, ...]:
    """The coordinates in groups that are coupled, and the groups in classes that one factor serves.

    Only what is known before any number is: two coordinates are alike where they hold the same arrays, not equal ones.

    >>> import jaxspring as js
    >>> from jaxspring.linalg.operators import Blocks
    >>> mass = jnp.ones(2)
    >>> diagonal = js.Vector((mass, mass, 2 * mass))
    >>> alike_coordinates(SpringMatrix(Blocks((diagonal,)), (None, None, None), diagonal, js.lattice(2).layout))
    (((0,), (1,)), ((2,),))
    """
    group_of = list(range(matrix.dim))
    for axes in _couplings(matrix):
        joined = {group_of[i] for i in axes}
        group_of = [min(joined) if g in joined else g for g in group_of]
    classes: dict[tuple, list[Group]] = {}
    for first in sorted(set(group_of)):
        group = tuple(i for i, g in enumerate(group_of) if g == first)
        key = _signature(matrix, first) if len(group) == 1 else ("coupled", first)
        classes.setdefault(key, []).append(group)
    return tuple(tuple(groups) for groups in classes.values())


def _couplings(matrix: SpringMatrix) -> list[Group]:
    everything = tuple(range(matrix.dim))
    springs = [term.axes or everything for term in matrix.blocks.springs if term.slope is not None]
    return springs + [everything for _ in (*matrix.blocks.dyads, *matrix.blocks.cells, *matrix.taken)]


def _signature(matrix: SpringMatrix, i: int) -> tuple:
    diagonals = tuple(id(d[i]) for d in matrix.blocks.diagonal)
    springs = tuple(term.axes is None or i in term.axes for term in matrix.blocks.springs)
    return (id(matrix.free[i]), diagonals, springs)


def read_entries(matrix: SpringMatrix, group: Group, nodes: Permutation, springs: tuple[SpringPlaces, ...]) -> Array:
    """Flat entries of the lower triangle for the coordinates of a group: node blocks, then each spring's, held ones zero off the diagonal.

    `entry_addresses` tells where they go, in the same order.
    """

    def eliminated(a: Array) -> Array:
        return nodes.inward(jnp.broadcast_to(a, matrix.like.shape).ravel())

    parts = [eliminated(matrix.entry(group[a], group[b])) for a in range(len(group)) for b in range(a + 1)]
    masks = [matrix.free[i] for i in group]
    free = [None if mask is None else eliminated(mask) for mask in masks]
    for term, spring in zip(matrix.blocks.pairs, springs, strict=True):
        for a, i in enumerate(group):
            for b, j in enumerate(group):
                value = _later_earlier(term, spring, i, j)
                value = jnp.zeros(term.net.n_springs, matrix.like.dtype) if value is None else value
                for mask, ends in ((free[a], spring.later), (free[b], spring.earlier)):
                    value = value if mask is None else jnp.where(mask[ends], value, jnp.zeros((), value.dtype))
                parts.append(value)
    return jnp.concatenate(parts)


def _later_earlier(term: SpringBlocks | CellDyads, spring: SpringPlaces, i: int, j: int) -> Array | None:
    """(E,) entries in row i of the later end and column j of the earlier one; None where all are zero."""
    found = term.across(i, j)
    if i == j or isinstance(term, SpringBlocks) or found is None:
        return found
    return jnp.where(spring.is_tail_later, found, term.across(j, i))


def entry_addresses(panels: Panels, springs: tuple[SpringPlaces, ...]) -> Array:
    """Flat places in storage of what `read_entries` reads."""
    d = panels.coupled
    nodes = np.arange(panels.n // d)
    # A node's unknowns never straddle two panels, so that a d x d block is a piece of the (B, total) array.
    corners = [
        jnp.asarray(panels.address(later * d, earlier * d)) for later, earlier in ((nodes, nodes), *((s.later, s.earlier) for s in springs))
    ]
    parts = [corners[0] + np.int32(a * panels.total + b) for a in range(d) for b in range(a + 1)]
    parts += [corner + np.int32(a * panels.total + b) for corner in corners[1:] for a in range(d) for b in range(d)]
    return jnp.concatenate(parts)


def store_entries(entries: Array, addresses: Array, panels: Panels) -> Array:
    """(B, total) storage of the matrix; unknowns that only fill the last panel have the entry 1 on the diagonal."""
    filling = np.arange(panels.n, panels.padded)
    stored = jnp.zeros(panels.size * panels.total, entries.dtype).at[addresses].add(entries, mode="promise_in_bounds")
    if len(filling):
        stored = stored.at[panels.address(filling, filling)].set(1, mode="promise_in_bounds", unique_indices=True)
    return stored.reshape(panels.size, panels.total)


def find_places(places: tuple[SpringPlaces, ...], term: SpringBlocks | CellDyads) -> SpringPlaces:
    """The ends of a term's springs. Raises ValueError where the analysis did not see their net."""
    wanted = _key(term.net)
    for spring in places:
        if spring.net == wanted:
            return spring
    raise ValueError(
        f"The matrix holds {term.net.n_springs} springs of a net that this Skyline was not made for, so its envelope may have no room for "
        f"them. Make it for every net that the forces use: Skyline(net, other_net); of hinges and joints that is their `pairs`."
    )


__all__ = [
    "Alike",
    "Group",
    "SpringPlaces",
    "alike_coordinates",
    "entry_addresses",
    "find_places",
    "read_entries",
    "store_entries",
]
