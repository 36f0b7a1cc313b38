"""What an obstacle is: a signed distance to its surface, as a function of place and time.

    d(x, t)              [m]    negative inside
    n = grad d                  away from the obstacle, of length one where d is the exact distance
    -d_t n / |n|**2      [m/s]  how fast the surface moves along its normal, where d_t is the rate of d at a fixed place

Contact, heat and whatever else meets obstacles asks for nothing but these. The distance is differentiable in place, time and every
constant: a radius, a centre or the height of a ground may be fitted. Where it has a kink (a centre, an edge, the middle of a box) its
derivative is that of one side, finite, and zero where no side is nearer than another.

Source: Osher and Fedkiw (2003), Level Set Methods and Dynamic Implicit Surfaces, chapter 2.
"""

from __future__ import annotations

import abc
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .._checks import as_inexact, finite, is_concrete
from ..numerics import cast_inexact
from ..vector import Vector


class Obstacle(eqx.Module):
    """What nodes cannot enter. Abstract: give `distance` to write your own."""

    @abc.abstractmethod
    def distance(self, position: Vector, time: Array) -> Array:
        """Signed distance [m] of each place, in the shape of one coordinate; negative inside.

        Args:
            position: places [m].
            time: [s].
        """

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates than the obstacle; unless said, every space fits."""

    def bind(self, dtype: DTypeLike) -> Self:
        """The same as a loop wants it, constants in this dtype. Called once, before the loop."""
        return cast_inexact(self, dtype)

    def velocity(self, position: Vector, time: Array) -> Vector:
        """How fast the obstacle's surface moves [m/s], where it is nearest: along its normal, unless said."""
        _, normal, rate = seen(self, position, time)
        squared = normal.dot(normal)
        has_normal = squared > 0
        return jnp.where(has_normal, -rate / jnp.where(has_normal, squared, jnp.ones_like(squared)), jnp.zeros_like(rate)) * normal

    @property
    def moves(self) -> bool:
        """Whether the distance depends on time."""
        return False

    @property
    def is_flat(self) -> bool:
        """Whether the distance is linear, piece by piece, wherever it is not positive: contact then feels no bend of the surface."""
        return False

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse (for values that were traced then, or changed since)."""
        return None


def seen(obstacle: Obstacle, position: Vector, time: Array) -> tuple[Array, Vector, Array]:
    """Distance [m], its gradient by the place, and its rate at a fixed place [m/s], at each place."""
    d, pulled = jax.vjp(lambda x: obstacle.distance(x, time), position)
    (normal,) = pulled(jnp.ones_like(d))
    if not obstacle.moves:
        return d, normal, jnp.zeros_like(d)
    _, rate = jax.jvp(lambda t: obstacle.distance(position, t), (time,), (jnp.ones_like(time),))
    return d, normal, rate


def curvature(obstacle: Obstacle, position: Vector, time: Array) -> tuple[Vector, ...]:
    """Rows of the second derivative of the distance by the place [1/m], at each place."""

    def normal(x: Vector) -> Vector:
        return seen(obstacle, x, time)[1]

    zeros = Vector.zeros_like(position)
    units = [Vector(tuple(jnp.ones_like(a) if i == j else a for j, a in enumerate(zeros))) for i in range(position.dim)]
    return tuple(jax.jvp(normal, (position,), (unit,))[1] for unit in units)


def place(name: str, value: Any) -> Array:
    """`value` as the (D,) finite coordinates of a place [m].

    Raises:
        ValueError: another shape, or a NaN or infinity.
    """
    value = as_inexact(name, value)
    if value.ndim != 1 or value.shape[0] not in (1, 2, 3):
        raise ValueError(f"{name} has shape {value.shape}; expected (D,), one number per coordinate, e.g. (0.0, 0.0, 1.0).")
    finite(name, value)
    return value


def two_places(a: Any, b: Any, must_differ: str = "") -> tuple[Array, Array]:
    """Two places of one space; `must_differ` says why they may not be the same one."""
    a, b = place("a", a), place("b", b)
    if a.shape != b.shape:
        raise ValueError(f"a has {a.shape[0]} coordinates and b has {b.shape[0]}. Give both ends in one space.")
    if must_differ and is_concrete(a) and is_concrete(b) and bool(jnp.all(a == b)):
        raise ValueError(f"a and b are both at {a}. {must_differ}")
    return a, b


def check_dim(what: str, coordinates: int, dim: int) -> None:
    """Raise ValueError where an obstacle has another number of coordinates than the space."""
    if coordinates != dim:
        raise ValueError(f"the {what} has {coordinates} coordinates, the positions have {dim}. Give it as many as the nodes have.")


def at(constant: Array, position: Vector) -> Vector:
    """A place or a direction (D,) as a `Vector` of numbers in the dtype of the positions."""
    return Vector(tuple(constant[i].astype(position.dtype) for i in range(position.dim)))


def length(v: Vector) -> Array:
    """Euclidean length, with derivative zero where it is zero. Shorter than `Vector.norm`, since what leaves the range of squares is far
    outside (infinite), or at the centre (zero), and both are right here.
    """
    squared = v.dot(v)
    is_apart = squared > 0
    return jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, squared, jnp.ones_like(squared))), jnp.zeros_like(squared))


def unit(v: Vector) -> Vector:
    """`v` over its length; zero where that is zero."""
    size = length(v)
    return v / jnp.where(size > 0, size, jnp.ones_like(size))


def any_not_finite(*values: Array) -> Array:
    """True where any entry of any array is NaN or infinite."""
    bad = jnp.zeros((), bool)
    for value in values:
        bad = bad | ~jnp.all(jnp.isfinite(value))
    return bad


__all__ = ["Obstacle", "any_not_finite", "at", "check_dim", "curvature", "length", "place", "seen", "two_places", "unit"]
