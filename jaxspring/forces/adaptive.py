"""Adaptive meshes: springs whose stiffness follows the image.

    a_d  = G_sigma * |grad d|, scaled to [0, 1]      adaptation function (another observation may take the gradient's place)
    O_i  = a_d(x_i, y_i)                             observation at the node, where it is now
    a_ij = (O_i + O_j) / 2
    k_ij = (1 - a_ij) k_min + a_ij k_max             [N/m]

Stiff springs draw together, so nodes gather where the image varies. The stiffness depends on position, so the force has no potential
and its Jacobian is not symmetric.

Source: slide "Adaptive Meshes". Its last line is damaged; this is its best-supported reading. The scaling to [0, 1] is not on the
slide: without it a raw gradient throws k far above k_max.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from .._arrays import Numbers, given
from .._checks import as_inexact, has_shape, is_concrete, nonnegative
from ..images.image import Image
from ..images.observation import GradientMagnitude, adaptation
from ..images.sampling import Bilinear
from ..images.surface import Surface
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from .base import any_not_positive, any_refused
from .springs import StiffnessRule


class ImageStiffness(StiffnessRule):
    """Stiffness between `k_min` and `k_max`, following an image under the nodes.

    Attributes:
        image: the data d(x, y).
        k_min: stiffness where there is nothing to see [N/m].
        k_max: stiffness where there is most to see [N/m].
        sigma: standard deviation of the Gaussian, in the image's unit of length.
        observation: what is looked at: `GradientMagnitude()`, `Curvature()`, or any function of the image.
        sampling: how the adaptation is read between pixels.
        radius: half width of the Gaussian in pixels; needed where sigma is traced (see `smoothing_radius`).
        adapted: the adaptation function, once prepared.

    Raises:
        ValueError: a negative constant, or k_min above k_max.

    >>> import numpy as np
    >>> rule = ImageStiffness(Image(np.eye(8)), k_min=1.0, k_max=10.0, sigma=1.0)
    """

    image: Image
    k_min: Array
    k_max: Array
    sigma: Array
    observation: Callable[[Image], Array]
    sampling: Any
    radius: int | None = eqx.field(static=True)
    adapted: Surface | None

    def __init__(
        self,
        image: Image,
        k_min: Numbers,
        k_max: Numbers,
        sigma: Numbers,
        observation: Callable[[Image], Array] | None = None,
        sampling: Any = None,
        radius: int | None = None,
    ):
        self.image = image
        self.k_min, self.k_max, self.sigma = (as_inexact(n, v) for n, v in (("k_min", k_min), ("k_max", k_max), ("sigma", sigma)))
        for name, value in (("k_min", self.k_min), ("k_max", self.k_max), ("sigma", self.sigma)):
            has_shape(name, value, {"one number": ()})
            nonnegative(name, value, "Neither a stiffness nor a width can be negative.")
        if is_concrete(self.k_min) and is_concrete(self.k_max) and np.asarray(self.k_min) > np.asarray(self.k_max):
            raise ValueError(f"k_min = {self.k_min} is above k_max = {self.k_max}. Swap them.")
        self.observation = GradientMagnitude() if observation is None else observation
        self.sampling = Bilinear() if sampling is None else sampling
        # Of what was passed: inside `jit` a number is a constant still, but no longer once it is an array.
        width = given("sigma", sigma)
        if radius is None and is_concrete(width) and all(map(is_concrete, image.spacing)):
            from ..images.smoothing import smoothing_radius

            radius = smoothing_radius(float(width), (float(image.spacing[0]), float(image.spacing[1])))
        self.radius = radius
        self.adapted = None

    def adaptation(self) -> Image:
        """The adaptation function a_d, an image with values in [0, 1]."""
        return adaptation(self.image, self.sigma, self.observation, radius=self.radius)

    def follows(self) -> dict[str, tuple[str, ...]]:
        """Which fields are made anew where another is replaced by a number: the filter's width follows sigma."""
        return {"sigma": ("radius",)}

    def bind(self, net: Topology, dtype: DTypeLike) -> ImageStiffness:
        """The rule with its adaptation function made: once before a loop, not in every step."""
        ready = self.adaptation().surface(self.sampling) if self.adapted is None else self.adapted
        return cast_inexact(eqx.tree_at(lambda r: r.adapted, self, ready, is_leaf=lambda leaf: leaf is None), dtype)

    def stiffness(self, net: Topology, state: State) -> EdgeField:
        """k_ij at the nodes' present positions [N/m]."""
        surface = self.adaptation().surface(self.sampling) if self.adapted is None else self.adapted
        observed = surface.value(state.position[0], state.position[1])
        low, high = self.k_min.astype(observed.dtype), self.k_max.astype(observed.dtype)
        return net.average(observed).map(lambda a: (1 - a) * low + a * high)

    def upper_bound(self) -> Array:
        """k_max [N/m]."""
        return self.k_max

    def invalid(self) -> Array:
        """Whether a constant is negative or not finite, k_min is above k_max, or the image's spacing is not positive."""
        return any_refused(self.k_min, self.k_max, self.sigma) | (self.k_min > self.k_max) | any_not_positive(self.image.spacing)


__all__ = ["ImageStiffness"]
