"""Differences and sums on a lattice by shifted slices alone.

The springs of one family join node `i` to node `i + o`. Their values are kept on an EXTENDED range: along an axis of n nodes the tails
run over n + |o| places, so that every node finds "its" spring both as tail and as head, and both are plain slices:

    d = x[t + o] - x[t]                 x padded with |o| zeros on both sides, and d masked to zero where a spring does not exist
    f[i] = p[i] - p[i - o]              no padding, no branch in the inner loop

Keeping only the springs that exist would pad every pull back on the nodes, and XLA's padded loops vectorise badly: on one
core this form is the faster, on two the gain is smaller (`docs/benchmarks.md`). On a periodic axis nothing is extended; the slice is
a roll.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

Offset = tuple[int, ...]


class Grid(NamedTuple):
    """Shape of a lattice, offset of each spring family, and which axes wrap."""

    shape: tuple[int, ...]
    offsets: tuple[Offset, ...]
    periodic: tuple[bool, ...]

    def extended(self, offset: Offset) -> tuple[int, ...]:
        """Shape in which a family's values are kept."""
        return tuple(n if wraps else n + abs(o) for n, o, wraps in zip(self.shape, offset, self.periodic, strict=True))

    def actual(self, offset: Offset) -> tuple[int, ...]:
        """Shape of the springs that exist."""
        return tuple(n if wraps else max(n - abs(o), 0) for n, o, wraps in zip(self.shape, offset, self.periodic, strict=True))

    def margin(self, offset: Offset) -> tuple[int, ...]:
        """Springs that do not exist, at either end of each axis."""
        return tuple(0 if wraps else abs(o) for o, wraps in zip(offset, self.periodic, strict=True))

    @property
    def reach(self) -> tuple[int, ...]:
        """Zeros to put around a node array, per axis."""
        margins = [self.margin(offset) for offset in self.offsets]
        return tuple(max((m[axis] for m in margins), default=0) for axis in range(len(self.shape)))


def difference(grid: Grid, x: Array) -> tuple[Array, ...]:
    """Head minus tail, per family; zero where a spring does not exist."""
    found = difference_anywhere(grid, x)
    return tuple(inside(grid, d, offset, 0) for d, offset in zip(found, grid.offsets, strict=True))


def accumulate(grid: Grid, pulls: tuple[Array, ...]) -> Array:
    """Each pull on its tail, the opposite on its head: minus the transpose of `difference`."""
    return accumulate_anywhere(grid, tuple(inside(grid, p, offset, 0) for p, offset in zip(pulls, grid.offsets, strict=True)))


def difference_anywhere(grid: Grid, x: Array) -> tuple[Array, ...]:
    """As `difference`, without the mask: in the margins a node outside counts as zero."""
    padded = _pad(x, grid.reach)
    ends = [_ends(grid, padded, offset) for offset in grid.offsets]
    return tuple(head - tail for tail, head in ends)


def accumulate_anywhere(grid: Grid, pulls: tuple[Array, ...]) -> Array:
    """As `accumulate`, without the mask: minus the transpose of `difference_anywhere`."""
    total = None
    for offset, pull in zip(grid.offsets, pulls, strict=True):
        tail, head = _at_nodes(grid, pull, offset)
        total = tail - head if total is None else total + (tail - head)
    return jnp.zeros(grid.shape) if total is None else total


def sum_of_ends(grid: Grid, a: Array) -> tuple[Array, ...]:
    """Tail plus head, per family; zero where a spring does not exist."""
    padded = _pad(a, grid.reach)
    found = []
    for offset in grid.offsets:
        tail, head = _ends(grid, padded, offset)
        found.append(inside(grid, tail + head, offset, 0))
    return tuple(found)


def sum_at_nodes(grid: Grid, values: tuple[Array, ...]) -> Array:
    """Sum over the springs at each node: the transpose of `sum_of_ends`."""
    total = None
    for offset, value in zip(grid.offsets, values, strict=True):
        tail, head = _at_nodes(grid, inside(grid, value, offset, 0), offset)
        total = tail + head if total is None else total + (tail + head)
    return jnp.zeros(grid.shape) if total is None else total


def inside(grid: Grid, value: Array, offset: Offset, fill: float) -> Array:
    """`value` where the family's springs exist, `fill` elsewhere."""
    shape = grid.extended(offset)
    exists = None
    for axis, (margin, n) in enumerate(zip(grid.margin(offset), grid.shape, strict=True)):
        if margin:
            # A constant of one axis: a program holds it once, and it compiles sooner than a comparison of indices.
            place = np.arange(shape[axis])
            here = lax.broadcast_in_dim((place >= margin) & (place < n), shape, (axis,))
            exists = here if exists is None else exists & here
    return value if exists is None else lax.select(exists, value, jnp.full(shape, fill, value.dtype))


def extend(grid: Grid, value: Array, offset: Offset, fill: float) -> Array:
    """Values of the springs that exist -> the extended range, with `fill` in its margins."""
    return lax.pad(value, jnp.asarray(fill, value.dtype), [(m, m, 0) for m in grid.margin(offset)])


def crop(grid: Grid, value: Array, offset: Offset) -> Array:
    """The springs that exist, out of the extended range."""
    return value[tuple(slice(m, m + n) for m, n in zip(grid.margin(offset), grid.actual(offset), strict=True))]


def _pad(a: Array, reach: tuple[int, ...]) -> Array:
    return lax.pad(a, np.zeros((), a.dtype), [(r, r, 0) for r in reach])


def _ends(grid: Grid, padded: Array, offset: Offset) -> tuple[Array, Array]:
    """Values at the tails and heads of a family, on its extended range."""
    starts = [r + min(-o, 0) * (not wraps) for r, o, wraps in zip(grid.reach, offset, grid.periodic, strict=True)]
    extended = grid.extended(offset)
    shift = [0 if wraps else o for o, wraps in zip(offset, grid.periodic, strict=True)]
    tail = lax.slice(padded, starts, [s + n for s, n in zip(starts, extended, strict=True)])
    head = lax.slice(
        _roll(grid, padded, offset, -1),
        [s + o for s, o in zip(starts, shift, strict=True)],
        [s + o + n for s, o, n in zip(starts, shift, extended, strict=True)],
    )
    return tail, head


def _at_nodes(grid: Grid, value: Array, offset: Offset) -> tuple[Array, Array]:
    """For each node, the value of the spring whose tail it is, and of the spring whose head it is."""
    starts = [0 if wraps else max(o, 0) for o, wraps in zip(offset, grid.periodic, strict=True)]
    shift = [0 if wraps else o for o, wraps in zip(offset, grid.periodic, strict=True)]
    tail = lax.slice(value, starts, [s + n for s, n in zip(starts, grid.shape, strict=True)])
    head = lax.slice(
        _roll(grid, value, offset, 1),
        [s - o for s, o in zip(starts, shift, strict=True)],
        [s - o + n for s, o, n in zip(starts, shift, grid.shape, strict=True)],
    )
    return tail, head


def _roll(grid: Grid, a: Array, offset: Offset, sign: int) -> Array:
    turning = [(axis, sign * o) for axis, (o, wraps) in enumerate(zip(offset, grid.periodic, strict=True)) if wraps and o]
    return jnp.roll(a, [o for _, o in turning], [axis for axis, _ in turning]) if turning else a
