"""Pair laws of a particle fluid: attraction at long range, repulsion at short range.

    force on i from j     f = q_i q_j w(r) (x_i - x_j)                            [N]    w > 0 pushes apart
    slides' law           w = -alpha / (r + zeta)**a + beta / r**b                       the vector is not a unit vector; q = mass
    unit-vector law       w = [-alpha / (r + zeta)**a + beta / r**b] / r                 q = mass
    Lennard-Jones 12-6    w = 24 epsilon [2 (sigma/r)**12 - (sigma/r)**6] / r**2         q = 1

Source: slide "Discrete Fluid Model" with its exponents corrected; a = 2 and b = 4 there. The printed remark that zeta is a minimum
separation is not what the formula does: zeta softens the attraction, and beta / r**b keeps particles apart. The unit-vector form is that of
Greenspan-type models. Both share the distance of equilibrium.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant
from .base import any_not_positive, any_refused

# Newton's steps for an equilibrium without closed form: the function is concave and rising, so that it converges from the left for all.
N_NEWTON = 60
# Why a constant is refused.
NO_REST = "Pairs would have no distance of equilibrium."
SINGULAR = "The attraction would be singular at a distance above zero."


class PairLaw(eqx.Module):
    """Force and potential of one pair. Abstract; subclass it for a law of your own, finite at every distance above zero.

    Also beyond its cut-off: an empty place of a neighbour list is a pair at 1e18 m (1e152 in float64), whose force the cut-off then drops.
    """

    @property
    def uses_mass(self) -> bool:
        """Whether both masses multiply the law."""
        return True

    @abc.abstractmethod
    def weight(self, squared: Array) -> Array:
        """Weight w of a squared distance [m^2], above zero: the force on i is q_i q_j w (x_i - x_j)."""

    @abc.abstractmethod
    def potential(self, squared: Array) -> Array:
        """Potential of a squared distance [m^2], per q_i q_j; its derivative by the distance is -w r."""

    @property
    @abc.abstractmethod
    def equilibrium_distance(self) -> Array:
        """r_0 [m], where the force of a pair is zero."""

    @abc.abstractmethod
    def turning_stiffness(self, energy: Array, core: Array) -> Array:
        """Stiffness of the repulsion where it has taken up `energy` (per q_i q_j), at no less than the distance `core` [m]."""

    def stiffness(self, distance: Array) -> Array:
        """Minus the derivative of the force by the distance [m], per q_i q_j: positive where the pair is stable along its line."""
        _, slope = jax.jvp(lambda r: self.weight(r * r) * r, (distance,), (jnp.ones_like(distance),))
        return -slope

    @property
    def contact_stiffness(self) -> Array:
        """k_0 per q_i q_j, the stiffness at the equilibrium distance; a pair swings at sqrt(q_i q_j k_0 (1/m_i + 1/m_j)) [rad/s]."""
        return self.stiffness(self.equilibrium_distance)

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse."""
        return None


class _PowerPair(PairLaw):
    """What the slides' law and its unit-vector form share."""

    alpha: Array
    beta: Array
    zeta: Array
    a: int = eqx.field(static=True)
    b: int = eqx.field(static=True)

    def __init__(self, alpha: Any, beta: Any, zeta: Any = 0.0, a: int = 2, b: int = 4):
        self.alpha = constant("alpha", alpha, NO_REST)
        self.beta = constant("beta", beta, NO_REST)
        self.zeta = constant("zeta", zeta, SINGULAR, may_be_zero=True)
        if not (isinstance(a, int) and isinstance(b, int) and 1 <= a < b and b >= 3):
            why = "The repulsion must rise faster than the attraction."
            raise ValueError(f"a = {a!r}, b = {b!r}; expected whole numbers, 1 <= a < b and b >= 3. {why}")
        self.a, self.b = a, b

    def _bracket(self, squared: Array) -> tuple[Array, Array]:
        """-alpha / (r + zeta)**a + beta / r**b, and 1 / r."""
        inverse = lax.rsqrt(squared)
        r = squared * inverse
        return self.beta * lax.integer_pow(inverse, self.b) - self.alpha * lax.integer_pow(1 / (r + self.zeta), self.a), inverse

    @property
    def equilibrium_distance(self) -> Array:
        """r_0 [m]: beta (r + zeta)**a = alpha r**b. For b = 2 a it is (s + sqrt(s**2 + 4 s zeta)) / 2 with s = (beta / alpha)**(1/a)."""
        if self.b == 2 * self.a:
            s = (self.beta / self.alpha) ** (1 / self.a)
            return (s + jnp.sqrt(s * s + 4 * s * self.zeta)) / 2
        target = jnp.log(self.beta / self.alpha)

        def step(_: Any, y: Array) -> Array:
            r = jnp.exp(y)
            return y - (self.b * y - self.a * jnp.log(r + self.zeta) - target) / (self.b - self.a * r / (r + self.zeta))

        # The root is found without derivative; one more step brings the exact derivative in.
        root = lax.stop_gradient(lax.fori_loop(0, N_NEWTON, step, target / (self.b - self.a)))
        return jnp.exp(step(None, root))

    def invalid(self) -> Array:
        """Whether alpha or beta is not positive, or zeta negative, or one of them not finite."""
        return any_not_positive(self.alpha, self.beta) | any_refused(self.zeta)


