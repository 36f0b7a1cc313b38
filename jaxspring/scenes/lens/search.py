"""The triangles of a lens mesh, the maps that they make, and the search for the triangle that holds a point.

Cells are cut by turns along one diagonal and the other (`turned`), which keeps the mesh as stiff along either. Inside a triangle both maps
are affine and exact inverses of each other,

    (x, y) = (x, y)_a + F [(u, v) - (u, v)_a]          (u, v) = (u, v)_a + F^-1 [(x, y) - (x, y)_a]          [pixels]

with (u, v) on the image, (x, y) where it is shown, and a one of its corners, which keeps the rounding that of a cell and not of the image.
Each triangle's eight numbers stand in one row of a table: a point reads a single row, and the derivative adds up rows.

The search jumps to where the current triangle's map would put the point, and after a few jumps walks: it crosses the edge that the point is
farthest beyond. Points are looked at together and the number of steps is bounded; which triangle holds a point has no derivative.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..reconstruction.raster import read
from ..reconstruction.triangles import Node, corners

JUMPS = 6
# A walk crosses the mesh in about as many steps as it has cells along both sides.
WALKS = 1
# Rounding of a place, in epsilons of the cells along a side: within it of an edge either triangle will do, the maps being continuous.
EDGE_ROUNDING = 4.0


def turned(cells: tuple[int, int]) -> Bool[np.ndarray, "my mx"]:
    """Which cells are cut along ne-sw: every other one, as on a board of chess."""
    row, column = np.indices(cells)
    return (row + column) % 2 == 1


class Affine(NamedTuple):
    """A map that is affine on each triangle: (u + b (x - a) + c (y - d), v + e (x - a) + f (y - d)).

    Attributes:
        rows: (T, 8) the numbers a, d, u, v, b, c, e, f of each triangle.
    """

    rows: Float[Array, "T 8"]

    @staticmethod
    def between(x: Node, y: Node, u: Node, v: Node) -> Affine:
        """The map from a mesh with nodes (x, y) to the one with nodes (u, v). NaN on triangles of (x, y) without area."""
        flip = jnp.asarray(turned((x.shape[0] - 1, x.shape[1] - 1)))
        (ax, bx, cx), (ay, by, cy), (au, bu, cu), (av, bv, cv) = (corners(a, flip) for a in (x, y, u, v))
        px, py, qx, qy = bx - ax, by - ay, cx - ax, cy - ay
        area = px * qy - py * qx
        ux, uy = ((bu - au) * qy - (cu - au) * py) / area, ((cu - au) * px - (bu - au) * qx) / area
        vx, vy = ((bv - av) * qy - (cv - av) * py) / area, ((cv - av) * px - (bv - av) * qx) / area
        eight = (ax, ay, au, av, ux, uy, vx, vy)
        # Behind a barrier: XLA would else make the table anew for every point that reads it.
        return Affine(lax.optimization_barrier(jnp.stack([a.reshape(-1) for a in eight], axis=-1)))

    def __call__(self, x: Array, y: Array, triangle: Int[Array, " P"]) -> tuple[Array, Array]:
        """Where the points (x, y) (P,) go, by the maps of these triangles."""
        a, d, u, v, b, c, e, f = jnp.unstack(read(self.rows, triangle), axis=-1)
        x, y = x - a, y - d
        return u + (b * x + c * y), v + (e * x + f * y)


def triangle_at(s: Array, t: Array, cells: tuple[int, int]) -> Int[Array, " P"]:
    """The triangle that holds points of the regular mesh, given in cells from its corner (column s, row t); outside, the nearest cell's."""
    column, row = _whole(s, cells[1]), _whole(t, cells[0])
    s, t = s - column.astype(s.dtype), t - row.astype(t.dtype)
    is_turned = (row + column) % 2 == 1
    is_lower = jnp.where(is_turned, s + t > 1, t > s)
    return is_lower.astype(jnp.int32) * (cells[0] * cells[1]) + row * cells[1] + column


class Found(NamedTuple):
    """Triangles (P,) that hold the points, how many steps it took to find them all, and how many were not found."""

    triangle: Int[Array, " P"]
    n_steps: Int[Array, ""]
    n_lost: Int[Array, ""]


