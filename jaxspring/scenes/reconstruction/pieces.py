"""A surface that breaks, over an image: find the breaks of a mesh, give each pixel to its side, fit the heights again, draw.

    corner A cut off from B and C     A's side, l_B / t_AB + l_C / t_AC < 1:  z = z_A         the other:  (l_B z_B + l_C z_C) / (l_B + l_C)
    all three sides cut               z of the corner of the largest l

Every pixel keeps a data spring; it acts on the nodes of its own side alone. Before the breaks are known, a node's datum is the image under
it, since a mean over pixels on both sides of an edge is on neither; its data spring is as stiff as those of the pixels around it together.
Lines along which the pixels are farther from the broken surface than from the whole one are mended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._arrays import Numbers
from ..._checks import triangle_indices
from ...images.image import Image
from ...topology.builders import from_triangles
from .break_energy import HeightField
from .break_lines import Faces
from .breaks import Breaks, assembled, find_breaks
from .given import host_number, pixel_weights, plane_points, weighted_rms
from .tin import Located, Tin, fitted_heights, locate_pixels, surface_matrix

# Springs along z over a node's data spring, while breaks are looked for.
SMOOTHING = 1.0


@dataclass(frozen=True)
class BrokenSurface:
    """What `break_surface` returns.

    Attributes:
        tin: nodes, triangles, heights.
        breaks: which springs are broken, and the lines.
        drawn: (ny, nx) the surface at every pixel; NaN outside.
        unbroken: the same mesh in one piece, its heights fitted alike.
        rmse: root mean square error over the pixels [unit of the image].
        greatest: the largest error.
    """

    tin: Tin
    breaks: Breaks
    drawn: np.ndarray
    unbroken: Tin
    rmse: float
    greatest: float


def break_surface(image: Image, points: Numbers, triangles: Numbers, step: Numbers, smoothing: Numbers = SMOOTHING) -> BrokenSurface:
    """Break a surface of triangles over an image along its edges, and fit both sides of each.

    Args:
        image: the data.
        points: (N, 2) or (N, 3) nodes in the unit of the image's spacing; x and y are read.
        triangles: (T, 3) node numbers.
        step: the lowest step that breaks, in the image's unit: three times the noise, or more.
        smoothing: stiffness of the springs along z over that of a node's data spring, while breaks are looked for. More finds lower steps
            in noise, less stands steeper slopes: see `Breaks.steepest`.

    Returns:
        `BrokenSurface`.

    Raises:
        ValueError: triangles that do not fit the points, a step or a smoothing that is not positive.

    >>> import jaxspring as js
    >>> y, x = np.mgrid[:40, :40]
    >>> image = js.Image(np.where(x > 17, 1.0, 0.0))
    >>> places = np.stack(np.meshgrid(np.linspace(0, 39, 11), np.linspace(0, 39, 11)), axis=-1).reshape(-1, 2)
    >>> found = break_surface(image, places, js.delaunay(places).triangles, step=0.5)
    >>> bool(found.rmse < found.unbroken.errors(image).rmse / 2)
    True
    """
    places = plane_points(points)
    corners = triangle_indices("triangles", triangles, len(places))
    ratio = host_number("smoothing", smoothing, "Nothing would hold the surface together.")
    net, truth = from_triangles(corners, len(places)), np.asarray(image.values, np.float64).ravel()
    located, weights = locate_pixels(image, places, corners), pixel_weights(image)
    matrix = surface_matrix(located, corners, len(places))
    whole = Tin(np.column_stack([places, fitted_heights(matrix, truth, net, weights)]), corners)
    number = matrix.T @ weights
    data = np.asarray(image.sample(places[:, 0], places[:, 1]), np.float64)
    k, lowest = ratio * float(np.median(number[number > 0])), host_number("step", step, "Every spring would break.")
    breaks = find_breaks(net, places, data, k, number, lowest, image)
    field = HeightField.of(net, places, data, k, number)

    def fitted(broken: Breaks) -> tuple[np.ndarray, np.ndarray, float]:
        sided = surface_matrix(sided_weights(located, corners, field.edges, broken), corners, len(places))
        z = fitted_heights(sided, truth, net, weights, ~broken.broken)
        return z, sided @ z, float(np.sum(weights * (located.triangle >= 0) * (sided @ z - truth) ** 2))

    best = fitted(breaks)
    for line in _lines(breaks):
        mended = assembled(net, field, lowest, breaks.broken & ~line, image)
        tried = fitted(mended)
        # A slope that is steep but has no edge: the pixels are nearer to the surface in one piece.
        breaks, best = (mended, tried) if tried[2] < best[2] else (breaks, best)
    z, surface, _ = best
    drawn = np.where(located.triangle < 0, np.nan, surface)
    error = np.where(weights > 0, np.abs(drawn - truth), np.nan)
    rmse, greatest = weighted_rms(error, weights), float(np.nanmax(error))
    return BrokenSurface(Tin(np.column_stack([places, z]), corners), breaks, drawn.reshape(image.shape), whole, rmse, greatest)


def _lines(breaks: Breaks) -> list[np.ndarray]:
    """(E,) booleans for each group of broken springs that hang together by faces, the smallest group first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    beside, springs = Faces.of(breaks.net).beside, np.flatnonzero(breaks.broken)
    n_faces, n = int(beside.max(initial=-1)) + 1, len(springs)
    rows, faces = np.repeat(np.arange(n), 2), beside[springs].ravel()
    rows, faces = rows[faces >= 0], faces[faces >= 0]
    joined = coo_array((np.ones(len(rows)), (rows, n + faces)), shape=(n + n_faces, n + n_faces))
    _, group = connected_components(joined, directed=False)
    groups = [springs[group[:n] == g] for g in np.unique(group[:n])]
    return [np.isin(np.arange(len(breaks.broken)), some) for some in sorted(groups, key=len)]


