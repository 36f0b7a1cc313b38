"""What a factor keeps, worked out once on the host: `Envelope` for nodes, `Panels` for the unknowns of d coordinates.

The symmetric matrix is kept by rows of its lower triangle (the active columns of the upper one), B unknowns to a panel. All rows of a
panel begin where its longest does, and the panel ends with its B x B corner on the diagonal:

            columns     first ... start-1 | start ... start+B-1
    panel   B rows    [      left         |      corner         ]

Panels lie side by side in one (B, total) array, so that what is stored is the profile but for the padding of panels. `d` coupled
coordinates of a node are d neighbouring unknowns.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from ..topology.permutation import Permutation

# Steps of a loop over panels cost microseconds each; panels of fewer rows than this are not worth theirs.
_SMALLEST_PANEL, _LARGEST_PANEL = 16, 48
# At most so many sizes of dense kernel are compiled for columns of different height; one more must save so much of the work, and columns
# that are all short are not worth the compile time.
_MOST_WIDTHS, _WORTH, _SHORT = 4, 0.1, 96


@dataclass(frozen=True)
class Profile:
    """How large a factor is, for each factor made.

    Attributes:
        entries: entries within the envelope, diagonal included.
        bandwidth: longest distance of an entry from the diagonal.
        stored: entries stored, panels' padding included.
        factor_work: multiply-adds of a factorisation, about: half the sum of squared heights.
        solve_work: multiply-adds of one right-hand side, about: twice the sum of heights.
    """

    entries: int
    bandwidth: int
    stored: int
    factor_work: int
    solve_work: int


class Envelope:
    """Where every node's column begins, for nodes in the order in which they are eliminated.

    Compared and hashed by content, so that it can be static under `jit`.

    Attributes:
        order: which node of the user's comes at each place.
        first: (N,) first place that each column reaches.
        block: rows of a panel as asked for; None chooses.
    """

    def __init__(self, places: np.ndarray, first: np.ndarray, block: int | None):
        self.order = Permutation(places)
        self.first = np.asarray(first, np.int64)
        self.block = block
        self._digest = hashlib.sha256(repr((self.order, block)).encode() + self.order.order.tobytes() + self.first.tobytes()).hexdigest()
        self._panels: dict[int, Panels] = {}

    def __hash__(self) -> int:
        return hash(self._digest)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Envelope) and self._digest == other._digest)

    def __repr__(self) -> str:
        return f"Envelope(nodes={len(self.first)})"

    def panels(self, coupled: int) -> Panels:
        """The panels for `coupled` unknowns per node."""
        if coupled not in self._panels:
            self._panels[coupled] = Panels(self.first, coupled, self.block)
        return self._panels[coupled]

    def profile(self, coupled: int) -> Profile:
        """Counts for `coupled` unknowns per node."""
        heights = np.arange(len(self.first)) - self.first
        unknowns = (coupled * heights[:, None] + np.arange(coupled)).ravel()
        panels = self.panels(coupled)
        return Profile(
            entries=int(np.sum(unknowns + 1)),
            bandwidth=int(unknowns.max()),
            stored=panels.size * panels.total,
            factor_work=int(np.sum(unknowns**2)) // 2,
            solve_work=2 * int(np.sum(unknowns)),
        )


class Panels:
    """Where each panel lies in storage, and which dense kernel it takes.

    Attributes:
        coupled: unknowns per node d.
        n: unknowns N d.
        size: rows of a panel B, a multiple of d.
        count: number of panels.
        active: (count,) columns that each panel keeps left of its corner.
        ends: (count,) where each panel ends in storage.
        total: columns of storage; the first `width` are zero, so that a window never begins before them.
        width: the most columns any panel keeps left of its corner, as a multiple of B.
        widths: the sizes of the dense kernels, ascending; the last is `width`.
        kinds: (count,) which of them each panel takes.
    """

    def __init__(self, first: np.ndarray, coupled: int, block: int | None):
        self.coupled = coupled
        self.n = coupled * len(first)
        self.size = _panel_size(first, coupled, block)
        self.count = -(-self.n // self.size)
        starts = np.arange(self.count) * self.size
        unknown_first = np.full(self.count * self.size, self.n)
        unknown_first[: self.n] = np.repeat(coupled * first, coupled)
        self.active = np.maximum(starts - unknown_first.reshape(self.count, self.size).min(axis=1), 0).astype(np.int32)
        multiples = np.maximum(-(-self.active // self.size), 1) * self.size
        self.width = int(multiples.max())
        self.widths = _kernel_widths(multiples)
        self.kinds = np.searchsorted(self.widths, multiples).astype(np.int32)
        ends = self.width + np.cumsum(self.active.astype(np.int64) + self.size)
        self.total = int(ends[-1])
        if self.size * self.total > np.iinfo(np.int32).max:
            raise ValueError(
                f"The envelope holds {self.size * self.total:,} entries, more than 32-bit addresses reach. Use conjugate gradients for a "
                f"net of this size."
            )
        self.ends = ends.astype(np.int32)

    @property
    def padded(self) -> int:
        """Unknowns with those that fill the last panel."""
        return self.count * self.size

    def address(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Flat places in the (B, total) storage of entries of the lower triangle (rows >= columns) within the envelope."""
        panel = rows // self.size
        place = self.ends[panel] - ((panel + 1) * self.size - columns)
        return ((rows % self.size) * self.total + place).astype(np.int32)


def _panel_size(first: np.ndarray, coupled: int, block: int | None) -> int:
    """Rows of a panel: as asked, else a quarter of the usual height, within limits; no more than there are unknowns."""
    height = coupled * float(np.sqrt(np.mean((np.arange(len(first)) - first) ** 2.0)))
    wanted = min(max(height / 4, _SMALLEST_PANEL), _LARGEST_PANEL) if block is None else block
    return coupled * min(max(round(wanted / coupled), 1), len(first))


def _kernel_widths(needed: np.ndarray) -> tuple[int, ...]:
    """A few sizes of kernel, each column taking the smallest that serves it; greedily, while the work (size^2) falls enough."""
    candidates = [int(w) for w in np.unique(needed)]
    chosen = [candidates[-1]]

    def work(widths: list[int]) -> float:
        ladder = np.sort(widths)
        return float(np.sum(ladder[np.searchsorted(ladder, needed)] ** 2.0))

    while len(chosen) < _MOST_WIDTHS and chosen[0] > _SHORT:
        rest = [w for w in candidates if w not in chosen]
        best = min(rest, key=lambda w: work([*chosen, w]), default=None)
        if best is None or work([*chosen, best]) > (1 - _WORTH) * work(chosen):
            break
        chosen.append(best)
    return tuple(sorted(chosen))


__all__ = ["Envelope", "Panels", "Profile"]
