"""Which triangle holds each pixel, exactly, and the piecewise linear surface drawn on the pixels.

`locate` walks: from the triangle that held a pixel last time it crosses the edge that the pixel is farthest beyond, until the pixel is
inside. Between two iterations of a fit the mesh moves little, and a few steps serve all pixels together. The first time, `locate_uniform`
knows the answer in closed form. The number of steps is bounded, so a folded mesh ends the walk too; pixels that are then in no triangle
are counted.

On an edge either triangle will do, because the surface is continuous: a pixel counts as inside within the rounding of the areas compared.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ...images.image import Image
from .triangles import OUTSIDE, Flip, Node, corners, neighbours

# Rounding of an area, in epsilons of image side times cell side: within it of an edge, a pixel might else be beyond it for both triangles.
EDGE_ROUNDING = 4.0
# A walk crosses the mesh in about as many steps as it has cells along both sides; more means that it goes round in circles.
WALKS = 4


class PixelGrid(eqx.Module):
    """Where the pixels of an image are.

    Attributes:
        x: (P,) pixel positions along x, row by row [m].
        y: (P,) along y [m].
        shape: (ny, nx) of the image (static).
        weights: (P,) how much each pixel counts, 0 in a hole; None where all count alike.
    """

    x: Float[Array, " P"]
    y: Float[Array, " P"]
    shape: tuple[int, int] = eqx.field(static=True)
    weights: Float[Array, " P"] | None = None

    @staticmethod
    def of(image: Image) -> PixelGrid:
        """The grid of an image."""
        ny, nx = image.shape
        x = image.origin[0] + image.spacing[0] * jnp.arange(nx, dtype=image.dtype)
        y = image.origin[1] + image.spacing[1] * jnp.arange(ny, dtype=image.dtype)
        weights = None if image.weights is None else image.weights.reshape(-1)
        return PixelGrid(jnp.tile(x, ny), jnp.repeat(y, nx), (ny, nx), weights)

    @property
    def n_pixels(self) -> int:
        """Number of pixels P."""
        return self.shape[0] * self.shape[1]

    @property
    def total(self) -> Array | int:
        """Sum of the weights: the number of pixels where they have none."""
        return self.n_pixels if self.weights is None else jnp.sum(self.weights)

    def uniform_nodes(self, node_shape: tuple[int, int]) -> tuple[Node, Node]:
        """(x, y) of a regular lattice over the image, its border on the outermost pixels [m]."""
        ny, nx = node_shape
        x = jnp.linspace(self.x[0], self.x[-1], nx, dtype=self.x.dtype)
        y = jnp.linspace(self.y[0], self.y[-1], ny, dtype=self.y.dtype)
        return jnp.broadcast_to(x[None, :], node_shape), jnp.broadcast_to(y[:, None], node_shape)


class Location(eqx.Module):
    """Where the pixels are in a mesh.

    Attributes:
        triangle: (P,) triangle that holds each pixel.
        n_steps: steps that the walk took.
        n_lost: pixels that are in no triangle (0 unless the mesh is folded, or does not cover the image).
    """

    triangle: Int[Array, " P"]
    n_steps: Int[Array, ""]
    n_lost: Int[Array, ""]


def locate_uniform(grid: PixelGrid, cells: tuple[int, ...]) -> Int[Array, " P"]:
    """(P,) a triangle of the cell that holds each pixel, in the regular lattice of `PixelGrid.uniform_nodes` with (my, mx) `cells`."""
    row, column = (np.minimum(np.arange(p) * m // max(p - 1, 1), m - 1) for p, m in zip(grid.shape, cells, strict=True))
    return jnp.asarray((row[:, None] * cells[1] + column[None, :]).ravel(), jnp.int32)


def locate(x: Node, y: Node, flip: Flip, grid: PixelGrid, triangle: Int[Array, " P"]) -> Location:
    """Triangles that hold the pixels, walking from those in `triangle`. Not differentiated: where a derivative exists, it is constant."""
    x, y = lax.stop_gradient((x, y))
    vertices = [c.reshape(-1) for a in (x, y) for c in corners(a, flip)]
    area = (x[-1, -1] - x[0, 0]) * (y[-1, -1] - y[0, 0])
    return walk(vertices, neighbours(flip).reshape(-1), grid, triangle, area / math.sqrt(flip.size), WALKS * sum(x.shape))


def walk(vertices: list[Array], across: Int[Array, " T3"], grid: PixelGrid, triangle: Int[Array, " P"], area: Array, most: int) -> Location:
    """The walk through any triangles.

    Args:
        vertices: x of the corners a, b and c of each triangle, (T,) each, then y.
        across: (3 T,) the triangle across the side opposite to a, of all triangles, then to b, then to c.
        grid: the pixels.
        triangle: where each walk starts.
        area: of the whole mesh, over the square root of its number of cells: what areas are rounded by.
        most: steps at most.
    """
    n_triangles = vertices[0].shape[0]
    tolerance = -EDGE_ROUNDING * jnp.finfo(vertices[0].dtype).eps * area

    def step(walk: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        triangle, _, _, n = walk
        ax, bx, cx, ay, by, cy = (read(v, triangle) for v in vertices)
        ax, bx, cx = ax - grid.x, bx - grid.x, cx - grid.x
        ay, by, cy = ay - grid.y, by - grid.y, cy - grid.y
        # Twice the areas that the pixel spans with the edges bc, ca, ab; a negative one is beyond that edge.
        a, b, c = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        least = jnp.minimum(jnp.minimum(a, b), c)
        edge = jnp.where(least == a, 0, jnp.where(least == b, 1, 2))
        following = read(across, triangle + n_triangles * edge)
        beyond = least < tolerance
        moves = beyond & (following != OUTSIDE)
        return jnp.where(moves, following, triangle), jnp.any(moves), jnp.sum(beyond, dtype=jnp.int32), n + 1

    zero = jnp.zeros((), jnp.int32)
    start = (triangle, jnp.asarray(True), zero, zero)
    triangle, _, n_lost, n_steps = lax.while_loop(lambda walk: walk[1] & (walk[3] < most), step, start)
    return Location(triangle, n_steps, n_lost)


def read(table: Array, index: Array) -> Array:
    """`table[index]` for indices that are surely in range: saves JAX's own clamping and wrapping of each."""
    return table.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def draw(x: Node, y: Node, z: Node, flip: Flip, grid: PixelGrid, triangle: Int[Array, " P"]) -> Float[Array, "h w"]:
    """The piecewise linear surface through the nodes, at every pixel: the reconstructed image.

    z runs linearly over each triangle, by barycentric weights. Differentiable in x, y and z with the triangles held fixed.
    """
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = (tuple(read(c.reshape(-1), triangle) for c in corners(a, flip)) for a in (x, y, z))
    u, v, w = (
        (bx - grid.x) * (cy - grid.y) - (by - grid.y) * (cx - grid.x),
        (cx - grid.x) * (ay - grid.y) - (cy - grid.y) * (ax - grid.x),
        (ax - grid.x) * (by - grid.y) - (ay - grid.y) * (bx - grid.x),
    )
    area = u + v + w
    flat = area == 0
    value = (u * az + v * bz + w * cz) / jnp.where(flat, jnp.ones_like(area), area)
    return jnp.where(flat, az, value).reshape(grid.shape)
