"""A hot surface that heats what touches it: Newton's term on every node within reach of a plane.

    s_i = (x_i - p) . n                                          [m]   height over the plane; below it, s < 0, counts as touching
    P_i = w(s_i) h A_i (theta_plane - theta_i)                   [W]   w = 1 for s <= reach, falling linearly to 0 at reach + fade

The reaction force of the surface is another effect, named apart.

Source: the hot constraint surfaces of Terzopoulos, Platt and Fleischer (1989); the law of the contact is Newton's.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, node_values, nonnegative, plane
from ..forces.base import any_refused
from ..state import State
from ..topology.base import Topology
from .boundaries import Given, ThermalBoundary, at_time


class HotPlane(ThermalBoundary):
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

    is_linear: ClassVar[bool] = True
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
        self.temperature = temperature if callable(temperature) else as_inexact("temperature", temperature)
        self.coefficient = as_inexact("coefficient", coefficient)
        self.area = node_values("area", area)
        self.reach = as_inexact("reach", reach)
        self.fade = as_inexact("fade", fade)
        numbers = {"coefficient": self.coefficient, "reach": self.reach, "fade": self.fade}
        for name, value in (numbers if callable(temperature) else {**numbers, "temperature": self.temperature}).items():
            has_shape(name, value, {"one number": ()})
            finite(name, value)
        for name, value in (("coefficient", self.coefficient), ("area", self.area), ("fade", self.fade)):
            nonnegative(name, value, "Heat would flow from cold to hot." if name != "fade" else "A length cannot be negative.")

    def on(self, net: Topology, name: str) -> HotPlane:
        """The same with its areas in node shape.

        Raises:
            ValueError: areas of another shape than one number or one per node.
        """
        return eqx.tree_at(lambda plane: plane.area, self, net.node_field(self.area, f"{name}.area"))

    def contact(self, state: State) -> Array:
        """How well each node touches the plane: 1 within reach, 0 away from it."""
        if self.point.shape[0] != state.dim:
            raise ValueError(f"the plane has {self.point.shape[0]} coordinates, the positions have {state.dim}.")
        beyond = -self.reach * jnp.ones_like(state.position[0])
        for x, p, n in zip(state.position, self.point, self.normal, strict=True):
            beyond = beyond + n * (x - p)
        one, zero = jnp.ones_like(beyond), jnp.zeros_like(beyond)
        fades = self.fade > 0
        ramp = jnp.clip(1 - beyond / jnp.where(fades, self.fade, jnp.ones_like(self.fade)), 0, 1)
        return jnp.where(fades, ramp, jnp.where(beyond <= 0, one, zero))

    def power(self, state: State, temperature: Array) -> Array:
        """Heat per time w h A (theta_plane - theta) [W]."""
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


__all__ = ["HotPlane"]
