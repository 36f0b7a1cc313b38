"""Pressure in a closed surface of triangles: a balloon, a ball, a cushion.

    V = sum over triangles of a . (b x c) / 6        what it encloses [m^3], with caps over its holes
    f_i = p sum over the triangles at i of S / 3     = p dV/dx_i                S: area vector, outward
    E = -p V                                         pressure p that stays
    E = -(p0 + pa) V0 log(V / V0) + pa (V - V0)      a gas, p V = const: p0 over the surrounding pa where it fills V0

A hole is capped by triangles from the middle of its nodes, which act on them like skin without weight: a third of each to either
end of its side, and a third to all nodes of the hole alike.

The energy has no spring blocks: in an implicit step of one linear solve pressure is taken at the old time; Newton's step takes it at the
new time, exactly, and a stiff gas needs that.

Source: the gradient of the enclosed volume; an ideal gas at constant temperature (Boyle).
"""

from __future__ import annotations

from typing import Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers, on_host
from .._checks import as_inexact, finite, has_shape, positive
from ..contact.base import length
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..topology.corners import Corners
from ..topology.mesh_checks import Sides, borders, pieces, refuse_crowded, signed_volumes, triangles_of
from ..vector import Vector
from .base import Force, Scene, any_not_positive, any_refused
from .triangles import area_vectors, check_space, corners_of, cross, perimeters, thirds


class Caps(eqx.Module):
    """The holes of a surface.

    Attributes:
        sides: corners (2) of the sides along them, such that a cap's triangle is its middle, and they.
        belongs: (L, C) 1 where side C is of hole L.
    """

    sides: Corners
    belongs: Array

    @staticmethod
    def over(holes: list[np.ndarray], net: Topology) -> Caps:
        """Caps over lines of nodes, each in order."""
        pairs = np.concatenate([np.stack([loop, np.roll(loop, -1)], axis=-1) for loop in holes])
        owner = np.repeat(np.arange(len(holes)), [len(loop) for loop in holes])
        return Caps(Corners(pairs, net), jnp.asarray(owner == np.arange(len(holes))[:, None], jnp.result_type(float)))

    def spokes(self, position: Vector) -> tuple[Vector, Vector, Vector]:
        """For each side its hole's middle, as seen from its first end, and both its ends, from that middle [m]."""
        first = self.sides.at(position)[0]
        (along,) = self.sides.apart(position)
        belongs = self.belongs.astype(position.dtype)
        count = jnp.sum(belongs, axis=1, dtype=belongs.dtype)
        middle = first.map(lambda a: jnp.matmul(jnp.matmul(belongs, a, precision=lax.Precision.HIGHEST) / count, belongs))
        a = first - middle
        return middle, a, a + along

    def of_middle(self, values: Vector) -> Vector:
        """What middles of holes have, (C,) for each of their sides, summed and given to the hole's nodes alike: (C,) for each side."""
        belongs = self.belongs.astype(values.dtype)
        count = jnp.sum(belongs, axis=1, dtype=belongs.dtype)
        return values.map(lambda a: jnp.matmul(jnp.matmul(belongs, a, precision=lax.Precision.HIGHEST) / count, belongs))


