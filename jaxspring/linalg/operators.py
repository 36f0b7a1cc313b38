"""The matrices of implicit steps, applied without assembling anything: `SpringMatrix`.

    A = diag(c) + sum over nodes and cells of s g g' + sum over springs of D' B D,        B = w I + s u u'

`D` takes differences along springs, `u` is a spring's direction, `g` a node's, or that of all corners of a cell. `M/dt + G + dt K` has
this form: a spring gives its weight w and slope s (see `forces/laws.py`), a dashpot a slope alone, masses and drag a diagonal, bending a
slope for the corners of a hinge. A coordinate that is held has an identity row and column: a product and a solve leave it alone, exactly.
So has a direction e that is taken from a node: with P the product of all (I - e e'), the matrix is P A P + I - P. Direct solvers and
preconditioners see A + F e e' instead, F large: close to it.

Source: slide "Implicit Solution"; blocks as in Baraff and Witkin (1998), section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..topology.base import NodeLayout, Topology
from ..topology.corners import Corners, pairs_of
from ..topology.edge_field import EdgeField
from ..vector import Vector


class SpringBlocks(eqx.Module):
    """One symmetric block w I + s u u' per spring of a network.

    Attributes:
        net: whose springs they are.
        weight: w, an edge field.
        slope: s, an edge field, or None where it is zero everywhere (the coordinates then decouple).
        direction: u, an edge field of `Vector`, or None with `slope`.
        axes: the coordinates the springs act in; None is all.
    """

    net: Topology
    weight: EdgeField
    slope: EdgeField | None
    direction: EdgeField | None
    axes: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        net: Topology,
        weight: EdgeField,
        slope: EdgeField | None = None,
        direction: EdgeField | None = None,
        axes: tuple[int, ...] | None = None,
    ):
        self.net = net
        # Nothing where a lattice keeps places of springs that do not exist: products then need no mask.
        self.weight = net.vanishing(weight)
        self.slope = None if slope is None else net.vanishing(slope)
        self.direction = None if direction is None else net.at_ends(direction)
        self.axes = axes

    def product(self, v: Vector) -> Vector:
        """D' B D v."""
        moving = v if self.axes is None else Vector(tuple(v[a] for a in self.axes))
        if self.slope is None or self.direction is None:
            total = self.net.stiffness_product(_weighted, moving, self.weight)
        else:
            total = self.net.stiffness_product(_block_product, moving, self.weight, self.slope, self.direction)
        return total if self.axes is None else _embedded(total, self.axes, v)

    def entry(self, i: int, j: int) -> EdgeField | None:
        """Entry (i, j) of every spring's block; None where it is zero everywhere."""
        if self.axes is not None:
            if i not in self.axes or j not in self.axes:
                return None
            i, j = self.axes.index(i), self.axes.index(j)
        if self.slope is None or self.direction is None:
            return self.weight if i == j else None
        along = self.net.map_springs(lambda s, u: s * u[i] * u[j], self.slope, self.direction)
        return self.weight + along if i == j else along

    def across(self, i: int, j: int) -> Array | None:
        """(E,) entry of the matrix in row i of each spring's tail, column j of its head, in the user's order; None where all are zero."""
        found = self.entry(i, j)
        return None if found is None else -self.net.flatten(found)

    def scaled(self, factor: Array | float) -> SpringBlocks:
        """The same springs with every block times `factor`."""
        scaled = eqx.tree_at(lambda b: b.weight, self, self.weight * factor)
        return scaled if self.slope is None else eqx.tree_at(lambda b: b.slope, scaled, self.slope * factor)


class NodeDyads(eqx.Module):
    """A block s g g' at every node.

    Attributes:
        slope: s, node shape.
        direction: g, `Vector` in node shape.
    """

    slope: Array
    direction: Vector

    def product(self, v: Vector) -> Vector:
        """s g (g . v)."""
        return (self.slope * self.direction.dot(v)) * self.direction

    def scaled(self, factor: Array | float) -> NodeDyads:
        """Every block times `factor`."""
        return NodeDyads(self.slope * factor, self.direction)


