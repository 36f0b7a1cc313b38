"""The tables of `ends.py`, made on the host: in which class a node is, which entries it reads.

Nodes of one class are one after the other. A class is worth its cost, of a loop of its own that must be compiled, where it saves entries
that would only fill up rows: the classes are those of the least sum of both, found class by class.

Source: the layout is ours.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from .ends import Class, Ends

WIDEST = 64  # springs that a node reads in one column
TABLE = 400  # entries that are read in the time that one more class costs: fewer classes compile sooner
SHARE = 100  # a class is worth its compile time where it saves this part of all entries


def build(pairs: np.ndarray, n_nodes: int) -> tuple[Ends, np.ndarray]:
    """Tables of the springs between (E, 2) nodes, and the order that the nodes are brought to: node `order[i]` becomes node i."""
    width = widths(np.bincount(pairs.ravel(), minlength=n_nodes))
    order = by_class(width)
    return tables(np.argsort(order)[pairs], width[order]), order


def by_class(width: np.ndarray) -> np.ndarray:
    """The order of the nodes, class by class, those without springs last."""
    return np.lexsort((np.arange(len(width)), np.where(width == 0, WIDEST + 2, width)))


def tables(pairs: np.ndarray, width: np.ndarray) -> Ends:
    """Of the springs between (E, 2) nodes that stand class by class, `width` that of each; a node may have fewer springs than its class,
    or none.
    """
    n_nodes = len(width)
    tails, heads = np.ascontiguousarray(pairs.T, np.int32)
    by_node = np.argsort(pairs.T.ravel(), kind="stable")
    degree = np.bincount(pairs.ravel(), minlength=n_nodes)
    start = np.cumsum(degree) - degree
    # What fills up a row repeats the node's first entry, that of a node without springs the first of all.
    start = np.where(degree > 0, start, 0)
    classes, columns, owners, rounds, first, begin = [], [], np.zeros(0, int), (), 0, 0
    for w in np.unique(width[width > 0]):
        nodes = np.flatnonzero(width == w)
        n_parts = np.maximum(-(-degree[nodes] // WIDEST), 1)
        done, of = WIDEST * counted(n_parts), np.repeat(np.arange(len(nodes)), n_parts)
        rows = min(int(w), WIDEST)
        slot, real_to = np.arange(rows)[:, None], np.minimum(degree[nodes][of] - done, WIDEST)
        real = slot < real_to
        entries = by_node[start[nodes][of] + done + np.where(real, slot, 0)]
        columns.append((entries.ravel(), real.ravel()))
        classes.append(Class(rows, len(of), first, begin, bool(w > WIDEST)))
        owners, rounds = (first + of, rounds_of(n_parts)) if w > WIDEST else (owners, rounds)
        first, begin = first + len(nodes), begin + entries.size
    entries, real = (np.concatenate(column) for column in zip(*columns, strict=True)) if columns else (np.zeros(0, int),) * 2
    places = np.zeros(pairs.size, np.int32)
    places[entries[real.astype(bool)]] = np.flatnonzero(real)
    neighbours, (at_tails, at_heads) = np.concatenate([heads, tails])[entries], np.split(places, 2)
    return Ends(
        neighbours=jnp.asarray(neighbours, jnp.int32),
        owners=jnp.asarray(owners, jnp.int32),
        entries=jnp.asarray(entries, jnp.int32),
        real=None if real.all() else jnp.asarray(real),
        tails=jnp.asarray(tails),
        heads=jnp.asarray(heads),
        at_tails=jnp.asarray(at_tails),
        at_heads=jnp.asarray(at_heads),
        rounds=tuple(map(jnp.asarray, rounds)),
        classes=tuple(classes),
        count=n_nodes,
    )


def common(degrees: Sequence[np.ndarray]) -> np.ndarray:
    """(N,) widths that every one of these nets fits in, if its nodes are brought to places by their number of springs; in falling order.

    The place of rank r is as wide as the widest need of that rank; places of nodes without springs, the most of any net, come last.
    """
    falling = [np.sort(d[d > 0])[::-1] for d in degrees]
    need = np.zeros(max(map(len, falling), default=0), int)
    for d in falling:
        need[: len(d)] = np.maximum(need[: len(d)], d)
    loners = max((int((d == 0).sum()) for d in degrees), default=0)
    return np.concatenate([widths(need), np.zeros(loners, int)])


def counted(numbers: np.ndarray) -> np.ndarray:
    """0, 1, ... n - 1 for each number n, one after the other."""
    return np.arange(numbers.sum()) - np.repeat(np.cumsum(numbers) - numbers, numbers)


def rounds_of(n_parts: np.ndarray) -> tuple[np.ndarray, ...]:
    """Tables that sum so many columns for each hub; missing entries name the zero that follows the last column."""
    rounds = []
    while (n_parts > 1).any():
        n_rows = -(-n_parts // WIDEST)
        start = np.repeat(np.cumsum(n_parts) - n_parts, n_rows) + WIDEST * counted(n_rows)
        at = start + np.arange(min(WIDEST, n_parts.max()))[:, None]
        rounds.append(np.where(at < np.repeat(np.cumsum(n_parts), n_rows), at, n_parts.sum()).astype(np.int32))
        n_parts = n_rows
    return tuple(rounds)


def widths(degree: np.ndarray) -> np.ndarray:
    """Width of each node's class, so that entries read, and the cost of a class, are fewest; above `WIDEST` for hubs, 0 for nodes alone."""
    rows = np.bincount(degree[degree <= WIDEST], minlength=2)
    rows[0] = 0
    table = max(TABLE, degree.sum() // SHARE)
    cost, narrower = np.zeros(len(rows)), np.zeros(len(rows), int)
    for width in range(1, len(rows)):
        # One class of this width for all nodes with more than s springs, after the best classes for up to s.
        costs = [cost[s] + table + width * rows[s + 1 : width + 1].sum() for s in range(width)]
        narrower[width], cost[width] = np.argmin(costs), np.min(costs)
    of_degree, width = np.zeros(len(rows), int), len(rows) - 1
    while width > 0:
        of_degree[narrower[width] + 1 : width + 1] = width
        width = narrower[width]
    return np.where(degree > WIDEST, WIDEST + 1, of_degree[np.minimum(degree, len(rows) - 1)])


__all__ = ["build", "by_class", "common", "counted", "rounds_of", "tables", "widths"]
