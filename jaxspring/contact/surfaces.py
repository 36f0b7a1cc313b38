"""An obstacle as an impact sees it: at a place and a time the height above it, its normal and how fast it comes; along a path, how the
height bends.

    height   (d - base) / |grad d|                        base: 0, or where a node began inside
    n        grad d / |grad d|
    rate     d_t / |grad d|                               so that n . v + rate is the speed at which the height grows
    bend     d^2/ds^2 of d(x + v s + a s^2 / 2, t + s), over |grad d|:  n . a + v' H v + 2 grad d_t . v + d_tt

Every node has a time of its own within a step, so that the obstacle is asked node by node, under `vmap`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.contact import pick_vector
from ..forces.planes import ROUNDING, Plane, pick
from ..vector import Vector
from .base import Obstacle


class Flat(Obstacle):
    """The plane of a floor among other obstacles.

    Attributes:
        plane: in the dtype of the state.
    """

    plane: Plane

    def distance(self, position: Vector, time: Array) -> Array:
        """(x - p) . n [m]."""
        return self.plane.height(position)


class Touch(eqx.Module):
    """Where a node is above a surface. All in node shape.

    Attributes:
        height: over the surface, or over where the node began inside [m].
        normal: of length one, away from the obstacle.
        rate: how fast the height would grow if the node stood still [m/s].
        drag: velocity of the obstacle along its surface, which friction feels [m/s]; None where it has none.
    """

    height: Array
    normal: Vector
    rate: Array
    drag: Vector | None = None

    def speed(self, velocity: Vector) -> Array:
        """How fast the height grows [m/s]: negative toward the obstacle."""
        return velocity.dot(self.normal) + self.rate


class Surface(eqx.Module):
    """An obstacle with what it does to a node that meets it.

    Attributes:
        obstacle: where it is.
        friction: mu.
        restitution: e.
    """

    obstacle: Obstacle
    friction: Array
    restitution: Array

    def distance(self, position: Vector, time: Array) -> Array:
        """d of each node [m], at one time for all of them or one for each."""
        return _by_node(_distance, self.obstacle, position, jnp.broadcast_to(time, position.shape))

    def touch(self, position: Vector, time: Array, base: Array) -> Touch:
        """Height, normal and rate of each node, at a time of its own."""
        # Without the barrier XLA computes a distance anew in each of its users, and theirs: programs grow exponentially.
        return lax.optimization_barrier(_by_node(_touch, self.obstacle, position, time, base))

    def along(self, s: Array, position: Vector, velocity: Vector, acceleration: Vector, time: Array, base: Array) -> tuple[Array, Array]:
        """Distance [m], and how fast it grows [m/s], of each node after its time s on the parabola from its place and time."""
        return _by_node(_along, self.obstacle, s, position, velocity, acceleration, time, base)

    def bend(self, position: Vector, velocity: Vector, acceleration: Vector, time: Array) -> Array:
        """Acceleration of the height along the parabola of each node from its place and time [m/s^2]: negative toward the obstacle."""
        return lax.optimization_barrier(_by_node(_bend, self.obstacle, position, velocity, acceleration, time))

    def rounding(self, position: Vector) -> Array:
        """Below which a height is rounding [m]: by the sizes of the place and of the obstacle's constants."""
        if isinstance(self.obstacle, Flat):
            return self.obstacle.plane.rounding(position)
        constants = [jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(self.obstacle) if eqx.is_inexact_array(leaf) and leaf.size]
        size = position.map(jnp.abs).dot(position.map(jnp.ones_like))
        for constant in constants:
            size = jnp.maximum(size, constant.astype(size.dtype))
        return ROUNDING * float(jnp.finfo(size.dtype).eps) * lax.stop_gradient(size)


def _distance(obstacle: Obstacle, x: Vector, t: Array) -> Array:
    return obstacle.distance(x, t)


def _touch(obstacle: Obstacle, x: Vector, t: Array, base: Array) -> Touch:
    d, (gradient, rate) = jax.value_and_grad(obstacle.distance, argnums=(0, 1))(x, t)
    per_length = _over_length(gradient)
    normal = gradient * per_length
    if type(obstacle).velocity is Obstacle.velocity:
        return Touch((d - base) * per_length, normal, rate * per_length)
    own = obstacle.velocity(x, t)
    return Touch((d - base) * per_length, normal, rate * per_length, own - own.dot(normal) * normal)


def _along(obstacle: Obstacle, s: Array, x: Vector, v: Vector, a: Vector, t: Array, base: Array) -> tuple[Array, Array]:
    return jax.jvp(lambda s: obstacle.distance(x + s * (v + (0.5 * s) * a), t + s) - base, (s,), (jnp.ones_like(s),))


def _bend(obstacle: Obstacle, x: Vector, v: Vector, a: Vector, t: Array) -> Array:
    def slope(s: Array) -> Array:
        return _along(obstacle, s, x, v, a, t, jnp.zeros_like(t))[1]

    s = jnp.zeros_like(t)
    return jax.jvp(slope, (s,), (jnp.ones_like(s),))[1] * _over_length(jax.grad(obstacle.distance)(x, t))


def _over_length(gradient: Vector) -> Array:
    """1 / |gradient|; 1 where it is zero."""
    squared = gradient.dot(gradient)
    return 1 / jnp.sqrt(jnp.where(squared > 0, squared, jnp.ones_like(squared)))


@eqx.filter_jit  # so that it is traced once, and not at each of its many places
def _by_node(function: Callable[..., Any], obstacle: Obstacle, *values: Any) -> Any:
    """What a function of an obstacle and one node makes of values in node shape, in node shape."""
    shape = jax.tree.leaves(values)[0].shape
    found = jax.vmap(lambda *of_node: function(obstacle, *of_node))(*jax.tree.map(jnp.ravel, values))
    return jax.tree.map(lambda a: a.reshape(shape), found)


def picked(chosen: tuple[Array, ...], touches: tuple[Touch, ...]) -> Touch:
    """The touch of the chosen surface."""
    nothing = Vector.zeros_like(touches[0].normal)
    drags = tuple(t.drag for t in touches)
    drag = None if all(d is None for d in drags) else pick_vector(chosen, tuple(nothing if d is None else d for d in drags))
    height, rate = (pick(chosen, tuple(values)) for values in zip(*((t.height, t.rate) for t in touches), strict=True))
    return Touch(height, pick_vector(chosen, tuple(t.normal for t in touches)), rate, drag)


__all__ = ["Flat", "Surface", "Touch", "picked"]
