"""Hinges that yield: bent beyond an angle they keep a part of it, a crease, and harden.

    trial       delta = theta - theta_0 - q, wrapped to (-pi, pi]                   [rad]
    yields      where |delta| > y + H a                                             y the yield angle, H in units of k_e
    slip        dg = (|delta| - y - H a) / (1 + H)
    keeps       q += sign(delta) dg,   a += dg

Once a step, after the step has converged, as springs yield: see `yielding.py`, whose return this is with the angle for the pull. Plastic
work of a step: k_e dg (y + H (a + dg / 2)).

Source: Simo and Hughes (1998), Computational Inelasticity, box 1.4, for one moment.
"""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, nonnegative
from ..numerics import cast_inexact, stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from .base import Rule, Scene, Step, any_refused
from .hinges import Hinges
from .history import Creased, Onset
from .yielding import at_once, sign


class PlasticHinges(Rule):
    """The hinges of a net keep what they are bent by beyond an angle, and harden linearly and alike in both directions.

    What they keep is remembered (`Creased`), and the `Hinges` of that net read it.

    Attributes:
        net: whose hinges yield.
        yield_angle: y, from the rest angle [rad]: one number, or (H,) in the order of `Hinges.nodes`.
        hardening: H, by how much the yield angle grows with the angle that is kept: as the yield angle. Zero is perfectly plastic.
        hinges: those that yield; the system fills it in.

    Raises:
        ValueError: a constant that is negative or not finite; in `System`, no or several `Hinges` on the net, another number of hinges.

    >>> import numpy as np
    >>> import jaxspring as js
    >>> net = js.from_triangles([(0, 1, 2), (1, 0, 3)], 4)
    >>> rule = js.cloth.PlasticHinges(net, yield_angle=0.5, hardening=0.25)
    >>> system = js.System(net, 1.0, js.cloth.Hinges(net, 2.0), free=np.zeros(4, bool), rules=rule)
    >>> bent = js.State.from_points(net, [(0, 0, 0), (1, 0, 0), (0.5, 1, 0), (0.5, 0, -1)])
    >>> end = js.rollout(system, bent, js.SymplecticEuler(), dt=0.1, n_steps=1).state
    >>> print(system.recall(end, 1).angle.round(4), rule.onset(end).count)
    [0.8566] 1
    """

    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    net: Topology
    yield_angle: Array
    hardening: Array
    hinges: Hinges | None

    def __init__(self, net: Topology, yield_angle: Numbers, hardening: Numbers = 0.0):
        self.net = net
        self.yield_angle, self.hardening = as_inexact("yield_angle", yield_angle), as_inexact("hardening", hardening)
        for name in ("yield_angle", "hardening"):
            if getattr(self, name).ndim > 1:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}; expected () (one number), or (H,) (one per hinge).")
            nonnegative(name, getattr(self, name), "A hinge would yield before it is bent, or ever more easily.")
        self.hinges = None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where the system has not exactly one `Hinges` on this net, or the constants do not fit it."""
        found = [force for force in scene.forces if isinstance(force, Hinges) and self._is_mine(force)]
        if len(found) != 1:
            raise ValueError(f"PlasticHinges needs one Hinges on its net; this system has {len(found)}. Put Hinges(net, ...) into forces=.")
        n = found[0].triangles.cells.shape[-1]
        for name in ("yield_angle", "hardening"):
            shape = getattr(self, name).shape
            if shape not in ((), (n,)):
                raise ValueError(f"{name} has shape {shape}; expected () (one number), or ({n},) (one per hinge).")

    def bind(self, scene: Scene) -> PlasticHinges:
        """The same, knowing the hinges of this net."""
        place = next(i for i, force in enumerate(scene.forces) if isinstance(force, Hinges) and self._is_mine(force))
        known = eqx.tree_at(lambda r: r.hinges, self, scene.bound(place), is_leaf=lambda leaf: leaf is None)
        return cast_inexact(known, scene.dtype)

    def remember(self, state: State) -> Creased:
        """Hinges that have never yielded."""
        nothing = jnp.zeros_like(self._known().bent(state))
        return Creased(nothing, nothing, jnp.full_like(nothing, jnp.inf))

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state in which hinges that were bent too far have given way."""
        memory: Creased = self.recall(state)
        bent = self._known().bent(state)
        y, h = (jnp.broadcast_to(a.astype(bent.dtype), bent.shape) for a in (self.yield_angle, self.hardening))
        slip, _ = at_once(bent, jnp.ones_like(bent), memory.slip, y, h)
        begins = (slip > 0) & jnp.isinf(memory.since)
        since = jnp.where(begins, state.time.astype(bent.dtype), memory.since)
        new = Creased(memory.angle + sign(bent) * slip, memory.slip + slip, since)
        return self.keep(state, new), Status.when(Flag.INVALID, stopped(step.dt) < 0)

    def overshoot(self, before: State, after: State) -> tuple[int, Array] | None:
        """Place of the hinges, and k_e (1 + H) dg^2 / 2 summed [J]."""
        hinges = self._known()
        if hinges.place is None:
            return None
        slip = self.recall(after).slip - self.recall(before).slip
        k = jnp.broadcast_to(hinges.stiffness, slip.shape)
        return hinges.place, jnp.sum(0.5 * k * (1 + jnp.broadcast_to(self.hardening, slip.shape)) * slip * slip)

    def onset(self, state: State) -> Onset:
        """How many hinges have yielded, and which and when the first did."""
        return Onset.first(self.recall(state).since)

    def invalid(self) -> Array:
        """Whether a constant is negative or not finite."""
        return any_refused(self.yield_angle, self.hardening)

    def _is_mine(self, hinges: Hinges) -> bool:
        return hinges.net.identity == self.net.identity

    def _known(self) -> Hinges:
        if self.hinges is None:
            raise ValueError("PlasticHinges knows no hinges yet. Put it in System(rules=...), and ask a part of system.bind(state.dtype).")
        return self.hinges


__all__ = ["PlasticHinges"]
