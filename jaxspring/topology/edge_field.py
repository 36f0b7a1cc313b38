"""A value on every spring, kept in the topology's own shape: one entry per spring family."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import Numbers, kept, own
from .._checks import shape_of
from .identity import NetIdentity

# What a user may pass for springs: numbers, a field of the net, or on a lattice numbers by family.
SpringNumbers: TypeAlias = "Numbers | EdgeField | Mapping[Any, Numbers]"


def _kept(families: Any) -> Any:
    return tuple(kept(entry) for entry in families) if isinstance(families, tuple | list) else families


class EdgeField(eqx.Module):
    """A value (an array, or a `Vector` of arrays) on every spring.

    On a lattice there is one entry per spring family, in the shape of that family's tails; on a graph a single entry of shape (E,).
    As a constant of springs an entry may also be one number for its whole family.
    Arithmetic is elementwise with another field or with a number.

    Attributes:
        families: tuple with one entry per spring family. NumPy arrays are copied.
        identity: whose springs these are; None in a field made by hand, which is taken for that of any net whose shapes it has (static).
    """

    families: tuple[Any, ...] = eqx.field(converter=_kept)
    identity: NetIdentity | None = eqx.field(static=True, default=None)

    __array_ufunc__ = None

    def map(self, function: Callable[..., Any], *others: EdgeField) -> EdgeField:
        """Apply `function` to each family (and those of `others`, which must be of the same springs)."""
        families = zip(self.families, *(o.families for o in others), strict=True)
        return EdgeField(tuple(function(*entries) for entries in families), _common_identity(self, *others))

    @property
    def dtype(self) -> jnp.dtype:
        """Type of the entries."""
        return jnp.result_type(jax.tree.leaves(self.families)[0])

    def __iter__(self) -> Iterator[Any]:
        return iter(self.families)

    def __len__(self) -> int:
        return len(self.families)

    def __getitem__(self, index: int) -> Any:
        return self.families[index]

    def __neg__(self) -> EdgeField:
        return self.map(lambda a: -a)

    def __add__(self, other: Any) -> EdgeField:
        return self._combine(lambda a, b: a + b, other)

    def __sub__(self, other: Any) -> EdgeField:
        return self._combine(lambda a, b: a - b, other)

    def __rsub__(self, other: Any) -> EdgeField:
        return self._combine(lambda a, b: b - a, other)

    def __mul__(self, other: Any) -> EdgeField:
        return self._combine(lambda a, b: a * b, other)

    def __truediv__(self, other: Any) -> EdgeField:
        return self._combine(lambda a, b: a / b, other)

    __radd__ = __add__
    __rmul__ = __mul__

    def _combine(self, operation: Callable[[Any, Any], Any], other: Any) -> EdgeField:
        if isinstance(other, EdgeField):
            return self.map(operation, other)
        if not (isinstance(other, (int, float, np.ndarray, np.generic)) or eqx.is_array(other)):
            return NotImplemented
        if shape_of(other):
            raise TypeError(
                f"An EdgeField was combined with an array of shape {shape_of(other)}. Convert it first: network.edge_field(array)."
            )
        if isinstance(other, (np.ndarray, np.generic)):
            other = own("the operand", other, jax.tree.leaves(self.families)[0].dtype)
        return self.map(lambda entry: operation(entry, other))


def named_entries(name: str, value: Any) -> list[tuple[str, Any]]:
    """The arrays of a constant of springs, each with its name for messages; none of None."""
    if isinstance(value, EdgeField):
        return [(f"{name}.families[{i}]", entry) for i, entry in enumerate(value.families)]
    return [] if value is None else [(name, value)]


def _common_identity(*fields: EdgeField) -> NetIdentity | None:
    known = [field.identity for field in fields if field.identity is not None]
    for other in known[1:]:
        if not other.has_springs_of(known[0]):
            raise ValueError(
                f"Edge fields of two nets were combined: {known[0]}; and {other}. Entry by entry they are about different springs. "
                f"Make both with one net."
            )
    return known[0] if known else None


# Fields of several nets over the same nodes, or of one.
OfNets: TypeAlias = "EdgeField | tuple[EdgeField, ...] | None"


def fields_of(fields: OfNets) -> tuple[EdgeField, ...]:
    """As a tuple, whatever their number."""
    return () if fields is None else (fields,) if isinstance(fields, EdgeField) else fields


def field_of(net: Any, fields: OfNets) -> EdgeField | None:
    """The one that tells about the springs of this net, or None."""
    return next((field for field in fields_of(fields) if net.owns(field)), None)


def with_field(net: Any, fields: OfNets, field: EdgeField) -> OfNets:
    """The fields, where this one takes the place of the net's old one, or comes last."""
    others = fields_of(fields)
    if all(not net.owns(other) for other in others):
        others = (*others, field)
    new = tuple(field if net.owns(other) else other for other in others)
    return new[0] if len(new) == 1 else new


class AtEnds(EdgeField):
    """An edge field as `net_pull` reads it: on a graph with each spring's value at both of its ends too. Made by `net.at_ends`.

    Attributes:
        ends: the values at the entries of `ends.py`, class by class; none on a lattice.
    """

    ends: tuple[Any, ...] = ()

    def map(self, function: Callable[..., Any], *others: EdgeField) -> EdgeField:
        """As of an edge field; at the ends too, unless there are other fields."""
        plain = super().map(function, *others)
        return plain if others or not self.ends else AtEnds(plain.families, plain.identity, tuple(function(entry) for entry in self.ends))


class ZeroOutside(AtEnds):
    """The same, and zero at places that are kept for springs that do not exist: made by `net.vanishing`."""
