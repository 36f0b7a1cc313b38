"""A hot surface that heats what touches it: Newton's term on every node within reach of an obstacle.

    s_i = distance of x_i to the surface                         [m]   for a plane (x_i - p) . n; inside, s < 0, counts as touching
    P_i = w(s_i) h A_i (theta_surface - theta_i)                 [W]   w = 1 for s <= reach, falling linearly to 0 at reach + fade

The reaction force of the surface is another effect, named apart.

Source: the hot constraint surfaces of Terzopoulos, Platt and Fleischer (1989); the law of the contact is Newton's.
"""

from __future__ import annotations

import abc
from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, kind, node_values, nonnegative, plane
from ..contact.base import Obstacle
from ..forces.base import any_refused
from ..state import State
from ..topology.base import Topology
from .boundaries import Given, ThermalBoundary, at_time


class _HotBoundary(ThermalBoundary):
    """What hot planes and other surfaces share: Newton's term, and where it fades. Abstract."""

    is_linear: ClassVar[bool] = True
    temperature: eqx.AbstractVar[Given]
    coefficient: eqx.AbstractVar[Array]
    area: eqx.AbstractVar[Array]
    reach: eqx.AbstractVar[Array]
    fade: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def height(self, state: State) -> Array:
        """Distance of each node to the surface [m], in node shape; below zero inside."""

    def on(self, net: Topology, name: str) -> Self:
        """The same with its areas in node shape.

        Raises:
            ValueError: areas of another shape than one number or one per node.
        """
        return eqx.tree_at(lambda surface: surface.area, self, net.node_field(self.area, f"{name}.area"))

    def contact(self, state: State) -> Array:
        """How well each node touches: 1 within reach, 0 away from it."""
        beyond = self.height(state) - self.reach
        one, zero = jnp.ones_like(beyond), jnp.zeros_like(beyond)
        fades = self.fade > 0
        ramp = jnp.clip(1 - beyond / jnp.where(fades, self.fade, jnp.ones_like(self.fade)), 0, 1)
        return jnp.where(fades, ramp, jnp.where(beyond <= 0, one, zero))

    def power(self, state: State, temperature: Array) -> Array:
        """Heat per time w h A (theta_surface - theta) [W]."""
        return self.slope(state, temperature) * (at_time(self.temperature, state.time, temperature) - temperature)

    def slope(self, state: State, temperature: Array) -> Array:
        """Contact times coefficient times area, w h A [W/K]."""
        return self.contact(state) * self.coefficient * self.area

    def slope_bound(self, state: State, temperature: Array) -> Array:
        """Coefficient times area, as if all nodes touched [W/K]."""
        return jnp.broadcast_to(self.coefficient * self.area, temperature.shape)

    def invalid(self) -> Array:
        """Whether coefficient, area or fade is negative or not finite."""
        return any_refused(self.coefficient, self.area, self.fade)


class HotPlane(_HotBoundary):
    """A plane that heats (or cools) the nodes within its reach.

    Attributes:
        point: (D,) a point of the plane [m].
        normal: (D,) its normal, away from the wall; of length one.
        temperature: [K], a number, or a function of time [s] that gives one.
        coefficient: h [W/(m^2 K)].
        area: of contact of each node [m^2], a number, or (N,) in the user's order; once it is in a `Heat`, a node array.
        reach: a node lower than this over the plane touches it [m].
        fade: over this height beyond the reach the contact falls to nothing [m]. With 0 it ends at once: the heat then has no
            derivative by the position.

    Raises:
        ValueError: a negative coefficient, area or fade, a normal without length, shapes that differ.
    """

    point: Array
    normal: Array
    temperature: Given
    coefficient: Array
    area: Array
    reach: Array
    fade: Array

    def __init__(
        self,
        point: Numbers,
        normal: Numbers,
        temperature: Numbers,
        coefficient: Numbers,
        area: Numbers,
        reach: Numbers,
        fade: Numbers = 0.0,
    ):
        """Check what is given.

        Args:
            point: (D,) [m].
            normal: (D,), of any length.
            temperature: [K].
            coefficient: [W/(m^2 K)].
            area: [m^2]: a number, or (N,) in the user's order.
            reach: [m].
            fade: [m].
        """
        self.point, self.normal = plane(point, normal)
        self.temperature, self.coefficient, self.area, self.reach, self.fade = _constants(temperature, coefficient, area, reach, fade)

    def height(self, state: State) -> Array:
        """(x - p) . n of each node [m], in node shape."""
        if self.point.shape[0] != state.dim:
            raise ValueError(f"the plane has {self.point.shape[0]} coordinates, the positions have {state.dim}.")
        total = jnp.zeros_like(state.position[0])
        for x, p, n in zip(state.position, self.point, self.normal, strict=True):
            total = total + n * (x - p)
        return total


