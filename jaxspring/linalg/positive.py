"""The positive semi-definite part of a `SpringMatrix` as plain arrays: what multigrid is made of.

A block w I + s u u' has the eigenvalues w (across the spring) and w + s (along it); the negative ones are replaced by zero.

Blocks are stacked here, (D, D, ...): one array compiles sooner than nine.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..topology.edge_field import EdgeField
from ..vector import Vector
from .operators import CellDyads, SpringBlocks, SpringMatrix


def spring_blocks(term: SpringBlocks, family: int, dim: int, dtype: jnp.dtype) -> Array:
    """(D, D, *family shape) the blocks of one spring family, zero where a lattice holds no spring."""
    weight = _clipped(term.weight.families[family])
    size = dim if term.axes is None else len(term.axes)
    found = on_diagonal(jnp.broadcast_to(weight.astype(dtype), (size, *weight.shape)))
    if term.slope is not None and term.direction is not None:
        slope = _clipped(term.weight.families[family] + term.slope.families[family]) - weight
        direction = jnp.stack([a.astype(dtype) for a in term.direction.families[family]])
        found = found + slope.astype(dtype)[None, None] * outer(direction)
    if term.axes is None:
        return found
    return jnp.zeros((dim, dim, *weight.shape), dtype).at[np.ix_(term.axes, term.axes)].set(found)


def node_blocks(matrix: SpringMatrix, others: Sequence[SpringBlocks], dtype: jnp.dtype) -> Array:
    """(D, D, *node shape) every node's block without its springs, but with those of `others` and its part of each cell; zero where held."""
    dim, shape = matrix.dim, matrix.like.shape
    total = jnp.zeros((dim, dim, *shape), dtype)
    for d in matrix.blocks.diagonal:
        total = total + on_diagonal(jnp.stack([jnp.broadcast_to(_clipped(a), shape).astype(dtype) for a in d]))
    for dyad in (*matrix.blocks.dyads, *matrix.taken):
        direction = jnp.stack([a.astype(dtype) for a in dyad.direction])
        total = total + _clipped(dyad.slope).astype(dtype)[None, None] * outer(direction)
    for term in others:
        if term.net.n_springs:
            families = [spring_blocks(term, family, dim, dtype) for family in range(len(term.weight))]
            total = total + _sum_at_nodes(term, families, shape)
    for cells in matrix.blocks.cells:
        total = total + _at_corners(cells, shape, dtype)
    free = free_coordinates(matrix, dtype)
    return total if free is None else total * outer(free)


def free_coordinates(matrix: SpringMatrix, dtype: jnp.dtype) -> Array | None:
    """(D, *node shape) 1 where free and 0 where held; None where nothing is held."""
    if all(mask is None for mask in matrix.free):
        return None
    shape = matrix.like.shape
    return jnp.stack([jnp.ones(shape, dtype) if m is None else jnp.broadcast_to(m, shape).astype(dtype) for m in matrix.free])


def as_rows(blocks: Array) -> tuple[Vector, ...]:
    """(D, D, ...) -> rows, as `BlockFactors` wants them."""
    return tuple(Vector(tuple(row)) for row in blocks)


def outer(a: Array) -> Array:
    """(D, ...) -> (D, D, ...): a[i] a[j]."""
    return a[:, None] * a[None, :]


def on_diagonal(a: Array) -> Array:
    """(D, ...) -> (D, D, ...): a[i] where i = j."""
    unit = jnp.eye(len(a), dtype=a.dtype).reshape(len(a), len(a), *(1,) * (a.ndim - 1))
    return unit * a[:, None]


def _sum_at_nodes(term: SpringBlocks, families: list[Array], shape: tuple[int, ...]) -> Array:
    dim = len(families[0])
    sums = [term.net.incident_sum(EdgeField(tuple(f[i, j] for f in families))) for i in range(dim) for j in range(dim)]
    return jnp.stack(sums).reshape(dim, dim, *shape)


def _at_corners(cells: CellDyads, shape: tuple[int, ...], dtype: jnp.dtype) -> Array:
    """(D, D, *node shape) the blocks of single nodes: what joins the corners of a cell is left out."""
    resisting = CellDyads(cells.corners, tuple(_clipped(s) for s in cells.slopes), cells.directions)
    dim = len(cells.directions[0][0]) if cells.directions else 0
    found = [[resisting.entry(min(i, j), max(i, j)).astype(dtype) for j in range(dim)] for i in range(dim)]
    return jnp.stack([jnp.stack(row) for row in found]).reshape(dim, dim, *shape)


def _clipped(a: Array) -> Array:
    return jnp.maximum(a, jnp.zeros_like(a))


__all__ = ["as_rows", "free_coordinates", "node_blocks", "on_diagonal", "outer", "spring_blocks"]