class CellDyads(eqx.Module):
    """Blocks s g g' over all corners of every cell, several for each: bending, where a motion of one corner loads all of them.

    Attributes:
        corners: of the cells, with their pairs.
        slopes: for each dyad s, (C,).
        directions: for each dyad and corner g, a `Vector` of (C,).
    """

    corners: Corners
    slopes: tuple[Array, ...]
    directions: tuple[tuple[Vector, ...], ...]

    @property
    def net(self) -> Topology:
        """A net of every pair of a cell's corners, for solvers that store entries."""
        return self.corners.coupled()

    def product(self, v: Vector) -> Vector:
        """The sum of s g (g . v)."""
        at, total = self.corners.at(v), None
        for s, g in zip(self.slopes, self.directions, strict=True):
            amount = s * sum((a.dot(b) for a, b in zip(g[1:], at[1:], strict=True)), start=g[0].dot(at[0]))
            here = tuple(amount * a for a in g)
            total = here if total is None else tuple(a + b for a, b in zip(total, here, strict=True))
        return Vector.zeros_like(v) if total is None else self.corners.sum(total)

    def entry(self, i: int, j: int) -> Array:
        """Entry (i, j) of every node's own block, in node shape."""
        return self.corners.sum(tuple(self._sum_of(k, i, k, j) for k in range(len(self.corners.cells))))

    def across(self, i: int, j: int) -> Array:
        """(E,) entry of the matrix in row i of the first and column j of the second corner of each pair."""
        return jnp.concatenate([self._sum_of(k, i, l, j) for k, l in pairs_of(len(self.corners.cells))])

    def scaled(self, factor: Array | float) -> CellDyads:
        """Every block times `factor`."""
        return CellDyads(self.corners, tuple(s * factor for s in self.slopes), self.directions)

    def _sum_of(self, k: int, i: int, l: int, j: int) -> Array:
        parts = [s * g[k][i] * g[l][j] for s, g in zip(self.slopes, self.directions, strict=True)]
        return sum(parts[1:], start=parts[0])


class Blocks(eqx.Module):
    """A sum of node, spring and cell blocks: what a force adds to a matrix.

    Attributes:
        diagonal: tuple of `Vector`s in node shape (or of a 0-d array per coordinate), added on the diagonal.
        dyads: blocks of nodes.
        springs: blocks of springs.
        cells: blocks of cells.
    """

    diagonal: tuple[Vector, ...] = ()
    dyads: tuple[NodeDyads, ...] = ()
    springs: tuple[SpringBlocks, ...] = ()
    cells: tuple[CellDyads, ...] = ()

    def __add__(self, other: Blocks) -> Blocks:
        return Blocks(self.diagonal + other.diagonal, self.dyads + other.dyads, self.springs + other.springs, self.cells + other.cells)

    def scaled(self, factor: Array | float) -> Blocks:
        """Every block times `factor`."""
        return Blocks(
            tuple(factor * d for d in self.diagonal),
            tuple(d.scaled(factor) for d in self.dyads),
            tuple(s.scaled(factor) for s in self.springs),
            tuple(c.scaled(factor) for c in self.cells),
        )

    @property
    def pairs(self) -> tuple[SpringBlocks | CellDyads, ...]:
        """The terms that couple pairs of nodes."""
        return tuple(term for term in (*self.springs, *self.cells) if term.net.n_springs)

    def product(self, v: Vector) -> Vector:
        """The product with a `Vector` in node shape, no coordinate held."""
        total = Vector.zeros_like(v)
        for d in self.diagonal:
            total = total + Vector(tuple(c * a for c, a in zip(d, v, strict=True)))
        for term in (*self.dyads, *self.springs, *self.cells):
            total = total + term.product(v)
        return total


