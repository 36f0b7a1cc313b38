"""Surfaces over any triangles in the plane (TINs): which triangle holds each pixel, heights by least squares, errors.

    surface at a pixel    z(p) = sum w_c z_c over the corners c of its triangle, w barycentric            z_pixels = W z
    best heights          (W'GW + r L) z = W'Gd

G holds the weights of the pixels, 0 in holes; L = sum (z_i - z_j)^2 over springs, with r small, decides nodes that no pixel reaches.

On the host, in double precision; a lattice inside `jit` has `raster` and `pixels` for the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._arrays import Numbers, on_host
from ..._checks import finite, triangle_indices
from ...images.image import Image
from ...topology.builders import from_triangles
from ...topology.graph import Graph
from .given import cross, differences, factored, pixel_weights, plane_points, weighted_rms

# Within so much of its edges a pixel counts as inside a triangle, in barycentric coordinates.
EDGE = 1e-9
# Of a coordinate in pixels, from a spacing and an origin of single precision; and the most that is taken for rounding [pixels].
ROUNDING, MOST_ROUNDING = 16 * float(np.finfo(np.float32).eps), 0.05
# Pairs of triangle and pixel looked at together.
CHUNK = 2_000_000
# Springs along z over the pixels that a node has on average: decides heights that no pixel does.
MEMBRANE = 1e-4


@dataclass(frozen=True)
class Located:
    """Pixels in triangles.

    Attributes:
        triangle: (P,) the triangle that holds each pixel, row by row; -1 outside.
        weights: (P, 3) of its corners.
    """

    triangle: np.ndarray
    weights: np.ndarray

    @property
    def outside(self) -> int:
        """Pixels in no triangle."""
        return int((self.triangle < 0).sum())


def locate_pixels(image: Image, points: np.ndarray, triangles: np.ndarray) -> Located:
    """The triangle that holds each pixel, and the weights of its corners; where triangles overlap, that in which it lies deepest."""
    (ny, nx), (sx, sy), (ox, oy) = image.shape, map(float, image.spacing), map(float, image.origin)
    local = (points[:, :2].astype(np.float64) - [ox, oy]) / [sx, sy]
    # A node on the border is there, though the image keeps its spacing and origin in fewer digits.
    rounding = np.minimum(ROUNDING * np.array([abs(ox / sx) + nx, abs(oy / sy) + ny]), MOST_ROUNDING)
    for border in (np.zeros(2), np.array([nx - 1.0, ny - 1.0])):
        local = np.where(np.abs(local - border) < rounding, border, local)
    a, b, c = (local[triangles[:, i]] for i in range(3))
    corners = np.stack([a, b, c])
    low = np.maximum(np.ceil(corners.min(axis=0) - EDGE), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(axis=0) + EDGE), [nx - 1, ny - 1]).astype(np.int64)
    size = np.maximum(high - low + 1, 0)
    count = size[:, 0] * size[:, 1]
    area = cross(b - a, c - a)
    count[area == 0] = 0
    found, weights, depth = np.full(ny * nx, -1), np.zeros((ny * nx, 3)), np.full(ny * nx, -np.inf)
    start = 0
    while start < len(triangles):
        stop = max(start + 1, int(np.searchsorted(np.cumsum(count[start:]), CHUNK)) + start)
        each = np.repeat(np.arange(start, stop), count[start:stop])
        place = np.arange(len(each)) - np.repeat(np.cumsum(count[start:stop]) - count[start:stop], count[start:stop])
        column, row = low[each, 0] + place % np.maximum(size[each, 0], 1), low[each, 1] + place // np.maximum(size[each, 0], 1)
        p = np.stack([column, row], axis=-1)
        u = cross(b[each] - p, c[each] - p) / area[each]
        v = cross(c[each] - p, a[each] - p) / area[each]
        w = np.stack([u, v, 1 - u - v], axis=-1)
        least = w.min(axis=1)
        pixel = row * nx + column
        # The deepest last: where places are written twice, the last one stays.
        order = np.argsort(least, kind="stable")
        order = order[(least[order] >= -EDGE) & (least[order] > depth[pixel[order]])]
        found[pixel[order]], weights[pixel[order]], depth[pixel[order]] = each[order], w[order], least[order]
        start = stop
    return Located(found, np.clip(weights, 0, 1))


def surface_matrix(located: Located, triangles: np.ndarray, n_nodes: int) -> Any:
    """W, (P, N) sparse: the surface at every pixel from the heights of the nodes. Rows of pixels outside are zero."""
    from scipy.sparse import csr_array

    inside = np.flatnonzero(located.triangle >= 0)
    rows, columns = np.repeat(inside, 3), triangles[located.triangle[inside]].ravel()
    return csr_array((located.weights[inside].ravel(), (rows, columns)), shape=(len(located.triangle), n_nodes))


def fitted_heights(
    matrix: Any, data: np.ndarray, net: Graph, weights: np.ndarray, whole: np.ndarray | None = None, membrane: float = MEMBRANE
) -> np.ndarray:
    """(N,) heights nearest to the pixels `data` (P,) by their `weights` (P,), with a little membrane along the springs that are whole."""
    from scipy.sparse import diags_array

    n, edges = net.n_nodes, np.asarray(net.edges)
    difference = differences(edges, n)
    normal = matrix.T @ diags_array(weights) @ matrix
    weight = float(normal.sum())
    ratio = membrane * (weight if weight > 0 else 1.0) / n
    held = np.ones(len(edges)) if whole is None else np.where(whole, 1.0, 1e-6)
    middle = float(np.average(data, weights=weights))
    system = normal + ratio * (difference.T @ diags_array(held) @ difference)
    counts = weights * (np.asarray(matrix.sum(axis=1)).ravel() > 0)
    return middle + factored(system, 1e-13).solve(matrix.T @ (counts * (data - middle)))


@dataclass(frozen=True)
class Tin:
    """Nodes, triangles and heights.

    Attributes:
        points: (N, 3) nodes; x and y in the unit of the image's spacing, z in that of its values.
        triangles: (T, 3) node numbers.
    """

    points: np.ndarray
    triangles: np.ndarray

    def __post_init__(self):
        """Own both arrays."""
        points = on_host("points", self.points).astype(np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points has shape {points.shape}; expected (N, 3).")
        finite("points", points)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "triangles", triangle_indices("triangles", self.triangles, len(points)).copy())

    @property
    def net(self) -> Graph:
        """A spring along every side."""
        return from_triangles(self.triangles, len(self.points))

    def drawn(self, image: Image) -> np.ndarray:
        """(ny, nx) the surface at every pixel; NaN outside."""
        located = locate_pixels(image, self.points, self.triangles)
        drawn = surface_matrix(located, self.triangles, len(self.points)) @ self.points[:, 2]
        return np.where(located.triangle < 0, np.nan, drawn).reshape(image.shape)

    def errors(self, image: Image) -> SurfaceErrors:
        """Root mean square (by the image's weights) and greatest error over all pixels but holes, folds, and the smallest angle."""
        error = np.abs(self.drawn(image) - np.asarray(image.values, np.float64)).ravel()
        outside, weights = int(np.isnan(error).sum()), pixel_weights(image)
        twice, angle = _areas_and_angle(self.points[:, :2], self.triangles)
        folds = int((twice * np.sign(np.median(twice)) <= 0).sum())
        greatest = float(np.nanmax(np.where(weights > 0, error, np.nan)))
        return SurfaceErrors(weighted_rms(error, weights), greatest, folds, angle, outside)


@dataclass(frozen=True)
class SurfaceErrors:
    """What a TIN is worth on an image.

    Attributes:
        rmse: root mean square error over the pixels inside that are no holes, by their weights [unit of the image].
        greatest: the largest error.
        folds: triangles folded over or without area.
        least_angle: the smallest angle of all triangles [degrees].
        outside: pixels in no triangle.
    """

    rmse: float
    greatest: float
    folds: int
    least_angle: float
    outside: int


def fitted_tin(image: Image, points: Numbers, triangles: Numbers) -> Tin:
    """The TIN with the heights that fit all pixels best.

    Args:
        image: the data.
        points: (N, 2) or (N, 3) nodes in the unit of the image's spacing; x and y are read.
        triangles: (T, 3) node numbers.

    Returns:
        A `Tin`.

    Raises:
        ValueError: triangles that do not fit the points.

    >>> y, x = np.mgrid[:8, :8]
    >>> tin = fitted_tin(Image(2.0 * x + y), [(0, 0), (7, 0), (0, 7), (7, 7)], [(0, 1, 2), (2, 1, 3)])
    >>> print(tin.points[:, 2].round(2), tin.errors(Image(2.0 * x + y)).folds)
    [ 0. 14.  7. 21.] 0
    """
    places = plane_points(points)
    corners = triangle_indices("triangles", triangles, len(places))
    matrix = surface_matrix(locate_pixels(image, places, corners), corners, len(places))
    z = fitted_heights(matrix, np.asarray(image.values, np.float64).ravel(), from_triangles(corners, len(places)), pixel_weights(image))
    return Tin(np.column_stack([places, z]), corners)


def _areas_and_angle(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, float]:
    a, b, c = (points[triangles[:, i]] for i in range(3))
    twice = cross(b - a, c - a)
    sides = np.sort(np.stack([np.linalg.norm(q - p, axis=1) for p, q in ((a, b), (b, c), (c, a))]), axis=0)
    longest = sides[1] * sides[2]
    sine = np.clip(np.abs(twice) / np.where(longest > 0, longest, 1), 0, 1)
    return twice, float(np.degrees(np.arcsin(sine.min())))


__all__ = ["Located", "SurfaceErrors", "Tin", "fitted_heights", "fitted_tin", "locate_pixels", "surface_matrix"]
