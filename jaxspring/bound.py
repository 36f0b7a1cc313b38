"""A system as a loop wants it: bound once to the dtype of a state, before the first step, inside the traced run.

Every constant has the shape of the topology and the dtype of the state; every part knows its masses, its place and the others. Steppers,
`diffeqsolve`, `equilibrium` and functions given to `SaveAt` get this; what users write, differentiate, edit and save is the `System`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .forces.base import Force, Rule, Scene, Step, acts
from .forces.contact import Books, Floor, strike
from .forces.linearisation import Linearisation
from .linalg.operators import Blocks
from .memory import Owner, entry_at, matched, with_entry, without_caches
from .nodes import Free, Motion, Nodes, owning
from .numerics import cast_inexact
from .state import State
from .status import Status
from .topology.base import Topology
from .topology.edge_field import fields_of
from .vector import Vector


class Energy(eqx.Module):
    """Energy of one state [J].

    Attributes:
        kinetic: sum of m v^2 / 2.
        potential: one entry per force, None where that force has no potential.
    """

    kinetic: Array
    potential: tuple[Array | None, ...]

    @property
    def total(self) -> Array:
        """Kinetic energy plus every potential that exists."""
        return sum((p for p in self.potential if p is not None), start=self.kinetic)


class BoundSystem(Nodes):
    """A system bound to the dtype of a state: made by `System.bind`, never by hand.

    Attributes:
        net: the topology.
        mass: [kg], a number or a node array.
        forces: bound, in the order of their indices in statuses.
        free: as in `System`.
        motion: as in `System`.
        rules: bound; None where there are none.
    """

    net: Topology
    mass: Array
    forces: tuple[Force, ...]
    free: Free
    motion: Motion | None
    rules: tuple[Rule, ...] | None

    @staticmethod
    def of(net: Topology, mass: Array, forces: Any, free: Free, motion: Motion | None, rules: Any, dtype: DTypeLike) -> BoundSystem:
        """The bound system of these parts, in this dtype."""
        net, mass, motion = cast_inexact((net, mass, motion), dtype)
        scene = Scene(net, mass, dtype, forces, rules or ())
        bound = tuple(scene.bound(i) for i in range(len(forces) + len(rules or ())))
        rest = bound[len(forces) :] or None
        return BoundSystem(net=net, mass=mass, forces=bound[: len(forces)], free=free, motion=motion, rules=rest)

    @property
    def followers(self) -> tuple[tuple[int, Rule], ...]:
        """Whatever acts after a step, with its index in a status."""
        return tuple((i, part) for i, part in enumerate(self.parts) if acts(part))

    def own(self, state: State) -> State:
        """The state as these parts may read it: its broken springs are those of this net where they do not say, and its memory is theirs.

        Raises:
            ValueError: the state holds the history of a part that this system does not have.
        """
        memory = matched(state.memory, tuple(Owner.of(part) for part in self.parts))
        state = owning(self.net, state)
        nets = [self.net, *(net for net in (getattr(part, "net", None) for part in self.parts) if net is not None)]
        for name, fields in (("alive", state.alive), ("rest_length", state.rest_length)):
            for field in fields_of(fields):
                if not any(net.owns(field) for net in nets):
                    raise ValueError(
                        f"state.{name} tells about the springs of another net than any of this system ({field.identity or 'not named'}, "
                        f"in families of shapes {tuple(entry.shape for entry in field.families)}), and would be read by none. Make it "
                        f"with a net of the system, net.own(...), or leave it out: dataclasses.replace(state, {name}=None)."
                    )
        return replace(state, memory=memory)

    def begin(self, state: State) -> State:
        """The constrained state with what its parts need: shared fields, and a memory for each that remembers something.

        Raises:
            ValueError: the state holds the history of a part that this system does not have.
        """
        state = self.constrain(self.own(state))
        for i, part in enumerate(self.parts):
            state = part.begin(state)
            entry = entry_at(state.memory, i)
            memory = part.remember(state) if entry is None else part.renew(entry.value, state)
            state = state if memory is None else part.keep(state, memory)
        return state

    def alone(self, state: State) -> State:
        """The constrained state without what only `rollout` keeps up to date: histories stay, caches and commands that hold for a step go.

        Raises:
            ValueError: the state holds the history of a part that this system does not have.
        """
        state = self.own(without_caches(state))
        for i, part in enumerate(self.parts):
            state = replace(state, memory=with_entry(state.memory, i, None)) if part.drives and not part.is_idle else state
        return self.constrain(state)

    @property
    def is_driven(self) -> bool:
        """Whether commands change from step to step."""
        return any(part.drives for _, part in self.followers)

    def commanded(self, state: State) -> State:
        """The state with the commands of this moment, which then hold."""
        for part in (part for _, part in self.followers if part.drives):
            state = part.keep(state, part.remember(state))
        return state

    def commanded_as(self, before: State, state: State, is_same: Array) -> State:
        """The state with the commands that an earlier one holds, where `is_same`."""
        for i, part in self.followers:
            entry, new = entry_at(before.memory, i), entry_at(state.memory, i)
            if part.drives and entry is not None and new is not None and jnp.shape(entry.value) == jnp.shape(new.value):
                state = part.keep(state, jnp.where(is_same, entry.value, new.value))
        return state

    def follow(self, before: State, state: State, dt: Array, pushed: Vector | None = None) -> tuple[State, Status]:
        """What happens after a step besides motion, and what went wrong there.

        Args:
            before: where the step began.
            state: where motion ended.
            dt: [s].
            pushed: change of velocity that obstacles gave in the step already [m/s], or None.
        """
        total, followers = Status.ok(), self.followers
        obstacles = tuple(i for i, part in followers if part.is_obstacle)
        drivers = tuple((i, part) for i, part in followers if part.drives)
        watchers = tuple((i, part) for i, part in followers if part.watches)
        step, stages, impacts = self._step(before, state, dt, bool(obstacles)), [], None
        for i, part in followers:
            if not part.is_obstacle and not part.drives and not part.watches:
                state, status = _updated(part, step, state)
                total = total.then(_placed(status, i))
                stages += [] if isinstance(part, Force) else [(i, state)]
        if obstacles:
            is_kicked = any(part.moves for _, part in followers if not part.is_obstacle)
            state, status, impacts = _struck(self.obstacles, replace(step, pushed=pushed), state, bool(watchers), is_kicked)
            total = total.then(_placed(status, obstacles[0]))
            stages.append((-1, state))
        for i, part in drivers:
            state, status = _updated(part, step, state)
            total = total.then(_placed(status, i))
            stages.append((i, state))
        step = replace(step, stages=tuple(stages), impacts=impacts)
        for i, part in watchers:
            state, status = _updated(part, step, state)
            total = total.then(_placed(status, i))
        return state, total

    @property
    def obstacles(self) -> tuple[Rule, ...]:
        """What nodes cannot enter."""
        return tuple(part for _, part in self.followers if part.is_obstacle)

    def resting(self, state: State, origin: Vector, span: Array, end: Array) -> Any:
        """What obstacles can take from nodes that rest on them, in a step from a state: see `Resting.of`; None where there are none."""
        if not self.obstacles:
            return None
        from .contact.resting import Resting

        return Resting.of(self.obstacles, state, self.acceleration(state), origin, span, end, self.free_masks(state.dim))

    def _step(self, before: State, moved: State, dt: Array, meets: bool) -> Step:
        """What the rules may know of a step; what only obstacles ask for is None where there are none."""
        if not meets:
            sees_free = any(part.sees_free for _, part in self.followers)
            return Step(before, moved, dt, self.free_masks(moved.dim) if sees_free else None)
        lagging = tuple(f for f in self.forces if reads_velocity(f, moved))

        def by_velocity(velocity: Vector) -> Vector:
            at = moved.moved(moved.position, velocity)
            forces = [f.force(at) for f in lagging]
            return self.hold(sum(forces[1:], start=forces[0]) * (1 / self.mass))

        return Step(before, moved, dt, self.free_masks(moved.dim), by_velocity if lagging else None)

    def force(self, state: State) -> Vector:
        """Sum of all forces on each node [N], also where it is held (there it is what the hold must balance)."""
        total = None
        for effect in self.forces:
            f = _on_nodes(effect, effect.force(state), state)
            total = f if total is None else total + f
        return Vector.zeros_like(state.position) if total is None else total

    def acceleration(self, state: State) -> Vector:
        """Force over mass where free, exactly zero where held [m/s^2]."""
        return self.hold(self.force(state) * (1 / self.mass))

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """K = -dF/dx [N/m], of the forces that name it."""
        return _sum_blocks(f.stiffness_blocks(state, linearisation) for f in self.forces)

    def damping_blocks(self, state: State) -> Blocks:
        """G = -dF/dv [N s/m], of the forces that name it."""
        return _sum_blocks(f.damping_blocks(state) for f in self.forces)

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """What an implicit step minimises besides the inertia [J]; None where a force has no potential."""
        parts = [f.incremental_potential(state, dt) for f in self.forces]
        if any(part is None for part in parts):
            return None
        return sum((part for part in parts if part is not None), start=jnp.zeros((), state.dtype))

    @property
    def is_symmetric(self) -> bool:
        """Whether every force has a symmetric Jacobian."""
        return all(f.is_symmetric for f in self.forces)

    def energy(self, state: State) -> Energy:
        """Kinetic energy and each force's potential [J]."""
        kinetic = 0.5 * jnp.sum(self.mass * state.velocity.dot(state.velocity))
        return Energy(kinetic, tuple(f.energy(state) for f in self.forces))


