"""A system: nodes with mass, the forces that its scene names, and what is held fixed.

    m_i a_i + gamma_i v_i - g_i - f_i = 0        i.e.  m_i a_i = sum of all forces        [N]

Source: slide "System Dynamics" (Lagrange's equations of motion).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import printing
from ._arrays import Numbers, as_mask, kept
from ._checks import as_inexact, has_shape, positive, shape_of
from .forces.base import Force, Rule, Step
from .forces.contact import strike
from .forces.linearisation import Linearisation
from .linalg.operators import Blocks, SpringMatrix
from .numerics import cast_inexact
from .pickling import refuse_local_functions
from .state import State
from .status import Status
from .topology.base import Topology
from .topology.periods import box_of, same_box
from .vector import Vector

Free = Array | tuple[Array, ...] | None


class Energy(eqx.Module):
    """Energy ledger of one state [J].

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


class System(eqx.Module):
    """Masses, forces and constraints on a topology. `eqx.filter_grad` with respect to it is the parameter gradient.

    Attributes:
        net: the topology.
        mass: [kg], a number or a node array.
        forces: the effects of the scene, in the order of their indices in statuses.
        free: None (all move), a bool node array, or one per coordinate: False is held at its place, exactly.
        motion: nodes moved by a schedule, or None.
        rules: what happens after each step besides motion, in this order: heat, breaking, contact. None where there are none.
    """

    net: Topology
    mass: Array
    forces: tuple[Force, ...]
    free: Free
    motion: Motion | None
    rules: tuple[Rule, ...] | None

    def __init__(
        self,
        net: Topology,
        mass: Numbers,
        forces: Force | Sequence[Force] = (),
        free: Numbers | None = None,
        motion: Motion | None = None,
        rules: Rule | Sequence[Rule] = (),
    ):
        """Args:
            net: the topology.
            mass: [kg]: a number, or (N,) in the user's order.
            forces: the effects; a single force is taken as a tuple of one.
            free: None, (N,) or (N, D) booleans in the user's order; False holds a node, or one coordinate of it.
            motion: nodes moved by a schedule (they count as not free).
            rules: what happens after each step besides motion; a single rule is taken as a tuple of one.

        Raises:
            ValueError: a mass that is not positive (named with its node), a wrong shape, forces on another topology.
            TypeError: something in `forces` that is not a `Force`, in `rules` that is not a rule; `free` that is not boolean.
        """
        mass = as_inexact("mass", mass)
        positive("mass", mass, "A node without mass would get an infinite acceleration.")
        self.net = net
        self.mass = net.node_field(mass, "mass")
        self.forces = tuple(self._adopt(i, f) for i, f in enumerate(forces if isinstance(forces, Iterable) else (forces,)))
        # None, not an empty tuple, which some transformations of equinox and diffrax mistake for an array.
        self.rules = tuple(self._adopt_rule(i, r) for i, r in enumerate(rules if isinstance(rules, Iterable) else (rules,))) or None
        _act_together(self.rules or ())
        self.free = _as_free(net, free)
        self.motion = motion
        if motion is not None:
            moved = as_mask("motion.moved", motion.moved, ", True where a node follows the schedule")
            has_shape("motion.moved", moved, {"one per node": (net.n_nodes,), "node shape": net.node_shape})

    def __str__(self) -> str:
        """A few lines for a person."""
        return printing.system(self)

    def __getstate__(self) -> dict[str, Any]:
        """What pickle stores. Raises PicklingError for a lambda, naming its field."""
        refuse_local_functions(self)
        return dict(self.__dict__)

    def __copy__(self) -> System:
        """Another object of the same parts: a system never changes."""
        return jax.tree.map(lambda leaf: leaf, self)

    def __deepcopy__(self, memo: dict[int, Any]) -> System:
        """The same with arrays of its own; functions are shared."""
        return jax.tree.map(lambda leaf: copy.deepcopy(leaf, memo), self)

    def _cast(self, effect: Force, state: State) -> Force:
        """The effect in its system, and constants of the state's dtype: float32 in, float32 out, whatever the constants were."""
        inside = effect.with_box(box_of(self.net)).with_mass(self.mass).with_forces(self.forces)
        return cast_inexact(inside, self._taken(state).dtype)

    def _taken(self, state: State) -> State:
        """The state, where this is one system and that one state, which JAX can compute."""
        self._refuse_stack()
        return state.checked()

    def _refuse_stack(self) -> None:
        rank = len(self.net.node_shape)
        if shape_of(self.mass) not in ((), self.net.node_shape) or any(len(shape) != rank for shape in self.net.family_shapes):
            raise ValueError(
                f"the system's mass has shape {shape_of(self.mass)}, that of one system () or {self.net.node_shape}: these are many "
                f"systems, stacked. Run them by jax.vmap(lambda system: ...)(systems). Nets of other springs cannot be stacked: run each "
                f"by itself."
            )

    def _adopt(self, i: int, force: Any) -> Force:
        if isinstance(force, Rule) and not isinstance(force, Force):
            raise TypeError(f"forces[{i}] is a {type(force).__name__}, which is a rule and no force. Pass it in rules=.")
        if not isinstance(force, Force):
            raise TypeError(f"forces[{i}] is a {type(force).__name__}; expected a Force, e.g. Springs(net, ...) or Drag(gamma).")
        return self._on_this_net(f"forces[{i}]", force)

    def _adopt_rule(self, i: int, rule: Any) -> Rule:
        if not isinstance(rule, Rule) or isinstance(rule, Force):
            raise TypeError(f"rules[{i}] is a {type(rule).__name__}; expected a rule, e.g. Heat(net, ...); forces belong to `forces`.")
        return self._on_this_net(f"rules[{i}]", rule)

    def _on_this_net(self, name: str, effect: Any) -> Any:
        other = getattr(effect, "net", None)
        if other is not None and (other.node_shape != self.net.node_shape or other.node_permutation != self.net.node_permutation):
            raise ValueError(f"{name} ({type(effect).__name__}) was built on another topology than the system.")
        if other is not None and not same_box(box_of(other), box_of(self.net)):
            raise ValueError(
                f"{name} ({type(effect).__name__}) was built on a net with box = {box_of(other)}, but the system's net has "
                f"{box_of(self.net)}. Some forces would act through the walls, and others not. Build all on one net."
            )
        effect.with_box(box_of(self.net))  # refuses a box that is too small
        return effect

    def _owning(self, state: State) -> State:
        """The state, whose broken springs and changed rest lengths are those of the system's net where they do not say: a field made by
        hand would else be taken for every net with fields of its shapes.
        """
        if state.alive is None and state.rest_length is None:
            return state
        given = (state.alive, state.rest_length)
        alive, rest_length = (self.net.own(f.families) if f is not None and self.net.owns(f) else f for f in given)
        return dataclasses.replace(state, alive=alive, rest_length=rest_length)

    @property
    def parts(self) -> tuple[Rule, ...]:
        """Forces, then rules: in the order of their indices in a status."""
        return (*self.forces, *(self.rules or ()))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of forces and rules, in the order of their indices in a status."""
        return tuple(type(part).__name__ for part in self.parts)

    @property
    def followers(self) -> tuple[tuple[int, Rule], ...]:
        """Whatever acts after a step, with its index in a status: forces that keep a memory, then the rules."""
        return tuple((i, part) for i, part in enumerate(self.parts) if not isinstance(part, Force) or part.is_rule)

    def begin(self, state: State) -> State:
        """The constrained state with the memory that forces and rules need."""
        state = self.constrain(self._owning(state))
        for _, rule in self.followers:
            state = rule.begin(state)
        return state

    def follow(self, before: State, state: State, dt: Array) -> tuple[State, Status]:
        """What happens after a step besides motion, and what went wrong there: obstacles last, all of them together."""
        total = Status.ok()
        step = self._step(before, state, dt)
        last = tuple((i, rule) for i, rule in self.followers if rule.obstacles)
        for i, rule in self.followers:
            if not rule.obstacles:
                state, status = rule.update(step, state)
                total = total.then(_placed(status, i))
        if len(last) > 1:
            state, status, _ = strike(tuple(rule for _, rule in last), step, state)
            total = total.then(_placed(status, last[0][0]))
        elif last:
            state, status = last[0][1].update(step, state)
            total = total.then(_placed(status, last[0][0]))
        return state, total

    def _step(self, before: State, moved: State, dt: Array) -> Step:
        """What the rules may know of a step; what only obstacles ask for is None where there are none."""
        if not any(rule.obstacles for _, rule in self.followers):
            return Step(before, moved, dt)
        lagging = tuple(f for f in self.forces if _reads_velocity(self._cast(f, moved), moved))

        def by_velocity(velocity: Vector) -> Vector:
            at = moved.moved(moved.position, velocity)
            forces = [self._cast(f, at).force(at) for f in lagging]
            return self.hold(sum(forces[1:], start=forces[0]) * (1 / self.mass.astype(at.dtype)))

        return Step(before, moved, dt, self.free_masks(moved.dim), by_velocity if lagging else None)

    def prepare(self, dtype: Any) -> System:
        """The system as a loop wants it: every constant in the shape of the topology and of `dtype`."""
        self._refuse_stack()
        box = box_of(self.net)
        alone = tuple(f.with_box(box).with_mass(self.mass).prepare(dtype) for f in self.forces)
        forces = tuple(f.with_forces(alone) for f in alone)
        ready = eqx.tree_at(lambda s: s.forces, self, forces)
        if self.rules:
            rules = tuple(r.with_box(box).with_mass(self.mass).with_forces(forces).prepare(dtype) for r in self.rules)
            ready = eqx.tree_at(lambda s: s.rules, ready, rules)
        return cast_inexact(ready, dtype)

    def force(self, state: State) -> Vector:
        """Sum of all forces on each node [N], also where it is held (there it is what the hold must balance)."""
        total, state = None, self._owning(state)
        for effect in self.forces:
            f = self._cast(effect, state).force(state)
            total = f if total is None else total + f
        return Vector.zeros_like(state.position) if total is None else total

    def acceleration(self, state: State) -> Vector:
        """Force over mass where free, exactly zero where held [m/s^2]."""
        return self.hold(self.force(state) * (1 / self.mass.astype(state.dtype)))

    def reaction(self, state: State) -> Vector:
        """Force of the holds on the nodes [N]: minus the net force where held, zero where free."""
        free = self.free_masks(state.dim)
        force = self.force(state)
        return Vector(
            tuple(jnp.zeros_like(f) if m is None else jnp.where(m, jnp.zeros_like(f), -f) for f, m in zip(force, free, strict=True))
        )

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """K = -dF/dx [N/m], of the forces that name it."""
        state = self._owning(state)
        return _sum_blocks(self._cast(f, state).stiffness_blocks(state, linearisation) for f in self.forces)

    def damping_blocks(self, state: State) -> Blocks:
        """G = -dF/dv [N s/m], of the forces that name it."""
        state = self._owning(state)
        return _sum_blocks(self._cast(f, state).damping_blocks(state) for f in self.forces)

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """What an implicit step minimises besides the inertia [J]; None where a force has no potential."""
        state = self._owning(state)
        parts = [self._cast(f, state).incremental_potential(state, dt) for f in self.forces]
        if any(part is None for part in parts):
            return None
        return sum((part for part in parts if part is not None), start=jnp.zeros((), state.dtype))

    def matrix(self, blocks: Blocks, state: State) -> SpringMatrix:
        """The blocks as a matrix over the coordinates, identity where held."""
        return SpringMatrix(blocks, self.free_masks(state.dim), state.position, state.layout)

    def is_symmetric(self, state: State) -> bool:
        """Whether every force has a symmetric Jacobian."""
        return all(f.is_symmetric(state) for f in self.forces)

    def hold(self, v: Vector) -> Vector:
        """`v` where free, zero where held."""
        return Vector(tuple(a if m is None else jnp.where(m, a, jnp.zeros_like(a)) for a, m in zip(v, self.free_masks(v.dim), strict=True)))

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

    @property
    def moved_nodes(self) -> Array:
        """Which nodes follow a schedule, bool, node shape."""
        if self.motion is None:
            return jnp.zeros(self.net.node_shape, bool)
        return self.net.node_field(self.motion.moved, "motion.moved")

    def stage(self, state: State) -> State:
        """A state within a step with moved nodes where their schedule has them at its time: at their place of the step's start, a
        stepper would lose its order.
        """
        return state if self.motion is None else self.constrain(state)

    def energy(self, state: State) -> Energy:
        """Kinetic energy and each force's potential [J]."""
        state = self._owning(self._taken(state))
        kinetic = 0.5 * jnp.sum(self.mass.astype(state.dtype) * state.velocity.dot(state.velocity))
        return Energy(kinetic, tuple(self._cast(f, state).energy(state) for f in self.forces))

    def momentum(self, state: State) -> Array:
        """(D,) total momentum [kg m/s]."""
        return jnp.stack([jnp.sum(self.mass.astype(self._taken(state).dtype) * a) for a in state.velocity])

    def angular_momentum(self, state: State) -> Array:
        """About the origin [kg m^2/s]: (3,) in space, (1,) in the plane."""
        m, x, p = self.mass.astype(self._taken(state).dtype), state.position, state.velocity
        if state.dim == 1:
            raise ValueError("Angular momentum needs 2 or 3 coordinates; these positions have 1.")
        pairs = [(0, 1)] if state.dim == 2 else [(1, 2), (2, 0), (0, 1)]
        return jnp.stack([jnp.sum(m * (x[i] * p[j] - x[j] * p[i])) for i, j in pairs])

    def free_masks(self, dim: int) -> tuple[Array | None, ...]:
        """Per coordinate, where nodes are free (None: all are)."""
        free = self.free if isinstance(self.free, tuple) else (self.free,) * dim
        if len(free) != dim:
            raise ValueError(f"free has {len(free)} coordinates, the state has {dim}.")
        if self.motion is None:
            return free
        still = ~self.moved_nodes
        return tuple(still if m is None else m & still for m in free)


