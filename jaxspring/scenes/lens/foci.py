"""What a lens is to magnify: discs, polygons, and images of importance.

A focus has a magnification m and a share s(x, y), 1 where the whole of it is wanted and 0 in the context. Several of them multiply:

    M(x, y) = product over the foci of m^s,        a(x, y) = 1 - product of (1 - s)

M is the magnification that is wanted (linear: lengths, not areas) and `a` says how much any focus has to say. So two lenses of 2 make 4
where they overlap, and a lens of 1/2 cancels one of 2. A focus with m = 1 keeps its size where others squeeze.

Across the rim, a band of width w outside the edge, a disc or polygon fades as 1 - t^2 (3 - 2 t) with t = distance / w.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..._arrays import Numbers
from ..._checks import as_inexact, constant, finite, has_shape, is_concrete, kind
from ...images.image import Image, without_holes

# x0, y0, x1, y1 of a rectangle [pixels].
Extent = tuple[Array, Array, Array, Array]


class Focus(eqx.Module):
    """A part of the image that is to be magnified. Subclass it for a shape of your own: a `magnification`, and a `share`.

    All lengths are in pixels; x runs along the columns and y along the rows.

    Attributes:
        magnification: m, above 0; linear, of lengths.
    """

    magnification: eqx.AbstractVar[Array]

    @abc.abstractmethod
    def share(self, x: Array, y: Array) -> Array:
        """How much of the magnification is wanted, from 0 to 1, at the nodes `(x, y)` of a regular grid, two arrays (ny, nx) [pixels]."""

    def extent(self) -> Extent | None:
        """The smallest rectangle (x0, y0, x1, y1) around the part that is wholly magnified [pixels]; None where it has no edge."""
        return None


class Disc(Focus):
    """A disc.

    Args:
        centre: (x, y) [pixels].
        radius: of the part that is wholly magnified [pixels].
        magnification: m, above 0; below 1 the disc shrinks.
        rim: width of the band outside, across which the magnification falls to that of the context [pixels]; 0.4 radius unless given.

    Attributes:
        centre: (2,) [pixels].
        radius, magnification, rim: as above.

    Raises:
        ValueError: a radius, magnification or rim that is not positive and finite, a centre that is not two finite numbers.

    >>> import jax.numpy as jnp
    >>> disc = Disc(centre=(100.0, 80.0), radius=30.0, magnification=2.0)
    >>> print(disc.share(jnp.array([100.0, 136.0, 150.0]), jnp.array([80.0, 80.0, 80.0])))
    [1.  0.5 0. ]
    """

    centre: Array
    radius: Array
    magnification: Array
    rim: Array

    def __init__(self, centre: Numbers, radius: Array | float, magnification: Array | float, rim: Array | float | None = None):
        self.centre = as_inexact("centre", centre)
        has_shape("centre", self.centre, {"(x, y)": (2,)})
        finite("centre", self.centre)
        self.radius = constant("radius", radius, "A disc without a radius magnifies nothing.")
        self.magnification = _magnification(magnification)
        self.rim = 0.4 * self.radius if rim is None else _rim(rim)

    def share(self, x: Array, y: Array) -> Array:
        """1 inside the radius, 0 beyond the rim."""
        dx, dy = x - self.centre[0], y - self.centre[1]
        squared = dx * dx + dy * dy
        # At the very centre the distance has no derivative, and none is needed.
        distance = jnp.sqrt(jnp.where(squared > 0, squared, jnp.ones_like(squared)))
        return faded(jnp.where(squared > 0, distance, jnp.zeros_like(distance)) - self.radius, self.rim)

    def extent(self) -> Extent:
        """The square around the disc."""
        (x, y), r = self.centre, self.radius
        return x - r, y - r, x + r, y + r


class Polygon(Focus):
    """The inside of a closed polygon, of either sense, whose edges do not cross.

    Args:
        corners: (n, 2) corners (x, y), three or more [pixels].
        magnification: m, above 0.
        rim: width of the band outside, across which the magnification falls to that of the context [pixels].

    Attributes:
        corners, magnification, rim: as above.

    Raises:
        ValueError: fewer than three corners, what is not finite, a magnification or rim that is not positive.

    >>> import jax.numpy as jnp
    >>> square = Polygon([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]], magnification=2.0, rim=8.0)
    >>> print(square.share(jnp.array([20.0, 34.0, 60.0]), jnp.array([20.0, 20.0, 20.0])))
    [1.  0.5 0. ]
    """

    corners: Array
    magnification: Array
    rim: Array

    def __init__(self, corners: Numbers, magnification: Array | float, rim: Array | float):
        self.corners = as_inexact("corners", corners)
        if self.corners.ndim != 2 or self.corners.shape[1] != 2 or len(self.corners) < 3:
            raise ValueError(f"corners has shape {self.corners.shape}; expected (n, 2): x and y of three corners or more.")
        finite("corners", self.corners)
        self.magnification = _magnification(magnification)
        self.rim = _rim(rim)

    def share(self, x: Array, y: Array) -> Array:
        """1 inside, 0 beyond the rim."""
        return faded(self._signed_distance(x, y), self.rim)

    def extent(self) -> Extent:
        """The rectangle around the corners."""
        low, high = jnp.min(self.corners, axis=0), jnp.max(self.corners, axis=0)
        return low[0], low[1], high[0], high[1]

    def _signed_distance(self, x: Array, y: Array) -> Array:
        """Distance to the nearest edge, negative inside [pixels]: where a ray to the right crosses an odd number of edges."""
        nearest, crossings = jnp.full_like(x, jnp.inf), jnp.zeros(x.shape, bool)
        for i in range(len(self.corners)):
            (ax, ay), (bx, by) = self.corners[i - 1], self.corners[i]
            ex, ey, px, py = bx - ax, by - ay, x - ax, y - ay
            length2 = ex * ex + ey * ey
            t = jnp.clip((px * ex + py * ey) / jnp.where(length2 > 0, length2, jnp.ones_like(length2)), 0, 1)
            dx, dy = px - t * ex, py - t * ey
            nearest = jnp.minimum(nearest, dx * dx + dy * dy)
            level = jnp.where(ey == 0, jnp.ones_like(ey), ey)
            crossings ^= ((ay > y) != (by > y)) & (px < py * ex / level)
        on_edge = nearest <= 0
        distance = jnp.where(on_edge, 0, jnp.sqrt(jnp.where(on_edge, 1, nearest)))
        return jnp.where(crossings, -distance, distance)


class Importance(Focus):
    """An image that says what is important: painted, a mask, a saliency map, the output of a network.

    Each node takes the mean of the pixels within a cell of it, weighted by a hat, so that every pixel has a say, and a derivative.

    Args:
        image: importance from 0 (context) to 1 (the whole magnification), on the pixels of the image that is to be warped; by its
            spacing and origin it may be coarser.
        magnification: m where the importance is 1, above 0.

    Attributes:
        image, magnification: as above.

    Raises:
        ValueError: pixels outside 0 to 1, an image with weights, a magnification that is not positive.
        TypeError: not a `js.Image`.

    >>> import numpy as np
    >>> import jaxspring as js
    >>> focus = js.lens.Importance(js.Image(np.eye(8)), magnification=2.0)
    """

    image: Image
    magnification: Array

    def __init__(self, image: Image, magnification: Array | float):
        image = kind("image", image, Image, "js.Image(mask.astype(float))")
        self.image = without_holes("image", image, "importance must be known everywhere.")
        if is_concrete(image.values):
            low, high = float(jnp.min(image.values)), float(jnp.max(image.values))
            if low < 0 or high > 1:
                raise ValueError(
                    f"image holds values from {low:g} to {high:g}, but importance runs from 0 (context) to 1 (the whole "
                    "magnification). Pass image.normalised()."
                )
        self.magnification = _magnification(magnification)

    def share(self, x: Array, y: Array) -> Array:
        """The importance around each node."""
        rows = _hats(y[:, 0], self.image.shape[0], self.image.spacing[1], self.image.origin[1])
        columns = _hats(x[0], self.image.shape[1], self.image.spacing[0], self.image.origin[0])
        return rows @ self.image.values.astype(x.dtype) @ columns.T


def several(foci: Focus | Sequence[Focus]) -> tuple[Focus, ...]:
    """One focus, or several, as a tuple."""
    return (foci,) if isinstance(foci, Focus) else tuple(foci)


def faded(distance: Array, rim: Array) -> Array:
    """1 where the signed distance from an edge is negative, 0 beyond the rim, smooth between."""
    t = distance / rim
    # Comparisons rather than `clip`, whose slope at its very ends is one half.
    t = jnp.where(t > 0, jnp.where(t < 1, t, jnp.ones_like(t)), jnp.zeros_like(t))
    return 1 - t * t * (3 - 2 * t)


def combined(foci: tuple[Focus, ...], x: Array, y: Array) -> tuple[Array, Array]:
    """The logarithm of M, and `a`, of several foci at the nodes of a regular grid."""
    log_wanted, left = jnp.zeros_like(x), jnp.ones_like(x)
    for focus in foci:
        share = focus.share(x, y)
        log_wanted, left = log_wanted + share * jnp.log(focus.magnification), left * (1 - share)
    return log_wanted, 1 - left


def ramped(foci: Focus | Sequence[Focus], part: Array | float) -> tuple[Focus, ...]:
    """The foci with a part of their magnification, m^part: from none at 0 to all of it at 1, by equal factors in equal steps.

    Args:
        foci: one or several.
        part: from 0 to 1; a number, which may be traced.

    Returns:
        A tuple of the foci, with other magnifications.

    Raises:
        ValueError: a part that is negative.

    >>> print(ramped(Disc((10.0, 10.0), 5.0, magnification=4.0), 0.5)[0].magnification)
    2.0
    """
    power = constant("part", part, "A ramp begins at nothing.", may_be_zero=True)
    return tuple(eqx.tree_at(lambda f: f.magnification, f, f.magnification ** power.astype(f.magnification.dtype)) for f in several(foci))


def _hats(nodes: Array, n: int, spacing: Array, origin: Array) -> Array:
    """(n_nodes, n) weights of the pixels along one axis for each node, which sum to 1."""
    pixels = origin.astype(nodes.dtype) + spacing.astype(nodes.dtype) * jnp.arange(n, dtype=nodes.dtype)
    # Where the pixels are coarser than the cells, the hat spans a pixel, which makes it the bilinear interpolation.
    reach = jnp.maximum(nodes[1] - nodes[0], spacing.astype(nodes.dtype))
    inside = jnp.minimum(jnp.maximum(nodes, pixels[0]), pixels[-1])
    weights = jnp.maximum(0, 1 - jnp.abs(inside[:, None] - pixels[None, :]) / reach)
    return weights / jnp.sum(weights, axis=1, keepdims=True)


def _magnification(value: Array | float) -> Array:
    return constant("magnification", value, "A magnification of 0 shrinks its focus to a point, a negative one mirrors it.")


def _rim(value: Array | float) -> Array:
    return constant("rim", value, "Without a rim the magnification jumps, and so does the derivative by the radius.")


__all__ = ["Disc", "Extent", "Focus", "Importance", "Polygon", "combined", "faded", "ramped", "several"]
