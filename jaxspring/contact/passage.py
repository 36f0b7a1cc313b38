"""The motion of one step and the obstacles in its way, as what happens at an impact and in a slide needs them."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..vector import Vector
from .frames import Frame, frame_of
from .paths import Path
from .surfaces import Surface, Touch


class Way(eqx.Module):
    """How nodes go on from where they are, as long as they meet nothing.

    Attributes:
        touches: where they are above each surface.
        frame: the directions that the surfaces take on which they rest.
        velocity: without what these take [m/s].
        acceleration: likewise [m/s^2].
    """

    touches: tuple[Touch, ...]
    frame: Frame
    velocity: Vector
    acceleration: Vector


class Passage(eqx.Module):
    """The motion of one step, and the obstacles in its way.

    Attributes:
        surfaces: in a fixed order.
        free: per coordinate, where nodes are free (None: all are).
        base: per surface, the distance from which a node counts [m]: 0, or where it began inside.
        rounding: per surface, below which a distance is rounding [m].
        start: time when the step began [s].
        dt: of the whole step [s].
        acceleration: a, in node shape [m/s^2].
        offset: what the stepper's velocity differs by from the parabola's [m/s].
    """

    surfaces: tuple[Surface, ...]
    free: tuple[Array | None, ...]
    base: tuple[Array, ...]
    rounding: tuple[Array, ...]
    start: Array
    dt: Array
    acceleration: Vector
    offset: Vector

    def clock(self, path: Path) -> Array:
        """The time of each node [s]."""
        return self.start + (self.dt - path.left)

    def touches(self, position: Vector, time: Array) -> tuple[Touch, ...]:
        """Where each node is above every surface."""
        return tuple(s.touch(position, time, base) for s, base in zip(self.surfaces, self.base, strict=True))

    def frame(self, touches: tuple[Touch, ...], held: tuple[Array, ...]) -> Frame:
        """The directions that are taken from nodes which rest."""
        return frame_of(tuple(self.free_part(t.normal) for t in touches), tuple(t.rate for t in touches), held)

    def free_part(self, v: Vector) -> Vector:
        """`v` where free, zero where held."""
        return v.where(self.free)

    def lever(self, normal: Vector) -> tuple[Vector, Array]:
        """Change of velocity per unit of change along a normal, where nodes are free, and its length: the normal, and 1, of free nodes."""
        part = self.free_part(normal)
        squared = part.dot(part)
        squared = jnp.where(squared > 0, squared, jnp.ones_like(squared))
        return part / squared, 1 / jnp.sqrt(squared)

    def lifted(self, position: Vector) -> Vector:
        """The positions at the end of the step, none of them inside."""
        time = jnp.broadcast_to(self.start + self.dt, position.shape)
        for surface, base in zip(self.surfaces, self.base, strict=True):
            touch = surface.touch(position, time, base)
            position = position - jnp.minimum(touch.height, jnp.zeros_like(touch.height)) * self.lever(touch.normal)[0]
        return position


__all__ = ["Passage", "Way"]
