"""What a force is: a function of the state, with what the system may ask of it.

Write your own by subclassing `Force`: `force` alone is enough. `energy` closes the ledger, `stiffness_bound` serves `stable_dt`, and
`diagnose` tells what it saw when the status is taken.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..linalg.operators import Blocks
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag
from ..vector import Vector
from .linearisation import Linearisation


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


class Force(eqx.Module):
    """A force on the nodes. Abstract; `Springs`, `Drag`, `Gravity` and the others are final."""

    @abc.abstractmethod
    def force(self, state: State) -> Vector:
        """Force on each node [N], in node shape."""

    def energy(self, state: State) -> Array | None:
        """Potential energy [J], or None where the force has no potential."""
        return None

    def prepare(self, dtype: Any) -> Force:
        """The same force with every constant in the shape and dtype that the loop wants. Called once, before the loop."""
        return cast_inexact(self, dtype)

    def with_mass(self, mass: Array) -> Force:
        """The force acting on these node masses [kg]; only forces that need them answer with another object."""
        return self

    def with_forces(self, forces: tuple[Force, ...]) -> Force:
        """The force knowing all forces of its system; only forces that need them answer with another object."""
        return self

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

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """What this effect has to report about a state: see `Finding`."""
        return ()

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse (for values that were traced then, or changed since)."""
        return None


def any_refused(*values: Any) -> Array:
    """True where any entry of any array is what a constructor refuses: negative, NaN or infinite."""
    bad = jnp.zeros((), bool)
    for leaf in jax.tree.leaves(values):
        bad = bad | ~jnp.all((leaf >= 0) & jnp.isfinite(leaf))
    return bad
