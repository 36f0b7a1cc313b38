"""Who is near whom, in arrays of fixed size: particles sorted by cell, and a table of neighbours.

    cell          floor(x / edge) modulo the grid, one number per particle: the grid wraps, so that space needs no bounds
    candidates    for each cell, the particles of the 3**D cells around it, one after the other (Q, cells)
    bits          for each particle, which candidates are nearer than the edge, 32 to a word (Q/32, N)
    table         the candidates whose bits are set, one bit of every particle at a time (K, N); empty places hold N

Along a coordinate with a period there are whole cells, no narrower than the edge, and the last one's neighbour is the first one.

The bits make the table without a scatter or a sort of N Q entries. A cell far away that the wrap puts at the same number only adds
candidates; distances decide.
"""

from __future__ import annotations

import itertools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .pair_sums import Fields, difference, squared_length

WORD = 32
# Particles per cell for which the grid is made; a liquid has about 15 where its cells are as wide as the cut-off.
PER_CELL = 8
# Volume of the 3**D cells around a particle over that of the ball inside: candidates per neighbour in a uniform fluid.
CANDIDATES_PER_NEIGHBOUR = {1: 1.5, 2: 9 / np.pi, 3: 27 * 3 / (4 * np.pi)}
# By what factor cells that fill a period whole may be wider than the edge: at most four cells' width is split into three.
WIDER = 4 / 3


class Neighbourhood(eqx.Module):
    """Which particles are near each other.

    Attributes:
        order: (N,) particle at each place, sorted by cell.
        place: (N,) place of each particle: the inverse of `order`.
        table: (K, N) places of the neighbours of the particle at each place; N where there is none.
        needed: capacity that holds all neighbours and candidates.
    """

    order: Array
    place: Array
    table: Array
    needed: Array


