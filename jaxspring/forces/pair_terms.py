"""What one pair of fluid particles contributes: force, energy, stiffness, drag, overlap.

Closer than the core the distance is taken as the core's in the law, so that the pull per unit of difference stops growing there:

    r >= core     force w(r) d                  energy U(r)
    r <  core     force w(core) d               energy U(core) + w(core) (core**2 - r**2) / 2

Force and energy are continuous, the energy's gradient is minus the force, and at r = 0 both are finite and the force is zero.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .cutoffs import Cutoff
from .pair_drag import PairDrag
from .pair_laws import PairLaw
from .pair_sums import Fields, difference, squared_length


class Arrangement(eqx.Module):
    """Which fields the particles have, and in which order they stand.

    Attributes:
        dim: coordinates (static).
        has_charge: whether a charge multiplies the law (static).
        has_fluid: whether some may be solid (static).
    """

    dim: int = eqx.field(static=True)
    has_charge: bool = eqx.field(static=True)
    has_fluid: bool = eqx.field(static=True)

    def particles(self, fields: Fields) -> Particles:
        """The fields by their names."""
        rest = iter(fields[self.dim :])
        charge = next(rest) if self.has_charge else None
        fluid = next(rest) if self.has_fluid else None
        return Particles(fields[: self.dim], charge, fluid, tuple(rest))


class Particles(eqx.Module):
    """Node fields of the particles, flat, as the pair terms read them.

    Attributes:
        position: D arrays (N,) [m].
        charge: (N,) q, what multiplies the law; None where it is one.
        fluid: (N,) 1 where the particle is fluid, 0 where it is solid; None where all are fluid.
        velocity: D arrays (N,) [m/s]; empty where no term needs them.
    """

    position: Fields
    charge: Array | None
    fluid: Array | None
    velocity: Fields

    def fields(self) -> Fields:
        """All arrays in one tuple, as `arrangement` orders them."""
        extra = tuple(a for a in (self.charge, self.fluid) if a is not None)
        return (*self.position, *extra, *self.velocity)

    @property
    def arrangement(self) -> Arrangement:
        """How `fields` orders them."""
        return Arrangement(len(self.position), self.charge is not None, self.fluid is not None)


class PairTerms(eqx.Module):
    """The law of a pair with its cut-off, core and drag.

    Attributes:
        law: attraction and repulsion.
        cutoff: how it ends.
        core: distance [m] below which the force stops growing.
        drag: of the pair, or None.
        arrangement: tells how fields stand in the tuples.
        box: (D,) period of each coordinate [m], or None: each pair acts by its nearest image.
    """

    law: PairLaw
    cutoff: Cutoff
    core: Array
    drag: PairDrag | None
    arrangement: Arrangement
    box: Array | None = None

    def force(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Force on the own particle [N], one array per coordinate."""
        a, b = self.arrangement.particles(own), self.arrangement.particles(other)
        d, squared = self._difference(a, b)
        guarded = jnp.maximum(squared, self.core * self.core)
        weight = self._shared(a, b, lambda: self.cutoff.weight(self.law, guarded), lambda: self._repulsion(guarded))
        if self.drag is not None and a.velocity:
            approach = sum((u - v) * along for u, v, along in zip(a.velocity, b.velocity, d, strict=True))
            weight = weight - self._takes_part(a, b, self.drag.rate(guarded) * approach / guarded)
        # A particle with itself has d = 0, but its weight is the core's: in reverse mode two huge terms would cancel only to rounding.
        weight = _if_distinct(distinct, weight)
        return tuple(weight * along for along in d)

    def energy(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Half the potential [J]: the other end counts the other half."""
        a, b = self.arrangement.particles(own), self.arrangement.particles(other)
        _, squared = self._difference(a, b)
        guarded = jnp.maximum(squared, self.core * self.core)
        inner = (guarded - squared) / 2

        def full() -> Array:
            return self.cutoff.potential(self.law, guarded) + self.cutoff.weight(self.law, guarded) * inner

        def repulsive() -> Array:
            bottom = self.law.potential(self.law.equilibrium_distance**2)
            zero = jnp.zeros((), squared.dtype)
            return jnp.where(self.law.weight(guarded) > 0, self.law.potential(guarded) - bottom + self._repulsion(guarded) * inner, zero)

        return (_if_distinct(distinct, self._shared(a, b, full, repulsive) / 2),)

    def stiffness(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Twice the largest eigenvalue of -dF/dx of the pair [N/m], zero where none is positive."""
        a, b = self.arrangement.particles(own), self.arrangement.particles(other)
        _, squared = self._difference(a, b)
        r = jnp.sqrt(jnp.maximum(squared, self.core * self.core))
        zero = jnp.zeros((), r.dtype)

        def full() -> Array:
            along = -_slope(lambda r: self.cutoff.weight(self.law, r * r) * r, r)
            return jnp.maximum(jnp.maximum(along, -self.cutoff.weight(self.law, r * r)), zero)

        def repulsive() -> Array:
            return jnp.maximum(-_slope(lambda r: self._repulsion(r * r) * r, r), zero)

        return (_if_distinct(distinct, 2 * self._shared(a, b, full, repulsive)),)

    def damping(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Twice the drag coefficient of the pair [N s/m]."""
        a, b = self.arrangement.particles(own), self.arrangement.particles(other)
        _, squared = self._difference(a, b)
        rate = jnp.zeros_like(squared) if self.drag is None else self.drag.rate(jnp.maximum(squared, self.core * self.core))
        return (_if_distinct(distinct, 2 * self._takes_part(a, b, rate)),)

    def overlap(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """One where the pair is closer than the core."""
        a, b = self.arrangement.particles(own), self.arrangement.particles(other)
        _, squared = self._difference(a, b)
        close = (squared < self.core * self.core).astype(squared.dtype)
        return (_if_distinct(distinct, self._takes_part(a, b, close)),)

    def _difference(self, a: Particles, b: Particles) -> tuple[Fields, Array]:
        """Own minus other position, and its square."""
        d = difference(a.position, b.position, self.box)
        return d, squared_length(d)

    def _repulsion(self, squared: Array) -> Array:
        return jnp.maximum(self.law.weight(squared), jnp.zeros((), squared.dtype))

    def _shared(self, a: Particles, b: Particles, full: Callable[[], Array], repulsive: Callable[[], Array]) -> Array:
        """The full value of two fluid particles, the repulsive one of a mixed pair, zero of two solid ones; times both charges."""
        value = full()
        if a.fluid is not None and b.fluid is not None:
            both = a.fluid + b.fluid
            mixed = jnp.where(both > 0.5, repulsive(), jnp.zeros((), value.dtype))
            value = jnp.where(both > 1.5, value, mixed)
        return value if a.charge is None or b.charge is None else value * (a.charge * b.charge)

    def _takes_part(self, a: Particles, b: Particles, value: Array) -> Array:
        if a.fluid is None or b.fluid is None:
            return value
        return jnp.where(a.fluid + b.fluid > 0.5, value, jnp.zeros((), value.dtype))


def _slope(function: Callable[[Array], Array], at: Array) -> Array:
    return jax.jvp(function, (at,), (jnp.ones_like(at),))[1]


def _if_distinct(distinct: Array | None, value: Array) -> Array:
    return value if distinct is None else jnp.where(distinct, value, jnp.zeros((), value.dtype))
