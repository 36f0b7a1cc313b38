"""Neighbour lists: the pairs within the cut-off and a skin, found now and then, and reused in between.

    listed      pairs nearer than edge = reach + skin
    rebuilt     when a particle may, after one more step twice as long as the last, have moved skin / 2 since the list was made
    trusted     while no particle has moved (edge - reach) / 2: no pair can then be within reach unlisted

Every sum looks whether the list can be trusted, so that no pair is ever left out: one that is too small (NEIGHBOUR_OVERFLOW tells the
capacity that is needed), or was made for other positions or a shorter reach, is not used, and the sum runs over all pairs, right but slow.

The list is made inside `jit`, under a conditional on the device. Derivatives pass through the positions, not through the list: a pair that
enters or leaves it has no force there.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant
from ..numerics import any_lane
from ..status import Flag, Status
from .cells import Neighbourhood, find_neighbours
from .pair_sums import Fields, difference, squared_length
from .pairs import AllPairs, PairFunction, Pairs

# Neighbours taken at a time: fewer write the sums more often; more make loops that XLA shares between cores though they are short.
SLOTS = 4


class NeighbourMemory(eqx.Module):
    """A list and the positions for which it was made.

    Attributes:
        near: who is near whom.
        reference: D arrays (N,) of positions [m] when it was made.
        edge: distance [m] below which pairs are listed.
        rebuilds: how often it was made anew.
        box: (D,) periods [m] for which it was made, or None.
    """

    near: Neighbourhood
    reference: Fields
    edge: Array
    rebuilds: Array
    box: Array | None = None

    def serves(self, position: Fields, reach: Array, box: Array | None = None) -> Array:
        """Whether every pair nearer than `reach` [m] at these positions is sure to be listed, room allowing."""
        is_near = 2 * _farthest(self.reference, position, box) <= self.edge - reach.astype(self.edge.dtype)
        return is_near if box is None or self.box is None else is_near & jnp.all(self.box == box.astype(self.box.dtype))


class TrustedList(eqx.Module):
    """A list as a sum takes it.

    Attributes:
        near: who is near whom.
        is_trusted: whether it holds every pair within reach.
        dim: number of coordinates (static).
    """

    near: Neighbourhood
    is_trusted: Array
    dim: int = eqx.field(static=True)


class NeighbourList(Pairs):
    """Pairs within the law's cut-off, from a list of fixed capacity.

    Attributes:
        capacity: neighbours of a particle within reach + skin for which there is room (static). Take a quarter more than the densest place
            has; NEIGHBOUR_OVERFLOW tells what is needed.
        skin: [m] by which the list reaches beyond the cut-off. A wider one is remade less often and holds more pairs.
    """

    capacity: int = eqx.field(static=True)
    skin: Array

    def __init__(self, capacity: int, skin: Numbers):
        if not isinstance(capacity, (int, np.integer)) or isinstance(capacity, bool) or capacity < 1:
            raise ValueError(f"capacity = {capacity!r}; expected a whole number of neighbours, 1 or more.")
        self.capacity = -(-int(capacity) // SLOTS) * SLOTS
        self.skin = constant("skin", skin, "The list would be out of date after any step.")

    @property
    def needs_reach(self) -> bool:
        """Whether the law must have a cut-off: a list holds the pairs within one."""
        return True

    def begin(self, position: Fields, reach: Array | None, box: Array | None = None) -> NeighbourMemory:
        """A list for these positions."""
        return self._made(position, reach, jnp.zeros((), jnp.int32), box)

    def keep(self, memory: NeighbourMemory, position: Fields, reach: Array | None, box: Array | None = None) -> NeighbourMemory:
        """The list where it serves these positions, else a new one."""
        fresh = jax.eval_shape(lambda: self.begin(position, reach, box))
        if jax.tree.structure(fresh) != jax.tree.structure(memory) or any(
            a.shape != b.shape or a.dtype != b.dtype for a, b in zip(jax.tree.leaves(fresh), jax.tree.leaves(memory), strict=True)
        ):
            return self.begin(position, reach, box)
        is_good = (memory.edge == self._edge(position, reach)) & memory.serves(position, _given(reach), box)
        return lax.cond(any_lane(~is_good), lambda _: self.begin(position, reach, box), lambda memory: memory, memory)

    def update(
        self, memory: NeighbourMemory, before: Fields, position: Fields, reach: Array | None, box: Array | None = None
    ) -> tuple[NeighbourMemory, Status]:
        """The list as it is, or made anew where a particle has moved far; DT_LIMIT where one step went farther than half the skin."""
        step, moved = _farthest(before, position, box), _farthest(memory.reference, position, box)
        is_stale = any_lane(2 * step + moved > self.skin / 2)

        def anew(memory: NeighbourMemory) -> NeighbourMemory:
            return self._made(position, reach, memory.rebuilds + 1, box)

        fresh = lax.cond(is_stale, anew, lambda memory: memory, memory)
        needed = fresh.near.needed
        status = Status.when(Flag.NEIGHBOUR_OVERFLOW, needed > self.capacity, count=needed)
        return fresh, status.then(Status.when(Flag.DT_LIMIT, step > self.skin / 2))

    def needed(self, memory: NeighbourMemory | None) -> Array:
        """Capacity needed where the list is too small, else 0."""
        if memory is None:
            return jnp.zeros((), jnp.int32)
        return jnp.where(memory.near.needed > memory.near.table.shape[0], memory.near.needed, 0)

    def ready(self, memory: NeighbourMemory | None, position: Fields, reach: Array | None, box: Array | None = None) -> TrustedList:
        """The list, and whether it can be trusted at these positions; a new one where there is none."""
        memory = self.begin(position, reach, box) if memory is None else memory
        is_trusted = memory.serves(position, _given(reach), box) & (self.needed(memory) == 0)
        return TrustedList(memory.near, is_trusted, len(position))

    def visit(self, function: PairFunction, fields: Fields, memory: TrustedList) -> Fields:
        """Sum over the listed pairs; over all pairs where the list cannot be trusted."""
        return lax.cond(
            any_lane(~memory.is_trusted),
            lambda fields, near: self.everyone().visit(function, fields),
            lambda fields, near: _sum_listed(function, fields, near, memory.dim),
            fields,
            memory.near,
        )

    def everyone(self) -> AllPairs:
        """All pairs, which are summed where the list cannot be trusted."""
        return AllPairs()

    def _made(self, position: Fields, reach: Array | None, rebuilds: Array, box: Array | None) -> NeighbourMemory:
        edge = self._edge(position, reach)
        periods = None if box is None else lax.stop_gradient(box.astype(edge.dtype))
        return NeighbourMemory(find_neighbours(position, edge, self.capacity, periods), position, edge, rebuilds, periods)

    def _edge(self, position: Fields, reach: Array | None) -> Array:
        dtype = position[0].dtype
        return lax.stop_gradient(_given(reach).astype(dtype) + self.skin.astype(dtype))


def _given(reach: Array | None) -> Array:
    if reach is None:
        raise ValueError("a neighbour list needs a law with a cut-off.")
    return lax.stop_gradient(reach)


def _sum_listed(function: PairFunction, fields: Fields, near: Neighbourhood, dim: int) -> Fields:
    """Sum over the table, some rows of all particles at a time, in the order of their cells, so that neighbours are near in memory."""
    own = tuple(a[near.order] for a in fields)
    n = own[0].shape[0]
    everyone = _packed(own, dim)

    def of_rows(places: Array) -> Fields:
        # All fields of a particle are read at once and used apart: both loops vectorise.
        found = everyone.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)
        return function(tuple(a[None] for a in own), tuple(found[..., i] for i in range(len(own))), None)

    # Rematerialised, so that a gradient keeps no pair.
    @jax.checkpoint
    def add_rows(total: Fields, places: Array) -> tuple[Fields, None]:
        values = of_rows(places)
        for i in range(SLOTS):
            total = tuple(t + value[i] for t, value in zip(total, values, strict=True))
        return total, None

    tables = near.table.reshape(-1, SLOTS, n)
    shapes = jax.eval_shape(of_rows, tables[0])
    start = tuple(jnp.zeros(n, s.dtype) for s in shapes)
    total, _ = lax.scan(add_rows, start, tables)
    return tuple(a[near.place] for a in total)


def _packed(fields: Fields, dim: int) -> Array:
    """(N + 1, F) all fields of a particle side by side, filled up to a power of two; the last one is far from everything.

    Empty places of the table point to it. The law's cut-off makes its pairs zero: no mask is needed.
    """
    n, dtype = fields[0].shape[0], fields[0].dtype
    width = 1 << (len(fields) - 1).bit_length()
    nothing = jnp.zeros(n, dtype)
    near = jnp.stack([*fields, *[nothing] * (width - len(fields))], axis=1)
    # Its square, and the sum of three, are still finite.
    far = np.sqrt(np.finfo(dtype).max) / 16
    return jnp.concatenate([near, jnp.asarray([far] * dim + [0] * (width - dim), dtype)[None]])


def _farthest(a: Fields, b: Fields, box: Array | None) -> Array:
    """Largest distance between two sets of positions [m]."""
    return jnp.sqrt(jnp.max(squared_length(difference(a, b, box)), initial=0))
