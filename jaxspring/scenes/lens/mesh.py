"""The net of a lens and its equilibrium under tension, which is a linear solve per coordinate.

Nodes stand on a regular grid over the image. Springs run along rows, columns and one diagonal per cell, and all have rest length zero, so
that a spring of stiffness w pulls with w times its length and x and y separate:

    sum over the neighbours j of  w_ij (x_j - x_i) = 0        at every node that is free along x, and likewise y        [N]

Left and right borders keep x and slide along y, top and bottom the other way round, corners stay. Springs on the border count half, since
only one side of them is there: then equal springs leave the regular grid as it is. Each node is a weighted mean of its neighbours, so by
Tutte's theorem (How to draw a graph, 1963; Floater 2003 for triangulations and any positive weights) no triangle is ever folded: a border
that slides is one half of a net mirrored about it.

The solve is conjugate gradients from the last shape, preconditioned by the net of equal springs, whose inverse is a product of sines along
one axis and cosines along the other, between square roots of the ratio of the diagonals (Concus & Golub 1973).
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ...linalg.base import SolveInfo
from ...linalg.cg import JaxCG
from ...topology.edge_field import EdgeField
from ...topology.lattice import SHEAR, STRUCTURAL, Lattice, lattice
from ...vector import Vector
from ..reconstruction.triangles import Node
from .search import turned

# Stiffness of a diagonal over that of a row: enough that the triangles, not the cells, decide on folds.
DIAGONAL = 0.2


class LensMesh(eqx.Module):
    """Geometry of a lens; nothing in it is differentiated.

    Attributes:
        net: (ny, nx) nodes with rows, columns and both diagonals; one diagonal of each cell has stiffness zero.
        x, y: (ny, nx) nodes of the regular grid [pixels].
        stiffness: of equal springs, which make an isotropic sheet; zero where there is no spring.
        length: of the springs of the regular grid [pixels].
        modes: what the preconditioner needs.
    """

    net: Lattice
    x: Array
    y: Array
    stiffness: EdgeField
    length: EdgeField
    modes: _Modes

    @staticmethod
    def over(shape: tuple[int, int], nodes: tuple[int, int]) -> LensMesh:
        """A mesh of (ny, nx) nodes over an image of this shape."""
        net = lattice(nodes, STRUCTURAL + SHEAR)
        x, y = np.meshgrid(np.linspace(0.0, shape[1] - 1.0, nodes[1]), np.linspace(0.0, shape[0] - 1.0, nodes[0]))
        hx, hy = x[0, 1] - x[0, 0], y[1, 0] - y[0, 0]
        table: dict[tuple[int, ...], float] = {(0, 1): hy / hx, (1, 0): hx / hy, (1, 1): DIAGONAL, (1, -1): DIAGONAL}
        parts = []
        for offset, size in zip(net.offsets, net.family_sizes, strict=True):
            one = np.full(size, table[offset])
            if offset == (0, 1):
                one.reshape(nodes[0], -1)[[0, -1]] *= 0.5
            elif offset == (1, 0):
                one.reshape(-1, nodes[1])[:, [0, -1]] *= 0.5
            else:
                one *= (turned((nodes[0] - 1, nodes[1] - 1)) == (offset == (1, -1))).ravel()
            parts.append(one)
        stiffness = net.inside(net.split(jnp.asarray(np.concatenate(parts))), 0.0)
        points = np.stack([x.ravel(), y.ravel()], axis=1)
        tail, head = net.edges.T
        length = net.split(jnp.asarray(np.linalg.norm(points[head] - points[tail], axis=1)))
        return LensMesh(net, jnp.asarray(x), jnp.asarray(y), stiffness, length, _Modes.of(nodes, hy / hx))

    @property
    def cells(self) -> tuple[int, int]:
        """Cells along y and x."""
        ny, nx = self.net.node_shape
        return ny - 1, nx - 1

    @property
    def cell_size(self) -> tuple[Array, Array]:
        """Of the regular grid, along x and y [pixels]."""
        return self.x[0, 1] - self.x[0, 0], self.y[1, 0] - self.y[0, 0]

    @property
    def is_free(self) -> Vector:
        """Which nodes are free along x and along y: all but those on the two borders across."""
        ny, nx = self.net.node_shape
        along_x, along_y = np.ones((ny, nx), bool), np.ones((ny, nx), bool)
        along_x[:, [0, -1]], along_y[[0, -1]] = False, False
        return Vector((jnp.asarray(along_x), jnp.asarray(along_y)))

    def differences(self, moved: Vector) -> EdgeField:
        """Head minus tail of every spring of the mesh displaced by `moved` [pixels]."""
        return self.net.difference(Vector((self.x, self.y)) + moved)

    def balance(self, stiffness: EdgeField, guess: Vector, solver: JaxCG) -> tuple[Vector, SolveInfo]:
        """Displacements (x, y) at which springs of this stiffness balance [pixels]; positive wherever the mesh has a spring."""
        free = tuple(self.is_free)

        def product(a: Vector) -> Vector:
            return -self.net.net_pull(lambda d, w: w * d, a.where(free), stiffness).where(free)

        pull = self.net.net_pull(lambda d, w: w * d, Vector((self.x, self.y)), stiffness).where(free)
        scale = lax.rsqrt(lax.stop_gradient(self.net.incident_sum(stiffness) / self.net.incident_sum(self.stiffness)))

        def precondition(r: Vector) -> Vector:
            return Vector((scale * self.modes.along_x(scale * r[0]), scale * self.modes.along_y(scale * r[1]))).where(free)

        moved, info = solver.solve(product, pull, precondition, guess)
        # Held again, so that what asks for the derivative at a held node gets zero, not an equation without a solution.
        return moved.where(free), info


class _Axis(NamedTuple):
    """Modes of a row of equal springs, (n, n) as columns, and their eigenvalues: both ends held, or both ends free with half a mass."""

    held: Array
    of_held: Array
    free: Array
    of_free: Array

    @staticmethod
    def of(n: int) -> _Axis:
        order, at = np.arange(n), np.arange(n)[:, None]
        held = np.sqrt(2 / (n - 1)) * np.sin(np.pi * order * at / (n - 1))
        held[:, [0, -1]] = 0.0
        free = np.sqrt(2 / (n - 1)) * np.cos(np.pi * order * at / (n - 1))
        free[:, [0, -1]] /= np.sqrt(2)
        of_free = 2 - 2 * np.cos(np.pi * order / (n - 1))
        # The first and last modes of the held row are none; any value will do.
        of_held = np.where((order == 0) | (order == n - 1), 1.0, of_free)
        return _Axis(*(jnp.asarray(a) for a in (held, of_held, free, of_free)))


class _Modes(eqx.Module):
    """The inverse of the net of equal springs without diagonals, for x (held left and right) and for y (held above and below).

    Attributes:
        rows, columns: modes along y and along x.
        ratio: height over width of a cell.
    """

    rows: _Axis
    columns: _Axis
    ratio: Array

    @staticmethod
    def of(nodes: tuple[int, int], ratio: float) -> _Modes:
        return _Modes(_Axis.of(nodes[0]), _Axis.of(nodes[1]), jnp.asarray(ratio))

    def along_x(self, r: Node) -> Node:
        """For x."""
        return self._solve(r, (self.rows.free, self.rows.of_free), (self.columns.held, self.columns.of_held))

    def along_y(self, r: Node) -> Node:
        """For y."""
        return self._solve(r, (self.rows.held, self.rows.of_held), (self.columns.free, self.columns.of_free))

    def _solve(self, r: Node, rows: tuple[Array, Array], columns: tuple[Array, Array]) -> Node:
        (a, of_a), (b, of_b) = rows, columns
        in_modes = (a.T @ r @ b) / (of_a[:, None] / self.ratio + of_b[None, :] * self.ratio)
        return a @ in_modes @ b.T


def at_cells(a: Array) -> Array:
    """Mean over the four corners of every cell."""
    return 0.25 * (a[:-1, :-1] + a[:-1, 1:] + a[1:, :-1] + a[1:, 1:])


__all__ = ["DIAGONAL", "LensMesh", "at_cells"]
