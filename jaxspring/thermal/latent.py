"""Latent heat by enthalpy: what melting takes up is kept beside the temperature.

    heat of a node                 C theta + h                           [J]   0 <= h <= L: 0 solid, L liquid
    one variable for both          y = (theta - theta_m) + h / C         [K]   heat above the solid at the melting point, over C
    and back                       h = C clip(y, 0, L / C)                     theta = theta_m + y - h / C

`theta` never falls as `y` rises: below 0 and above L / C with slope 1, between them not at all (the plateau). Schemes advance `y`, so that
no heat is lost where nodes melt, however long the step. Solid and liquid have the same capacity.

Source: Voller, Cross and Markatos (1987); the variable is enthalpy over capacity.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import node_values, nonnegative
from ..forces.base import any_refused
from ..topology.base import Topology


class LatentHeat(eqx.Module):
    """Melting at one temperature, with a latent heat. Differentiable in both.

    Attributes:
        melting: melting point [K], a number, or (N,) in the user's order; once it is in a `Heat`, a node array.
        latent: heat that melts a node [J], likewise.

    Raises:
        ValueError: a negative latent heat, a value that is not finite.
    """

    melting: Array
    latent: Array

    def __init__(self, melting: Numbers, latent: Numbers):
        self.melting = node_values("melting", melting)
        self.latent = node_values("latent", latent)
        nonnegative("latent", self.latent, "Melting takes heat up.")

    def on(self, net: Topology) -> LatentHeat:
        """The same with its values in node shape.

        Raises:
            ValueError: values of another shape than one number or one per node.
        """
        values = (net.node_field(self.melting, "latent.melting"), net.node_field(self.latent, "latent.latent"))
        return eqx.tree_at(lambda law: (law.melting, law.latent), self, values)

    def taken_up(self, temperature: Array) -> Array:
        """Latent heat of nodes at these temperatures [J]: none up to the melting point, all above it."""
        full = jnp.broadcast_to(self.latent, temperature.shape)
        return jnp.where(temperature > self.melting, full, jnp.zeros_like(full))

    def joined(self, temperature: Array, enthalpy: Array, capacity: Array) -> Array:
        """The variable y [K] of nodes with these temperatures [K] and latent heats [J]."""
        return temperature - self.melting + enthalpy / capacity

    def temperature(self, y: Array, capacity: Array) -> Array:
        """Temperature of the variable y [K]."""
        # In this order nodes that melt are at the melting point exactly.
        return self.melting + self.above(y, capacity)

    def above(self, y: Array, capacity: Array) -> Array:
        """Temperature over the melting point [K]."""
        return y - self._plateau(y, capacity)

    def enthalpy(self, y: Array, capacity: Array) -> Array:
        """Latent heat taken up [J]."""
        return capacity * self._plateau(y, capacity)

    def is_melting(self, y: Array, capacity: Array) -> Array:
        """Which nodes are on the plateau, where heat does not change the temperature."""
        return (y >= 0) & (y <= self.latent / capacity)

    def _plateau(self, y: Array, capacity: Array) -> Array:
        return jnp.clip(y, jnp.zeros_like(y), jnp.broadcast_to(self.latent / capacity, y.shape))

    def invalid(self) -> Array:
        """Whether the latent heat is negative or not finite."""
        return any_refused(self.latent)


__all__ = ["LatentHeat"]
