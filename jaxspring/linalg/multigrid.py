"""`Multigrid`: a preconditioner whose iterations do not grow with the mesh.

A few sweeps with every node's own block remove the rough part of an error; the smooth part is seen just as well by a net of fewer nodes,
where it is rough again, and so on to a net so small that its matrix is inverted. On a lattice the smaller nets are those of every
other node (`multigrid_lattice.py`), on a graph those of groups of nodes (`multigrid_graph.py`). What was tried: `docs/solvers.md`.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from ..numerics import is_traced
from ..topology.base import Topology
from ..topology.graph import Graph
from ..topology.lattice import Lattice
from ..vector import Vector
from .multigrid_cycle import Hierarchy, cycle, half_inverse
from .multigrid_graph import GraphHierarchy
from .multigrid_lattice import LatticeHierarchy
from .operators import SpringMatrix
from .preconditioners import Map, Preconditioner

# Nodes of the smallest net, whose matrix is inverted: in space that takes a few milliseconds.
_MOST_NODES = 130


class Multigrid(Preconditioner):
    """One V-cycle of multigrid, in float32 whatever the matrix: the accuracy of the answer is that of the iteration around it.

    Springs that push sideways (negative weights) count as if they did not; springs of other nets on the same nodes count with the nodes'
    own blocks alone. On a lattice nothing needs to be known beforehand; on a graph, nodes are grouped on the host: make it outside `jit`.

    Args:
        net: the net whose springs the matrices hold.
        n_sweeps: degree of the smoothing polynomial, before and after each correction.

    Attributes:
        hierarchy: the nets, chosen at construction.
        n_sweeps: as above (static).

    Raises:
        ValueError: no sweep; a matrix on nodes of another shape than the net's.
        TypeError: a graph that is traced.

    >>> import jaxspring as js
    >>> [axes.shape for axes in Multigrid(js.lattice((64, 64))).hierarchy.chain]
    [(64, 64), (33, 33), (17, 17), (9, 9)]
    """

    hierarchy: Hierarchy
    n_sweeps: int = eqx.field(static=True)

    def __init__(self, net: Topology, n_sweeps: int = 2):
        if n_sweeps < 1:
            raise ValueError(f"n_sweeps = {n_sweeps}: without smoothing the rough part of an error stays. Pass 1 or more.")
        if isinstance(net, Graph) and is_traced(net):
            raise TypeError("net is traced, but its nodes are grouped on the host. Make Multigrid(net) outside jit, and pass it in.")
        on_lattice = LatticeHierarchy.of(net, _MOST_NODES) if isinstance(net, Lattice) else None
        self.hierarchy = GraphHierarchy.of(net, _MOST_NODES) if on_lattice is None else on_lattice
        self.n_sweeps = n_sweeps

    def build(self, matrix: SpringMatrix) -> Map:
        """The V-cycle for the positive semi-definite part of `matrix`."""
        if matrix.like.shape != self.hierarchy.node_shape:
            raise ValueError(
                f"The matrix lives on nodes of shape {matrix.like.shape}, but Multigrid was made for {self.hierarchy.node_shape}. "
                f"Make it from the net of the system that is solved."
            )
        levels, last = self.hierarchy.build(matrix, jnp.float32)
        coarsest = half_inverse(last)

        def apply(r: Vector) -> Vector:
            inner = self.hierarchy.enter(matrix.pick(r, Vector.zeros_like(r)).map(lambda a: a.astype(jnp.float32)))
            z = self.hierarchy.leave(cycle(levels, coarsest, inner, self.n_sweeps), r)
            return matrix.pick(z.map(lambda a: a.astype(r.dtype)), r)

        return apply


__all__ = ["Multigrid"]
