"""Gaussian smoothing, differentiable with respect to the pixels and to sigma.

The kernel is the sampled Gaussian exp(-k^2 / (2 s^2)), cut at `radius` pixels and divided by its sum, applied along x and then along y,
with s = sigma / spacing on each axis. The image is continued by reflection about the outer edge of its border pixels (b a | a b c | c b),
SciPy's default, which keeps the mean of the image exactly.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._arrays import given
from .._checks import as_inexact, has_shape
from .filtering import band_distance, filter_axis
from .image import Image

Length = float | Array

# Below this deviation (in pixels) the first neighbour's weight, exp(-1 / (2 s^2)), is under exp(-80) = 2e-35: nothing in either precision,
# while its derivative by autodiff would be 0 * inf. There the kernel is the identity and its derivative zero, as in the limit.
_IDENTITY_DEVIATION = math.sqrt(1 / 160)


def smooth(image: Image, sigma: Length, radius: int | None = None) -> Image:
    """The image convolved with a Gaussian.

    Args:
        image: what is smoothed.
        sigma: standard deviation [m], one number; 0 gives the image itself.
        radius: pixels kept on each side of the kernel's centre. Left out, it is four standard deviations, which needs a sigma and a
            spacing that are known while tracing. With a sigma that is traced (inside `jit` or `grad`), pass the radius for the largest
            sigma that can occur: `smoothing_radius(largest_sigma, image.spacing)`.

    Returns:
        An image of the same shape, spacing and unit. Should a traced sigma exceed half the radius, the kernel would no longer be a
        Gaussian, and every pixel is NaN instead.

    Raises:
        ValueError: sigma negative, NaN or infinite; radius negative, or under two standard deviations.
        TypeError: sigma or spacing is traced and no radius was given, or radius is not an int.

    >>> import numpy as np
    >>> spike = Image(np.eye(1, 5, 2))
    >>> print((1000 * smooth(spike, 1.0).values).round())
    [[ 58. 242. 399. 242.  58.]]
    """
    asked: Any = given("sigma", sigma)  # as it was passed: inside `jit` a number is a constant still
    width = as_inexact("sigma", asked, image.dtype)
    has_shape("sigma", width, {"one number": ()})
    is_traced = any(isinstance(length, Tracer) for length in (asked, *image.spacing))
    if radius is None:
        if is_traced:
            raise TypeError(
                "smooth: sigma (or the image's spacing) is traced, so the width of the kernel cannot follow it.\n"
                "Pass radius=smoothing_radius(largest_sigma, spacing), a number of pixels computed outside jit and grad."
            )
        radius = smoothing_radius(asked, image.spacing)
    _check_radius(radius)
    if not is_traced:
        least = smoothing_radius(asked, image.spacing, deviations=2.0)
        if radius < least:
            raise ValueError(f"radius = {radius} pixels is under two standard deviations, sigma = {float(asked)}: pass radius >= {least}.")
    values = image.values
    for axis, spacing in ((1, image.spacing[0]), (0, image.spacing[1])):
        if values.shape[axis] > 1:
            values = filter_axis(values, _gaussian_band(width / spacing, radius), radius, axis, mode="symmetric")
    return image.filtered(values)


def smoothing_radius(sigma: Length, spacing: Length | tuple[Length, Length] = 1.0, deviations: float = 4.0) -> int:
    """Pixels on each side of a Gaussian kernel's centre, on the axis of finer spacing.

    Args:
        sigma: standard deviation [m], a number that is known.
        spacing: distance between pixels [m]: a number, or (along x, along y).
        deviations: how many standard deviations the pixels are to hold.

    Returns:
        The number of pixels.

    Raises:
        ValueError: sigma negative, NaN or infinite.

    >>> smoothing_radius(1.6)
    7
    """
    pair = spacing if isinstance(spacing, tuple) else (spacing,)
    sigma, finest = float(sigma), min(float(part) for part in pair)
    if not (math.isfinite(sigma) and sigma >= 0):
        raise ValueError(f"sigma is {sigma}, but a standard deviation is finite and not negative. Pass sigma = 0 for no smoothing.")
    # A hair less than the quotient, so that rounding does not add a pixel where it is whole.
    return math.ceil(deviations * sigma / finest * (1 - 1e-6))


@functools.partial(jax.jit, static_argnames="radius", inline=True)
def _gaussian_band(deviation: Array, radius: int) -> Array:
    """Band matrix of the Gaussian whose standard deviation is given in pixels; the kernel sums to one."""
    square = jnp.square(deviation)
    is_wide = square > _IDENTITY_DEVIATION**2
    exponent = 0.5 / jnp.where(is_wide, square, _IDENTITY_DEVIATION**2)
    distance = band_distance(radius)
    is_kept = (distance == 0) | (is_wide & (distance <= radius))
    weight = jnp.where(is_kept, jnp.exp(-exponent * np.square(distance).astype(deviation.dtype)), 0)
    band = weight / jnp.sum(weight, axis=0, keepdims=True)
    return jnp.where(2 * jnp.abs(deviation) <= radius * (1 + 1e-5), band, jnp.nan)


def _check_radius(radius: int) -> None:
    """A radius is a whole number of pixels, known while tracing."""
    if isinstance(radius, bool) or not isinstance(radius, int):
        raise TypeError(f"radius must be an int, a number of pixels fixed while tracing; got {type(radius).__name__}.")
    if radius < 0:
        raise ValueError(f"radius = {radius}, but a kernel has at least its centre: pass 0 or more pixels.")
