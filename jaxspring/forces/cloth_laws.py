"""Laws of one spring for cloth: a strain limit with a gradient, and a thread that buckles.

    Stiffening   pull = k (r - l) + (factor - 1) k l q(e - strain)      e = (r - l) / l
                 q(z) = 0  (z < 0),   z^2 / (2 band)  (z < band),   z - band / 2  (above)
    ChoiKo       pull = max(f_b, c_b (r - L)) for r < L, 0 above       f_b = 2 k_b q'(r / L) / L^2
                                                                   q: sin(sqrt q) / sqrt q = r / L

The first has the stiffness k up to the limit, and `factor` times as much beyond strain + band: Provot's limit as a force, which keeps
momentum and energy. The second is a thread of bending stiffness k_b bent to an arc of curvature kappa = 2 sqrt(q) / L, whose energy is
k_b kappa^2 L / 2 = 2 k_b q / L; near its rest length, where the arc would push at once with 12 k_b / L^2, it is a stiff spring.

Source: Provot (1995), "Deformation Constraints in a Mass-Spring Model to Describe Rigid Cloth Behavior"; Choi and Ko (2002), "Stable but
Responsive Cloth", whose f_b = k_b kappa^2 / (cos(kappa L / 2) - sinc(kappa L / 2)) is the same, written by q = (kappa L / 2)^2.
"""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from numpy.polynomial import Chebyshev, Polynomial

from .._arrays import Numbers
from .._checks import constant
from .laws import Law, inverse_length, length_of
from .ramp import ramp, ramp_energy, ramp_slope

# The share r / L where the arc's force over the linear one is least: the two cross at most once on either side of it.
_NARROWEST = 0.2794853
# Minus the least value of sin(y) / y, and a degree that is enough for 1e-13.
_LEAST, _DEGREE = 0.21723362821122166, 16
_HALVINGS = 30


class Stiffening(Law):
    """Hooke's law up to a strain, and a stiffness `factor` times as large beyond: a strain limit that has a gradient and an energy.

    Attributes:
        strain: at which it sets in, stretched (squeezed springs keep k).
        factor: stiffness beyond, over k.
        band: further strain over which it grows.

    Raises:
        ValueError: a negative strain, a factor or band that is not above zero, an array in the place of a number.

    >>> law = js.cloth.Stiffening(strain=0.1, factor=50.0, band=0.02)
    >>> net = js.lattice(2)
    >>> springs = js.Springs(net, 10.0, 1.0, law=law)
    >>> pull = springs.tension(js.State.from_points(net, [[0.0], [1.2]]))
    >>> print(f"{net.flatten(pull)[0]:.2f} N")
    46.10 N
    """

    is_finite_at_zero: ClassVar[bool] = True
    strain: Array
    factor: Array
    band: Array

    def __init__(self, strain: Numbers = 0.1, factor: Numbers = 100.0, band: Numbers = 0.02):
        self.strain = constant("strain", strain, "Springs would be stiff below their rest length.", may_be_zero=True)
        self.factor = constant("factor", factor, "The stiffness beyond the limit is this times k.")
        self.band = constant("band", band, "The stiffness grows over it; a sharp limit is the rule StrainLimit.")

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Pull over length [N/m]."""
        further = ramp(*self._beyond(squared_length, rest_length))
        inverse = inverse_length(squared_length)
        return stiffness * (1 - rest_length * inverse + (self.factor - 1) * further * inverse)

    def slope(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Derivative of the pull by the length, less the weight [N/m]."""
        share = ramp_slope(*self._beyond(squared_length, rest_length))
        return stiffness * (1 + (self.factor - 1) * share) - self.weight(squared_length, stiffness, rest_length)

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Energy of the spring [J]."""
        stretch = length_of(squared_length) - rest_length
        further = ramp_energy(*self._beyond(squared_length, rest_length))
        return stiffness * (0.5 * stretch * stretch + (self.factor - 1) * further)

    def _beyond(self, squared_length: Array, rest_length: Array) -> tuple[Array, Array]:
        """Length beyond the limit, and the length of the band [m]. A spring without rest length has no strain, and no limit."""
        beyond = length_of(squared_length) - rest_length * (1 + self.strain)
        return jnp.where(rest_length > 0, beyond, jnp.zeros_like(beyond)), self.band * rest_length


class ChoiKo(Law):
    """A thread that buckles when squeezed: for springs between second neighbours, whose stiffness is that of the straight thread, c_b.

    It does nothing when stretched: that is left to the springs between neighbours, `js.TensionOnly()` in the same source.

    Attributes:
        bending: k_b [N m^2], the bending stiffness of the thread.

    Raises:
        ValueError: a bending stiffness that is not above zero, an array in the place of a number.

    >>> net = js.lattice(2)
    >>> springs = js.Springs(net, 1000.0, 1.0, law=js.cloth.ChoiKo(bending=0.5))
    >>> pull = springs.tension(js.State.from_points(net, [[0.0], [0.8]]))
    >>> print(f"{net.flatten(pull)[0]:.2f} N")
    -6.84 N
    """

    is_finite_at_zero: ClassVar[bool] = True
    bending: Array

    def __init__(self, bending: Numbers):
        self.bending = constant("bending", bending, "A thread without bending stiffness does not push: leave the springs out.")

    def weight(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Pull over length [N/m]."""
        length = length_of(squared_length)
        safe = _safe(rest_length)
        arc = 2 * self.bending / (safe * safe) * arc_slope(jnp.clip(length / safe, 0, 1))
        straight = stiffness * jnp.minimum(length - rest_length, 0)
        return jnp.where(rest_length > 0, jnp.maximum(arc, straight), jnp.zeros_like(straight)) * inverse_length(squared_length)

    def energy(self, squared_length: Array, stiffness: Array, rest_length: Array) -> Array:
        """Energy of the spring [J]: straight, or straight until it buckles and then that of its arc."""
        safe = _safe(rest_length)
        share = jnp.clip(length_of(squared_length) / safe, 0, 1)
        first, last = (lax.stop_gradient(a) for a in _crossings(stiffness * safe * safe * safe / (4 * self.bending)))

        def straight(x: Array) -> Array:
            return 0.5 * stiffness * (safe * (1 - x)) ** 2

        def bent(x: Array) -> Array:
            return 2 * self.bending * arc_of(x) / safe

        # Down to x the work is that of each branch over its part: straight above `first` and below `last`.
        upper, lower = jnp.maximum(share, first), jnp.minimum(share, last)
        middle = jnp.clip(share, last, first)
        total = straight(upper) + (bent(middle) - bent(first)) + (straight(lower) - straight(last))
        return jnp.where(rest_length > 0, total, jnp.zeros_like(total))


