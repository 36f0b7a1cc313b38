"""Groups of nodes: how the nets of multigrid on a graph follow each other. On the host, from the springs alone.

Every group is a node with its neighbours; a displacement of the groups is spread to the nodes, P, by one sweep of averaging with the
neighbours, so that it has no jumps. A spring feels the difference of at most a few groups, (D P) with rows that sum to zero, so

    P' D' B D P = sum over pairs of groups (I, J) of springs with blocks  - sum over springs s of (D P)_sI (D P)_sJ B_s

is again a matrix of spring blocks, with sums whose weights are known beforehand.

Source: smoothed aggregation, Vanek, Mandel and Brezina (1996), here with the net's own averages in place of the matrix's.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

# Share of the neighbours' average in P: the usual 2/3.
_SHARE = 2 / 3
# Groups that a node may belong to: near a hub there could be thousands, and a coarse spring for each pair of them.
_PARENTS = 4


class Springs(NamedTuple):
    """Tail and head of each spring of a net of n nodes."""

    tails: np.ndarray
    heads: np.ndarray
    n: int


class Coarser(NamedTuple):
    """The next net: its springs, P (nodes x groups) and the weights of the springs' blocks (coarse springs x springs)."""

    springs: Springs
    spread: Any
    combination: Any


def coarser(springs: Springs) -> Coarser:
    """Group the nodes of a net in the order of their numbers: where neighbours have near ones, groups lie close together, and are few."""
    from scipy.sparse import csr_array, diags_array

    tails, heads, n = springs
    ones = np.ones(2 * len(tails))
    neighbours = csr_array((ones, (np.concatenate([tails, heads]), np.concatenate([heads, tails]))), shape=(n, n))
    neighbours.sort_indices()
    group = _groups([int(i) for i in neighbours.indptr], [int(j) for j in neighbours.indices], n)
    n_groups = int(group.max(initial=-1)) + 1
    inside = group >= 0
    member = csr_array((np.ones(inside.sum()), (np.flatnonzero(inside), group[inside])), shape=(n, n_groups))
    degree = np.maximum(neighbours.sum(axis=1), 1)
    spread = (1 - _SHARE) * member + _SHARE * (diags_array(1 / degree) @ neighbours @ member)
    spread = _largest(csr_array(spread), _PARENTS)
    number = np.arange(len(tails))
    difference = csr_array(
        (np.repeat([-1.0, 1.0], len(tails)), (np.tile(number, 2), np.concatenate([tails, heads]))), shape=(len(tails), n)
    )
    springs, combination = _combined(csr_array(difference @ spread), n_groups)
    return Coarser(springs, spread, combination)


def coarser_by(order: np.ndarray, springs: Springs) -> Coarser:
    """The same of a net whose nodes are kept in another order: node `order[i]` is asked as number i."""
    number = np.argsort(order)
    found = coarser(Springs(number[springs.tails], number[springs.heads], springs.n))
    return found._replace(spread=found.spread[number])


def _groups(start: list[int], neighbour: list[int], n: int) -> np.ndarray:
    """(n,) group of each node, -1 for a node without springs. Nodes whose neighbours are all free found groups; the rest joins one."""
    group = [-1] * n
    count = 0
    for i in range(n):
        around = neighbour[start[i] : start[i + 1]]
        if group[i] < 0 and around and all(group[j] < 0 for j in around):
            group[i] = count
            for j in around:
                group[j] = count
            count += 1
    founded = list(group)
    for i in range(n):
        if group[i] < 0:
            group[i] = next((founded[j] for j in neighbour[start[i] : start[i + 1]] if founded[j] >= 0), -1)
    return np.asarray(group)


def _largest(matrix: Any, count: int) -> Any:
    """At most `count` entries of each row, the largest, scaled so that they sum to one."""
    from scipy.sparse import csr_array

    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    by_size = np.lexsort((-matrix.data, row))
    place = np.arange(len(row)) - matrix.indptr[row]
    keep = by_size[place < count]
    total = np.bincount(row[keep], matrix.data[keep], minlength=matrix.shape[0])
    return csr_array((matrix.data[keep] / total[row[keep]], (row[keep], matrix.indices[keep])), shape=matrix.shape)


def _combined(difference: Any, n_groups: int) -> tuple[Springs, Any]:
    """Springs between groups, and the weight of every fine block in theirs."""
    from scipy.sparse import csr_array

    start, count = difference.indptr, np.diff(difference.indptr)
    first, second, weight, spring = [], [], [], []
    for a in range(count.max(initial=0)):
        for b in range(a + 1, count.max()):
            rows = np.flatnonzero(count > b)
            p, q = start[rows] + a, start[rows] + b
            first.append(difference.indices[p])
            second.append(difference.indices[q])
            weight.append(-difference.data[p] * difference.data[q])
            spring.append(rows)
    if not first:
        return Springs(np.zeros(0, np.int64), np.zeros(0, np.int64), n_groups), csr_array((0, difference.shape[0]))
    i, j = np.concatenate(first), np.concatenate(second)
    pair, place = np.unique(np.minimum(i, j).astype(np.int64) * n_groups + np.maximum(i, j), return_inverse=True)
    combination = csr_array((np.concatenate(weight), (place, np.concatenate(spring))), shape=(len(pair), difference.shape[0]))
    return Springs(pair // n_groups, pair % n_groups, n_groups), combination


__all__ = ["Coarser", "Springs", "coarser", "coarser_by"]