class SpringMatrix(eqx.Module):
    """A symmetric matrix over the coordinates of all nodes: `Blocks`, with identity rows where a coordinate is held.

    Call it to multiply: `A(v)` with a `Vector` in node shape.

    Attributes:
        blocks: what is summed.
        free: per coordinate, a bool array in node shape (None: all free).
        like: a `Vector` in node shape that tells shape, dimension and dtype.
        layout: how node fields are stored (static).
        taken: directions that are held, of length one or zero, at right angles to each other at every node; their slopes stand for
            firmness where a matrix must be factored.
    """

    blocks: Blocks
    free: tuple[Array | None, ...]
    like: Vector
    layout: NodeLayout = eqx.field(static=True)
    taken: tuple[NodeDyads, ...] = ()

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return self.like.dim

    @property
    def is_scalar(self) -> bool:
        """Whether the coordinates decouple by construction: no spring or node block has an entry off its diagonal."""
        return not (self.blocks.dyads or self.blocks.cells or self.taken) and all(term.slope is None for term in self.blocks.springs)

    def taking(self, directions: tuple[Vector, ...]) -> SpringMatrix:
        """The same with these directions held: of length one or zero, at right angles, zero in coordinates that are held already."""
        own = self.diagonal()
        # Far above what a node has of its own, and far below where that would be lost beside it.
        firm = float(jnp.finfo(self.like.dtype).eps) ** -0.4 * sum(own.map(jnp.abs))
        return replace(self, taken=tuple(NodeDyads(firm, e) for e in directions))

    def within(self, inverse: Callable[[Vector], Vector]) -> Callable[[Vector], Vector]:
        """A map r -> about A^-1 r that leaves alone what is taken."""
        if not self.taken:
            return inverse
        return lambda r: self.pick(inverse(self.pick(r, Vector.zeros_like(r))), r)

    def __call__(self, v: Vector) -> Vector:
        """A v; held coordinates of `v` pass through."""
        return self.pick(self.blocks.product(self.pick(v, Vector.zeros_like(v))), v)

    def pick(self, where_free: Vector, where_held: Vector) -> Vector:
        """The first where a coordinate is free, the second where it is held."""
        entries = zip(self.free, where_free, where_held, strict=True)
        found = Vector(tuple(a if mask is None else jnp.where(mask, a, b) for mask, a, b in entries))
        if self.taken:
            # Each coordinate reads all of them: without the barrier XLA computes what gave them anew for each.
            found = lax.optimization_barrier(found)
        for dyad in self.taken:
            found = found - dyad.direction.dot(found - where_held) * dyad.direction
        return found

    def entry(self, i: int, j: int) -> Array:
        """Entry (i, j) of every node's own D x D block, in node shape."""
        shape, dtype = self.like.shape, self.like.dtype
        total = jnp.zeros(shape, dtype)
        if i == j:
            for d in self.blocks.diagonal:
                total = total + d[i]
        for dyad in (*self.blocks.dyads, *self.taken):
            total = total + dyad.slope * dyad.direction[i] * dyad.direction[j]
        for term in self.blocks.springs:
            found = term.entry(i, j)
            if found is not None and term.net.n_springs:
                total = total + term.net.incident_sum(found)
        for term in self.blocks.cells:
            total = total + term.entry(i, j)
        for mask in {id(m): m for m in (self.free[i], self.free[j]) if m is not None}.values():
            total = jnp.where(mask, total, jnp.full((), float(i == j), dtype))
        return total

    def diagonal(self) -> Vector:
        """The diagonal; 1 where held."""
        return Vector(tuple(self.entry(i, i) for i in range(self.dim)))

    def node_blocks(self) -> tuple[Vector, ...]:
        """Rows of every node's own D x D block: `node_blocks()[i][j]` is a node array."""
        upper = {(i, j): self.entry(i, j) for i in range(self.dim) for j in range(i, self.dim)}
        return tuple(Vector(tuple(upper[min(i, j), max(i, j)] for j in range(self.dim))) for i in range(self.dim))

    def to_dense(self) -> Array:
        """(N D, N D) array, rows by node in the user's order and then by coordinate. For small systems."""
        layout, n, dim = self.layout, int(np.prod(self.like.shape)), self.dim
        flat = jnp.eye(n * dim, dtype=self.like.dtype).reshape(n * dim, n, dim)

        def column(points: Array) -> Array:
            v = Vector(tuple(layout.unflatten(points[:, i]) for i in range(dim)))
            return jnp.stack([layout.flatten(a) for a in self(v)], axis=-1).ravel()

        return lax.map(column, flat).T

    def to_scipy(self) -> Any:
        """`scipy.sparse.csr_array` in the order of `to_dense`. On the host: not for traced values."""
        from scipy.sparse import coo_array, csr_array

        if self.taken:
            return csr_array(np.asarray(self.to_dense()))
        layout, n, dim = self.layout, int(np.prod(self.like.shape)), self.dim
        free = np.ones((n, dim), bool)
        for i, mask in enumerate(self.free):
            if mask is not None:
                free[:, i] = np.asarray(layout.flatten(jnp.broadcast_to(mask, self.like.shape)))
        rows, columns, values = [], [], []

        def add(row: Any, column: Any, i: int, j: int, value: Any) -> None:
            keep = free[row, i] & free[column, j]
            rows.append((row * dim + i)[keep])
            columns.append((column * dim + j)[keep])
            values.append(np.asarray(value)[keep])

        nodes = np.arange(n)
        for i in range(dim):
            for j in range(dim):
                # Held rows have the entry 1 here, and no other.
                value = np.asarray(layout.flatten(self.entry(i, j)))
                rows.append(nodes * dim + i)
                columns.append(nodes * dim + j)
                values.append(value)
                for term in self.blocks.pairs:
                    found = term.across(i, j)
                    if found is not None:
                        tail, head = term.net.edges[:, 0], term.net.edges[:, 1]
                        add(tail, head, i, j, found)
                        add(head, tail, j, i, found)
        size = (n * dim, n * dim)
        matrix = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=size).tocsr()
        matrix.eliminate_zeros()
        return matrix


def isotropic(value: Any, like: Vector) -> Vector:
    """A node array (or number) on the diagonal of every coordinate, in node shape."""
    return like.map(lambda a: jnp.broadcast_to(jnp.asarray(value, a.dtype), a.shape))


def _weighted(d: Vector, weight: Array) -> Vector:
    return weight * d


def _block_product(d: Vector, weight: Array, slope: Array, u: Vector) -> Vector:
    return weight * d + (slope * u.dot(d)) * u


def _embedded(total: Vector, axes: tuple[int, ...], like: Vector) -> Vector:
    return Vector(tuple(total[axes.index(i)] if i in axes else jnp.zeros_like(a) for i, a in enumerate(like)))


__all__ = ["Blocks", "CellDyads", "NodeDyads", "SpringBlocks", "SpringMatrix", "isotropic"]
