"""Springs that tear: beyond a strain or a pull a spring breaks for good; or loses its stiffness over a band, and then breaks.

    at once        breaks where z > z_t             z = (r - l) / l, e_p not taken off; or z = k (r - l - e_p)      [1] or [N]
    over a band    w = largest z so far             t = clip((w - z_t) / band, 0, 1)
                   stiffness (1 - t^2 (3 - 2 t)) k  breaks where t = 1

Once a step, after the step has converged. Only stretched springs tear. The pull z is that of the spring whose stiffness is whole, which
grows with its stretch. Breaking is a decision, of derivative zero; over the band stiffness has a derivative by z_t, band and whatever moves
the spring, and as the band shrinks the runs tend to those that break at once. What is lost never comes back.

Source: continuum damage, Kachanov (1958) for the share of a section that still carries, Simo and Ju (1987) for damage that follows the
largest strain so far; the cubic between is this library's choice, so that the stiffness has a continuous slope.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from .._checks import positive
from ..memory import with_entry
from ..state import State
from ..status import Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, named_entries
from .base import Scene, Step, any_not_positive
from .history import Onset, Torn, begun, never
from .living import map_living
from .spring_rules import Breaking, check_lengths


class Tearing(Breaking):
    """The springs of a net tear beyond a strain or a pull.

    Attributes:
        net: whose springs tear; those of other nets over the same nodes stay whole.
        strain: stretch over rest length at which a spring tears, plastic stretch included: a number, (E,) in the user's order, an
            `EdgeField`, or numbers by family, as in `Springs`. Or None:
        force: pull at which it tears [N]; as the strain. One of the two is given.
        band: further strain, or pull [N], over which the stiffness falls to zero; as the strain. None tears at once.
        springs: those that tear; the system fills it in.

    Raises:
        ValueError: both or neither of strain and force; a constant that is not above zero and finite; in `System`, no or several `Springs`
            on the net, a strain where a rest length is zero.

    >>> import numpy as np
    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> rule = js.plasticity.Tearing(net, strain=0.2)
    >>> system = js.System(net, 1.0, js.Springs(net, 100.0, 1.0), free=np.zeros(3, bool), rules=rule)
    >>> start = js.State.from_points(net, [[0.0], [1.1], [2.4]])
    >>> end = js.rollout(system, start, js.SymplecticEuler(), dt=0.1, n_steps=1).state
    >>> first = rule.onset(end)
    >>> print(net.flatten(end.alive), first.count, first.spring, first.time)
    [ True False] 1 1 0.1
    """

    constants: ClassVar[tuple[str, ...]] = ("strain", "force", "band")
    strain: Any
    force: Any
    band: Any

    def __init__(
        self,
        net: Topology,
        strain: SpringNumbers | None = None,
        force: SpringNumbers | None = None,
        band: SpringNumbers | None = None,
    ):
        if (strain is None) == (force is None):
            raise ValueError("Tearing needs either strain or force [N], and not both: two rules may stand in one system.")
        self.net = net
        self.strain, self.force = _constant(net, "strain", strain), _constant(net, "force", force)
        self.band = _constant(net, "band", band)
        self.springs = None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where the system has not exactly one `Springs` on this net, or a strain has no length to go by."""
        springs = self.own_springs(scene)
        if self.strain is not None:
            check_lengths("strain", springs)

    def remember(self, state: State) -> Torn:
        """Springs that are whole."""
        if self.band is None:
            return Torn(never(self.net, state), None, None)
        nothing, all_of_it = (self.net.everywhere(jnp.full((), value, state.dtype)) for value in (0.0, 1.0))
        return Torn(never(self.net, state), nothing, all_of_it)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state in which springs that were stretched too far are weaker, or broken."""
        memory, limit = self.recall(state), self.constant("force" if self.strain is None else "strain", state)
        load, worst, share = self.load(state), memory.worst, memory.share
        if worst is None:
            off = map_living(self.net, state, lambda z, most: z > most, load, limit)
        else:
            worst = self.net.map_springs(lambda w, z: jnp.where(z > w, z, w), worst, load)
            fallen = self.net.map_springs(
                lambda w, most, band: jnp.clip((w - most) / band, 0, 1), worst, limit, self.constant("band", state)
            )
            share = fallen.map(lambda t: 1 - t * t * (3 - 2 * t))
            off = map_living(self.net, state, lambda t: t >= 1, fallen)
        new = Torn(begun(self.net, memory.since, off, state.time), worst, share)
        return self.keep(state.with_alive(self.net, self.whole(state, off.map(jnp.logical_not))), new), Status.ok()

    def load(self, state: State) -> EdgeField:
        """What the limit is compared with: the whole strain, or the pull at the whole stiffness [N]; zero where broken."""
        springs = self.known_springs()
        if self.strain is None:
            # Without what this rule has taken of the stiffness.
            return springs.tension(dataclasses.replace(state, memory=with_entry(state.memory, self.place or 0, None)))

        def strain(d: Any, l: Array) -> Array:
            has_length = l > 0
            return jnp.where(has_length, d.norm() / jnp.where(has_length, l, jnp.ones_like(l)) - 1, jnp.zeros_like(d[0]))

        return map_living(self.net, state, strain, springs.differences(state), springs.unyielded_length(state))

    def onset(self, state: State) -> Onset:
        """How many springs have torn, and where and when the first did."""
        return Onset.of(self.net, self.recall(state).since)

    def invalid(self) -> Array:
        """Whether a constant is not above zero, or not finite."""
        return any_not_positive(self.strain, self.force, self.band)


def _constant(net: Topology, name: str, value: SpringNumbers | None) -> Any:
    """A constant as the user passed it, or None."""
    found = None if value is None else net.edge_constant(value, name)
    for place, entry in named_entries(name, found):
        positive(place, entry, "A spring would be torn at rest, or no band be left: leave band out for springs that tear at once.")
    return found


__all__ = ["Tearing"]
