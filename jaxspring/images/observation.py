"""What an adaptive mesh observes in an image: gradient magnitude, curvature, and mixtures, scaled to [0, 1].

    adaptation  a = G_sigma * O,  then  a / max a          O = |grad d| on the slides

Springs between observing nodes stiffen where `a` is large. Curvature is that of the surface z = d(x, y):

    H = ((1 + d_y^2) d_xx - 2 d_x d_y d_xy + (1 + d_x^2) d_yy) / (2 (1 + d_x^2 + d_y^2)^(3/2))      mean
    K = (d_xx d_yy - d_xy^2) / (1 + d_x^2 + d_y^2)^2                                                Gaussian
    kappa_1,2 = H +- sqrt(H^2 - K)                                                                  principal

Source: slides "Adaptive Meshes"; the normalisation is ours (raw grey levels would drive stiffness far beyond its bounds).
"""

from __future__ import annotations

import abc
import functools
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from .._arrays import given
from .._checks import as_inexact, finite, has_shape
from ..numerics import power_of_two
from .image import Image, of_order_one
from .smoothing import Length, smooth

T = TypeVar("T")


# One program instead of a dozen where a function is called outside `jit`; inside, it leaves no trace.
# A plain function stands before it, since a compiled one does not pickle under its own name.
def _one_program(function: Callable[[Image], T]) -> Callable[[Image], T]:
    program = jax.jit(function, inline=True)
    return functools.wraps(function)(lambda image: program(image))


@_one_program
def image_gradient(image: Image) -> tuple[Array, Array]:
    """Slopes (d/dx, d/dy), each `(ny, nx)` [image unit per m]: central differences, one-sided on the border; zero along one lone pixel."""
    return _slope(image.values, 1) / image.spacing[0], _slope(image.values, 0) / image.spacing[1]


@_one_program
def gradient_magnitude(image: Image) -> Array:
    """|grad d| at the pixels. Where the gradient is zero its derivative is taken as zero, not NaN.

    Args:
        image: d.

    Returns:
        `(ny, nx)` [image unit per m].
    """
    return _norm(*image_gradient(image))


@_one_program
def principal_curvatures(image: Image) -> tuple[Array, Array]:
    """Principal curvatures of the surface z = image, with pixels in the unit of the spacing.

    Second differences; on the border, those of the nearest inner pixel. A scaled image is another surface: normalise grey levels first.

    Args:
        image: the height z over the plane.

    Returns:
        The larger and the smaller curvature, each `(ny, nx)` [1/m].
    """
    dx, dy = image_gradient(image)
    sx, sy = image.spacing
    second = _second_difference(image.values, 1) / (sx * sx), _second_difference(image.values, 0) / (sy * sy), _slope(dx, 0) / sy
    # Slopes by the area factor A = sqrt(1 + dx^2 + dy^2), second derivatives by A and by their size: no square leaves the range of float32.
    steep = _size(jnp.ones_like(dx), dx, dy)
    dx, dy, flat = dx / steep, dy / steep, 1 / steep
    area = jnp.sqrt(dx * dx + dy * dy + flat * flat)
    dx, dy, flat = dx / area, dy / area, flat / area
    second = tuple(part / steep / area for part in second)
    size = _size(*second)
    dxx, dyy, dxy = (part / size for part in second)
    mean = ((flat * flat + dy * dy) * dxx - 2 * dx * dy * dxy + (flat * flat + dx * dx) * dyy) / 2
    gaussian = (dxx * dyy - dxy * dxy) * (flat * flat)
    # H^2 - K is never negative, but rounding can make it so: clipped at zero.
    mean, half_gap = size * mean, size * _guarded_sqrt(mean * mean - gaussian)
    return mean + half_gap, mean - half_gap


class Observation(eqx.Module):
    """What the mesh looks at: called with an `Image`, gives one number per pixel, `(ny, nx)`. Any function of that form serves as well."""

    @abc.abstractmethod
    def __call__(self, image: Image) -> Array:
        """The observation at every pixel, `(ny, nx)`."""


class Intensity(Observation):
    """The image itself (brightness, or depth): `adaptation` shifts it up first where it is negative."""

    def __call__(self, image: Image) -> Array:
        """The pixels, `(ny, nx)` [image unit]."""
        return image.values


class GradientMagnitude(Observation):
    """|grad d|, the slides' observation: stiff springs on edges."""

    def __call__(self, image: Image) -> Array:
        """`gradient_magnitude(image)`, `(ny, nx)` [image unit per m]."""
        return gradient_magnitude(image)


class Curvature(Observation):
    """max(|kappa_1|, |kappa_2|) of the surface z = image: stiff springs on both sides of an edge, on ridges and corners."""

    def __call__(self, image: Image) -> Array:
        """The larger absolute principal curvature, `(ny, nx)` [1/m]."""
        # max(|H + s|, |H - s|) with s >= 0 is |H| + s; the kink at H = 0 keeps a finite slope.
        larger, smaller = principal_curvatures(image)
        return jnp.abs(larger + smaller) / 2 + (larger - smaller) / 2