def _on_nodes(effect: Force, force: Any, state: State) -> Vector:
    """The force, where it is one on each node. A net without springs gives no coordinates, which stands for zero."""
    if isinstance(force, Vector) and force.dim == 0:
        return Vector.zeros_like(state.position)
    if not isinstance(force, Vector) or force.dim != state.dim or force.shape != state.position.shape:
        found = f"a Vector of {force.dim} arrays of shape {force.shape}" if isinstance(force, Vector) else f"a {type(force).__name__}"
        wanted = f"a Vector of {state.dim} arrays of shape {state.position.shape}, one for each coordinate"
        raise TypeError(f"{type(effect).__name__}.force gives {found}; expected {wanted}.")
    return force


def _updated(part: Rule, step: Step, state: State) -> tuple[State, Status]:
    """The state after a part has acted, and its status.

    Raises:
        TypeError: what it gives is not these two, or what it keeps has another structure, shape or type than what it remembered.
    """
    found: Any = part.update(step, state)
    name = type(part).__name__
    if not (isinstance(found, tuple) and len(found) == 2 and isinstance(found[0], State) and isinstance(found[1], Status)):
        said = ", ".join(type(entry).__name__ for entry in found) if isinstance(found, tuple) else type(found).__name__
        raise TypeError(f"{name}.update gives {said}; expected a state and a status: return state, js.Status.ok().")
    old, new = (jax.tree.map(lambda a: (jnp.shape(a), jnp.result_type(a)), s.memory) for s in (state, found[0]))
    if old != new:
        raise TypeError(
            f"{name}.update keeps another structure, shape or type than {name}.remember gave. A memory's shapes must not change."
        )
    return found


