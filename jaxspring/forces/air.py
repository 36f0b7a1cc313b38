"""Air on cloth: drag, lift and wind, triangle by triangle.

    w = u - (v_a + v_b + v_c) / 3        the wind as the triangle feels it [m/s]         u: the air's velocity at its middle
    w_n = w . n,   w_t = w - w_n n       across it and along it                          n -> -n changes nothing

    F = rho/2 A [ C_d |w_n| w_n n                        pressure across the triangle
                + C_f |w_t| w_t                          friction along it
                + C_l (w_n |w| n - w_n^2 w / |w|) ]      lift, across the wind: C_l |w|^2 sin cos of the angle of attack
      + c A w_n n                                        the linear form, as Provot has it

by thirds to its corners. In still air, without a wind, it takes energy out and never feeds any in. In an implicit step the matrix holds

    G = A/3 [ (rho C_d |w_n| + c) n n' + rho/2 C_f (|w_t| (I - n n') + w_t w_t' / |w_t|) ]

at each corner: the three corners' shared block, summed over its row. What changes with the place, and lift, are taken at the old time;
Newton's step takes all of it at the new time.

Source: the quadratic law is that of a flat plate; Provot (1995) for the linear one (C_vi = c times the area of a node); lift as in
Keckeisen and others (2004), "Wind for cloth simulation"; Wejchert and Haumann (1991), "Animation aerodynamics".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, nonnegative, shape_of
from ..contact.base import length, unit
from ..contact.node_blocks import blocks_of
from ..linalg.operators import Blocks
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..topology.corners import Corners
from ..vector import Vector
from .base import Force, Scene, any_refused
from .triangles import area_vectors, check_space, corners_of, perimeters, thirds

Wind = Callable[[Vector, Array], Vector]
COEFFICIENTS = ("drag", "friction", "lift", "viscous")


class Air(Force):
    """Drag, lift and wind on the triangles of a surface, in space.

    A triangle without area feels nothing. Triangles of any winding will do.

    Attributes:
        net: the topology.
        drag: C_d, one number or (T,); a flat plate across the wind has 1.1 to 1.3.
        friction: C_f along the surface, one number or (T,), or None; 0.01 to 0.05 for cloth.
        lift: C_l across the wind, one number or (T,), or None. The pressure across the triangle is in part lift already.
        viscous: c of the linear form [N s/m^3], one number or (T,), or None.
        density: rho of the air [kg/m^3].
        wind: velocity of the air [m/s]: (3,), or a function (places, time) -> velocities, both `Vector`s of the T middles, time in seconds;
            a module with arrays of its own can be fitted. None: still air.
        triangles: their corners.

    Raises:
        ValueError: a negative coefficient, a shape that is neither one number nor one per triangle, a net without triangles.

    >>> import jax.numpy as jnp
    >>> net, points = js.cloth.rectangle(1.0, 1.0, 0.25)
    >>> gust = lambda places, t: js.Vector((0 * places.x, 0 * places.x, 10.0 + jnp.sin(t) * places.x))
    >>> push = Air(net, drag=1.2, wind=gust).force(js.State.from_points(net, points))
    >>> print(round(float(push.z.sum()), 4))  # 1.2 kg/m^3 / 2 * 1.2 * 1 m^2 * (10 m/s)^2
    72.0
    """

    net: Topology
    drag: Array
    friction: Array | None
    lift: Array | None
    viscous: Array | None
    density: Array
    wind: Array | Wind | None
    triangles: Corners

    def __init__(
        self,
        net: Topology,
        drag: Numbers = 1.2,
        friction: Numbers | None = None,
        lift: Numbers | None = None,
        viscous: Numbers | None = None,
        density: Numbers = 1.2,
        wind: Numbers | Wind | None = None,
        triangles: Numbers | Corners | None = None,
    ):
        """Check what is given.

        Args:
            net: the topology.
            drag: C_d across a triangle.
            friction: C_f along it; None: none.
            lift: C_l; None: none.
            viscous: c [N s/m^3]; None: none. For the linear form alone pass `drag=0.0`.
            density: rho [kg/m^3], one number; 1.2 unless said, of air at 20 degrees Celsius.
            wind: (3,) [m/s], or a function of places and time; None: still air.
            triangles: (T, 3) node numbers; None: those of the net, or the halves of a lattice's squares.
        """
        self.net = net
        self.triangles = corners_of(net, triangles)
        n = self.triangles.cells.shape[1]
        for name, value in zip(COEFFICIENTS, (drag, friction, lift, viscous), strict=True):
            setattr(self, name, None if value is None else _coefficient(name, value, n))
        self.density = as_inexact("density", density)
        has_shape("density", self.density, {"one number": ()})
        nonnegative("density", self.density, "Air pulls nothing.")
        if wind is None or callable(wind):
            self.wind = wind
        else:
            self.wind = as_inexact("wind", wind)
            has_shape("wind", self.wind, {"a velocity": (3,)})
            finite("wind", self.wind)

    def force(self, state: State) -> Vector:
        """What the air does to each node [N]."""
        return thirds(self.triangles, self.on_triangles(state))

    def on_triangles(self, state: State) -> Vector:
        """The force on each triangle [N], in the order of the triangles."""
        area, n, w = self._felt(state)
        across = w.dot(n)
        half = 0.5 * self.density.astype(state.dtype)
        normal = half * self.drag * jnp.abs(across) * across
        if self.viscous is not None:
            normal = normal + self.viscous * across
        total = (area * normal) * n
        if self.friction is not None:
            along = w - across * n
            total = total + (area * half * self.friction * length(along)) * along
        if self.lift is not None:
            total = total + (area * half * self.lift) * ((across * length(w)) * n - (across * across) * unit(w))
        return total

    @property
    def is_symmetric(self) -> bool:
        """Whether -dF/dx is symmetric: what the air does changes with the place by no potential."""
        return False

    @property
    def can_feed(self) -> bool:
        """Whether it can raise the energy: where there is a wind."""
        return self.wind is not None

    def damping_blocks(self, state: State) -> Blocks:
        """G at each node [N s/m], without lift."""
        area, n, w = self._felt(state)
        across, half = w.dot(n), 0.5 * self.density.astype(state.dtype)
        normal = 2 * half * self.drag * jnp.abs(across)
        if self.viscous is not None:
            normal = normal + self.viscous
        entries = {(i, j): normal * n[i] * n[j] for i in range(3) for j in range(i, 3)}
        if self.friction is not None:
            along = w - across * n
            ahead, drag = unit(along), half * self.friction * length(along)
            for i, j in entries:
                entries[i, j] = entries[i, j] + drag * ((1.0 if i == j else 0.0) - n[i] * n[j] + ahead[i] * ahead[j])
        upper = {at: thirds(self.triangles, area * entry) for at, entry in entries.items()}
        return blocks_of(tuple(Vector(tuple(upper[min(i, j), max(i, j)] for j in range(3))) for i in range(3)))

    def damping_bound(self, state: State) -> Array:
        """Of the row sums of |dF/dv| at each node [N s/m]."""
        area, _, w = self._felt(state)
        return thirds(self.triangles, area * (self._rho(drag=1.0, friction=1.0, lift=2.0) * length(w) + self._viscous()))

    def stiffness_bound(self, state: State) -> Array:
        """Of the row sums of |dF/dx| at each node [N/m]: by how much triangles turn and grow, in a wind that is even in space."""
        _, _, w = self._felt(state)
        speed = length(w)
        per_area = self._rho(drag=2.0, friction=2.0, lift=3.0) * speed * speed + 3 * self._viscous() * speed
        return thirds(self.triangles, 0.5 * perimeters(self.triangles, state.position) * per_area)

    def invalid(self) -> Array:
        """Whether a coefficient or the density is negative or not finite, or a constant wind not finite."""
        bad = any_refused(self.drag, self.friction, self.lift, self.viscous, self.density)
        return bad if self.wind is None or callable(self.wind) else bad | ~jnp.all(jnp.isfinite(self.wind))

    def bind(self, scene: Scene) -> Air:
        """The same with constants in the dtype of the state."""
        return cast_inexact(self, scene.dtype)

    def _rho(self, drag: float, friction: float, lift: float) -> Array:
        """rho times a weighted sum of the coefficients."""
        weights = ((drag, self.drag), (friction, self.friction), (lift, self.lift))
        return self.density * sum((weight * c for weight, c in weights if c is not None), start=jnp.zeros_like(self.density))

    def _viscous(self) -> Array:
        return jnp.zeros_like(self.drag) if self.viscous is None else self.viscous

    def _felt(self, state: State) -> tuple[Array, Vector, Vector]:
        """Area [m^2] and unit normal of each triangle, zero where it has no area, and the wind it feels [m/s]."""
        check_space(self, state)
        corners = self.triangles
        vector = area_vectors(corners, state.position)
        area, n = length(vector), unit(vector)
        a, b, c = corners.at(state.velocity)
        return area, n, self._blowing(state) - (a + b + c) / 3.0

    def _blowing(self, state: State) -> Vector:
        """The air's velocity at the middle of each triangle [m/s]."""
        first = self.triangles.at(state.position)[0]
        if self.wind is None:
            return Vector.zeros_like(first)
        if not callable(self.wind):
            wind = self.wind.astype(state.dtype)
            return Vector(tuple(jnp.broadcast_to(wind[i], a.shape) for i, a in enumerate(first)))
        ab, ac = self.triangles.apart(state.position)
        found = self.wind(first + (ab + ac) / 3.0, state.time)
        if not isinstance(found, Vector) or found.dim != 3 or any(shape_of(a) not in ((), first.shape) for a in found):
            raise ValueError(
                f"wind must give a Vector of three arrays of shape {first.shape}, a velocity at each of the places it is asked for; got "
                f"{type(found).__name__} of shape {shape_of(found)}."
            )
        return Vector(tuple(jnp.broadcast_to(a, first.shape).astype(state.dtype) for a in found))


def _coefficient(name: str, value: Any, n_triangles: int) -> Array:
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": (), "one per triangle": (n_triangles,)})
    nonnegative(name, value, "Air would push cloth against the wind.")
    return value


__all__ = ["Air", "Wind"]