class SlideLaw(_PowerPair):
    """The slides' law: w = -alpha / (r + zeta)**a + beta / r**b, along the vector itself, which is not normalised.

    With a = 2 and b = 4 the attraction goes as 1/r at long range and has a logarithmic potential: no particle ever escapes.

    Attributes:
        alpha: attraction [N m^(a-1) / kg^2].
        beta: repulsion [N m^(b-1) / kg^2].
        zeta: length that softens the attraction [m].
        a: exponent of the attraction, a whole number (static).
        b: exponent of the repulsion, above a (static).

    Raises:
        ValueError: alpha or beta not positive, zeta negative, exponents that do not fit.

    >>> round(float(SlideLaw(1.0, 1.0, zeta=0.1).equilibrium_distance), 4)
    1.0916
    """

    def __init__(self, alpha: Numbers, beta: Numbers, zeta: Numbers = 0.0, a: int = 2, b: int = 4):
        super().__init__(alpha, beta, zeta, a, b)

    def weight(self, squared: Array) -> Array:
        """-alpha / (r + zeta)**a + beta / r**b."""
        return self._bracket(squared)[0]

    def potential(self, squared: Array) -> Array:
        """For a = 2, b = 4: alpha [ln(r + zeta) + zeta / (r + zeta)] + beta / (2 r**2)."""
        r = jnp.sqrt(squared)
        return self.alpha * _rising(r + self.zeta, self.zeta, self.a) + self.beta * lax.integer_pow(1 / r, self.b - 2) / (self.b - 2)

    def turning_stiffness(self, energy: Array, core: Array) -> Array:
        """Repulsion's (b - 1) beta / r**b where beta / ((b - 2) r**(b-2)) is the energy."""
        inverse = jnp.minimum(((self.b - 2) * energy / self.beta) ** (1 / (self.b - 2)), 1 / core)
        return (self.b - 1) * self.beta * lax.integer_pow(inverse, self.b)


class UnitVectorLaw(_PowerPair):
    """The slides' bracket along the unit vector: w = [-alpha / (r + zeta)**a + beta / r**b] / r.

    With a = 2 and b = 4 a pair has a finite well, -alpha / (r + zeta) + beta / (3 r**3), and the attraction a shorter range.

    Attributes:
        alpha: attraction [N m^a / kg^2].
        beta: repulsion [N m^b / kg^2].
        zeta: length that softens the attraction [m].
        a: exponent of the attraction, a whole number (static).
        b: exponent of the repulsion, above a (static).
    """

    def __init__(self, alpha: Numbers, beta: Numbers, zeta: Numbers = 0.0, a: int = 2, b: int = 4):
        super().__init__(alpha, beta, zeta, a, b)

    def weight(self, squared: Array) -> Array:
        """The bracket over r."""
        bracket, inverse = self._bracket(squared)
        return bracket * inverse

    def potential(self, squared: Array) -> Array:
        """For a = 2, b = 4: -alpha / (r + zeta) + beta / (3 r**3)."""
        r = jnp.sqrt(squared)
        far = jnp.log(r + self.zeta) if self.a == 1 else lax.integer_pow(1 / (r + self.zeta), self.a - 1) / (1 - self.a)
        return self.alpha * far + self.beta * lax.integer_pow(1 / r, self.b - 1) / (self.b - 1)

    def turning_stiffness(self, energy: Array, core: Array) -> Array:
        """Repulsion's b beta / r**(b+1) where beta / ((b - 1) r**(b-1)) is the energy."""
        inverse = jnp.minimum(((self.b - 1) * energy / self.beta) ** (1 / (self.b - 1)), 1 / core)
        return self.b * self.beta * lax.integer_pow(inverse, self.b + 1)


