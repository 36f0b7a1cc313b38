"""Springs seen from their ends: every node reads its own springs, so that nothing is accumulated and no program holds a scatter.

    f_i = sum over the springs at node i of p(x_j - x_i; k, l)        p odd in the difference, so that both ends agree

Each spring has two entries, one at either end. Nodes are put in classes by their number of springs; the entries of a class of n nodes with
up to c springs are c rows of n, so that a sum over the rows reads memory in order. A node with very many springs has several
columns, which are summed in further rounds: a hub costs time and memory in proportion to its springs. Values that are read in every step
are spread over the entries once, before the loop, and derivatives by them are folded once, after it. Tables are made in `end_tables.py`.

The transpose of a sum of pulls is the same sum over the same tables: with e = q_j - q_i and J, K the derivatives of p,

    J' e summed at node i        and        -K' e / 2 at either entry of a spring.

Source: the springs' symmetry (slide "Force Computation", f_ij = -f_ji); layout and rule are ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from ..numerics import filled, linear_call
from ..vector import Vector

# Every index is in range by construction; without the test for negative ones programs compile in half the time.
_SURE: Any = {"mode": "promise_in_bounds", "wrap_negative_indices": False}


Spread = tuple[Any, ...]  # for each class an array (width, count), or a `Vector` of such


@dataclass(frozen=True)
class Class:
    """Nodes with about as many springs: entries `begin` to `begin + width * count`, row by row.

    Attributes:
        width: rows: springs of a node.
        count: columns: nodes, or parts of hubs.
        first: number of the first node.
        begin: number of the first entry.
        is_hubs: whether several columns may be of one node.
    """

    width: int
    count: int
    first: int
    begin: int
    is_hubs: bool

    def rows(self, a: Array) -> Array:
        """Of all entries (H,) this class's, (width, count)."""
        return lax.slice(a, (self.begin,), (self.begin + self.width * self.count,)).reshape(self.width, self.count)

    def own(self, x: Array, owners: Array) -> Array:
        """Of a node array (N,) the value at each column's node, for every row; nodes of a class are one after the other."""
        if self.is_hubs:
            return _read(x, owners)[None]
        return lax.slice(x, (self.first,), (self.first + self.count,))[None]


class Ends(eqx.Module):
    """The tables of a net, of H entries.

    Attributes:
        neighbours: (H,) the node at the other end.
        owners: of the class of hubs, the node of each column.
        entries: (H,) which spring, counted as E tails and then E heads.
        real: (H,) False where a node has fewer springs than its class: the entry repeats its first one. None where all have as many.
        tails: (E,) tail node of each spring.
        heads: (E,) head node of each.
        at_tails: (E,) the entry at each spring's tail.
        at_heads: (E,) the entry at its head.
        rounds: for hubs, tables (W, rows) of the columns, and of the sums of the round before, that are summed into each row; one row for
            each hub after the last round.
        classes: of nodes that have springs, in the order of the nodes; the last one that of hubs, if there is any (static).
        count: number of nodes N (static).
        exists: (E,) False for springs that only fill up, of a net in a batch of nets: copies of the first one, which no entry reads. None
            where all springs are.
    """

    neighbours: Int[Array, " H"]
    owners: Int[Array, " columns"]
    entries: Int[Array, " H"]
    real: Bool[Array, " H"] | None
    tails: Int[Array, " E"]
    heads: Int[Array, " E"]
    at_tails: Int[Array, " E"]
    at_heads: Int[Array, " E"]
    rounds: tuple[Int[Array, "W rows"], ...]
    classes: tuple[Class, ...] = eqx.field(static=True)
    count: int = eqx.field(static=True)
    exists: Bool[Array, " E"] | None = None

    # Linear maps, each with its transpose. Transposes leave out the entries of no spring: pulls and all their derivatives but those by the
    # fields that vanish are zero there.

    def difference(self, x: Array) -> Array:
        """(N,) -> (E,): head minus tail."""
        return linear_call(_difference, _minus_accumulate, self, x)

    def accumulate(self, p: Array) -> Array:
        """(E,) -> (N,): plus at the tail, minus at the head."""
        return linear_call(_accumulate, _minus_difference, self, p)

    def sum_at_nodes(self, values: Array) -> Array:
        """(E,) -> (N,): the sum of the values of the springs at each node."""
        return linear_call(_sum_at_nodes, _sum_of_ends, self, values)

    def mean_of_ends(self, a: Array) -> Array:
        """(N,) -> (E,): the mean over both ends."""
        return 0.5 * linear_call(_sum_of_ends, _sum_at_nodes, self, a)

    def spread(self, field: Any, vanishing: bool = False) -> Spread:
        """(E,) values, or a `Vector` of such -> those of each spring at both of its entries, class by class. Those of no spring repeat one
        of the node, or are zero.
        """
        forward = _spread_vanishing if vanishing else _spread
        leaves, tree = jax.tree.flatten(field)
        is_real = [jnp.issubdtype(a.dtype, jnp.inexact) for a in leaves]
        columns = [linear_call(forward, _fold, self, a) if real else forward(self, a) for a, real in zip(leaves, is_real, strict=True)]
        return tuple(tree.unflatten(parts) for parts in zip(*columns, strict=True))

    def apart(self, x: Vector) -> list[Vector]:
        """Other end minus own, at every entry, class by class."""
        columns = [linear_call(_apart, _together, self, a) for a in x]
        return [Vector(parts) for parts in zip(*columns, strict=True)]

    def sums(self, values: Sequence[Vector]) -> Vector:
        """Values at the entries, class by class, summed at each node."""
        return Vector(linear_call(_sums, _repeated, self, tuple(v.components for v in values)))

    def net_pull(self, pull: Callable[..., Vector], moving: Sequence[Vector], fields: Sequence[Any]) -> Vector:
        """The sum over each node's springs of `pull(*differences, *fields)`.

        Args:
            pull: odd in the differences together, and zero where a field that vanishes is; a tree, by whose arrays there are derivatives
                too.
            moving: what differences are taken of, each in node shape.
            fields: spread, or of one number for all springs; a spring's value does not change its sign from end to end.
        """
        is_spread = tuple(isinstance(field, tuple) for field in fields)
        shared = pull, tuple(None if of_each else field for field, of_each in zip(fields, is_spread, strict=True))
        columns = [field for field, of_each in zip(fields, is_spread, strict=True) if of_each]
        each = tuple(tuple(column[i] for column in columns) for i in range(len(self.classes)))
        varying, rest = eqx.partition((shared, each), eqx.is_inexact_array)
        fixed, static = eqx.partition(rest, eqx.is_array)
        return _net_pull((is_spread, static[0]), tuple(moving), varying, fixed, self)


