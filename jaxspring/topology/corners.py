"""Cells seen from their corners: what nodes have is read at the corners of triangles, hinges or joints, and sums are brought back.

    at     y_k = x[c_k]                                  c_k the node at corner k of each cell, k = 0 ... m - 1
    sum    f_i = sum of y_k over all cells and corners k with c_k = i

Each is the other's transpose, under every transformation. Every node reads the corners that lie at it, so that no program holds a
scatter: nodes are in classes by their number of corners, those of very many are summed in rounds (see `end_tables.py`).

Source: the layout is that of `ends.py`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._arrays import as_indices
from ..numerics import linear_call
from ..vector import Vector
from .base import Topology
from .end_tables import WIDEST, counted, rounds_of, widths
from .periods import box_of, minimum_image

# Every index is in range by construction.
_SURE: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False}


class Corners(eqx.Module):
    """The corners of C cells of m nodes each.

    Attributes:
        cells: (m, C) place of each corner's node in a flat node array.
        tables: for each class of nodes (width, count) the corners that a node sums, counted cell by cell and corner after corner; m C
            where it has fewer.
        rounds: for nodes of very many corners, the tables of further sums: see `end_tables.py`.
        back: (N,) for each node the place of its sum; the last one, of a zero, for nodes at no corner.
        box: (D,) periods of the net [m], or None.
        pairs: a net with a spring for every pair of each cell's corners, the first of `pairs_of` for all cells, then the second, ...: for
            matrices whose cells couple their corners. None where nobody asked for it.
        node_shape: of a node array (static).

    >>> import jaxspring as js
    >>> corners = Corners([(0, 1, 2), (1, 3, 2)], js.lattice((2, 2)))
    >>> a, b, c = corners.at(jnp.array([[1.0, 2.0], [3.0, 4.0]]))
    >>> print(a, b, c)
    [1. 2.] [2. 4.] [3. 3.]
    >>> print(corners.sum((a, b, c)))
    [[1. 4.]
     [6. 4.]]
    """

    cells: Int[Array, "m C"]
    tables: tuple[Int[Array, "width count"], ...]
    rounds: tuple[Int[Array, "W rows"], ...]
    back: Int[Array, " N"]
    box: Array | None
    pairs: Topology | None
    node_shape: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, cells: Any, net: Topology, with_pairs: bool = False):
        """Make the tables, on the host.

        Args:
            cells: (C, m) node numbers in the user's order.
            net: over whose nodes they are.
            with_pairs: make the net of `pairs`; a node is then at one corner of a cell only.

        Raises:
            ValueError: no cell, a node that does not exist.
            TypeError: node numbers that are not integers, or are traced.
        """
        given = as_indices("cells", cells)
        if given.ndim != 2 or not given.size:
            raise ValueError(f"cells has shape {given.shape}; expected (C, m): m node numbers for each of C >= 1 cells.")
        bad = (given < 0) | (given >= net.n_nodes)
        if bad.any():
            cell, corner = (int(i) for i in np.argwhere(bad)[0])
            raise ValueError(
                f"cells[{cell}] = {tuple(given[cell].tolist())} names node {given[cell, corner]}, but there are n_nodes = {net.n_nodes} "
                f"(nodes are 0 to {net.n_nodes - 1}). Unchecked, JAX would read another node instead. Fix cells[{cell}]."
            )
        order = net.node_permutation
        places = np.asarray(given if order is None else order.inverse[given], np.int32).T
        self.cells = jnp.asarray(places)
        tables, rounds, back = _tables(places.ravel(), net.n_nodes)
        self.tables = tuple(jnp.asarray(table, jnp.int32) for table in tables)
        self.rounds = tuple(jnp.asarray(table, jnp.int32) for table in rounds)
        self.back = jnp.asarray(back, jnp.int32)
        self.box = box_of(net)
        couples = [given[:, [k, l]] for k, l in pairs_of(given.shape[1])] if with_pairs else []
        self.pairs = net.with_edges(np.concatenate(couples)) if couples else None
        self.node_shape = net.node_shape

    def at(self, field: Any) -> tuple[Any, ...]:
        """A node array or a `Vector` in node shape -> its values at each corner, (C,)."""
        if isinstance(field, Vector):
            return tuple(Vector(parts) for parts in zip(*(self.at(a) for a in field), strict=True))
        if not jnp.issubdtype(field.dtype, jnp.inexact):
            return _at(self, field)
        return linear_call(_at, _sum, self, field)

    def sum(self, values: tuple[Any, ...]) -> Any:
        """For each corner (C,) values, arrays or `Vector`s -> their sum at each node, in node shape."""
        if isinstance(values[0], Vector):
            return Vector(tuple(self.sum(parts) for parts in zip(*(v.components for v in values), strict=True)))
        return linear_call(_sum, _at, self, tuple(values))

    def apart(self, x: Vector) -> tuple[Vector, ...]:
        """Positions [m] -> the other corners less the first, nearest images where the net is periodic."""
        first, *others = self.at(x)
        apart = tuple(other - first for other in others)
        return apart if self.box is None else tuple(minimum_image(d, self.box) for d in apart)

    def coupled(self) -> Topology:
        """The net of `pairs`.

        Raises:
            ValueError: the corners were made without.
        """
        if self.pairs is None:
            raise ValueError("these cells couple their corners, which a matrix must know: Corners(cells, net, with_pairs=True).")
        return self.pairs

    def nodes(self, net: Topology) -> np.ndarray:
        """(C, m) node numbers in the user's order, for the host; `net` is the one that they were made for."""
        places = np.asarray(self.cells).T
        return places if net.node_permutation is None else net.node_permutation.order[places]


