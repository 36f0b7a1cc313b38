"""Sums of spring values on the nodes of a graph, in two interchangeable ways.

`Gather`, the default but for large graphs on a CPU, lets each node read the values of its springs from a table, so that no program holds
a scatter: bit-for-bit reproducible on every device. `Scatter` adds each spring's value to its two nodes. Nodes are numbered and put in
tables by their number of springs, so that no table is padded to the largest, and sums come out in the order of the nodes; a node with more
than `WIDEST` springs is split into parts that are summed in a further round, so that a hub costs time and memory in proportion to its
springs.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..numerics import linear_call

WIDEST = 16  # springs that a node reads in one row
TABLE = 1000  # entries that are read in the time that one more table costs: with fewer tables small graphs are faster, and compile sooner


FASTER_BY_SCATTER = 50_000  # nodes; measured on CPUs: at 100,000 a step takes 0.92 of the time that it takes with tables


class Reduction(eqx.Module):
    """How the springs of a graph act on its nodes. Abstract: see `Gather` and `Scatter`."""

    @abc.abstractmethod
    def difference(self, x: Array, tails: Array, heads: Array) -> Array:
        """(N,) -> (E,): head minus tail."""

    @abc.abstractmethod
    def accumulate(self, p: Array, tails: Array, heads: Array) -> Array:
        """(E,) -> (N,): plus at the tail, minus at the head; the transpose of `difference`, with the opposite sign."""

    @abc.abstractmethod
    def sum_at_nodes(self, values: Array, tails: Array, heads: Array) -> Array:
        """(E,) -> (N,): the sum of the values of the springs at each node."""

    @abc.abstractmethod
    def mean_of_ends(self, a: Array, tails: Array, heads: Array) -> Array:
        """(N,) -> (E,): the mean over both ends."""


class Scatter(Reduction):
    """Each spring adds to its two nodes by `.at[].add`.

    Attributes:
        count: number of nodes (static).
    """

    count: int = eqx.field(static=True)

    @staticmethod
    def build(tails: np.ndarray, heads: np.ndarray, n_nodes: int) -> tuple[Scatter, np.ndarray]:
        """As `Gather.build`; every order suits."""
        return Scatter(n_nodes), np.arange(n_nodes)

    def difference(self, x: Array, tails: Array, heads: Array) -> Array:
        """Head minus tail."""
        return _read(x, heads) - _read(x, tails)

    def accumulate(self, p: Array, tails: Array, heads: Array) -> Array:
        """Plus at the tail, minus at the head."""
        zero = jnp.zeros(self.count, p.dtype)
        return _add(_add(zero, tails, p), heads, -p)

    def sum_at_nodes(self, values: Array, tails: Array, heads: Array) -> Array:
        """Sum of the values of the springs at each node."""
        zero = jnp.zeros(self.count, values.dtype)
        return _add(_add(zero, tails, values), heads, values)

    def mean_of_ends(self, a: Array, tails: Array, heads: Array) -> Array:
        """Mean over both ends."""
        return 0.5 * (_read(a, tails) + _read(a, heads))


class Gather(Reduction):
    """Each node reads its springs from tables.

    A table of shape (rows, width) lists, for each row, which values to add. In the first round the values are [values, -values, 0]; in
    each further round they are the sums of the parts of the round before, and a zero.

    Attributes:
        whole: for each round, tables of several widths, one row for each node whose sum this round completes, in the order of the nodes.
        parts: for each round but the last, one table, whose rows are parts of the nodes that need a further round.
    """

    whole: tuple[tuple[Int[Array, "rows width"], ...], ...]
    parts: tuple[Int[Array, "rows width"], ...]

    @staticmethod
    def build(tails: np.ndarray, heads: np.ndarray, n_nodes: int) -> tuple[Gather, np.ndarray]:
        """Tables from the springs' ends, and the order that the nodes must be brought to: node `order[i]` becomes node i."""
        owner = np.concatenate([tails, heads]).astype(np.int64)
        entry = np.argsort(owner, kind="stable")
        owner, nodes = owner[entry], np.arange(n_nodes)
        whole, parts, completed = [], [], []
        while len(nodes):
            degree = np.bincount(owner, minlength=n_nodes)
            start = np.cumsum(degree) - degree
            is_whole = degree[nodes] <= WIDEST
            small, nodes = nodes[is_whole], nodes[~is_whole]
            width = _widths(degree[small])
            whole.append(tuple(_table(entry, start[small[width == w]], degree[small[width == w]], w) for w in np.unique(width)))
            completed.append(small[np.argsort(width, kind="stable")])
            if len(nodes):
                n_parts = -(-degree[nodes] // WIDEST)
                owner = np.repeat(nodes, n_parts)
                done = WIDEST * (np.arange(len(owner)) - np.repeat(np.cumsum(n_parts) - n_parts, n_parts))
                parts.append(_table(entry, start[owner] + done, np.minimum(degree[owner] - done, WIDEST), WIDEST))
                entry = np.arange(len(owner))
        return Gather(tuple(whole), tuple(parts)), np.concatenate(completed)

    def difference(self, x: Array, tails: Array, heads: Array) -> Array:
        """Head minus tail."""
        return linear_call(_difference, _minus_accumulate, (self, tails, heads), x)

    def accumulate(self, p: Array, tails: Array, heads: Array) -> Array:
        """Plus at the tail, minus at the head."""
        return linear_call(_accumulate, _minus_difference, (self, tails, heads), p)

    def sum_at_nodes(self, values: Array, tails: Array, heads: Array) -> Array:
        """Sum of the values of the springs at each node."""
        return linear_call(_sum, _sum_of_ends, (self, tails, heads), values)

    def mean_of_ends(self, a: Array, tails: Array, heads: Array) -> Array:
        """Mean over both ends."""
        return 0.5 * linear_call(_sum_of_ends, _sum, (self, tails, heads), a)

    def reduce(self, tail_values: Array, head_values: Array) -> Array:
        """(N,) sum of `tail_values` where a node is the tail and `head_values` where it is the head."""
        zero = jnp.zeros((1,), tail_values.dtype)
        values = jnp.concatenate([tail_values, head_values, zero])
        sums = [_sum_rows(values, table) for table in self.whole[0]]
        for part, tables in zip(self.parts, self.whole[1:], strict=True):
            values = jnp.concatenate([_sum_rows(values, part), zero])
            sums += [_sum_rows(values, table) for table in tables]
        return jnp.concatenate(sums)


def choose_reduction(n_nodes: int) -> type[Gather] | type[Scatter]:
    """The faster one for a network of that size on this device. On a GPU `Gather`: a scatter adds in an order of its own each time."""
    return Scatter if n_nodes > FASTER_BY_SCATTER and jax.default_backend() == "cpu" else Gather


def _table(entry: np.ndarray, start: np.ndarray, count: np.ndarray, width: int) -> Array:
    """Rows of `count` entries each from `start` on, padded to `width` by the number of the zero that follows all values."""
    slot = np.arange(width)
    at = np.where(slot < count[:, None], start[:, None] + slot, len(entry))
    return jnp.asarray(np.append(entry, len(entry))[at], jnp.int32)


def _widths(degree: np.ndarray) -> np.ndarray:
    """Width of each node's table, so that entries read, and `TABLE` for each table, are fewest. A node without a spring reads one zero."""
    rows = np.bincount(np.maximum(degree, 1))
    cost, narrower = np.zeros(len(rows)), np.zeros(len(rows), int)
    for width in range(1, len(rows)):
        # One table of this width for all nodes with more than s springs, after the best tables for up to s.
        costs = [cost[s] + TABLE + width * rows[s + 1 : width + 1].sum() for s in range(width)]
        narrower[width], cost[width] = np.argmin(costs), np.min(costs)
    of_degree, width = np.zeros(len(rows), int), len(rows) - 1
    while width > 0:
        of_degree[narrower[width] + 1 : width + 1] = width
        width = narrower[width]
    return of_degree[np.maximum(degree, 1)]


def _sum_rows(values: Array, table: Array) -> Array:
    total = _read(values, table[:, 0])
    for slot in range(1, table.shape[1]):
        total = total + _read(values, table[:, slot])
    return total


def _read(a: Array, index: Array) -> Array:
    # Every index is in range by construction; without the test for negative ones programs compile in half the time.
    return a.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _add(a: Array, index: Array, values: Array) -> Array:
    return a.at[index].add(values, mode="promise_in_bounds", wrap_negative_indices=False)


def _difference(residuals, x):
    _, tails, heads = residuals
    return _read(x, heads) - _read(x, tails)


def _minus_difference(residuals, x):
    _, tails, heads = residuals
    return _read(x, tails) - _read(x, heads)


def _accumulate(residuals, p):
    gather, _, _ = residuals
    return gather.reduce(p, -p)


def _minus_accumulate(residuals, p):
    gather, _, _ = residuals
    return gather.reduce(-p, p)


def _sum(residuals, values):
    gather, _, _ = residuals
    return gather.reduce(values, values)


def _sum_of_ends(residuals, a):
    _, tails, heads = residuals
    return _read(a, tails) + _read(a, heads)
