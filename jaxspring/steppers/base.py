"""What a stepper is: `init` and `step`, pure functions of the system and the state."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.base import Force
from ..linalg.base import SolveInfo
from ..state import State
from ..vector import Vector


class Stepper(eqx.Module):
    """Advances a state by one time step. Abstract.

    To write your own, subclass it and give `step`. A stepper that carries something from step to step (an acceleration, a factor)
    returns it from `init` and from every `step`. Held nodes: call `system.hold` on what you add to the velocity.
    """

    def init(self, system: BoundSystem, state: State) -> Any:
        """What the stepper carries before its first step; None where it carries nothing."""
        return None

    @abc.abstractmethod
    def step(self, system: BoundSystem, state: State, dt: Array, memory: Any) -> tuple[State, Any]:
        """The state one `dt` [s] later, and what to carry. The caller sets the new state's time."""

    def after_rules(self, system: BoundSystem, before: State, moved: State, now: State, dt: Array, memory: Any) -> Any:
        """What to carry where rules have changed positions, velocities, springs or commands: the step began at `before`, motion ended at
        `moved`, rules left `now`. A stepper that carries what belongs to these makes it anew; called only where a rule may change them.
        """
        return memory

    @property
    def runs_backward(self) -> bool:
        """Whether dt may be negative."""
        return True

    def report(self, memory: Any) -> SolveInfo | None:
        """How the linear or nonlinear solve of the last step ended; None for a stepper that solves nothing."""
        return None

    def pushed(self, memory: Any) -> Vector | None:
        """Change of velocity that obstacles gave to nodes in the last step already [m/s], since the step held them there: what their rule
        then books and takes friction by. None for a stepper that knows of no obstacles.
        """
        return None

    def lags_damping(self, effect: Force, state: State) -> bool:
        """Whether the damping of a force is taken at an old velocity, so that it counts in `limit`."""
        return True

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array | None:
        """Largest stable dt [s] for motions of at most that squared frequency [1/s^2] and a damping rate c = gamma / m [1/s] within the
        two bounds; None where the stepper does not know.
        """
        return None
