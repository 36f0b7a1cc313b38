"""A fixed reordering, applied as a pair of gathers.

`a[order]` alone puts a scatter into the gradient. Here the transpose of one gather is the other gather.
"""

from __future__ import annotations

import hashlib

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics import linear_call


class Permutation:
    """`order[i]` is the user's number of internal item `i`; compared and hashed by content, so that it can be static under `jit`."""

    def __init__(self, order: np.ndarray):
        self.order = np.asarray(order, np.int32)
        self.inverse = np.argsort(self.order).astype(np.int32)
        self._digest = hashlib.sha256(self.order.tobytes()).hexdigest()

    def __hash__(self) -> int:
        return hash(self._digest)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Permutation) and self._digest == other._digest)

    def __repr__(self) -> str:
        return f"Permutation(size={self.order.size}, numbering={self._digest[:6]})"

    def inward(self, a: Array) -> Array:
        """User's order -> internal order, along the last axis."""
        return _gather_pair(a, self.order, self.inverse)

    def outward(self, a: Array) -> Array:
        """Internal order -> user's order, along the last axis."""
        return _gather_pair(a, self.inverse, self.order)


def _gather_pair(a: Array, forward: np.ndarray, backward: np.ndarray) -> Array:
    if not jnp.issubdtype(a.dtype, jnp.inexact):
        return a[..., forward]
    tables = (jnp.asarray(forward), jnp.asarray(backward))
    return linear_call(_gather_first, _gather_second, tables, a)


def _gather_first(tables: tuple[Array, Array], a: Array) -> Array:
    return a[..., tables[0]]


def _gather_second(tables: tuple[Array, Array], a: Array) -> Array:
    return a[..., tables[1]]


def locality_order(pairs: np.ndarray, n_nodes: int) -> np.ndarray:
    """Reverse Cuthill-McKee order: joined nodes get near numbers, so that gathers stay in cache."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    if not len(pairs):
        return np.arange(n_nodes, dtype=np.int32)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    matrix = coo_array((np.ones(len(both), np.int8), (both[:, 0], both[:, 1])), shape=(n_nodes, n_nodes)).tocsr()
    return np.asarray(reverse_cuthill_mckee(matrix, symmetric_mode=True), np.int32)
