"""In which order unknowns are eliminated: what decides how much of a factor is kept.

Column j of the upper triangle is kept from its first nonzero row m_j down to the diagonal; eliminating fills nothing outside:

    height h_j = j - m_j        profile = sum (h_j + 1)        bandwidth = max h_j
    factor  about  sum h_j^2 / 2 multiply-adds                 solve  about  2 sum h_j

An n x n lattice, row by row: profile n^3 + n - 1 with structural springs, n^3 + n^2 - n with shear, 2n^3 - 2n^2 + 3n - 4 with bend.
Reverse Cuthill-McKee takes 2/3 of the first and 4/3 of the second (for large n): neither order is always the better.

Source: Jennings' variable band, Bathe's active columns; A. George and J. Liu (1981), chapter 4, for the orders.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any

import numpy as np


class Ordering(abc.ABC):
    """A rule that numbers the nodes of a net. Abstract: see `Natural`, `ReverseCuthillMcKee` and `Given`."""

    @abc.abstractmethod
    def places(self, edges: np.ndarray, n_nodes: int) -> np.ndarray:
        """(N,) which node comes first, second, ..., for (E, 2) springs; nodes in the user's numbering."""


@dataclass(frozen=True)
class Natural(Ordering):
    """The user's own numbering: row by row on a lattice.

    >>> Natural().places(np.array([[0, 2]]), 3)
    array([0, 1, 2])
    """

    def places(self, edges: np.ndarray, n_nodes: int) -> np.ndarray:
        """0, 1, 2, ..."""
        return np.arange(n_nodes)


@dataclass(frozen=True)
class ReverseCuthillMcKee(Ordering):
    """Breadth first from a node of few neighbours, turned round (SciPy's).

    >>> order = ReverseCuthillMcKee().places(np.array([[0, 2], [2, 1]]), 3)
    >>> first_places(np.array([[0, 2], [2, 1]]), order).tolist()
    [0, 0, 1]
    """

    def places(self, edges: np.ndarray, n_nodes: int) -> np.ndarray:
        """Neighbours get near places."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        if not len(edges):
            return np.arange(n_nodes)
        both = np.concatenate([edges, edges[:, ::-1]])
        matrix = coo_array((np.ones(len(both), np.int8), (both[:, 0], both[:, 1])), shape=(n_nodes, n_nodes)).tocsr()
        return np.asarray(reverse_cuthill_mckee(matrix, symmetric_mode=True))


class Given(Ordering):
    """A permutation of one's own: (N,) integers, the node that comes first, second, ...

    Raises ValueError where a node is missing, named twice or does not exist.
    """

    def __init__(self, nodes: Any):
        self.nodes = np.asarray(nodes)

    def __hash__(self) -> int:
        return hash((self.nodes.shape, self.nodes.tobytes()))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Given) and np.array_equal(self.nodes, other.nodes)

    def places(self, edges: np.ndarray, n_nodes: int) -> np.ndarray:
        """The permutation, checked."""
        if self.nodes.shape != (n_nodes,) or not np.issubdtype(self.nodes.dtype, np.integer):
            raise ValueError(
                f"order has shape {self.nodes.shape} and dtype {self.nodes.dtype}; expected ({n_nodes},) integers: the node that comes "
                f"first, second, and so on. Pass None to have one chosen."
            )
        outside = np.flatnonzero((self.nodes < 0) | (self.nodes >= n_nodes))
        if len(outside):
            i = int(outside[0])
            raise ValueError(f"order[{i}] = {self.nodes[i]}, but nodes are 0 to {n_nodes - 1}. Fix order[{i}].")
        times = np.bincount(self.nodes, minlength=n_nodes)
        if (times != 1).any():
            twice, missing = int(np.argmax(times)), int(np.argmin(times))
            raise ValueError(
                f"order names node {twice} {times[twice]} times and node {missing} not at all. Every node must come exactly once, "
                f"else an equation would be lost. Pass a permutation of 0 to {n_nodes - 1}."
            )
        return self.nodes


def first_places(edges: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(N,) m_j: the first place that column j of the upper triangle reaches, for (E, 2) springs and the node at each place."""
    n_nodes = len(places)
    place = np.empty(n_nodes, np.int64)
    place[places] = np.arange(n_nodes)
    first = np.arange(n_nodes)
    ends = place[edges]
    np.minimum.at(first, ends.max(axis=1), ends.min(axis=1))
    return first


def smallest_profile(edges: np.ndarray, n_nodes: int, orderings: tuple[Ordering, ...]) -> tuple[Ordering, np.ndarray, np.ndarray]:
    """The ordering of least profile (the first of equals), its places, and where its columns begin."""
    found = []
    for ordering in orderings:
        places = ordering.places(edges, n_nodes)
        first = first_places(edges, places)
        found.append((int(np.sum(np.arange(n_nodes) - first)), ordering, places, first))
    _, ordering, places, first = min(found, key=lambda entry: entry[0])
    return ordering, places, first


__all__ = ["Given", "Natural", "Ordering", "ReverseCuthillMcKee", "first_places", "smallest_profile"]
