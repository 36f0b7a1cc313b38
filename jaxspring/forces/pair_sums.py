"""Derivatives of sums over pairs: sums over the same pairs, whose two ends know of each other, so that nothing is scattered either.

    sum           g_i = sum over j of g(i, j)
    tangent       sum over j of dg(i, j)/di t_i + dg(i, j)/dj t_j
    cotangent     sum over j of [dg(i, j)/di]' c_i + [dg(j, i)/di]' c_j
                  and for g(j, i) = +- g(i, j) the sum over j of [dg(i, j)/di]' (c_i +- c_j)

For this the pairs must be listed from both ends.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..numerics import linear_call
from ..topology.periods import nearest_image

# One array per coordinate or quantity.
Fields = tuple[Array, ...]


def difference(a: Fields, b: Fields, box: Array | None) -> Fields:
    """Per coordinate a - b, or its nearest image in a box of these periods."""
    d = tuple(p - q for p, q in zip(a, b, strict=True))
    return d if box is None else tuple(nearest_image(along, period) for along, period in zip(d, box, strict=True))


def squared_length(d: Fields) -> Array:
    """Sum of the squares of the coordinates."""
    squared = d[0] * d[0]
    for along in d[1:]:
        squared = squared + along * along
    return squared


@eqx.filter_custom_jvp
def summed(pairs: Any, function: Callable[..., Fields], sign: int | None, terms: Fields, fields: Fields, memory: Any) -> Fields:
    """`pairs.visit`, with derivatives: see `Pairs.sum`; `terms` are arrays here."""
    return pairs.visit(partial(function, terms), fields, memory)


@summed.def_jvp
def _summed_jvp(primals: Any, tangents: Any) -> tuple[Fields, Fields]:
    pairs, function, sign, terms, fields, memory = primals
    by_terms, by_fields = (tuple(i for i, t in enumerate(moved) if t is not None) for moved in tangents[3:5])
    operand = _picked(tangents[3], by_terms), _picked(tangents[4], by_fields)
    rule = (function, sign, by_terms, by_fields)
    tangent = linear_call(partial(_tangents, *rule), partial(_cotangents, *rule), (pairs, terms, fields, memory), operand)
    return summed(*primals), tangent


def _tangents(function: Any, sign: int | None, by_terms: Any, by_fields: Any, residuals: Any, operand: Any) -> Fields:
    """Sum of the pairs' tangents; what moves travels with the terms and the fields."""
    pairs, terms, fields, memory = residuals
    of_pair = partial(_tangent, function, by_terms, by_fields, len(terms), len(fields))
    return summed(pairs, of_pair, sign, (*terms, *operand[0]), (*fields, *operand[1]), memory)


def _tangent(
    function: Any, by_terms: Any, by_fields: Any, n_terms: int, n_fields: int, terms: Fields, own: Fields, other: Fields, distinct: Any
) -> Fields:
    def of(some_terms: Fields, some_own: Fields, some_other: Fields) -> Fields:
        ends = (_replaced(end[:n_fields], by_fields, some) for end, some in ((own, some_own), (other, some_other)))
        return function(_replaced(terms[:n_terms], by_terms, some_terms), *ends, distinct)

    at = (_picked(terms, by_terms), _picked(own, by_fields), _picked(other, by_fields))
    return jax.jvp(of, at, (terms[n_terms:], own[n_fields:], other[n_fields:]))[1]


def _cotangents(function: Any, sign: int | None, by_terms: Any, by_fields: Any, residuals: Any, weights: Fields) -> Any:
    """Cotangents of the terms that move, and of the fields."""
    pairs, terms, fields, memory = residuals

    def of_terms(some: Fields) -> Fields:
        return pairs.visit(partial(function, _replaced(terms, by_terms, some)), fields, memory)

    (to_terms,) = jax.vjp(of_terms, _picked(terms, by_terms))[1](weights) if by_terms else ((),)
    of_pair = partial(_cotangent, function, sign, by_fields, len(fields))
    to_fields = summed(pairs, of_pair, None, terms, (*fields, *weights), memory) if by_fields else ()
    return to_terms, to_fields


def _cotangent(
    function: Any, sign: int | None, by_fields: Any, n_fields: int, terms: Fields, own: Fields, other: Fields, distinct: Any
) -> Fields:
    shape = jnp.broadcast_shapes(own[0].shape, other[0].shape)
    own, other = (tuple(jnp.broadcast_to(a, shape) for a in end) for end in (own, other))
    here, there = own[:n_fields], other[:n_fields]

    def pulled(values: Callable[[Fields], Fields], weights: Fields) -> Fields:
        def spread(some: Fields) -> Fields:
            return tuple(jnp.broadcast_to(value, shape) for value in values(_replaced(here, by_fields, some)))

        return jax.vjp(spread, _picked(here, by_fields))[1](weights)[0]

    def as_own(end: Fields) -> Fields:
        return function(terms, end, there, distinct)

    def as_other(end: Fields) -> Fields:
        return function(terms, there, end, distinct)

    if sign is not None:
        return pulled(as_own, tuple(a + sign * b for a, b in zip(own[n_fields:], other[n_fields:], strict=True)))
    ends = pulled(as_own, own[n_fields:]), pulled(as_other, other[n_fields:])
    return tuple(a + b for a, b in zip(*ends, strict=True))


def _picked(values: Any, which: tuple[int, ...]) -> Fields:
    return tuple(values[i] for i in which)


def _replaced(values: Fields, which: tuple[int, ...], some: Fields) -> Fields:
    changed = dict(zip(which, some, strict=True))
    return tuple(changed.get(i, value) for i, value in enumerate(values))
