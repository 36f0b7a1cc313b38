"""The signed distance to a closed mesh of triangles, in NumPy, at the nodes of a grid.

    distance   the least over the triangles of that to the nearest place p of each
    sign       that of (x - p) . m, where m is the normal of the face, or the sum of the normals at the edge or (by their angles) at the
               corner on which p lies

Places are taken in small blocks: only triangles that may be nearest to a place of the block are looked at.

Source: Ericson (2005), Real-Time Collision Detection, 5.1.5; Baerentzen and Aanaes (2005), "Signed distance computation using the angle
weighted pseudonormal", for the sign.
"""

from __future__ import annotations

import numpy as np

# Places along each side of a block: smaller ones look at fewer triangles, larger ones do more at a time.
BLOCK = 6
# Triangles and places taken at a time, in products of their numbers: about 100 MB of temporary arrays.
AT_A_TIME = 400_000


def grid_distance(vertices: np.ndarray, faces: np.ndarray, axes: tuple[np.ndarray, ...]) -> np.ndarray:
    """Signed distance [m] at the nodes of a grid, negative inside: an array in the order of `axes`.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3) corners of triangles, turning the same way about the outward normal.
        axes: coordinates along x, y and z [m].
    """
    corners, normals = vertices[faces], pseudonormals(vertices, faces)
    found = np.empty(tuple(len(axis) for axis in axes))
    for start in np.ndindex(*(-(-n // BLOCK) for n in found.shape)):
        block = tuple(slice(BLOCK * i, BLOCK * (i + 1)) for i in start)
        points = np.stack(np.meshgrid(*(axis[part] for axis, part in zip(axes, block, strict=True)), indexing="ij"), axis=-1)
        found[block] = signed_distance(points.reshape(-1, 3), corners, normals).reshape(points.shape[:3])
    return found


def signed_distance(points: np.ndarray, corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(P,) signed distance [m] of places that are near each other."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = np.linalg.norm(points - middle, axis=1).max()
    from_middle = np.concatenate(
        [np.linalg.norm(nearest(middle[None], part)[0][0], axis=-1) for part in np.array_split(corners, -(-len(corners) // AT_A_TIME))]
    )
    # No place of the block is nearer to a triangle than the middle is, less the radius.
    chosen = np.flatnonzero(from_middle <= from_middle.min() + 2 * radius * (1 + 1e-9))
    result = np.empty(len(points))
    for part in np.array_split(np.arange(len(points)), -(-len(points) * len(chosen) // AT_A_TIME)):
        if len(part):
            offset, feature = nearest(points[part], corners[chosen])
            squared = np.einsum("ptd,ptd->pt", offset, offset)
            triangle = np.argmin(squared, axis=1)
            rows = np.arange(len(part))
            normal = normals[chosen[triangle], feature[rows, triangle]]
            side = np.einsum("pd,pd->p", offset[rows, triangle], normal)
            result[part] = np.where(side < 0, -1.0, 1.0) * np.sqrt(squared[rows, triangle])
    return result


def nearest(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(P, T, 3) each place less the nearest one of each triangle [m], and (P, T) where that lies.

    0 is the face, 1 to 3 the edges a b, b c and c a, 4 to 6 the corners a, b and c.
    """
    a, b, c = (corners[None, :, i] for i in range(3))
    p = points[:, None]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, p - a), _dot(ac, p - a)
    d3, d4 = _dot(ab, p - b), _dot(ac, p - b)
    d5, d6 = _dot(ab, p - c), _dot(ac, p - c)
    of_c, of_b, of_a = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    on_ab = (of_c <= 0) & (d1 >= 0) & (d3 <= 0)
    on_ac = (of_b <= 0) & (d2 >= 0) & (d6 <= 0)
    on_bc = (of_a <= 0) & (d4 >= d3) & (d5 >= d6)
    at_a, at_b, at_c = (d1 <= 0) & (d2 <= 0), (d3 >= 0) & (d4 <= d3), (d6 >= 0) & (d5 <= d6)
    whole = of_a + of_b + of_c
    with np.errstate(divide="ignore", invalid="ignore"):
        v, w = of_b / whole, of_c / whole
        along_ab, along_ac = d1 / (d1 - d3), d2 / (d2 - d6)
        along_bc = (d4 - d3) / ((d4 - d3) + (d5 - d6))
    conditions = [at_a, at_b, at_c, on_ab, on_ac, on_bc]
    # The barycentric numbers of b and c, in the order in which the conditions are asked.
    zero, one = np.zeros_like(d1), np.ones_like(d1)
    of_ab = np.select(conditions, [zero, one, zero, along_ab, zero, 1 - along_bc], v)
    of_ac = np.select(conditions, [zero, zero, one, zero, along_ac, along_bc], w)
    feature = np.select(conditions, [np.full(d1.shape, i) for i in (4, 5, 6, 1, 3, 2)], 0)
    return p - a - of_ab[..., None] * ab - of_ac[..., None] * ac, feature


def pseudonormals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 7, 3) normals of each triangle's face, of its edges a b, b c and c a, and of its corners, in the order of `nearest`."""
    corners = vertices[faces]
    sides = np.roll(corners, -1, axis=1) - corners
    face = np.cross(sides[:, 0], sides[:, 1])
    face = face / np.linalg.norm(face, axis=1, keepdims=True)
    unit = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    cosine = np.einsum("fid,fid->fi", unit, -np.roll(unit, 1, axis=1))
    angle = np.arccos(np.clip(cosine, -1, 1))
    at_corner = np.zeros_like(vertices)
    np.add.at(at_corner, faces.ravel(), (angle[..., None] * face[:, None]).reshape(-1, 3))
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    _, number = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    at_edge = np.zeros((number.max() + 1, 3))
    np.add.at(at_edge, number.ravel(), np.repeat(face, 3, axis=0))
    return np.concatenate([face[:, None], at_edge[number.ravel()].reshape(-1, 3, 3), at_corner[faces]], axis=1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...d,...d->...", a, b)


__all__ = ["grid_distance", "nearest", "pseudonormals", "signed_distance"]
