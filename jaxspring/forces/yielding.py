"""Springs that yield: beyond a force they give way, harden, and keep the stretch that they gave.

    trial       f = k (r - l - e_p)                                                                         [N]
    yields      where |f| > F_y + H a                   F_y = yield_force, or k l yield_strain              [N]
    slip        dg = (|f| - F_y - H a) / (k + H) p      p = 1, or 1 - exp(-dt (k + H) / eta) with a viscosity  [m]
    keeps       e_p += sign(f) dg,   a += dg

Once a step, after the step has converged and before the next: inside a step e_p stands still, so that matrices are symmetric and the
result does not depend on iterations. Without a viscosity the pull comes back to the yield surface at once. With one it flows,
eta da/dt = |f| - F_y - H a, of which p is the exact solution while r stands still, for any dt; with F_y = H = 0 a Maxwell element creeps.

Plastic work of a step: dg (F_y + H (a + dg / 2)), exact where r moves one way in it. The trial pull, which is above the yield surface, has
put (k + H) dg^2 / 2 more into the spring; nothing in the motion of a spring that yields at once corresponds to that, and books count it as
of the step. The derivative is that of the branch taken; exactly at yield, where it is not defined, that of the spring that yields.

Source: Simo and Hughes (1998), Computational Inelasticity, box 1.4 (return mapping with isotropic hardening) and section 1.7 (viscous
overstress, after Perzyna 1966).
"""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._checks import positive
from ..numerics import stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, named_entries
from .base import Scene, Step, any_not_positive, any_refused
from .history import Onset, Yielded, begun, never
from .laws import Hooke, TensionOnly
from .living import map_living
from .spring_rules import SpringRule, check_lengths
from .springs import _check_sign


