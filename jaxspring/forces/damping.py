"""Damping: drag against the surroundings, and dashpots along springs.

    drag      f_i = -gamma_i v_i                                   [N]   slows rigid motion too
    dashpot   f_i = c_ij ((v_j - v_i) . u_ij) u_ij                 [N]   keeps momentum and angular momentum

Source: slide "Force Computation (Cont.)" for the drag; the dashpot is the usual damper along the spring (absent from the slides).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import node_values, nonnegative
from ..linalg.operators import Blocks, SpringBlocks, isotropic
from ..numerics import cast_inexact, tiny
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, ZeroOutside
from ..vector import Vector
from .base import Finding, Force, Scene, any_refused
from .in_box import long_springs, turned_springs
from .lengths import are_apart, too_short_or_long
from .living import counted, heeding, living, map_living, vanishing
from .springs import _check_sign, _edge_constant


class Drag(Force):
    """Viscous drag on every node.

    Attributes:
        gamma: [N s/m], one number, or (N,) in the user's order; on a lattice also its shape.

    Raises:
        ValueError: a negative or non-finite value.
    """

    gamma: Array

    def __init__(self, gamma: Numbers):
        self.gamma = node_values("gamma", gamma)
        nonnegative("gamma", self.gamma, "A negative drag feeds energy in.")

    def force(self, state: State) -> Vector:
        """-gamma v [N]."""
        return -(self._gamma(state) * state.velocity)

    def damping_blocks(self, state: State) -> Blocks:
        """gamma on the diagonal [N s/m]."""
        return Blocks((isotropic(self._gamma(state), state.position),))

    def incremental_potential(self, state: State, dt: Array) -> Array:
        """dt gamma v^2 / 2, summed [J]."""
        return jnp.sum(0.5 * dt * self._gamma(state).astype(state.dtype) * state.velocity.dot(state.velocity))

    @property
    def is_symmetric(self) -> bool:
        """Whether -dF/dv is symmetric: drag acts on each coordinate alone."""
        return True

    @property
    def can_feed(self) -> bool:
        """Whether the force can raise the energy: drag takes energy out."""
        return False

    def damping_bound(self, state: State) -> Array:
        """gamma [N s/m]."""
        return self._gamma(state).astype(state.dtype)

    def damping_floor(self, state: State) -> Array:
        """gamma [N s/m]."""
        return self._gamma(state).astype(state.dtype)

    def invalid(self) -> Array:
        """Whether gamma is negative or not finite."""
        return any_refused(self.gamma)

    def _gamma(self, state: State) -> Array:
        return state.layout.constant("gamma", self.gamma)


class Dashpots(Force):
    """A damper along every spring of a network.

    A spring that is broken in `state.alive` has no damper.

    Attributes:
        net: the topology.
        damping: c [N s/m]: a number, (E,) in the user's order, an `EdgeField`, or numbers by family, as in `Springs`.
    """

    net: Topology
    damping: Any

    def __init__(self, net: Topology, damping: SpringNumbers):
        self.net = net
        self.damping = _edge_constant(net, "damping", damping)
        _check_sign("damping", self.damping, "A negative damper feeds energy in.")

    def bind(self, scene: Scene) -> Dashpots:
        """Constants as edge fields."""
        damping = vanishing(self.net, cast_inexact(self.net.edge_field(self.damping), scene.dtype))
        return cast_inexact(eqx.tree_at(lambda f: f.damping, self, damping), scene.dtype)

    def force(self, state: State) -> Vector:
        """Sum of the dampers' pulls at each node [N]; a spring of no length has no direction and no damping."""
        if self.net.n_springs == 0:
            return Vector.zeros_like(state.position)

        damping = self.net.edge_field(self.damping)
        if not self.net.has_margins:
            damping = vanishing(self.net, damping)
        if isinstance(damping, ZeroOutside):
            pull, fields = heeding(self.net, state, _pull, damping)
            return self.net.net_pull(pull, (state.position, state.velocity), *fields)
        d = self.net.difference(state.position)
        return self.net.accumulate(map_living(self.net, state, _pull, d, self._rate(state), damping))

    def damping_blocks(self, state: State) -> Blocks | None:
        """Blocks c u u' per spring [N s/m], its direction taken as it is."""
        if self.net.n_springs == 0:
            return None
        d = self.net.difference(state.position)
        c = self.net.edge_field(self.damping)
        slope = map_living(self.net, state, lambda d, c: jnp.broadcast_to(c, d.shape).astype(d.dtype), d, c)
        direction = map_living(self.net, state, lambda d: _inverse_length(d) * d, d)
        return Blocks(springs=(SpringBlocks(self.net, slope * 0, slope, direction),))

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """COINCIDENT: dampers whose ends are apart, but so near that the square of their distance underflows: they have no direction
        then. NONFINITE: dampers so long that it overflows. BOX: dampers of half a period.
        """
        if self.net.n_springs == 0:
            return ()

        d, nothing = self.net.difference(state.position), jnp.zeros((), state.dtype)
        found = too_short_or_long(self.net, state, lambda d, _: are_apart(d), d, nothing)
        return (*found, *long_springs(self.net, state.position, living(self.net, state)))

    def diagnose_since(self, start: State, state: State) -> tuple[Finding, ...]:
        """BOX: dampers that act toward another image than at the start."""
        if self.net.n_springs == 0:
            return ()
        return turned_springs(self.net, start.position, state.position, living(self.net, state))

    @property
    def can_feed(self) -> bool:
        """Whether the force can raise the energy: a damper takes energy out."""
        return False

    def damping_bound(self, state: State) -> Array | None:
        """Twice the sum of the dampers at each node [N s/m], those of broken springs too: they may come back."""
        if self.net.n_springs == 0:
            return None
        c = self.net.edge_field(self.damping)
        spread = self.net.own(jnp.ones(shape, state.dtype) for shape in self.net.family_shapes)
        spread = self.net.map_springs(lambda one, c: one * c, spread, c)
        alive = living(self.net, state)
        spread = spread if alive is None else self.net.map_springs(counted, spread, spread, alive)
        return 2 * self.net.incident_sum(spread)

    def invalid(self) -> Array:
        """Whether a damper is negative or not finite."""
        return any_refused(self.damping)

    def _rate(self, state: State) -> EdgeField:
        return self.net.unboxed().difference(state.velocity)


def _pull(d: Vector, relative: Vector, c: Array) -> Vector:
    inverse = _inverse_length(d)
    return (c * (d.dot(relative) * inverse) * inverse) * d


def _inverse_length(d: Vector) -> Array:
    """1 / |d|, and zero with zero derivative where there is no length."""
    squared = d.dot(d)
    is_long = squared > tiny(squared.dtype)
    # Both wheres, so that the derivative at length zero is zero and not infinity times zero.
    return jnp.where(is_long, lax.rsqrt(jnp.where(is_long, squared, jnp.ones_like(squared))), jnp.zeros_like(squared))
