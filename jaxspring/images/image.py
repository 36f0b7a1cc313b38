"""A one-channel image as a height over the plane: pixels, their physical spacing, and how to read between them.

Position component 0 is x, along the columns; component 1 is y, along the rows. Pixel `values[j, i]` is a node at

    x = origin_x + i spacing_x        y = origin_y + j spacing_y        [m]

so with spacing 1 and origin 0, `values[y, x]` sits at `(x, y)`. Outside the outermost pixels the coordinate is clamped: the value is
that of the nearest border point and the slope across the border is exactly zero.

A pixel may have a weight: how much its value counts in data springs and errors. One of weight zero is a hole; see `holes.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array

from .._arrays import given, own
from .._checks import as_inexact, shape_of
from ..numerics import power_of_two
from .holes import checked_weights, continued
from .sampling import Bilinear, Sampling
from .surface import Surface

PerAxis = float | Array | Sequence[float] | Sequence[Array]


class Image(eqx.Module):
    """One channel of pixels with a physical spacing. Pixels, spacing and origin are all differentiable.

    Attributes:
        values: pixels `(ny, nx)`, row by row, in the image's own unit. Whole numbers and booleans become the default float type.
        spacing: distance between neighbouring pixels `(along x, along y)` [m, or whatever length the node positions are in].
        origin: position `(x, y)` of pixel `values[0, 0]`, in the same unit.
        weights: how much each pixel counts, `(ny, nx)`, zero or more, for instance one over the variance of its noise; None where all count
            alike. Zero is a hole: what `values` holds there, NaN too, is not read, and the continuation of the data around it takes its
            place.

    Raises:
        ValueError: no pixels, not two axes, a pixel of weight above zero that is NaN or infinite, weights that are negative, not finite or
            all zero, a spacing that is not positive, an origin that the pixels'
            type cannot hold to a thousandth of the spacing.
            Of traced values only shape and type are looked at.
        TypeError: complex, text or half-precision pixels.

    >>> import numpy as np
    >>> image = Image(np.array([[0.0, 1.0], [10.0, 11.0]]))
    >>> print(image.sample(1.0, 0.5))
    6.0
    >>> holed = Image(np.array([[0.0, 1.0], [np.nan, 1.0]]), weights=np.array([[1.0, 1.0], [0.0, 1.0]]))
    >>> print(holed.n_holes, holed.sample(0.0, 0.0))
    1 0.0
    """

    values: Array
    spacing: tuple[Array, Array]
    origin: tuple[Array, Array]
    weights: Array | None

    def __init__(self, values: ArrayLike, spacing: PerAxis = 1.0, origin: PerAxis = 0.0, weights: ArrayLike | None = None):
        self.values, self.weights = _as_pixels(values, weights)
        self.spacing = _per_axis("spacing", spacing, self.values.dtype, must_be_positive=True)
        # A generator gives its numbers once, and they are looked at twice.
        place: Any = origin if isinstance(origin, tuple | list) else given("origin", origin)
        self.origin = _per_axis("origin", place, self.values.dtype)
        _check_place(place, self.origin, self.spacing)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns `(ny, nx)`."""
        ny, nx = jnp.shape(self.values)[-2:]
        return ny, nx

    @property
    def dtype(self) -> jnp.dtype:
        """Floating type of the pixels."""
        return jnp.result_type(self.values)

    @property
    def n_holes(self) -> Array | int:
        """Number of pixels of weight zero."""
        return 0 if self.weights is None else jnp.sum(self.weights == 0)

    def with_values(self, values: Array) -> Image:
        """The same geometry, floating type and weights with other pixels `(ny, nx)`, not checked; holes get their continuation."""
        if jnp.shape(values) != jnp.shape(self.values):
            raise ValueError(f"values has shape {jnp.shape(values)}, but the image has {jnp.shape(self.values)}: pass one value per pixel.")
        values = own("values", values, self.dtype)
        return self.filtered(values if self.weights is None else continued(values, self.weights))

    def filtered(self, values: Array) -> Image:
        """The same with what a filter made of the pixels, holes included: nothing is continued anew."""
        return eqx.tree_at(lambda image: image.values, self, values)

    def filled(self) -> Image:
        """The same without weights: the continuation under the holes counts as data from here on."""
        return eqx.tree_at(lambda image: image.weights, self, None, is_leaf=lambda leaf: leaf is None)

    def normalised(self) -> Image:
        """Pixels scaled to [0, 1] by their whole range; a constant image becomes 0."""
        values = of_order_one(self.values)
        low, high = jnp.min(values), jnp.max(values)
        extent = jnp.where(high > low, high - low, 1)
        return self.filtered((values - low) / extent)

    def surface(self, method: Sampling = Bilinear()) -> Surface:  # noqa: B008 (frozen, holds no array)
        """The image made ready to be read between its pixels. Make it once, outside a loop: `CubicSpline` filters the pixels here."""
        cover = None
        if self.weights is not None:
            cover = Surface(self.weights, self.spacing, self.origin, self.shape, Bilinear())
        return Surface(method.coefficients(self.values), self.spacing, self.origin, self.shape, method, cover)

    def sample(self, x: ArrayLike, y: ArrayLike, method: Sampling = Bilinear()) -> Array:  # noqa: B008
        """Values at the points `(x, y)`; see `Surface.value`."""
        return self.surface(method).value(x, y)

    def sample_with_gradient(self, x: ArrayLike, y: ArrayLike, method: Sampling = Bilinear()) -> tuple[Array, Array, Array]:  # noqa: B008
        """Values and both slopes at the points `(x, y)`; see `Surface.value_and_gradient`."""
        return self.surface(method).value_and_gradient(x, y)

    def outside(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Which points lie outside the outermost pixels, as booleans of the points' shape; see `Surface.outside`."""
        return self.surface().outside(x, y)


def of_order_one(values: Array) -> Array:
    """Values divided by a power of two, so that neither their range nor its square leaves their type. For what no unit can change."""
    # In two steps, since the reciprocal of the largest float32 is no normal number.
    values = values / 16
    return values / power_of_two(jnp.max(jnp.abs(values)))


def _per_axis(name: str, value: PerAxis, dtype: jnp.dtype, must_be_positive: bool = False) -> tuple[Array, Array]:
    """A number, or a pair (x, y), as two scalar arrays of the pixels' type."""
    pair: Any = value if isinstance(value, tuple | list) else given(name, value)
    pair = tuple(pair) if isinstance(pair, tuple | list) or pair.ndim == 1 else (pair, pair)
    if len(pair) != 2 or any(shape_of(part) for part in pair):
        raise ValueError(f"{name} must be one number or a pair (along x, along y), got {value!r}.")
    owned = tuple(as_inexact(name, part, dtype) for part in pair)
    for axis, part in zip("xy", pair, strict=True):
        # In the pixels' type: what is rounded to zero is none.
        part = part if isinstance(part, Tracer) else np.asarray(given(name, part)).astype(dtype)
        if not isinstance(part, Tracer) and not (np.isfinite(part) and (part > 0 or not must_be_positive)):
            wanted = "positive and finite" if must_be_positive else "finite"
            raise ValueError(f"{name} along {axis} is {part}, but must be {wanted}: every sample would be wrong. Correct {name}.")
    return owned[0], owned[1]


def _check_place(given: Any, origin: tuple[Array, Array], spacing: tuple[Array, Array]) -> None:
    """Raise ValueError where rounding to the pixels' type moves the origin by a part of a pixel that counts."""
    pair: tuple[Any, ...] = tuple(given) if isinstance(given, (tuple, list)) or np.ndim(given) == 1 else (given, given)
    for axis, exact, held, step in zip("xy", pair, origin, spacing, strict=True):
        if any(isinstance(value, Tracer) for value in (exact, held, step)):
            continue
        error = abs(float(held) - float(exact))
        if error > 1e-3 * float(step):
            raise ValueError(
                f"origin along {axis} is {exact}, which {held.dtype} holds as {float(held)!r}: the image would lie "
                f"{error / float(step):.2g} pixels off. Subtract the origin from it and from the nodes, or pass float64 pixels with "
                f"jax_enable_x64 on."
            )


def without_holes(name: str, image: Image, why: str) -> Image:
    """The image, which has no weights; else ValueError."""
    if image.weights is not None:
        raise ValueError(
            f"{name} has weights or holes, but {why} Pass {name}.filled(), in which holes are continued from their neighbours."
        )
    return image


def _as_pixels(values: ArrayLike, weights: ArrayLike | None) -> tuple[Array, Array | None]:
    """Pixels and weights as floating arrays; refuse what is not one channel of finite real numbers, naming what came and what to do."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.getmaskarray(values).any():
        row = tuple(int(i) for i in np.argwhere(np.ma.getmaskarray(values))[0])
        raise ValueError(
            f"values{list(row)} is masked: what lies under a mask is no pixel. "
            "Use image_from_array(values, fill=<number>), or holes=Holes()."
        )
    array: Any = given("values", values)
    if not isinstance(array, Tracer):
        array = np.asarray(array)
    dtype = _floating(np.dtype(array.dtype))
    shape = tuple(array.shape)
    if len(shape) != 2:
        is_colour = len(shape) == 3 and shape[-1] in (1, 2, 3, 4)
        cure = "pass values[..., 0], or load it with channel=Luminance()" if is_colour else "pass an array (rows, columns)"
        raise ValueError(f"values has shape {shape}, but an image has one channel, (ny, nx): {cure}.")
    if 0 in shape:
        raise ValueError(f"values has shape {shape}: there is no pixel to sample. Pass at least one row and one column.")
    weight = None if weights is None else checked_weights(weights, shape, dtype)
    if isinstance(array, np.ndarray):
        # Converted here and not by JAX, which knows neither foreign byte orders nor long doubles; what overflows is found below.
        with np.errstate(over="ignore"):
            array = array.astype(dtype)
        counts = True if weight is None or isinstance(weight, Tracer) else np.asarray(weight > 0)
        bad = np.argwhere(~np.isfinite(array) & counts)
        if len(bad):
            row, column = (int(i) for i in bad[0])
            raise ValueError(
                f"values[{row}, {column}] is {array[row, column]} in {dtype} ({len(bad)} of {array.size} pixels are not finite).\n"
                "Unchecked, it would spoil every sample in the four cells around it, even exactly on a good neighbour (0 * NaN is NaN).\n"
                "Repair the pixels, load them with fill=<number> to replace each one that is not finite, or give them the weight 0."
            )
    if weight is None:
        return own("values", array, dtype), None
    filled = continued(array if isinstance(array, np.ndarray) else array.astype(dtype), weight)
    return own("values", filled, dtype), own("weights", weight, dtype)


def _floating(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The floating type that pixels of `dtype` are held in."""
    if dtype.kind in "biu":
        return jnp.result_type(float)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise TypeError(f"values has dtype {dtype}, but pixels must be real numbers. Pass for instance their absolute value.")
    if dtype.itemsize < 4:
        raise TypeError(f"values has dtype {dtype}: half precision overflows in the filters. Convert with values.astype('float32').")
    return np.dtype(np.float32) if dtype.itemsize == 4 else jnp.result_type(float)
