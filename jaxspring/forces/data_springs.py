"""Data springs: the image pulls the mesh.

    DataSprings       f_i = (0, 0, k_data (d(x_i, y_i) - z_i))     the slides' law: z toward the image value under the node   [N]
    ImageAttraction   f_i = strength grad d(x_i, y_i)              the image as a potential, -strength d                      [N]

The slide prints the first as a norm; its code (`force.z += IMAGE_CONST * (val - p.z)`) is what is meant. That law pulls z alone, so its
Jacobian is not symmetric where the image has a slope, and it has no potential. `conservative=True` adds the missing in-plane part,
-k e grad d with e = d - z, which makes it the gradient of k/2 e^2.

Where the image has weights w, read between its pixels as the image is, the stiffness is k_data w(x_i, y_i): over a hole nothing pulls.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, node_values, nonnegative
from ..images.image import Image, without_holes
from ..images.sampling import Bilinear, Sampling
from ..images.surface import Surface
from ..linalg.operators import Blocks, NodeDyads
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag
from ..vector import Vector
from .base import Finding, Force, Scene, any_not_positive, any_refused
from .linearisation import Linearisation


class DataSprings(Force):
    """A spring from every node to the image surface above or below it, along z.

    Attributes:
        image: the data d(x, y); its values have the unit of z [m]. Its weights multiply the stiffness.
        stiffness: k_data [N/m], one number, or (N,) in the user's order; on a lattice also its shape.
        sampling: how the image is read between pixels.
        conservative: add the in-plane part that makes the force the gradient of an energy.

    Raises:
        ValueError: a negative stiffness; conservative, with an image that has weights.
    """

    image: Image | Surface
    stiffness: Array
    sampling: Any
    conservative: bool = eqx.field(static=True)

    def __init__(self, image: Image, stiffness: Numbers, sampling: Sampling | None = None, conservative: bool = False):
        why = "the energy of a conservative spring would fall over a hole, whatever the heights, and push nodes there."
        self.image = without_holes("image", image, why) if conservative and isinstance(image, Image) else image
        self.stiffness = node_values("stiffness", stiffness)
        self.sampling = Bilinear() if sampling is None else sampling
        self.conservative = conservative
        nonnegative("stiffness", self.stiffness, "A negative data spring pushes away from the image.")

    def bind(self, scene: Scene) -> DataSprings:
        """The image ready to be read."""
        return _ready(self, scene.dtype)

    @property
    def has_potential(self) -> bool:
        """Whether it is conservative."""
        return self.conservative

    def force(self, state: State) -> Vector:
        """Pull toward the image [N]."""
        x, y, z = _coordinates(state)
        k = self._stiffness(state)
        if not self.conservative:
            zero = jnp.zeros_like(z)
            return Vector((zero, zero, k * (_surface(self).value(x, y) - z)))
        value, dx, dy = _surface(self).value_and_gradient(x, y)
        pull = k * (value - z)
        return Vector((-pull * dx, -pull * dy, pull))

    def energy(self, state: State) -> Array | None:
        """k/2 (d - z)^2, summed [J], where conservative; else None."""
        if not self.conservative:
            return None
        x, y, z = _coordinates(state)
        error = _surface(self).value(x, y) - z
        return jnp.sum(0.5 * self._stiffness(state) * error * error)

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """Blocks k on z [N/m]; where conservative k g g' with g = grad (d - z). The image's slope (its curvature) is left out."""
        k = self._stiffness(state).astype(state.dtype)
        x, y, z = _coordinates(state)
        if self.conservative:
            _, dx, dy = _surface(self).value_and_gradient(x, y)
            return Blocks(dyads=(NodeDyads(jnp.broadcast_to(k, z.shape), Vector((dx, dy, -jnp.ones_like(z)))),))
        zero = jnp.zeros_like(z)
        return Blocks((Vector((zero, zero, jnp.broadcast_to(k, z.shape))),))

    def stiffness_bound(self, state: State) -> Array:
        """k, or k (1 + |grad d|^2) where conservative [N/m]."""
        # The z-only law is triangular, with eigenvalues 0 and k. The conservative one is about k n n' with n = (-grad d, 1).
        if not self.conservative:
            return self._stiffness(state).astype(state.dtype)
        _, dx, dy = _surface(self).value_and_gradient(*_coordinates(state)[:2])
        return self._stiffness(state).astype(state.dtype) * (1 + dx * dx + dy * dy)

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """OUTSIDE: nodes beyond the image's border."""
        return _outside(_surface(self), state)

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the distance of two pixels."""
        return _rounding(_surface(self), state)

    def invalid(self) -> Array:
        """Whether the stiffness or a weight is negative or not finite, or the image's spacing not positive."""
        cover = _surface(self).cover
        refused = any_refused(self.stiffness) if cover is None else any_refused(self.stiffness, cover.coefficients)
        return refused | any_not_positive(self.image.spacing)

    def _stiffness(self, state: State) -> Array:
        stiffness, cover = state.layout.constant("stiffness", self.stiffness), _surface(self).cover
        return stiffness if cover is None else stiffness * cover.value(state.position[0], state.position[1])