class Pressure(Force):
    """Pressure of what a closed surface of triangles holds, over that around it.

    Attributes:
        net: the topology.
        pressure: p over the surrounding pressure [Pa], one number: as it stays, or where a gas fills `volume`.
        volume: V0 of a gas [m^3]; None: the pressure stays as it is.
        ambient: pa around it [Pa]; None with `volume`.
        triangles: their corners.
        caps: over holes; None where there are none.

    A gas pressed to no volume, or turned inside out by too long a step, gives NaN, which the status names.

    Raises:
        ValueError: a surface with a hole, unless holes are capped; neighbours wound against each other; a side of more than two triangles;
            a surface that is inside out; a constant of a wrong sign.

    >>> corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / 3**0.5
    >>> net = js.from_triangles([(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)], 4)
    >>> ball = Pressure(net, corners, 100.0)
    >>> state = js.State.from_points(net, corners)
    >>> print(ball.enclosed(state).round(4), net.flatten_nodes(ball.force(state).x).round(3))
    0.5132 [ 22.222  22.222 -22.222 -22.222]
    """

    net: Topology
    pressure: Array
    volume: Array | None
    ambient: Array | None
    triangles: Corners
    caps: Caps | None

    def __init__(
        self,
        net: Topology,
        points: Numbers,
        pressure: Numbers,
        volume: Numbers | None = None,
        ambient: Numbers = 101325.0,
        triangles: Numbers | None = None,
        cap_holes: bool = False,
    ):
        """Look at the surface, on the host.

        Args:
            net: the topology.
            points: (N, 3) positions [m], by which outside is told from inside.
            pressure: p [Pa], over that around. Below zero it sucks.
            volume: V0 [m^3] at which a gas has that pressure; None: the pressure stays. `Pressure.of_gas` takes that of the points.
            ambient: pa [Pa] around a gas; the standard atmosphere unless said.
            triangles: (T, 3) node numbers, counter-clockwise seen from outside; None: those of the net.
            cap_holes: close each hole by a cap.
        """
        self.net = net
        cells, places = triangles_of(net, triangles), on_host("points", points)
        has_shape("points", places, {"a place in space per node": (net.n_nodes, 3)})
        finite("points", places)
        holes = _checked(cells, cap_holes)
        self.triangles = corners_of(net, cells)
        self.caps = Caps.over(holes, net) if holes else None
        self.pressure = as_inexact("pressure", pressure)
        has_shape("pressure", self.pressure, {"one number": ()})
        finite("pressure", self.pressure)
        self.volume = self.ambient = None
        if volume is not None:
            self.volume, self.ambient = as_inexact("volume", volume), as_inexact("ambient", ambient)
            for name, value in (("volume", self.volume), ("ambient", self.ambient)):
                has_shape(name, value, {"one number": ()})
                positive(name, value, "A gas has both above zero.")
            positive("pressure + ambient", self.pressure + self.ambient.astype(self.pressure.dtype), "A gas does not pull.")
        _refuse_inward(cells, places, holes, volume is not None)

    @classmethod
    def of_gas(
        cls,
        net: Topology,
        points: Numbers,
        pressure: Numbers,
        ambient: Numbers = 101325.0,
        triangles: Numbers | None = None,
        cap_holes: bool = False,
    ) -> Self:
        """A gas, p V = const, that has the pressure [Pa] over its surroundings where the surface stands at `points`."""
        still = cls(net, points, pressure, triangles=triangles, cap_holes=cap_holes)
        places = Vector(tuple(net.node_field(column) for column in on_host("points", points).T))
        return cls(net, points, pressure, still._volume(places), ambient, triangles, cap_holes)

    def bind(self, scene: Scene) -> Pressure:
        """The same with constants in the dtype of the state."""
        return cast_inexact(self, scene.dtype)

    def enclosed(self, state: State) -> Array:
        """What the surface encloses, with its caps [m^3]."""
        check_space(self, state)
        return self._volume(state.position)

    def overpressure(self, state: State) -> Array:
        """Present pressure over the surrounding one [Pa]."""
        p = self.pressure.astype(state.dtype)
        if self.volume is None or self.ambient is None:
            return p
        start, around = self.volume.astype(state.dtype), self.ambient.astype(state.dtype)
        return (p + around) * start / _above_zero(self.enclosed(state)) - around

    def force(self, state: State) -> Vector:
        """p dV/dx [N]."""
        return self.overpressure(state) * self._slope(state.position)

    def energy(self, state: State) -> Array:
        """Minus the work that the pressure can do, over that of the surroundings [J]; zero at no volume, or at V0 of a gas."""
        inside = self.enclosed(state)
        if self.volume is None or self.ambient is None:
            return -self.pressure.astype(state.dtype) * inside
        start, around = self.volume.astype(state.dtype), self.ambient.astype(state.dtype)
        constant = (self.pressure.astype(state.dtype) + around) * start
        return around * (inside - start) - constant * jnp.log(_above_zero(inside) / start)

    def stiffness_bound(self, state: State) -> Array:
        """Of the row sums of |dF/dx| at each node [N/m]: by the turning of triangles, and by the pressure of a gas."""
        x = state.position
        bound = jnp.abs(self.overpressure(state)) * self._turning(x)
        if self.volume is None or self.ambient is None:
            return bound
        slope, inside = length(self._slope(x)), self.enclosed(state)
        constant = (self.pressure + self.ambient).astype(state.dtype) * self.volume.astype(state.dtype)
        return bound + constant / (inside * inside) * slope * jnp.sum(slope)

    def invalid(self) -> Array:
        """Whether the pressure is not finite, or a gas has a constant that is not above zero."""
        bad = ~jnp.isfinite(self.pressure)
        if self.volume is None or self.ambient is None:
            return bad
        return bad | any_not_positive(self.volume, self.ambient) | any_refused(self.pressure + self.ambient.astype(self.pressure.dtype))

    def _volume(self, x: Vector) -> Array:
        """About the middle of all nodes, which changes nothing but rounding."""
        centred = x.map(lambda a: a - lax.stop_gradient(jnp.mean(a)))
        a = self.triangles.at(centred)[0]
        total = jnp.sum(a.dot(area_vectors(self.triangles, centred))) / 3
        if self.caps is None:
            return total
        middle, u, v = self.caps.spokes(centred)
        return total + jnp.sum(middle.dot(cross(u, v))) / 6

    def _slope(self, x: Vector) -> Vector:
        """dV/dx [m^2]."""
        total = thirds(self.triangles, area_vectors(self.triangles, x))
        if self.caps is None:
            return total
        _, u, v = self.caps.spokes(x)
        sixth = cross(u, v) / 6.0
        return total + self.caps.sides.sum((sixth + self.caps.of_middle(sixth), sixth))

    def _turning(self, x: Vector) -> Array:
        """Half a third of the sides of the triangles at each node [m]."""
        bound = thirds(self.triangles, 0.5 * perimeters(self.triangles, x))
        if self.caps is None:
            return bound
        _, u, v = self.caps.spokes(x)
        sixth = (length(u) + length(v) + length(v - u)) / 6
        return bound + self.caps.sides.sum((sixth + self.caps.of_middle(Vector((sixth,)))[0], sixth))


