"""What the surfaces of this package share on the host: what a user gives, checked by name; weights of pixels; springs along sides."""

from __future__ import annotations

from typing import Any

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


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a_x b_y - a_y b_x of vectors (..., 2)."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def pixel_weights(image: Image) -> np.ndarray:
    """(P,) how much each pixel counts, row by row: 1 where the image says nothing, 0 in its holes."""
    if image.weights is None:
        return np.ones(image.values.size)
    return np.asarray(image.weights, np.float64).ravel()


def seen(image: Image) -> np.ndarray:
    """(ny, nx) the pixels, NaN in holes: there pictures stay empty, and errors do not count."""
    return np.where(pixel_weights(image) > 0, np.asarray(image.values, np.float64).ravel(), np.nan).reshape(image.shape)


def weighted_rms(error: np.ndarray, weights: np.ndarray) -> float:
    """Root mean square of errors by weights of as many numbers; what is NaN does not count. Without any weight NaN."""
    error, weights = np.ravel(error), np.ravel(weights)
    counts = ~np.isnan(error) & (weights > 0)
    total = float(weights[counts].sum())
    return float(np.sqrt(np.sum(weights[counts] * error[counts] ** 2) / total)) if total > 0 else float("nan")


def springs_along(edges: np.ndarray, sides: np.ndarray, n_nodes: int) -> np.ndarray:
    """(...) which spring runs along each side (..., 2); springs are sorted, lower node first."""
    return np.searchsorted(edges.astype(np.int64) @ [n_nodes, 1], np.sort(sides, axis=-1).astype(np.int64) @ [n_nodes, 1])


def differences(edges: np.ndarray, n_nodes: int) -> Any:
    """(E, N) sparse: head less tail of every spring."""
    from scipy.sparse import csr_array

    rows, signs = np.repeat(np.arange(len(edges)), 2), np.tile([-1.0, 1.0], len(edges))
    return csr_array((signs, (rows, edges.ravel())), shape=(len(edges), n_nodes))


def factored(matrix: Any, hair: float) -> Any:
    """A sparse symmetric matrix ready to be solved with, a hair of its largest diagonal entry added: it chooses what nothing else does."""
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    n = matrix.shape[0]
    added = diags_array(np.full(n, hair * matrix.diagonal().max()))
    return splu((matrix + added).tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})


__all__ = [
    "cross",
    "differences",
    "factored",
    "host_number",
    "pixel_weights",
    "plane_points",
    "seen",
    "springs_along",
    "weighted_rms",
]
