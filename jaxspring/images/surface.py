"""Reading an image at any points: locate the cell, gather its block of coefficients, weight and sum.

Nothing here differentiates a gather with respect to its index: slopes with respect to position come from the weights alone, so the
reverse pass holds a scatter only where the pixels themselves are differentiated.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array

from .._arrays import given
from .sampling import Sampling

# One program instead of a dozen where a method is called outside `jit`; inside, it leaves no trace.
_one_program = functools.partial(jax.jit, inline=True)


class Surface(eqx.Module):
    """An image with its coefficients for one way of sampling, from `Image.surface`.

    The result has the floating type of the points, not of the pixels, so a float32 state stays float32. A coordinate that is NaN or
    infinite gives NaN, and so does everything where a traced spacing is not positive; any other coordinate
    outside is clamped, however far.

    Attributes:
        coefficients: what the weights of `method` multiply, an array of at least `(ny, nx)` [image unit].
        spacing: distance between pixels along x and along y [m], two 0-d arrays.
        origin: position (x, y) of the first pixel [m], two 0-d arrays.
        shape: `(ny, nx)` (static).
        method: how to read between pixels.
        cover: the weights of the pixels, to be read bilinearly; None where all count alike.
    """

    coefficients: Array
    spacing: tuple[Array, Array]
    origin: tuple[Array, Array]
    shape: tuple[int, int] = eqx.field(static=True)
    method: Sampling
    cover: Surface | None = None

    @_one_program
    def value(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Values at the points `(x, y)`, two arrays of any one shape [m] (or one of them a number)."""
        (column, row), finite = self._locate(x, y)
        block = self._block(column, row)
        value = _weighted(self.method.weights(row.fraction), [_weighted(self.method.weights(column.fraction), line) for line in block])
        return jnp.where(finite, value, jnp.nan)

    @_one_program
    def value_and_gradient(self, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array, Array]:
        """Value, d value/dx and d value/dy at the points `(x, y)`, for the price of one gather [image unit, and that per m].

        The slope across a border that the point is beyond is exactly zero; the one along that border is the border's own.
        """
        (column, row), finite = self._locate(x, y)
        block = self._block(column, row)
        along_x = [_weighted(self.method.weights(column.fraction), line) for line in block]
        slope_x = [_weighted(self.method.slopes(column.fraction), line) for line in block]
        down, down_slope = self.method.weights(row.fraction), self.method.slopes(row.fraction)
        parts = (
            _weighted(down, along_x),
            jnp.where(column.inside, _weighted(down, slope_x), 0) / column.spacing,
            jnp.where(row.inside, _weighted(down_slope, along_x), 0) / row.spacing,
        )
        value, dx, dy = (jnp.where(finite, part, jnp.nan) for part in parts)
        return value, dx, dy

    def outside(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Which points lie outside the outermost pixels, as booleans of the points' shape. The very border is inside; NaN is outside."""
        (column, row), _ = self._locate(x, y)
        return ~(column.inside & row.inside)

    def _locate(self, x: ArrayLike, y: ArrayLike) -> tuple[tuple[_Along, _Along], Array]:
        """The cell and the fraction of it that each coordinate falls in, and whether that is a place."""
        x, y = _points(x, y)
        column = _along(x, self.origin[0], self.spacing[0], self.shape[1])
        row = _along(y, self.origin[1], self.spacing[1], self.shape[0])
        return (column, row), jnp.isfinite(x) & jnp.isfinite(y) & (column.spacing > 0) & (row.spacing > 0)

    def _block(self, column: _Along, row: _Along) -> list[list[Array]]:
        """The coefficients around each point, as `block[a][b]` along rows and columns."""
        flat, width = self.coefficients.reshape(-1), self.coefficients.shape[-1]
        corner = row.cell * width + column.cell
        n = len(self.method.weights(jnp.zeros((), column.fraction.dtype)))

        def gather(index: Array) -> Array:
            # `_along` keeps every index in range, NaN included; telling JAX so saves its own clamping and wrapping of each index.
            return flat.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False).astype(column.fraction.dtype)

        return [[gather(corner + (a * width + b)) for b in range(n)] for a in range(n)]


class _Along(eqx.Module):
    """Where points fall along one axis: cell index, fraction of that cell, whether within the outermost pixels, and the axis' spacing."""

    cell: Array
    fraction: Array
    inside: Array
    spacing: Array


def _along(coordinate: Array, origin: Array, spacing: Array, n: int) -> _Along:
    """Split one coordinate into cell and fraction; outside is clamped, NaN lands somewhere valid."""
    spacing = spacing.astype(coordinate.dtype)
    u = (coordinate - origin.astype(coordinate.dtype)) / spacing
    # Comparisons rather than `clip`, whose slope on the very border is one half: nodes that slide along a border sit exactly there.
    clamped = jnp.where(u >= 0, jnp.where(u <= n - 1, u, n - 1), 0)
    cell = jnp.minimum(clamped.astype(jnp.int32), max(n - 2, 0))
    return _Along(cell, clamped - lax.stop_gradient(cell.astype(u.dtype)), (u >= 0) & (u <= n - 1), spacing)


def _weighted(weights: Sequence[Array], terms: Sequence[Array]) -> Array:
    """Sum of weight times term."""
    total = weights[0] * terms[0]
    for weight, term in zip(weights[1:], terms[1:], strict=True):
        total = total + weight * term
    return total


def _points(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Both coordinates as floating arrays of one shape and one type."""
    # A Python number follows the other coordinate; whole numbers become the default float.
    x, y = given("x", x), given("y", y)
    dtype = jnp.result_type(x, y)
    if not jnp.issubdtype(dtype, jnp.floating):
        dtype = jnp.result_type(float)
    x, y = jnp.asarray(x, dtype), jnp.asarray(y, dtype)
    if x.shape != y.shape and x.ndim and y.ndim:
        raise ValueError(f"x has shape {x.shape} and y has shape {y.shape}: give every point both coordinates, in two arrays of one shape.")
    shape = x.shape or y.shape
    return jnp.broadcast_to(x, shape), jnp.broadcast_to(y, shape)
