"""The state of a simulation: time, position, velocity, and what the scene's effects add."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ._checks import as_inexact
from .topology.base import NodeLayout, Topology
from .vector import Vector


class State(eqx.Module):
    """Where everything is, and how fast it moves. Build it with `State.from_points`.

    Attributes:
        time: [s], a 0-d array.
        position: `Vector` in node shape [m].
        velocity: `Vector` in node shape [m/s].
        layout: how node fields are stored (static).
    """

    time: Array
    position: Vector
    velocity: Vector
    layout: NodeLayout = eqx.field(static=True)

    @staticmethod
    def from_points(net: Topology, points: Any, velocities: Any = None, time: Any = 0.0) -> State:
        """A state from (N, D) arrays in the user's node order.

        Args:
            net: the topology.
            points: (N, D) positions [m], D = 1, 2 or 3. Integers are converted to the default float.
            velocities: (N, D) velocities [m/s]; None is at rest.
            time: [s].

        Raises:
            ValueError: a wrong shape, or a NaN or infinity, named with its index.
            TypeError: half precision, complex numbers.
        """
        position = net.vector_field(points, "points")
        if velocities is None:
            velocity = Vector.zeros_like(position)
        else:
            velocity = net.vector_field(as_inexact("velocities", velocities, position.dtype), "velocities")
            if velocity.dim != position.dim:
                raise ValueError(f"velocities have {velocity.dim} coordinates, points have {position.dim}.")
        return State(jnp.asarray(time, position.dtype), position, velocity, net.layout)

    @property
    def points(self) -> Array:
        """(..., N, D) positions [m] in the user's node order."""
        return jnp.stack([self.layout.flatten(a) for a in self.position], axis=-1)

    @property
    def velocities(self) -> Array:
        """(..., N, D) velocities [m/s] in the user's node order."""
        return jnp.stack([self.layout.flatten(a) for a in self.velocity], axis=-1)

    @property
    def dtype(self) -> jnp.dtype:
        """Floating type of the simulation."""
        return self.position.dtype

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return self.position.dim
