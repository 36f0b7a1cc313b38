"""What stands for the stiffness of a spring in a matrix: its tangent, made safe; its exact tangent; or the slides' secant.

    Tangent        w -> max(w, 0), w + s -> max(w + s, 0)     positive semi-definite, the same force; for steps and search directions
    ExactTangent   w, s                                       the Hessian of the energy, indefinite where a spring is squeezed
    Secant         w, 0                                       one number per spring, x, y and z apart: the matrix of the slides

with the block w I + s u u' of one spring. At rest the secant form has w = 0: a step with it is as conditionally stable as an explicit
one (omega dt < 2).

Source: slide "Implicit Solution" for the secant form; the clamped tangent as in Choi and Ko (2002).
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array


class Linearisation(eqx.Module):
    """How the block of one spring is taken. Abstract: `Tangent`, `ExactTangent` and `Secant` are final."""

    @abc.abstractmethod
    def block(self, weight: Array, slope: Array) -> tuple[Array, Array | None]:
        """Weight and slope [N/m] to be used; a slope of None decouples the coordinates."""


class Tangent(Linearisation):
    """The tangent stiffness with its negative part left out: positive semi-definite. The default."""

    def block(self, weight: Array, slope: Array) -> tuple[Array, Array]:
        """Both eigenvalues of the block, clamped at zero."""
        sideways = jnp.maximum(weight, jnp.zeros_like(weight))
        along = jnp.maximum(weight + slope, jnp.zeros_like(weight))
        return sideways, along - sideways


class ExactTangent(Linearisation):
    """The tangent stiffness as it is."""

    def block(self, weight: Array, slope: Array) -> tuple[Array, Array]:
        """Weight and slope as they are."""
        return weight, slope


class Secant(Linearisation):
    """The slides' matrix: the weights k (1 - l / r) alone. Equal to the tangent only where rest lengths are zero."""

    def block(self, weight: Array, slope: Array) -> tuple[Array, None]:
        """The weight alone."""
        return weight, None


__all__ = ["ExactTangent", "Linearisation", "Secant", "Tangent"]
