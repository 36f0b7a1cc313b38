"""Factor and solve with dense kernels, one panel after the other: the arithmetic of `Skyline`.

    A = U'U = L D L'        L = U' D^(-1/2),  D = diag(U)^2, the pivots

A panel holds rows of L D^(1/2) = U'. With W the triangle of the rows above that it reaches:

    left   = A_left W^-T             one triangular solve: the dot products of the active columns
    corner = chol(A_corner - left left')

The rows above are carried as a dense window, moved by one panel per step; `lax.scan` walks over the panels, and `lax.switch` picks a
window no larger than needed.

Source: Bathe's active columns (COLSOL), with panels of rows in the place of single columns.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .envelope import Panels


def factor_panels(panels: Panels, stored: Array) -> tuple[Array, Array]:
    """Factor a matrix in panel storage.

    A pivot is bad unless it is finite and above the rounding error eps A_jj of its own subtraction.

    Args:
        panels: the layout.
        stored: (B, total) lower triangle of the matrix; what lies above the diagonal in a corner is not read.

    Returns:
        (B, total) rows of U', and the first unknown whose pivot is bad, -1 where none is. From there on the factor is meaningless.
    """
    size, width, dtype = panels.size, panels.width, stored.dtype
    column = np.arange(width + size, dtype=np.int32)[None, :]
    branches = [partial(_substitute, w) for w in panels.widths]

    def step(carry: Any, panel: Any) -> tuple[Any, None]:
        factored, window, first, square_there, diagonal_there = carry
        index, end, active, kind = panel
        rows = lax.dynamic_slice(stored, (np.int32(0), end - width - size), (size, width + size))
        is_own = column >= width - active
        own = jnp.where(is_own, rows, jnp.zeros((), dtype))
        left = lax.switch(kind, branches, window, own[:, :width]) if len(branches) > 1 else branches[0](window, own[:, :width])
        square = own[:, width:] - left @ left.T
        corner = lax.linalg.cholesky(square, symmetrize_input=False)
        new = jnp.concatenate([left, corner], axis=1)
        window = jnp.concatenate([jnp.pad(window[size:, size:], ((0, 0), (0, size))), new[:, size:]])
        # Columns that are not the panel's own go to its right, where the next panel overwrites them: nothing is read from what is
        # written, so that it is written in place.
        shifted = lax.dynamic_slice(jnp.pad(new, ((0, 0), (0, width))), (np.int32(0), width - active), (size, width + size))
        factored = lax.dynamic_update_slice(factored, shifted, (np.int32(0), end - active - size))
        diagonal, pivots = jnp.diagonal(own[:, width:]), jnp.diagonal(corner) ** 2
        is_bad = ~jnp.all(_is_good(pivots, diagonal))
        is_first = is_bad & (first < 0)
        first = jnp.where(is_first, index, first)
        square_there = jnp.where(is_first, square, square_there)
        diagonal_there = jnp.where(is_first, diagonal, diagonal_there)
        return (factored, window, first, square_there, diagonal_there), None

    room = jnp.zeros((size, panels.total + width), dtype)
    begin = (room, jnp.eye(width, dtype=dtype), jnp.int32(-1), jnp.zeros((size, size), dtype), jnp.zeros((size,), dtype))
    table = (np.arange(panels.count, dtype=np.int32), panels.ends, panels.active, panels.kinds)
    (factored, _, first, square, diagonal), _ = lax.scan(step, begin, tuple(jnp.asarray(a) for a in table))
    row = lax.cond(first >= 0, _first_bad, lambda square, diagonal: jnp.int32(0), square, diagonal)
    return factored[:, : panels.total], jnp.where(first >= 0, first * size + row, jnp.int32(-1))


def solve_panels(panels: Panels, factored: Array, b: Array) -> Array:
    """U^-1 U^-T b.

    Args:
        panels: the layout.
        factored: (B, total) from `factor_panels`.
        b: (padded, R) right-hand sides in the order of elimination.

    Returns:
        (padded, R)
    """
    size, width = panels.size, panels.width
    column = np.arange(width, dtype=np.int32)[:, None]
    table = tuple(jnp.asarray(a) for a in (panels.ends, panels.active))
    zeros = jnp.zeros((width, b.shape[1]), b.dtype)

    def read(end: Array) -> tuple[Array, Array]:
        rows = lax.dynamic_slice(factored, (np.int32(0), end - width - size), (size, width + size))
        return rows[:, :width], rows[:, width:]

    def forward(above: Array, panel: Any) -> tuple[Array, Array]:
        right_side, end, active = panel
        left, corner = read(end)
        # Left of its own columns a window shows other panels' rows; they meet zeros.
        known = left @ jnp.where(column >= width - active, above, jnp.zeros((), b.dtype))
        y = lax.linalg.triangular_solve(corner, right_side - known, left_side=True, lower=True)
        return jnp.concatenate([above[size:], y]), y

    def backward(pending: Array, panel: Any) -> tuple[Array, Array]:
        right_side, end, active = panel
        left, corner = read(end)
        right_side = right_side - pending[width - size :]
        x = lax.linalg.triangular_solve(corner, right_side, left_side=True, lower=True, transpose_a=True)
        moved = jnp.concatenate([jnp.zeros_like(x), pending[: width - size]])
        return moved + jnp.where(column >= width - active, left.T @ x, jnp.zeros((), b.dtype)), x

    pieces = b.reshape(panels.count, size, b.shape[1])
    _, y = lax.scan(forward, zeros, (pieces, *table))
    _, x = lax.scan(backward, zeros, (y, *table), reverse=True)
    return x.reshape(b.shape)


def _substitute(width: int, window: Array, left: Array) -> Array:
    """Left W^-T by the last `width` rows of the window; the columns before them are zero."""
    before = window.shape[0] - width
    triangle = window[before:, before:]
    found = lax.linalg.triangular_solve(triangle, left[:, before:], left_side=False, lower=True, transpose_a=True)
    return jnp.pad(found, ((0, 0), (before, 0)))


def _is_good(pivot: Array, diagonal: Array) -> Array:
    # The pivot is what is left of the diagonal entry; below its rounding error the sign means nothing. NaN compares false.
    return (pivot > jnp.finfo(pivot.dtype).eps * jnp.abs(diagonal)) & jnp.isfinite(pivot)


def _first_bad(square: Array, diagonal: Array) -> Array:
    """First row of a panel whose pivot is bad, by elimination without blocks."""
    size = square.shape[0]
    below = np.arange(size, dtype=np.int32)

    def eliminate(j: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        square, found = carry
        pivot = square[j, j]
        found = jnp.where((found < 0) & ~_is_good(pivot, diagonal[j]), j, found)
        column = jnp.where(below > j, square[:, j], jnp.zeros((), square.dtype))
        return square - column[:, None] * (column / pivot)[None, :], found

    _, found = lax.fori_loop(jnp.int32(0), jnp.int32(size), eliminate, (square, jnp.int32(-1)))
    return jnp.maximum(found, 0)


__all__ = ["factor_panels", "solve_panels"]
