"""Springs that soften as they get warm.

    theta_ij = (theta_i + theta_j) / 2                                                [K]
    k_ij     = k0_ij clip((theta_m - theta_ij) / (theta_m - theta_s), 0, 1)           [N/m]   full below theta_s, none from theta_m on

The smooth version replaces clip(z, 0, 1) by (softplus(b z) - softplus(b (z - 1))) / b, with a sharpness b: it has a derivative everywhere,
is never exactly 0 or 1, and tends to the ramp as b grows, by at most ln 2 / b. The ramp has a gradient by the melting point only for
springs that are between the two temperatures; elsewhere it is exactly zero.

Source: Terzopoulos, Platt and Fleischer (1989), stiffness that falls with temperature; the linear ramp and the mean of the ends are
this library's reading. The smooth ramp is that of two softplus functions.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, is_concrete, nonnegative, positive
from ..forces.base import any_refused
from ..forces.living import map_living
from ..forces.springs import ExpansionRule, StiffnessRule
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers


class ThermalStiffness(StiffnessRule):
    """Full stiffness below the softening temperature, none from the melting point on, linear between.

    Args:
        stiffness: k0 [N/m]: a number, (E,) in the user's order, or an `EdgeField`; kept as `full`.
        softening: theta_s [K], a number.
        melting: theta_m [K], a number.
        sharpness: b of the smooth version, a number; None is the exact ramp.

    Raises:
        ValueError: a negative stiffness, a melting point that is not above the softening temperature, a sharpness that is not positive.

    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> rule = ThermalStiffness(100.0, softening=300.0, melting=400.0)
    >>> warm = js.State.from_points(net, net.grid(), temperature=[300.0, 350.0, 450.0])
    >>> print(net.flatten(rule.stiffness(net, warm)))
    [75.  0.]
    """

    full: Any
    softening: Array
    melting: Array
    sharpness: Array | None

    def __init__(self, stiffness: SpringNumbers, softening: Numbers, melting: Numbers, sharpness: Numbers | None = None):
        self.full = stiffness if isinstance(stiffness, EdgeField) else as_inexact("stiffness", stiffness)
        if not isinstance(self.full, EdgeField) and self.full.ndim > 1:
            raise ValueError(f"stiffness has shape {self.full.shape}; expected () (one number), or (E,) (one per spring).")
        for i, entry in enumerate(self.full.families if isinstance(self.full, EdgeField) else (self.full,)):
            nonnegative(
                f"stiffness.families[{i}]" if isinstance(self.full, EdgeField) else "stiffness", entry, "It would push without bound."
            )
        self.softening, self.melting = _number("softening", softening), _number("melting", melting)
        if is_concrete(self.softening) and is_concrete(self.melting) and not np.asarray(self.softening) < np.asarray(self.melting):
            raise ValueError(
                f"softening = {self.softening} K is not below melting = {self.melting} K. The stiffness falls between the two."
            )
        self.sharpness = None if sharpness is None else _number("sharpness", sharpness)
        if self.sharpness is not None:
            positive("sharpness", self.sharpness, "The stiffness would rise with temperature. Pass None for the exact ramp.")

    @property
    def follows_position(self) -> bool:
        """Whether the stiffness depends on where the nodes are: at a given temperature the springs have a potential."""
        return False

    def stiffness(self, net: Topology, state: State) -> EdgeField:
        """Stiffness k_ij at the present temperatures [N/m]."""
        warm = net.average(temperature_of(state, "ThermalStiffness"))
        full, low, high = cast_inexact((net.edge_field(self.full, "stiffness"), self.softening, self.melting), state.dtype)
        b = None if self.sharpness is None else self.sharpness.astype(state.dtype)
        return map_living(net, state, lambda full, theta: full * _share((high - theta) / (high - low), b), full, warm)

    def upper_bound(self) -> Any:
        """The largest of the full stiffnesses [N/m]. One that is not finite is left out: it is refused, or its spring is broken."""
        entries = self.full.families if isinstance(self.full, EdgeField) else (self.full,)
        return jnp.max(jnp.stack([jnp.max(jnp.where(jnp.isfinite(entry), entry, jnp.zeros_like(entry))) for entry in entries]))

    def invalid(self) -> Array:
        """Whether a constant is one that the constructor refuses."""
        bad = any_refused(self.full) | ~(self.softening < self.melting)
        return bad if self.sharpness is None else bad | ~(self.sharpness > 0)


class ThermalExpansion(ExpansionRule):
    """Rest lengths that grow with the mean temperature of the ends: l = l0 (1 + a (theta_ij - theta_0)), never below zero.

    Attributes:
        coefficient: a [1/K].
        reference: theta_0 [K], where the given rest lengths hold.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> springs = js.Springs(net, 1.0, 1.0, expansion=ThermalExpansion(1e-3, reference=300.0))
    >>> hot = js.State.from_points(net, net.grid(), temperature=400.0)
    >>> print(net.flatten(springs.natural_length(hot)))
    [1.1]
    """

    coefficient: Array
    reference: Array

    def __init__(self, coefficient: Numbers, reference: Numbers):
        self.coefficient, self.reference = _number("coefficient", coefficient), _number("reference", reference)

    def factor(self, net: Topology, state: State) -> EdgeField:
        """Growth 1 + a (theta_ij - theta_0)."""
        a, at = self.coefficient.astype(state.dtype), self.reference.astype(state.dtype)
        warm = net.average(temperature_of(state, "ThermalExpansion"))
        return warm.map(lambda theta: jnp.maximum(1 + a * (theta - at), jnp.zeros((), theta.dtype)))

    def invalid(self) -> Array:
        """Whether a constant is not finite."""
        return ~(jnp.isfinite(self.coefficient) & jnp.isfinite(self.reference))


def temperature_of(state: State, who: str) -> Array:
    """The state's temperature [K], which `who` needs.

    Raises:
        ValueError: there is none.
    """
    if state.temperature is None:
        raise ValueError(f"{who} needs a temperature, but the state has none. Pass temperature=... to State.from_points.")
    return state.temperature


def _share(z: Array, sharpness: Array | None) -> Array:
    if sharpness is None:
        return jnp.clip(z, 0, 1)
    # The shares of z and 1 - z add up to 1. The smaller one is formed: the larger, a difference of large terms, would exceed 1 by rounding.
    is_low = z < 0.5
    near = jnp.where(is_low, z, 1 - z)
    share = (jax.nn.softplus(sharpness * near) - jax.nn.softplus(sharpness * (near - 1))) / sharpness
    return jnp.where(is_low, share, 1 - share)


def _number(name: str, value: Any) -> Array:
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": ()})
    finite(name, value)
    return value


__all__ = ["ThermalExpansion", "ThermalStiffness"]
