"""The mesh that follows from a set of split triangles: levels, midpoints, closure, and the stiffness of its sides. See `refine`.

Numbers: child c of triangle t of one level is triangle 4 t + c of the next, corners first, the middle last. A node is known by its
barycentric coordinates in the first mesh, in whole numbers, so that meshes made by other ways agree on which node is which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Barycentric coordinates are whole numbers of this unit: so many levels can be told apart.
UNIT = 1 << 24
SIDES = ((0, 1), (1, 2), (2, 0))
# A pair of nodes as one number.
WIDE = 1 << 31


@dataclass(frozen=True)
class Level:
    """Triangles of one level.

    Attributes:
        numbers: (M,) of the triangles.
        corners: (M, 3) their nodes.
        is_red: (M,) which are split.
        middles: (M, 3) midpoint node of each side; -1 where the side is whole.
    """

    numbers: np.ndarray
    corners: np.ndarray
    is_red: np.ndarray
    middles: np.ndarray


@dataclass(frozen=True)
class Built:
    """A mesh made from the triangles that are split.

    Attributes:
        levels: from the first mesh on.
        nodes: (N, 6) each node as (node, node, node, share, share, share) of the first mesh, empty places -1.
        parents: (N, 2) the ends that each midpoint lies between; a node of the first mesh twice itself.
        starts: first node of each level's midpoints, and N.
        pairs, between: sides that are split, as sorted numbers, and their midpoints.
    """

    levels: tuple[Level, ...]
    nodes: np.ndarray
    parents: np.ndarray
    starts: tuple[int, ...]
    pairs: np.ndarray
    between: np.ndarray

    @staticmethod
    def of(roots: np.ndarray, n_roots: int, red: list[np.ndarray]) -> Built:
        """From the numbers of the red triangles of each level."""
        index = np.arange(n_roots)
        empty = np.full((n_roots, 2), -1)
        nodes = np.column_stack([index, empty, np.full(n_roots, UNIT), np.zeros((n_roots, 2), int)])
        parents, starts = np.stack([index, index], axis=-1), [n_roots]
        pairs, between = np.zeros(0, np.int64), np.zeros(0, np.int64)
        numbers, corners, found = np.arange(len(roots), dtype=np.int64), roots.astype(np.int64), []
        for chosen in [*red, np.zeros(0, np.int64)]:
            is_red = np.isin(numbers, chosen)
            new = np.unique(_keys(sides_of(corners[is_red])))
            ends = np.stack([new // WIDE, new % WIDE], axis=-1)
            pairs, between = np.concatenate([pairs, new]), np.concatenate([between, len(nodes) + np.arange(len(new))])
            nodes = np.concatenate([nodes, _midway(nodes[ends[:, 0]], nodes[ends[:, 1]])])
            parents = np.concatenate([parents, ends])
            starts.append(len(nodes))
            found.append((numbers, corners, is_red))
            order = np.argsort(pairs)
            pairs, between = pairs[order], between[order]
            middles = look_up(pairs, between, _keys(sides_of(corners[is_red])))
            numbers = (4 * numbers[is_red][:, None] + np.arange(4)).ravel()
            corners = children(corners[is_red], middles).reshape(-1, 3)
            if not len(numbers):
                break
        levels = tuple(Level(n, c, r, look_up(pairs, between, _keys(sides_of(c)))) for n, c, r in found)
        return Built(levels, nodes, parents, tuple(starts), pairs, between)

    @staticmethod
    def closed(roots: np.ndarray, n_roots: int, red: tuple[np.ndarray, ...]) -> Built:
        """With all that must be split as well, so that no triangle has more than one split side, once."""
        split = list(red)
        while True:
            built = Built.of(roots, n_roots, split)
            missing = built._missing()
            if not any(map(len, missing)):
                return built
            split += [np.zeros(0, np.int64)] * (len(missing) - len(split))
            split = [np.union1d(old, new) for old, new in zip(split, missing, strict=True)]

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.nodes)

    @property
    def red(self) -> tuple[np.ndarray, ...]:
        """Numbers of the red triangles of each level."""
        return tuple(level.numbers[level.is_red] for level in self.levels)

    def leaves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(T, 3) triangles of the mesh, those with a split side bisected; (T,) level and (T,) number of what each is or is half of."""
        triangles, level_of, number_of = [], [], []
        for i, level in enumerate(self.levels):
            leaf = ~level.is_red
            corners, middles, numbers = level.corners[leaf], level.middles[leaf], level.numbers[leaf]
            cut = middles >= 0
            is_green = cut.any(axis=1)
            side = np.argmax(cut[is_green], axis=1)
            rows = np.arange(len(side))
            p, q, r = (corners[is_green][rows, (side + k) % 3] for k in range(3))
            m = middles[is_green][rows, side]
            parts = np.concatenate([corners[~is_green], np.stack([p, m, r], axis=-1), np.stack([m, q, r], axis=-1)])
            own = np.concatenate([numbers[~is_green], numbers[is_green], numbers[is_green]])
            order = np.argsort(own, kind="stable")
            triangles.append(parts[order])
            number_of.append(own[order])
            level_of.append(np.full(len(own), i))
        return np.concatenate(triangles).astype(np.int32), np.concatenate(level_of), np.concatenate(number_of)

    def stiffness(self, edges: np.ndarray, kappa: np.ndarray, older: tuple[np.ndarray, ...], s: float) -> np.ndarray:
        """(E,) stiffness of sorted springs, from (R, 3) half-weights of the first mesh; what is not red in `older` is split at `s`."""
        total, keys = np.zeros(len(edges)), _keys(edges)
        for i, level in enumerate(self.levels):
            leaf = ~level.is_red
            sides, middle, k = sides_of(level.corners[leaf]).reshape(-1, 2), level.middles[leaf].ravel(), kappa[leaf].ravel()
            whole = middle < 0
            np.add.at(total, np.searchsorted(keys, _keys(sides[whole])), k[whole])
            for end in range(2):
                # Each half of a split side is twice as stiff as the whole of it.
                halves = np.stack([sides[~whole, end], middle[~whole]], axis=-1)
                np.add.at(total, np.searchsorted(keys, _keys(halves)), 2 * k[~whole])
            before = older[i] if i < len(older) else np.zeros(0, np.int64)
            own = np.where(np.isin(level.numbers[level.is_red], before), 1.0, s)[:, None]
            red = kappa[level.is_red]
            outer, inner = (2 - own) * red, own * red
            # Corner parts (a, ab, ca), (ab, b, bc), (ca, bc, c) and the middle (bc, ca, ab); an inner side belongs to two of them.
            parts = (
                (outer[:, 0], inner[:, 1], outer[:, 2]),
                (outer[:, 0], outer[:, 1], inner[:, 2]),
                (inner[:, 0], outer[:, 1], outer[:, 2]),
                (inner[:, 0], inner[:, 1], inner[:, 2]),
            )
            kappa = np.stack([np.stack(part, axis=-1) for part in parts], axis=1).reshape(-1, 3)
        return total

    def _missing(self) -> list[np.ndarray]:
        """Triangles of each level that are not split but must be: of two split sides, or of one that is split twice."""
        found = []
        for level in self.levels:
            cut = (level.middles >= 0) & ~level.is_red[:, None]
            twice = np.zeros(len(cut), bool)
            for i, (a, b) in enumerate(SIDES):
                for end in (a, b):
                    half = _keys(np.stack([level.corners[:, end], np.maximum(level.middles[:, i], 0)], axis=-1))
                    twice |= cut[:, i] & (look_up(self.pairs, self.between, half) >= 0)
            found.append(level.numbers[(cut.sum(axis=1) > 1) | twice])
        return found