class Yielding(SpringRule):
    """The springs of a net yield beyond a force or a strain, and harden linearly and alike in both directions.

    What they have yielded by is remembered (`Yielded`), and the `Springs` of that net read it: their rest length is the one that they
    would have, plus e_p. A broken spring forgets it. Of two such rules on one net, a slider and a creeping damper, the stretches add up.

    Attributes:
        net: whose springs yield.
        yield_force: F_y, pull or push at which a spring first yields [N]: a number, (E,) in the user's order, an `EdgeField`, or numbers
            by family, as in `Springs`; zero with a viscosity is a Maxwell element. Or None:
        yield_strain: F_y / (k l), of the present stiffness and of the rest length without e_p; as the yield force. One of the two is given.
        hardening: H, by how much the yield force grows with slip [N/m]; as the yield force. Zero is perfectly plastic.
        viscosity: eta, overstress over the rate of slip [N s/m]; as the yield force. None yields at once.
        springs: those that yield; the system fills it in.

    Raises:
        ValueError: both or neither of force and strain; a constant that is negative or not finite, a viscosity that is not above zero; in
            `System`, no or several `Springs` on the net, springs of another law than `Hooke` and `TensionOnly`, a yield strain where a
            rest length is zero.

    >>> import numpy as np
    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> rule = js.plasticity.Yielding(net, yield_force=2.0, hardening=25.0)
    >>> system = js.System(net, 1.0, js.Springs(net, 100.0, 1.0), free=np.zeros(2, bool), rules=rule)
    >>> end = js.rollout(system, js.State.from_points(net, [[0.0], [1.1]]), js.SymplecticEuler(), dt=0.1, n_steps=1).state
    >>> print(net.flatten(system.forces[0].tension(end)).round(4), net.flatten(system.recall(end, 1).stretch).round(4))
    [3.6] [0.064]
    """

    constants: ClassVar[tuple[str, ...]] = ("yield_force", "yield_strain", "hardening", "viscosity")
    yield_force: Any
    yield_strain: Any
    hardening: Any
    viscosity: Any

    def __init__(
        self,
        net: Topology,
        yield_force: SpringNumbers | None = None,
        yield_strain: SpringNumbers | None = None,
        hardening: SpringNumbers = 0.0,
        viscosity: SpringNumbers | None = None,
    ):
        if (yield_force is None) == (yield_strain is None):
            raise ValueError("Yielding needs either yield_force [N] or yield_strain, and not both: each is the other over k l.")
        self.net = net
        self.yield_force = _constant(net, "yield_force", yield_force)
        self.yield_strain = _constant(net, "yield_strain", yield_strain)
        self.hardening = _constant(net, "hardening", hardening)
        self.viscosity = _constant(net, "viscosity", viscosity)
        for name, entry in named_entries("viscosity", self.viscosity):
            positive(name, entry, "A spring would slip without end. Leave the viscosity out for one that yields at once.")
        self.springs = None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where the system has not exactly one `Springs` on this net, or one of a law that cannot yield."""
        springs = self.own_springs(scene)
        if type(springs.law) not in (Hooke, TensionOnly):
            raise ValueError(
                f"Yielding returns a linear pull to the yield force, but these springs have the law {type(springs.law).__name__}. "
                f"Use Hooke() or TensionOnly()."
            )
        if self.yield_strain is not None:
            check_lengths("yield_strain", springs)

    def remember(self, state: State) -> Yielded:
        """Springs that have never yielded."""
        nothing = self.net.everywhere(jnp.zeros((), state.dtype))
        return Yielded(nothing, nothing, never(self.net, state))

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state in which springs that were pulled or pushed too hard have given way."""
        springs, memory = self.known_springs(), self.recall(state)
        pull, stiffness = springs.tension(state), springs.present_stiffness(state)
        strength, dt = self.strength(state), step.dt
        given = (pull, stiffness, memory.slip, strength, self.constant("hardening", state))
        more = () if self.viscosity is None else (self.constant("viscosity", state),)

        def slipped(f: Array, k: Array, a: Array, y: Array, h: Array, *eta: Array) -> Array:
            slip, stiff = at_once(f, k, a, y, h)
            return slip * -jnp.expm1(-dt.astype(f.dtype) * stiff / eta[0]) if eta else slip

        slip = map_living(self.net, state, slipped, *given, *more)
        new = Yielded(
            map_living(self.net, state, lambda q, f, dg: q + sign(f) * dg, memory.stretch, pull, slip),
            map_living(self.net, state, lambda a, dg: a + dg, memory.slip, slip),
            begun(self.net, memory.since, slip.map(lambda dg: dg > 0), state.time),
        )
        return self.keep(state, new), Status.when(Flag.INVALID, stopped(dt) < 0)

    def overshoot(self, before: State, after: State) -> tuple[int, Array] | None:
        """Place of the springs, and (k + H) dg^2 / 2 summed [J], where they yield at once."""
        springs = self.known_springs()
        if self.viscosity is not None or springs.place is None:
            return None
        fields = (springs.present_stiffness(after), self.constant("hardening", after), self.recall(before).slip, self.recall(after).slip)
        energy = map_living(self.net, after, lambda k, h, a, b: 0.5 * (k + h) * (b - a) * (b - a), *fields)
        return springs.place, self.net.sum(energy)

    def strength(self, state: State) -> Array | EdgeField:
        """F_y, the pull at which a spring that has not hardened yields [N]."""
        if self.yield_strain is None:
            return self.constant("yield_force", state)
        springs = self.known_springs()
        fields = (springs.present_stiffness(state), springs.unyielded_length(state), self.constant("yield_strain", state))
        return map_living(self.net, state, lambda k, l, e: k * l * e, *fields)

    def onset(self, state: State) -> Onset:
        """How many springs have yielded, and where and when the first did."""
        return Onset.of(self.net, self.recall(state).since)

    def invalid(self) -> Array:
        """Whether a constant is negative or not finite, or a viscosity zero."""
        bad = any_refused(self.yield_force, self.yield_strain, self.hardening)
        return bad if self.viscosity is None else bad | any_not_positive(self.viscosity)


def _constant(net: Topology, name: str, value: SpringNumbers | None) -> Any:
    """A constant as the user passed it, or None."""
    if value is None:
        return None
    found = net.edge_constant(value, name)
    _check_sign(name, found, "A spring would yield before it is pulled, or ever more easily.")
    return found


def at_once(f: Array, k: Array, a: Array, y: Array, h: Array) -> tuple[Array, Array]:
    """Slip that brings a trial pull back to the yield surface, zero inside of it; and k + H, 1 where nothing yields."""
    over = jnp.abs(f) - y - h * a
    yields = (over >= 0) & (k + h > 0)
    stiff = jnp.where(yields, k + h, jnp.ones_like(over))
    return jnp.where(yields, f * sign(f) - y - h * a, jnp.zeros_like(over)) / stiff, stiff


def sign(f: Array) -> Array:
    """-1 or 1, never 0: a spring of yield force zero has a derivative where it is not pulled."""
    return jnp.where(f < 0, -jnp.ones_like(f), jnp.ones_like(f))


__all__ = ["Yielding", "at_once", "sign"]
