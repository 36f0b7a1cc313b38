"""Borders that slide along themselves: nodes of a straight stretch keep to its line, corners stay.

    x <- x_0 + u u' (x - x_0),    v <- u u' v          u the direction of the border at the node, 0 at a corner

after every step, which for a linear constraint is the constrained motion itself. On an outline of straight sides, with holes or without, no
node leaves its side, and corners stay where they are; between them springs of positive stiffness keep the nodes in order.
"""

from __future__ import annotations

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._arrays import Numbers
from ..._checks import as_inexact
from ...forces.base import Rule, Step
from ...state import State
from ...status import Status
from ...topology.base import Topology
from ...topology.mesh_checks import Sides, triangles_of
from ...vector import Vector
from .given import host_number, plane_points

# Where the border turns by more, a node is a corner [degrees].
CORNER = 1.0


class SlidingBorder(Rule):
    """The border of a mesh of triangles in the plane slides along itself; z is free.

    Attributes:
        net: a net with triangles.
        points: (N, 2) or (N, 3) places on the border that nodes keep to [m]; the first two coordinates count.
        direction: (N, 2) unit vector along the border; zero at corners, and inside, where it means nothing.
        on_border: (N,) which nodes are held so.

    >>> import jaxspring as js
    >>> net = js.delaunay([(0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (1, 0.5), (0, 0.5)])
    >>> border = SlidingBorder(net, [(0, 0), (1, 0), (2, 0), (0, 1), (2, 1), (1, 0.5), (0, 0.5)])
    >>> border.on_border.tolist(), border.corners.tolist()
    ([True, True, True, True, True, False, True], [0, 2, 3, 4])
    """

    breaks: ClassVar[bool] = False
    net: Topology
    points: Array
    direction: Array
    on_border: np.ndarray

    def __init__(self, net: Topology, points: Numbers, corner: Numbers = CORNER):
        """Find the border and its corners.

        Args:
            net: a net with triangles.
            points: (N, 2) or (N, 3) places of the nodes [m].
            corner: turn of the border above which a node is a corner and stays [degrees].

        Raises:
            ValueError: a net without triangles, points of another shape.
        """
        places = plane_points(points)
        if len(places) != net.n_nodes:
            raise ValueError(f"points has {len(places)} rows, but the net has {net.n_nodes} nodes.")
        turn = host_number("corner", corner, "Every node of the border would stay.")
        self.net = net
        self.points = as_inexact("points", places)
        self.on_border, direction = _border(triangles_of(net, None), places, turn)
        self.direction = as_inexact("direction", direction)

    @property
    def corners(self) -> np.ndarray:
        """Nodes of the border that stay."""
        return np.flatnonzero(self.on_border & ~np.asarray(jnp.any(self.direction != 0, axis=-1)))

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """Places and velocities along the border."""
        held = state.layout.unflatten(jnp.asarray(self.on_border))
        u = [state.layout.unflatten(self.direction[:, i].astype(state.dtype)) for i in range(2)]
        origin = [state.layout.unflatten(self.points[:, i].astype(state.dtype)) for i in range(2)]

        def along(a: Array, b: Array) -> tuple[Array, Array]:
            share = u[0] * a + u[1] * b
            return share * u[0], share * u[1]

        x, y, *rest = state.position
        vx, vy, *speeds = state.velocity
        moved, speed = along(x - origin[0], y - origin[1]), along(vx, vy)
        position = Vector((*(jnp.where(held, o + m, a) for a, o, m in zip((x, y), origin, moved, strict=True)), *rest))
        velocity = Vector((*(jnp.where(held, s, v) for v, s in zip((vx, vy), speed, strict=True)), *speeds))
        return state.moved(position, velocity), Status.ok()


def _border(triangles: np.ndarray, points: np.ndarray, corner: float) -> tuple[np.ndarray, np.ndarray]:
    """Which nodes are on the border, and the direction at each that slides."""
    sides = Sides(triangles)
    pairs = sides.pairs[sides.counts == 1]
    on_border, direction = np.zeros(len(points), bool), np.zeros((len(points), 2))
    on_border[pairs.ravel()] = True
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    ends = ends[np.argsort(ends[:, 0], kind="stable")]
    # Where two borders touch, a node has four sides: it stays.
    nodes, first, count = np.unique(ends[:, 0], return_index=True, return_counts=True)
    nodes, first = nodes[count == 2], first[count == 2]
    one, other = points[ends[first, 1]], points[ends[first + 1, 1]]
    before, after = points[nodes] - one, other - points[nodes]
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    sine = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.degrees(np.abs(np.arctan2(sine, (before * after).sum(axis=1))))
    straight = (turn <= corner) & (size > 0)
    chord = other - one
    direction[nodes[straight]] = chord[straight] / np.linalg.norm(chord[straight], axis=1, keepdims=True)
    return on_border, direction


__all__ = ["SlidingBorder"]