class LennardJones(PairLaw):
    """Lennard-Jones 12-6: potential 4 epsilon [(sigma/r)**12 - (sigma/r)**6]; masses do not enter it.

    Attributes:
        epsilon: depth of the well [J].
        sigma: distance at which the potential is zero [m]; the well's bottom is at 2**(1/6) sigma.

    >>> law = LennardJones(epsilon=1.0, sigma=1.0)
    >>> round(float(law.equilibrium_distance), 4)
    1.1225
    """

    epsilon: Array
    sigma: Array

    def __init__(self, epsilon: Numbers, sigma: Numbers):
        self.epsilon = constant("epsilon", epsilon, NO_REST)
        self.sigma = constant("sigma", sigma, NO_REST)

    @property
    def uses_mass(self) -> bool:
        """Whether both masses multiply the law: epsilon alone says how strong it is."""
        return False

    def weight(self, squared: Array) -> Array:
        """24 epsilon [2 (sigma/r)**12 - (sigma/r)**6] / r**2 [N/m]."""
        inverse = 1 / squared
        sixth = lax.integer_pow(self.sigma * self.sigma * inverse, 3)
        return 24 * self.epsilon * inverse * sixth * (2 * sixth - 1)

    def potential(self, squared: Array) -> Array:
        """4 epsilon [(sigma/r)**12 - (sigma/r)**6] [J]."""
        sixth = lax.integer_pow(self.sigma * self.sigma / squared, 3)
        return 4 * self.epsilon * sixth * (sixth - 1)

    @property
    def equilibrium_distance(self) -> Array:
        """2**(1/6) sigma [m]."""
        return 2 ** (1 / 6) * self.sigma

    def turning_stiffness(self, energy: Array, core: Array) -> Array:
        """4 epsilon 156 (sigma/r)**14 / sigma**2 where 4 epsilon (sigma/r)**12 is the energy [N/m]."""
        ratio = jnp.minimum((energy / (4 * self.epsilon)) ** (1 / 12), self.sigma / core)
        return 624 * self.epsilon * lax.integer_pow(ratio, 14) / (self.sigma * self.sigma)

    def invalid(self) -> Array:
        """Whether epsilon or sigma is not positive or not finite."""
        return any_not_positive(self.epsilon, self.sigma)


def gentle_fluid(spacing: Numbers, zeta: Numbers = 0.0, alpha: Numbers = 1.0) -> SlideLaw:
    """The slides' law whose pairs rest at the lattice's spacing h, so that a spring that fuses leaves its two particles without a push.

    r_0 = h asks for beta = alpha h**4 / (h + zeta)**2.

    Args:
        spacing: h [m], the length of the lattice's structural springs.
        zeta: length that softens the attraction [m].
        alpha: attraction [N m / kg^2]; it sets how strongly the fluid holds together.

    Returns:
        The law with this beta [N m^3 / kg^2].

    Raises:
        ValueError: a spacing or an attraction that is not positive, or a negative zeta.

    >>> round(float(gentle_fluid(spacing=0.5, zeta=0.1).equilibrium_distance), 6)
    0.5
    """
    h = constant("spacing", spacing, "Particles of a lattice are apart.")
    zeta, alpha = constant("zeta", zeta, SINGULAR, may_be_zero=True), constant("alpha", alpha, NO_REST)
    return SlideLaw(alpha, alpha * lax.integer_pow(h, 4) / lax.integer_pow(h + zeta, 2), zeta)


def _rising(shifted: Array, zeta: Array, a: int) -> Array:
    """Integral of r / (r + zeta)**a by r, at r + zeta = shifted."""
    if a == 1:
        return shifted - zeta * jnp.log(shifted)
    if a == 2:
        return jnp.log(shifted) + zeta / shifted
    inverse = 1 / shifted
    return zeta * lax.integer_pow(inverse, a - 1) / (a - 1) - lax.integer_pow(inverse, a - 2) / (a - 2)