def sided_weights(located: Located, triangles: np.ndarray, edges: np.ndarray, breaks: Breaks) -> Located:
    """The weights of the pixels, in triangles that are cut by those of their own side alone."""
    share = _shares(triangles, edges, breaks)
    cuts = np.isfinite(share).sum(axis=2)
    weights = located.weights.copy()
    n_cuts = np.where(located.triangle >= 0, cuts.sum(axis=1)[located.triangle], 0)
    three = np.flatnonzero(n_cuts == 6)
    weights[three] = np.eye(3)[np.argmax(weights[three], axis=1)]
    two = np.flatnonzero(n_cuts == 4)
    triangle = located.triangle[two]
    # The corner that both cut sides meet at is cut off from the others.
    corner = np.argmax(cuts[triangle], axis=1)
    from_corner = share[triangle, corner]
    ratio = np.where(np.isfinite(from_corner), located.weights[two] / np.where(np.isfinite(from_corner), from_corner, 1), 0.0)
    is_alone = ratio.sum(axis=1) < 1
    alone = np.eye(3)[corner]
    rest = np.where(alone == 1, 0.0, located.weights[two])
    total = rest.sum(axis=1, keepdims=True)
    weights[two] = np.where(is_alone[:, None], alone, rest / np.where(total > 0, total, 1))
    return Located(located.triangle, weights)


def _shares(triangles: np.ndarray, edges: np.ndarray, breaks: Breaks) -> np.ndarray:
    """(T, 3, 3) where the side from one corner to another is crossed, from the first; infinite where it is whole."""
    n = breaks.net.n_nodes
    share = np.full((len(triangles), 3, 3), np.inf)
    keys = edges.astype(np.int64) @ [n, 1]
    order = np.argsort(keys)
    for a in range(3):
        for b in range(3):
            wanted = triangles[:, a].astype(np.int64) * n + triangles[:, b]
            place = order[np.minimum(np.searchsorted(keys[order], wanted), len(keys) - 1)]
            cut = (keys[place] == wanted) & breaks.broken[place]
            share[cut, a, b] = breaks.fraction[place[cut]]
            share[cut, b, a] = 1 - breaks.fraction[place[cut]]
    return share


__all__ = ["BrokenSurface", "break_surface", "sided_weights"]
