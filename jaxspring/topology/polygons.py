"""Polygons cut into triangles, also where a corner points inwards.

A polygon whose corners all turn the same way is cut from its first corner. Any other loses one ear after the other: a corner that points
outwards and whose triangle holds no other corner (Meisters, 1975). Corners are looked at along the polygon's mean normal (Newell's).
"""

from __future__ import annotations

import numpy as np

# Share of a polygon's squared size below which a corner counts as straight.
STRAIGHT = 1e-12


class CrossedPolygonError(ValueError):
    """A polygon whose sides cross.

    Attributes:
        face: its number.
    """

    def __init__(self, face: int):
        super().__init__(f"face {face} crosses itself")
        self.face = face


def triangulate(points: np.ndarray, sizes: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(T, 3) triangles that cover the polygons.

    Args:
        points: (N, 3) vertices.
        sizes: (F,) corners of each polygon, 3 or more.
        corners: their vertices, polygon after polygon.

    Raises:
        CrossedPolygonError: a polygon whose sides cross.
    """
    start = np.cumsum(sizes) - sizes
    triangles, owners = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)]
    for size in np.unique(sizes):
        faces = np.flatnonzero(sizes == size)
        polygons = corners[start[faces][:, None] + np.arange(size)]
        if size == 3:
            triangles.append(polygons)
            owners.append(faces)
            continue
        flat = _flattened(points[polygons])
        is_round = _is_round(flat)
        fans = np.stack([np.stack([polygons[:, 0], polygons[:, i], polygons[:, i + 1]], axis=-1) for i in range(1, size - 1)], axis=1)
        triangles.append(fans[is_round].reshape(-1, 3))
        owners.append(np.repeat(faces[is_round], size - 2))
        for i in np.flatnonzero(~is_round):
            cut = _ears(flat[i], polygons[i])
            if cut is None:
                raise CrossedPolygonError(int(faces[i]))
            triangles.append(polygons[i][np.array(cut)].reshape(-1, 3))
            owners.append(np.full(len(cut), faces[i]))
    # In the order of the faces.
    return np.concatenate(triangles)[np.argsort(np.concatenate(owners), kind="stable")]


def _flattened(polygons: np.ndarray) -> np.ndarray:
    """(F, n, 2) corners in the plane across each polygon's mean normal, measured in its size; counted counter-clockwise."""
    local = polygons - polygons.mean(axis=1, keepdims=True)
    size = np.abs(local).max(axis=(1, 2))
    local = local / np.where(size > 0, size, 1)[:, None, None]
    normal = np.cross(local, np.roll(local, -1, axis=1)).sum(axis=1)
    length = np.linalg.norm(normal, axis=1)
    normal = np.where(length[:, None] > 0, normal, [0.0, 0.0, 1.0]) / np.where(length > 0, length, 1)[:, None]
    # Any direction across the normal: the axis that is most across it, made so exactly.
    u = np.eye(3)[np.abs(normal).argmin(axis=1)]
    u = u - (u * normal).sum(axis=1)[:, None] * normal
    u = u / np.linalg.norm(u, axis=1)[:, None]
    v = np.cross(normal, u)
    return np.stack([(local * u[:, None]).sum(axis=-1), (local * v[:, None]).sum(axis=-1)], axis=-1)


def _is_round(flat: np.ndarray) -> np.ndarray:
    """(F,) whether each corner points outwards, and the polygon goes round once."""
    along = np.roll(flat, -1, axis=1) - flat
    before = np.roll(along, 1, axis=1)
    turn, straight = _cross(before, along), (before * along).sum(axis=-1)
    return (turn > STRAIGHT).all(axis=1) & (np.arctan2(turn, straight).sum(axis=1) < 3 * np.pi)


def _ears(flat: np.ndarray, names: np.ndarray) -> list[tuple[int, int, int]] | None:
    """Triangles of one polygon as places of its corners; None where its sides cross. `names` tells corners that are one vertex."""
    left, cut = list(range(len(flat))), []
    while len(left) > 3:
        best, widest = None, -np.inf
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            area = _cross(flat[b] - flat[a], flat[c] - flat[b])
            if area <= STRAIGHT or any(
                names[p] not in (names[a], names[b], names[c]) and _holds(flat[a], flat[b], flat[c], flat[p]) for p in left
            ):
                continue
            # The ear whose smallest angle is largest, so that no sliver is left for the end.
            width = area / max(_squared(flat[b] - flat[a]), _squared(flat[c] - flat[b]), _squared(flat[a] - flat[c]))
            if width > widest:
                best, widest = i, width
        if best is None:
            # Nothing is left but corners in one line, which have no area.
            if abs(_area(flat[left])) > STRAIGHT * len(left):
                return None
            cut += [(left[0], left[i], left[i + 1]) for i in range(1, len(left) - 1)]
            left = []
            break
        cut.append((left[best - 1], left[best], left[(best + 1) % len(left)]))
        del left[best]
    if left:
        cut.append((left[0], left[1], left[2]))
    covered = sum(abs(_cross(flat[b] - flat[a], flat[c] - flat[a])) / 2 for a, b, c in cut)
    return cut if abs(covered - _area(flat)) <= 1e-9 * max(covered, 1) else None


def _holds(a: np.ndarray, b: np.ndarray, c: np.ndarray, p: np.ndarray) -> bool:
    """Whether p lies in the triangle or on its border."""
    return bool(min(_cross(b - a, p - a), _cross(c - b, p - b), _cross(a - c, p - c)) >= -STRAIGHT)


def _area(flat: np.ndarray) -> float:
    return float(_cross(flat, np.roll(flat, -1, axis=0)).sum() / 2)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _squared(a: np.ndarray) -> float:
    return float(a @ a)


__all__ = ["CrossedPolygonError", "triangulate"]
