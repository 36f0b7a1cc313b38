"""A strain limit after each step, as Provot has it: springs that are stretched too far are shortened, by moving their ends.

    where r > (1 + strain) l:     c = (r - (1 + strain) l) / max(n_i, n_j)        n_i: such springs at node i
    x_i += w_i / (w_i + w_j) c u       x_j -= w_j / (w_i + w_j) c u              w = 1 / m, 0 where held;  u from i to j
    v += (x' - x) / dt

All springs move at once, so that nothing depends on their order, and the centre of mass stays. One sweep shortens a spring alone in full,
one among n by an n-th at least; sweeps go on until every spring keeps the limit, or their number is spent. The velocity follows, else the
next step would stretch the spring again. Both ends held: nothing is done, and the status says so.

The derivative is that of the sweeps, and is zero across the limit. Where gradients are wanted take the law `Stiffening`.

Source: Provot (1995), "Deformation Constraints in a Mass-Spring Model to Describe Rigid Cloth Behavior", section 4, whose sweeps go from
spring to spring and leave the velocity.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers, whole_number
from .._checks import constant, nonnegative
from ..numerics import cast_inexact, stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, named_entries
from ..vector import Vector
from .base import Scene, Step, any_refused
from .laws import inverse_length
from .living import map_living
from .spring_rules import SpringRule, check_lengths


class StrainLimit(SpringRule):
    """The springs of a net are never longer than (1 + strain) times their rest length after a step.

    Attributes:
        net: whose springs are shortened.
        strain: the largest: a number, (E,) in the user's order, an `EdgeField`, or numbers by family; 1e6, which no spring reaches, where
            there is to be no limit.
        tolerance: strain beyond the limit that is let pass.
        sweeps: most passes over the springs in a step (static). Each brings the limit one node further.
        springs: those that are shortened; the system fills it in.

    Raises:
        ValueError: a strain or tolerance that is negative or not finite, sweeps below 1; in `System`, no or several `Springs` on the net,
            springs in some coordinates only, a rest length of zero.

    >>> net = js.lattice(3)
    >>> rule = js.cloth.StrainLimit(net, strain=0.1)
    >>> system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), free=[False, True, True], rules=rule)
    >>> start = js.State.from_points(net, [[0.0], [1.3], [2.2]])
    >>> end = js.rollout(system, start, js.SymplecticEuler(), dt=1e-3, n_steps=1).state
    >>> print(end.points[:, 0].round(3))
    [0.  1.1 2.2]
    """

    moves: ClassVar[bool] = True
    breaks: ClassVar[bool] = False
    sees_free: ClassVar[bool] = True
    constants: ClassVar[tuple[str, ...]] = ("strain",)
    strain: Any
    tolerance: Array
    mass: Array | None
    sweeps: int = eqx.field(static=True)

    def __init__(self, net: Topology, strain: SpringNumbers = 0.1, tolerance: Numbers = 1e-3, sweeps: int = 20):
        self.net = net
        self.strain = net.edge_constant(strain, "strain")
        for place, entry in named_entries("strain", self.strain):
            nonnegative(place, entry, "Springs would be shortened below their rest length.")
        self.tolerance = constant("tolerance", tolerance, "No sweep would be enough.", may_be_zero=True)
        self.sweeps = whole_number("sweeps", sweeps)
        if self.sweeps < 1:
            raise ValueError(f"sweeps = {sweeps}; expected 1 or more.")
        self.mass, self.springs = None, None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where the system has not exactly one `Springs` on this net, in all coordinates, with rest lengths."""
        springs = self.own_springs(scene)
        check_lengths("strain", springs)
        if springs.axes is not None:
            raise ValueError(f"StrainLimit moves nodes in all coordinates, but these springs act in axes = {springs.axes}.")

    def bind(self, scene: Scene) -> StrainLimit:
        """Constants as edge fields, the springs of this net, and the masses."""
        bound = super().bind(scene)
        return eqx.tree_at(lambda r: r.mass, bound, cast_inexact(scene.mass, scene.dtype), is_leaf=lambda leaf: leaf is None)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state in which no spring is beyond its limit, with the velocities that led there."""
        springs, held = self.known_springs(), step.free or (None,) * state.dim
        natural = cast_inexact(springs.natural_length(state), state.dtype)
        longest = map_living(self.net, state, lambda l, e: l * (1 + e), natural, self.constant("strain", state))
        slack = map_living(self.net, state, lambda l: l * self.tolerance.astype(l.dtype), natural)
        lightness = self._lightness(state, held)

        def sweep(x: Vector, _: None) -> tuple[Vector, None]:
            over = self._over(state, x, longest)
            is_wanted = jnp.any(self.net.joined(map_living(self.net, state, lambda c, most: c > most, over, slack)))
            return lax.cond(is_wanted, lambda x: self._shortened(state, x, over, lightness, held), lambda x: x, x), None

        x, _ = lax.scan(sweep, state.position, None, length=self.sweeps)
        velocity = state.velocity + (1 / step.dt) * (x - state.position)
        left = self.net.joined(map_living(self.net, state, lambda c, most: c > most, self._over(state, x, longest), slack))
        count = stopped(jnp.sum(left, dtype=jnp.int32))
        status = Status.when(Flag.STRAIN, count > 0, count=count)
        return dataclasses.replace(state, position=x, velocity=velocity), status

    def invalid(self) -> Array:
        """Whether a strain or the tolerance is negative or not finite."""
        return any_refused(self.strain, self.tolerance)

    def _over(self, state: State, x: Vector, longest: EdgeField) -> EdgeField:
        """Length beyond the limit [m], zero where kept."""

        def beyond(d: Vector, most: Array) -> Array:
            squared = d.dot(d)
            return jnp.maximum(squared * inverse_length(squared) - most, jnp.zeros((), squared.dtype))

        return map_living(self.net, state, beyond, self.net.difference(x), longest)

    def _lightness(self, state: State, free: tuple[Array | None, ...]) -> Array:
        """1 / m in node shape, zero where a node is held in every coordinate [1/kg]."""
        if self.mass is None:
            raise ValueError("StrainLimit knows no masses yet. Put it in System(rules=...), and ask the parts of system.bind(state.dtype).")
        light = jnp.broadcast_to(1 / self.mass, self.net.node_shape)
        if any(mask is None for mask in free):
            return light
        is_free = sum(jnp.broadcast_to(mask, self.net.node_shape).astype(jnp.int32) for mask in free if mask is not None)
        return jnp.where(jnp.asarray(is_free) > 0, light, jnp.zeros_like(light))

    def _shortened(self, state: State, x: Vector, over: EdgeField, light: Array, free: tuple[Array | None, ...]) -> Vector:
        """Positions after one pass over all springs."""
        is_over = self.net.inside(over.map(lambda c: (c > 0).astype(c.dtype)), 0)
        at_node = self.net.incident_sum(is_over)
        counts = Vector((at_node,))
        # The larger of two is their mean and half of their difference.
        half_gap = self.net.unboxed().difference(counts).map(lambda d: 0.5 * jnp.abs(d[0]))
        busiest = self.net.average(at_node).map(lambda a, b: a + b, half_gap)

        def impulse(d: Vector, c: Array, n: Array, w: Array) -> Vector:
            is_moved = (c > 0) & (w > 0)
            share = jnp.where(is_moved, c, jnp.zeros_like(c)) / jnp.where(is_moved, n * 2 * w, jnp.ones_like(c))
            return (share * inverse_length(d.dot(d))) * d

        pulls = map_living(self.net, state, impulse, self.net.difference(x), over, busiest, self.net.average(light))
        return x + (light * self.net.accumulate(pulls)).where(free)


__all__ = ["StrainLimit"]
