"""Springs as a list of pairs: what a graph and a net laid over another have in common.

An edge field holds one entry of shape (E,). Springs are kept in an order in which what is read together lies together; the user's is kept
outside.
"""

from __future__ import annotations

import hashlib
from typing import Any, Self

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .base import Topology
from .edge_field import EdgeField
from .identity import NetIdentity
from .permutation import Permutation, locality_order
from .reduction import Reduction


class ListedSprings(Topology):
    """A topology whose springs are one list. Abstract: see `Graph` and `Overlay`."""

    tails: eqx.AbstractVar[Array]
    heads: eqx.AbstractVar[Array]
    reduction: eqx.AbstractVar[Reduction]
    box: eqx.AbstractVar[Array | None]
    springs: eqx.AbstractVar[Permutation]
    digest: eqx.AbstractVar[str]
    name: eqx.AbstractVar[str | None]

    @property
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape of an edge field of the only family of springs: ((E,),)."""
        return (self.family_sizes,)

    @property
    def family_sizes(self) -> tuple[int, ...]:
        """Number of springs of the only family: (E,)."""
        return (self.springs.order.size,)

    @property
    def identity(self) -> NetIdentity:
        """The springs' digest, and the name."""
        springs = (f"{self.n_nodes} nodes", f"{self.springs.order.size} springs", f"digest {self.digest}")
        return NetIdentity(type(self).__name__, springs, self.name, self.springs)

    def _ends(self) -> np.ndarray:
        """(E, 2) places of tail and head, on the host."""
        return np.stack([of_one(self.tails), of_one(self.heads)], axis=-1)

    def unboxed(self) -> Self:
        """The same springs without periods."""
        return eqx.tree_at(lambda net: net.box, self, None, is_leaf=lambda leaf: leaf is None)

    def inside(self, field: EdgeField, fill: float) -> EdgeField:
        """The field itself: a list keeps no margins."""
        return field

    def split(self, flat: Array) -> EdgeField:
        """(E,) array in the user's order -> edge field."""
        return self.own((self.springs.inward(flat),))

    def _flatten(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array in the user's order."""
        return self.springs.outward(field.families[0])


def arranged(pairs: np.ndarray, n_nodes: int, reduction: Any) -> tuple[np.ndarray, np.ndarray, Reduction, np.ndarray, Permutation]:
    """How the springs between these pairs of nodes are kept.

    Args:
        pairs: (E, 2) tail and head of each spring.
        n_nodes: number of nodes.
        reduction: `Gather` or `Scatter`.

    Returns:
        Tails and heads in the order of the springs and the numbering in which they are kept, how pulls are summed, the given number of
        each node that is kept, and the order of the springs.
    """
    near = locality_order(pairs, n_nodes)
    inner = np.argsort(near)[pairs]
    springs = Permutation(np.lexsort((inner.max(axis=1), inner.min(axis=1))))
    tails, heads = inner[springs.order].T
    sums, order = reduction.build(tails, heads, n_nodes)
    nodes = near[order]
    tails, heads = np.argsort(nodes).astype(np.int32)[pairs[springs.order]].T
    return tails, heads, sums, nodes, springs


def of_one(table: Array) -> np.ndarray:
    """A table on the host; of stacked nets, which are all one, the first's."""
    array = np.asarray(table)
    return array.reshape(-1, array.shape[-1])[0] if array.ndim > 1 else array


def digest_of(pairs: np.ndarray) -> str:
    """Of the springs in the user's numbering and order."""
    return hashlib.sha256(np.ascontiguousarray(pairs, "<i4").data).hexdigest()[:16] if len(pairs) else ""


__all__ = ["ListedSprings", "arranged", "digest_of", "of_one"]
