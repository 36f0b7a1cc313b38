"""Ways to read an image between its pixels: bilinear, and cubic B-spline.

Both are separable sums over a small block of coefficients `c` around the point, which lies at the fraction `t` of a cell:

    value    sum_ab  w_a(ty) w_b(tx) c[iy + a, ix + b]
    slope    the same with w' in place of w on one axis

Bilinear takes the pixels themselves as coefficients. The cubic spline first solves for coefficients whose spline passes through
the pixels (Unser, Aldroubi & Eden 1993, IEEE Trans. Signal Processing 41, 821-833).
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .filtering import band_distance, filter_axis

# The inverse of the sampled cubic B-spline (1, 4, 1)/6 is sqrt(3) z^|k|, with z the root of z^2 + 4 z + 1 inside the unit circle.
_POLE = float(np.sqrt(3.0) - 2.0)


class Sampling(eqx.Module):
    """A rule for reading between the pixels. `Bilinear` and `CubicSpline` are ready made; subclass it for another one.

    A point lies in cell `i` of an axis, at the fraction `t` in [0, 1] of it; cells run from 0 to `n - 2` (one pixel alone has one cell).
    The block of coefficients that `weights` multiplies starts at index `i` of the array that `coefficients` returns.
    """

    @abc.abstractmethod
    def coefficients(self, values: Array) -> Array:
        """Coefficients to gather from, made once from the pixels `(ny, nx)`; each axis has at least `n_cells - 1 + n_weights` entries."""

    @abc.abstractmethod
    def weights(self, t: Array) -> tuple[Array, ...]:
        """One weight per coefficient of the block along one axis, at the fraction `t` of a cell."""

    @abc.abstractmethod
    def slopes(self, t: Array) -> tuple[Array, ...]:
        """Derivatives of `weights` with respect to `t`."""


class Bilinear(Sampling):
    """Linear along x and along y inside each cell of four pixels: continuous, with a kink at every pixel.

    On a kink the slope is that of the cell to the right (towards larger x or y); on the last row or column, of the last cell.
    It never leaves the range of the pixels.
    """

    def coefficients(self, values: Array) -> Array:
        """The pixels; a single row or column is doubled, so that every axis has a cell."""
        pad = [(0, 1 if n == 1 else 0) for n in values.shape]
        return jnp.pad(values, pad, mode="edge") if 1 in values.shape else values

    def weights(self, t: Array) -> tuple[Array, ...]:
        """`(1 - t, t)`: exact at both ends of the cell."""
        return 1 - t, t

    def slopes(self, t: Array) -> tuple[Array, ...]:
        """Derivatives of the two weights by `t`: `(-1, 1)` wherever `t` is."""
        one = jnp.ones_like(t)
        return -one, one


class CubicSpline(Sampling):
    """The cubic B-spline through the pixels, twice continuously differentiable.

    The image is mirrored about its outermost pixels (SciPy's `mode="mirror"`), so the slope across the border is zero on the border and
    stays continuous where the clamped outside begins. Between pixels it can leave their range, by about a tenth of a jump.
    """

    def coefficients(self, values: Array) -> Array:
        """Spline coefficients of the mirrored image, with one more on each side."""
        for axis in (0, 1):
            values = _prefilter(values, axis)
        # An axis of one pixel is constant: its only cell still needs four coefficients.
        pad = [(1, 2 if n == 1 else 1) for n in values.shape]
        for axis, width in enumerate(pad):
            widths = [(0, 0), (0, 0)]
            widths[axis] = width
            values = jnp.pad(values, widths, mode="edge" if values.shape[axis] == 1 else "reflect")
        return values

    def weights(self, t: Array) -> tuple[Array, ...]:
        """The four pieces of the cubic B-spline."""
        s = 1 - t
        return s * s * s / 6, (4 - 3 * t * t * (1 + s)) / 6, (4 - 3 * s * s * (1 + t)) / 6, t * t * t / 6

    def slopes(self, t: Array) -> tuple[Array, ...]:
        """Derivatives of the four pieces by `t`."""
        s = 1 - t
        return -s * s / 2, t * (3 * t - 4) / 2, s * (4 - 3 * s) / 2, t * t / 2


def _prefilter(values: Array, axis: int) -> Array:
    """Coefficients along one axis whose B-spline passes through `values`; the inverse filter is cut off below rounding."""
    n = values.shape[axis]
    if n == 1:
        return values
    # Cut where the tail is under a tenth of the rounding unit: 14 taps on each side in float32, 30 in float64.
    radius = int(np.ceil(np.log(0.1 * float(jnp.finfo(values.dtype).eps)) / np.log(-_POLE)))
    distance = band_distance(radius)
    band = np.where(distance <= radius, np.sqrt(3.0) * _POLE**distance, 0.0)
    return filter_axis(values, jnp.asarray(band, values.dtype), radius, axis, mode="reflect")
