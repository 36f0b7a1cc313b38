"""Active contours: a chain, open or closed, that an image draws to its edges while springs shorten it and joints keep it smooth.

    energy     sum k/2 |x_i - x_{i+1}|^2  +  sum k_theta/2 phi_i^2  -  strength sum a(x_i),    a the observation scaled to [0, 1]

Source: Kass, Witkin and Terzopoulos (1988), "Snakes": tension by springs of rest length zero, bending by joints, the image as a potential.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Array

from ..._arrays import Numbers, on_host
from ..._checks import as_inexact, finite, has_shape, nonnegative
from ...forces.damping import Drag
from ...forces.data_springs import ImageAttraction
from ...forces.joints import AngularJoints
from ...forces.springs import Springs
from ...images.image import Image
from ...images.observation import GradientMagnitude, adaptation
from ...images.sampling import CubicSpline
from ...state import State
from ...system import System
from ...topology.graph import Graph


def active_contour(
    image: Image,
    points: Numbers,
    sigma: float,
    tension: Numbers = 0.02,
    bending: Numbers = 0.1,
    strength: Numbers = 1.0,
    closed: bool = True,
    observation: Callable[[Image], Array] | None = None,
    drag: float = 0.5,
    radius: int | None = None,
) -> tuple[System, State]:
    """A contour on an image, ready for `rollout`: mass 1 kg a node, so a dt of about 1 is stable with the values given here.

    Args:
        image: what is observed.
        points: (N, 2) nodes in order, in the unit of the image's spacing.
        sigma: width of the Gaussian that smooths the observation: how far an edge reaches [m].
        tension: k of the springs of rest length zero [N/m]: a number, or one per spring.
        bending: k_theta of the joints [N m]: a number, or one per joint.
        strength: of the image [J].
        closed: whether the last node is joined to the first. The ends of an open contour stay.
        observation: what draws: `GradientMagnitude()` unless said, `js.images.Intensity()`, or any function of an image.
        drag: gamma of each node [N s/m].
        radius: half width of the Gaussian in pixels; needed where sigma or the image is traced (see `js.images.smoothing_radius`).

    Returns:
        `(system, state)`.

    Raises:
        ValueError: fewer than 4 points, points of another shape.

    >>> y, x = np.mgrid[:40, :40]
    >>> angle = 2 * np.pi * np.arange(30) / 30
    >>> start = np.stack([20 + 15 * np.cos(angle), 20 + 15 * np.sin(angle)], axis=-1)
    >>> system, state = active_contour(Image(1.0 * (np.hypot(x - 20, y - 20) < 10)), start, sigma=2.0)
    >>> system.net.n_springs, len(system.forces)
    (30, 4)
    """
    places = on_host("points", points).astype(np.float64)
    if places.ndim != 2 or places.shape[1] != 2 or len(places) < 4:
        raise ValueError(f"points has shape {places.shape}; expected (N, 2), N at least 4: the nodes of the contour in order.")
    finite("points", places)
    n = len(places)
    i = np.arange(n if closed else n - 1)
    net = Graph.from_edges(np.stack([i, (i + 1) % n], axis=-1), n)
    j = np.arange(n) if closed else np.arange(1, n - 1)
    k, k_theta = net.edge_constant(tension, "tension"), as_inexact("bending", bending)
    has_shape("bending", k_theta, {"one number": (), "one per joint": (len(j),)})
    for name, value in (("tension", k), ("bending", k_theta)):
        nonnegative(name, value, "A contour that is pushed apart or folds never rests.")
    joints = AngularJoints(net, k_theta, joints=np.stack([(j - 1) % n, j, (j + 1) % n], axis=-1))
    seen = adaptation(image, sigma, GradientMagnitude() if observation is None else observation, radius)
    forces = (Springs(net, k, 0.0), joints, ImageAttraction(seen, strength, CubicSpline()), Drag(drag))
    free = np.ones(n, bool)
    free[[0, -1]] = closed
    return System(net, 1.0, forces, free=free), State.from_points(net, places)


__all__ = ["active_contour"]