def _struck(obstacles: tuple[Rule, ...], step: Step, state: State, books: bool, is_kicked: bool) -> tuple[State, Status, Books | None]:
    """The state after the impacts of a step: on planes alone by their own pass, which knows when a node meets one in closed form."""
    if all(isinstance(part, Floor) for part in obstacles):
        planes = tuple(part.plane(step.moved) for part in obstacles if isinstance(part, Floor))
        return strike(planes, step, state, books, is_kicked)
    from .contact.rule import strike as strike_any

    return strike_any(obstacles, step, state, books, is_kicked)


def _placed(status: Status, effect: int) -> Status:
    """The status naming this effect, where anything went wrong."""
    placed = jnp.where(status.flags != 0, jnp.asarray(effect, jnp.int32), status.effect)
    return eqx.tree_at(lambda s: s.effect, status, placed)


def reads_velocity(force: Force, state: State) -> bool:
    """Whether the program of a force names the velocities at all."""
    program = jax.make_jaxpr(lambda v: force.force(state.moved(state.position, v)))(state.velocity).jaxpr
    inputs = {id(v) for v in program.invars}
    read = [v for equation in program.eqns for v in equation.invars]
    return any(id(v) in inputs for v in (*read, *program.outvars))


def _sum_blocks(parts: Iterable[Blocks | None]) -> Blocks:
    return sum((part for part in parts if part is not None), start=Blocks())


__all__ = ["BoundSystem", "Energy", "reads_velocity"]
