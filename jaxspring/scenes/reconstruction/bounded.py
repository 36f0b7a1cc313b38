"""A surface whose greatest error is bounded: triangles with a pixel beyond the bound are split, and the heights fitted again.

Red-green subdivision, so the nodes of the fitted mesh stay and its triangles keep their shape. As nodes come to be as many as pixels, the
least-squares surface passes through them; a bound that does not hold even then cannot be held, and is said to be so.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._arrays import Numbers
from ..._checks import triangle_indices
from ...images.image import Image
from .given import host_number, pixel_weights, plane_points, weighted_rms
from .refine import Subdivision
from .tin import Tin, fitted_heights, locate_pixels, surface_matrix


@dataclass(frozen=True)
class BoundedSurface:
    """What `bound_error` returns.

    Attributes:
        tin: nodes, triangles, heights.
        greatest: its largest error over the pixels under its triangles [unit of the image].
        rmse: root mean square error.
        holds: whether the bound does.
        n_splits: how often triangles were split.
        worst: (row, column) of the pixel of the largest error.
        outside: how many pixels with data lie under no triangle: of them nothing is bounded.
    """

    tin: Tin
    greatest: float
    rmse: float
    holds: bool
    n_splits: int
    worst: tuple[int, int]
    outside: int


def bound_error(image: Image, points: Numbers, triangles: Numbers, bound: Numbers, most: int | None = None) -> BoundedSurface:
    """Split triangles until no pixel under one is farther from the surface than a bound.

    Args:
        image: the data.
        points: (N, 2) or (N, 3) nodes to start from; x and y are read.
        triangles: (T, 3) node numbers.
        bound: the greatest error that is allowed [unit of the image].
        most: nodes at most; None: as many as pixels.

    Returns:
        `BoundedSurface`; where the bound cannot be held with so many nodes, the last surface that was tried, and `holds` False.

    Raises:
        ValueError: triangles that do not fit the points, a bound that is not positive.

    >>> y, x = np.mgrid[:30, :30]
    >>> found = bound_error(Image((x - 15.0) ** 2 + y), [(0, 0), (29, 0), (0, 29), (29, 29)], [(0, 1, 2), (2, 1, 3)], bound=5.0)
    >>> found.holds, found.greatest < 5, len(found.tin.points) < 100
    (True, True, True)
    """
    places = plane_points(points)
    corners = triangle_indices("triangles", triangles, len(places))
    limit = host_number("bound", bound, "No surface of triangles has no error at all.")
    base = mesh = Subdivision.of(corners, len(places))
    most, truth, n_splits = image.values.size if most is None else most, np.asarray(image.values, np.float64).ravel(), 0
    weights = pixel_weights(image)
    while True:
        now = mesh.carried(places, base)
        located = locate_pixels(image, now, mesh.triangles)
        matrix = surface_matrix(located, mesh.triangles, mesh.n_nodes)
        z = fitted_heights(matrix, truth, mesh.net, weights)
        error = np.where((located.triangle < 0) | (weights == 0), 0.0, np.abs(matrix @ z - truth))
        greatest = np.zeros(len(mesh.triangles))
        np.maximum.at(greatest, np.maximum(located.triangle, 0), error)
        finer = mesh.refined(greatest > limit) if error.max() > limit else mesh
        if finer is mesh or finer.n_nodes > most:
            worst = divmod(int(error.argmax()), image.shape[1])
            rmse = weighted_rms(error, weights * (located.triangle >= 0))
            tin = Tin(np.column_stack([now, z]), mesh.triangles)
            outside = int(((located.triangle < 0) & (weights > 0)).sum())
            return BoundedSurface(tin, float(error.max()), rmse, finer is mesh, n_splits, worst, outside)
        mesh, n_splits = finer, n_splits + 1


__all__ = ["BoundedSurface", "bound_error"]
