"""Triangles of a surface in space, as forces on them see them: area vectors, and shares of the corners.

    S = (b - a) x (c - a) / 2        [m^2]   of length A, along the normal n about which a, b, c turn counter-clockwise

What a triangle has goes to its corners by thirds.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Array

from .._arrays import Numbers
from ..contact.base import length
from ..state import State
from ..topology.base import Topology
from ..topology.corners import Corners
from ..topology.mesh_checks import triangles_of
from ..vector import Vector


def corners_of(net: Topology, triangles: Numbers | Corners | None) -> Corners:
    """The corners of triangles: as given, of (T, 3) node numbers, or of the net's own."""
    return triangles if isinstance(triangles, Corners) else Corners(triangles_of(net, triangles), net)


def check_space(part: Any, state: State) -> None:
    """Raise ValueError where there are not three coordinates."""
    if state.dim != 3:
        raise ValueError(f"{type(part).__name__} acts on triangles in space, but positions have {state.dim} coordinates. Give them a z.")


def cross(a: Vector, b: Vector) -> Vector:
    """a x b in space."""
    return Vector((a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]))


def area_vectors(corners: Corners, position: Vector) -> Vector:
    """S of each triangle [m^2], through the walls of a box where that is nearer."""
    ab, ac = corners.apart(position)
    return 0.5 * cross(ab, ac)


def perimeters(corners: Corners, position: Vector) -> Array:
    """Sum of each triangle's sides [m]."""
    ab, ac = corners.apart(position)
    return length(ab) + length(ac) + length(ac - ab)


def thirds(corners: Corners, values: Any) -> Any:
    """What triangles have, by thirds to their corners: summed at each node."""
    third = values / 3.0
    return corners.sum((third, third, third))


__all__ = ["area_vectors", "check_space", "corners_of", "cross", "perimeters", "thirds"]
