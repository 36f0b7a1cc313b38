"""The angle between two elements of a chain, in the plane or in space, and how it changes when nodes move.

    phi = atan2(|t1 x t2|, t1 . t2)        t1, t2 the directions of the elements, c = cos phi
    phi grad phi                           - (phi / sin phi) (t2 - c t1) / l1 by the one, (phi / sin phi) (c t2 - t1) / l2 by the other

phi^2 is smooth where the chain is straight, phi is not: phi / sin phi is a series there, and no normal of a plane is asked for. Turning out
of the plane is told by directions across t1 that the least turning brings to t2,

    w2 = w1 - (w1 . t2) / (1 + c) (t1 + t2)

Source: parallel transport as in Bergou and others (2008), "Discrete Elastic Rods".
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import power_of_two, tiny
from ..vector import Vector

# Below this squared sine a series takes the place of phi / sin phi; its error is less than rounding.
SMALL = 1e-4


class Turn(eqx.Module):
    """Directions before and after each joint, and the angle between them; every array has shape (J,).

    Attributes:
        before, after: t1, t2.
        per_length: 1 / l1, 1 / l2 [1/m]; zero for a direction that is given.
        squared: phi^2.
        ratio: phi / sin phi; 0 where folded.
        is_degenerate: whether an element has no length, or lies folded onto the other.
    """

    before: Vector
    after: Vector
    per_length: tuple[Array, Array]
    squared: Array
    ratio: Array
    is_degenerate: Array

    @property
    def gradient(self) -> tuple[Vector, Vector]:
        """phi grad phi, by the element before and the one after [rad^2/m]."""
        c = self.before.dot(self.after)
        one = self.after - c * self.before
        other = c * self.after - self.before
        return -(self.ratio * self.per_length[0]) * one, (self.ratio * self.per_length[1]) * other

    @property
    def frames(self) -> tuple[tuple[Vector, Vector], ...]:
        """Directions across t1 and t2, each pair brought from one to the other by the least turning; one in the plane, two in space."""
        t1, t2 = self.before, self.after
        if t1.dim == 2:
            return ((Vector((-t1.y, t1.x)), Vector((-t2.y, t2.x))),)
        one, zero = jnp.ones_like(t1.x), jnp.zeros_like(t1.x)
        # The axis that t1 is farthest from: of three squares that sum to one the least is at most a third.
        x, y, z = (lax.stop_gradient(a * a) for a in t1)
        is_x, is_y = (x <= y) & (x <= z), (y < x) & (y <= z)
        axis = Vector((jnp.where(is_x, one, zero), jnp.where(is_y, one, zero), jnp.where(is_x | is_y, zero, one)))
        u = axis - axis.dot(t1) * t1
        u = lax.rsqrt(u.dot(u)) * u
        v = Vector((t1.y * u.z - t1.z * u.y, t1.z * u.x - t1.x * u.z, t1.x * u.y - t1.y * u.x))
        nearness = 1 + t1.dot(t2)
        is_folded = nearness <= 16 * float(jnp.finfo(nearness.dtype).eps)
        per = jnp.where(is_folded, zero, 1 / jnp.where(is_folded, one, nearness))
        return tuple((w, w - (per * w.dot(t2)) * (t1 + t2)) for w in (u, v))


def turn(e1: Vector, e2: Vector, is_element: Array) -> Turn:
    """The turning from elements e1 to elements e2 [m], or from directions that are given where e1 is no element."""
    t1, per1, short1 = _direction(e1)
    t2, per2, short2 = _direction(e2)
    c, across = t1.dot(t2), _cross(t1, t2)
    squared = sum((a * a for a in across[1:]), start=across[0] * across[0])
    is_short = short1 | short2
    is_near = (squared < SMALL) & (c > 0)
    # The sine of what is folded has no direction to grow in.
    is_folded = (squared <= (4 * float(jnp.finfo(c.dtype).eps)) ** 2) & (c <= 0)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    sine = jnp.sqrt(jnp.where(is_near | is_folded | is_short, one, squared))
    angle = jnp.arctan2(jnp.where(is_folded | is_short, zero, sine), jnp.where(is_short, one, c))
    series = 1 + squared * (1 / 6 + squared * (3 / 40 + squared * (15 / 336)))
    ratio = jnp.where(is_near, series, jnp.where(is_folded | is_short, zero, angle / sine))
    phi_squared = jnp.where(is_near, squared * series * series, angle * angle)
    is_degenerate = is_short | is_folded
    return Turn(t1, t2, (jnp.where(is_element, per1, zero), per2), jnp.where(is_short, zero, phi_squared), ratio, is_degenerate)


def _direction(e: Vector) -> tuple[Vector, Array, Array]:
    """Direction, 1 / length, and whether there is no length."""
    scale = power_of_two(jnp.max(jnp.abs(jnp.stack(tuple(e))), axis=0))
    scaled = e.map(lambda a: a / scale)
    squared = scaled.dot(scaled)
    is_short = squared <= tiny(squared.dtype)
    per = lax.rsqrt(jnp.where(is_short, jnp.ones_like(squared), squared))
    return per * scaled, jnp.where(is_short, jnp.zeros_like(per), per / scale), is_short


def _cross(a: Vector, b: Vector) -> tuple[Array, ...]:
    if a.dim == 2:
        return (a.x * b.y - a.y * b.x,)
    return a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x


__all__ = ["Turn", "turn"]
