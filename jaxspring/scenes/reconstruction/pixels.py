"""One data spring per pixel, acting through the barycentric weights of the triangle that holds it.

Inside a triangle the surface is a plane, z = alpha + beta px + gamma py, with p measured from a local origin. The squared error over its
pixels is then a quadratic in (alpha, beta, gamma) whose coefficients are ten sums over the pixels: their moments.

    sum (z(p) - d)^2 = n alpha^2 + 2 alpha beta Sx + ... - 2 alpha D - 2 beta Dx - 2 gamma Dy + DD

So the pixels are read once per mesh, not once per derivative, and the loss over 3,200 triangles is exact. Moments do not depend on the
node positions where no pixel changes its triangle: there the loss is differentiable, and everywhere it is continuous.

The pixels' springs pull the nodes with f = k (b - N z), N = sum w w' and b = sum w d over all pixels (w: the three weights of a pixel).
Beside springs of stiffness k_z along z, whose Laplacian is L, the mesh comes to rest at

    (N + r L) z = b,    r = k_z / k                                                                               [pixels]

which for small r is the best z that this mesh can have: the least-squares spline. A little of r decides nodes that no pixel holds.

Where pixels have weights, each sum takes every pixel times its weight: its spring is so much stiffer. A hole has weight zero.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ..._checks import constant
from ...forces.base import Force
from ...linalg.cg import JaxCG, SolveInfo
from ...state import State
from ...topology.lattice import Lattice
from ...vector import Vector
from .raster import PixelGrid, read
from .triangles import Corners, Flip, Node, at_nodes, corners

PerTriangle = Float[Array, "2 my mx"]
PlaneOf = tuple[PerTriangle, PerTriangle, PerTriangle]  # constant, slope in px, slope in py
# Grey levels are taken from the middle of their range [0, 1], which saves a digit in the sums.
MIDDLE = 0.5


class Moments(eqx.Module):
    """Sums over the pixels in each triangle, of powers of their position p from the triangle's origin and their value d - MIDDLE, times w.

    Attributes:
        sums: n, px, py, px^2, px py, py^2, d, d px, d py, d^2.
        origin: (x, y) of each triangle's local origin [m].
    """

    sums: tuple[PerTriangle, ...]
    origin: tuple[PerTriangle, PerTriangle]

    @staticmethod
    def of(values: Float[Array, " P"], grid: PixelGrid, triangle: Int[Array, " P"], x: Node, y: Node, flip: Flip) -> Moments:
        """Moments of the pixels `values` held by `triangle`, by the weights of the grid, about the centroids of the triangles."""
        shape = (2, *flip.shape)
        ox, oy = _centre(corners(x, flip)), _centre(corners(y, flip))
        px, py = grid.x - read(ox.reshape(-1), triangle), grid.y - read(oy.reshape(-1), triangle)
        d = values - MIDDLE
        features = (jnp.ones_like(d), px, py, px * px, px * py, py * py, d, d * px, d * py, d * d)
        if grid.weights is not None:
            features = tuple(grid.weights * feature for feature in features)
        # One scatter of rows is a little faster than ten, and than any sort.
        table = (
            jnp.zeros((ox.size, len(features)), d.dtype)
            .at[triangle]
            .add(jnp.stack(features, axis=-1), mode="promise_in_bounds", wrap_negative_indices=False)
        )
        return Moments(tuple(column.reshape(shape) for column in table.T), (ox, oy))

    @property
    def count(self) -> PerTriangle:
        """Weight of the pixels in each triangle: their number where they have none."""
        return self.sums[0]

    def squared_error(self, x: Node, y: Node, z: Node, flip: Flip) -> PerTriangle:
        """Sum over each triangle's pixels of (z - d)^2 [image unit^2]."""
        n, sx, sy, sxx, sxy, syy, d, dx, dy, dd = self.sums
        a, b, c = self._plane(x, y, z, flip)
        error = a * a * n + b * b * sxx + c * c * syy + 2 * (a * b * sx + a * c * sy + b * c * sxy - a * d - b * dx - c * dy) + dd
        # A triangle that lost its area and holds no pixel has no say, whatever its plane.
        return jnp.where(n > 0, error, jnp.zeros_like(error))

    def normal_equations(self, x: Node, y: Node, flip: Flip) -> NormalEquations:
        """N and b of the pixels' springs, per triangle."""
        n, sx, sy, sxx, sxy, syy, d, dx, dy, _ = self.sums
        weights = self._barycentric(x, y, flip)

        def product(p: tuple[Array, Array, Array], q: tuple[Array, Array, Array]) -> Array:
            linear = (p[0] * q[1] + p[1] * q[0]) * sx + (p[0] * q[2] + p[2] * q[0]) * sy
            return p[0] * q[0] * n + linear + p[1] * q[1] * sxx + (p[1] * q[2] + p[2] * q[1]) * sxy + p[2] * q[2] * syy

        u, v, w = weights
        matrix = (product(u, u), product(v, v), product(w, w), product(v, w), product(w, u), product(u, v))
        a, b, c = (p[0] * d + p[1] * dx + p[2] * dy for p in weights)
        return NormalEquations(matrix, at_nodes((a, b, c), flip), flip)

    def _local(self, a: Node, origin: PerTriangle, flip: Flip) -> Corners:
        p, q, r = corners(a, flip)
        return p - origin, q - origin, r - origin

    def _barycentric(self, x: Node, y: Node, flip: Flip) -> tuple[PlaneOf, PlaneOf, PlaneOf]:
        """Each weight as a plane (constant, slope in px, slope in py) over its triangle."""
        (ax, bx, cx), (ay, by, cy) = self._local(x, self.origin[0], flip), self._local(y, self.origin[1], flip)
        return barycentric_planes((ax, ay), (bx, by), (cx, cy))

    def _plane(self, x: Node, y: Node, z: Node, flip: Flip) -> tuple[Array, Array, Array]:
        p, q, r = (c - MIDDLE for c in corners(z, flip))
        u, v, w = self._barycentric(x, y, flip)
        return u[0] * p + v[0] * q + w[0] * r, u[1] * p + v[1] * q + w[1] * r, u[2] * p + v[2] * q + w[2] * r