@eqx.filter_custom_jvp
def _net_pull(static: Any, moving: tuple[Vector, ...], varying: Any, fixed: Any, ends: Ends) -> Vector:
    """Each class by itself, so that differences, pulls and their sum are one loop over the memory."""
    columns = []
    for i, one in enumerate(ends.classes):
        neighbours = one.rows(ends.neighbours)
        apart = tuple(v.map(lambda a, one=one, at=neighbours: _read(a, at) - one.own(a, ends.owners)) for v in moving)
        columns.append(_over_rows(_pull(static, _of_class(fixed, i), apart, *_of_class(varying, i)).components))
    return Vector(_joined(ends, columns))


@_net_pull.def_jvp
def _net_pull_jvp(primals: Any, tangents: Any) -> tuple[Vector, Vector]:
    static, moving, varying, fixed, ends = primals
    steps = filled((tangents[1], tangents[2]), (moving, varying))
    tangent = linear_call(partial(_tangent, static), partial(_tangent_transpose, static), (moving, varying, fixed, ends), steps)
    return _net_pull(*primals), tangent


def _tangent(static: Any, residuals: Any, operand: Any) -> Vector:
    """By how much the sum grows with what moves and what varies."""
    moving, varying, fixed, ends = residuals
    grown = []
    for i, (d, step) in enumerate(zip(_apart_of(ends, moving), _apart_of(ends, operand[0]), strict=True)):
        function = partial(_pull, static, _of_class(fixed, i))
        grown.append(jax.jvp(function, (d, *_of_class(varying, i)), (step, *_of_class(operand[1], i)))[1])
    return ends.sums(grown)


def _tangent_transpose(static: Any, residuals: Any, q: Vector) -> Any:
    """The same sum with transposed blocks; and half of each derivative by a spring's value at either entry."""
    moving, varying, fixed, ends = residuals
    of_moving, of_shared, of_each = [], [], []
    for i, (d, e) in enumerate(zip(_apart_of(ends, moving), ends.apart(q), strict=True)):
        _, back = jax.vjp(partial(_pull, static, _of_class(fixed, i)), d, *_of_class(varying, i))
        for found, by in zip((of_moving, of_shared, of_each), back(e), strict=True):
            found.append(by)
    shared = jax.tree.map(lambda *parts: sum(parts[1:], start=parts[0]), *of_shared)
    halved = jax.tree.map(lambda a: -0.5 * a, (shared, tuple(of_each)))
    return tuple(ends.sums(column) for column in zip(*of_moving, strict=True)), halved


def _apart_of(ends: Ends, moving: Sequence[Vector]) -> list[tuple[Vector, ...]]:
    return list(zip(*(ends.apart(v) for v in moving), strict=True))


def _of_class(values: Any, i: int) -> tuple[Any, Any]:
    """What all classes share, and what this one has."""
    shared, each = values
    return shared, each[i]


def _pull(static: Any, fixed: Any, apart: tuple[Vector, ...], shared: Any, each: Any) -> Vector:
    """The pulls of one class."""
    is_spread, rest = static
    pull, common = eqx.combine(shared, fixed[0], rest)
    own = iter(eqx.combine(each, fixed[1]))
    return pull(*apart, *(next(own) if of_each else field for field, of_each in zip(common, is_spread, strict=True)))


