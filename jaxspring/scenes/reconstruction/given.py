"""What the surfaces of this package take from a user: places in the plane, and numbers above zero, read on the host and checked by name."""

from __future__ import annotations

import numpy as np

from ..._arrays import Numbers, on_host
from ..._checks import finite, has_shape, positive
from ...images.image import Image


def host_number(name: str, value: Numbers, why: str) -> float:
    """One number above zero; `why` says what another would do.

    Raises:
        TypeError: no number, or a traced one.
        ValueError: an array, not finite, not above zero.
    """
    array = on_host(name, value).astype(np.float64)
    has_shape(name, array, {"one number": ()})
    positive(name, array, why)
    return float(array)


def plane_points(points: Numbers) -> np.ndarray:
    """(N, 2) the first two coordinates of (N, 2) or (N, 3) points, a copy.

    Raises:
        TypeError: no numbers, or traced ones.
        ValueError: another shape, what is not finite.
    """
    places = on_host("points", points).astype(np.float64)
    if places.ndim != 2 or places.shape[1] not in (2, 3):
        raise ValueError(f"points has shape {places.shape}; expected (N, 2) or (N, 3), one row for each node.")
    finite("points", places)
    return places[:, :2].copy()


def pixel_weights(image: Image) -> np.ndarray:
    """(P,) how much each pixel counts, row by row: 1 where the image says nothing, 0 in its holes."""
    if image.weights is None:
        return np.ones(image.values.size)
    return np.asarray(image.weights, np.float64).ravel()


def weighted_rms(error: np.ndarray, weights: np.ndarray) -> float:
    """Root mean square of errors by weights of the same shape; what is NaN does not count. Without any weight NaN."""
    counts = ~np.isnan(error) & (weights > 0)
    total = float(weights[counts].sum())
    return float(np.sqrt(np.sum(weights[counts] * error[counts] ** 2) / total)) if total > 0 else float("nan")


__all__ = ["host_number", "pixel_weights", "plane_points", "weighted_rms"]
