"""Lattices of every other node: the levels of multigrid on a `Lattice`.

Node I of the coarser lattice is node 2 I of the finer; an axis of n nodes becomes one of n // 2 + 1 (n / 2 where it wraps). Between them
fields are interpolated linearly. The coarser lattice has the same springs, with blocks such that a linear displacement has the same energy:

    along an axis with offset 1     the two springs between its ends, in series              difference 1/2, energy 1/4 each
    along an axis with offset 2     the springs over it, as springs with offset 1             difference 1, energy 1
    across, offset 0                its neighbours in parallel, 1/2, 1, 1/2

so a sheet keeps its stiffness, a chain halves and a block doubles it. A spring to a held coordinate ties the other end to the ground: a
block on the diagonal.

Values of a family are kept by CELL, the lower corner of what the spring spans: tail = cell + max(-o, 0), head = cell + max(o, 0).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..topology.base import Topology
from ..topology.lattice import Lattice
from ..vector import Vector
from .multigrid_cycle import Hierarchy, Level
from .operators import SpringMatrix
from .positive import as_rows, free_coordinates, node_blocks, outer, spring_blocks
from .preconditioners import BlockFactors

Offset = tuple[int, ...]


class Axes(NamedTuple):
    """Number of nodes along each axis, and which wrap."""

    shape: tuple[int, ...]
    periodic: tuple[bool, ...]

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return int(np.prod(self.shape))

    def coarser(self) -> Axes | None:
        """Every other node; None where that is impossible or no less."""
        if any(wraps and (n % 2 or n < 4) for n, wraps in zip(self.shape, self.periodic, strict=True)):
            return None
        pairs = zip(self.shape, self.periodic, strict=True)
        shape = tuple(n // 2 if wraps else n if n == 1 else n // 2 + 1 for n, wraps in pairs)
        return None if shape == self.shape else Axes(shape, self.periodic)


class LatticeSprings(eqx.Module):
    """A matrix of blocks on a lattice, nothing held.

    Attributes:
        axes: the lattice (static).
        offsets: of the spring families (static).
        families: per family the (D, D, *cells) blocks of the springs.
        nodes: (D, D, *shape) blocks of the nodes.
    """

    axes: Axes = eqx.field(static=True)
    offsets: tuple[Offset, ...] = eqx.field(static=True)
    families: tuple[Array, ...]
    nodes: Array

    def coarser(self, axes: Axes) -> LatticeSprings:
        """The same springs between every other node."""
        found: dict[Offset, Array] = {}
        for offset, blocks in zip(self.offsets, self.families, strict=True):
            reduced = tuple(int(np.sign(o)) for o in offset)
            share = 1.0 if max(abs(o) for o in offset) == 2 else 0.25
            moved = share * self._spring_sum(blocks, offset)
            found[reduced] = found[reduced] + moved if reduced in found else moved
        return LatticeSprings(axes, tuple(found), tuple(found.values()), restrict(self.nodes, self.axes))

    def _spring_sum(self, a: Array, offset: Offset) -> Array:
        for axis, (o, n, wraps) in enumerate(zip(offset, self.axes.shape, self.axes.periodic, strict=True)):
            if abs(o) == 1:
                a = _pairs(a, axis + 2, n // 2)
            elif n > 1:
                a = _weighted(a, axis + 2, n // 2 if wraps or o else n // 2 + 1, wraps)
        return a

    def dense(self) -> Array:
        """(n D, n D) matrix, coordinate by coordinate."""
        n, dim = self.axes.n_nodes, len(self.nodes)
        numbers = np.arange(n).reshape(self.axes.shape)
        rows, columns, values = [np.arange(n)], [np.arange(n)], [self.nodes.reshape(dim, dim, n)]
        for offset, blocks in zip(self.offsets, self.families, strict=True):
            tail, head = (_node_of_cell(numbers, self.axes, [max(sign * o, 0) for o in offset], offset).ravel() for sign in (-1, 1))
            flat = blocks.reshape(dim, dim, -1)
            rows += [tail, head, tail, head]
            columns += [tail, head, head, tail]
            values += [flat, flat, -flat, -flat]
        empty = jnp.zeros((dim, dim, n, n), self.nodes.dtype)
        full = empty.at[:, :, np.concatenate(rows), np.concatenate(columns)].add(jnp.concatenate(values, axis=2))
        return full.transpose(0, 2, 1, 3).reshape(n * dim, n * dim)


class LatticeLevel(Level):
    """One lattice of the hierarchy, ready to multiply.

    Attributes:
        axes: the lattice (static).
        offsets: of the spring families (static).
        families: per family, the blocks by cell, with margins.
        centre: (D, D, *shape) every node's own block.
        factors: of those blocks.
    """

    axes: Axes = eqx.field(static=True)
    offsets: tuple[Offset, ...] = eqx.field(static=True)
    families: tuple[Array, ...]
    centre: Array
    factors: BlockFactors

    @staticmethod
    def of(springs: LatticeSprings) -> LatticeLevel:
        """Margins put around the families, blocks summed and factored."""
        axes = springs.axes
        known = zip(springs.offsets, springs.families, strict=True)
        families = tuple(_with_margin(a, [abs(o) for o in offset], axes, left_only=True) for offset, a in known)
        centre = springs.nodes
        for offset, a in zip(springs.offsets, families, strict=True):
            centre = centre + _at(a, axes, offset, 1) + _at(a, axes, offset, -1)
        return LatticeLevel(axes, springs.offsets, families, centre, BlockFactors.of(as_rows(centre)))

    def product(self, v: Vector) -> Vector:
        """Every node's own block, minus those of its springs with the neighbours."""
        reach = [max((abs(o[axis]) for o in self.offsets), default=0) for axis in range(len(self.axes.shape))]
        padded = [_with_margin(a, reach, self.axes) for a in v]
        out = [sum((self.centre[i, j] * v[j] for j in range(1, v.dim)), self.centre[i, 0] * v[0]) for i in range(v.dim)]
        for offset, blocks in zip(self.offsets, self.families, strict=True):
            for sign in (1, -1):
                block = _at(blocks, self.axes, offset, sign)
                start = [r + sign * o for r, o in zip(reach, offset, strict=True)]
                other = [lax.slice(a, start, [s + n for s, n in zip(start, self.axes.shape, strict=True)]) for a in padded]
                for i in range(v.dim):
                    for j in range(v.dim):
                        out[i] = out[i] - block[min(i, j), max(i, j)] * other[j]
        return Vector(tuple(out))

    def solve_blocks(self, r: Vector) -> Vector:
        """Solve with every node's own block."""
        return self.factors.solve(r)

    def restrict(self, r: Vector) -> Vector:
        """Every other node, with half of its neighbours."""
        return r.map(lambda a: restrict(a, self.axes))

    def prolong(self, v: Vector) -> Vector:
        """Linear interpolation between the nodes of the next level."""
        return v.map(lambda a: prolong(a, self.axes))


