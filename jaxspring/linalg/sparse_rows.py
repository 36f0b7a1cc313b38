"""Sparse matrices whose pattern is known beforehand, as tables of rows of about equal length.

A product reads rows of an (M, ...) array by their numbers and adds them up; there is no scatter. Rows are sorted by length and padded to
the longest of their table, at most one and a half times their own length, so that one long row costs no more than its entries.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Entries that are read in the time that one more table costs.
_TABLE = 3000


class SparseRows(eqx.Module):
    """A sparse matrix of numbers.

    Attributes:
        columns: per table, (width, rows) the columns of the entries.
        weights: per table, (width, rows) the entries; 0 where a row is padded.
        order: (n_rows,) where each row of the matrix stands among those of all tables; empty where the matrix has no entry.
        n_rows: number of rows (static).
    """

    columns: tuple[Int[Array, "width rows"], ...]
    weights: tuple[Float[Array, "width rows"], ...]
    order: Int[Array, " n_rows"]
    n_rows: int = eqx.field(static=True)

    @staticmethod
    def of(matrix: Any) -> SparseRows:
        """From a SciPy matrix."""
        csr = matrix.tocsr()
        length = np.diff(csr.indptr)
        columns, weights, members = [], [], [np.zeros(0, np.int32)]
        for rows, place, exists in tables(length) if csr.nnz else []:
            entry = np.where(exists, csr.indptr[rows] + place, 0)
            columns.append(jnp.asarray(np.where(exists, csr.indices[entry], 0), jnp.int32))
            weights.append(jnp.asarray(np.where(exists, csr.data[entry], 0.0), jnp.float32))
            members.append(rows)
        order = jnp.asarray(np.argsort(np.concatenate(members)), jnp.int32)
        return SparseRows(tuple(columns), tuple(weights), order, csr.shape[0])

    def product(self, values: Array) -> Array:
        """(M, ...) -> (n_rows, ...)."""
        if not self.columns:
            return jnp.zeros((self.n_rows, *values.shape[1:]), values.dtype)
        ones = (1,) * (values.ndim - 1)
        sums = []
        for columns, weights in zip(self.columns, self.weights, strict=True):
            weight = weights.astype(values.dtype).reshape(*weights.shape, *ones)
            sums.append(jnp.sum(weight * read(values, columns), axis=0))
        return read(jnp.concatenate(sums), self.order)


def tables(length: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rows sorted into tables: their numbers (rows,), the places 0, 1, ... in a row (width, 1), and whether an entry exists there."""
    found = []
    width = _widths(length)
    for w in np.unique(width):
        rows = np.flatnonzero(width == w)
        place = np.arange(w)[:, None]
        found.append((rows, place, place < length[rows]))
    return found


def read(values: Array, index: Array) -> Array:
    """`values[index]` without a check of the bounds."""
    return values.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _widths(length: np.ndarray) -> np.ndarray:
    """Width of the table that each row goes to."""
    allowed = [1]
    while allowed[-1] < length.max(initial=1):
        allowed.append(max(allowed[-1] * 3 // 2, allowed[-1] + 1))
    width = np.asarray(allowed)[np.searchsorted(allowed, np.maximum(length, 1))]
    for w, wider in zip(np.unique(width)[:-1], np.unique(width)[1:], strict=True):
        here = width == w
        if np.sum(here) * (wider - w) < _TABLE:
            width[here] = wider
    return width


__all__ = ["SparseRows", "read", "tables"]
