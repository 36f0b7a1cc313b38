"""Red-green subdivision of triangles, up and down, without moving the surface.

A red triangle is split into four at the midpoints of its sides. One whose neighbour is finer along one side is closed by a bisector, green;
along more sides, or by more than one level, it becomes red itself. Green triangles vanish before the next change, so angles stay those of
the first mesh and their bisections. The mesh follows from the set of triangles that were asked to be red, and from nothing else: taking
them out again gives the old mesh, node by node.

    a side's stiffness      k = the sum of kappa from its triangles
    split, 0 <= s <= 1      each half of side i   (2 - s) kappa_i from that triangle;  the inner side along i   2 s kappa_i
    a bisected triangle     each half of its split side 2 kappa_i, its bisector nothing

Then the energy of every linear field is the same for all s. At s = 0 the inner sides are slack and the new nodes rest at the midpoints: the
equilibrium is exactly that of the coarse mesh. At s = 1 stands the fine mesh of the same material. The stiffness is linear in s: ramp it.

Source: red-green closure as in Bank, Sherman and Weiser (1983); the half-weights are this library's.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..._arrays import Numbers, on_host
from ..._checks import has_shape, nonnegative, triangle_indices
from ...topology.builders import from_triangles
from ...topology.graph import Graph
from .given import springs_along
from .red_green import Built, sides_of

DEEPEST = 20


@dataclass(frozen=True)
class Subdivision:
    """A mesh of triangles, some of them split into four, closed by bisections. Make one by `Subdivision.of`.

    Attributes:
        roots: (R, 3) triangles of the first mesh.
        n_roots: its nodes.
        root_stiffness: (R, 3) kappa of the sides a b, b c, c a of each [N/m].
        red: for each level, the numbers of the triangles that were asked to be split; child c of triangle t has number 4 t + c.

    >>> mesh = Subdivision.of([(0, 1, 2), (2, 1, 3)], 4)
    >>> finer = mesh.refined([True, False])
    >>> len(finer.triangles), finer.n_nodes, finer.coarsened(np.ones(6, bool)).triangles.tolist()
    (6, 7, [[0, 1, 2], [2, 1, 3]])
    """

    roots: np.ndarray
    n_roots: int
    root_stiffness: np.ndarray
    red: tuple[np.ndarray, ...] = ()

    @staticmethod
    def of(triangles: Numbers, n_nodes: int, stiffness: Numbers = 1.0) -> Subdivision:
        """The mesh before any change.

        Args:
            triangles: (T, 3) node numbers.
            n_nodes: number of nodes N.
            stiffness: of the springs along the sides [N/m]: a number, or (E,) in the order of `from_triangles(triangles, N).edges`. What
                a side has is shared evenly by its triangles.

        Raises:
            ValueError: triangles that do not fit, a negative stiffness.
        """
        corners = triangle_indices("triangles", triangles, n_nodes)
        k = on_host("stiffness", stiffness).astype(np.float64)
        edges = np.asarray(from_triangles(corners, n_nodes).edges)
        has_shape("stiffness", k, {"one number": (), "one per side": (len(edges),)})
        nonnegative("stiffness", k, "A negative spring pushes its ends apart.")
        sides = springs_along(edges, sides_of(corners), n_nodes)
        count = np.bincount(sides.ravel(), minlength=len(edges))
        return Subdivision(corners, n_nodes, (np.broadcast_to(k, len(edges)) / count)[sides])

    @property
    def triangles(self) -> np.ndarray:
        """(T, 3) triangles of the present mesh, wound as the first ones."""
        return self._leaves[0]

    @property
    def n_nodes(self) -> int:
        """Nodes of the present mesh: those of the first one keep their numbers, midpoints follow level by level."""
        return self._built.n_nodes

    @property
    def level(self) -> np.ndarray:
        """(T,) how often the first mesh was split to give each triangle; a bisected one counts as its whole."""
        return self._leaves[1]

    @cached_property
    def net(self) -> Graph:
        """A spring along every side."""
        return from_triangles(self.triangles, self.n_nodes)

    def refined(self, marked: Numbers) -> Subdivision:
        """The mesh with the marked triangles, (T,) booleans, split into four; of a bisected one, the whole.

        Raises:
            ValueError: another shape; more than 20 levels.
        """
        mask = _marks(marked, len(self.triangles))
        levels, numbers = self.level[mask], self._leaves[2][mask]
        if mask.any() and levels.max() >= DEEPEST:
            raise ValueError(f"a triangle has been split {DEEPEST} times; finer ones cannot be told apart.")
        red = [*self.red, *[np.zeros(0, np.int64)] * (int(levels.max(initial=-1)) + 1 - len(self.red))]
        # What was split to close the mesh is asked for now, where its parts are.
        for at in range(len(red)):
            finer = levels >= at
            red[at] = np.union1d(red[at], numbers[finer] >> (2 * (levels[finer] - at)))
        return self._with(red)

    def coarsened(self, marked: Numbers) -> Subdivision:
        """The mesh with triangles put together again where all parts of a split one are marked, (T,) booleans; one level at most.

        Raises:
            ValueError: another shape.
        """
        mask = _marks(marked, len(self.triangles))
        levels, numbers = self.level[~mask], self._leaves[2][~mask]
        fewer = []
        for at, ids in enumerate(self.red):
            finer = levels > at
            kept = numbers[finer] >> (2 * (levels[finer] - at))
            parents = self.red[at + 1] >> 2 if at + 1 < len(self.red) else np.zeros(0, np.int64)
            fewer.append(ids[np.isin(ids, np.union1d(kept, parents))])
        return self._with(fewer)

    def added(self, since: Subdivision) -> np.ndarray:
        """(T,) which triangles are parts of what was split after `since`: marks for `coarsened` that undo it."""
        levels, numbers = self.level, self._leaves[2]
        new = np.zeros(len(levels), bool)
        for at, ids in enumerate(self._built.red):
            old = since._built.red[at] if at < len(since._built.red) else np.zeros(0, np.int64)
            finer = levels > at
            new[finer] |= np.isin(numbers[finer] >> (2 * (levels[finer] - at)), np.setdiff1d(ids, old))
        return new

    def stiffness(self, since: Subdivision | None = None) -> tuple[np.ndarray, np.ndarray]:
        """(E,) stiffness of `net` at s = 0 and at s = 1 [N/m]: `(1 - s) * slack + s * full` between.

        Args:
            since: the mesh that s refers to: what was split after it has inner sides that are slack at s = 0. None: the first one.
        """
        older, edges = () if since is None else since._built.red, np.asarray(self.net.edges)
        slack, full = (self._built.stiffness(edges, self.root_stiffness, older, s) for s in (0.0, 1.0))
        return slack, full

    def carried(self, values: Numbers, since: Subdivision) -> np.ndarray:
        """Values of the nodes of another mesh of the same family, (N, ...), at the nodes of this one: kept, or the mean of both ends.

        Places, velocities and heights so carried leave the surface where it is.

        Raises:
            ValueError: another number of values, a mesh of another family.
        """
        old = on_host("values", values)
        if old.shape[:1] != (since.n_nodes,):
            raise ValueError(f"values has shape {old.shape}; expected ({since.n_nodes}, ...), one row for each node.")
        if since.n_roots != self.n_roots or not np.array_equal(since.roots, self.roots):
            raise ValueError("since is a subdivision of another mesh.")
        known = {row.tobytes(): i for i, row in enumerate(since._built.nodes)}
        place = np.array([known.get(row.tobytes(), -1) for row in self._built.nodes])
        new = np.zeros((self.n_nodes, *old.shape[1:]), np.result_type(old.dtype, np.float32))
        new[place >= 0] = old[place[place >= 0]]
        starts = self._built.starts
        for start, stop in itertools.pairwise(starts):
            unknown = start + np.flatnonzero(place[start:stop] < 0)
            one, other = self._built.parents[unknown].T
            new[unknown] = 0.5 * (new[one] + new[other])
        return new

    def _with(self, red: list[np.ndarray]) -> Subdivision:
        while red and not len(red[-1]):
            red = red[:-1]
        return Subdivision(self.roots, self.n_roots, self.root_stiffness, tuple(red))

    @cached_property
    def _built(self) -> Built:
        return Built.closed(self.roots, self.n_roots, self.red)

    @cached_property
    def _leaves(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._built.leaves()


def _marks(marked: Numbers, count: int) -> np.ndarray:
    mask = on_host("marked", marked, may_be_boolean=True)
    has_shape("marked", mask, {"one per triangle": (count,)})
    return mask.astype(bool)


__all__ = ["Subdivision"]
