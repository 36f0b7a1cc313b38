"""Groups of nodes, groups of groups, and so on: the levels of multigrid on a `Graph`.

How the nets follow each other is found on the host, once (`aggregation.py`); here their matrices are made of numbers. A field is one
(N, D) array, and a block one (D, D) entry: with neighbours read from tables, one reading of all coordinates is faster than one for each
(on lattices it is the other way round).
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from ..topology.base import Topology
from ..topology.graph import Graph
from ..topology.lattice import Lattice
from ..topology.permutation import locality_order
from ..vector import Vector
from .aggregation import Springs, coarser, coarser_by
from .multigrid_cycle import Hierarchy, Level
from .operators import SpringBlocks, SpringMatrix
from .positive import as_rows, free_coordinates, node_blocks, spring_blocks
from .preconditioners import BlockFactors
from .sparse_rows import SparseRows, read, tables


class Net(eqx.Module):
    """Tables of one net. Its nodes are numbered anew, table by table.

    Attributes:
        neighbours: per table, (width, rows) the neighbours of each node; the node itself where a row is padded.
        springs: per table, (width, rows) the springs to them; the number of springs where padded.
        spread: P, from the next net.
        gathered: P', to the next net.
        combination: blocks of the next net's springs from those of this net.
    """

    neighbours: tuple[Int[Array, "width rows"], ...]
    springs: tuple[Int[Array, "width rows"], ...]
    spread: SparseRows
    gathered: SparseRows
    combination: SparseRows


class GraphLevel(Level):
    """One net of the hierarchy, ready to multiply.

    Attributes:
        net: its tables.
        blocks: per table, (width, rows, D, D) the blocks of the springs to the neighbours.
        centre: (N, D, D) every node's own block.
        factors: of those blocks.
    """

    net: Net
    blocks: tuple[Array, ...]
    centre: Array
    factors: BlockFactors

    @staticmethod
    def of(net: Net, springs: Array, nodes: Array) -> GraphLevel:
        """From (E, D, D) blocks of springs and (N, D, D) blocks of nodes."""
        padded = jnp.concatenate([springs, jnp.zeros_like(springs[:1])]) if len(springs) else jnp.zeros((1, *nodes.shape[1:]), nodes.dtype)
        blocks = tuple(read(padded, table) for table in net.springs)
        centre = nodes + jnp.concatenate([jnp.sum(b, axis=0) for b in blocks])
        return GraphLevel(net, blocks, centre, BlockFactors.of(as_rows(jnp.moveaxis(centre, 0, -1))))

    def product(self, v: Array) -> Array:
        """Every node's own block, minus those of its springs with the neighbours."""
        known = zip(self.blocks, self.net.neighbours, strict=True)
        others = [jnp.sum(b * read(v, neighbours)[:, :, None, :], axis=(0, 3)) for b, neighbours in known]
        return jnp.sum(self.centre * v[:, None, :], axis=2) - jnp.concatenate(others)

    def solve_blocks(self, r: Array) -> Array:
        """Solve with every node's own block."""
        return jnp.stack(self.factors.solve(Vector(tuple(r.T))).components, axis=-1)

    def restrict(self, r: Array) -> Array:
        """P' r."""
        return self.net.gathered.product(r)

    def prolong(self, v: Array) -> Array:
        """P v."""
        return self.net.spread.product(v)


