"""Springs that fuse: above the melting point a spring breaks, and its bit in `state.alive` is cleared.

    breaks      theta_ij >= theta_m                                theta_ij = (theta_i + theta_j) / 2       [K]
    comes back  never, unless `Refreezing` is named: then where theta_ij <= theta_m - hysteresis and the ends are within reach,
                with its present length as rest length, so that it comes back without a pull and without energy

Velocities and positions are untouched, so momentum is continuous; shapes never change. Breaking is a decision: it has no gradient.

Source: Terzopoulos, Platt and Fleischer (1989): a thermoelastic unit fuses above the melting point. Refreezing is this library's.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, nonnegative, positive
from ..forces.base import Scene, Step
from ..forces.molten import Molten, check_springs
from ..forces.spring_rules import Breaking
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from .stiffness import temperature_of


class Refreezing(eqx.Module):
    """Springs that come back once cold.

    Attributes:
        hysteresis: how far below the melting point a spring comes back [K]; noise of less than that toggles nothing.
        reach: longest spring that can come back [m].
    """

    hysteresis: Array
    reach: Array

    def __init__(self, hysteresis: Numbers, reach: Numbers):
        self.hysteresis, self.reach = as_inexact("hysteresis", hysteresis), as_inexact("reach", reach)
        for name, value in (("hysteresis", self.hysteresis), ("reach", self.reach)):
            has_shape(name, value, {"one number": ()})
        nonnegative("hysteresis", self.hysteresis, "A spring would come back while it is hot.")
        positive("reach", self.reach, "No spring could come back. Leave refreezing out.")


class Fusing(Breaking):
    """Springs break at the melting point. Belongs to a system's `rules`, after `Heat`.

    Attributes:
        net: whose springs fuse; those of other nets over the same nodes stay whole.
        melting: theta_m [K].
        refreezing: `Refreezing`, or None: what is broken stays so.
        springs: those whose rest lengths change when they come back; the system fills it in.

    Raises:
        ValueError: a melting point that is not finite; at the start of a run a state without temperature, springs on another net only, or
            refreezing without springs of this net.

    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), rules=Fusing(net, melting=350.0))
    >>> start = js.State.from_points(net, net.grid(), temperature=[300.0, 340.0, 400.0])
    >>> print(net.flatten(js.rollout(system, start, js.Still(), dt=0.1, n_steps=1).state.alive))
    [ True False]
    """

    melting: Array
    refreezing: Refreezing | None

    def __init__(self, net: Topology, melting: Numbers, refreezing: Refreezing | None = None):
        self.net = net
        self.melting = as_inexact("melting", melting)
        has_shape("melting", self.melting, {"one number": ()})
        finite("melting", self.melting)
        if refreezing is not None and not isinstance(refreezing, Refreezing):
            raise TypeError(f"refreezing is a {type(refreezing).__name__}; expected Refreezing(hysteresis, reach), or None.")
        self.refreezing = refreezing
        self.springs = None

    def check(self, scene: Scene) -> None:
        """Raise ValueError where no `Springs` of the system is on this net, or several that may come back; or where torn ones would."""
        check_springs("Fusing", self.net, scene.forces)
        if self.refreezing is None:
            return
        if len(self.places(scene)) != 1:
            raise ValueError(
                f"refreezing needs one Springs on the net of Fusing, whose rest lengths change; this system has {len(self.places(scene))}."
            )
        others = [type(r).__name__ for r in scene.rules if isinstance(r, Breaking) and r.net.identity == self.net.identity]
        if len(others) > 1:
            raise ValueError(
                f"refreezing brings back every broken spring of its net that is cold, those of {', '.join(others)} too. Break them on "
                f"nets of their own, net.named('second'), or leave refreezing out."
            )

    def bind(self, scene: Scene) -> Fusing:
        """The same, knowing the springs that may come back."""
        springs = None if self.refreezing is None else scene.bound(self.places(scene)[0])
        return cast_inexact(eqx.tree_at(lambda r: r.springs, self, springs, is_leaf=lambda leaf: leaf is None), scene.dtype)

    def begin(self, state: State) -> State:
        """The state with a bit for every spring and, where springs come back, a rest length of every spring."""
        temperature_of(state, "Fusing")
        state = super().begin(state)
        if self.refreezing is None or self.springs is None:
            return state
        lengths = state.rest_length_of(self.net)
        if lengths is None:
            given = cast_inexact(self.springs.net.edge_field(self.springs.rest_length, "rest_length"), state.dtype)
            entries = given.families if isinstance(given, EdgeField) else (given,) * len(self.net.family_shapes)
            lengths = self.net.own(jnp.broadcast_to(l, shape) for l, shape in zip(entries, self.net.family_shapes, strict=True))
        return state.with_rest_length(self.net, lengths)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """Springs broken where hot, and back where cold and near."""
        melting = self.melting.astype(state.dtype)
        warm = self.net.average(temperature_of(state, "Fusing"))
        alive = self.whole(state, warm.map(lambda theta: theta < melting))
        refused = Status.when(Flag.INVALID, ~jnp.isfinite(melting))
        if self.refreezing is None:
            return state.with_alive(self.net, alive), refused
        cold, reach = melting - self.refreezing.hysteresis.astype(state.dtype), self.refreezing.reach.astype(state.dtype)
        length = self.net.difference(state.position).map(lambda d: d.norm())
        back = self.net.map_springs(
            lambda whole, theta, l: ~whole & (theta <= cold) & (theta < melting) & (l <= reach), alive, warm, length
        )
        natural = length
        factor = None if self.springs is None else self.springs.growth(state)
        if factor is not None:
            natural = self.net.map_springs(lambda l, f: l / jnp.where(f > 0, f, jnp.ones_like(f)), length, factor)
        rest = self.net.map_springs(jnp.where, back, natural, state.rest_length_of(self.net))
        return state.with_alive(self.net, self.net.map_springs(jnp.logical_or, alive, back)).with_rest_length(self.net, rest), refused


def melted_fraction(net: Topology, state: State) -> Array:
    """Share of the particles that no living spring holds.

    Args:
        net: the topology whose springs fuse.
        state: one state; leading axes of saved states are not accepted: use `jax.vmap`.

    Returns:
        A number from 0 to 1, 0-d.

    Raises:
        ValueError: the state's springs are those of another net.
    """
    return jnp.mean(Molten(net).is_fluid(state).astype(state.dtype))


__all__ = ["Fusing", "Refreezing", "melted_fraction"]