def _act_together(rules: tuple[Rule, ...]) -> None:
    """Raises ValueError where obstacles stand beside a rule that runs its own: they would act in two passes."""
    last = [rule for rule in rules if rule.obstacles]
    books = [type(rule).__name__ for rule in last if not any(obstacle is rule for obstacle in rule.obstacles)]
    if len(last) > 1 and books:
        raise ValueError(
            f"rules hold {len(last)} obstacles or sets of them, one within {books[0]}. All obstacles act together, the earliest impact "
            f"first: put all of them into the {books[0]}."
        )


def _placed(status: Status, effect: int) -> Status:
    """The status naming this effect, where anything went wrong."""
    placed = jnp.where(status.flags != 0, jnp.asarray(effect, jnp.int32), status.effect)
    return eqx.tree_at(lambda s: s.effect, status, placed)


def _reads_velocity(force: Force, state: State) -> bool:
    """Whether the program of a force names the velocities at all."""
    program = jax.make_jaxpr(lambda v: force.force(state.moved(state.position, v)))(state.velocity).jaxpr
    inputs = {id(v) for v in program.invars}
    read = [v for equation in program.eqns for v in equation.invars]
    return any(id(v) in inputs for v in (*read, *program.outvars))


def _sum_blocks(parts: Iterable[Blocks | None]) -> Blocks:
    return sum((part for part in parts if part is not None), start=Blocks())


def _as_free(net: Topology, free: Any) -> Free:
    if free is None:
        return None
    free = as_mask("free", free, ": True moves, False is held")
    if len(shape_of(free)) == 2 and free.shape != net.node_shape:
        has_shape("free", free, {"per node": (net.n_nodes,), "per node and coordinate": (net.n_nodes, min(free.shape[1], 3))})
        return tuple(net.node_field(free[:, i], "free") for i in range(free.shape[1]))
    return net.node_field(free, "free")
