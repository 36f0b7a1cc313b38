"""Cut-offs of a pair law: what is left of it beyond a radius, and what is done so that it ends there.

With F = w r the law's force, U its potential, and c the radius:

    plain           F                         potential U - U(c)                       the force jumps at c
    shifted force   F - F(c)                  potential U - U(c) + F(c) (r - c)        the force ends at zero; the equilibrium moves
    switched        F S - (U - U(c)) S'       potential (U - U(c)) S(r)                S falls from 1 to 0 between r_on and c; r_0 stays

Every potential is continuous and zero at c and beyond, so that its gradient is minus the force. What a cut-off leaves out is not small for
the slides' law, whose force falls as 1/r only: see `docs/fluid.md`.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant, is_concrete
from .base import any_not_positive
from .pair_laws import PairLaw

# Why a radius of a switch is refused.
NOTHING_LEFT = "A switch fades between two distances above zero."


class Cutoff(eqx.Module):
    """How a law ends. Abstract."""

    @property
    @abc.abstractmethod
    def reach(self) -> Array | None:
        """Distance [m] from which on there is no force; None where the law has no end."""

    @abc.abstractmethod
    def weight(self, law: PairLaw, squared: Array) -> Array:
        """The law's weight, cut off."""

    @abc.abstractmethod
    def potential(self, law: PairLaw, squared: Array) -> Array:
        """The law's potential, cut off."""

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse."""
        return None


class NoCutoff(Cutoff):
    """The law as it is, at every distance."""

    @property
    def reach(self) -> None:
        """No distance: the law has no end."""
        return None

    def weight(self, law: PairLaw, squared: Array) -> Array:
        """The law's own."""
        return law.weight(squared)

    def potential(self, law: PairLaw, squared: Array) -> Array:
        """The law's own."""
        return law.potential(squared)


class _AtRadius(Cutoff):
    """What ends at a radius."""

    radius: Array

    def __init__(self, radius: Any):
        self.radius = constant("radius", radius, "No pair would be within it.")

    @property
    def reach(self) -> Array:
        """The radius [m]."""
        return self.radius

    def invalid(self) -> Array:
        """Whether the radius is not positive or not finite."""
        return any_not_positive(self.radius)


class PlainCutoff(_AtRadius):
    """The law up to a radius, nothing beyond: the force jumps there, and energy is kept less well.

    Attributes:
        radius: [m].
    """

    __init__ = _AtRadius.__init__  # said again for type checkers, which would make one of the fields

    def weight(self, law: PairLaw, squared: Array) -> Array:
        """The law's w below the radius, zero from it on."""
        return _below(squared, self.radius, law.weight(squared))

    def potential(self, law: PairLaw, squared: Array) -> Array:
        """The law's U - U(c) below the radius, zero from it on."""
        return _below(squared, self.radius, law.potential(squared) - law.potential(self.radius**2))


class ShiftedForce(_AtRadius):
    """The law less its force at the radius, so that the force ends at zero without a jump.

    The radius must lie beyond the distance at which the attraction is strongest, else no attraction is left: for the slides' law with
    zeta = 0 beyond sqrt(3 beta / alpha), for its unit-vector form beyond sqrt(2 beta / alpha).

    Attributes:
        radius: [m].
    """

    __init__ = _AtRadius.__init__  # said again for type checkers, which would make one of the fields

    def weight(self, law: PairLaw, squared: Array) -> Array:
        """The law's w - F(c) / r below the radius, zero from it on."""
        end = law.weight(self.radius**2) * self.radius
        return _below(squared, self.radius, law.weight(squared) - end * jnp.sqrt(1 / squared))

    def potential(self, law: PairLaw, squared: Array) -> Array:
        """The law's U - U(c) + F(c) (r - c) below the radius, zero from it on."""
        end = law.weight(self.radius**2) * self.radius
        shifted = law.potential(squared) - law.potential(self.radius**2) + end * (jnp.sqrt(squared) - self.radius)
        return _below(squared, self.radius, shifted)


class Switched(Cutoff):
    """The law untouched up to `on`, then its potential faded out by a polynomial with two continuous derivatives up to `off`.

    Attributes:
        on: [m]; choose it beyond the equilibrium distance, which then stays.
        off: [m], above `on`.
    """

    on: Array
    off: Array

    def __init__(self, on: Numbers, off: Numbers):
        self.on, self.off = constant("on", on, NOTHING_LEFT), constant("off", off, NOTHING_LEFT)
        if is_concrete(self.on) and is_concrete(self.off) and not np.asarray(self.on) < np.asarray(self.off):
            raise ValueError(f"on = {self.on} is not below off = {self.off}: the force would be switched off before it begins to fade.")

    @property
    def reach(self) -> Array:
        """The radius `off` [m]."""
        return self.off

    def weight(self, law: PairLaw, squared: Array) -> Array:
        """Faded weight: w S - (U - U(c)) S' / r below `off`, zero from it on."""
        r = jnp.sqrt(squared)
        s = self._fraction(r)
        switch = 1 - s * s * s * (10 - s * (15 - 6 * s))
        slope = -30 * s * s * (1 - s) * (1 - s) / (self.off - self.on)
        cut = law.potential(squared) - law.potential(self.off**2)
        return _below(squared, self.off, law.weight(squared) * switch - cut * slope / r)

    def potential(self, law: PairLaw, squared: Array) -> Array:
        """Faded potential: (U - U(c)) S below `off`, zero from it on."""
        s = self._fraction(jnp.sqrt(squared))
        switch = 1 - s * s * s * (10 - s * (15 - 6 * s))
        return _below(squared, self.off, (law.potential(squared) - law.potential(self.off**2)) * switch)

    def invalid(self) -> Array:
        """Whether a radius is not positive or not finite, or `on` is not below `off`."""
        return any_not_positive(self.on, self.off) | ~(self.on < self.off)

    def _fraction(self, r: Array) -> Array:
        one = jnp.ones((), r.dtype)
        return jnp.clip((r - self.on) / (self.off - self.on), jnp.zeros((), r.dtype), one)


def _below(squared: Array, radius: Array, value: Array) -> Array:
    return jnp.where(squared < radius * radius, value, jnp.zeros((), value.dtype))