class LatticeHierarchy(Hierarchy):
    """All lattices from the finest to one that is small enough for a dense inverse.

    Attributes:
        net: the finest.
        chain: axes of all of them (static).
    """

    net: Lattice
    chain: tuple[Axes, ...] = eqx.field(static=True)

    @staticmethod
    def of(net: Lattice, most_nodes: int) -> LatticeHierarchy | None:
        """None where this lattice cannot be halved down to `most_nodes`."""
        if any(sorted(map(abs, o))[-1] > 1 and sum(map(abs, o)) != 2 for o in net.offsets):
            return None
        chain = [Axes(net.shape, net.periodic)]
        while chain[-1].n_nodes > most_nodes:
            following = chain[-1].coarser()
            if following is None:
                return None
            chain.append(following)
        return LatticeHierarchy(net, tuple(chain))

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field."""
        return self.net.node_shape

    def build(self, matrix: SpringMatrix, dtype: jnp.dtype) -> tuple[tuple[Level, ...], Array]:
        """All levels but the last, and the last as a dense matrix."""
        springs, levels = springs_on(matrix, self.net, dtype), []
        for axes in self.chain[1:]:
            levels.append(LatticeLevel.of(springs))
            springs = springs.coarser(axes)
        return tuple(levels), springs.dense()

    def enter(self, r: Vector) -> Vector:
        """A field as the levels want it."""
        return r

    def leave(self, v: Vector, like: Vector) -> Vector:
        """A field as the matrix wants it."""
        return v


def springs_on(matrix: SpringMatrix, net: Lattice, dtype: jnp.dtype) -> LatticeSprings:
    """The families of all lattices of this shape, by cell; what hangs on a held coordinate, or on another net, is put on the nodes."""
    axes, free = Axes(net.shape, net.periodic), free_coordinates(matrix, dtype)
    nodes = node_blocks(matrix, [term for term in matrix.blocks.springs if not _is_like(term.net, net)], dtype)
    found: dict[Offset, Array] = {}
    for term in matrix.blocks.springs:
        if not (isinstance(term.net, Lattice) and _is_like(term.net, net)):
            continue
        for family, offset in enumerate(term.net.offsets):
            a = spring_blocks(term, family, matrix.dim, dtype)
            margin = [0, 0, *term.net.grid_shape.margin(offset)]
            a = lax.slice(a, margin, [n - m for n, m in zip(a.shape, margin, strict=True)])
            a = _rolled(a, axes, [-max(-o, 0) for o in offset])
            if free is not None:
                a, nodes = _grounded(a, nodes, free, axes, offset)
            found[offset] = found[offset] + a if offset in found else a
    return LatticeSprings(axes, tuple(found), tuple(found.values()), nodes)


def _is_like(one: Topology, other: Lattice) -> bool:
    """Whether a net is a lattice of the same nodes."""
    return isinstance(one, Lattice) and (one.shape, one.periodic) == (other.shape, other.periodic)


def _grounded(a: Array, nodes: Array, free: Array, axes: Axes, offset: Offset) -> tuple[Array, Array]:
    """Blocks between free coordinates; the rest of a block stays with the free end alone, on the nodes."""
    shift = {sign: [max(sign * o, 0) for o in offset] for sign in (-1, 1)}
    tail, head = (_node_of_cell(free, axes, shift[sign], offset) for sign in (-1, 1))
    nodes = nodes + _on_nodes(a * outer(tail * (1 - head)), axes, shift[-1], offset)
    nodes = nodes + _on_nodes(a * outer(head * (1 - tail)), axes, shift[1], offset)
    return a * outer(tail * head), nodes


def _node_of_cell(a: Any, axes: Axes, shift: list[int], offset: Offset) -> Any:
    """For each cell the value at node cell + shift; leading axes, and NumPy arrays, allowed."""
    for axis, (s, o, n, wraps) in enumerate(zip(shift, offset, axes.shape, axes.periodic, strict=True), start=a.ndim - len(offset)):
        if wraps:
            a = np.roll(a, -s, axis) if isinstance(a, np.ndarray) else jnp.roll(a, -s, axis)
        else:
            a = a[(slice(None),) * axis + (slice(s, s + n - abs(o)),)]
    return a


def _on_nodes(a: Array, axes: Axes, shift: list[int], offset: Offset) -> Array:
    """The transpose of `_node_of_cell`."""
    for axis, (s, o, wraps) in enumerate(zip(shift, offset, axes.periodic, strict=True), start=a.ndim - len(offset)):
        a = jnp.roll(a, s, axis) if wraps else _pad(a, axis, s, abs(o) - s)
    return a


def _rolled(a: Array, axes: Axes, shift: list[int]) -> Array:
    turning = [(s, axis) for axis, (s, wraps) in enumerate(zip(shift, axes.periodic, strict=True), start=2) if wraps and s]
    return jnp.roll(a, [s for s, _ in turning], [axis for _, axis in turning]) if turning else a


def restrict(a: Array, axes: Axes) -> Array:
    """The transpose of `prolong`."""
    for axis, (n, wraps) in enumerate(zip(axes.shape, axes.periodic, strict=True), start=a.ndim - len(axes.shape)):
        if n > 1:
            a = _weighted(a, axis, n // 2 if wraps else n // 2 + 1, wraps)
    return a


def prolong(a: Array, axes: Axes) -> Array:
    """Linear interpolation from every other node to all of `axes`."""
    for axis, (n, wraps) in enumerate(zip(axes.shape, axes.periodic, strict=True)):
        if n > 1:
            a = _interpolated(a, axis, n, wraps)
    return a


def _weighted(a: Array, axis: int, count: int, wraps: bool) -> Array:
    """a[2 I] + (a[2 I - 1] + a[2 I + 1]) / 2 for I < count; nothing beyond the ends."""
    n = a.shape[axis]
    padded = jnp.concatenate([_cut(a, axis, n - 1, n), a], axis) if wraps else _pad(a, axis, 1, max(2 * count - n, 0))
    left, middle, right = (lax.slice_in_dim(padded, s, s + 2 * count - 1, 2, axis) for s in range(3))
    return middle + 0.5 * (left + right)


def _pairs(a: Array, axis: int, count: int) -> Array:
    """a[2 I] + a[2 I + 1] for I < count; nothing beyond the end."""
    padded = _pad(a, axis, 0, max(2 * count - a.shape[axis], 0))
    first, second = (lax.slice_in_dim(padded, s, s + 2 * count - 1, 2, axis) for s in range(2))
    return first + second


def _interpolated(a: Array, axis: int, n: int, wraps: bool) -> Array:
    """a[I] at 2 I, the mean of both neighbours between; n values."""
    ends = jnp.concatenate([a, _cut(a, axis, 0, 1)], axis) if wraps else a
    count = ends.shape[axis] - 1
    between = 0.5 * (_cut(ends, axis, 0, count) + _cut(ends, axis, 1, count + 1))
    even = lax.pad(a, np.zeros((), a.dtype), [(0, int(wraps), 1) if k == axis else (0, 0, 0) for k in range(a.ndim)])
    odd = lax.pad(between, np.zeros((), a.dtype), [(1, int(not wraps), 1) if k == axis else (0, 0, 0) for k in range(a.ndim)])
    return _cut(even + odd, axis, 0, n)


def _at(a: Array, axes: Axes, offset: Offset, sign: int) -> Array:
    """For each node the value of the spring whose tail (sign 1) or head (sign -1) it is; `a` has margins on the left and right."""
    start = [0, 0, *(max(sign * o, 0) for o in offset)]
    return lax.slice(a, start, [s + n for s, n in zip(start, (*a.shape[:2], *axes.shape), strict=True)])


def _with_margin(a: Array, width: list[int], axes: Axes, left_only: bool = False) -> Array:
    """Zeros around, or the other side where an axis wraps; a wrapping family needs its left margin alone."""
    for axis, (w, wraps) in enumerate(zip(width, axes.periodic, strict=True), start=a.ndim - len(width)):
        if w and wraps:
            n = a.shape[axis]
            parts = [_cut(a, axis, n - w, n), a] if left_only else [_cut(a, axis, n - w, n), a, _cut(a, axis, 0, w)]
            a = jnp.concatenate(parts, axis)
        elif w:
            a = _pad(a, axis, w, w)
    return a


def _pad(a: Array, axis: int, low: int, high: int) -> Array:
    return lax.pad(a, np.zeros((), a.dtype), [(low, high, 0) if k == axis else (0, 0, 0) for k in range(a.ndim)])


def _cut(a: Array, axis: int, start: int, stop: int) -> Array:
    return lax.slice_in_dim(a, start, stop, 1, axis)


__all__ = ["LatticeHierarchy"]
