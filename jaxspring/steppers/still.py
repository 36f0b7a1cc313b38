"""Nodes that do not move: for scenes of heat alone."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from ..bound import BoundSystem
from ..state import State
from .base import Stepper


class Still(Stepper):
    """Leaves every node where it is and as fast as it is; time passes, and rules act.

    Forces are not evaluated. Nodes on a schedule still follow it.
    """

    def step(self, system: BoundSystem, state: State, dt: Array, memory: None) -> tuple[State, None]:
        """The same state."""
        return state, None

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """Infinite: only rules limit dt."""
        return jnp.full_like(squared_frequency, jnp.inf)


__all__ = ["Still"]