def _read(a: Array, index: Array) -> Array:
    return a.at[index].get(**_SURE)


def _difference(ends: Ends, x: Array) -> Array:
    return _read(x, ends.heads) - _read(x, ends.tails)


def _minus_difference(ends: Ends, x: Array) -> Array:
    return _read(x, ends.tails) - _read(x, ends.heads)


def _sum_of_ends(ends: Ends, a: Array) -> Array:
    return _read(a, ends.tails) + _read(a, ends.heads)


def _accumulate(ends: Ends, p: Array) -> Array:
    p = _with_copies(ends, p)
    return _sum_of_entries(ends, jnp.concatenate([p, -p]))


def _minus_accumulate(ends: Ends, p: Array) -> Array:
    p = _with_copies(ends, p)
    return _sum_of_entries(ends, jnp.concatenate([-p, p]))


def _sum_at_nodes(ends: Ends, values: Array) -> Array:
    values = _with_copies(ends, values)
    return _sum_of_entries(ends, jnp.concatenate([values, values]))


def _with_copies(ends: Ends, p: Array) -> Array:
    """What copies of the first spring have is the first spring's too."""
    if ends.exists is None:
        return p
    copied = jnp.sum(jnp.where(ends.exists, jnp.zeros((), p.dtype), p))
    return jnp.where(jnp.arange(p.shape[0]) == 0, p + copied, p)


def _of_springs(ends: Ends, values: Array) -> Array:
    """Values of entries, zero where the spring only fills up."""
    return values if ends.exists is None else jnp.where(ends.exists, values, jnp.zeros((), values.dtype))


def _sum_of_entries(ends: Ends, values: Array) -> Array:
    if not ends.classes:
        return jnp.zeros(ends.count, values.dtype)
    at_entries = _masked(ends, _read(values, ends.entries))
    return _sums(ends, tuple((one.rows(at_entries),) for one in ends.classes))[0]


def _masked(ends: Ends, a: Array) -> Array:
    """Zero at entries of no spring."""
    return a if ends.real is None else jnp.where(ends.real, a, jnp.zeros((), a.dtype))


def _split(ends: Ends, a: Array) -> Spread:
    return tuple(one.rows(a) for one in ends.classes)


def _flat(values: Spread) -> Array:
    return jnp.concatenate([jnp.ravel(v) for v in values])


def _entries_of(ends: Ends, a: Array) -> Array:
    n = a.shape[0]
    return _read(a, jnp.where(ends.entries >= n, ends.entries - n, ends.entries))


def _spread(ends: Ends, a: Array) -> Spread:
    return _split(ends, _entries_of(ends, a))


def _spread_vanishing(ends: Ends, a: Array) -> Spread:
    return _split(ends, _masked(ends, _entries_of(ends, a)))


def _fold(ends: Ends, values: Spread) -> Array:
    flat = _flat(values)
    return _of_springs(ends, _read(flat, ends.at_tails) + _read(flat, ends.at_heads))


def _apart(ends: Ends, x: Array) -> Spread:
    # One gather for all classes: each one is a loop of its own, and must be compiled.
    others = _read(x, ends.neighbours)
    return tuple(one.rows(others) - one.own(x, ends.owners) for one in ends.classes)


def _together(ends: Ends, values: Spread) -> Array:
    """A spring's two values have come from differences of opposite sign."""
    flat = _flat(values)
    return _minus_accumulate(ends, _of_springs(ends, _read(flat, ends.at_tails) - _read(flat, ends.at_heads)))


def _sums(ends: Ends, values: tuple[tuple[Array, ...], ...]) -> tuple[Array, ...]:
    return _joined(ends, [_over_rows(arrays) for arrays in values])


def _repeated(ends: Ends, q: tuple[Array, ...]) -> tuple[tuple[Array, ...], ...]:
    return tuple(tuple(jnp.broadcast_to(one.own(a, ends.owners), (one.width, one.count)) for a in q) for one in ends.classes)


def _joined(ends: Ends, columns: list[Sequence[Array]]) -> tuple[Array, ...]:
    """Sums of columns, class by class, as node arrays."""
    for table in ends.rounds:
        columns[-1] = _over_rows([_read(jnp.append(a, jnp.zeros((), a.dtype)), table) for a in columns[-1]])
    loners = ends.count - sum(arrays[0].shape[0] for arrays in columns)
    more = [jnp.zeros(loners, columns[0][0].dtype)] if loners else []
    return tuple(jnp.concatenate([*parts, *more]) for parts in zip(*columns, strict=True))


def _over_rows(arrays: Sequence[Array]) -> Sequence[Array]:
    """Sums over the first axis, of all arrays in one pass: one by one, XLA would compute what they share for each of them."""
    zero = jnp.zeros((), arrays[0].dtype)
    return lax.reduce(tuple(arrays), (zero,) * len(arrays), lambda a, b: tuple(x + y for x, y in zip(a, b, strict=True)), (0,))


__all__ = ["Class", "Ends", "Spread"]