class HotSurface(_HotBoundary):
    """An obstacle of any form that heats (or cools) the nodes within its reach: a hot ball, a rod, a moving stamp.

    Attributes:
        obstacle: `js.contact.Sphere`, any obstacle; it may move.
        temperature: [K], a number, or a function of time [s] that gives one.
        coefficient: h [W/(m^2 K)].
        area: of contact of each node [m^2], a number, or (N,) in the user's order; once it is in a `Heat`, a node array.
        reach: a node nearer than this to the surface touches it [m].
        fade: over this distance beyond the reach the contact falls to nothing [m]. With 0 it ends at once: the heat then has no
            derivative by the position.

    Raises:
        TypeError: what is no obstacle.
        ValueError: a negative coefficient, area or fade, shapes that differ.

    >>> ball = js.contact.Sphere((0.0, 0.0), 1.0)
    >>> hot = HotSurface(ball, temperature=400.0, coefficient=5.0, area=0.1, reach=0.1, fade=0.2)
    >>> state = js.State.from_points(js.lattice(3), [[1.0, 0.0], [1.2, 0.0], [2.0, 0.0]])
    >>> print(hot.contact(state).round(3))
    [1.  0.5 0. ]
    """

    obstacle: Obstacle
    temperature: Given
    coefficient: Array
    area: Array
    reach: Array
    fade: Array

    def __init__(self, obstacle: Obstacle, temperature: Numbers, coefficient: Numbers, area: Numbers, reach: Numbers, fade: Numbers = 0.0):
        """Check what is given.

        Args:
            obstacle: what is hot.
            temperature: [K].
            coefficient: [W/(m^2 K)].
            area: [m^2]: a number, or (N,) in the user's order.
            reach: [m].
            fade: [m].
        """
        self.obstacle = kind("obstacle", obstacle, Obstacle, "Sphere((0.0, 0.0), 1.0)")
        self.temperature, self.coefficient, self.area, self.reach, self.fade = _constants(temperature, coefficient, area, reach, fade)

    def height(self, state: State) -> Array:
        """Distance of each node to the surface [m], in node shape; below zero inside."""
        self.obstacle.check(state.dim)
        return self.obstacle.distance(state.position, state.time)

    def invalid(self) -> Array:
        """Whether coefficient, area or fade is negative or not finite, or the obstacle has a constant that it would refuse."""
        bad, of_obstacle = super().invalid(), self.obstacle.invalid()
        return bad if of_obstacle is None else bad | of_obstacle


def _constants(
    temperature: Numbers, coefficient: Numbers, area: Numbers, reach: Numbers, fade: Numbers
) -> tuple[Given, Array, Array, Array, Array]:
    """The constants, checked."""
    heat = temperature if callable(temperature) else as_inexact("temperature", temperature)
    numbers = {name: as_inexact(name, value) for name, value in {"coefficient": coefficient, "reach": reach, "fade": fade}.items()}
    areas = node_values("area", area)
    for name, value in (numbers if callable(temperature) else {**numbers, "temperature": heat}).items():
        has_shape(name, value, {"one number": ()})
        finite(name, value)
    for name, value in (("coefficient", numbers["coefficient"]), ("area", areas), ("fade", numbers["fade"])):
        nonnegative(name, value, "Heat would flow from cold to hot." if name != "fade" else "A length cannot be negative.")
    return heat, numbers["coefficient"], areas, numbers["reach"], numbers["fade"]


__all__ = ["HotPlane", "HotSurface"]
