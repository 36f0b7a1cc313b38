"""A system: nodes with mass, the forces that its scene names, and what is held fixed.

    m_i a_i + gamma_i v_i - g_i - f_i = 0        i.e.  m_i a_i = sum of all forces        [N]

Source: slide "System Dynamics" (Lagrange's equations of motion).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from . import printing
from ._arrays import Numbers, as_mask
from ._checks import as_inexact, has_shape, positive, shape_of
from .bound import BoundSystem, Energy
from .closures import opened
from .forces.base import Force, Rule, Scene, check_class
from .forces.linearisation import Linearisation
from .linalg.operators import Blocks
from .memory import entry_at
from .nodes import Free, Motion, Nodes
from .pickling import refuse_local_functions
from .state import State
from .topology.base import Topology
from .topology.periods import box_of, same_box
from .vector import Vector


class System(Nodes):
    """Masses, forces and constraints on a topology. `eqx.filter_grad` with respect to it is the parameter gradient.

    Attributes:
        net: the topology.
        mass: [kg], a number or a node array, on a graph in the graph's own order: `net.flatten_nodes(system.mass)` is in the user's.
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
        self.free = _as_free(net, free)
        self.motion = opened(motion, "motion")
        if motion is not None:
            moved = as_mask("motion.moved", motion.moved, ", True where a node follows the schedule")
            has_shape("motion.moved", moved, {"one per node": (net.n_nodes,), "node shape": net.node_shape})
        scene = Scene(net, self.mass, self.mass.dtype, self.forces, self.rules or ())
        for part in self.parts:
            part.check(scene)

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
        check_class(effect)
        effect = opened(effect, f"{name} ({type(effect).__name__})")
        if any(_is_shared(leaf) for leaf in jax.tree.leaves(effect)):
            effect = jax.tree.map(_own_copy, effect)
        if other is not None and not same_box(box_of(other), box_of(self.net)):
            raise ValueError(
                f"{name} ({type(effect).__name__}) was built on a net with box = {box_of(other)}, but the system's net has "
                f"{box_of(self.net)}. Some forces would act through the walls, and others not. Build all on one net."
            )
        return effect

    def bind(self, dtype: DTypeLike) -> BoundSystem:
        """The system as a loop wants it: every constant in the shape of the topology and of `dtype`, every part knowing its masses, its
        place and the others. Made once, inside the program that runs.

        Args:
            dtype: of the state, `state.dtype`.

        Raises:
            ValueError: many systems, stacked; a part that does not fit the system.
        """
        self._refuse_stack()
        return BoundSystem.of(self.net, self.mass, self.forces, self.free, self.motion, self.rules, dtype)

    def _at(self, state: State) -> tuple[BoundSystem, State]:
        """The system bound to the state's dtype, and the state as it takes it."""
        bound = self.bind(self._taken(state).dtype)
        return bound, bound.own(state)

    def begin(self, state: State) -> State:
        """The constrained state with the memory that forces and rules need."""
        bound, state = self._at(state)
        return bound.begin(state)

    def recall(self, state: State, effect: int) -> Any:
        """What a part remembers in this state: the value that it keeps there.

        Args:
            state: one that came out of a run of this system.
            effect: index of the part, forces first and then rules.

        Raises:
            ValueError: it remembers nothing there.
        """
        _, state = self._at(state)
        entry = entry_at(state.memory, effect % len(self.parts))
        if entry is None:
            raise ValueError(f"part {effect} of this system, {self.effects[effect]}, remembers nothing in this state.")
        return entry.value

    def force(self, state: State) -> Vector:
        """Sum of all forces on each node [N], also where it is held (there it is what the hold must balance)."""
        bound, state = self._at(state)
        return bound.force(state)

    def acceleration(self, state: State) -> Vector:
        """Force over mass where free, exactly zero where held [m/s^2]."""
        bound, state = self._at(state)
        return bound.acceleration(state)

    def reaction(self, state: State) -> Vector:
        """Force of the holds on the nodes [N]: minus the net force where held, zero where free."""
        free = self.free_masks(state.dim)
        force = self.force(state)
        return Vector(
            tuple(jnp.zeros_like(f) if m is None else jnp.where(m, jnp.zeros_like(f), -f) for f, m in zip(force, free, strict=True))
        )

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """K = -dF/dx [N/m], of the forces that name it."""
        bound, state = self._at(state)
        return bound.stiffness_blocks(state, linearisation)

    def damping_blocks(self, state: State) -> Blocks:
        """G = -dF/dv [N s/m], of the forces that name it."""
        bound, state = self._at(state)
        return bound.damping_blocks(state)

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """What an implicit step minimises besides the inertia [J]; None where a force has no potential."""
        bound, state = self._at(state)
        return bound.incremental_potential(state, dt)

    def energy(self, state: State) -> Energy:
        """Kinetic energy and each force's potential [J]."""
        bound, state = self._at(state)
        return bound.energy(state)


def _is_shared(leaf: Any) -> bool:
    """Whether a leaf of a part of a user's own is a NumPy array that somebody else may change."""
    return isinstance(leaf, np.ndarray) and leaf.flags.writeable


def _own_copy(leaf: Any) -> Any:
    """Such an array as one that nobody else changes; anything else as it is."""
    if not _is_shared(leaf):
        return leaf
    copied = leaf.copy()
    copied.setflags(write=False)
    return copied


def _as_free(net: Topology, free: Any) -> Free:
    if free is None:
        return None
    free = as_mask("free", free, ": True moves, False is held")
    if len(shape_of(free)) == 2 and free.shape != net.node_shape:
        has_shape("free", free, {"per node": (net.n_nodes,), "per node and coordinate": (net.n_nodes, min(free.shape[1], 3))})
        return tuple(net.node_field(free[:, i], "free") for i in range(free.shape[1]))
    return net.node_field(free, "free")


def as_system(value: Any) -> System:
    """The system itself. TypeError for anything else, a bound system among them."""
    if isinstance(value, BoundSystem):
        raise TypeError("system is a BoundSystem, which a run makes for itself. Pass the System that it was bound from.")
    if not isinstance(value, System):
        raise TypeError(f"system is a {type(value).__name__}; expected a System: js.System(net, mass, forces).")
    return value