def arc_of(share: Array) -> Array:
    """q with sin(sqrt q) / sqrt q = share, for shares of 0 to 1: the square of half the angle of an arc whose chord is this share of it."""
    t, _ = _root(share)
    return _value(_polynomial().coef, t)


def arc_slope(share: Array) -> Array:
    """Its derivative, 1 / S'(q): -6 at a share of 1, -2 pi^2 at 0."""
    t, per_share = _root(share)
    return _value(_polynomial().deriv().coef, t) * per_share


@cache
def _polynomial() -> Polynomial:
    """q as a polynomial in t, to 1e-13.

    As a function of s = sqrt(share + .217) it is smooth far beyond its interval: -.217 is the least value of S, where its inverse has a
    root. Iterations in its place would be traced again by every derivative.
    """

    def solved(s: np.ndarray) -> np.ndarray:
        share = s * s - _LEAST
        # From the right of the root the first step goes to its left, and the others come up to it, since S is convex.
        q = 10 * (1 - np.sqrt(np.maximum(1 - 1.2 * (1 - share), 0)))
        for _ in range(8):
            value, slope = np.sinc(np.sqrt(q) / np.pi), -(1 - q / 10 * (1 - q / 28 * (1 - q / 54))) / 6
            slope = np.where(q < 0.01, slope, (np.cos(np.sqrt(q)) - value) / (2 * np.where(q < 0.01, 1, q)))
            q = np.maximum(q - (value - share) / slope, 0)
        return q

    ends = [np.sqrt(_LEAST), np.sqrt(1 + _LEAST)]
    # Of the same polynomial on -1 to 1, so that the coefficients fall.
    return Polynomial(Chebyshev.interpolate(solved, _DEGREE, ends).convert(kind=Polynomial, domain=ends, window=[-1, 1]).coef)


def _root(share: Array) -> tuple[Array, Array]:
    """s = sqrt(share + .217) brought to -1 to 1, and its derivative by the share."""
    low, high = np.sqrt(_LEAST), np.sqrt(1 + _LEAST)
    s = jnp.sqrt(share + _LEAST)
    return (2 * s - float(low + high)) / float(high - low), 1 / (float(high - low) * s)


def _value(coefficients: np.ndarray, t: Array) -> Array:
    total = jnp.zeros_like(t)
    for c in reversed(coefficients.tolist()):
        total = total * t + c
    return total


def _crossings(ratio: Array) -> tuple[Array, Array]:
    """Between which shares r / L the arc pushes less than the straight thread, c_b L^3 / (4 k_b) = ratio: from `last` up to `first`."""

    def found(low: float, high: float, rises: bool) -> Array:
        def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            middle = 0.5 * (ends[0] + ends[1])
            arc_is_less = -0.5 * arc_slope(middle) < ratio * (1 - middle)
            goes_up = arc_is_less if rises else ~arc_is_less
            return jnp.where(goes_up, middle, ends[0]), jnp.where(goes_up, ends[1], middle)

        low_end, high_end = lax.fori_loop(0, _HALVINGS, halve, (jnp.full_like(ratio, low), jnp.full_like(ratio, high)))
        return 0.5 * (low_end + high_end)

    return found(_NARROWEST, 1.0, True), found(0.0, _NARROWEST, False)


def _safe(rest_length: Array) -> Array:
    return jnp.where(rest_length > 0, rest_length, jnp.ones_like(rest_length))


__all__ = ["ChoiKo", "Stiffening"]
