"""Sums of spring values on the nodes of a graph, in two interchangeable ways.

`Scatter` adds each spring's value to its two nodes. `Gather` lets each node read the values of its springs from a table, so that no
program holds a scatter: bit-for-bit reproducible on every device. Nodes are bucketed by their number of springs, so that a table is
never padded to the largest; a node with more than `WIDEST` springs is split into parts that are summed in a second round, so that a
hub costs time and memory in proportion to its springs.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..numerics import linear_call

WIDEST = 16


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
    """Each spring adds to its two nodes by `.at[].add`."""

    count: int = eqx.field(static=True)

    @staticmethod
    def build(tails: np.ndarray, heads: np.ndarray, n_nodes: int) -> Scatter:
        """Needs the number of nodes only."""
        return Scatter(n_nodes)

    def difference(self, x: Array, tails: Array, heads: Array) -> Array:
        """Head minus tail."""
        return _read(x, heads) - _read(x, tails)

    def accumulate(self, p: Array, tails: Array, heads: Array) -> Array:
        """Plus at the tail, minus at the head."""
        zero = jnp.zeros(self.count, p.dtype)
        return zero.at[tails].add(p, mode="promise_in_bounds").at[heads].add(-p, mode="promise_in_bounds")

    def sum_at_nodes(self, values: Array, tails: Array, heads: Array) -> Array:
        """Sum of the values of the springs at each node."""
        zero = jnp.zeros(self.count, values.dtype)
        return zero.at[tails].add(values, mode="promise_in_bounds").at[heads].add(values, mode="promise_in_bounds")

    def mean_of_ends(self, a: Array, tails: Array, heads: Array) -> Array:
        """Mean over both ends."""
        return 0.5 * (_read(a, tails) + _read(a, heads))


class Gather(Reduction):
    """Each node reads its springs from tables.

    Attributes:
        rounds: each round is a tuple of tables, one per width; a table of shape (rows, width) lists, for each row, which entries of
            [values, -values, 0] (first round) or of the last round's rows to add.
        order: (N,) which row of the last round belongs to each node.
        rows: number of springs E.
    """

    rounds: tuple[tuple[Int[Array, "rows width"], ...], ...]
    order: Int[Array, " N"]
    rows: int = eqx.field(static=True)

    @staticmethod
    def build(tails: np.ndarray, heads: np.ndarray, n_nodes: int) -> Gather:
        """Tables from the springs' ends."""
        n_springs = len(tails)
        owner = np.concatenate([tails, heads]).astype(np.int64)
        by_owner = np.argsort(owner, kind="stable")
        entry, owner = by_owner, owner[by_owner]
        padding = 2 * n_springs
        rounds = []
        while True:
            tables, group_owner, row_of_group = _tables(entry, owner, n_nodes, padding)
            rounds.append(tuple(jnp.asarray(t, jnp.int32) for t in tables))
            if len(group_owner) == n_nodes:
                return Gather(tuple(rounds), jnp.asarray(row_of_group[np.argsort(group_owner)], jnp.int32), n_springs)
            entry, owner, padding = row_of_group, group_owner, len(group_owner)

    def difference(self, x: Array, tails: Array, heads: Array) -> Array:
        """Head minus tail."""
        return linear_call(_difference, _minus_accumulate, (self, tails, heads), x)

    def accumulate(self, p: Array, tails: Array, heads: Array) -> Array:
        """Plus at the tail, minus at the head."""
        return -linear_call(_minus_accumulate, _difference, (self, tails, heads), p)

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
        for i, tables in enumerate(self.rounds):
            sums = jnp.concatenate([_sum_rows(values, table) for table in tables])
            values = sums if i + 1 == len(self.rounds) else jnp.concatenate([sums, zero])
        return _read(values, self.order)


def choose_reduction(n_nodes: int, n_springs: int) -> type[Gather] | type[Scatter]:
    """The faster of the two for this size on the default device, as `benchmarks/explicit.py` measures them."""
    return Gather if jax.default_backend() != "cpu" else Scatter


def _tables(entry: np.ndarray, owner: np.ndarray, n_nodes: int, padding: int) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """One round: tables by width, the node that each group of entries belongs to, and the row that each group got.

    `entry` is sorted by `owner`. Every node has at least one group (empty where it has no spring).
    """
    degree = np.bincount(owner, minlength=n_nodes)
    n_groups = np.maximum(-(-degree // WIDEST), 1)
    group_owner = np.repeat(np.arange(n_nodes), n_groups)
    first_group = np.cumsum(n_groups) - n_groups
    place = np.arange(len(entry)) - np.repeat(np.cumsum(degree) - degree, degree)
    group, slot = first_group[owner] + place // WIDEST, place % WIDEST
    size = np.bincount(group, minlength=len(group_owner))
    tables, row_of_group, start = [], np.empty(len(group_owner), np.int64), 0
    for width in np.unique(np.maximum(size, 1)):
        members = np.flatnonzero(np.maximum(size, 1) == width)
        row_of_group[members] = start + np.arange(len(members))
        table = np.full((len(members), width), padding, np.int64)
        inside = np.maximum(size[group], 1) == width
        table[row_of_group[group[inside]] - start, slot[inside]] = entry[inside]
        tables.append(table)
        start += len(members)
    return tables, group_owner, row_of_group


def _sum_rows(values: Array, table: Array) -> Array:
    total = _read(values, table[:, 0])
    for slot in range(1, table.shape[1]):
        total = total + _read(values, table[:, slot])
    return total


def _read(a: Array, index: Array) -> Array:
    return a.at[index].get(mode="promise_in_bounds")


def _difference(residuals, x):
    _, tails, heads = residuals
    return _read(x, heads) - _read(x, tails)


def _minus_accumulate(residuals, p):
    gather, _, _ = residuals
    return gather.reduce(-p, p)


def _sum(residuals, values):
    gather, _, _ = residuals
    return gather.reduce(values, values)


def _sum_of_ends(residuals, a):
    _, tails, heads = residuals
    return _read(a, tails) + _read(a, heads)
