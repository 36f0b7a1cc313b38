"""Sheets at rest in the plane z = 0: meshes of equilateral triangles, and Provot's grid.

    rectangle   rows along x, every second one shifted by half a spacing, and closed at its ends by half triangles
    outline     nodes at the border, equilateral triangles inside, and between them triangles by Delaunay's criterion, smoothed
    provot      structural springs (i, i + 1), shear springs along both diagonals, flexion springs (i, i + 2)

Springs along the edges of equilateral triangles are isotropic, and so are hinges on them: see `materials.py`. Of an outline, the node
of a lattice counts as inside where it is at least `CLEAR` spacings from the border: no other node is then nearer to the middle of a
piece of the border than its ends, so that Delaunay's triangles have that piece as a side.

Source: Provot (1995), "Deformation Constraints in a Mass-Spring Model to Describe Rigid Cloth Behavior", for the grid; smoothing by the
mean of the neighbours is Laplacian smoothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._arrays import Numbers, on_host
from .._checks import as_inexact, finite, has_shape, nonnegative, positive
from ..forces.springs import Springs
from ..topology.builders import from_triangles
from ..topology.graph import Graph
from ..topology.lattice import BEND, SHEAR, STRUCTURAL, Lattice, lattice
from ..topology.mesh_checks import runs
from .moduli import twice_areas

# Height of a triangle over its side.
ROW = math.sqrt(3) / 2
# Least distance of an inner node from the border, in spacings.
CLEAR = 0.7
# Nodes this near to the border, in spacings, are smoothed, so many times.
SMOOTHED, SWEEPS = 1.8, 12
WHY = "A spring of negative stiffness pushes without bound."
# An outline with triangles of smaller angles is refused [degrees].
LEAST_ANGLE = 5.0


def rectangle(width: float, height: float, spacing: float) -> tuple[Graph, np.ndarray]:
    """A rectangle of equilateral triangles, rows along x, from (0, 0) to (width, height).

    Sides are met exactly: triangles are stretched by what is needed for a whole number of spacings along x and of rows along y, so they are
    equilateral where width is a whole number of spacings and height one of sqrt(3) / 2 spacings. Every second row ends in half triangles.

    Args:
        width: along x [m].
        height: along y [m].
        spacing: wanted side of a triangle [m].

    Returns:
        `(net, points)`: a `Graph` with triangles, counter-clockwise, and springs along their sides; (N, 3) rest positions [m], row by row.

    Raises:
        ValueError: a size that is not positive, a spacing wider than the rectangle.

    >>> net, points = rectangle(1.0, 3**0.5, 0.5)
    >>> net.n_nodes, net.triangles.shape, points[-1].round(3).tolist()
    (17, (20, 3), [1.0, 1.732, 0.0])
    """
    width, height, spacing = (_size(name, value) for name, value in (("width", width), ("height", height), ("spacing", spacing)))
    if spacing > 1.5 * min(width, height / ROW):
        raise ValueError(f"spacing = {spacing} m is wider than the rectangle of {width} m by {height} m. Pass a smaller one.")
    n, m = max(1, round(width / spacing)), max(1, round(height / (spacing * ROW)))
    plain, shifted = np.arange(n + 1.0), np.concatenate([[0.0], np.arange(n) + 0.5, [float(n)]])
    rows = [shifted if j % 2 else plain for j in range(m + 1)]
    start = np.cumsum([0, *map(len, rows)])
    points = np.zeros((start[-1], 3))
    points[:, 0] = np.concatenate(rows) * (width / n)
    points[:, 1] = np.repeat(np.arange(m + 1), [len(row) for row in rows]) * (height / m)
    i, triangles = np.arange(n + 1), []
    for j in range(m):
        even, odd = (start[j], start[j + 1]) if j % 2 == 0 else (start[j + 1], start[j])
        at_even = np.stack([even + i[:-1], even + i[1:], odd + i[1:]], axis=-1)
        at_odd = np.stack([even + i, odd + i + 1, odd + i], axis=-1)
        both = np.concatenate([at_even, at_odd])
        triangles.append(both if j % 2 == 0 else both[:, ::-1])
    return from_triangles(np.concatenate(triangles), len(points)), points


def disc(radius: float, spacing: float) -> tuple[Graph, np.ndarray]:
    """A disc about the origin: equilateral triangles inside, the border's nodes on the circle.

    Args:
        radius: [m].
        spacing: side of a triangle [m].

    Returns:
        As `rectangle`; nodes of the border come first, counter-clockwise from (radius, 0).

    Raises:
        ValueError: a size that is not positive, a spacing wider than the radius.

    >>> net, points = disc(0.15, 0.02)
    >>> bool(np.allclose(np.linalg.norm(points[:47], axis=1), 0.15)), net.n_nodes
    (True, 210)
    """
    radius, spacing = _size("radius", radius), _size("spacing", spacing)
    if spacing > radius:
        raise ValueError(f"spacing = {spacing} m is wider than the radius of {radius} m. Pass a smaller one.")
    angle = 2 * math.pi * np.arange(round(2 * math.pi * radius / spacing)) / round(2 * math.pi * radius / spacing)
    return _filled(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1), spacing, np.zeros(2))


def outline(polygon: Numbers, spacing: float) -> tuple[Graph, np.ndarray]:
    """The inside of a polygon: equilateral triangles, rows along x, and triangles near to equilateral along the border.

    Args:
        polygon: (P, 2) corners in order, either way round [m]. The last one is joined to the first.
        spacing: side of a triangle [m]. Each side of the polygon is cut into pieces of about that length.

    Returns:
        As `rectangle`; nodes of the border come first, counter-clockwise from the first corner.

    Raises:
        ValueError: fewer than three corners, what is not finite, sides that cross or touch, a part too narrow for
            the spacing, a corner sharper than 5 degrees.

    >>> net, points = outline([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], 0.25)
    >>> net.n_nodes, net.triangles.shape
    (61, (88, 3))
    """
    corners, spacing = on_host("polygon", polygon), _size("spacing", spacing)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
        raise ValueError(f"polygon has shape {corners.shape}; expected (P, 2): P >= 3 corners in the plane, in order.")
    finite("polygon", corners)
    _refuse_crossed(corners)
    if _area(corners) < 0:
        corners = np.concatenate([corners[:1], corners[:0:-1]])
    border = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        n = max(1, round(float(np.linalg.norm(b - a)) / spacing))
        border.append(a + (b - a) * np.arange(n)[:, None] / n)
    return _filled(np.concatenate(border), spacing, 0.5 * (corners.min(axis=0) + corners.max(axis=0)))


def provot(
    shape: tuple[int, int], spacing: float, stretch: Numbers, shear: Numbers, flexion: Numbers | None = None
) -> tuple[Lattice, np.ndarray, Springs]:
    """Provot's grid: structural, shear and flexion springs on a square lattice, all at rest.

    A flexion spring (i, i + 2) of rest length 2 h has no bending stiffness at small angles: at a turn of phi from one spring to the next
    its energy is k h^2 phi^4 / 32. It keeps folds open, but fails every measurement of a bending stiffness, whatever k is; and in the plane
    it adds four times its k to the stretch stiffness. Where bending is measured take `js.cloth.fabric`.

    Args:
        shape: (ny, nx) nodes along weft (y) and warp (x).
        spacing: h [m].
        stretch: k of the structural springs [N/m], one number or (warp, weft): along x and along y. It does not change with h.
        shear: k of both diagonals [N/m].
        flexion: k of the springs (i, i + 2) [N/m], one number or (warp, weft); None makes none.

    Returns:
        `(net, points, springs)`: the `Lattice`, (N, 3) rest positions [m] in the plane z = 0, and the springs, with constants by family.

    Raises:
        ValueError: a shape that is not of two axes, a constant that is negative or of another shape, a spacing that is not positive.

    >>> net, points, springs = provot((20, 30), 0.01, stretch=(100.0, 60.0), shear=20.0, flexion=1.0)
    >>> net.n_springs, points.shape, float(springs.energy(js.State.from_points(net, points))) < 1e-10
    (3352, (600, 3), True)
    """
    spacing = _size("spacing", spacing)
    if not isinstance(shape, tuple | list) or len(shape) != 2:
        raise ValueError(f"shape = {shape}; expected (ny, nx), the nodes along y and x.")
    net = lattice(shape, STRUCTURAL + SHEAR if flexion is None else STRUCTURAL + SHEAR + BEND)
    warp, weft = pair("stretch", stretch)
    diagonal = as_inexact("shear", shear)
    has_shape("shear", diagonal, {"one number": ()})
    nonnegative("shear", diagonal, WHY)
    stiffness: dict[tuple[int, ...], Any] = {(0, 1): warp, (1, 0): weft, (1, 1): diagonal, (1, -1): diagonal}
    if flexion is not None:
        stiffness[0, 2], stiffness[2, 0] = pair("flexion", flexion)
    length = {offset: spacing * math.hypot(*offset) for offset in stiffness}
    families = net.own(stiffness[offset] for offset in net.offsets)
    springs = Springs(net, families, net.own(as_inexact("rest_length", length[offset]) for offset in net.offsets))
    return net, in_space(net.grid(spacing)), springs


def pair(name: str, value: Numbers) -> tuple[Any, Any]:
    """One number for warp and weft, or one for each."""
    array = as_inexact(name, value)
    has_shape(name, array, {"one number": (), "(warp, weft)": (2,)})
    nonnegative(name, array, WHY)
    return (array[0], array[1]) if array.ndim else (array, array)


def in_space(points: np.ndarray) -> np.ndarray:
    """(N, 2) places in the plane -> (N, 3) with z = 0."""
    return np.pad(points, ((0, 0), (0, 1)))


def _size(name: str, value: Any) -> float:
    size = on_host(name, value)
    has_shape(name, size, {"one number": ()})
    positive(name, size, "A mesh needs a size.")
    return float(size)


def _area(corners: np.ndarray) -> float:
    """Area of a polygon, negative where it runs clockwise."""
    x, y = (corners - corners[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _refuse_crossed(corners: np.ndarray) -> None:
    """Raise ValueError where two sides meet elsewhere than at the corner they share."""
    n, ends = len(corners), np.roll(corners, -1, axis=0)
    i, j = np.triu_indices(n, 1)
    lengths = np.linalg.norm(ends - corners, axis=1)
    if (lengths == 0).any():
        k = int(np.argmin(lengths))
        raise ValueError(f"polygon[{k}] and polygon[{(k + 1) % n}] are at one place. Leave one out.")

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])

    a, b, c, d = corners[i], ends[i], corners[j], ends[j]
    crosses = (side(a, b, c) * side(a, b, d) <= 0) & (side(c, d, a) * side(c, d, b) <= 0)
    # Sides of one line lie on each other only where their boxes do.
    apart = (np.maximum(a, b) < np.minimum(c, d)) | (np.maximum(c, d) < np.minimum(a, b))
    neighbours = (j == i + 1) | ((i == 0) & (j == n - 1))
    turns_back = np.einsum("sd,sd->s", b - a, d - c) < 0
    folded = (side(a, b, c) == 0) & (side(a, b, d) == 0) & turns_back
    bad = np.where(neighbours, folded, crosses & ~apart.any(axis=1))
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"polygon: the sides that begin at corners {i[k]} and {j[k]} cross or touch, so it has no one inside.")


def _filled(border: np.ndarray, spacing: float, middle: np.ndarray) -> tuple[Graph, np.ndarray]:
    """The inside of a border of nodes (B, 2), counter-clockwise, filled with a lattice that has a node at `middle`."""
    from scipy.spatial import Delaunay

    low, high = border.min(axis=0), border.max(axis=0)
    n, m = (int((high - low).max() / spacing) + 2, int((high - low).max() / (spacing * ROW)) + 2)
    row, column = np.meshgrid(np.arange(-m, m + 1), np.arange(-n, n + 1), indexing="ij")
    places = middle + spacing * np.stack([(column + 0.5 * (row % 2)).ravel(), (row * ROW).ravel()], axis=-1)
    places = places[((places > low) & (places < high)).all(axis=1)]
    away = _distance(places, border)
    keep = _is_inside(places, border) & (away >= CLEAR * spacing)
    points, near = np.concatenate([border, places[keep]]), away[keep] < SMOOTHED * spacing
    moved = len(border) + np.flatnonzero(near)

    def inside() -> np.ndarray:
        triangles = Delaunay(points - middle).simplices
        return triangles[_is_inside(points[triangles].mean(axis=1), border)]

    for _ in range(SWEEPS):
        points[moved] = _middles(inside(), points)[moved]
    triangles = _counterclockwise(points, inside())
    _check(points, triangles, len(border), spacing)
    return from_triangles(triangles, len(points)), in_space(points)


def _middles(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) the mean of each node's neighbours."""
    sides = runs(triangles)
    pairs = np.unique(np.sort(sides, axis=1), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(points))
    total = np.stack([np.bincount(both[:, 0], points[both[:, 1], k], len(points)) for k in range(2)], axis=-1)
    return total / np.maximum(degree, 1)[:, None]


