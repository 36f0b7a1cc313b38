"""Losses that several scenes share. A loss is any function from parameters to one number; write your own."""

from __future__ import annotations

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array

from .._checks import as_inexact, finite, shape_of


def squared_distance(points: Array, target: ArrayLike) -> Array:
    """Mean over the nodes of the squared distance between two sets of points.

    Args:
        points: (..., N, D) [m].
        target: of the same shape [m].

    Returns:
        The mean [m^2], 0-d.

    Raises:
        ValueError: a target of another shape, or one that is not finite.

    >>> print(squared_distance(jnp.zeros((2, 3)), jnp.ones((2, 3))))
    3.0
    """
    target = as_inexact("target", target, points.dtype)
    finite("target", target)
    if shape_of(points) != shape_of(target):
        raise ValueError(f"points have shape {shape_of(points)}, target has {shape_of(target)}; expected the same.")
    return jnp.mean(jnp.sum((points - target) ** 2, axis=-1))
