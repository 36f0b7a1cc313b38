"""Break lines: through which cells a break goes, where along each spring it is, and the lines that are drawn.

A line crosses springs and runs through the faces between them: the cells of a lattice, the triangles of a graph. Inside a triangle whose
corner A is cut off from B and C, the line is straight between its two crossings: in barycentric coordinates A's side is

    l_B / t_AB + l_C / t_AC < 1          t the share of the side, from A, at which it is crossed

Where an image is at hand, each crossing is put where two levels, one for each end of the spring, fit the image along it best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...topology.base import Topology
from ...topology.lattice import Lattice

# Readings of the image along a spring that is crossed, beyond both its ends by so many of its lengths.
READINGS, BEYOND = 33, 0.25


@dataclass(frozen=True)
class Faces:
    """The faces of a net and the springs around them.

    Attributes:
        sides: (F, S) springs around each face, one after the other.
        beside: (E, 2) faces at each spring; -1 for none.
        ring: (E,) springs of the border: those with a face on one side only.
    """

    sides: np.ndarray
    beside: np.ndarray
    ring: np.ndarray

    @staticmethod
    def of_corners(corners: np.ndarray, edges: np.ndarray, n_nodes: int) -> Faces:
        """From (F, S) nodes around each face and (E, 2) springs along all their sides."""
        keys = np.sort(edges, axis=1).astype(np.int64) @ [n_nodes, 1]
        order = np.argsort(keys, kind="stable")
        double = np.flatnonzero(np.diff(keys[order]) == 0)
        if len(double):
            i, j = order[double[0]], order[double[0] + 1]
            raise ValueError(f"springs {i} and {j} join the same nodes, {tuple(edges[i].tolist())}. Make them one, with both stiffnesses.")
        wanted = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1), axis=-1).astype(np.int64) @ [n_nodes, 1]
        place = np.minimum(np.searchsorted(keys[order], wanted), max(len(keys) - 1, 0))
        sides = order[place]
        if not np.array_equal(keys[sides], wanted):
            raise ValueError("a side of a face has no spring. Breaks need a chain, a lattice of structural springs, or from_triangles.")
        of = np.full((len(edges), 2), -1)
        for face, spring in zip(np.repeat(np.arange(len(sides)), sides.shape[1]), sides.ravel(), strict=True):
            if of[spring, 1] >= 0:
                raise ValueError(f"spring {spring}, {tuple(edges[spring].tolist())}, has more than two faces: no line can cross it.")
            of[spring, 0 if of[spring, 0] < 0 else 1] = face
        loose = np.flatnonzero(of[:, 0] < 0)
        if len(loose):
            i = loose[0]
            raise ValueError(f"spring {i}, {tuple(edges[i].tolist())}, is the side of no face. Leave out springs that are no sides.")
        return Faces(sides, of, of[:, 1] < 0)

    @staticmethod
    def of(net: Topology) -> Faces:
        """Of a chain (none), a lattice of structural springs, or a graph of triangles."""
        edges, corners = np.asarray(net.edges), getattr(net, "triangles", None)
        if isinstance(net, Lattice) and len(net.shape) == 1 and net.n_springs == net.n_nodes - 1:
            return Faces(np.zeros((0, 2), int), np.full((len(edges), 2), -1), np.zeros(len(edges), bool))
        if isinstance(net, Lattice) and len(net.shape) == 2:
            number = np.arange(net.n_nodes).reshape(net.shape)
            around = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
            corners = np.stack([a.ravel() for a in around], axis=-1)
        if corners is None:
            raise ValueError("this net has no faces. Breaks need a chain, a lattice of structural springs, or a graph of triangles.")
        return Faces.of_corners(np.asarray(corners), edges, net.n_nodes)

    def at(self, spring: int) -> list[int]:
        """The faces at a spring."""
        return [int(face) for face in self.beside[spring] if face >= 0]

    def springs(self, face: int) -> np.ndarray:
        """The springs around a face."""
        return self.sides[face]


def locate_breaks(image: Any, points: np.ndarray, edges: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """(E,) where each broken spring is crossed, from its tail (0) to its head (1): where two levels fit the image best; without one 1/2."""
    fraction = np.full(len(edges), 0.5)
    springs = np.flatnonzero(broken)
    if image is None or not len(springs) or points.shape[1] < 2:
        return fraction
    tail, head = points[edges[springs, 0]], points[edges[springs, 1]]
    share = np.linspace(-BEYOND, 1 + BEYOND, READINGS)
    places = tail[:, None] + share[None, :, None] * (head - tail)[:, None]
    read = np.asarray(image.sample(places[..., 0], places[..., 1]), np.float64)
    # The cut after reading m that leaves the least squared deviation from the mean on either side.
    n = np.arange(1, READINGS)
    sums, squares = np.cumsum(read, axis=1), np.cumsum(read**2, axis=1)
    left = squares[:, :-1] - sums[:, :-1] ** 2 / n
    right = (squares[:, -1:] - squares[:, :-1]) - (sums[:, -1:] - sums[:, :-1]) ** 2 / (READINGS - n)
    best = np.argmin(left + right, axis=1)
    between = 0.5 * (share[best] + share[best + 1])
    # A crossing stays off the nodes, so that each keeps a side of the triangle.
    fraction[springs] = np.clip(between, 0.02, 0.98)
    return fraction


def crossings(points: np.ndarray, edges: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """(E, 2) where each spring is crossed."""
    tail, head = points[edges[:, 0]], points[edges[:, 1]]
    return tail + fraction[:, None] * (head - tail)


def trace(faces: Faces, points: np.ndarray, edges: np.ndarray, broken: np.ndarray, fraction: np.ndarray) -> tuple[np.ndarray, ...]:
    """The break lines, (M, 2) points each: from crossing to crossing; where more than two meet in a face, through the face's middle."""
    if not broken.any() or points.shape[1] < 2:
        return ()
    places, joins = crossings(points, edges, fraction), {int(s): [] for s in np.flatnonzero(broken)}
    nodes: dict[int, np.ndarray] = {s: places[s] for s in joins}
    for face in np.unique(faces.beside[broken]):
        if face < 0:
            continue
        cut = [int(s) for s in faces.sides[face] if broken[s]]
        if len(cut) == 2:
            joins[cut[0]].append(cut[1])
            joins[cut[1]].append(cut[0])
        elif len(cut) > 2:
            middle = -1 - int(face)
            nodes[middle] = places[cut].mean(axis=0)
            joins[middle] = list(cut)
            for s in cut:
                joins[s].append(middle)
    lines, used = [], set()
    ends = sorted((s for s in joins if len(joins[s]) != 2), key=lambda s: (len(joins[s]) == 0, s))
    # Open lines from their ends first; what is left is closed.
    for start in (*ends, *joins):
        if not joins[start] and start not in used:
            tail, head = points[edges[start]]
            across = np.array([-(head - tail)[1], (head - tail)[0]]) / 2
            lines.append(np.stack([nodes[start] - across, nodes[start] + across]))
            used.add(start)
        for following in joins[start]:
            if (start, following) in used:
                continue
            path, here, there = [start], start, following
            while True:
                used |= {(here, there), (there, here)}
                path.append(there)
                onward = [s for s in joins[there] if (there, s) not in used]
                if len(joins[there]) != 2 or not onward:
                    break
                here, there = there, onward[0]
            lines.append(np.stack([nodes[s] for s in path]))
    return tuple(lines)


def length_of(lines: tuple[np.ndarray, ...]) -> float:
    """Length of all lines together [m]."""
    return math.fsum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in lines)


__all__ = ["Faces", "crossings", "length_of", "locate_breaks", "trace"]