def find_neighbours(position: Fields, edge: Array, capacity: int, box: Array | None = None) -> Neighbourhood:
    """All pairs nearer than `edge` [m], up to `capacity` for each particle; `needed` tells whether that was enough.

    In a box of periods (D,) [m] a pair is as near as its nearest image.
    """
    n, dim = position[0].shape[0], len(position)
    per_axis = max(3, round((n / PER_CELL) ** (1 / dim)))
    ratio = CANDIDATES_PER_NEIGHBOUR[dim] * (1 if box is None else WIDER**dim)
    n_words = -(-min(int(np.ceil(ratio * capacity)), n if box is not None else np.iinfo(int).max) // WORD)
    counts = (per_axis,) * dim if box is None else tuple(_whole_cells(period, edge, per_axis) for period in box)
    cells, order = _sorted_cells(position, edge, per_axis, counts, box)
    place = jnp.zeros(n, jnp.int32).at[order].set(jnp.arange(n, dtype=jnp.int32), unique_indices=True)
    candidates, most = _candidates(cells, per_axis, counts, n_words * WORD)
    # A place N, far from everything, for candidates that are none.
    far = jnp.asarray(jnp.finfo(position[0].dtype).max, position[0].dtype)
    sorted_positions = tuple(jnp.append(a[order], far) for a in position)
    bits = _near_bits(sorted_positions, cells, candidates, most, edge, box)
    table, count = _table(bits, cells, candidates, capacity)
    room = n_words * WORD
    by_candidates = jnp.where(most > room, jnp.ceil(most.astype(jnp.float32) / ratio).astype(jnp.int32), 0)
    return Neighbourhood(order, place, table, jnp.maximum(jnp.max(count, initial=0), by_candidates))


def _whole_cells(period: Array, edge: Array, per_axis: int) -> Array:
    """How many cells there are along a coordinate: as many as fit into a period, the cells of the table where there is none."""
    whole = jnp.clip(jnp.floor(period.astype(edge.dtype) / edge), 1, per_axis).astype(jnp.int32)
    return jnp.where(period > 0, whole, per_axis)


def _sorted_cells(position: Fields, edge: Array, per_axis: int, counts: tuple[Any, ...], box: Array | None) -> tuple[Array, Array]:
    """(N,) cell numbers in rising order, and the particle at each place."""
    cell = jnp.zeros(position[0].shape, jnp.int32)
    for i, (a, count) in enumerate(zip(position, counts, strict=True)):
        width = edge
        if box is not None:
            period = box[i].astype(a.dtype)
            width = jnp.where(period > 0, period / count.astype(a.dtype), edge)
            count = count.astype(a.dtype)
        # The remainder is taken before the conversion: coordinates may be larger than an int32.
        along = jnp.mod(jnp.floor(a / width), count).astype(jnp.int32)
        cell = cell * per_axis + jnp.clip(along, 0, per_axis - 1)
    n = cell.shape[0]
    if per_axis ** len(position) * n < 2**32:
        # Cell and particle in one number: one array is sorted four times as fast as two.
        both = lax.sort(cell.astype(jnp.uint32) * np.uint32(n) + jnp.arange(n, dtype=jnp.uint32))
        return (both // np.uint32(n)).astype(jnp.int32), (both % np.uint32(n)).astype(jnp.int32)
    cells, order = lax.sort((cell, jnp.arange(n, dtype=jnp.int32)), num_keys=1)
    return cells, order


def _candidates(cells: Array, per_axis: int, counts: tuple[Any, ...], room: int) -> tuple[Array, Array]:
    """(room, cells) places of the particles in the cells around each cell, N where there is none; and the largest number of them."""
    n_cells = per_axis ** len(counts)
    start = jnp.searchsorted(cells, jnp.arange(n_cells + 1, dtype=jnp.int32)).astype(jnp.int32)
    first_cell, last_cell = _runs_around(per_axis, counts)
    first = start[first_cell]
    count = start[last_cell] - first
    end = jnp.cumsum(count, axis=0, dtype=jnp.int32)
    # Slot q lies in the range of which the ends of all earlier ones are at most q: its place is q plus that range's shift.
    shift = first - (end - count)
    slot = jnp.arange(room, dtype=jnp.int32)[:, None]
    place = slot + shift[0][None]
    for i in range(1, first.shape[0]):
        place = jnp.where(slot >= end[i - 1][None], slot + shift[i][None], place)
    n = jnp.asarray(cells.shape[0], jnp.int32)
    return jnp.where(slot < end[-1][None], place, n), jnp.max(end[-1])


def _near_bits(position: Fields, cells: Array, candidates: Array, most: Array, edge: Array, box: Array | None) -> Array:
    """(words, N) one bit per candidate: nearer than `edge`, and another particle."""
    n = cells.shape[0]
    n_words = candidates.shape[0] // WORD
    own = tuple(a[:n] for a in position)
    numbers = jnp.arange(n, dtype=jnp.int32)

    def near(j: Array) -> Array:
        other = tuple(whole.at[j].get(mode="promise_in_bounds") for whole in position)
        squared = squared_length(difference(own, other, box))
        return ((squared < edge * edge) & (j != numbers)).astype(jnp.uint32)

    # Eight candidates at a time: all 32 at once are no faster and compile much longer.
    def byte(b: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        block, bits = carry
        for i in range(8):
            candidate = block[8 * b + i].at[cells].get(mode="promise_in_bounds")
            bits = bits | (near(candidate) << (8 * b + i).astype(jnp.uint32))
        return block, bits

    def word(block: Array) -> Array:
        return lax.fori_loop(0, WORD // 8, byte, (block, jnp.zeros(n, jnp.uint32)))[1]

    blocks = candidates.reshape(n_words, WORD, candidates.shape[1])
    # Only as many words as some particle has candidates for: the loop's end is a value.
    used = jnp.minimum((most + WORD - 1) // WORD, n_words)
    return lax.fori_loop(0, used, lambda w, bits: bits.at[w].set(word(blocks[w])), jnp.zeros((n_words, n), jnp.uint32))


def _table(bits: Array, cells: Array, candidates: Array, capacity: int) -> tuple[Array, Array]:
    """(capacity, N) the candidates whose bits are set, in their order; and (N,) how many there are."""
    n_words, n = bits.shape
    numbers = jnp.arange(n, dtype=jnp.int32)
    count = jnp.sum(lax.population_count(bits).astype(jnp.int32), axis=0, dtype=jnp.int32)
    # The first word at or after each that has a bit; the last entry, past the end, is a word without bits.
    after = [jnp.full(n, n_words, jnp.int32)]
    for w in reversed(range(n_words)):
        after.append(jnp.where(bits[w] != 0, w, after[-1]))
    following = jnp.concatenate(after[::-1])
    words = jnp.append(bits.ravel(), jnp.zeros(n, jnp.uint32))

    def take(flat: Array, index: Array) -> Array:
        return flat.at[index].get(mode="promise_in_bounds")

    def next_bit(walk: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        """Take the lowest bit left of each particle's word; where it was the last one, go on to the next word that has any."""
        place, word = walk
        lowest = word & (~word + 1)
        bit = lax.population_count(lowest - 1).astype(jnp.int32)
        slot = (jnp.minimum(place, n_words - 1) * WORD + jnp.minimum(bit, WORD - 1)) * candidates.shape[1] + cells
        found = jnp.where(word != 0, take(candidates.ravel(), slot), jnp.asarray(n, jnp.int32))
        rest = word ^ lowest
        is_done = (rest == 0) & (place < n_words)
        place = jnp.where(is_done, take(following, jnp.minimum(place + 1, n_words) * n + numbers), place)
        return (place, jnp.where(is_done, take(words, place * n + numbers), rest)), found

    start = (after[-1], take(words, after[-1] * n + numbers))
    return lax.scan(next_bit, start, None, length=capacity)[1], count


def _runs_around(per_axis: int, counts: tuple[Any, ...]) -> tuple[Any, Any]:
    """(2 x 3**(D-1), cells) first number and last plus one of runs of cells with which the 3**D cells around each are numbered.

    Three neighbours along the last axis follow each other, but for one that the wrap puts at the other end: it is a run of its own. Where
    an axis has one or two cells, neighbours that are the same one are taken once.
    """
    dim = len(counts)
    where = [a.astype(np.int32) for a in np.unravel_index(np.arange(per_axis**dim), (per_axis,) * dim)]
    # Plain NumPy where the numbers of cells are known: the tables are then constants of the program.
    xp: Any = np if all(isinstance(count, int) for count in counts) else jnp
    last_count = counts[-1]
    # Numbers past the last cell name none; they are read as it, so that no run has a negative length.
    along = xp.minimum(where[-1], last_count - 1)
    wrapped = xp.where(along == 0, last_count - 1, 0)
    has_wrapped = ((along == 0) | (along == last_count - 1)) & (last_count > 2)
    first, last = [], []
    for offset in itertools.product((-1, 0, 1), repeat=dim - 1):
        row, is_new = np.zeros_like(where[-1]), True
        for coordinate, count, step in zip(where[:-1], counts[:-1], offset, strict=True):
            row = row * per_axis + (coordinate + step) % count
            # Of two cells the one below is the one above, and of one cell both are itself.
            is_new = is_new & ((step == 0) | (count > 2) | ((step == 1) & (count == 2)))
        start = row * per_axis + xp.maximum(along - 1, 0)
        first += [start, row * per_axis + wrapped]
        last += [xp.where(is_new, row * per_axis + xp.minimum(along + 1, last_count - 1) + 1, start)]
        last += [row * per_axis + wrapped + (has_wrapped & is_new).astype(np.int32)]
    return xp.stack(first).astype(np.int32), xp.stack(last).astype(np.int32)
