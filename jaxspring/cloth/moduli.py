"""What springs and hinges make of a flat sheet: its stiffness to strain and to curvature, by the energy of each in homogeneous ones.

    strain       (e11, e22, g)    g the angle of shear          W = e' C e / 2    C = sum over springs of k l^2 m m' / area
    curvature    (c11, c22, 2 c12)                              W = c' D c / 2    D = sum over hinges of k t t' / area
    along n      C(n) = s' C s,  D(n) = s' D s                  m = (n1^2, n2^2, n1 n2),  s = (n1^2, n2^2, 2 n1 n2)

m is how a spring along n stretches with the strain, s the strain that stretches along n alone; t is by how much a hinge turns in each
curvature: the jump of the slope of the heights of its four nodes on x^2 / 2, y^2 / 2, x y / 2. C is that of the whole sheet, border and
all. D is that of the triangles that have a neighbour at each side, since a free border does not bend.

Source: the affine energy of a spring lattice, e.g. Ostoja-Starzewski (2002), "Lattice models in micromechanics".
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array

from .._checks import as_inexact
from ..topology.mesh_checks import runs


class Moduli(eqx.Module):
    """Stiffness of a sheet, as it is realised.

    Attributes:
        membrane: C (3, 3) [N/m].
        bending: D (3, 3) [N m].
        density: mean areal density [kg/m^2].
    """

    membrane: Array
    bending: Array
    density: Array

    def stretch_along(self, angle: ArrayLike) -> Array:
        """C(n) [N/m] where n is at this angle from x [rad], of any shape: load over extension, the other direction held."""
        return _along(self.membrane, angle)

    def bending_along(self, angle: ArrayLike) -> Array:
        """D(n) [N m]: moment over curvature of a cylinder whose axis is across n."""
        return _along(self.bending, angle)

    def stretch_anisotropy(self) -> Array:
        """Largest over smallest C(n) of all directions: 1 where stretch has none."""
        return _spread(self.stretch_along(_every(self.membrane)))

    def bending_anisotropy(self) -> Array:
        """Largest over smallest D(n) of all directions."""
        return _spread(self.bending_along(_every(self.bending)))


def matrix(stiffness: Array, rows: np.ndarray) -> Array:
    """C or D of springs or hinges of these stiffnesses, by what each does in the three strains: the sum of k r r'."""
    r = jnp.asarray(rows, stiffness.dtype)
    return jnp.einsum("e,ei,ej->ij", stiffness, r, r)


def stretches(points: np.ndarray, edges: np.ndarray, area: float) -> np.ndarray:
    """(E, 3) l m / sqrt(area) of springs between places in the plane."""
    d = points[edges[:, 1]] - points[edges[:, 0]]
    m = np.stack([d[:, 0] ** 2, d[:, 1] ** 2, d[:, 0] * d[:, 1]], axis=-1)
    return m / np.sqrt(np.einsum("ed,ed->e", d, d) * area)[:, None]


def turns(points: np.ndarray, hinges: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(H, 3) t / sqrt(area) of hinges of four nodes, the edge from a to b and both opposite corners, over the inner triangles.

    Raises:
        ValueError: no triangle has a neighbour at each side.
    """
    x, y = points.T
    turned = sum(_slope(points, hinges[:, [0, 1, k]], np.stack([x * x, y * y, x * y], axis=-1) / 2) for k in (2, 3))
    sides = np.sort(runs(triangles), axis=1)
    known = {tuple(pair): i for i, pair in enumerate(np.sort(hinges[:, :2], axis=1).tolist())}
    hinge = np.array([known.get(tuple(pair), -1) for pair in sides.tolist()]).reshape(3, -1)
    inner = (hinge >= 0).all(axis=0)
    if not inner.any():
        raise ValueError("no triangle has a neighbour at each side, so that the mesh is too coarse to bend. Pass a smaller spacing.")
    area = np.abs(twice_areas(points, triangles[inner])).sum() / 2
    # A hinge belongs to its two triangles in halves.
    weight = np.bincount(hinge[:, inner].ravel(), minlength=len(hinges)) / (2 * area)
    return turned * np.sqrt(weight)[:, None]


def _slope(points: np.ndarray, corners: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """By how much the third corner's height is over the line of the other two, over its distance from it."""
    a, b, c = (points[corners[:, k]] for k in range(3))
    share = np.einsum("hd,hd->h", c - a, b - a) / np.einsum("hd,hd->h", b - a, b - a)
    distance = np.linalg.norm(c - a - share[:, None] * (b - a), axis=1)
    on_line = (1 - share)[:, None] * heights[corners[:, 0]] + share[:, None] * heights[corners[:, 1]]
    return (heights[corners[:, 2]] - on_line) / distance[:, None]


def twice_areas(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(T,) twice the area of triangles between places in the plane, negative where they turn clockwise."""
    u, v = (points[triangles[:, k]] - points[triangles[:, 0]] for k in (1, 2))
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]


def _along(matrix: Array, angle: ArrayLike) -> Array:
    angle = as_inexact("angle", angle, matrix.dtype)
    c, s = jnp.cos(angle), jnp.sin(angle)
    strain = jnp.stack([c * c, s * s, 2 * c * s], axis=-1)
    return jnp.sum(strain * jnp.matmul(strain, matrix), axis=-1)


def _every(matrix: Array) -> Array:
    """A direction per degree."""
    return jnp.asarray(np.radians(np.arange(180.0)), matrix.dtype)


def _spread(values: Array) -> Array:
    return jnp.max(values) / jnp.min(values)


__all__ = ["Moduli", "matrix", "stretches", "turns", "twice_areas"]
