"""Where nodes are on their way through a step."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array

from ..forces.contact import Book
from ..vector import Vector


class Path(eqx.Module):
    """Where nodes are on their way through a step.

    Attributes:
        position: at the last impact.
        velocity: of the parabola there, without the stepper's offset.
        arrived: with it: where no time is left, the velocity at the end of the step.
        left: time that is left [s].
        held: for each obstacle, whether the node rests on it.
        is_struck: whether a node has met an obstacle.
        first: at the first impact: velocity, J, time left; None where no force depends on velocity.
        moments: J r and J r^2 / 2, summed over impacts; None likewise.
        books: for each obstacle what it did; None where nobody asks.
    """

    position: Vector
    velocity: Vector
    arrived: Vector
    left: Array
    held: tuple[Array, ...]
    is_struck: Array
    first: tuple[Vector, Vector, Array] | None
    moments: tuple[Vector, Vector] | None
    books: tuple[Book, ...] | None


__all__ = ["Path"]
