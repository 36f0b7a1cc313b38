"""How hard a surface pushes: a spring that sets in softly, a damper, and friction that is regularised at rest.

With the depth s > 0 [m], its rate, and w the depth over which the stiffness rises to k:

    push       k s**2 / (2 w) for s < w,  k (s - w/2) beyond                 [N]    continuous, and so is its slope
    energy     k s**3 / (6 w),  k (s**2/2 - s w/2 + w**2/6) beyond           [J]
    damper     c g(s) times the rate of the depth                            [N]    g = 3 t**2 - 2 t**3, t = s / w; 1 beyond w
    friction   mu push (2 y - y**2) for y = |v_t| / creep < 1, mu push beyond    [N]    against the tangential velocity v_t

A node in grip creeps: held by a share of the cone it moves at that share of about half the creep speed. What is left out of Coulomb's law
is this alone, and the force has a derivative everywhere.

Source: Li and others (2020), "Incremental Potential Contact", equations 13 to 15, for friction; the rest is a linear spring and damper
whose ends are rounded.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant, node_values, nonnegative
from ..forces.base import any_not_positive, any_refused
from ..forces.ramp import ramp, ramp_energy, ramp_slope
from ..vector import Vector

# Why a constant is refused.
NO_PUSH = "A negative stiffness pulls inward."
FEEDS = "It would feed energy in."


class ContactLaw(eqx.Module):
    """Push, damper and friction of a surface, as functions of depth and speed.

    Attributes:
        stiffness: k [N/m].
        onset: w [m].
        damping: c [N s/m], or None.
        friction: mu, or None.
        creep: [m/s].
    """

    stiffness: Array
    onset: Array
    damping: Array | None
    friction: Array | None
    creep: Array

    def __init__(self, stiffness: Numbers, onset: Numbers, damping: Numbers | None, friction: Numbers | None, creep: Numbers):
        self.stiffness = node_values("stiffness", stiffness)
        nonnegative("stiffness", self.stiffness, NO_PUSH)
        self.onset = constant("onset", onset, "The push would set in with a kink.")
        self.damping = None if damping is None else node_values("damping", damping)
        self.friction = None if friction is None else node_values("friction", friction)
        for name, value in (("damping", self.damping), ("friction", self.friction)):
            if value is not None:
                nonnegative(name, value, FEEDS)
        self.creep = constant("creep", creep, "Friction would jump where a node turns round.")

    def push(self, depth: Array) -> Array:
        """Force over stiffness [m], of a depth [m]; zero outside."""
        return ramp(depth, self.onset)

    def slope(self, depth: Array) -> Array:
        """Derivative of `push`, between 0 and 1."""
        return ramp_slope(depth, self.onset)

    def energy(self, depth: Array) -> Array:
        """Energy over stiffness [m^2]."""
        return ramp_energy(depth, self.onset)

    def grip(self, depth: Array) -> Array:
        """Which part of the damper acts, between 0 and 1."""
        share = self.slope(depth)
        return share * share * (3 - 2 * share)

    def drag(self, speed: Array) -> Array:
        """Friction over mu times push, and over the tangential speed [s/m]."""
        slips = speed >= self.creep
        one = jnp.ones_like(speed)
        return jnp.where(slips, 1 / jnp.where(slips, speed, one), (2 - speed / self.creep) / self.creep)

    def drag_slope(self, speed: Array) -> Array:
        """Derivative of friction over mu times push by the tangential speed [s/m]."""
        return jnp.where(speed < self.creep, 2 * (1 - speed / self.creep) / self.creep, jnp.zeros_like(speed))

    def rounding(self, position: Vector) -> Array:
        """The largest coordinate's rounding over the onset."""
        eps = jnp.asarray(jnp.finfo(position.dtype).eps, position.dtype)
        return position.largest() * eps / self.onset.astype(position.dtype)

    def invalid(self) -> Array:
        """Whether a constant is negative or not finite, or onset or creep not positive."""
        return any_refused(self.stiffness, self.damping, self.friction) | any_not_positive(self.onset, self.creep)


__all__ = ["ContactLaw"]
