"""Sums over pairs of particles: for every particle i, the sum over all j of g(i, j).

`g` is evaluated twice per pair, once for each end, so that nothing is scattered: the result is the same bit for bit in every run, and the
two halves of an antisymmetric `g` cancel exactly. Derivatives: `pair_sums`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..status import Status
from .base import any_not_positive
from .pair_sums import Fields, summed

# (own fields, other's fields, whether the two are two; None: all are) -> values, all arrays that broadcast against each other.
PairFunction = Callable[[Fields, Fields, Array | None], Fields]

# Measured on a CPU: fewer rows vectorise less, more leave the cache.
ROWS_AT_A_TIME = 128


class Pairs(eqx.Module):
    """Which pairs are looked at. Abstract."""

    def sum(self, function: Callable[..., Fields], terms: Any, fields: Fields, memory: Any, sign: int | None = None) -> Fields:
        """For each particle the sum of `function(terms, own, other, distinct)` over the others: arrays (N,) from fields of shape (N,).

        Args:
            function: see `visit`; it must close over no traced value.
            terms: what it needs besides: a pytree that may be differentiated by.
            fields: what the particles have.
            memory: what `ready` gave.
            sign: 1 where exchanging the two particles leaves the values, -1 where it turns their sign, None where it does neither.
        """
        arrays, static = eqx.partition(terms, eqx.is_array)
        leaves, tree = jax.tree.flatten(arrays)
        return summed(self, partial(_of_leaves, function, static, tree), sign, tuple(leaves), fields, memory)

    @abc.abstractmethod
    def visit(self, function: PairFunction, fields: Fields, memory: Any) -> Fields:
        """For each particle the sum of `function` over the others; derivatives are up to `sum`.

        A place that holds no pair is passed with own = other, and is False in the last argument; or, where that is None, with another
        particle so far away that the law has no force there.
        """

    @property
    def needs_reach(self) -> bool:
        """Whether the law must have a cut-off."""
        return False

    # The periods `box` (D,) [m] are passed to the four that follow only where the system's net has some.

    def begin(self, position: tuple[Array, ...], reach: Array | None, box: Array | None = None) -> Any:
        """What is remembered between steps, made from the positions; None where nothing is."""
        return None

    def keep(self, memory: Any, position: tuple[Array, ...], reach: Array | None, box: Array | None = None) -> Any:
        """The memory at the start of another run: as it is where it serves these positions, else new."""
        return memory

    def ready(self, memory: Any, position: tuple[Array, ...], reach: Array | None, box: Array | None = None) -> Any:
        """The memory as `visit` takes it, at these positions; `memory` is None in a state that has not begun."""
        return memory

    def update(
        self, memory: Any, before: tuple[Array, ...], position: tuple[Array, ...], reach: Array | None, box: Array | None = None
    ) -> tuple[Any, Status]:
        """The memory after a step from `before` to `position`."""
        return memory, Status.ok()

    def needed(self, memory: Any) -> Array | None:
        """Capacity that the memory would need where it is too small, else 0; None where nothing is remembered."""
        return None

    def invalid(self) -> Array | None:
        """Whether an array of it (a length, unless a subclass says otherwise) is not positive or not finite."""
        return any_not_positive(eqx.filter(self, eqx.is_array))


class AllPairs(Pairs):
    """Every pair, in tiles of rows, so that memory stays bounded: N**2 evaluations.

    Attributes:
        tile: rows at a time (static); None takes 128.
    """

    tile: int | None = eqx.field(static=True)

    def __init__(self, tile: int | None = None):
        if tile is not None and (not isinstance(tile, (int, np.integer)) or isinstance(tile, bool) or tile < 1):
            raise ValueError(f"tile = {tile!r}; expected a whole number of rows, 1 or more, or None.")
        self.tile = None if tile is None else int(tile)

    def visit(self, function: PairFunction, fields: Fields, memory: Any = None) -> Fields:
        """Sum over all others, a tile of rows at a time."""
        n = fields[0].shape[0]
        tile = max(1, min(n, ROWS_AT_A_TIME if self.tile is None else self.tile))
        n_tiles = -(-n // tile)
        everyone = tuple(a[:, None] for a in fields)
        numbers = jnp.arange(n, dtype=jnp.int32)

        # The sum runs down the columns, whose accumulators are the rows of the tile: that loop vectorises.
        def of_tile(rows: tuple[Array, Fields]) -> Fields:
            own_numbers, own = rows
            values = function(tuple(a[None, :] for a in own), everyone, own_numbers[None, :] != numbers[:, None])
            return tuple(jnp.sum(value, axis=0) for value in values)

        if n_tiles == 1:
            return of_tile((numbers, fields))

        def tiled(a: Array) -> Array:
            return jnp.pad(a, (0, n_tiles * tile - n)).reshape(n_tiles, tile)

        # Rematerialised, so that a gradient keeps no tile either.
        sums = jax.lax.map(jax.checkpoint(of_tile), jax.tree.map(tiled, (numbers, fields)))
        return tuple(a.reshape(n_tiles * tile)[:n] for a in sums)


def _of_leaves(function: Any, static: Any, tree: Any, leaves: Fields, own: Fields, other: Fields, distinct: Any) -> Fields:
    return function(eqx.combine(jax.tree.unflatten(tree, leaves), static), own, other, distinct)
