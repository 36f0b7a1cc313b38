"""What a force is: a function of the state, with what the system may ask of it.

A rule is what happens to a state besides motion, after each step: heat flows, springs break.

Write your own by subclassing `Force`: `force` alone is enough. `energy` closes the ledger, `stiffness_bound` serves `stable_dt`, and
`diagnose` tells what it saw when the status is taken.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from .. import printing
from ..linalg.operators import Blocks
from ..memory import Memory, Owner, entry_at, with_entry
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.periods import box_of
from ..vector import Vector
from .linearisation import Linearisation

# Share of a force that rounding may take before PRECISION is told: three digits are left. The threshold is a choice.
SPOILT = 1e-3


class Finding(eqx.Module):
    """Something an effect has to report about a state.

    Attributes:
        flag: which kind of trouble (static).
        count: how many nodes or springs show it; 0 is none.
        node: flat index of the first of them, -1 where it is a spring.
    """

    flag: Flag = eqx.field(static=True)
    count: Array
    node: Array


class Step(eqx.Module):
    """The step that a rule follows.

    Attributes:
        before: the state in which it began.
        moved: where motion took it, before any rule.
        dt: [s].
        free: per coordinate, where nodes are free (None: all are). None where no obstacle asks, nor a rule that `sees_free`.
        pushed: change of velocity that obstacles gave in the step already [m/s], which held nodes there; None where no step holds any.
        by_velocity: (velocities) -> accelerations [m/s^2] by the forces that depend on velocity, where motion ended; None where no force
            does, or no obstacle asks.
        stages: what the rules before this one left, in their order: (place, state), all obstacles together as one of place -1.
        impacts: what each obstacle did, for a rule that watches, or None.
    """

    before: State
    moved: State
    dt: Array
    free: tuple[Array | None, ...] | None = None
    by_velocity: Callable[[Vector], Vector] | None = None
    pushed: Vector | None = None
    stages: tuple[tuple[int, State], ...] = ()
    impacts: Any = None


class Scene:
    """What a part is told of its system when it is bound.

    Attributes:
        net: of the system.
        mass: node masses [kg], one number or a node array.
        dtype: of the state.
        forces: of the system, not bound.
        rules: of the system, not bound.
    """

    def __init__(self, net: Topology, mass: Array, dtype: DTypeLike, forces: tuple[Force, ...], rules: tuple[Rule, ...]):
        self.net, self.mass, self.dtype, self.forces, self.rules = net, mass, dtype, forces, rules
        self._bound: dict[int, Any] = {}

    @property
    def box(self) -> Array | None:
        """(D,) periods of the coordinates [m], or None."""
        return box_of(self.net)

    def bound(self, place: int) -> Any:
        """The part at this place, bound; each is bound once, and the others hold no copy of it."""
        if place not in self._bound:
            part = (*self.forces, *self.rules)[place]
            part.check(self)
            self._bound[place] = _placed(part.bind(self), place)
        return self._bound[place]


class Rule(eqx.Module):
    """What happens to a state after each step, besides motion. Abstract.

    Rules run in the order in which the system names them, each on the state that the one before left; then all obstacles, together; then
    those that drive; then those that watch. A stepper is told where a rule may have changed positions or velocities (`moves`).

    What it must know from step to step it gives in `remember`, reads by `recall` and writes by `keep`.

    Attributes:
        is_obstacle: whether nodes meet it: all of a system's act together, the earliest impact first (class attribute).
        is_cache: whether what it remembers can be made anew from the state (class attribute).
        sets_temperature: whether it changes temperatures: it is named where one is NaN or infinite (class attribute).
        moves: whether it may change positions or velocities (class attribute).
        breaks: whether it may change which springs hold, or their rest lengths (class attribute).
        drives: whether it acts after the obstacles, on the state in which the next step begins, and changes neither positions nor
            velocities: it gives commands that hold for a step (class attribute).
        watches: whether it acts last, and is told by `Step.stages` what all the others did (class attribute).
        sees_free: whether it reads `Step.free` (class attribute; obstacles may in any case).
        place: which part of its system it is, once bound: its index in a status and in `state.memory` (static).
    """

    is_obstacle: ClassVar[bool] = False
    is_cache: ClassVar[bool] = False
    moves: ClassVar[bool] = True
    breaks: ClassVar[bool] = True
    sets_temperature: ClassVar[bool] = False
    drives: ClassVar[bool] = False
    watches: ClassVar[bool] = False
    sees_free: ClassVar[bool] = False
    place: int | None = eqx.field(static=True, init=False, default=None)

    def __str__(self) -> str:
        """A line for a person."""
        return printing.effect(self)

    @property
    def is_idle(self) -> bool:
        """Whether, as it was made, it does nothing after a step and remembers nothing, though its class can."""
        return False

    @property
    def does_work(self) -> bool:
        """Whether it may do work on what rests on it: an obstacle that moves."""
        return False

    def check(self, scene: Scene) -> None:
        """Raise ValueError where it does not fit the system. Called when the system is made, and when it is bound."""

    def bind(self, scene: Scene) -> Self:
        """The same as the loop wants it: every constant in the shape and dtype of the state, with what it needs of the scene. Called once,
        before the loop. It may take `scene.mass` and, by `scene.bound(i)`, other parts.
        """
        return cast_inexact(self, scene.dtype)

    def begin(self, state: State) -> State:
        """The state with what this rule needs of the fields that all effects share. Called before the first step."""
        return state

    def remember(self, state: State) -> Any:
        """What it remembers at the start of a run, any tree of arrays; None: nothing. Its shapes must not change later."""
        return None

    def renew(self, memory: Any, state: State) -> Any:
        """The memory of an earlier run as one that goes on from `state` may use it."""
        return memory

    def recall(self, state: State) -> Any:
        """What it remembers in this state; what `remember` gives where that is nothing yet.

        Raises:
            ValueError: it gives no `remember`; a part that is not bound, where the state remembers something of several of its kind.
        """
        entry = entry_at(state.memory, self.place) if self.place is not None else self._only_entry(state)
        memory = self.remember(state) if entry is None else entry.value
        if memory is None:
            raise ValueError(f"{type(self).__name__} recalls what it never remembered. Give it a method remember(state).")
        return memory

    def _only_entry(self, state: State) -> Memory | None:
        """The entry of a part outside its bound system: the one that is of its class and net."""
        own = [entry for entry in state.memory or () if entry is not None and entry.owner == Owner.of(self)]
        if len(own) > 1:
            raise ValueError(
                f"the state remembers something of {len(own)} parts that are {Owner.of(self)}. Ask the one that is meant: "
                f"system.bind(state.dtype).parts[i]."
            )
        return own[0] if own else None

    def keep(self, state: State, memory: Any) -> State:
        """The state in which it remembers this. Only a bound part has a place there."""
        if self.place is None:
            raise ValueError(f"{type(self).__name__} has no place in a state's memory yet. Ask the parts of system.bind(state.dtype).")
        entry = Memory(memory, Owner.of(self), self.is_cache)
        return dataclasses.replace(state, memory=with_entry(state.memory, self.place, entry))

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state after this rule, where `state` is what motion and the rules before it left, and what went wrong."""
        return state, Status.ok()

    def overshoot(self, before: State, after: State) -> tuple[int, Array] | None:
        """Of what it took between these two states, what the step had put there only since the rule acts once in it: of which force, by
        its place, and how much [J]. Books count it as of the step. None: nothing.
        """
        return None

    def limit(self, state: State) -> Array | None:
        """Largest stable dt [s]; None where nothing limits it."""
        return None

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """What this effect has to report about a state: see `Finding`."""
        return ()

    def diagnose_since(self, start: State, state: State) -> tuple[Finding, ...]:
        """What it has to report about a state that a run has brought from `start`, besides `diagnose`."""
        return ()

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse (for values that were traced then, or changed since)."""
        return None


class Force(Rule):
    """A force on the nodes. Abstract; `Springs`, `Drag`, `Gravity` and the others are final.

    A force may act as a rule, too: one that remembers something gives `remember` and `update`.
    """

    @abc.abstractmethod
    def force(self, state: State) -> Vector:
        """Force on each node [N], in node shape."""

    @property
    def has_potential(self) -> bool:
        """Whether it is the gradient of an `energy`: one that gives an `energy` is, unless it says no."""
        return type(self).energy is not Force.energy

    @property
    def is_symmetric(self) -> bool:
        """Whether -dF/dx and -dF/dv are symmetric, so that conjugate gradients apply: a force with a potential is."""
        return self.has_potential

    @property
    def can_feed(self) -> bool:
        """Whether it can raise the sum of kinetic and potential energy; one without a potential can, unless it says no."""
        return not self.has_potential

    def energy(self, state: State) -> Array | None:
        """Potential energy [J], or None where the force has no potential."""
        return None

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks | None:
        """-dF/dx [N/m] as blocks of nodes and springs, for implicit steps; None: taken at the old time there."""
        return None

    def damping_blocks(self, state: State) -> Blocks | None:
        """-dF/dv [N s/m] as blocks of nodes and springs, for implicit steps; None: taken at the old time there."""
        return None

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """What an implicit step minimises for this force [J]: a function of the state that is reached, its time held, whose gradient by
        position is minus the force when the velocity is displacement / dt. The energy, unless said; None where there is none.
        """
        return self.energy(state)

    def stiffness_bound(self, state: State) -> Array | None:
        """Upper bound of the row sums of |dF/dx| at each node [N/m], in node shape or a number; None where zero."""
        return None

    def damping_bound(self, state: State) -> Array | None:
        """Upper bound of the row sums of |dF/dv| at each node [N s/m]; None where zero."""
        return None

    def damping_floor(self, state: State) -> Array | None:
        """Lower bound of -dF/dv on every motion of a node [N s/m]; None where zero."""
        return None

    def rounding(self, state: State) -> Array | None:
        """Rounding error of a position, relative to the smallest length that the effect must resolve; None where it takes no difference."""
        return None


def check_class(part: Rule) -> None:
    """TypeError where a class of a user's own has a field in the place of a method, or a method in the place of a property: what a force
    says of itself must be a bool, else every condition on it would hold.
    """
    kind = Force if isinstance(part, Force) else Rule
    kinds = type(part).__mro__[: type(part).__mro__.index(Rule)]
    if any("place" in vars(kind).get("__annotations__", {}) for kind in kinds):
        raise TypeError(f"{type(part).__name__} has a field place, which is the part's number in its system. Rename the field.")
    for field in dataclasses.fields(part):
        if field.name != "place" and callable(getattr(kind, field.name, None)):
            raise TypeError(
                f"{type(part).__name__} has a field {field.name}, but {kind.__name__}.{field.name} is a method. Rename the field."
            )
    for name in ("has_potential", "is_symmetric", "can_feed") if isinstance(part, Force) else ():
        if not isinstance(getattr(part, name), bool):
            raise TypeError(
                f"{type(part).__name__}.{name} is a {type(getattr(part, name)).__name__}; expected a bool: make it a @property."
            )


def _placed(part: Any, place: int) -> Any:
    """The part, knowing its place: a copy, since a part never changes."""
    copy = jax.tree.map(lambda leaf: leaf, part)
    object.__setattr__(copy, "place", place)
    return copy


def acts(part: Rule) -> bool:
    """Whether it does something after a step."""
    return type(part).update is not Rule.update and not part.is_idle


def remembers(part: Rule) -> bool:
    """Whether it may remember something."""
    return type(part).remember is not Rule.remember and not part.is_idle


def any_refused(*values: Any) -> Array:
    """True where any entry of any array is what a constructor refuses: negative, NaN or infinite."""
    bad = jnp.zeros((), bool)
    for leaf in jax.tree.leaves(values):
        bad = bad | ~jnp.all((leaf >= 0) & jnp.isfinite(leaf))
    return bad


def any_not_positive(*values: Any) -> Array:
    """True where any entry of any array is zero, negative, NaN or infinite."""
    bad = any_refused(values)
    for leaf in jax.tree.leaves(values):
        bad = bad | jnp.any(leaf == 0)
    return bad
