"""Sides of triangles swapped where that lowers the squared error: each pair of triangles is cut along the better diagonal of its four.

In sweeps: heights by least squares, then for every inner side whose four corners are convex the squared error over the pixels of both
triangles, cut as they are and the other way, heights held. The swaps that gain most are made, none beside another; then the next sweep.

Source: data-dependent triangulation by local swaps, Dyn, Levin and Rippa (1990).
"""

from __future__ import annotations

import numpy as np

from ...images.image import Image
from ...topology.mesh_checks import Sides
from .given import cross, pixel_weights
from .tin import Tin, fitted_tin, locate_pixels

# A triangle thinner than this share of its longest side squared is not made.
THIN = 1e-3
# A sweep that gains less than this share of the squared error is the last one.
ENOUGH = 1e-3


def swap_sides(image: Image, tin: Tin, n_sweeps: int = 20) -> Tin:
    """Swap sides of triangles until the squared error falls no more; nodes keep their places, heights are fitted again.

    Args:
        image: the data.
        tin: a surface over it.
        n_sweeps: at most so many.

    Returns:
        A `Tin` with as many triangles.

    >>> y, x = np.mgrid[:20, :20]
    >>> ridge = Image(np.abs(1.0 * x - y))
    >>> across = Tin(np.array([[0.0, 0, 0], [19, 0, 0], [0, 19, 0], [19, 19, 0]]), np.array([[0, 1, 2], [2, 1, 3]]))
    >>> swap_sides(ridge, across).errors(ridge).rmse < 0.05
    True
    """
    truth, weights = np.asarray(image.values, np.float64).ravel(), pixel_weights(image)
    now = fitted_tin(image, tin.points, tin.triangles)
    for _ in range(n_sweeps):
        before = _squared(image, truth, weights, now)
        changed = _swept(image, truth, weights, now)
        if changed is None:
            break
        after = fitted_tin(image, now.points, changed)
        gain = before - _squared(image, truth, weights, after)
        now = after if gain > 0 else now
        if gain <= ENOUGH * before:
            break
    return now


def _squared(image: Image, truth: np.ndarray, weights: np.ndarray, tin: Tin) -> float:
    return float(np.nansum(weights * (tin.drawn(image).ravel() - truth) ** 2))


def _swept(image: Image, truth: np.ndarray, weights: np.ndarray, tin: Tin) -> np.ndarray | None:
    """The triangles after one sweep, or None where no swap gains."""
    points, triangles = tin.points, tin.triangles.copy()
    located = locate_pixels(image, points, triangles)
    (_, nx), (sx, sy), (ox, oy) = image.shape, map(float, image.spacing), map(float, image.origin)
    order = np.argsort(located.triangle, kind="stable")
    first = np.searchsorted(located.triangle[order], np.arange(len(triangles) + 1)).tolist()
    place = np.stack([ox + sx * (order % nx), oy + sy * (order // nx)], axis=-1)
    data = np.stack([truth, weights], axis=-1)[order]
    sides = Sides(triangles)
    numbers, one, other, _ = sides.shared()
    found = []
    for side, t, u in zip(numbers.tolist(), one.tolist(), other.tolist(), strict=True):
        a, b = sides.pairs[side].tolist()
        c, d = (int(triangles[k].sum()) - a - b for k in (t, u))
        quad = points[[a, b, c, d]]
        if not _is_convex(quad):
            continue
        pixels = np.concatenate([np.arange(first[t], first[t + 1]), np.arange(first[u], first[u + 1])])
        gain = _error(quad[[0, 1, 2, 3]], place[pixels], data[pixels]) - _error(quad[[2, 3, 0, 1]], place[pixels], data[pixels])
        if gain > 0:
            found.append((gain, t, u, a, b, c, d))
    used, changed = np.zeros(len(triangles), bool), False
    for _, t, u, a, b, c, d in sorted(found, reverse=True):
        if used[t] or used[u]:
            continue
        turn = cross(points[a] - points[c], points[d] - points[c]) > 0
        is_up = cross(*(points[triangles[t][i]] - points[triangles[t][0]] for i in (1, 2))) > 0
        triangles[t] = (c, a, d) if turn == is_up else (c, d, a)
        triangles[u] = (c, d, b) if turn == is_up else (c, b, d)
        used[[t, u]], changed = True, True
    return triangles if changed else None


def _error(quad: np.ndarray, place: np.ndarray, data: np.ndarray) -> float:
    """Squared error beside values and weights `data` (P, 2) of the surface cut from corner 0 to corner 1, corners 2 and 3 beside it."""
    a, b = quad[0], quad[1]
    beside = cross(b[:2] - a[:2], place - a[:2]) * cross(b[:2] - a[:2], quad[2][:2] - a[:2]) >= 0
    total = 0.0
    for corner, held in ((quad[2], beside), (quad[3], ~beside)):
        u, v, p = b - a, corner - a, place[held] - a[:2]
        area = cross(u, v)
        s, t = cross(p, v) / area, cross(u, p) / area
        total += float(np.sum(data[held, 1] * (a[2] + s * u[2] + t * v[2] - data[held, 0]) ** 2))
    return total


def _is_convex(quad: np.ndarray) -> bool:
    """Whether the side from corner 2 to corner 3 runs inside, and cuts off no sliver."""
    a, b, c, d = quad
    along = d - c
    left, right = float(cross(along, a - c)), float(cross(along, b - c))
    longest = max(float(np.sum((p[:2] - q[:2]) ** 2)) for p in (a, b) for q in (c, d))
    return bool(left * right < 0) and min(abs(left), abs(right)) > THIN * max(longest, float(np.sum(along[:2] ** 2)))


__all__ = ["swap_sides"]
