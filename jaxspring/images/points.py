"""Scattered points: positions, heights, weights; counted where they are of no use, and averaged into an image where one is wanted.

Map coordinates reach millions of metres, of which float32 leaves half a metre. So positions are kept from the corner of the points' box,
which itself stays in double precision.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers, on_host, own
from .image import Image

# Points that one pixel holds on average where nobody says how many pixels there are to be.
PER_PIXEL = 2
# Points whose box is narrower than this share of its length lie on a line.
LEAST_WIDTH = 1e-9


class PointCloud(eqx.Module):
    """Points (x, y, z), each with a weight.

    Args:
        points: (P, 3) [m], on the host: they decide on shapes.
        weights: (P,) how much each counts, above zero, for instance one over the variance of its noise; None where all count alike.
        skip_nan: leave out points with a NaN, and count them; else they are an error, as infinity always is.

    Attributes:
        x, y: (P,) positions from `corner` [m].
        z: (P,) heights [m].
        weights: (P,), or None.
        corner: the smallest x and y of all [m], in double precision (static).
        n_skipped: points that were left out for a NaN (static).
        n_repeated: points at exactly the place (x, y) of an earlier one; each of them counts (static).

    Raises:
        ValueError: no points, a wrong shape, a coordinate that is not finite, a weight that is not above zero, points on one line.
        TypeError: traced points.

    >>> cloud = PointCloud([[5e6, 5e6, 1.0], [5e6 + 0.5, 5e6, 2.0], [5e6, 5e6 + 1, 3.0]])
    >>> print(cloud.x, cloud.corner)
    [0.  0.5 0. ] (5000000.0, 5000000.0)
    """

    x: Array
    y: Array
    z: Array
    weights: Array | None
    corner: tuple[float, float] = eqx.field(static=True)
    n_skipped: int = eqx.field(static=True)
    n_repeated: int = eqx.field(static=True)

    def __init__(self, points: Numbers, weights: Numbers | None = None, skip_nan: bool = False):
        table, weight = _checked(on_host("points", points), None if weights is None else on_host("weights", weights))
        is_kept = ~np.isnan(table).any(axis=1) if skip_nan else np.ones(len(table), bool)
        self.n_skipped = int((~is_kept).sum())
        table, weight = table[is_kept], None if weight is None else weight[is_kept]
        _check_spread(table, self.n_skipped)
        corner = table[:, :2].min(axis=0)
        dtype = jnp.result_type(float)
        self.x, self.y = (own("points", table[:, i] - corner[i], dtype) for i in range(2))
        self.z = own("points", table[:, 2], dtype)
        self.weights = None if weight is None else own("weights", weight, dtype)
        self.corner = float(corner[0]), float(corner[1])
        self.n_repeated = len(table) - len(np.unique(table[:, :2], axis=0))

    @property
    def n_points(self) -> int:
        """Number of points P that are used."""
        return self.x.shape[0]

    def with_heights(self, z: Array) -> PointCloud:
        """The same points at other heights (P,) [m], not checked; may be traced."""
        return eqx.tree_at(lambda cloud: cloud.z, self, own("z", z, self.z.dtype))

    def box(self, outline: tuple[float, float, float, float] | None = None) -> tuple[float, float, float, float]:
        """(x0, y0, x1, y1) from `corner` [m], of an outline in the coordinates of the points; without one, of the points' own box.

        Raises:
            ValueError: an outline without area.
        """
        if outline is None:
            return 0.0, 0.0, float(jnp.max(self.x)), float(jnp.max(self.y))
        x0, y0, x1, y1 = outline
        if not (x1 > x0 and y1 > y0):
            raise ValueError(f"outline = {outline}; expected (x0, y0, x1, y1) with x1 > x0 and y1 > y0.")
        return x0 - self.corner[0], y0 - self.corner[1], x1 - self.corner[0], y1 - self.corner[1]

    def image(
        self,
        shape: tuple[int, int] | None = None,
        outline: tuple[float, float, float, float] | None = None,
        median: bool = False,
    ) -> Image:
        """The points averaged into pixels: weighted means, with the sum of weights as the pixel's; a pixel without a point is a hole.

        Args:
            shape: (ny, nx) pixels; without it square ones that hold two points on average.
            outline: (x0, y0, x1, y1) of the outermost pixels' centres, in the coordinates of the points [m]; their box unless given.
            median: take the middle height in each pixel, which outliers do not move; weights still add up.

        Returns:
            The image, its origin and spacing in metres from `corner`.

        Raises:
            ValueError: fewer than 2 x 2 pixels; an outline without area, or without a point in it.
        """
        box = self.box(outline)
        width, height = box[2] - box[0], box[3] - box[1]
        if shape is None:
            x, y = np.asarray(self.x, np.float64), np.asarray(self.y, np.float64)
            n_within = max(1, int(((x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])).sum()))
            side = np.sqrt(PER_PIXEL * width * height / n_within)
            shape = max(2, round(height / side) + 1), max(2, round(width / side) + 1)
        if len(shape) != 2 or min(shape) < 2:
            raise ValueError(f"shape = {shape}; an image of points has at least 2 x 2 pixels (ny, nx).")
        spacing = width / (shape[1] - 1), height / (shape[0] - 1)
        x, y, z = (np.asarray(a, np.float64) for a in (self.x, self.y, self.z))
        column, row = np.rint((x - box[0]) / spacing[0]).astype(int), np.rint((y - box[1]) / spacing[1]).astype(int)
        is_in = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
        if not is_in.any():
            raise ValueError(f"outline = {outline} holds none of the {self.n_points} points. Give it in their coordinates.")
        cell, z = (row * shape[1] + column)[is_in], z[is_in]
        weights = np.ones(len(z)) if self.weights is None else np.asarray(self.weights, np.float64)[is_in]
        n = shape[0] * shape[1]
        total = np.bincount(cell, weights, n)
        middle = _medians(cell, z, n) if median else np.bincount(cell, weights * z, n) / np.where(total > 0, total, 1)
        dtype = self.z.dtype
        return Image(middle.reshape(shape).astype(dtype), spacing, box[:2], total.reshape(shape).astype(dtype))


def _medians(cell: np.ndarray, z: np.ndarray, n: int) -> np.ndarray:
    """The middle z of each cell, of an even number the lower one; zero in an empty cell."""
    order = np.lexsort((z, cell))
    first, count = np.unique(cell[order], return_index=True, return_counts=True)[1:]
    found = np.zeros(n)
    found[cell[order][first]] = z[order][first + (count - 1) // 2]
    return found


def _checked(table: np.ndarray, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    if table.ndim != 2 or table.shape[1] != 3:
        raise ValueError(f"points has shape {table.shape}; expected (P, 3): x, y and z of each point.")
    if not len(table):
        raise ValueError("points is empty: without a point there is no surface.")
    if weights is not None:
        if weights.shape != table.shape[:1]:
            raise ValueError(f"weights has shape {weights.shape}; expected ({len(table)},), one per point.")
        bad = ~(np.isfinite(weights) & (weights > 0))
        if bad.any():
            i = int(np.argmax(bad))
            raise ValueError(f"weights[{i}] = {weights[i]}, but must be above zero and finite ({int(bad.sum())} are not). Leave such out.")
    return table, weights


def _check_spread(table: np.ndarray, n_skipped: int) -> None:
    """Raise ValueError where a point is not finite, where none is left, or where all lie on one line."""
    bad: Any = ~np.isfinite(table)
    if bad.any():
        point, axis = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"points[{point}] has {'xyz'[axis]} = {table[point, axis]} ({int(bad.any(axis=1).sum())} of {len(table)} are not finite). "
            "Leave them out, or pass skip_nan=True to skip those with a NaN and have them counted."
        )
    if not len(table):
        raise ValueError(f"all {n_skipped} points hold a NaN: none is left.")
    centred = table[:, :2] - table[:, :2].mean(axis=0)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    if spread[0] <= LEAST_WIDTH**2 * spread[1] or spread[1] == 0:
        raise ValueError(f"the {len(table)} points lie in one place or on one line in the plane: they span no surface. Add some beside it.")
