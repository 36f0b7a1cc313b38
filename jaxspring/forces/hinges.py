"""Hinges: bending of a mesh of triangles, an angle at every edge that two of them share.

    energy      k_e / 2 (theta - theta_0)^2                            [J]    the difference wrapped to (-pi, pi]
    forces      - k_e (theta - theta_0) grad theta                     [N]
    block       k_e grad theta grad theta'                             [N/m]  positive semi-definite, of four corners
    plate       k_e = B |e|^2 / A                                      [J]    B bending stiffness [N m], A area of both triangles [m^2]

On equilateral triangles the hinges are an isotropic plate of Poisson's ratio -1/3 as they are refined; on a grid of squares with one
diagonal each they bend three times as hard along the diagonals as along the axes. No choice of k_e gives another Poisson's ratio.

Source: Grinspun and others (2003), "Discrete Shells", and Bridson, Marino and Fedkiw (2003); the factor of the plate from the energy of
an equilateral mesh on a cylinder.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, is_concrete, nonnegative, triangle_indices
from ..linalg.operators import Blocks, CellDyads
from ..state import State
from ..status import Flag
from ..topology.base import Topology
from ..topology.corners import Corners
from ..topology.hinge_list import hinges_of
from ..vector import Vector
from .base import Finding, Force, any_refused
from .dihedral import Dihedral, cross, dihedral, wrapped
from .history import Creased, remembered
from .linearisation import ExactTangent, Linearisation


class Hinges(Force):
    """Bending of a mesh in space: every edge of two triangles resists folding.

    The mesh may have windings that do not agree, several parts, or one side only. An angle is positive where the mesh is convex seen from
    the side from which the corners of the triangle of the lower number go round counter-clockwise. A hinge at pi, folded flat, pushes one
    way or the other; its energy has no jump there.

    A hinge at an edge without length or a triangle without area does nothing, and the status says `DEGENERATE`. Springs that break leave
    hinges as they are. Damping of bending: `Rayleigh(0.0, time, hinges)`, a moment k_e times that time per rate of angle.

    Attributes:
        net: whose nodes are bent.
        stiffness: k_e, moment per angle [N m]: one number, or (H,) in the order of `nodes`.
        rest_angle: theta_0 [rad]; as the stiffness. `PlasticHinges` adds to it.
        triangles: the corners of the hinges.

    >>> import jaxspring as js
    >>> net = js.from_triangles([(0, 1, 2), (1, 0, 3)], 4)
    >>> hinges = js.cloth.Hinges(net, stiffness=0.5)
    >>> bent = js.State.from_points(net, [(0, 0, 0), (1, 0, 0), (0.5, 1, 0), (0.5, 0, 1)])
    >>> print(hinges.nodes, hinges.angles(bent).round(4), f"{hinges.energy(bent):.4f}")
    [[0 1 2 3]] [-1.5708] 0.6169
    """

    net: Topology
    stiffness: Array
    rest_angle: Array
    triangles: Corners

    def __init__(
        self,
        net: Topology,
        stiffness: Numbers,
        rest_angle: Numbers | None = None,
        triangles: Numbers | Corners | None = None,
        rest_points: Numbers | None = None,
    ):
        """Find the hinges.

        Args:
            net: whose nodes are bent.
            stiffness: k_e [N m]: one number, or (H,), one per hinge.
            rest_angle: [rad]: one number, or (H,). None is flat, zero.
            triangles: (T, 3) node numbers; None takes the triangles of the net.
            rest_points: (N, D) places [m] whose angles are the rest angles.

        Raises:
            ValueError: no triangles; an edge of three triangles; a triangle given twice; a stiffness that is negative or not finite;
                both rest angles and places at rest.
        """
        self.net = net
        self.triangles = triangles if isinstance(triangles, Corners) else _corners(net, triangles)
        if rest_points is not None:
            if rest_angle is not None:
                raise ValueError("rest_angle and rest_points are both given: rest angles are those of the points. Leave one out.")
            rest_angle = _in_space(self.triangles, net, rest_points).angle
        self.stiffness = self._constant("stiffness", stiffness)
        self.rest_angle = self._constant("rest_angle", 0.0 if rest_angle is None else rest_angle)
        nonnegative("stiffness", self.stiffness, "A hinge of negative stiffness folds by itself.")

    @staticmethod
    def from_bending(net: Topology, points: Numbers, bending: Numbers, triangles: Numbers | None = None) -> Hinges:
        """Hinges of a plate: k_e = B |e|^2 / A, with the lengths, areas and angles of places at rest.

        Args:
            net: whose nodes are bent.
            points: (N, D) places at rest [m], D = 2 or 3: a flat pattern, or a shell, which then keeps its shape.
            bending: B, moment per width and curvature [N m]: one number, or (H,) in the order of `nodes`.
            triangles: as in `Hinges`.

        Raises:
            ValueError: as `Hinges`; two triangles without area.

        >>> import jaxspring as js
        >>> net = js.from_triangles([(0, 1, 2), (1, 0, 3)], 4)
        >>> square = [(0, 0), (1, 1), (0, 1), (1, 0)]
        >>> print(js.cloth.Hinges.from_bending(net, square, bending=3e-5).stiffness)
        [6.e-05]
        """
        corners = _corners(net, triangles)
        e, f, g = _from_first(corners, net, points)
        area = 0.5 * (cross(e, f).norm() + cross(g, e).norm())
        if is_concrete(area) and bool(jnp.any(area <= 0)):
            i = int(np.argmax(np.asarray(area) <= 0))
            raise ValueError(
                f"hinge {i}, nodes {corners.nodes(net)[i].tolist()}, has triangles without area at rest: no k_e follows from B."
            )
        b = as_inexact("bending", bending)
        has_shape("bending", b, {"one number": (), "one per hinge": area.shape})
        stiffness = b.astype(area.dtype) * e.dot(e) / area
        return Hinges(net, stiffness, dihedral(e, f, g).angle, corners)

    @property
    def nodes(self) -> np.ndarray:
        """(H, 4) nodes of each hinge in the user's numbering: the edge from a to b, and the two corners opposite to it."""
        return self.triangles.nodes(self.net)

    @property
    def pairs(self) -> Topology:
        """A net of every pair of a hinge's corners, for `Skyline(net, hinges.pairs)`."""
        return self.triangles.coupled()

    def angles(self, state: State) -> Array:
        """(H,) theta of each hinge [rad], in (-pi, pi]; 0 where degenerate."""
        return wrapped(self._now(state).angle)

    def bent(self, state: State) -> Array:
        """(H,) angle of each hinge from that at rest [rad], in (-pi, pi]; 0 where degenerate."""
        return self._turned(state, self._now(state))

    def moments(self, state: State) -> Array:
        """(H,) moment of each hinge, k_e (theta - theta_0) [N m]; 0 where degenerate."""
        return self._moments(state)[1]

    def force(self, state: State) -> Vector:
        """Sum of the forces of the hinges at each node [N]."""
        now, moment = self._moments(state)
        return self.triangles.sum(tuple(-moment * g for g in now.gradient))

    def energy(self, state: State) -> Array:
        """k_e / 2 (theta - theta_0)^2, summed [J]."""
        now = self._now(state)
        turned = self._turned(state, now)
        return jnp.sum(0.5 * self._stiffness(state, now) * turned * turned)

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """Blocks k_e g g' of all four corners [N/m]; for `ExactTangent` with the moment times the second derivative of the angle."""
        now, moment = self._moments(state)
        k = self._stiffness(state, now)
        dyads = [(k, now.gradient)]
        if isinstance(linearisation, ExactTangent):
            dyads += [(factor * moment, g) for factor, g in now.second]
        slopes, directions = zip(*dyads, strict=True)
        return Blocks(cells=(CellDyads(self.triangles, slopes, directions),))

    def stiffness_bound(self, state: State) -> Array:
        """Upper bound of the row sums: k_e |g_i| sum of |g_j|, and the moment times that of the second derivative [N/m]."""
        now, moment = self._moments(state)
        k = self._stiffness(state, now)
        sizes = tuple(g.norm() for g in now.gradient)
        total = k * (sizes[0] + sizes[1] + sizes[2] + sizes[3])
        rows = (total * size + jnp.abs(moment) * more for size, more in zip(sizes, now.second_bound, strict=True))
        return self.triangles.sum(tuple(rows))

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """DEGENERATE: hinges at an edge without length or a triangle without area, and a node of the first."""
        bad = self._now(state).is_degenerate
        return (Finding(Flag.DEGENERATE, jnp.sum(bad, dtype=jnp.int32), self.triangles.cells[0][jnp.argmax(bad)]),)

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the smallest height of a triangle."""
        now = self._now(state)
        steepest = jnp.max(jnp.where(now.is_degenerate, jnp.zeros_like(now.angle), jnp.maximum(*now.per_heights)))
        return state.position.largest() * jnp.asarray(jnp.finfo(state.dtype).eps, state.dtype) * steepest

    def invalid(self) -> Array:
        """Whether a stiffness is negative or not finite, or a rest angle not finite."""
        return any_refused(self.stiffness) | ~jnp.all(jnp.isfinite(self.rest_angle))

    def _constant(self, name: str, value: Numbers) -> Array:
        value = as_inexact(name, value)
        has_shape(name, value, {"one number": (), "one per hinge": (self.triangles.cells.shape[-1],)})
        finite(name, value)
        return value

    def _now(self, state: State) -> Dihedral:
        if state.dim != 3:
            raise ValueError(f"Hinges bend in space and need positions of 3 coordinates; these have {state.dim}.")
        return dihedral(*self.triangles.apart(state.position))

    def _stiffness(self, state: State, now: Dihedral) -> Array:
        """(H,) stiffness of each hinge, 0 where degenerate."""
        k = jnp.broadcast_to(self.stiffness.astype(state.dtype), now.angle.shape)
        return jnp.where(now.is_degenerate, jnp.zeros_like(k), k)

    def _turned(self, state: State, now: Dihedral) -> Array:
        """(H,) angle of each hinge from that at rest, 0 where degenerate."""
        rest = jnp.broadcast_to(self.rest_angle.astype(state.dtype), now.angle.shape)
        for creased in remembered(self.net, state, Creased):
            rest = rest + creased.angle
        return jnp.where(now.is_degenerate, jnp.zeros_like(rest), wrapped(now.angle - rest))

    def _moments(self, state: State) -> tuple[Dihedral, Array]:
        """The hinges, and the moment of each."""
        now = self._now(state)
        return now, self._stiffness(state, now) * self._turned(state, now)


def _corners(net: Topology, triangles: Any) -> Corners:
    if triangles is None:
        triangles = getattr(net, "triangles", None)
        if triangles is None:
            raise ValueError(f"this {type(net).__name__} has no triangles, whose edges are hinges. Pass triangles=, (T, 3) node numbers.")
    return Corners(hinges_of(triangle_indices("triangles", triangles, net.n_nodes)), net, with_pairs=True)


def _from_first(corners: Corners, net: Topology, points: Numbers) -> tuple[Vector, ...]:
    """The other corners less the first, of places in the plane or in space."""
    x = net.vector_field(points)
    if x.dim == 1:
        raise ValueError("points has 1 coordinate; a mesh of triangles lies in 2 or 3.")
    apart = corners.apart(x)
    return apart if x.dim == 3 else tuple(Vector((*d, jnp.zeros_like(d.x))) for d in apart)


def _in_space(corners: Corners, net: Topology, points: Numbers) -> Dihedral:
    return dihedral(*_from_first(corners, net, points))


__all__ = ["Hinges"]