def _counterclockwise(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    turns = twice_areas(points, triangles) < 0
    return np.where(turns[:, None], triangles[:, ::-1], triangles)


def _check(points: np.ndarray, triangles: np.ndarray, n_border: int, spacing: float) -> None:
    """Raise ValueError unless the triangles end at the border, use all nodes, and none is a sliver."""
    n_nodes = len(points)
    sides = runs(triangles)
    there, back = sides[:, 0] * n_nodes + sides[:, 1], sides[:, 1] * n_nodes + sides[:, 0]
    ends = np.sort(there[~np.isin(there, back)])
    i = np.arange(n_border)
    wanted = np.sort(i * n_nodes + (i + 1) % n_border)
    if len(np.unique(triangles)) < n_nodes or not np.array_equal(ends, wanted):
        missing = np.setdiff1d(wanted, ends)
        where = f" near node {missing[0] // n_nodes} of the border" if len(missing) else ""
        raise ValueError(f"triangles with sides of {spacing} m do not fill the outline{where}: it is too narrow. Pass a smaller spacing.")
    a, b, c = (points[triangles[:, k]] for k in range(3))
    lengths = np.sort([np.linalg.norm(q - p, axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0)
    # The smallest angle is the one across the shortest side.
    angle = np.degrees(np.arcsin(np.minimum(np.abs(twice_areas(points, triangles)) / (lengths[1] * lengths[2]), 1.0)))
    if angle.min() < LEAST_ANGLE:
        x, y = points[triangles[np.argmin(angle)]].mean(axis=0)
        raise ValueError(
            f"a triangle near ({x:.6g}, {y:.6g}) would have an angle of {angle.min():.2g} degrees: the outline is too narrow there for "
            f"sides of {spacing} m. Pass a smaller spacing, or blunt a corner as sharp as that."
        )


def _is_inside(places: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Whether each place is inside a closed line: a ray to the right crosses it an odd number of times."""
    inside = np.zeros(len(places), bool)
    for a, b in zip(border, np.roll(border, -1, axis=0), strict=True):
        spans = (a[1] > places[:, 1]) != (b[1] > places[:, 1])
        rise = b[1] - a[1] if b[1] != a[1] else 1.0
        inside ^= spans & (places[:, 0] < a[0] + (b[0] - a[0]) * (places[:, 1] - a[1]) / rise)
    return inside


def _distance(places: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Distance of each place from a closed line."""
    least = np.full(len(places), np.inf)
    for a, b in zip(border, np.roll(border, -1, axis=0), strict=True):
        share = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(places - a - share[:, None] * (b - a), axis=1))
    return least


__all__ = ["disc", "in_space", "outline", "pair", "provot", "rectangle"]
