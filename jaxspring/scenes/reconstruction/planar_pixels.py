"""One data spring per pixel on any triangles in the plane: what `pixels` is on a lattice.

Inside a triangle the surface is a plane, so its squared error over the pixels is a quadratic in three numbers, and its coefficients are ten
sums over the pixels. They depend on the places of the nodes only through which triangle holds a pixel. See `pixels`.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ...linalg.cg import JaxCG
from ...topology.graph import Graph
from ...vector import Vector
from .pixels import MIDDLE, PlaneOf, barycentric_planes
from .raster import PixelGrid, read


class PixelSums(eqx.Module):
    """Sums over the pixels in each triangle, of powers of their place p from its centroid and their value d - 1/2.

    Attributes:
        sums: (T, 10) of n, px, py, px^2, px py, py^2, d, d px, d py, d^2.
        origin: (T, 2) centroids [m].
    """

    sums: Float[Array, "T 10"]
    origin: Float[Array, "T 2"]

    @staticmethod
    def of(
        values: Array, inside: Array, grid: PixelGrid, triangle: Int[Array, " P"], points: Array, corners: Int[Array, "T 3"]
    ) -> PixelSums:
        """Of the pixels `values` (P,) that are `inside` (P,), 1 or 0, held by `triangle`, in triangles of `points` (N, 2)."""
        origin = jnp.mean(points[corners], axis=1)
        px, py = grid.x - read(origin[:, 0], triangle), grid.y - read(origin[:, 1], triangle)
        d = values - MIDDLE
        features = (jnp.ones_like(d), px, py, px * px, px * py, py * py, d, d * px, d * py, d * d)
        table = jnp.zeros((len(corners), len(features)), d.dtype)
        rows = inside[:, None] * jnp.stack(features, axis=-1)
        return PixelSums(table.at[triangle].add(rows, mode="promise_in_bounds", wrap_negative_indices=False), origin)

    def barycentric(self, points: Array, corners: Array) -> tuple[PlaneOf, PlaneOf, PlaneOf]:
        """Each corner's weight as a plane (constant, slope in px, slope in py) over its triangle."""
        a, b, c = (points[corners[:, i]] - self.origin for i in range(3))
        return barycentric_planes((a[:, 0], a[:, 1]), (b[:, 0], b[:, 1]), (c[:, 0], c[:, 1]))

    def squared_error(self, points: Array, z: Array, corners: Array) -> Array:
        """(T,) sum over each triangle's pixels of (z - d)^2; differentiable in the places and the heights (N,)."""
        n, sx, sy, sxx, sxy, syy, d, dx, dy, dd = self.sums.T
        weights, heights = self.barycentric(points, corners), [z[corners[:, i]] - MIDDLE for i in range(3)]
        a, b, c = (sum((w[j] * h for w, h in zip(weights, heights, strict=True)), start=jnp.zeros_like(n)) for j in range(3))
        error = a * a * n + b * b * sxx + c * c * syy + 2 * (a * b * sx + a * c * sy + b * c * sxy - a * d - b * dx - c * dy) + dd
        return jnp.where(n > 0, error, jnp.zeros_like(error))


class PlanarHeights(eqx.Module):
    """(N + r L) z = b of the pixels' springs, in balance with springs along z.

    Attributes:
        blocks: (T, 3, 3) of each triangle [pixels].
        right_side: (N,) b, measured from 1/2.
        corners: (T, 3) nodes.
        net: whose springs carry L.
    """

    blocks: Array
    right_side: Array
    corners: Array
    net: Graph

    def __init__(self, sums: PixelSums, points: Array, corners: Array, net: Graph):
        n, sx, sy, sxx, sxy, syy, d, dx, dy, _ = sums.sums.T
        moments = jnp.stack([jnp.stack([n, sx, sy], -1), jnp.stack([sx, sxx, sxy], -1), jnp.stack([sy, sxy, syy], -1)], axis=-2)
        weights = jnp.stack([jnp.stack(plane, -1) for plane in sums.barycentric(points, corners)], axis=-2)
        self.blocks = jnp.einsum("tia,tab,tjb->tij", weights, moments, weights)
        right = jnp.einsum("tia,ta->ti", weights, jnp.stack([d, dx, dy], -1))
        self.right_side = jnp.zeros(net.n_nodes, points.dtype).at[corners].add(right)
        self.corners, self.net = corners, net

    def membrane_energy(self, z: Array) -> Array:
        """z'L z, the sum over springs of (z_i - z_j)^2."""
        return self.net.sum(self.net.difference(Vector((self.net.layout.unflatten(z),))).map(lambda d: d[0] * d[0]))

    def best(self, ratio: Array, guess: Array, solver: JaxCG) -> Array:
        """(N,) heights in balance. Not for derivatives: they minimise the error."""
        net = self.net
        diagonal = jnp.zeros_like(self.right_side).at[self.corners].add(jnp.diagonal(self.blocks, axis1=1, axis2=2))
        degree = net.layout.flatten(net.incident_sum(net.split(jnp.ones(net.n_springs, guess.dtype))))
        inverse = 1 / (diagonal + ratio * degree)

        def product(z: Array) -> Array:
            local = jnp.einsum("tij,tj->ti", self.blocks, z[self.corners])
            springs = net.accumulate(net.difference(Vector((net.layout.unflatten(z),))))[0]
            return jnp.zeros_like(z).at[self.corners].add(local) - ratio * net.layout.flatten(springs)

        z, _ = solver.solve(product, self.right_side, lambda residual: inverse * residual, guess - MIDDLE)
        return lax.stop_gradient(z + MIDDLE)


__all__ = ["PixelSums", "PlanarHeights"]
