"""Irregular networks: any list of springs between nodes.

Nodes and springs are renumbered inside, so that what is read together lies together; the user's numbering is kept outside. A node field
has shape (N,), an edge field holds one entry of shape (E,). How pulls are summed on nodes is an object, `Gather` or `Scatter`: see
`reduction.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._arrays import Edges, Numbers, whole_number
from .._checks import node_indices, triangle_indices
from ..vector import Vector
from .edge_field import EdgeField
from .listed import ListedSprings, arranged, digest_of
from .overlay import Overlay
from .periods import as_box, minimum_image
from .permutation import Permutation
from .reduction import Gather, Reduction, Scatter, choose_reduction


class Graph(ListedSprings):
    """Nodes joined by an arbitrary list of springs. Build it with `Graph.from_edges`, `delaunay` or `from_triangles`.

    Attributes:
        tails: (E,) internal number of each spring's tail node.
        heads: (E,) internal number of each spring's head node.
        reduction: how pulls are summed on nodes.
        box: (D,) period of each coordinate [m], or None.
        triangles: (T, 3) triangles in the user's numbering, or None.
        count: N (static).
        nodes: the user's order of the nodes and the graph's own (static).
        springs: the user's order of the springs and the graph's own (static).
        digest: of the springs in the user's numbering and order (static).
        name: tells it from other nets of the same springs, or None: see `named`.
    """

    tails: Int[Array, " E"]
    heads: Int[Array, " E"]
    reduction: Reduction
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
        reduction: type[Gather] | type[Scatter] | None = None,
    ) -> Graph:
        """A network from an (E, 2) integer array: tail and head node of each spring. Springs may be repeated.

        Args:
            edges: (E, 2) node numbers: an array, or any series of pairs. Numbers: inside jit, grad and vmap a net cannot be built.
            n_nodes: number of nodes N; a node without a spring is allowed.
            box: (D,) period of each coordinate [m]; zero where a coordinate is not periodic.
            triangles: (T, 3) triangles, kept for plots and surfaces.
            reduction: `Gather` (no scatter in any program) or `Scatter`, which compiles sooner; see `docs/benchmarks.md` for their speed.
                None takes `Gather`, but `Scatter` on a CPU for more nodes than `FASTER_BY_SCATTER`.

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
        kind = choose_reduction(n_nodes) if reduction is None else reduction
        tails, heads, sums, order, springs = arranged(pairs, n_nodes, kind)
        return Graph(
            tails=jnp.asarray(tails),
            heads=jnp.asarray(heads),
            reduction=sums,
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

    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail along each spring."""
        d = self._per_array(self.reduction.difference, x)
        return self.own((d if self.box is None else minimum_image(d, self.box),))

    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node: each pull on its tail, the opposite on its head."""
        return self._per_array(self.reduction.accumulate, pulls.families[0])

    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node."""
        return self.reduction.sum_at_nodes(values.families[0], self.tails, self.heads)

    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""
        return self.own((self.reduction.mean_of_ends(a, self.tails, self.heads),))

    def _per_array(self, function: Callable[[Array, Array, Array], Array], v: Vector) -> Vector:
        return v.map(lambda a: function(a, self.tails, self.heads))


def _as_triangles(triangles: Any, n_nodes: int) -> np.ndarray:
    """Triangles of the net's own, which nobody can change."""
    own = triangle_indices("triangles", triangles, n_nodes)
    own.setflags(write=False)
    return own
