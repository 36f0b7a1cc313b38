"""A closed mesh of triangles as an obstacle: its signed distance, sampled once on a grid, and read between the samples by a cubic spline.

    inside the grid    the spline through the samples: two continuous derivatives
    outside it         sqrt(o**2 + d**2), o: distance to the grid, d: sampled at its nearest place; no more than the true distance

Edges and corners are rounded over about one spacing: there the error is up to a fifth of it, and a fiftieth in the middle of faces; the
gradient is up to 1.3 long outside of an edge, and 1.4 inside where two faces are as near. Thin parts need several samples across.

Source: `mesh_distance.py` for the samples; the spline as in `images/sampling.py`.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._arrays import Numbers, given
from .._checks import as_inexact, finite, is_concrete, positive, triangle_indices
from ..forces.base import any_not_positive
from ..images.sampling import CubicSpline
from ..images.surface import _along
from ..vector import Vector
from .base import Obstacle, any_not_finite, check_dim, length
from .mesh_distance import grid_distance

# The grid reaches this many spacings beyond the mesh: the spline of the surface's own cells then knows both sides.
MARGIN = 3
# So many samples more take part in finding the spline; what its end does falls to a quarter with each.
BEYOND = 10
# Samples beyond which a grid is refused: 128 MiB in float64.
MOST_SAMPLES = 2**24


class MeshField(Obstacle):
    """The inside of a closed mesh of triangles, in space.

    The mesh is read once, on the host: the distance has no derivative by its vertices, only by place; put the mesh into a `Moving`
    obstacle to move it.

    Attributes:
        coefficients: of the spline, one for each sample and one more at each side [m].
        origin: (3,) place of the first sample [m].
        spacing: between samples [m].

    Raises:
        ValueError: a mesh that is not closed or whose triangles do not turn the same way about their normals, with the edge; triangles
            without area; vertices that are not (V, 3) or not finite; a spacing that is not positive, or asks for too large a grid.
        TypeError: traced vertices.
    """

    coefficients: Array
    origin: Array
    spacing: Array

    def __init__(self, vertices: Numbers, faces: Numbers, spacing: Numbers):
        """Sample the distance.

        Args:
            vertices: (V, 3) [m].
            faces: (F, 3) corners of each triangle, by the numbers of its vertices; all turn the same way, outward or inward.
            spacing: [m] between samples; a tenth of the mesh's size is coarse, a hundredth fine.
        """
        points, triangles = _checked(vertices, faces)
        self.spacing = as_inexact("spacing", spacing)
        if not is_concrete(self.spacing) or self.spacing.ndim:
            raise ValueError("spacing must be one number that is known when the obstacle is built: it decides on the size of the grid.")
        positive("spacing", self.spacing, "There would be no grid.")
        step = float(self.spacing)
        low, high = points.min(axis=0) - MARGIN * step, points.max(axis=0) + MARGIN * step
        counts = np.ceil((high - low) / step).astype(np.int64) + 1
        if np.prod(counts.astype(float)) > MOST_SAMPLES:
            raise ValueError(
                f"spacing = {step} m asks for {' x '.join(map(str, counts))} samples of the distance, more than {MOST_SAMPLES}. Pass "
                f"a larger spacing, e.g. {float(np.max(high - low)) / 100:.3g}."
            )
        samples = grid_distance(points, triangles, (*(a + step * np.arange(n) for a, n in zip(low, counts, strict=True)),))
        dtype = self.spacing.dtype
        self.origin = jnp.asarray(low, dtype)
        self.coefficients = jnp.asarray(_spline(samples), dtype)

    def distance(self, position: Vector, time: Array) -> Array:
        """Spline through the samples; beyond the grid a lower bound of the distance [m]."""
        spline = CubicSpline()
        steps = self.spacing.astype(position.dtype)
        counts = [n - 2 for n in self.coefficients.shape]
        along = [_along(a, self.origin[i], steps, counts[i]) for i, a in enumerate(position)]
        _, ny, nz = self.coefficients.shape
        corner = (along[0].cell * ny + along[1].cell) * nz + along[2].cell
        block = (np.arange(4)[:, None, None] * ny + np.arange(4)[:, None]) * nz + np.arange(4)
        index = corner[None, None, None] + block.reshape(4, 4, 4, *(1,) * corner.ndim).astype(np.int32)
        # The cell is in range, whatever the place: see `_along`.
        value = self.coefficients.reshape(-1).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False).astype(position.dtype)
        for one in along:
            weights = jnp.stack(spline.weights(one.fraction))
            value = jnp.sum(weights.reshape(4, *(1,) * (value.ndim - weights.ndim), *weights.shape[1:]) * value, axis=0)
        beyond = Vector(tuple(self._beyond(a, i, counts[i]) for i, a in enumerate(position)))
        is_outside = beyond.dot(beyond) > 0
        far = length(Vector((*beyond, value)))
        return jnp.where(is_outside, far, value)

    def _beyond(self, coordinate: Array, axis: int, n: int) -> Array:
        """How far a coordinate is outside of the grid [m]."""
        low = self.origin[axis].astype(coordinate.dtype)
        high = low + (n - 1) * self.spacing.astype(coordinate.dtype)
        return jnp.where(coordinate < low, coordinate - low, jnp.where(coordinate > high, coordinate - high, jnp.zeros_like(coordinate)))

    def check(self, dim: int) -> None:
        """Raise ValueError where the space has not three coordinates."""
        check_dim("mesh", 3, dim)

    def invalid(self) -> Array:
        """Whether a sample is not finite, or the spacing not positive."""
        return any_not_finite(self.coefficients, self.origin) | any_not_positive(self.spacing)


def _checked(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """The mesh in NumPy, its triangles turning about the outward normal."""
    points = given("vertices", vertices)
    if isinstance(points, Tracer):
        raise TypeError("vertices is traced (made inside jit, grad or vmap), but a mesh is sampled on the host. Build it outside.")
    finite("vertices", as_inexact("vertices", points))
    # In float64, whatever the library's type is: distances are differences of large coordinates.
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise ValueError(f"vertices has shape {points.shape}; expected (V, 3), three coordinates for each vertex.")
    triangles = triangle_indices("faces", faces, len(points))
    _check_closed(triangles)
    corners = points[triangles]
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    longest = np.max(np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2), axis=1)
    flat = double_area <= 1e-12 * longest**2
    if flat.any():
        raise ValueError(f"faces[{int(np.argmax(flat))}] has no area, so no normal. Remove it, or move a corner.")
    volume = np.einsum("fd,fd->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return points, triangles if volume > 0 else triangles[:, ::-1]


def _check_closed(triangles: np.ndarray) -> None:
    """Raise ValueError unless each edge is passed once in either direction."""
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2).astype(np.int64)
    n = int(triangles.max()) + 1
    there, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    values, counts = np.unique(there, return_counts=True)
    twice = np.isin(there, values[counts > 1])
    lonely = ~np.isin(back, there)
    if not (twice | lonely).any():
        return
    i = int(np.argmax(twice | lonely))
    edge, face = tuple(edges[i].tolist()), i // 3
    if twice[i]:
        raise ValueError(
            f"faces[{face}] and another triangle both run along the edge {edge} in this direction: the mesh has no one inside. Turn "
            f"triangles so that neighbours run along a common edge in opposite directions, and leave out sheets that meet at an edge."
        )
    raise ValueError(
        f"the mesh is not closed: no other triangle meets faces[{face}] at the edge {edge} ({int(lonely.sum())} such edges). An open mesh "
        f"has no inside. Fill its holes; where corners at one place have several numbers, as in STL files, make them one."
    )


def _spline(samples: np.ndarray) -> np.ndarray:
    """Coefficients of the cubic spline through the samples, with one more at each side. Beyond the outermost they go on along their slope:
    a spline that ends level would swing about a distance, which does not.
    """
    from scipy.ndimage import spline_filter

    wide = np.pad(samples, BEYOND, mode="reflect", reflect_type="odd")
    inner = slice(BEYOND - 1, 1 - BEYOND)
    return spline_filter(wide, order=3, output=np.float64, mode="mirror")[inner, inner, inner]


__all__ = ["MeshField"]
