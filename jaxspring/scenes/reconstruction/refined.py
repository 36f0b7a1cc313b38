"""A mesh refined where its error is, up to a number of nodes; and refined and fitted.

In rounds: heights by least squares, then the triangles of the largest squared error are split, as many as the round's share of the nodes
allows. A triangle may be split again in the next round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._arrays import Numbers
from ..._checks import triangle_indices
from ...images.image import Image
from .given import pixel_weights, plane_points
from .refine import Subdivision
from .tin import fitted_heights, locate_pixels, surface_matrix

ROUNDS = 3


@dataclass(frozen=True)
class Refined:
    """What `refine_by_error` returns.

    Attributes:
        mesh: the subdivision.
        base: the mesh that it began with.
        points: (N, 2) its nodes.
        stiffness: (E,) of the springs along its sides at s = 1 [N/m].
    """

    mesh: Subdivision
    base: Subdivision
    points: np.ndarray
    stiffness: np.ndarray


def refine_by_error(
    image: Image,
    points: Numbers,
    triangles: Numbers,
    n_nodes: int,
    stiffness: Numbers = 1.0,
    rounds: int = ROUNDS,
    observation: Callable[[Image], Any] | None = None,
) -> Refined:
    """Split the triangles with the largest squared error, or where most is observed, until a mesh has so many nodes.

    Args:
        image: the data.
        points: (N, 2) or (N, 3) nodes to start from; x and y are read.
        triangles: (T, 3) node numbers.
        n_nodes: at most so many nodes in the end; the mesh comes near to it from below.
        stiffness: of the springs along the sides [N/m]: a number, or (E,) in the order of `from_triangles(triangles, N).edges`.
        rounds: how often triangles are chosen; each round adds its share of the nodes.
        observation: of the image, one number per pixel, such as `js.images.Curvature()` or any function of an image; its sum over a
            triangle takes the place of the squared error.

    Returns:
        `Refined`.

    Raises:
        ValueError: fewer nodes than there are, triangles that do not fit, an observation of another shape.

    >>> y, x = np.mgrid[:40, :40]
    >>> edge = Image(np.tanh(0.5 * (x - 12.0)))
    >>> found = refine_by_error(edge, [(0, 0), (39, 0), (0, 39), (39, 39)], [(0, 1, 2), (2, 1, 3)], n_nodes=60, rounds=5)
    >>> bool(found.mesh.n_nodes <= 60 and np.median(found.points[:, 0]) < 19.5)
    True
    """
    places = plane_points(points)
    corners = triangle_indices("triangles", triangles, len(places))
    if n_nodes < len(places):
        raise ValueError(f"n_nodes = {n_nodes}, but the mesh has {len(places)} already. Start from a coarser one.")
    base = mesh = Subdivision.of(corners, len(places), stiffness)
    truth, weights = np.asarray(image.values, np.float64).ravel(), pixel_weights(image)
    seen = None if observation is None else np.asarray(observation(image), np.float64)
    if seen is not None and seen.shape != image.shape:
        raise ValueError(f"observation gives an array of shape {seen.shape} for an image of {image.shape}; expected one number per pixel.")
    for i in range(rounds):
        goal = len(places) + (n_nodes - len(places)) * (i + 1) // rounds
        located = locate_pixels(image, mesh.carried(places, base), mesh.triangles)
        if seen is None:
            matrix = surface_matrix(located, mesh.triangles, mesh.n_nodes)
            weight = weights * (matrix @ fitted_heights(matrix, truth, mesh.net, weights) - truth) ** 2
        else:
            weight = seen.ravel()
        inside = located.triangle >= 0
        of_triangle = np.bincount(located.triangle[inside], weight[inside], minlength=len(mesh.triangles))
        mesh = _split_largest(mesh, of_triangle, goal)
    return Refined(mesh, base, mesh.carried(places, base), mesh.stiffness(base)[1])


def _split_largest(mesh: Subdivision, weight: np.ndarray, n_nodes: int) -> Subdivision:
    """As many of the heaviest triangles split as nodes allow, by bisection of their number."""
    order = np.argsort(-weight, kind="stable")
    least, most, best = 0, len(order), mesh
    while least < most:
        count = (least + most + 1) // 2
        marked = np.zeros(len(order), bool)
        marked[order[:count]] = True
        finer = mesh.refined(marked)
        if finer.n_nodes <= n_nodes:
            least, best = count, finer
        else:
            most = count - 1
    return best


__all__ = ["Refined", "refine_by_error"]
