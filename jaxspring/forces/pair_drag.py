"""Drag between particles: what they lose of their approach, momentum and angular momentum stay.

    f_i = -c(r) ((v_i - v_j) . u) u        c(r) = eta (1 - r/R)**2 below R, 0 beyond        [N]

u is the unit vector between the two. The force acts along the line of the pair and is opposite for the other end.

Source: the dissipative force of dissipative particle dynamics; the slides' fluid has no dissipation of its own.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant
from .base import any_not_positive, any_refused


class PairDrag(eqx.Module):
    """Drag along the line of each pair that is near.

    Attributes:
        damping: eta [N s/m].
        radius: R [m]; beyond it there is no drag.
    """

    damping: Array
    radius: Array

    def __init__(self, damping: Numbers, radius: Numbers):
        self.damping = constant("damping", damping, "A negative drag feeds energy in.", may_be_zero=True)
        self.radius = constant("radius", radius, "No pair would be within it: pass drag=None for no drag.")

    def rate(self, squared: Array) -> Array:
        """Coefficient c(r) [N s/m] of a squared distance [m^2]."""
        near = jnp.maximum(1 - jnp.sqrt(squared) / self.radius, jnp.zeros((), squared.dtype))
        return self.damping * near * near

    def invalid(self) -> Array:
        """Whether eta is negative, or R not positive, or one of them not finite."""
        return any_refused(self.damping) | any_not_positive(self.radius)
