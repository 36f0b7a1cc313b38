"""Did an implicit step raise the energy? Only where nothing in the scene can feed energy in.

    E - lowest E of the run  >  slack * scale + what errors explain
    scale = highest kinetic energy of the run + sum over it and the potentials of (highest - lowest)

The scale is the energy of motion and what the run has exchanged, not what one step has: that vanishes where the motion turns, while the
energy of a good run still swings a little about the one which its method keeps. Errors are rounding, and the residuals of the solves,
which add up.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..bound import BoundSystem
from ..linalg.iterative import norm
from ..numerics import stopped
from ..state import State
from .stage import Stage


class EnergyWatch(eqx.Module):
    """What the energy of a run did so far.

    Attributes:
        parts: kinetic energy and the potentials that there are, of the last state [J].
        lowest: total of the run [J], moved along with what rules did to the energy.
        floor, ceiling: lowest and highest of `parts` [J].
        drift: rise that the errors of all steps together explain [J].
    """

    parts: Array
    lowest: Array
    floor: Array
    ceiling: Array
    drift: Array

    @staticmethod
    def of(system: BoundSystem, state: State) -> EnergyWatch | None:
        """Before the first step; None where something in the system can feed energy in."""
        if system.motion is not None or any(force.can_feed for force in system.forces) or any(part.does_work for part in system.obstacles):
            return None
        parts = _parts(system, state)
        return EnergyWatch(parts, jnp.sum(parts), parts, parts, jnp.zeros((), state.dtype))

    def shifted(self, system: BoundSystem, state: State) -> EnergyWatch:
        """After rules have changed the energy, which is no fault of a step."""
        parts = _parts(system, state)
        return eqx.tree_at(lambda w: (w.parts, w.lowest), self, (parts, self.lowest + jnp.sum(parts - self.parts)))

    def after(self, stage: Stage, state: State, residual: Array) -> EnergyWatch:
        """After a step that solved `stage` to a relative residual and ended at `state`."""
        stage, state, residual = stopped((stage, state, residual))
        parts = _parts(stage.system, state)
        # Work of the forces that rounding and an inexact solve leave over: a residual is relative to M v / h and the forces, whose work in
        # a step is at most twice the kinetic energy and what is exchanged.
        # A scene at rest moves by the rounding of its places alone, against forces that are rounding too.
        moved = norm(state.position - stage.predictor.position) + float(jnp.finfo(state.dtype).eps) * norm(state.position)
        of_positions = stage.rounding() * moved
        of_solve = 2 * residual * (parts[0] + jnp.sum(jnp.abs(parts - self.parts)))
        return EnergyWatch(
            parts=parts,
            lowest=jnp.minimum(self.lowest, jnp.sum(parts)),
            floor=jnp.minimum(self.floor, parts),
            ceiling=jnp.maximum(self.ceiling, parts),
            drift=self.drift + of_positions + of_solve,
        )

    def rose(self, slack: float) -> Array:
        """Whether the energy is higher than it was, by more than this share of what moves and was exchanged."""
        scale = self.ceiling[0] + jnp.sum(self.ceiling - self.floor)
        rounding = 64 * float(jnp.finfo(scale.dtype).eps) * jnp.sum(jnp.abs(self.parts))
        return jnp.sum(self.parts) - self.lowest > slack * scale + rounding + self.drift


def _parts(system: BoundSystem, state: State) -> Array:
    """Kinetic energy, then the potentials that there are [J]."""
    energy = stopped(system.energy(state))
    return jnp.stack([energy.kinetic, *(part for part in energy.potential if part is not None)])


__all__ = ["EnergyWatch"]
