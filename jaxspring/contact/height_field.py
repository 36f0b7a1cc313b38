"""A ground whose height is an image: terrain, steps, a rough floor.

    d = (z - h(x, y)) / sqrt(1 + h_x**2 + h_y**2)        [m]

The ground is all that lies below the surface. This is zero exactly on it, has a gradient of length one there, and differs from the distance
by terms of the second order, distance squared over twice the radius of curvature: it is exact over a plane, at any slope. In the plane (two
coordinates) the height is an image of one row.

Source: Taubin (1994), "Distance approximations for rasterizing implicit curves", the first-order distance.
"""

from __future__ import annotations

from typing import Self

import equinox as eqx
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .._checks import finite, kind
from ..forces.base import any_not_positive
from ..images.image import Image, without_holes
from ..images.sampling import CubicSpline, Sampling
from ..images.surface import Surface
from ..numerics import cast_inexact
from ..vector import Vector
from .base import Obstacle, any_not_finite


class HeightField(Obstacle):
    """The ground below an image of heights. Outside the image it goes on at the height of the border.

    Attributes:
        image: heights [m] at the pixels; spacing and origin say where they are, x along the columns and y along the rows. In the plane one
            row. Heights may be differentiated by.
        sampling: how the image is read between pixels: `CubicSpline()` unless said, whose slope is continuous.

    Raises:
        TypeError: what is no image, or no sampling.
        ValueError: a height that is not finite; an image with weights.

    >>> ramp = HeightField(js.Image(np.array([[0.0, 1.0, 2.0]])), js.images.Bilinear())
    >>> print(ramp.distance(js.Vector((np.array([0.5]), np.array([1.5]))), jnp.array(0.0)).round(4))
    [0.7071]
    """

    image: Image | Surface
    sampling: Sampling

    def __init__(self, image: Image, sampling: Sampling | None = None):
        image = kind("image", image, Image, "Image(heights, spacing=0.1)")
        self.image = without_holes("image", image, "a ground must be somewhere at every place.")
        finite("image.values", self.image.values)
        self.sampling = CubicSpline() if sampling is None else kind("sampling", sampling, Sampling, "CubicSpline()")

    def distance(self, position: Vector, time: Array) -> Array:
        """Height over the ground along z (in the plane along y), over the length of the ground's normal [m]."""
        surface = self.image.surface(self.sampling) if isinstance(self.image, Image) else self.image
        if position.dim == 3:
            height, dx, dy = surface.value_and_gradient(position.x, position.y)
            steepness = dx * dx + dy * dy
        else:
            row = jnp.broadcast_to(surface.origin[1].astype(position.dtype), position.shape)
            height, dx, _ = surface.value_and_gradient(position.x, row)
            steepness = dx * dx
        return (position[position.dim - 1] - height) / jnp.sqrt(1 + steepness)

    def check(self, dim: int) -> None:
        """Raise ValueError where the space does not fit the image: three coordinates, or two and an image of one row."""
        rows = self.image.shape[0]
        if dim == 1 or (dim == 2 and rows != 1):
            raise ValueError(
                f"the height field has an image of {rows} rows, the positions have {dim} coordinates. In space it takes 3 coordinates; in "
                f"the plane an image of one row, e.g. Image(heights[None])."
            )

    def bind(self, dtype: DTypeLike) -> Self:
        """The same with the image ready to be read: a spline is filtered once, not in every step."""
        surface = self.image.surface(self.sampling) if isinstance(self.image, Image) else self.image
        return cast_inexact(eqx.tree_at(lambda h: h.image, self, surface), dtype)

    def invalid(self) -> Array:
        """Whether a height is not finite, or the spacing not positive."""
        heights = self.image.values if isinstance(self.image, Image) else self.image.coefficients
        return any_not_finite(heights, *self.image.origin) | any_not_positive(self.image.spacing)


__all__ = ["HeightField"]
