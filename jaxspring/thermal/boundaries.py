"""What happens to heat at the surface: fixed temperature, prescribed flux, convection, radiation. Insulated is what no boundary names.

    fixed        theta = theta_0                                     [K]
    flux         P_i = q A_i                                         [W]   q > 0 heats
    convection   P_i = h A_i (theta_a - theta_i)                     [W]   Newton's law of cooling
    radiation    P_i = e sigma A_i (theta_a^4 - theta_i^4)           [W]   Stefan and Boltzmann's law, theta absolute

A surface that heats what touches it depends on where the nodes are: see `hot_plane.py`.

Source: Carslaw and Jaeger, Conduction of Heat in Solids (1959), section 1.9.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers, as_mask, own
from .._checks import as_inexact, finite, has_shape, is_concrete, nonnegative
from ..forces.base import any_refused
from ..state import State
from ..topology.base import NodeLayout, Topology

# Numbers, or a function of time [s] that gives them.
Given: TypeAlias = "Numbers | Callable[[Array], Numbers]"

# CODATA 2018, exact to the digits given [W/(m^2 K^4)].
STEFAN_BOLTZMANN = 5.670374419e-8


class ThermalBoundary(eqx.Module):
    """Heat that enters nodes from outside. Abstract.

    To write your own, give `power`. It may depend on the node's own temperature, on where it is and on the time, never on the
    temperature of other nodes. Say `is_linear = True` where the power is linear in the temperature: implicit schemes then need one
    linear solve.
    """

    is_linear: ClassVar[bool] = False

    def on(self, net: Topology, name: str) -> Self:
        """The same in a rule on this net; `name` is what it is called in an error.

        Raises:
            ValueError: nodes that are those of another net.
        """
        for mask in (getattr(self, "nodes", None), self.held()):
            if mask is not None and mask.shape != net.node_shape:
                raise ValueError(
                    f"{name} ({type(self).__name__}) names nodes on a net of shape {mask.shape}; expected {net.node_shape}, that of Heat's "
                    f"net. Unchecked, it would act on other nodes. Build it with the net that you give Heat."
                )
        if getattr(self, "layout", net.layout) != net.layout:
            raise ValueError(
                f"{name} ({type(self).__name__}) names nodes on a net in another order inside than Heat's net. Unchecked, it "
                f"would act on other nodes. Build it with the net that you give Heat."
            )
        return self

    def power(self, state: State, temperature: Array) -> Array | None:
        """Heat per time into each node [W], in node shape, at these temperatures [K]; None where it is none."""
        return None

    def slope(self, state: State, temperature: Array) -> Array | None:
        """Minus the derivative of `power` by the node's own temperature [W/K], zero or more."""
        power, rate = jax.jvp(lambda t: _or_zero(self.power(state, t), t), (temperature,), (jnp.ones_like(temperature),))
        return jnp.maximum(-rate, jnp.zeros_like(power))

    def slope_bound(self, state: State, temperature: Array) -> Array | None:
        """Upper bound of `slope` for wherever the nodes go [W/K], for the limit of explicit steps."""
        return self.slope(state, temperature)

    def held(self) -> Array | None:
        """Which nodes have their temperature given: bool in node shape; None where none has."""
        return None

    def given(self, time: Array, temperature: Array) -> Array:
        """The temperatures [K], with those that this boundary gives in their place."""
        return temperature

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse."""
        return None


class FixedTemperature(ThermalBoundary):
    """Nodes whose temperature is given; what flows into or out of them is not counted as the body's heat.

    Attributes:
        nodes: bool, node shape.
        temperature: [K]: a number, a node array, or a function of time [s] that gives one.
        layout: how the nodes of the net are kept (static).

    Raises:
        ValueError: a wrong shape, a temperature that is not finite.
        TypeError: `nodes` that is not boolean.

    >>> import jaxspring as js
    >>> net = js.lattice(5)
    >>> cold_end = FixedTemperature(net, np.arange(5) == 0, 300.0)
    """

    is_linear: ClassVar[bool] = True
    nodes: Array
    temperature: Given
    layout: NodeLayout = eqx.field(static=True)

    def __init__(self, net: Topology, nodes: Numbers, temperature: Given):
        """Check what is given, and bring it to the shape of the net.

        Args:
            net: the topology.
            nodes: (N,) booleans in the user's order.
            temperature: [K]: a number, (N,) in the user's order, or a function of time [s] that gives a number or a node array.
        """
        self.nodes, self.layout = _mask(net, nodes), net.layout
        self.temperature = _given(net, "temperature", temperature)

    def held(self) -> Array:
        """The nodes of given temperature."""
        return self.nodes

    def given(self, time: Array, temperature: Array) -> Array:
        """The temperatures with the given ones in their place [K]."""
        return jnp.where(self.nodes, at_time(self.temperature, time, temperature), temperature)


class HeatFlux(ThermalBoundary):
    """A prescribed flux through the surface of nodes.

    Attributes:
        nodes: bool, node shape.
        flux: [W/m^2], positive heats: a number, a node array, or a function of time [s] that gives one.
        area: surface of each node [m^2], a number or a node array.
        layout: how the nodes of the net are kept (static).

    Raises:
        ValueError: a wrong shape, a flux that is not finite, a negative area.
        TypeError: `nodes` that is not boolean.
    """

    is_linear: ClassVar[bool] = True
    nodes: Array
    flux: Given
    area: Array
    layout: NodeLayout = eqx.field(static=True)

    def __init__(self, net: Topology, nodes: Numbers, flux: Given, area: Numbers):
        """Check what is given, and bring it to the shape of the net.

        Args:
            net: the topology.
            nodes: (N,) booleans in the user's order.
            flux: [W/m^2]: a number, (N,) in the user's order, or a function of time [s] that gives a number or a node array.
            area: [m^2]: a number, or (N,) in the user's order.
        """
        self.nodes, self.layout = _mask(net, nodes), net.layout
        self.flux = _given(net, "flux", flux)
        self.area = _nonnegative(net, "area", area)

    def power(self, state: State, temperature: Array) -> Array:
        """Flux times area [W]."""
        return _there(self.nodes, at_time(self.flux, state.time, temperature) * self.area, temperature)

    def slope(self, state: State, temperature: Array) -> None:
        """No slope: the flux does not look at the temperature."""

    def invalid(self) -> Array:
        """Whether the area is negative or not finite."""
        return any_refused(self.area)


class Convection(ThermalBoundary):
    """Newton's law of cooling: a surface in a moving fluid.

    Attributes:
        nodes: bool, node shape.
        coefficient: h [W/(m^2 K)], a number or a node array.
        ambient: temperature of the fluid [K]: a number, a node array, or a function of time [s] that gives one.
        area: surface of each node [m^2], a number or a node array.
        layout: how the nodes of the net are kept (static).

    Raises:
        ValueError: a wrong shape, a negative coefficient or area, a temperature that is not finite.
        TypeError: `nodes` that is not boolean.
    """

    is_linear: ClassVar[bool] = True
    nodes: Array
    coefficient: Array
    ambient: Given
    area: Array
    layout: NodeLayout = eqx.field(static=True)

    def __init__(self, net: Topology, nodes: Numbers, coefficient: Numbers, ambient: Given, area: Numbers):
        """Check what is given, and bring it to the shape of the net.

        Args:
            net: the topology.
            nodes: (N,) booleans in the user's order.
            coefficient: [W/(m^2 K)]: a number, or (N,) in the user's order.
            ambient: [K]: a number, (N,) in the user's order, or a function of time [s] that gives a number or a node array.
            area: [m^2]: a number, or (N,) in the user's order.
        """
        self.nodes, self.layout = _mask(net, nodes), net.layout
        self.coefficient = _nonnegative(net, "coefficient", coefficient)
        self.ambient = _given(net, "ambient", ambient)
        self.area = _nonnegative(net, "area", area)

    def power(self, state: State, temperature: Array) -> Array:
        """Heat per time h A (theta_a - theta) [W]."""
        return self._conductance(temperature) * (at_time(self.ambient, state.time, temperature) - temperature)

    def slope(self, state: State, temperature: Array) -> Array:
        """Coefficient times area, h A [W/K]."""
        return self._conductance(temperature)

    def _conductance(self, like: Array) -> Array:
        return _there(self.nodes, self.coefficient * self.area, like)

    def invalid(self) -> Array:
        """Whether the coefficient or the area is negative or not finite."""
        return any_refused(self.coefficient, self.area)


class Radiation(ThermalBoundary):
    """Stefan and Boltzmann's law of a grey surface among surroundings of one temperature; temperatures are absolute.

    Attributes:
        nodes: bool, node shape.
        emissivity: between 0 and 1, a number or a node array.
        ambient: temperature of the surroundings [K]: a number, a node array, or a function of time [s] that gives one.
        area: surface of each node [m^2], a number or a node array.
        layout: how the nodes of the net are kept (static).

    Raises:
        ValueError: a wrong shape, an emissivity below 0 or above 1, a negative area, a temperature that is not finite.
        TypeError: `nodes` that is not boolean.
    """

    nodes: Array
    emissivity: Array
    ambient: Given
    area: Array
    layout: NodeLayout = eqx.field(static=True)

    def __init__(self, net: Topology, nodes: Numbers, emissivity: Numbers, ambient: Given, area: Numbers):
        """Check what is given, and bring it to the shape of the net.

        Args:
            net: the topology.
            nodes: (N,) booleans in the user's order.
            emissivity: between 0 and 1: a number, or (N,) in the user's order.
            ambient: [K]: a number, (N,) in the user's order, or a function of time [s] that gives a number or a node array.
            area: [m^2]: a number, or (N,) in the user's order.
        """
        self.nodes, self.layout = _mask(net, nodes), net.layout
        self.emissivity = _nonnegative(net, "emissivity", emissivity)
        if is_concrete(self.emissivity) and np.any(np.asarray(self.emissivity) > 1):
            raise ValueError(
                f"emissivity = {float(jnp.max(self.emissivity))}, but must be between 0 and 1: no surface radiates more than a black one. "
                f"Pass a larger area if that is meant."
            )
        self.ambient = _given(net, "ambient", ambient)
        self.area = _nonnegative(net, "area", area)

    def power(self, state: State, temperature: Array) -> Array:
        """Heat per time e sigma A (theta_a^4 - theta^3 abs(theta)) [W]."""
        ambient = at_time(self.ambient, state.time, temperature)
        # A product of differences: no digit is lost where the two are near.
        difference = (ambient - temperature) * (ambient + temperature) * (ambient**2 + temperature**2)
        # Below zero, where a step too long may lead, the odd power still pulls back: heat falls as temperature rises, everywhere.
        difference = jnp.where(temperature < 0, ambient**4 + temperature**4, difference)
        return self._factor(temperature) * difference

    def slope(self, state: State, temperature: Array) -> Array:
        """Derivative 4 e sigma A theta^3 [W/K]."""
        return self._factor(temperature) * 4 * jnp.abs(temperature) ** 3

    def slope_bound(self, state: State, temperature: Array) -> Array:
        """The slope at the hotter of node and surroundings [W/K]."""
        return self.slope(state, jnp.maximum(jnp.abs(temperature), at_time(self.ambient, state.time, temperature)))

    def _factor(self, like: Array) -> Array:
        return _there(self.nodes, STEFAN_BOLTZMANN * self.emissivity * self.area, like)

    def invalid(self) -> Array:
        """Whether the emissivity is not between 0 and 1, or the area negative or not finite."""
        return any_refused(self.emissivity, self.area) | jnp.any(self.emissivity > 1)


def at_time(value: Given, time: Array, like: Array) -> Array:
    """A constant, or a function of time taken now, as a node array of the dtype of `like`."""
    now = own("what a function of time returned", value(time) if callable(value) else value, like.dtype)
    has_shape("what a function of time returned", now, {"one number": (), "node shape": like.shape})
    return jnp.broadcast_to(now, like.shape)


def _there(nodes: Array, value: Array, like: Array) -> Array:
    value = jnp.broadcast_to(value.astype(like.dtype), like.shape)
    return jnp.where(nodes, value, jnp.zeros_like(value))


def _or_zero(power: Array | None, like: Array) -> Array:
    return jnp.zeros_like(like) if power is None else power


def _mask(net: Topology, nodes: Any) -> Array:
    nodes = as_mask("nodes", nodes, ", one per node")
    has_shape("nodes", nodes, {"one per node": (net.n_nodes,), "node shape": net.node_shape})
    return net.node_field(nodes, "nodes")


def _given(net: Topology, name: str, value: Any) -> Any:
    if callable(value):
        return value
    value = as_inexact(name, value)
    finite(name, value)
    return net.node_field(value, name)


def _nonnegative(net: Topology, name: str, value: Any) -> Array:
    value = as_inexact(name, value)
    nonnegative(name, value, "Heat would flow from cold to hot.")
    return net.node_field(value, name)


__all__ = ["Convection", "FixedTemperature", "HeatFlux", "Radiation", "ThermalBoundary", "at_time"]
