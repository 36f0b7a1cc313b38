"""Closed shells: a mesh of sphere topology fitted to range data of a shape, coarse to fine.

    data spring of a point q     acts on its nearest place on the surface, w_a x_a + w_b x_b + w_c x_c in a triangle
    balance                      (W'W + r L) (x - x_before) = W'(q - W x_before),    L of springs along the sides, r their stiffness
                                 over that of one datum

so springs resist a change of shape, not the shape: nothing shrinks. Nearest places are looked for anew, and the balance found again, until
they agree. Then every triangle is split into four, the surface unmoved, and so on.

Source: the nearest-place iteration of Besl and McKay (1992), with springs in the place of a rigid motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._arrays import Numbers, on_host, whole_number
from ..._checks import finite, triangle_indices
from ...topology.builders import from_triangles
from ...topology.graph import Graph
from .given import differences, factored, host_number
from .red_green import SIDES
from .refine import Subdivision

# Searches of nearest places at each level, and triangles looked at for each point.
SEARCHES, NEAR = 8, 12


@dataclass(frozen=True)
class Shell:
    """What `fit_shell` returns.

    Attributes:
        points: (N, 3) nodes [m].
        triangles: (T, 3) node numbers, wound as they came.
        rms: for each level, the root mean square distance of the data from the surface [m].
        n_nodes: for each level.
        levels: for each level, (points, triangles).
    """

    points: np.ndarray
    triangles: np.ndarray
    rms: tuple[float, ...]
    n_nodes: tuple[int, ...]
    levels: tuple[tuple[np.ndarray, np.ndarray], ...]

    @property
    def net(self) -> Graph:
        """A spring along every side."""
        return from_triangles(self.triangles, len(self.points))


def icosahedron(radius: Numbers = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """(12, 3) corners and (20, 3) faces, wound outward, of a regular icosahedron about the origin: a shell to start from.

    Args:
        radius: of the corners [m].

    Returns:
        `(points, triangles)`.

    Raises:
        ValueError: a radius that is not positive.

    >>> points, triangles = icosahedron(2.0)
    >>> round(float(np.linalg.norm(points[3])), 3), triangles.shape
    (2.0, (20, 3))
    """
    size = host_number("radius", radius, "A shell has a size.")
    height, ring = 1 / math.sqrt(5), 2 / math.sqrt(5)
    turn = 2 * math.pi * np.arange(5) / 5
    upper = np.stack([ring * np.cos(turn), ring * np.sin(turn), np.full(5, height)], axis=-1)
    lower = np.stack([ring * np.cos(turn + math.pi / 5), ring * np.sin(turn + math.pi / 5), np.full(5, -height)], axis=-1)
    points = size * np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]])
    i = np.arange(5)
    j = (i + 1) % 5
    zero, last = np.zeros(5, int), np.full(5, 11)
    faces = [(zero, 1 + i, 1 + j), (1 + i, 6 + i, 1 + j), (1 + j, 6 + i, 6 + j), (6 + i, last, 6 + j)]
    return points, np.concatenate([np.stack(face, axis=-1) for face in faces])


def fit_shell(data: Numbers, points: Numbers, triangles: Numbers, n_levels: int = 3, stiffness: Numbers = 0.1) -> Shell:
    """Fit a closed mesh, or any surface in space, to points on a shape.

    Args:
        data: (P, 3) points on the shape, with noise [m].
        points: (N, 3) nodes of a coarse mesh near the shape, such as `icosahedron` moved and scaled [m].
        triangles: (T, 3) node numbers.
        n_levels: how often every triangle is split after the first fit.
        stiffness: r of the springs along the sides, over that of one datum.

    Returns:
        `Shell`; its nodes are the least-squares surface of triangles, which lies on both sides of a curved shape.

    Raises:
        ValueError: arrays of other shapes, what is not finite, no data, a stiffness that is not positive.

    >>> rng = np.random.default_rng(0)
    >>> directions = rng.normal(size=(500, 3))
    >>> shape = directions / np.linalg.norm(directions, axis=1, keepdims=True) * [1.5, 1.0, 0.8]
    >>> found = fit_shell(shape, *icosahedron(), n_levels=1)
    >>> found.n_nodes, found.rms[1] < found.rms[0] / 2
    ((12, 42), True)
    """
    q, x = (on_host(name, a).astype(np.float64) for name, a in (("data", data), ("points", points)))
    for name, a in (("data", q), ("points", x)):
        if a.ndim != 2 or a.shape[1] != 3 or not len(a):
            raise ValueError(f"{name} has shape {a.shape}; expected (N, 3), one row for each point.")
        finite(name, a)
    ratio = host_number("stiffness", stiffness, "A node without data would be anywhere.")
    n_levels = whole_number("n_levels", n_levels)
    mesh = Subdivision.of(triangle_indices("triangles", triangles, len(x)), len(x))
    rms, levels = [], []
    for level in range(n_levels + 1):
        if level:
            finer = mesh.refined(np.ones(len(mesh.triangles), bool))
            mesh, x = finer, finer.carried(x, mesh)
        for _ in range(SEARCHES):
            x = _balanced(q, x, mesh, ratio)
        rms.append(float(np.sqrt(np.mean(np.sum((_surface(q, x, mesh.triangles)[0] @ x - q) ** 2, axis=1)))))
        levels.append((x, mesh.triangles))
    return Shell(x, mesh.triangles, tuple(rms), tuple(len(p) for p, _ in levels), tuple(levels))


def _balanced(q: np.ndarray, x: np.ndarray, mesh: Subdivision, stiffness: float) -> np.ndarray:
    """Nodes in balance between the data and the springs."""
    matrix, _ = _surface(q, x, mesh.triangles)
    difference = differences(np.asarray(mesh.net.edges), len(x))
    system = matrix.T @ matrix + stiffness * (difference.T @ difference)
    return x + factored(system, 1e-12).solve(matrix.T @ (q - matrix @ x))


def _surface(q: np.ndarray, x: np.ndarray, triangles: np.ndarray) -> tuple[Any, np.ndarray]:
    """(P, N) weights of the nodes at the place of the surface that is nearest to each point, and the triangle of each."""
    from scipy.sparse import csr_array
    from scipy.spatial import KDTree

    corners = x[triangles]
    near = min(NEAR, len(triangles))
    _, candidates = KDTree(corners.mean(axis=1)).query(q, k=near)
    candidates = candidates.reshape(len(q), near)
    weights = nearest_weights(q[:, None], corners[candidates])
    distance = np.sum((np.einsum("pkc,pkcd->pkd", weights, corners[candidates]) - q[:, None]) ** 2, axis=-1)
    best = np.argmin(distance, axis=1)
    chosen, rows = candidates[np.arange(len(q)), best], np.arange(len(q))
    entries = weights[rows, best].ravel(), (np.repeat(rows, 3), triangles[chosen].ravel())
    return csr_array(entries, shape=(len(q), len(x))), chosen


def nearest_weights(q: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(..., 3) barycentric weights of the place of each triangle (..., 3, D) that is nearest to a point (..., D)."""
    a, b, c = corners[..., 0, :], corners[..., 1, :], corners[..., 2, :]
    u, v, p = b - a, c - a, q - a
    uu, uv, vv, pu, pv = (np.sum(one * other, axis=-1) for one, other in ((u, u), (u, v), (v, v), (p, u), (p, v)))
    area = uu * vv - uv * uv
    safe = np.where(area > 0, area, 1)
    s, t = (vv * pu - uv * pv) / safe, (uu * pv - uv * pu) / safe
    inside = np.stack([1 - s - t, s, t], axis=-1)
    # Outside it is on one of the sides.
    sides = []
    for i, j in SIDES:
        one, other = corners[..., i, :], corners[..., j, :]
        along = other - one
        length = np.sum(along * along, axis=-1)
        share = np.clip(np.sum((q - one) * along, axis=-1) / np.where(length > 0, length, 1), 0, 1)
        weights = np.zeros(inside.shape)
        weights[..., i], weights[..., j] = 1 - share, share
        sides.append(weights)
    on_sides = np.stack(sides, axis=-2)
    gap = np.sum((np.einsum("...kc,...cd->...kd", on_sides, corners) - q[..., None, :]) ** 2, axis=-1)
    nearest = np.take_along_axis(on_sides, np.argmin(gap, axis=-1)[..., None, None], axis=-2)[..., 0, :]
    is_inside = (inside >= 0).all(axis=-1) & (area > 0)
    return np.where(is_inside[..., None], inside, nearest)


__all__ = ["Shell", "fit_shell", "icosahedron", "nearest_weights"]
