"""What a force is: a function of the state, with what the system may ask of it.

A rule is what happens to a state besides motion, after each step: heat flows, springs break.

Write your own by subclassing `Force`: `force` alone is enough. `energy` closes the ledger, `stiffness_bound` serves `stable_dt`, and
`diagnose` tells what it saw when the status is taken.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .. import printing
from ..linalg.operators import Blocks
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag, Status
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
        free: per coordinate, where nodes are free (None: all are). None where no obstacle asks.
        by_velocity: (velocities) -> accelerations [m/s^2] by the forces that depend on velocity, where motion ended; None where no force
            does, or no obstacle asks.
    """

    before: State
    moved: State
    dt: Array
    free: tuple[Array | None, ...] | None = None
    by_velocity: Callable[[Vector], Vector] | None = None


class Rule(eqx.Module):
    """What happens to a state after each step, besides motion. Abstract.

    Rules run in the order in which the system names them, each on the state that the one before left; obstacles come last, together. A
    rule that gives the state another position or velocity tells the stepper so by that alone.
    """

    def __str__(self) -> str:
        """A line for a person."""
        return printing.effect(self)

    @property
    def obstacles(self) -> tuple[Rule, ...]:
        """The obstacles that it holds, itself where it is one. All of a system's act together, the earliest impact first."""
        return ()

    @property
    def sets_temperature(self) -> bool:
        """Whether it changes temperatures: it is named where one is NaN or infinite."""
        return False

    def begin(self, state: State) -> State:
        """The state with the memory that this rule needs, made where it is not there yet. Called before the first step."""
        return state

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state after this rule, where `state` is what motion and the rules before it left, and what went wrong."""
        return state, Status.ok()

    def limit(self, state: State) -> Array | None:
        """Largest stable dt [s]; None where nothing limits it."""
        return None

    def prepare(self, dtype: Any) -> Self:
        """The same with every constant in the shape and dtype that the loop wants. Called once, before the loop."""
        return cast_inexact(self, dtype)

    def with_mass(self, mass: Array) -> Self:
        """The same, knowing the node masses [kg]; only what needs them answers with another object."""
        return self

    def with_box(self, box: Array | None) -> Self:
        """The same, knowing the periods [m] of the system's coordinates (None: there are none), which it must fit; only what takes
        differences without a net needs them.
        """
        return self

    def with_forces(self, forces: tuple[Force, ...]) -> Self:
        """The same, knowing all forces of its system; only what needs them answers with another object."""
        return self

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

    A force may act as a rule, too: one that keeps a list up to date gives `begin` and `update`, and says so in `is_rule`.
    """

    @abc.abstractmethod
    def force(self, state: State) -> Vector:
        """Force on each node [N], in node shape."""

    @property
    def is_rule(self) -> bool:
        """Whether `begin` and `update` are to be called."""
        return False

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

    def is_symmetric(self, state: State) -> bool:
        """Whether -dF/dx and -dF/dv are symmetric, so that conjugate gradients apply: a force with a potential is."""
        return self.energy(state) is not None

    def can_feed(self, state: State) -> bool:
        """Whether the force can raise the sum of kinetic and potential energy; one without a potential can, unless it says no."""
        return self.energy(state) is None

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
