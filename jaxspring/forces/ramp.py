"""A ramp that sets in softly: zero, then curving up over a width w, then straight with slope 1.

    ramp      z^2 / (2 w) for 0 < z < w,  z - w / 2 beyond       slope     z / w,  1 beyond
    energy    z^3 / (6 w),  z^2 / 2 - z w / 2 + w^2 / 6 beyond, its integral

Value, slope and energy are continuous. What pushes or stiffens from some depth or strain on has this form.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array


def ramp(z: Array, width: Array) -> Array:
    """The ramp; zero below zero. A width of zero stands for none: slope 1 at once."""
    rising, beyond = _parts(z, width)
    return rising * rising / (2 * _divisor(width)) + beyond


def ramp_slope(z: Array, width: Array) -> Array:
    """Its derivative, between 0 and 1."""
    rising, _ = _parts(z, width)
    return rising / _divisor(width)


def ramp_energy(z: Array, width: Array) -> Array:
    """Its integral."""
    rising, beyond = _parts(z, width)
    return rising * rising * rising / (6 * _divisor(width)) + 0.5 * beyond * (beyond + width)


def _parts(z: Array, width: Array) -> tuple[Array, Array]:
    """What lies within the width, and what is beyond it."""
    is_beyond, zero = z >= width, jnp.zeros_like(z)
    is_beyond = is_beyond & (z > 0)
    return jnp.where(is_beyond, width, jnp.where(z > 0, z, zero)), jnp.where(is_beyond, z - width, zero)


def _divisor(width: Array) -> Array:
    return jnp.where(width > 0, width, jnp.ones_like(width))


__all__ = ["ramp", "ramp_energy", "ramp_slope"]