class GraphHierarchy(Hierarchy):
    """All nets from the finest to one that is small enough for a dense inverse.

    Attributes:
        finest: the network.
        order: (N,) which of its nodes stands in place i of the first tables.
        place: (N,) where each of its nodes stands.
        ends: tail and head of its springs.
        nets: tables of all nets but the last.
        last_ends: tail and head of the springs of the last net.
        n_last: number of its nodes (static).
    """

    finest: Topology
    order: Int[Array, " N"]
    place: Int[Array, " N"]
    ends: tuple[Int[Array, " E"], Int[Array, " E"]]
    nets: tuple[Net, ...]
    last_ends: tuple[Int[Array, " E_last"], Int[Array, " E_last"]]
    n_last: int = eqx.field(static=True)

    @staticmethod
    def of(net: Topology, most_nodes: int) -> GraphHierarchy:
        """Group nodes until at most `most_nodes` are left."""
        springs = [Springs(*_ends(net), net.n_nodes)]
        steps = []
        while springs[-1].n > most_nodes:
            steps.append(coarser(springs[-1]) if steps else coarser_by(_near_order(net), springs[0]))
            springs.append(steps[-1].springs)
        drafts = [_Tables.of(s) for s in springs[:-1]]
        orders = [*(draft.order for draft in drafts), np.arange(springs[-1].n)]
        nets = []
        for draft, step, order, following in zip(drafts, steps, orders[:-1], orders[1:], strict=True):
            place = np.argsort(order)
            spread = step.spread[order][:, following]
            neighbours = tuple(jnp.asarray(place[table], jnp.int32) for table in draft.neighbours)
            numbers = tuple(jnp.asarray(table, jnp.int32) for table in draft.springs)
            nets.append(Net(neighbours, numbers, *(SparseRows.of(m) for m in (spread, spread.T, step.combination))))
        order = jnp.asarray(orders[0], jnp.int32)
        place = jnp.asarray(np.argsort(orders[0]), jnp.int32)
        return GraphHierarchy(net, order, place, _as_arrays(springs[0]), tuple(nets), _as_arrays(springs[-1]), springs[-1].n)

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field."""
        return self.finest.node_shape

    def build(self, matrix: SpringMatrix, dtype: jnp.dtype) -> tuple[tuple[Level, ...], Array]:
        """All levels but the last, and the last as a dense matrix."""
        springs, nodes = self._finest_blocks(matrix, dtype)
        levels = []
        for net in self.nets:
            levels.append(GraphLevel.of(net, springs, nodes))
            springs, nodes = net.combination.product(springs), net.gathered.product(nodes)
        return tuple(levels), self._dense(springs, nodes)

    def enter(self, r: Vector) -> Array:
        """(N, D) array in the order of the tables."""
        return read(jnp.stack([a.ravel() for a in r], axis=-1), self.order)

    def leave(self, v: Array, like: Vector) -> Vector:
        """The way back."""
        points = read(v, self.place)
        return Vector(tuple(points[:, i].reshape(like.shape) for i in range(like.dim)))

    def _finest_blocks(self, matrix: SpringMatrix, dtype: jnp.dtype) -> tuple[Array, Array]:
        """(E, D, D) blocks of the springs between free coordinates, and (N, D, D) of the nodes."""
        mine = [term for term in matrix.blocks.springs if _is_on(term, self.finest)]
        others = [term for term in matrix.blocks.springs if not _is_on(term, self.finest)]
        tails, heads = self.ends
        dim = matrix.dim
        springs = jnp.zeros((len(tails), dim, dim), dtype)
        for term in mine:
            springs = springs + _flat_blocks(term, dim, dtype)
        nodes = jnp.moveaxis(node_blocks(matrix, others, dtype).reshape(dim, dim, -1), -1, 0)
        free = free_coordinates(matrix, dtype)
        if free is not None:
            flat = free.reshape(dim, -1).T
            tail, head = read(flat, tails), read(flat, heads)
            for end, other, at in ((tail, head, tails), (head, tail, heads)):
                held = springs * _outer(end * (1 - other))
                nodes = nodes.at[at].add(held, mode="promise_in_bounds")
            springs = springs * _outer(tail * head)
        return springs, read(nodes, self.order) if self.nets else nodes

    def _dense(self, springs: Array, nodes: Array) -> Array:
        """(n D, n D) matrix of the last net, node by node."""
        n, dim = self.n_last, nodes.shape[-1]
        tails, heads = self.last_ends
        empty = jnp.zeros((n, n, dim, dim), nodes.dtype)
        own = jnp.arange(n, dtype=jnp.int32)
        rows = jnp.concatenate([own, tails, heads, tails, heads])
        columns = jnp.concatenate([own, tails, heads, heads, tails])
        values = jnp.concatenate([nodes, springs, springs, -springs, -springs])
        return empty.at[rows, columns].add(values).transpose(0, 2, 1, 3).reshape(n * dim, n * dim)


class _Tables(NamedTuple):
    """Neighbours of every node, and the springs to them, in tables; `order` lists the nodes table by table."""

    neighbours: list[np.ndarray]
    springs: list[np.ndarray]
    order: np.ndarray

    @staticmethod
    def of(springs: Springs) -> _Tables:
        tails, heads, n = springs
        own, other = np.concatenate([tails, heads]), np.concatenate([heads, tails])
        entry = np.argsort(own, kind="stable")
        degree = np.bincount(own, minlength=n)
        start = np.cumsum(degree) - degree
        neighbours, numbers, members = [], [], []
        for rows, place, exists in tables(degree):
            at = np.append(entry, 0)[np.where(exists, start[rows] + place, len(entry))]
            neighbours.append(np.where(exists, np.append(other, 0)[at], rows))
            numbers.append(np.where(exists, at % max(len(tails), 1), len(tails)))
            members.append(rows)
        return _Tables(neighbours, numbers, np.concatenate(members))


def _as_arrays(springs: Springs) -> tuple[Array, Array]:
    return jnp.asarray(springs.tails, jnp.int32), jnp.asarray(springs.heads, jnp.int32)


def _ends(net: Topology) -> tuple[np.ndarray, np.ndarray]:
    """Tail and head of each spring, in the order of `_flat_blocks`, nodes as they are stored."""
    if isinstance(net, Graph):
        return np.asarray(net.ends.tails), np.asarray(net.ends.heads)
    return net.edges[:, 0], net.edges[:, 1]


def _near_order(net: Topology) -> np.ndarray:
    """An order of the nodes as they are stored in which neighbours are near. A graph keeps them by their number of springs."""
    order = locality_order(net.edges, net.n_nodes)
    return net.nodes.inverse[order] if isinstance(net, Graph) else order


def _is_on(term: SpringBlocks, net: Topology) -> bool:
    """Whether a term's springs are those of the net."""
    return term.net.identity.has_springs_of(net.identity) and term.net.layout == net.layout


def _flat_blocks(term: SpringBlocks, dim: int, dtype: jnp.dtype) -> Array:
    """(E, D, D) blocks of a term's springs, family by family."""
    found = []
    for family in range(len(term.weight)):
        a = spring_blocks(term, family, dim, dtype)
        if isinstance(term.net, Lattice):
            margin = [0, 0, *term.net.grid_shape.margin(term.net.offsets[family])]
            a = lax.slice(a, margin, [n - m for n, m in zip(a.shape, margin, strict=True)])
        found.append(jnp.moveaxis(a.reshape(dim, dim, -1), -1, 0))
    return jnp.concatenate(found) if found else jnp.zeros((0, dim, dim), dtype)


def _outer(a: Array) -> Array:
    return a[:, :, None] * a[:, None, :]


__all__ = ["GraphHierarchy"]