def _above_zero(inside: Array) -> Array:
    """A volume, or NaN where a gas would have none."""
    return jnp.where(inside > 0, inside, jnp.full((), jnp.nan, inside.dtype))


def _checked(cells: np.ndarray, cap_holes: bool) -> list[np.ndarray]:
    """The holes of a surface that can hold a pressure. Raises ValueError for any other."""
    sides = Sides(cells)
    refuse_crowded(sides)
    number, _, _, alike = sides.shared()
    if not alike.all():
        side = int(number[np.argmin(alike)])
        raise ValueError(
            f"{sides.where(side)} is run along in one direction by both: one of them is inside out. Turn it over, by "
            f"js.cloth.rewound(net, points), which also says where no winding fits."
        )
    n_open = int((sides.counts == 1).sum())
    if n_open and not cap_holes:
        raise ValueError(
            f"the surface is not closed: {sides.where(int(np.argmax(sides.counts == 1)))} has no other triangle ({n_open} such sides). "
            f"What it holds would flow out. Fill its holes, or pass cap_holes=True."
        )
    return borders(cells) if n_open else []


def _refuse_inward(cells: np.ndarray, places: np.ndarray, holes: list[np.ndarray], is_gas: bool) -> None:
    """Raise ValueError where a piece is wound inward, or a gas would fill several."""
    fans = [np.stack([np.full(len(loop), len(places) + i), loop, np.roll(loop, -1)], axis=-1) for i, loop in enumerate(holes)]
    closed = np.concatenate([cells, *fans])
    everything = np.concatenate([places, *(places[loop].mean(axis=0)[None] for loop in holes)])
    piece = pieces(Sides(closed), len(closed))
    volumes = np.bincount(piece, signed_volumes(everything, closed))
    if (volumes <= 0).any():
        i = int(np.argmin(volumes))
        first = int(np.flatnonzero(piece == i)[0])
        raise ValueError(
            f"the surface is inside out: piece {i}, of triangle {first}, encloses {volumes[i]:.6g} m^3, so that pressure would pull it in. "
            f"Turn its triangles over, by js.cloth.rewound(net, points), or pass triangles[:, ::-1]."
        )
    if is_gas and len(volumes) > 1:
        raise ValueError(f"{len(volumes)} closed pieces do not share one gas. Give each a Pressure of its own, with triangles=.")


__all__ = ["Pressure"]
