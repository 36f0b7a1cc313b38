"""Rules about the springs of one net: what `Yielding`, `Tearing` and `Fusing` share.

Breaking clears a spring's bit in `state.alive`. Velocities and positions are untouched, so momentum is continuous; shapes never change. It
is a decision and has no gradient. The energy that a spring held is gone, and a `Ledger` books it under the rule that broke it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from .._checks import is_concrete
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, named_entries
from .base import Rule, Scene
from .living import living
from .molten import check_springs
from .springs import Springs


class SpringRule(Rule):
    """Changes the springs of a net after each step. Abstract: give `update`.

    Attributes:
        net: whose springs are changed; those of other nets over the same nodes stay as they are.
        springs: these, once bound.
        constants: names of fields that hold a number, one per spring, or None (class attribute).
    """

    moves: ClassVar[bool] = False
    constants: ClassVar[tuple[str, ...]] = ()
    net: Topology
    springs: Springs | None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where the system has not exactly one `Springs` on this net."""
        self.own_springs(scene)

    def bind(self, scene: Scene) -> Any:
        """The same with constants as edge fields, knowing the springs of this net."""
        given = [getattr(self, name) for name in self.constants]
        fields = [None if value is None else self.net.edge_field(value, name) for name, value in zip(self.constants, given, strict=True)]
        known = (*cast_inexact(fields, scene.dtype), scene.bound(self.places(scene)[0]))
        names = (*self.constants, "springs")
        return eqx.tree_at(lambda r: tuple(getattr(r, name) for name in names), self, known, is_leaf=lambda leaf: leaf is None)

    def places(self, scene: Scene) -> list[int]:
        """The places of the `Springs` on this net among the parts of a system."""
        return [i for i, f in enumerate(scene.forces) if isinstance(f, Springs) and f.net.identity == self.net.identity]

    def own_springs(self, scene: Scene) -> Springs:
        """The one `Springs` on this net, not bound. Raises ValueError where there is none, or there are several."""
        who = type(self).__name__
        check_springs(who, self.net, scene.forces)
        found = [force for force in (scene.forces[i] for i in self.places(scene)) if isinstance(force, Springs)]
        if len(found) != 1:
            raise ValueError(
                f"{who} needs one Springs on its net, whose pulls it judges; this system has {len(found)}. Put Springs(net, ...) into "
                f"forces=; a second set of springs along the same edges wants a net of its own: net.named('second')."
            )
        return found[0]

    def known_springs(self) -> Springs:
        """The bound springs. Raises ValueError outside a bound system."""
        if self.springs is None:
            who = type(self).__name__
            raise ValueError(f"{who} knows no springs yet. Put it in System(rules=...), and ask the parts of system.bind(state.dtype).")
        return self.springs

    def constant(self, name: str, state: State) -> Any:
        """A constant as a number or an edge field in the dtype of the state."""
        return cast_inexact(self.net.edge_field(getattr(self, name), name), state.dtype)


class Breaking(SpringRule):
    """Breaks springs. Abstract: give `update`."""

    def begin(self, state: State) -> State:
        """The state with a bit for every spring."""
        # The same kind of field as a step leaves it, also where it was made by hand.
        return state.with_alive(self.net, state.alive_of(self.net))

    def whole(self, state: State, unbroken: EdgeField) -> EdgeField:
        """Which springs hold: those that held, less those that break now."""
        return self.net.map_springs(lambda alive, holds: alive & holds, living(self.net, state), unbroken)


def check_lengths(name: str, springs: Springs) -> None:
    """ValueError where a strain is asked of a spring without rest length."""
    if any(is_concrete(entry) and np.any(np.asarray(entry) == 0) for _, entry in named_entries("rest_length", springs.rest_length)):
        raise ValueError(f"{name} is a stretch over the rest length, but a rest length of these springs is zero. Give a force instead.")


__all__ = ["Breaking", "SpringRule", "check_lengths"]
