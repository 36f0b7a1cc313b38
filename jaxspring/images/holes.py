"""Pixels with weights, and holes: pixels of weight zero, whose stored number is never read.

What reads a picture between its pixels (slopes, smoothing, sampling) needs a number under a hole as well. It gets the continuation of the
data around it, made once. Coarse to fine, with v the values and w = 1 where there is one:

    down   V = sum w v / sum w over 2 x 2 pixels, as long as there is more than one
    up     v = V, interpolated linearly, where there is no value; then a few sweeps v = mean of the four neighbours over the holes

Every number is an average with positive weights, so the continuation stays within the range of the data, is linear in them and turns a
constant into itself. It weighs nothing: no error, data spring or height is drawn to it.

Source of the pyramid: Gortler et al. (1996), "The Lumigraph", section 3.4 (pull-push). The sweeps are ours; they take off its blocks.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._arrays import given
from .._checks import is_concrete

SWEEPS = 4


@dataclass(frozen=True)
class Holes:
    """Which pixels of a file or an array have no value, and that they are to become holes: pixels of weight zero.

    Those that the file itself declares (its no-data number, its mask, pixels that are wholly transparent, masked entries of an array) are
    holes always; pixels that are partly transparent weigh as much as they are opaque.

    Attributes:
        nodata: numbers that stand for "no value" beside the declared one: a number or several, for instance 0 in a depth image.
        nan: whether NaN is a hole too; else it is an error, as infinity always is.

    Raises:
        TypeError: a nodata that is no number.

    >>> import jaxspring as js
    >>> depth = js.images.image_from_array(np.array([[2.0, 0.0], [2.5, np.nan]]), holes=Holes(nodata=0, nan=True))
    >>> print(depth.weights)
    [[1. 0.]
     [1. 0.]]
    """

    nodata: float | tuple[float, ...] = ()
    nan: bool = False

    def __post_init__(self) -> None:
        for number in self.numbers:
            if isinstance(number, bool) or not isinstance(number, int | float | np.integer | np.floating):
                raise TypeError(f"nodata holds {number!r:.60}, a {type(number).__name__}; expected numbers, e.g. Holes(nodata=-9999).")

    @property
    def numbers(self) -> tuple[float, ...]:
        """All the numbers of `nodata`."""
        return self.nodata if isinstance(self.nodata, tuple) else (self.nodata,)


def checked_weights(weights: Any, shape: tuple[int, ...], dtype: Any) -> np.ndarray | Array:
    """Weights in the type of the pixels; of traced ones only the shape is looked at.

    Raises:
        TypeError: no real numbers.
        ValueError: another shape, a weight that is negative or not finite, no weight above zero.
    """
    array: Any = given("weights", weights)
    if np.dtype(array.dtype).kind not in "biuf":
        raise TypeError(f"weights has dtype {array.dtype}; expected real numbers, or booleans that are True where there is a value.")
    if tuple(array.shape) != shape:
        raise ValueError(f"weights has shape {tuple(array.shape)}, but values has {shape}: pass one weight per pixel.")
    if isinstance(array, Tracer):
        return array.astype(dtype)
    with np.errstate(over="ignore"):
        numbers = np.asarray(array).astype(dtype)
    bad = ~(np.isfinite(numbers) & (numbers >= 0))
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"weights[{row}, {column}] is {numbers[row, column]}, but a weight is zero (a hole) or more, and finite. "
            f"Fix it ({int(bad.sum())} of {numbers.size} weights are not)."
        )
    if not numbers.any():
        raise ValueError("weights are zero everywhere: without a single pixel that has a value there is no surface. Pass weights above 0.")
    return numbers


def continued(values: Any, weights: Any) -> Any:
    """Values `(ny, nx)` where the weight is above zero, and their continuation elsewhere; of NumPy arrays one of NumPy.

    What `values` holds under a hole is not read: it may be NaN, and the derivative with respect to it is zero. Where every weight is zero
    the result is zero.
    """
    if not (is_concrete(values) and is_concrete(weights)):
        return _traced(values, weights)
    return _continued(np, np.asarray(values), np.asarray(weights))


def _continued(xp: Any, values: Any, weights: Any) -> Any:
    known = weights > 0
    return _filled(xp, xp.where(known, values, xp.zeros_like(values)), known.astype(values.dtype))


# One program instead of hundreds of operations where it stands outside `jit`; inside, it leaves no trace.
_traced = functools.partial(jax.jit, inline=True)(functools.partial(_continued, jnp))


def _filled(xp: Any, values: Any, known: Any) -> Any:
    """Values (zero where unknown) and their continuation; `known` is one or zero."""
    ny, nx = values.shape
    if ny * nx == 1:
        return values
    pad = ((0, ny % 2 if ny > 1 else 0), (0, nx % 2 if nx > 1 else 0))
    total, count = (_in_blocks(xp.pad(a, pad)) for a in (known * values, known))
    any_known = count > 0
    coarse = xp.where(any_known, total / xp.where(any_known, count, xp.ones_like(count)), xp.zeros_like(total))
    above = _filled(xp, coarse, any_known.astype(values.dtype))
    for axis, n in enumerate((ny, nx)):
        above = _refined(xp, above, axis, n)
    filled = known * values + (1 - known) * above
    for _ in range(SWEEPS):
        padded = xp.pad(filled, 1, mode="edge")
        mean = (padded[:-2, 1:-1] + padded[2:, 1:-1] + padded[1:-1, :-2] + padded[1:-1, 2:]) / 4
        filled = known * values + (1 - known) * mean
    return filled


def _in_blocks(values: Any) -> Any:
    """Sums over blocks of 2 x 2 pixels, of 1 x 2 where there is one row."""
    ny, nx = values.shape
    down, across = min(ny, 2), min(nx, 2)
    return values.reshape(ny // down, down, nx // across, across).sum(axis=(1, 3))


def _refined(xp: Any, coarse: Any, axis: int, n: int) -> Any:
    """Twice as many values along an axis, cut to n: each lies a quarter of a coarse distance from the middle of its block."""
    if n == 1:
        return coarse
    c = coarse if axis == 1 else coarse.T
    padded = xp.pad(c, ((0, 0), (1, 1)), mode="edge")
    fine = xp.stack([0.75 * c + 0.25 * padded[:, :-2], 0.75 * c + 0.25 * padded[:, 2:]], axis=-1).reshape(c.shape[0], -1)[:, :n]
    return fine if axis == 1 else fine.T
