"""Obstacles made of others: one that moves, and one of a function of the user's own.

    moving    d(x, t) = d_0(x - u(t), t)                u: displacement [m]

Source: a rigid displacement of a signed distance.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .._arrays import own
from .._checks import has_shape, kind
from ..vector import Vector
from .base import Obstacle, at


class Moving(Obstacle):
    """An obstacle that is displaced without turning, by a function of time.

    Its own velocity is the derivative of that function: a belt that moves along itself drags what it touches by friction.

    Attributes:
        obstacle: what moves, at time 0 or whenever the displacement is zero.
        motion: time [s] -> displacement (D,) [m]; any callable, differentiable; arrays in it may be differentiated by.

    Raises:
        TypeError: an obstacle or a motion of another kind.

    >>> rising = Moving(js.contact.Plane((0.0, 0.0), (0.0, 1.0)), lambda t: jnp.array([0.0, 2.0]) * t)
    >>> print(rising.distance(js.Vector((np.array([0.0]), np.array([5.0]))), jnp.array(1.0)))
    [3.]
    """

    obstacle: Obstacle
    motion: Callable[[Array], Array]

    def __init__(self, obstacle: Obstacle, motion: Callable[[Array], Array]):
        self.obstacle = kind("obstacle", obstacle, Obstacle, "Sphere((0.0, 0.0), 1.0)")
        if not callable(motion):
            raise TypeError(f"motion is a {type(motion).__name__}; expected a function of time [s] that returns the displacement (D,) [m].")
        self.motion = motion

    def distance(self, position: Vector, time: Array) -> Array:
        """Distance of the place as the moving obstacle sees it [m]."""
        return self.obstacle.distance(position - self._displacement(position, time), time)

    def velocity(self, position: Vector, time: Array) -> Vector:
        """Velocity of the motion, and what the obstacle moves by itself [m/s]."""

        def displacement(t: Array) -> Vector:
            return self._displacement(position, t)

        here, speed = jax.jvp(displacement, (time,), (jnp.ones_like(time),))
        speed = position.map(lambda a, s: jnp.broadcast_to(s, a.shape), speed)
        return speed + self.obstacle.velocity(position - here, time) if self.obstacle.moves else speed

    def _displacement(self, position: Vector, time: Array) -> Vector:
        found = own("what a motion returned", self.motion(time))
        has_shape("what a motion returned", found, {"one number per coordinate": (position.dim,)})
        return at(found, position)

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates than what moves."""
        self.obstacle.check(dim)

    def bind(self, dtype: DTypeLike) -> Self:
        """The same with its constants, those of the motion too, in this dtype."""
        return eqx.tree_at(lambda m: m.obstacle, super().bind(dtype), self.obstacle.bind(dtype))

    @property
    def moves(self) -> bool:
        """Whether the distance depends on time: that is what it is for."""
        return True

    @property
    def is_flat(self) -> bool:
        """Whether the surface of what moves has no bend."""
        return self.obstacle.is_flat

    def invalid(self) -> Array | None:
        """Whether what moves has a constant that its constructor would refuse."""
        return self.obstacle.invalid()


class SignedDistance(Obstacle):
    """An obstacle from a function of the user's own.

    Away from the distance's true value by a factor, contact is stiffer or softer by it; where it is zero, negative and which way it grows
    is what counts.

    Attributes:
        function: (places, a `Vector` [m]; time [s]) -> signed distance [m], in the shape of one coordinate, negative inside; any callable,
            differentiable; arrays in it may be differentiated by.
        reads_time: whether the distance depends on time; where it does not, say False, and contact with it has an energy (static).

    Raises:
        TypeError: what is no function.

    >>> bowl = SignedDistance(lambda x, t: 2.0 - x.norm(), reads_time=False)
    >>> print(bowl.distance(js.Vector((np.array([0.0, 3.0]), np.array([1.5, 0.0]))), jnp.array(0.0)))
    [ 0.5 -1. ]
    """

    function: Callable[[Vector, Array], Array]
    reads_time: bool = eqx.field(static=True)

    def __init__(self, function: Callable[[Vector, Array], Array], reads_time: bool = True):
        if not callable(function):
            raise TypeError(f"function is a {type(function).__name__}; expected a function of places (a Vector [m]) and time [s].")
        self.function, self.reads_time = function, reads_time

    def distance(self, position: Vector, time: Array) -> Array:
        """What the function gives [m].

        Raises:
            ValueError: the function gives another shape than that of one coordinate.
        """
        found = own("what the distance function returned", self.function(position, time))
        has_shape("what the distance function returned", found, {"one per place": position.shape})
        return found.astype(position.dtype)

    @property
    def moves(self) -> bool:
        """Whether the distance depends on time: unless said otherwise."""
        return self.reads_time


__all__ = ["Moving", "SignedDistance"]