class Combined(Observation):
    """Weighted sum of observations, for instance w1 |grad d| + w2 kappa. The weights are differentiable.

    Attributes:
        observations: tuple of observations (or functions of an image).
        weights: one number each, in a unit that makes the terms alike.

    >>> import numpy as np
    >>> both = Combined((GradientMagnitude(), Curvature()), (1.0, 0.5))
    >>> both(Image(np.eye(4))).shape
    (4, 4)
    """

    observations: tuple[Callable[[Image], Array], ...]
    weights: tuple[Array, ...]

    def __init__(self, observations: Sequence[Callable[[Image], Array]], weights: Sequence[ArrayLike]):
        weights = weights if isinstance(weights, tuple | list) else tuple(given("weights", weights))
        if len(observations) != len(weights) or not observations:
            raise ValueError(f"{len(observations)} observations and {len(weights)} weights: pass at least one, and one weight for each.")
        self.observations = tuple(observations)
        self.weights = tuple(as_inexact("weights", weight, jnp.result_type(float)) for weight in weights)
        for i, weight in enumerate(self.weights):
            has_shape(f"weights[{i}]", weight, {"one number": ()})
            finite(f"weights[{i}]", weight)

    def __call__(self, image: Image) -> Array:
        """The weighted sum, `(ny, nx)`."""
        terms = [w.astype(image.dtype) * observe(image) for w, observe in zip(self.weights, self.observations, strict=True)]
        return sum(terms[1:], terms[0])


def adaptation(
    image: Image,
    sigma: Length,
    observation: Callable[[Image], Array] = GradientMagnitude(),  # noqa: B008 (frozen, holds no array)
    radius: int | None = None,
) -> Image:
    """The observation smoothed by a Gaussian and scaled to [0, 1] by its maximum: an image to be sampled at the nodes.

    An observation that is negative somewhere is first shifted so that its minimum is 0.

    Args:
        image: what is observed.
        sigma: standard deviation of the Gaussian [m]; 0 smooths nothing.
        observation: from an image to `(ny, nx)`, in any unit.
        radius: of the Gaussian, as in `smooth` [pixels]: needed where sigma is traced.

    Returns:
        An image of the same spacing, without unit. Where there is nothing to see (a constant image) it is 0 everywhere, and its
        derivatives are finite.

    Raises:
        ValueError: a sigma or radius that `smooth` refuses, or an observation of another shape.
        TypeError: a traced sigma without a radius.

    >>> import numpy as np
    >>> step = Image(np.tile([0.0, 0.0, 0.0, 5.0, 5.0, 5.0], (4, 1)))
    >>> print(adaptation(step, 0.0).values[0])
    [0. 0. 1. 1. 0. 0.]
    """
    observed = smooth(image.filtered(_observed(image, observation)), sigma, radius)
    values = of_order_one(observed.values)
    low = jnp.minimum(jnp.min(values), 0)
    extent = jnp.max(values) - low
    # NaN is not "nothing to see": compare so that it passes through.
    is_empty = extent <= 0
    scaled = (values - low) / jnp.where(is_empty, 1, extent)
    return observed.filtered(jnp.where(is_empty, 0, scaled))


def _observed(image: Image, observation: Callable[[Image], Array]) -> Array:
    """What a function of the image gives, one number per pixel."""
    return image.filled().with_values(observation(image)).values


def _slope(values: Array, axis: int) -> Array:
    """Central difference per pixel, one-sided at both ends."""
    n = values.shape[axis]
    if n == 1:
        return jnp.zeros_like(values)
    v = jnp.moveaxis(values, axis, 0)
    slope = jnp.concatenate([v[1:2] - v[:1], (v[2:] - v[:-2]) / 2, v[-1:] - v[-2:-1]])
    return jnp.moveaxis(slope, 0, axis)


def _second_difference(values: Array, axis: int) -> Array:
    """v[i-1] - 2 v[i] + v[i+1]; the ends repeat their neighbour, and fewer than three pixels have none."""
    if values.shape[axis] < 3:
        return jnp.zeros_like(values)
    v = jnp.moveaxis(values, axis, 0)
    inner = v[:-2] - 2 * v[1:-1] + v[2:]
    return jnp.moveaxis(jnp.concatenate([inner[:1], inner, inner[-1:]]), 0, axis)


def _norm(x: Array, y: Array) -> Array:
    """sqrt(x^2 + y^2), with derivative zero at zero; of numbers whose squares would leave the range of their type as well."""
    size = _size(x, y)
    x, y = x / size, y / size
    return size * _guarded_sqrt(x * x + y * y)


def _size(*parts: Array) -> Array:
    """The largest absolute value among the parts, as a power of two."""
    return power_of_two(functools.reduce(jnp.maximum, [jnp.abs(part) for part in parts]))


def _guarded_sqrt(square: Array) -> Array:
    """Square root, zero with zero derivative for arguments that are not positive; NaN stays NaN."""
    is_zero = square <= 0
    return jnp.where(is_zero, 0, jnp.sqrt(jnp.where(is_zero, 1, square)))