def barycentric_planes(a: tuple[Array, Array], b: tuple[Array, Array], c: tuple[Array, Array]) -> tuple[PlaneOf, PlaneOf, PlaneOf]:
    """The weights of the corners (x, y) of any triangles, each as a plane; a triangle without area counts as one of twice that area 1."""
    (ax, ay), (bx, by), (cx, cy) = a, b, c
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    inverse = 1 / jnp.where(area == 0, jnp.ones_like(area), area)
    return (
        ((bx * cy - by * cx) * inverse, (by - cy) * inverse, (cx - bx) * inverse),
        ((cx * ay - cy * ax) * inverse, (cy - ay) * inverse, (ax - cx) * inverse),
        ((ax * by - ay * bx) * inverse, (ay - by) * inverse, (bx - ax) * inverse),
    )


class NormalEquations(eqx.Module):
    """N z = b of the pixels' springs, with z and b measured from MIDDLE.

    Attributes:
        matrix: entries aa, bb, cc, bc, ca, ab of each triangle's 3 x 3 matrix [pixels].
        right_side: b in node shape [image unit times pixels].
        flip: the cells' diagonals.
    """

    matrix: tuple[PerTriangle, PerTriangle, PerTriangle, PerTriangle, PerTriangle, PerTriangle]
    right_side: Node
    flip: Flip

    def apply(self, z: Node) -> Node:
        """N z."""
        aa, bb, cc, bc, ca, ab = self.matrix
        a, b, c = corners(z, self.flip)
        return at_nodes((aa * a + ab * b + ca * c, ab * a + bb * b + bc * c, ca * a + bc * b + cc * c), self.flip)

    def diagonal(self) -> Node:
        """Diagonal of N."""
        aa, bb, cc, *_ = self.matrix
        return at_nodes((aa, bb, cc), self.flip)


class PixelSprings(Force):
    """The pixels' springs as a force along z, on a mesh whose x and y stay where `equations` were made.

    Attributes:
        equations: N and b.
        stiffness: k of one pixel's spring [N/m].
    """

    equations: NormalEquations
    stiffness: Array

    def __init__(self, equations: NormalEquations, stiffness: Array | float):
        self.equations = equations
        self.stiffness = constant("stiffness", stiffness, "A negative data spring pushes away from the image.", may_be_zero=True)

    def force(self, state: State) -> Vector:
        """k (b - N z) along the last coordinate [N], zero along the others."""
        *plane, z = state.position
        pull = self.stiffness.astype(z.dtype) * (self.equations.right_side - self.equations.apply(z - MIDDLE))
        return Vector((*(jnp.zeros_like(a) for a in plane), pull))

    def stiffness_bound(self, state: State) -> Array:
        """Row sums of k N: all its entries are weights, none negative [N/m]."""
        ones = jnp.ones_like(state.position[-1])
        return self.stiffness.astype(state.dtype) * self.equations.apply(ones)


def best_height(
    equations: NormalEquations,
    net: Lattice,
    ratio: Array,
    guess: Node,
    solver: JaxCG = JaxCG(),  # noqa: B008 (frozen, holds no array)
) -> tuple[Node, SolveInfo]:
    """Height at which the pixels' springs and the mesh's springs along z balance: (N + r L) z = b. Its derivative is implicit.

    Args:
        equations: N and b.
        net: the mesh; its springs carry L.
        ratio: r = k_z / k [pixels], a number.
        guess: where the solver starts, for instance the last height.
        solver: conjugate gradients, preconditioned by the diagonal.
    """
    inverse = lax.stop_gradient(1 / (equations.diagonal() + ratio * _degree(net, guess.dtype)))

    def matvec(z: Node) -> Node:
        return equations.apply(z) - ratio * net.accumulate(net.difference(Vector((z,))))[0]

    z, info = solver.solve(matvec, equations.right_side, lambda residual: inverse * residual, guess - MIDDLE)
    return z + MIDDLE, info


def membrane_energy(net: Lattice, z: Node) -> Array:
    """The sum over springs of (z_i - z_j)^2, which is z'L z."""
    return net.sum(net.difference(Vector((z,))).map(lambda d: d[0] * d[0]))


def _centre(points: Corners) -> PerTriangle:
    """Centroids, as constants: the error does not depend on where it is measured from."""
    a, b, c = points
    return lax.stop_gradient((a + b + c) / 3)


def _degree(net: Lattice, dtype: jnp.dtype) -> Node:
    """Number of springs at each node: the diagonal of L."""
    return net.incident_sum(net.split(jnp.ones(net.n_springs, dtype)))
