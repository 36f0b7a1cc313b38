"""What one pair of balls contributes: force, energy, what touches, bounds.

Both ends are computed alike, so that the two halves of a pair are opposite to the bit. At distance zero there is no direction and no force.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..forces.pair_sums import Fields, difference, squared_length
from .law import ContactLaw


class Ball(eqx.Module):
    """One end of pairs: its fields by their names.

    Attributes:
        position: D arrays [m].
        rest: D arrays [m]; empty where no pair is left out for touching at rest.
        radius: [m].
        velocity: D arrays [m/s]; empty where no term needs them.
    """

    position: Fields
    rest: Fields
    radius: Array
    velocity: Fields


class PairContact(eqx.Module):
    """The law of a pair, and how the fields of its ends stand in a tuple: position, rest, radius, velocity.

    Attributes:
        law: push, damper and friction.
        radius: of all nodes [m]; None where each has its own, among the fields.
        box: (D,) periods [m], or None.
        dim: coordinates (static).
        has_rest: whether places at rest are among the fields (static).
        has_velocity: whether velocities are (static).
    """

    law: ContactLaw
    radius: Array | None
    box: Array | None
    dim: int = eqx.field(static=True)
    has_rest: bool = eqx.field(static=True)
    has_velocity: bool = eqx.field(static=True)

    def force(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Force on the own node [N], one array per coordinate."""
        a, b = self._ball(own), self._ball(other)
        d, inverse, depth = self._meeting(a, b, distinct)
        push = self.law.stiffness * self.law.push(depth)
        weight = push * inverse
        if not self.has_velocity:
            return tuple(weight * along for along in d)
        relative = tuple(u - v for u, v in zip(a.velocity, b.velocity, strict=True))
        parting = sum(u * along for u, along in zip(relative, d, strict=True)) * inverse
        if self.law.damping is not None:
            weight = weight - self.law.damping * self.law.grip(depth) * parting * inverse
        if self.law.friction is None:
            return tuple(weight * along for along in d)
        tangential = tuple(u - parting * inverse * along for u, along in zip(relative, d, strict=True))
        squared = squared_length(tangential)
        slides, one = squared > 0, jnp.ones_like(squared)
        speed = jnp.where(slides, jnp.sqrt(jnp.where(slides, squared, one)), jnp.zeros_like(squared))
        brake = self.law.friction * push * self.law.drag(speed)
        return tuple(weight * along - brake * u for along, u in zip(d, tangential, strict=True))

    def energy(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Half the elastic energy [J]: the other end counts the other half."""
        _, _, depth = self._meeting(self._ball(own), self._ball(other), distinct)
        return (0.5 * self.law.stiffness * self.law.energy(depth),)

    def touches(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """One where the two touch."""
        _, _, depth = self._meeting(self._ball(own), self._ball(other), distinct)
        return ((depth > 0).astype(depth.dtype),)

    def damping(self, own: Fields, other: Fields, distinct: Array | None) -> Fields:
        """Twice the largest slope of damper and friction by the velocity [N s/m]."""
        _, _, depth = self._meeting(self._ball(own), self._ball(other), distinct)
        total = jnp.zeros_like(depth)
        if self.law.damping is not None:
            total = total + 2 * self.law.damping * self.law.grip(depth)
        if self.law.friction is not None:
            total = total + 4 * self.law.friction * self.law.stiffness * self.law.push(depth) / self.law.creep
        return (total,)

    def _meeting(self, a: Ball, b: Ball, distinct: Array | None) -> tuple[Fields, Array, Array]:
        """Own minus other position, one over its length (zero where there is none), and the depth; that of pairs left out is below zero."""
        d = difference(a.position, b.position, self.box)
        squared = squared_length(d)
        is_apart, one = squared > 0, jnp.ones_like(squared)
        length = jnp.sqrt(jnp.where(is_apart, squared, one))
        inverse = jnp.where(is_apart, 1 / length, jnp.zeros_like(squared))
        reach = a.radius + b.radius
        depth = reach - jnp.where(is_apart, length, jnp.zeros_like(squared))
        counts = depth > 0
        if distinct is not None:
            counts = counts & distinct
        if self.has_rest:
            counts = counts & (squared_length(difference(a.rest, b.rest, self.box)) >= reach * reach)
        return d, inverse, jnp.where(counts, depth, -one)

    def _ball(self, fields: Fields) -> Ball:
        position, rest = fields[: self.dim], fields[self.dim :]
        at_rest, rest = (rest[: self.dim], rest[self.dim :]) if self.has_rest else ((), rest)
        radius, rest = (self.radius, rest) if self.radius is not None else (rest[0], rest[1:])
        return Ball(position, at_rest, radius, rest)


__all__ = ["Ball", "PairContact"]