def pairs_of(m: int) -> list[tuple[int, int]]:
    """The pairs of m corners: (0, 1), (0, 2), ... (m - 2, m - 1)."""
    return [(k, l) for k in range(m) for l in range(k + 1, m)]


def _read(a: Array, index: Array) -> Array:
    return a.at[index].get(**_SURE)


def _at(corners: Corners, x: Array) -> tuple[Array, ...]:
    flat = jnp.ravel(x)
    return tuple(_read(flat, nodes) for nodes in corners.cells)


def _sum(corners: Corners, values: tuple[Array, ...]) -> Array:
    zero = jnp.zeros(1, values[0].dtype)
    flat = jnp.concatenate([*values, zero])
    sums = [jnp.sum(_read(flat, table), axis=0, dtype=flat.dtype) for table in corners.tables]
    for table in corners.rounds:
        sums[-1] = jnp.sum(_read(jnp.concatenate([sums[-1], zero]), table), axis=0, dtype=flat.dtype)
    return _read(jnp.concatenate([*sums, zero]), corners.back).reshape(corners.node_shape)


def _tables(places: np.ndarray, n_nodes: int) -> tuple[list[np.ndarray], tuple[np.ndarray, ...], np.ndarray]:
    """Which entries each node sums, class by class, where that is done in rounds, and where each node's sum is."""
    by_node = np.argsort(places, kind="stable")
    degree = np.bincount(places, minlength=n_nodes)
    start = np.cumsum(degree) - degree
    width = widths(degree)
    tables, rounds, back, n_sums = [], (), np.zeros(n_nodes, int), 0
    for w in np.unique(width[width > 0]):
        nodes = np.flatnonzero(width == w)
        n_parts = -(-degree[nodes] // WIDEST)
        of, done = np.repeat(nodes, n_parts), WIDEST * counted(n_parts)
        slot = np.arange(min(int(w), WIDEST))[:, None]
        exists = slot < degree[of] - done
        tables.append(np.where(exists, by_node[start[of] + done + np.where(exists, slot, 0)], places.size))
        rounds = rounds_of(n_parts)
        back[nodes] = n_sums + np.arange(len(nodes))
        n_sums += len(nodes)
    back[degree == 0] = n_sums
    return tables, rounds, back


__all__ = ["Corners", "pairs_of"]
