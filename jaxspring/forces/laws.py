"""The physics of one spring: a pull along `d`, head minus tail.

    pull on the tail   p = w(r^2; k, l) d            [N]     r = |d|
    stiffness block    w (I - u u') + (w + s) u u'   [N/m]   u = d / r,  s = r dw/dr

A law gives the weight `w` and the slope `s`; `spring_pull` makes a force of them whose tangent brings its own transpose, since
a spring's block is symmetric. Zero length with a rest length has no direction: the pull is 0 there and the block is taken as k I.

Source: slide "Force Computation", with the length written |r| - l; blocks as in Baraff and Witkin (1998), section 4.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import filled, linear_call, tiny
from ..vector import Vector
from .linearisation import Linearisation


class Law(eqx.Module):
    """Constitutive law of one spring. Abstract. All arguments of the methods broadcast against each other.

    Attributes:
        is_finite_at_zero: whether weight, energy and their derivatives are finite at length zero, and the weight is zero where the
            stiffness is, so that it need not be masked where there is no spring (class attribute).
    """

    is_finite_at_zero: ClassVar[bool] = False

    @property
    def needs_no_mask(self) -> bool:
        """Whether `is_finite_at_zero` is said of the weight that the law has: by the class that defines it, or one below. A subclass of
        `Hooke` with another weight says it anew, or is masked.
        """
        of_weight, of_flag = (next(c for c in type(self).__mro__ if name in vars(c)) for name in ("weight", "is_finite_at_zero"))
        return self.is_finite_at_zero and issubclass(of_flag, of_weight)

    @abc.abstractmethod
    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Pull per unit of difference [N/m]; the pull is this times `d`."""

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array | None:
        """Energy of the spring [J]. A law without one leaves this out."""
        return None

    @property
    def has_energy(self) -> bool:
        """Whether it gives an `energy`."""
        return type(self).energy is not Law.energy

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Length times the derivative of the weight by the length [N/m]."""
        _, tangent = jax.jvp(lambda r2: self.weight(r2, stiffness, rest_length), (squared_length,), (2 * squared_length,))
        return tangent


class Hooke(Law):
    """Linear law: the pull is k (r - l). Odd under stretch and squeeze; the block is indefinite when squeezed."""

    is_finite_at_zero: ClassVar[bool] = True

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Weight k (1 - l / r) [N/m]."""
        # One rsqrt, guarded by a maximum: as fast as no guard. The derivative rule treats length zero.
        return stiffness * (1 - rest_length * inverse_length(squared_length))

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Slope k l / r [N/m]."""
        return stiffness * (rest_length * inverse_length(squared_length))

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """k/2 (r - l)^2 [J]."""
        stretch = length_of(squared_length) - rest_length
        return 0.5 * stiffness * stretch * stretch


class TensionOnly(Law):
    """Hooke's law when stretched, nothing when squeezed: a rope."""

    is_finite_at_zero: ClassVar[bool] = True

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Weight k max(0, 1 - l / r) [N/m]."""
        return stiffness * jnp.maximum(1 - rest_length * inverse_length(squared_length), jnp.zeros((), squared_length.dtype))

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """k/2 max(0, r - l)^2 [J]."""
        stretch = jnp.maximum(length_of(squared_length) - rest_length, jnp.zeros((), squared_length.dtype))
        return 0.5 * stiffness * stretch * stretch


class PowerLaw(Law):
    """Pull k l (|r - l| / l)^n with the sign of r - l: stiffens (n > 1) with stretch. Needs rest lengths above zero.

    Attributes:
        exponent: n, at least 1 (1 is Hooke's law).
    """

    is_finite_at_zero: ClassVar[bool] = True

    exponent: float = eqx.field(static=True, default=3.0)

    def __check_init__(self) -> None:
        if self.exponent < 1:
            raise ValueError(f"exponent = {self.exponent}; expected 1 or more: below 1 the stiffness is infinite at rest.")

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Weight k l sign(e) |e / l|^n / r [N/m]."""
        strain = length_of(squared_length) / rest_length - 1
        # In this order no product leaves the range of float32 before the weight itself does.
        growth = stiffness * (jnp.sign(strain) * _power(jnp.abs(strain), self.exponent))
        return growth * (rest_length * inverse_length(squared_length))

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Derivative of the pull, n k |e / l|^(n-1), less the weight [N/m]."""
        weight = self.weight(squared_length, stiffness, rest_length)
        if self.exponent == 1:
            return stiffness - weight
        strain = length_of(squared_length) / rest_length - 1
        return stiffness * self.exponent * _power(jnp.abs(strain), self.exponent - 1) - weight

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Energy k l^2 |e / l|^(n+1) / (n+1) [J]."""
        strain = length_of(squared_length) / rest_length - 1
        return stiffness * _power(jnp.abs(strain), self.exponent + 1) * rest_length * rest_length / (self.exponent + 1)


class EnergyLaw(Law):
    """A law given by the energy of one spring as a function of its length.

    Attributes:
        function: (length [m], stiffness, rest_length) -> energy [J], elementwise and differentiable in the length.

    >>> law = EnergyLaw(lambda r, k, l: 0.5 * k * (r - l) ** 2)
    """

    function: Callable[[Array, Array, Array], Array]

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Derivative of the energy by the length, over the length [N/m]."""
        return self._pull(length_of(squared_length), stiffness, rest_length) * inverse_length(squared_length)

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Second derivative of the energy by the length, less the weight [N/m]."""
        return _slope_of(self._pull, squared_length, stiffness, rest_length)

    def _pull(self, length: Array, stiffness: Array, rest_length: Array) -> Array:
        return jax.jvp(lambda r: self.function(r, stiffness, rest_length), (length,), (jnp.ones_like(length),))[1]

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """The user's function."""
        return self.function(length_of(squared_length), stiffness, rest_length)


class PullLaw(Law):
    """A law given by the pull of one spring as a function of its length; it has no energy.

    Attributes:
        function: (length [m], stiffness, rest_length) -> pull [N], positive when the ends are drawn together.
    """

    function: Callable[[Array, Array, Array], Array]

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """The user's pull over the length [N/m]."""
        return self.function(length_of(squared_length), stiffness, rest_length) * inverse_length(squared_length)

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Derivative of the pull by the length, less the weight [N/m]."""
        return _slope_of(self.function, squared_length, stiffness, rest_length)


@eqx.filter_custom_jvp
def spring_pull(law: Law, d: Vector, stiffness: Array, rest_length: Array) -> Vector:
    """Pull of each spring on its tail [N]; d, stiffness and rest_length of one family."""
    return law.weight(d.dot(d), stiffness, rest_length) * d


@spring_pull.def_jvp
def _spring_pull_jvp(primals: Any, tangents: Any) -> tuple[Vector, Vector]:
    law, d, stiffness, rest_length = primals
    pull = spring_pull(law, d, stiffness, rest_length)
    params, static = eqx.partition(law, eqx.is_inexact_array)
    moving = (tangents[1], tangents[2], tangents[3], tangents[0])
    residuals = (d, stiffness, rest_length, params)
    return pull, linear_call(partial(_tangent, static), partial(_tangent_transpose, static), residuals, filled(moving, residuals))


def _tangent(static: Any, residuals: Any, operand: Any) -> Vector:
    """Tangent dp = w dd + s u (u . dd) + (w_k dk + w_l dl + ...) d."""
    d, stiffness, rest_length, params = residuals
    dd, *constants = operand
    squared, is_long = _guarded(d)
    weight, slope = _linearised(eqx.combine(params, static), squared, is_long, stiffness, rest_length)
    inverse = inverse_length(squared)
    of_constants = partial(_weight, static, squared)
    _, by_constants = jax.jvp(of_constants, (stiffness, rest_length, params), tuple(constants))
    along = slope * (d.dot(dd) * inverse) * inverse + by_constants
    return weight * dd + along * d


def _tangent_transpose(static: Any, residuals: Any, q: Vector) -> Any:
    """The same block on q, as it is symmetric; and the products with the derivatives of the weight."""
    d, stiffness, rest_length, params = residuals
    squared, is_long = _guarded(d)
    weight, slope = _linearised(eqx.combine(params, static), squared, is_long, stiffness, rest_length)
    # As in the laws, so that XLA computes it once.
    inverse = inverse_length(squared)
    # A division, so that XLA keeps it as an array of its own instead of computing it anew in each of its five readers.
    length = lax.sqrt(squared)
    along = d.dot(q) / length
    _, pullback = jax.vjp(partial(_weight, static, squared), stiffness, rest_length, params)
    dk, dl, dparams = pullback(along * length)
    return weight * q + (slope * along * inverse) * d, dk, dl, dparams


def _weight(static: Any, squared: Array, stiffness: Array, rest_length: Array, params: Any) -> Array:
    return eqx.combine(params, static).weight(squared, stiffness, rest_length)


def _guarded(d: Vector) -> tuple[Array, Array]:
    """Squared length, 1 where there is none; and where there is one. Before the law, not only after it: at length zero a derivative of
    what follows is then zero, and not infinity times zero.
    """
    squared = d.dot(d)
    is_long = squared > tiny(squared.dtype)
    return jnp.where(is_long, squared, jnp.ones_like(squared)), is_long


def _linearised(law: Law, squared: Array, is_long: Array, stiffness: Array, rest_length: Array) -> tuple[Array, Array]:
    """Weight and slope for the derivative; a spring of no length is taken as k I."""
    weight = jnp.where(is_long, law.weight(squared, stiffness, rest_length), stiffness)
    slope = jnp.where(is_long, law.slope(squared, stiffness, rest_length), jnp.zeros((), squared.dtype))
    return weight, slope


def spring_block(
    law: Law, linearisation: Linearisation, d: Vector, stiffness: Array, rest_length: Array
) -> tuple[Array, Array | None, Vector]:
    """Weight and slope [N/m] of each spring's block, and its direction. A spring of no length has the block k I and no direction."""
    squared, is_long = _guarded(d)
    weight, slope = _linearised(law, squared, is_long, stiffness, rest_length)
    u = jnp.where(is_long, lax.rsqrt(squared), jnp.zeros_like(squared)) * d
    return *linearisation.block(jnp.broadcast_to(weight, d.shape), jnp.broadcast_to(slope, d.shape)), u


@eqx.filter_custom_jvp
def spring_energy(law: Law, d: Vector, stiffness: Array, rest_length: Array) -> Array:
    """Energy of each spring [J]; its derivative by `d` is the pull, guarded alike."""
    energy = law.energy(d.dot(d), stiffness, rest_length)
    if energy is None:
        raise TypeError(f"{type(law).__name__}.energy gives None. A law without an energy leaves the method out.")
    return energy


@spring_energy.def_jvp
def _spring_energy_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    law, d, stiffness, rest_length = primals
    energy = law.energy(d.dot(d), stiffness, rest_length)
    total = jnp.zeros_like(energy)
    if tangents[1] is not None and any(t is not None for t in tangents[1]):
        dd = Vector(tuple(jnp.zeros_like(p) if t is None else t for t, p in zip(tangents[1], d, strict=True)))
        total = total + spring_pull(law, d, stiffness, rest_length).dot(dd)
    for i in (2, 3):
        if tangents[i] is not None:

            def vary(value: Array, i: int = i) -> Array:
                return law.energy(d.dot(d), *(value if j == i else primals[j] for j in (2, 3)))

            total = total + jax.jvp(vary, (primals[i],), (tangents[i],))[1]
    if jax.tree.leaves(tangents[0]):
        params, static = eqx.partition(law, eqx.is_inexact_array)
        moved = filled(tangents[0], params)

        def vary_law(params: Any) -> Array:
            return eqx.combine(params, static).energy(d.dot(d), stiffness, rest_length)

        total = total + jax.jvp(vary_law, (params,), (moved,))[1]
    return energy, total


def inverse_length(squared: Array) -> Array:
    """One over the root of a squared length; large and finite where there is none."""
    return lax.rsqrt(jnp.maximum(squared, tiny(squared.dtype)))


def length_of(squared: Array) -> Array:
    """The root of a squared length, with derivative zero where there is none; NaN where the square has overflowed."""
    return squared * inverse_length(squared)


def _slope_of(pull: Callable[..., Array], squared: Array, stiffness: Array, rest_length: Array) -> Array:
    """By the length and not by its square, since cubes of lengths would come in, and leave the range of float32."""
    length = length_of(squared)
    value, rate = jax.jvp(lambda r: pull(r, stiffness, rest_length), (length,), (jnp.ones_like(length),))
    return rate - value * inverse_length(squared)


def _power(base: Array, exponent: float) -> Array:
    """base**exponent for base >= 0, exponent >= 1, with a finite derivative at zero."""
    is_zero = base == 0
    return jnp.where(is_zero, 0, jnp.where(is_zero, 1, base) ** jnp.asarray(exponent, base.dtype)).astype(base.dtype)