class ImageAttraction(Force):
    """Nodes are drawn to where the image is bright: the image is a potential.

    Attributes:
        image: d(x, y).
        strength: [J per unit of the image]; negative draws to the dark.
        sampling: how the image is read between pixels; the cubic spline has a continuous force.

    Raises:
        ValueError: a strength that is not finite; an image with weights.
    """

    image: Image | Surface
    strength: Array
    sampling: Any

    def __init__(self, image: Image, strength: Numbers, sampling: Sampling | None = None):
        self.image = without_holes("image", image, "a potential must be known everywhere.") if isinstance(image, Image) else image
        self.strength = as_inexact("strength", strength)
        has_shape("strength", self.strength, {"one number": ()})
        finite("strength", self.strength)
        self.sampling = Bilinear() if sampling is None else sampling

    def bind(self, scene: Scene) -> ImageAttraction:
        """The image ready to be read."""
        return _ready(self, scene.dtype)

    def force(self, state: State) -> Vector:
        """Strength grad d [N]; no force along z."""
        _, dx, dy = _surface(self).value_and_gradient(state.position[0], state.position[1])
        rest = tuple(jnp.zeros_like(dx) for _ in range(state.dim - 2))
        return Vector((self.strength * dx, self.strength * dy, *rest))

    def energy(self, state: State) -> Array:
        """-strength d, summed [J]."""
        return -jnp.sum(self.strength * _surface(self).value(state.position[0], state.position[1]))

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the distance of two pixels."""
        return _rounding(_surface(self), state)

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """OUTSIDE: nodes beyond the image's border."""
        return _outside(_surface(self), state)

    def invalid(self) -> Array:
        """Whether the strength is not finite, or the image's spacing not positive."""
        return ~jnp.all(jnp.isfinite(self.strength)) | any_not_positive(self.image.spacing)


def _surface(effect: DataSprings | ImageAttraction) -> Surface:
    return effect.image.surface(effect.sampling) if isinstance(effect.image, Image) else effect.image


def _ready(effect: Any, dtype: Any) -> Any:
    """The effect with its image ready to be read: a spline is filtered once, not in every step."""
    return cast_inexact(eqx.tree_at(lambda e: e.image, effect, _surface(effect)), dtype)


def _coordinates(state: State) -> tuple[Array, Array, Array]:
    if state.dim != 3:
        raise ValueError(f"DataSprings act along z and need positions of 3 coordinates; these have {state.dim}.")
    return state.position.x, state.position.y, state.position.z


def _outside(image: Surface, state: State) -> tuple[Finding, ...]:
    beyond = image.outside(state.position[0], state.position[1])
    node = jnp.argmax(jnp.ravel(beyond)).astype(jnp.int32)
    return (Finding(Flag.OUTSIDE, jnp.sum(beyond).astype(jnp.int32), node),)


def _rounding(image: Surface, state: State) -> Array:
    eps = jnp.asarray(jnp.finfo(state.dtype).eps, state.dtype)
    errors = [jnp.max(jnp.abs(state.position[i])) * eps / image.spacing[i].astype(state.dtype) for i in range(2)]
    return jnp.maximum(errors[0], errors[1])
