"""Loads: gravity, and forces given by the user, constant or in time."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, fits_nodes, node_values, shape_of
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..vector import Vector
from .base import Force, Scene


class Gravity(Force):
    """Weight of every node, f = m g.

    Attributes:
        acceleration: (D,) [m/s^2], e.g. (0, 0, -9.81).
        mass: [kg], one number or a node array; `System` fills it in.
    """

    acceleration: Array
    mass: Array | None

    def __init__(self, acceleration: Numbers, mass: Numbers | None = None):
        self.acceleration = as_inexact("acceleration", acceleration)
        finite("acceleration", self.acceleration)
        if self.acceleration.ndim != 1 or self.acceleration.shape[0] not in (1, 2, 3):
            raise ValueError(
                f"acceleration has shape {self.acceleration.shape}; expected (D,), one number per coordinate, e.g. (0, 0, -9.81)."
            )
        self.mass = None if mass is None else node_values("mass", mass)

    def bind(self, scene: Scene) -> Gravity:
        """The same gravity acting on the masses of the scene; masses that were given stay."""
        return cast_inexact(self if self.mass is not None else Gravity(self.acceleration, scene.mass), scene.dtype)

    def force(self, state: State) -> Vector:
        """Weight m g [N]."""
        fits_nodes("mass", self._mass(), state)
        return Vector(tuple(self._weight(g, a) for g, a in zip(self._acceleration(state), state.position, strict=True)))

    def energy(self, state: State) -> Array:
        """-m g . x, summed [J]; zero at the origin."""
        mass = self._mass()
        heights = [jnp.sum(mass * a) for a in state.position]
        return -jnp.dot(self._acceleration(state), jnp.stack(heights))

    def _weight(self, g: Array, like: Array) -> Array:
        return jnp.broadcast_to(g * self._mass(), like.shape)

    def _acceleration(self, state: State) -> Array:
        if self.acceleration.shape[0] != state.dim:
            raise ValueError(f"acceleration has {self.acceleration.shape[0]} coordinates, the positions have {state.dim}.")
        return self.acceleration

    def _mass(self) -> Array:
        if self.mass is None:
            raise ValueError("Gravity has no masses yet. Put it in a System, or pass Gravity(acceleration, mass).")
        return self.mass


class Load(Force):
    """A given force on the nodes: constant, or a function of time.

    Attributes:
        value: `Vector` in node shape [N], or a function of time [s] that returns one.

    Raises:
        TypeError: anything else, e.g. an array.

    >>> import jax.numpy as jnp
    >>> from jaxspring.topology.lattice import lattice
    >>> push = Load.from_points(lattice(2), [[0.0, 0.0], [1.0, 0.0]])
    """

    value: Vector | Callable[[Array], Vector]

    def __init__(self, value: Vector | Callable[[Array], Vector]):
        if not isinstance(value, Vector) and not callable(value):
            raise TypeError(
                f"value is a {type(value).__name__}; expected a Vector in node shape, or a function of time that returns one. "
                f"For an (N, D) array in the order of the nodes use Load.from_points(net, forces)."
            )
        self.value = value

    @staticmethod
    def from_points(net: Topology, forces: Numbers) -> Load:
        """A constant load from an (N, D) array [N] in the user's node order."""
        return Load(net.vector_field(forces, "forces"))

    def force(self, state: State) -> Vector:
        """The given force [N]."""
        load = self.value if isinstance(self.value, Vector) else self.value(state.time)
        if not isinstance(load, Vector) or load.dim != state.dim or load.shape != state.position.shape:
            raise ValueError(
                f"a load must be a Vector of {state.dim} arrays of shape {state.position.shape}; got "
                f"{type(load).__name__} of shape {shape_of(load)}."
            )
        return load.map(lambda a: a.astype(state.dtype))

    def energy(self, state: State) -> Array | None:
        """-f . x, summed [J], where the load is constant; None where it varies in time."""
        return -jnp.sum(self.value.dot(state.position)) if isinstance(self.value, Vector) else None

    def incremental_potential(self, state: State, dt: Array) -> Array:
        """-f . x, summed [J], with the load of the state's time."""
        return -jnp.sum(self.force(state).dot(state.position))

    @property
    def has_potential(self) -> bool:
        """Whether it is constant in time: only then has it an energy."""
        return isinstance(self.value, Vector)

    @property
    def is_symmetric(self) -> bool:
        """Whether -dF/dx is symmetric: a load does not depend on position."""
        return True
