"""Symmetric filters along one axis of an image, as products with a small band matrix.

The axis is cut into blocks of B >= 2 radius pixels. The outputs of a block need only that block and the next of the extended image, so with
the band matrix `A` of shape (2 B, B) the whole filter is one product (rows of two blocks) A. A sum of shifted slices runs faster at small
radius, but compiling its gradient took a minute at radius 40 and more than six at 80; this takes the same few seconds for any radius.
"""

from __future__ import annotations

import functools

import jax
import numpy as np
from jax import lax
from jax import numpy as jnp
from jaxtyping import Array

# Smaller products do not fill the vector registers.
_LEAST_BLOCK = 32


def band_distance(radius: int) -> np.ndarray:
    """Distances in pixels, `(2 B, B)` whole numbers, from each input of two blocks to each output; above `radius` where unrelated."""
    block = max(2 * radius, _LEAST_BLOCK)
    return np.abs(np.arange(2 * block)[:, None] - np.arange(block)[None, :] - radius)


# One program instead of a dozen where it is called outside `jit`; inside, it leaves no trace.
@functools.partial(jax.jit, static_argnames=("radius", "axis", "mode"), inline=True)
def filter_axis(values: Array, band: Array, radius: int, axis: int, mode: str) -> Array:
    """Filter the pixels `(ny, nx)` along one axis.

    `band` is the kernel at the distances of `band_distance(radius)`, zero beyond the radius. The image is extended by `jnp.pad`'s `mode`.
    """
    rows = values if axis == 1 else values.T
    n_rows, n = rows.shape
    block = band.shape[1]
    n_blocks = -(-n // block)
    extended = jnp.pad(rows, ((0, 0), (radius, radius)), mode=mode)
    extended = jnp.pad(extended, ((0, 0), (0, (n_blocks + 1) * block - extended.shape[1])))
    blocks = extended.reshape(n_rows, n_blocks + 1, block)
    pairs = jnp.concatenate([blocks[:, :-1], blocks[:, 1:]], axis=-1)
    # Without this, accelerators multiply in reduced precision.
    filtered = jnp.matmul(pairs.reshape(-1, 2 * block), band, precision=lax.Precision.HIGHEST)
    filtered = filtered.reshape(n_rows, n_blocks * block)[:, :n]
    return filtered if axis == 1 else filtered.T