def search(
    inverse: Affine, x: Array, y: Array, cells: tuple[int, int], size: tuple[Array, Array], start: Int[Array, " P"] | None = None
) -> Found:
    """Triangles that hold the points (x, y) (P,) of the shown mesh; `size` of a cell on the image along x and y [pixels].

    From the triangles `start`, or from where the points were on a mesh at rest.
    """
    inverse, x, y = lax.stop_gradient((inverse, x, y))
    most = JUMPS + WALKS * sum(cells)

    def goes_on(state: tuple[Array, Array, Array, Array]) -> Array:
        return ~jnp.all(state[2]) & (state[3] < most)

    def step(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        # Whether a point is inside is decided in one pass and acted on in the next: computed twice within one, for the choice and for
        # the count, it could be yes and no by rounding, and such a point would never move nor be found.
        last, following, is_inside, n = state
        triangle = jnp.where(is_inside, last, following)
        u, v = inverse(x, y, triangle)
        s, t = u / size[0], v / size[1]
        following, is_inside = _across(triangle, s, t, cells)
        # Who would walk back to where it came from stands on the edge between, as far as rounding can tell.
        is_inside |= (n > JUMPS) & (following == last)
        return triangle, jnp.where(n < JUMPS, triangle_at(s, t, cells), following), is_inside, n + 1

    start = triangle_at(x / size[0], y / size[1], cells) if start is None else start
    first = (start, start, jnp.zeros(start.shape, bool), jnp.zeros((), jnp.int32))
    triangle, _, is_inside, n = lax.while_loop(goes_on, step, first)
    return Found(triangle, n, jnp.sum(~is_inside, dtype=jnp.int32))


def _across(triangle: Array, s: Array, t: Array, cells: tuple[int, int]) -> tuple[Array, Array]:
    """The triangle across the edge that a point (s, t) is farthest beyond, and whether it is beyond none. The border is no edge."""
    n_cells = cells[0] * cells[1]
    is_lower, cell = triangle >= n_cells, triangle % n_cells
    row, column = cell // cells[1], cell % cells[1]
    s, t = s - column.astype(s.dtype), t - row.astype(t.dtype)
    is_turned = (row + column) % 2 == 1
    # How far the point is inside each of the three edges: along a row, along a column, along the diagonal.
    along_row = jnp.where(is_lower, 1 - t, t)
    is_east = is_turned == is_lower
    along_column = jnp.where(is_east, 1 - s, s)
    diagonal = jnp.where(is_turned, 1 - s - t, s - t)
    diagonal = jnp.where(is_lower, -diagonal, diagonal)
    new_row, new_column = row + jnp.where(is_lower, 1, -1), column + jnp.where(is_east, 1, -1)
    far = jnp.asarray(jnp.inf, s.dtype)
    along_row = jnp.where((new_row >= 0) & (new_row < cells[0]), along_row, far)
    along_column = jnp.where((new_column >= 0) & (new_column < cells[1]), along_column, far)
    least = jnp.minimum(jnp.minimum(along_row, along_column), diagonal)
    # A right neighbour shows its western half, which is the lower one unless it is turned; and it is turned where this cell is not.
    beside = cell + jnp.where(is_east, 1, -1) + jnp.where(is_turned == is_east, n_cells, 0)
    above = cell + jnp.where(is_lower, cells[1], n_cells - cells[1])
    partner = cell + jnp.where(is_lower, 0, n_cells)
    following = jnp.where(least == along_row, above, jnp.where(least == along_column, beside, partner))
    return following.astype(jnp.int32), least >= -EDGE_ROUNDING * float(jnp.finfo(s.dtype).eps) * max(cells)


def _whole(s: Array, n: int) -> Int[Array, " P"]:
    """The cell that a coordinate falls in, along one axis; NaN in the first."""
    inside = jnp.where(s > 0, jnp.minimum(s, n - 1), jnp.zeros_like(s))
    return lax.stop_gradient(inside).astype(jnp.int32)


__all__ = ["Affine", "Found", "search", "triangle_at", "turned"]