def children(corners: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """(M, 4, 3) the parts of red triangles, wound as they are."""
    (a, b, c), (ab, bc, ca) = corners.T, middles.T
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab))
    return np.stack([np.stack(part, axis=-1) for part in parts], axis=1)


def sides_of(corners: np.ndarray) -> np.ndarray:
    """(M, 3, 2) nodes of the sides a b, b c, c a."""
    return np.stack([corners[:, side] for side in SIDES], axis=1)


def look_up(keys: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The value of each key, -1 where there is none."""
    if not len(keys):
        return np.full(wanted.shape, -1)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.where(keys[place] == wanted, values[place], -1)


def _keys(pairs: np.ndarray) -> np.ndarray:
    """(..., 2) nodes as one number, the lower first."""
    ordered = np.sort(pairs, axis=-1).astype(np.int64)
    return ordered[..., 0] * WIDE + ordered[..., 1]


def _midway(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Barycentric coordinates of the midpoints: all lie in one triangle of the first mesh, so three places are enough."""
    node, share = np.concatenate([one[:, :3], other[:, :3]], axis=1), np.concatenate([one[:, 3:], other[:, 3:]], axis=1) // 2
    order = np.argsort(node, axis=1, kind="stable")
    node, share = np.take_along_axis(node, order, axis=1), np.take_along_axis(share, order, axis=1)
    for i in range(1, 6):
        same = (node[:, i] == node[:, i - 1]) & (node[:, i] >= 0)
        share[:, i] += np.where(same, share[:, i - 1], 0)
        node[same, i - 1], share[same, i - 1] = -1, 0
    order = np.argsort(-node, axis=1, kind="stable")[:, :3]
    return np.concatenate([np.take_along_axis(node, order, axis=1), np.take_along_axis(share, order, axis=1)], axis=1)


__all__ = ["SIDES", "Built", "Level", "children", "look_up", "sides_of"]
