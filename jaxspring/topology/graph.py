"""Irregular networks: any list of springs between nodes.

Nodes and springs are renumbered inside, so that what is read together lies together; the user's numbering is kept outside. A node field
has shape (N,), an edge field holds one entry of shape (E,). How each node reads its springs: see `ends.py`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .._arrays import Edges, Numbers, whole_number
from .._checks import node_indices, triangle_indices
from .ends import Ends
from .listed import ListedSprings, arranged, digest_of
from .overlay import Overlay
from .periods import as_box
from .permutation import Permutation


class Graph(ListedSprings):
    """Nodes joined by an arbitrary list of springs. Build it with `Graph.from_edges`, `delaunay` or `from_triangles`.

    Attributes:
        ends: the springs as each node reads them.
        box: (D,) period of each coordinate [m], or None.
        triangles: (T, 3) triangles in the user's numbering, or None.
        count: N (static).
        nodes: the user's order of the nodes and the graph's own (static).
        springs: the user's order of the springs and the graph's own (static).
        digest: of the springs in the user's numbering and order (static).
        name: tells it from other nets of the same springs, or None: see `named`.
    """

    ends: Ends
    box: Array | None
    triangles: np.ndarray | None
    count: int = eqx.field(static=True)
    nodes: Permutation = eqx.field(static=True)
    springs: Permutation = eqx.field(static=True)
    digest: str = eqx.field(static=True)
    name: str | None = eqx.field(static=True)

    @staticmethod
    def from_edges(
        edges: Edges,
        n_nodes: int,
        *,
        box: Numbers | None = None,
        triangles: Numbers | None = None,
    ) -> Graph:
        """A network from an (E, 2) integer array: tail and head node of each spring. Springs may be repeated.

        Args:
            edges: (E, 2) node numbers: an array, or any series of pairs. Numbers: inside jit, grad and vmap a net cannot be built.
            n_nodes: number of nodes N; a node without a spring is allowed.
            box: (D,) period of each coordinate [m]; zero where a coordinate is not periodic.
            triangles: (T, 3) triangles, kept for plots and surfaces.

        Raises:
            ValueError: no node, a node that does not exist, a spring that joins a node to itself, a triangle with a corner twice, a period
                that is negative or not finite.
            TypeError: node numbers that are not integers, or are traced.

        >>> net = Graph.from_edges([(0, 1), (1, 2)], n_nodes=3)
        >>> net.n_springs
        2
        """
        n_nodes = whole_number("n_nodes", n_nodes)
        if n_nodes < 1:
            raise ValueError(f"n_nodes = {n_nodes}, but a network needs at least 1 node.")
        pairs = node_indices("edges", edges, n_nodes)
        ends, order, springs = arranged(pairs, n_nodes)
        return Graph(
            ends=ends,
            box=as_box(box),
            triangles=None if triangles is None else _as_triangles(triangles, n_nodes),
            count=n_nodes,
            nodes=Permutation(order),
            springs=springs,
            digest=digest_of(pairs),
            name=None,
        )

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node array: (N,)."""
        return (self.count,)

    @property
    def node_permutation(self) -> Permutation:
        """From the user's node order to the internal one."""
        return self.nodes

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) tail and head of each spring, in the user's order and numbering."""
        return self.nodes.order[self._ends()][self.springs.inverse]

    def with_edges(self, edges: Edges, name: str | None = None) -> Overlay:
        """A further net over the same nodes: see `Topology.with_edges`."""
        return Overlay.on(self.layout, self.box, edges, name)

    def _taken(self, a: Array) -> Array:
        return a

    def _put(self, a: Array) -> Array:
        return a


def _as_triangles(triangles: Any, n_nodes: int) -> np.ndarray:
    """Triangles of the net's own, which nobody can change."""
    own = triangle_indices("triangles", triangles, n_nodes)
    own.setflags(write=False)
    return own
