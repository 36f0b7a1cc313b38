"""Nodes with mass, and what holds them: what a system and a bound system have in common.

    held       x stays, v = 0
    moved      x = path(t), v = d path / dt

Forces and rules are numbered alike in both.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._arrays import kept
from .forces.base import Force, Rule
from .linalg.operators import Blocks, SpringMatrix
from .state import State
from .topology.base import Topology
from .topology.edge_field import EdgeField, OfNets, fields_of
from .vector import Vector

Free = Array | tuple[Array, ...] | None


class Motion(eqx.Module):
    """Nodes moved by a schedule.

    Attributes:
        moved: bool, (N,) in the user's order, on a lattice also its shape: which nodes follow the schedule.
        path: (time [s]) -> `Vector` of positions [m], made by `net.vector_field` from (N, D); its derivative in time is the velocity.
    """

    moved: Array = eqx.field(converter=kept)
    path: Callable[[Array], Vector]

    def at(self, time: Array) -> tuple[Vector, Vector]:
        """Positions and velocities that the schedule prescribes at `time`."""
        return jax.jvp(self.path, (time,), (jnp.ones_like(time),))


class Nodes(eqx.Module):
    """Masses, constraints and parts on the nodes of a net. Abstract: see `System` and `BoundSystem`."""

    net: eqx.AbstractVar[Topology]
    mass: eqx.AbstractVar[Array]
    forces: eqx.AbstractVar[tuple[Force, ...]]
    free: eqx.AbstractVar[Free]
    motion: eqx.AbstractVar[Motion | None]
    rules: eqx.AbstractVar[tuple[Rule, ...] | None]

    @property
    def parts(self) -> tuple[Rule, ...]:
        """Forces, then rules: in the order of their indices in a status."""
        return (*self.forces, *(self.rules or ()))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of forces and rules, in the order of their indices in a status."""
        return tuple(type(part).__name__ for part in self.parts)

    def _taken(self, state: State) -> State:
        """The state, where JAX can compute it and it is one state."""
        return state.checked()

    def hold(self, v: Vector) -> Vector:
        """`v` where free, zero where held."""
        return v.where(self.free_masks(v.dim))

    def constrain(self, state: State) -> State:
        """The state with held nodes at rest and moved nodes on their schedule."""
        state = eqx.tree_at(lambda s: s.velocity, self._taken(state), self.hold(state.velocity))
        if self.motion is None:
            return state
        position, velocity = self.motion.at(state.time)
        moved = self.moved_nodes

        def pick(new: Vector, old: Vector) -> Vector:
            return old.map(lambda a, b: jnp.where(moved, b.astype(a.dtype), a), new)

        return eqx.tree_at(lambda s: (s.position, s.velocity), state, (pick(position, state.position), pick(velocity, state.velocity)))

    def stage(self, state: State) -> State:
        """A state within a step with moved nodes where their schedule has them at its time: at their place of the step's start, a
        stepper would lose its order.
        """
        return state if self.motion is None else self.constrain(state)

    @property
    def moved_nodes(self) -> Array:
        """Which nodes follow a schedule, bool, node shape."""
        if self.motion is None:
            return jnp.zeros(self.net.node_shape, bool)
        return self.net.node_field(self.motion.moved, "motion.moved")

    def free_masks(self, dim: int) -> tuple[Array | None, ...]:
        """Per coordinate, where nodes are free (None: all are)."""
        free = self.free if isinstance(self.free, tuple) else (self.free,) * dim
        if len(free) != dim:
            raise ValueError(f"free has {len(free)} coordinates, the state has {dim}.")
        if self.motion is None:
            return free
        still = ~self.moved_nodes
        return tuple(still if m is None else m & still for m in free)

    def matrix(self, blocks: Blocks, state: State) -> SpringMatrix:
        """The blocks as a matrix over the coordinates, identity where held."""
        return SpringMatrix(blocks, self.free_masks(state.dim), state.position, state.layout)

    def momentum(self, state: State) -> Array:
        """(D,) total momentum [kg m/s]."""
        mass = self.mass.astype(self._taken(state).dtype)
        return jnp.stack([jnp.sum(mass * a) for a in state.velocity])

    def angular_momentum(self, state: State) -> Array:
        """About the origin [kg m^2/s]: (3,) in space, (1,) in the plane."""
        m, x, p = self.mass.astype(self._taken(state).dtype), state.position, state.velocity
        if state.dim == 1:
            raise ValueError("Angular momentum needs 2 or 3 coordinates; these positions have 1.")
        pairs = [(0, 1)] if state.dim == 2 else [(1, 2), (2, 0), (0, 1)]
        return jnp.stack([jnp.sum(m * (x[i] * p[j] - x[j] * p[i])) for i, j in pairs])


def owning(net: Topology, state: State) -> State:
    """The state, whose broken springs and changed rest lengths are those of this net where they do not say: a field made by hand would
    else be taken for every net with fields of its shapes.
    """
    if state.alive is None and state.rest_length is None:
        return state

    def named(fields: OfNets) -> OfNets:
        own = tuple(net.own(f.families) if net.owns(f) else f for f in fields_of(fields))
        return own[0] if isinstance(fields, EdgeField) else own or None

    alive, rest_length = named(state.alive), named(state.rest_length)
    return eqx.tree_at(lambda s: (s.alive, s.rest_length), state, (alive, rest_length), is_leaf=lambda leaf: leaf is None)


__all__ = ["Free", "Motion", "Nodes", "owning"]
