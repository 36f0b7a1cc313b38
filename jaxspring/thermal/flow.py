"""What heats each node at one place and time: conduction along springs, sources, boundaries.

    C_i dtheta_i/dt = sum_j G_ij (theta_j - theta_i) + q_i + sum of boundaries P_i(theta_i)          [W]

in `difference` and `accumulate` as springs have it: the heat that leaves a tail enters the head, to the last bit, so that conduction
neither makes nor loses heat. The unknown is `y`: the temperature, or with latent heat the variable of `latent.py`.

Source: slide "Heating and Melting", conservative form for properties that vary.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..linalg.operators import Blocks, SpringBlocks, SpringMatrix
from ..state import State
from ..vector import Vector
from .boundaries import Given, ThermalBoundary, at_time
from .latent import LatentHeat


class Flow(eqx.Module):
    """Everything that heats the nodes while they stay where they are.

    Attributes:
        capacity: C [J/K], node shape.
        links: conductances G [W/K], one term per set of springs.
        boundaries: what enters from outside.
        source: [W], or None.
        latent: melting, or None.
        state: where the nodes are, and the time.
    """

    capacity: Array
    links: tuple[SpringBlocks, ...]
    boundaries: tuple[ThermalBoundary, ...]
    source: Given | None
    latent: LatentHeat | None
    state: State

    def at(self, time: Array) -> Flow:
        """The same at another time [s]."""
        return dataclasses.replace(self, state=self.state.moved(self.state.position, self.state.velocity, time))

    @property
    def is_linear(self) -> bool:
        """Whether the power is linear in y."""
        return self.latent is None and all(b.is_linear for b in self.boundaries)

    def held(self) -> Array | None:
        """Which nodes have their temperature given; None where none has."""
        masks = [m for m in (b.held() for b in self.boundaries) if m is not None]
        total = None
        for mask in masks:
            total = mask if total is None else total | mask
        return total

    def hold(self, y: Array) -> Array:
        """The unknown y with the given temperatures in their place."""
        held = self.held()
        if held is None:
            return y
        temperature = self.temperature(y)
        given = temperature
        for boundary in self.boundaries:
            given = boundary.given(self.state.time, given)
        return jnp.where(held, self.entered(given, None), y)

    def entered(self, temperature: Array, enthalpy: Array | None) -> Array:
        """The unknown y [K] of these temperatures [K] and latent heats [J] (None: by the temperature)."""
        if self.latent is None:
            return temperature
        taken_up = self.latent.taken_up(temperature) if enthalpy is None else enthalpy
        return self.latent.joined(temperature, taken_up, self.capacity)

    def temperature(self, y: Array) -> Array:
        """Temperature of the unknown y [K]."""
        return y if self.latent is None else self.latent.temperature(y, self.capacity)

    def is_melting(self, y: Array) -> Array | None:
        """Which nodes keep their temperature whatever heat they get; None without latent heat."""
        return None if self.latent is None else self.latent.is_melting(y, self.capacity)

    def power(self, temperature: Array) -> Array:
        """Heat per time into each node [W], by whatever way."""
        total = self.supplied(temperature)
        for link in self.links:
            total = total - link.product(Vector((temperature,)))[0]
        return total

    def supplied(self, temperature: Array) -> Array:
        """Heat per time into each node from outside [W]: sources and boundaries, without what fixed temperatures take or give."""
        total = jnp.zeros_like(temperature)
        if self.source is not None:
            total = total + at_time(self.source, self.state.time, temperature)
        for boundary in self.boundaries:
            power = boundary.power(self.state, temperature)
            total = total if power is None else total + power
        return total

    def slope(self, temperature: Array) -> Array | None:
        """Minus the derivative of what boundaries supply by the node's own temperature [W/K]; None where it is zero."""
        slopes = [s for s in (b.slope(self.state, temperature) for b in self.boundaries) if s is not None]
        total = None
        for s in slopes:
            total = s if total is None else total + s
        return total

    def matrix(self, y: Array, dt: Any) -> SpringMatrix:
        """The matrix C + dt (slopes + conductances) [J/K] over the nodes whose temperature is free to change, identity for the others."""
        temperature = self.temperature(y)
        diagonal, slope = self.capacity, self.slope(temperature)
        if slope is not None:
            diagonal = diagonal + dt * slope
        springs = tuple(link.scaled(dt) for link in self.links)
        fixed, melting = self.held(), self.is_melting(y)
        stuck = melting if fixed is None else fixed if melting is None else fixed | melting
        free = None if stuck is None else ~stuck
        return SpringMatrix(Blocks((Vector((diagonal,)),), (), springs), (free,), Vector((temperature,)), self.state.layout)


__all__ = ["Flow"]
