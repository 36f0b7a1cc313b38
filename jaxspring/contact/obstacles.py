"""Obstacles of simple form, each by the exact signed distance to its surface.

    plane         (x - p) . n
    half-spaces   the least of the heights over their planes
    sphere        |x - c| - r                                                         a disc in the plane
    box           |max(q, 0)| + min(max of q, 0)          q_i = |x_i - c_i| - h_i     a rectangle in the plane
    capsule       |x - nearest place of the segment a b| - r
    cylinder      as a box, with q = (|along| - L/2, |across| - r)                    flat ends; in the plane a turned rectangle

Outside each is the true distance. So it is inside a sphere, a box and a cylinder; in several half-spaces at once it is minus the depth
below the deepest plane.

Source: distances as in Quilez, "Distance functions" (2008-2024); here with derivatives that are finite everywhere.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, constant, finite, is_concrete, plane, positive
from ..forces.base import any_not_positive
from ..vector import Vector
from .base import Obstacle, any_not_finite, at, check_dim, length, place, two_places, unit

# Why a constant is refused.
INSIDE_OUT = "Of a negative radius no place would be inside."


class Plane(Obstacle):
    """A wall behind a plane: everything below it, against the normal, is inside.

    Attributes:
        point: (D,) a point of the plane [m].
        normal: (D,) its normal, away from the wall; of length one.

    Raises:
        ValueError: a normal without length, shapes that differ, what is not finite.

    >>> ground = Plane(point=(0.0, 0.0), normal=(0.0, 2.0))
    >>> print(ground.distance(js.Vector((np.array([5.0]), np.array([-0.5]))), jnp.array(0.0)))
    [-0.5]
    """

    point: Array
    normal: Array

    def __init__(self, point: Numbers, normal: Numbers):
        self.point, self.normal = plane(point, normal)

    def distance(self, position: Vector, time: Array) -> Array:
        """(x - p) . n [m]."""
        return (position - at(self.point, position)).dot(at(self.normal, position))

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("plane", self.point.shape[0], dim)

    @property
    def is_flat(self) -> bool:
        """Whether the surface has no bend: a plane has none."""
        return True

    def invalid(self) -> Array:
        """Whether a coordinate is not finite."""
        return any_not_finite(self.point, self.normal)


class HalfSpaces(Obstacle):
    """Walls behind several planes: a corner, a trough, a room. Inside is what lies below any of them.

    Of two planes that are as deep the first counts. Where nodes rest in a corner, make each wall an obstacle of its own: then both push.

    Attributes:
        points: (M, D) a point of each plane [m].
        normals: (M, D) normals, away from the walls; of length one.

    Raises:
        ValueError: a normal without length, named with its index; shapes that differ; what is not finite.
    """

    points: Array
    normals: Array

    def __init__(self, points: Numbers, normals: Numbers):
        points, normals = as_inexact("points", points), as_inexact("normals", normals)
        for name, value in (("points", points), ("normals", normals)):
            finite(name, value)
            if value.ndim != 2 or not value.shape[0] or value.shape[1] not in (1, 2, 3) or value.shape != points.shape:
                raise ValueError(f"{name} has shape {value.shape}; expected (M, D), a row for each of M >= 1 planes, as points has.")
        sizes = jnp.sqrt(jnp.sum(normals**2, axis=1, keepdims=True))
        if is_concrete(sizes) and not np.all(np.asarray(sizes) > 0):
            i = int(np.argmin(np.asarray(sizes)[:, 0]))
            raise ValueError(f"normals[{i}] has no length, so the plane no direction. Pass e.g. (0.0, 0.0, 1.0).")
        self.points, self.normals = points, normals / sizes

    def distance(self, position: Vector, time: Array) -> Array:
        """The least height over a plane [m]."""
        least = self._height(0, position)
        for i in range(1, self.points.shape[0]):
            height = self._height(i, position)
            least = jnp.where(height < least, height, least)
        return least

    def _height(self, i: int, position: Vector) -> Array:
        return (position - at(self.points[i], position)).dot(at(self.normals[i], position))

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("obstacle of half-spaces", self.points.shape[1], dim)

    @property
    def is_flat(self) -> bool:
        """Whether the surface has no bend: planes have none."""
        return True

    def invalid(self) -> Array:
        """Whether a coordinate is not finite."""
        return any_not_finite(self.points, self.normals)


class Sphere(Obstacle):
    """A ball; in the plane a disc. At its very centre no direction leads out: the gradient is zero there.

    Attributes:
        centre: (D,) [m].
        radius: [m].

    Raises:
        ValueError: a radius that is not positive, a centre that is not (D,) or not finite.
    """

    centre: Array
    radius: Array

    def __init__(self, centre: Numbers, radius: Numbers):
        self.centre = place("centre", centre)
        self.radius = constant("radius", radius, INSIDE_OUT)

    def distance(self, position: Vector, time: Array) -> Array:
        """|x - c| - r [m]."""
        return length(position - at(self.centre, position)) - self.radius.astype(position.dtype)

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("sphere", self.centre.shape[0], dim)

    def invalid(self) -> Array:
        """Whether the radius is not positive, or a number not finite."""
        return any_not_positive(self.radius) | any_not_finite(self.centre)


class Box(Obstacle):
    """A box along the axes; in the plane a rectangle.

    Attributes:
        centre: (D,) [m].
        half_sizes: (D,) from the centre to each face [m].

    Raises:
        ValueError: a half size that is not positive, shapes that differ, what is not finite.
    """

    centre: Array
    half_sizes: Array

    def __init__(self, centre: Numbers, half_sizes: Numbers):
        self.centre, self.half_sizes = place("centre", centre), place("half_sizes", half_sizes)
        if self.centre.shape != self.half_sizes.shape:
            raise ValueError(f"half_sizes has shape {self.half_sizes.shape}; expected {self.centre.shape}, as centre has.")
        positive("half_sizes", self.half_sizes, "A box without thickness has no inside.")

    def distance(self, position: Vector, time: Array) -> Array:
        """|max(q, 0)| + min(max of q, 0) [m]."""
        return _boxed((position - at(self.centre, position)).map(_size) - at(self.half_sizes, position))

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("box", self.centre.shape[0], dim)

    @property
    def is_flat(self) -> bool:
        """Whether the surface has no bend: inside a box the distance is that to a face."""
        return True

    def invalid(self) -> Array:
        """Whether a half size is not positive, or a number not finite."""
        return any_not_positive(self.half_sizes) | any_not_finite(self.centre)


class Capsule(Obstacle):
    """All that is within a radius of a segment. Ends may coincide: it is a ball then. On its axis the gradient is zero.

    Attributes:
        a: (D,) one end of the segment [m].
        b: (D,) the other end [m].
        radius: [m].

    Raises:
        ValueError: a radius that is not positive, ends in different spaces, what is not finite.
    """

    a: Array
    b: Array
    radius: Array

    def __init__(self, a: Numbers, b: Numbers, radius: Numbers):
        self.a, self.b = two_places(a, b)
        self.radius = constant("radius", radius, INSIDE_OUT)

    def distance(self, position: Vector, time: Array) -> Array:
        """Distance to the segment less the radius [m]."""
        axis = at(self.b, position) - at(self.a, position)
        offset = position - at(self.a, position)
        squared = axis.dot(axis)
        one, zero = jnp.ones_like(squared), jnp.zeros_like(squared)
        share = offset.dot(axis) / jnp.where(squared > 0, squared, one)
        share = jnp.where(share > 0, jnp.where(share < 1, share, one), zero)
        return length(offset - share * axis) - self.radius.astype(position.dtype)

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("capsule", self.a.shape[0], dim)

    def invalid(self) -> Array:
        """Whether the radius is not positive, or a number not finite."""
        return any_not_positive(self.radius) | any_not_finite(self.a, self.b)


class Cylinder(Obstacle):
    """A cylinder with flat ends; in the plane a rectangle in any direction.

    Attributes:
        a: (D,) the middle of one end [m].
        b: (D,) the middle of the other end [m].
        radius: [m].

    Raises:
        ValueError: a radius that is not positive, ends that coincide or are in different spaces, what is not finite.
    """

    a: Array
    b: Array
    radius: Array

    def __init__(self, a: Numbers, b: Numbers, radius: Numbers):
        self.a, self.b = two_places(a, b, "A cylinder without length has no direction. Pass a Sphere, or move one end.")
        self.radius = constant("radius", radius, INSIDE_OUT)

    def distance(self, position: Vector, time: Array) -> Array:
        """As a box of the two coordinates along and across the axis [m]."""
        a, b = at(self.a, position), at(self.b, position)
        axis = unit(b - a)
        offset = position - 0.5 * (a + b)
        along = offset.dot(axis)
        across = length(offset - along * axis)
        return _boxed(Vector((_size(along) - 0.5 * length(b - a), across - self.radius.astype(position.dtype))))

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has another number of coordinates."""
        check_dim("cylinder", self.a.shape[0], dim)

    def invalid(self) -> Array:
        """Whether the radius is not positive, the length zero, or a number not finite."""
        return any_not_positive(self.radius) | any_not_finite(self.a, self.b) | jnp.all(self.a == self.b)


def _size(a: Array) -> Array:
    """Absolute value, with the derivative of one side at zero."""
    return jnp.where(a >= 0, a, -a)


def _boxed(q: Vector) -> Array:
    """Distance of a place that is q_i beyond the face of each axis (q_i < 0: before it)."""
    # Comparisons rather than `maximum`, whose derivative on the very surface is one half: that is where nodes rest.
    outer = length(q.map(lambda a: jnp.where(a > 0, a, jnp.zeros_like(a))))
    nearest = q[0]
    for a in q.components[1:]:
        nearest = jnp.where(a > nearest, a, nearest)
    return outer + jnp.where(nearest <= 0, nearest, jnp.zeros_like(nearest))


__all__ = ["Box", "Capsule", "Cylinder", "HalfSpaces", "Plane", "Sphere"]
