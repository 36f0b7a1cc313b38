"""What a surface of triangles is, before forces act on it: pieces, holes, sides that more than two triangles share, winding.

Each triangle (a, b, c) runs along its sides a b, b c and c a. Two that share a side are wound alike where they run along it in opposite
directions. Every triangle stands twice in a graph, as it is and turned over; a shared side joins those that are wound alike. A
triangle and its own other side in one piece of that graph is a surface with one side, such as a Moebius strip.

Source: the double cover of a surface, by which it can be oriented if and only if the cover of a piece falls in two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .._arrays import Numbers, on_host
from .._checks import finite, triangle_indices
from .base import Topology
from .builders import from_triangles
from .graph import Graph
from .lattice import Lattice

# Twice the area of a triangle over its longest side squared, below which it counts as flat.
FLAT = 1e-12


def runs(triangles: np.ndarray) -> np.ndarray:
    """(3 T, 2) the sides along which triangles run, corner after corner: a b of all triangles, then b c, then c a."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)


class Sides:
    """The sides of T triangles.

    Attributes:
        pairs: (S, 2) nodes of each distinct side, the lower first, sorted.
        of: (3 T,) number of the side along which each triangle runs, corner after corner: a b of all triangles, then b c, then c a.
        up: (3 T,) whether it runs from the lower node to the higher.
        counts: (S,) triangles at each side.
    """

    def __init__(self, triangles: np.ndarray):
        run = runs(triangles)
        self.up = run[:, 0] < run[:, 1]
        self.pairs, self.of, self.counts = np.unique(np.sort(run, axis=1), axis=0, return_inverse=True, return_counts=True)
        self.of = self.of.ravel()
        self._n_triangles = len(triangles)

    def shared(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """For each side of two triangles: its number, both triangles, and whether they are wound alike."""
        order = np.argsort(self.of, kind="stable")
        first = order[np.searchsorted(self.of[order], np.flatnonzero(self.counts == 2))]
        second = order[np.searchsorted(self.of[order], np.flatnonzero(self.counts == 2)) + 1]
        n = self._n_triangles
        return np.flatnonzero(self.counts == 2), first % n, second % n, self.up[first] != self.up[second]

    def where(self, side: int) -> str:
        """The nodes of a side and the triangles at it, for messages."""
        n = self._n_triangles
        at = sorted(int(i) % n for i in np.flatnonzero(self.of == side))
        return f"the side between nodes {int(self.pairs[side, 0])} and {int(self.pairs[side, 1])} (triangles {', '.join(map(str, at))})"


@dataclass(frozen=True)
class MeshReport:
    """What `examine` found in a mesh of triangles. Node and triangle numbers are the user's.

    Attributes:
        n_triangles: how many.
        n_pieces: that hang together by sides of triangles.
        n_holes: closed lines along which the surface ends: 0 where it is closed.
        is_wound: whether all triangles that share a side are wound alike.
        has_two_sides: whether they can be: not so on a Moebius strip.
        crowded: (K, 2) sides that more than two triangles share.
        unused: nodes of no triangle.
        doubled: (K, 2) pairs of nodes at one place.
        flat: triangles without area.
        least_angle: the smallest of all triangles [degrees]; 0 where one is flat.
        volumes: [m^3] enclosed by each piece, negative where it is wound inward; NaN where it is open or not wound alike.
    """

    n_triangles: int
    n_pieces: int
    n_holes: int
    is_wound: bool
    has_two_sides: bool
    crowded: np.ndarray
    unused: np.ndarray
    doubled: np.ndarray
    flat: np.ndarray
    least_angle: float
    volumes: np.ndarray

    @property
    def is_closed(self) -> bool:
        """Whether every side has exactly two triangles."""
        return self.n_holes == 0 and not len(self.crowded)

    def __str__(self) -> str:
        """A line for each finding."""
        lines = [f"{self.n_triangles} triangles, {self.n_pieces} pieces, {self.n_holes} holes, least angle {self.least_angle:.3g} degrees"]
        if not self.has_two_sides:
            lines.append("a surface with one side: no winding fits it")
        elif not self.is_wound:
            lines.append("neighbours are wound against each other")
        named = {
            "sides of more than two triangles": self.crowded,
            "nodes of no triangle": self.unused,
            "pairs of nodes at one place": self.doubled,
            "triangles without area": self.flat,
        }
        lines += [f"{len(found)} {what}, first {found[0].tolist()}" for what, found in named.items() if len(found)]
        return "\n".join(lines)


def examine(net: Topology, points: Numbers, triangles: Numbers | None = None) -> MeshReport:
    """Look a mesh over before forces act on it.

    Springs act on any mesh, `Air` on any triangles. Hinges want sides of at most two triangles; `Pressure` wants a closed surface wound
    outward. `from_mesh` merges vertices at one place, drops those not used, and cuts faces of more corners into triangles.

    Args:
        net: a net with triangles.
        points: (N, 3) positions [m].
        triangles: (T, 3) node numbers; None: those of the net.

    Returns:
        A `MeshReport`; `print` tells it in words.

    Raises:
        ValueError: no triangles, points of another shape.

    >>> net = from_triangles([(0, 1, 2), (1, 3, 2), (1, 2, 4)], 5)
    >>> print(examine(net, [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (1, 1, 1)]))
    3 triangles, 1 pieces, 1 holes, least angle 45 degrees
    1 sides of more than two triangles, first [1, 2]
    """
    corners = triangles_of(net, triangles)
    places = _places(net, points)
    sides = Sides(corners)
    piece = pieces(sides, len(corners))
    two_sided, _ = winding(corners, sides)
    _, one, _, alike = sides.shared()
    is_wound = bool(alike.all())
    lengths = np.stack([np.linalg.norm(places[corners[:, k - 1]] - places[corners[:, k - 2]], axis=1) for k in range(3)], axis=-1)
    twice = np.linalg.norm(np.cross(places[corners[:, 1]] - places[corners[:, 0]], places[corners[:, 2]] - places[corners[:, 0]]), axis=1)
    flat = twice <= FLAT * lengths.max(axis=1) ** 2
    # The smallest angle is the one across the shortest side.
    others = np.prod(np.sort(lengths, axis=1)[:, 1:], axis=1)
    sine = np.where(flat, 0.0, twice / np.where(flat, 1.0, others))
    _, first, inverse = np.unique(places + 0.0, axis=0, return_index=True, return_inverse=True)
    first = first[inverse.ravel()]
    later = np.flatnonzero(first != np.arange(len(places)))
    n_pieces = int(piece.max()) + 1
    has_no_volume = np.isin(np.arange(n_pieces), np.concatenate([piece[_at_border(sides, len(corners))], piece[one[~alike]]]))
    volumes = np.bincount(piece, signed_volumes(places, corners), n_pieces)
    return MeshReport(
        n_triangles=len(corners),
        n_pieces=n_pieces,
        n_holes=_n_borders(sides),
        is_wound=is_wound,
        has_two_sides=two_sided,
        crowded=sides.pairs[sides.counts > 2],
        unused=np.setdiff1d(np.arange(net.n_nodes), corners),
        doubled=np.stack([first[later], later], axis=-1),
        flat=np.flatnonzero(flat),
        least_angle=float(np.degrees(np.arcsin(np.clip(sine.min(), 0.0, 1.0)))),
        volumes=np.where(has_no_volume, np.nan, volumes),
    )


def rewound(net: Graph, points: Numbers) -> Graph:
    """The same nodes and triangles, neighbours wound alike: as the first triangle of each piece, or outward where a piece is closed.

    Args:
        net: a net of triangles with springs along their sides, as `from_triangles` and `from_mesh` make.
        points: (N, 3) positions [m].

    Returns:
        A `Graph` of the same nodes and sides.

    Raises:
        ValueError: a side that more than two triangles share, a surface with one side, such as a Moebius strip.

    >>> net = rewound(from_triangles([(0, 1, 2), (1, 2, 3)], 4), [(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)])
    >>> net.triangles.tolist()
    [[0, 1, 2], [3, 2, 1]]
    """
    corners, places = triangles_of(net, None), _places(net, points)
    sides = Sides(corners)
    refuse_crowded(sides)
    two_sided, turned = winding(corners, sides)
    if not two_sided:
        raise ValueError("the triangles make a surface with one side (a Moebius strip): no winding fits. Cut it along a line.")
    new = np.where(turned[:, None], corners[:, ::-1], corners)
    piece = pieces(sides, len(corners))
    is_open = np.bincount(piece[_at_border(sides, len(corners))], minlength=piece.max() + 1) > 0
    inward = (np.bincount(piece, signed_volumes(places, new)) < 0) & ~is_open
    return from_triangles(np.where(inward[piece][:, None], new[:, ::-1], new), net.n_nodes)


def triangles_of(net: Topology, triangles: Numbers | None) -> np.ndarray:
    """(T, 3) triangles as given, or those of the net; of a lattice in two dimensions, each square cut along its diagonal (1, 1).

    Raises:
        ValueError: none are given, and the net has none.
    """
    if triangles is not None:
        return triangle_indices("triangles", triangles, net.n_nodes)
    own: Any = getattr(net, "triangles", None)
    if own is not None:
        return np.asarray(own)
    if isinstance(net, Lattice) and len(net.shape) == 2 and min(net.shape) > 1:
        return np.concatenate(cut(net))
    raise ValueError("triangles is None, and the net has none of its own. Pass (T, 3) node numbers, or build it with from_triangles.")


def cut(net: Lattice, other: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Both triangles of each square of a sheet, counter-clockwise, cut along the diagonal (1, 1) or the `other` one."""
    n = np.arange(net.n_nodes).reshape(net.shape)
    grid = np.pad(n, [(0, int(wraps)) for wraps in net.periodic], mode="wrap")
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    if other:
        return np.stack([a, b, d], axis=-1), np.stack([b, c, d], axis=-1)
    return np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)


def refuse_crowded(sides: Sides) -> None:
    """Raise ValueError where more than two triangles share a side."""
    if (sides.counts > 2).any():
        side = int(np.argmax(sides.counts > 2))
        raise ValueError(f"{sides.where(side)} has {sides.counts[side]} triangles, so that no two of them are neighbours. Leave some out.")


def winding(triangles: np.ndarray, sides: Sides) -> tuple[bool, np.ndarray]:
    """Whether a winding fits, and (T,) which triangles to turn over so that each piece is wound as its first. Sides of two alone count."""
    _, one, two, alike = sides.shared()
    n = len(triangles)
    label = _components(np.concatenate([one, one + n]), np.where(alike, np.stack([two, two + n]), np.stack([two + n, two])).ravel(), 2 * n)
    up, down = label[:n], label[n:]
    # Of the two sheets of a piece, the one that holds its first triangle as it is.
    sheet = np.minimum(up, down)
    first = np.full(2 * n, -1)
    first[sheet[::-1]] = up[::-1]
    return bool((up != down).all()), up != first[sheet]


def pieces(sides: Sides, n_triangles: int) -> np.ndarray:
    """(T,) number of the piece that each triangle belongs to, by the sides that they share: 0 for the first."""
    label = _components(np.tile(np.arange(n_triangles), 3), n_triangles + sides.of, n_triangles + len(sides.pairs))[:n_triangles]
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse.ravel()]


def signed_volumes(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(T,) volume of the tetrahedron from the middle of all nodes to each triangle [m^3], positive where it is wound outward."""
    a, b, c = (points[triangles[:, k]] - points.mean(axis=0) for k in range(3))
    return np.einsum("td,td->t", a, np.cross(b, c)) / 6


def borders(triangles: np.ndarray) -> list[np.ndarray]:
    """The holes of a surface that is wound alike: nodes of each in order, such that triangles across it would be wound like the others.

    Raises:
        ValueError: two holes that meet at a node.
    """
    run = runs(triangles)
    sides = Sides(triangles)
    ends = run[sides.counts[sides.of] == 1]
    following = {int(b): int(a) for a, b in ends}
    if len(following) < len(ends):
        node = int(np.flatnonzero(np.bincount(ends[:, 1]) > 1)[0])
        raise ValueError(f"two holes meet at node {node}, so that no one cap closes either. Give the mesh a node for each.")
    loops = []
    while following:
        start, node = next(iter(following.items()))
        loop = [start]
        del following[start]
        while node != start:
            loop.append(node)
            node = following.pop(node)
        loops.append(np.array(loop))
    return loops


def _components(one: np.ndarray, other: np.ndarray, n: int) -> np.ndarray:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    return connected_components(coo_array((np.ones(len(one), np.int8), (one, other)), shape=(n, n)), directed=False)[1]


def _at_border(sides: Sides, n_triangles: int) -> np.ndarray:
    """Triangles with a side that is no other's, or of more than two."""
    return np.flatnonzero(sides.counts[sides.of] != 2) % n_triangles


def _n_borders(sides: Sides) -> int:
    """Closed lines along which the surface ends."""
    pairs = sides.pairs[sides.counts == 1]
    if not len(pairs):
        return 0
    label = _components(pairs[:, 0], pairs[:, 1], int(pairs.max()) + 1)
    return len(np.unique(label[pairs[:, 0]]))


def _places(net: Topology, points: Numbers) -> np.ndarray:
    places = on_host("points", points)
    if places.shape != (net.n_nodes, 3):
        raise ValueError(f"points has shape {places.shape}; expected ({net.n_nodes}, 3): a place in space for each node.")
    finite("points", places)
    return places


__all__ = [
    "MeshReport",
    "Sides",
    "borders",
    "cut",
    "examine",
    "pieces",
    "refuse_crowded",
    "rewound",
    "runs",
    "signed_volumes",
    "triangles_of",
    "winding",
]
