"""What obstacles gave to nodes in a step: ground reaction forces, friction, and the way out for nodes that are inside.

    impulse of the normal       m (change of velocity along it)          [N s]
    impulse of friction         m (change of velocity along the surface) [N s]
    mean force in the step      impulse / dt                             [N]

Source: momentum.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..forces.base import Rule, Scene, Step
from ..forces.contact import Floor
from ..memory import entry_at
from ..state import State
from ..status import Status
from ..vector import Vector
from .rule import Contact, surface_of

SWEEPS = 8  # over all obstacles: out of one may be into another


class Impulse(eqx.Module):
    """What one obstacle gave to each node in one step [N s], in node shape; over dt it is the mean force on the node.

    Attributes:
        normal: along its normal.
        friction: along its surface.
    """

    normal: Vector
    friction: Vector


class Impulses(Rule):
    """Keeps what every obstacle of the system gave in the last step: see `impulses`. It watches, and changes nothing.

    Attributes:
        masses: [kg], for each obstacle the same, once bound.

    >>> net = js.lattice(2)
    >>> rules = (js.Floor((0.0, 0.0), (0.0, 1.0)), js.contact.Impulses())
    >>> system = js.System(net, 2.0, js.Gravity((0.0, -10.0)), rules=rules)
    >>> rest = js.State.from_points(net, [[0.0, 0.0], [1.0, 5.0]])
    >>> run = js.rollout(system, rest, js.VelocityVerlet(), dt=0.1, n_steps=3)
    >>> print(js.contact.impulses(system, run.state)[0].normal.y)
    [2. 0.]
    """

    watches: ClassVar[bool] = True
    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    masses: tuple[Array, ...] | None

    def __init__(self) -> None:
        self.masses = None

    def bind(self, scene: Scene) -> Impulses:
        """The same, knowing the masses, and how many obstacles the scene has."""
        masses = tuple(scene.mass for rule in scene.rules if rule.is_obstacle)
        return eqx.tree_at(lambda r: r.masses, self, masses, is_leaf=lambda leaf: leaf is None)

    def remember(self, state: State) -> tuple[Impulse, ...]:
        """Nothing given yet, by each obstacle."""
        nothing = Vector.zeros_like(state.position)
        return tuple(Impulse(nothing, nothing) for _ in self._known())

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state with what the step's obstacles gave."""
        pairs = zip(self._known(), step.impacts or (), strict=True)
        return self.keep(state, tuple(Impulse(mass * book.normal, mass * book.friction) for mass, book in pairs)), Status.ok()

    def _known(self) -> tuple[Array, ...]:
        if self.masses is None:
            raise ValueError("Impulses knows no masses yet. Put it in System(rules=...), and call rollout, or system.bind(state.dtype).")
        return self.masses


def impulses(system: Any, state: State) -> tuple[Impulse, ...]:
    """What each obstacle gave to each node in the step that led to a state.

    Args:
        system: of whose rules one is `Impulses`; bound or not.
        state: one that came out of a run of it; of a batch, or of many frames, too.

    Returns:
        An `Impulse` for each obstacle, in the order of the system's rules.

    Raises:
        ValueError: no `Impulses` in the system, or a state that no run has made.
    """
    places = [i for i, part in enumerate(system.parts) if isinstance(part, Impulses)]
    entry = entry_at(state.memory, places[0]) if places else None
    if entry is None:
        raise ValueError("nothing keeps impulses. Pass rules=(..., js.contact.Impulses()) to System, and a state that came out of rollout.")
    return entry.value


def push_out(system: Any, state: State) -> State:
    """The state with every node that is inside an obstacle moved onto its surface, along the normal there; velocities stay.

    Args:
        system: its rules are looked through for `Floor` and `Contact`. Held nodes are moved as well.
        state: where some nodes may be inside.

    Returns:
        The state. Where obstacles overlap so that there is no way out along their normals, nodes stay inside, and a run says so.

    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, rules=js.Floor((0.0, 0.0), (0.0, 1.0)))
    >>> print(push_out(system, js.State.from_points(net, [[0.0, -0.5], [1.0, 2.0]])).position.y)
    [0. 2.]
    """
    position = state.position
    time = jnp.broadcast_to(state.time, position.shape)
    surfaces = [surface_of(rule, state) for rule in system.rules or () if isinstance(rule, (Floor, Contact))]
    for _ in range(SWEEPS):
        for surface in surfaces:
            touch = surface.touch(position, time, jnp.zeros_like(time))
            position = position - jnp.minimum(touch.height, jnp.zeros_like(time)) * touch.normal
    return state.moved(position, state.velocity)


__all__ = ["Impulse", "Impulses", "impulses", "push_out"]
