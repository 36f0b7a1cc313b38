"""Looking for trouble during a rollout: once per block, and a replay of a failed run to name the step.

The watch costs one check of the state per block. NaN is sticky, so that nothing need be kept beside it: a run that failed is done again
from its start, up to the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .bound import BoundSystem
from .forces.base import SPOILT
from .numerics import any_lane, cast_inexact, stopped
from .state import State
from .status import NOWHERE, Flag, Status
from .steppers.solves import Solves
from .system import System


class Carry(eqx.Module):
    """What goes from step to step: the state, what the stepper carries, how many steps were done, how its solves went, and what the
    system's rules found.
    """

    state: State
    memory: Any
    step: Array
    solves: Solves | None = None
    found: Status | None = None


class Precision(eqx.Module):
    """How far the coordinates may grow before their rounding is looked at again.

    Attributes:
        errors: relative error of each force at the start of the run; None where it takes no difference.
        size: largest coordinate then [m].
    """

    errors: tuple[Array | None, ...]
    size: Array

    @staticmethod
    def of(ready: BoundSystem, state: State) -> Precision:
        """At the start of a run."""
        return stopped(Precision(tuple(force.rounding(state) for force in ready.forces), state.position.largest()))

    def look(self, ready: BoundSystem, carry: Carry, status: Status) -> Status:
        """The status, with PRECISION where coordinates have grown too large for a force.

        Springs are measured only where the coordinates have grown, and come within a tenth of what the lengths at the start allow; no more
        once it has been told.
        """
        ready, carry = stopped((ready, carry))
        grown = carry.state.position.largest() / self.size
        # NaN, where all coordinates were zero, counts as grown.
        is_open = ~status.has(Flag.PRECISION) & ~(grown <= 1.125)
        for i, error in enumerate(self.errors):
            if error is None:
                continue
            is_near = any_lane(is_open & ~(error * grown <= SPOILT / 10))
            force, nothing = ready.forces[i], jnp.zeros_like(error)
            now = lax.cond(is_near, lambda state, force=force: force.rounding(state), lambda _, none=nothing: none, carry.state)
            status = status.then(Status.when(Flag.PRECISION, now > SPOILT, step=carry.step, effect=i))
        return status


def begin(system: System, ready: BoundSystem, precise: Precision, carry: Carry, dt: Array, limit: Array | None) -> Status:
    """Before the first step: constants that a constructor would refuse, a state that is not finite, a dt above the limit, and
    coordinates too large for the springs between them. The constants are read as the user gave them, which is one array where the bound one
    (`ready`) holds one for every spring family.
    """
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float64:
        system = cast_inexact(system, carry.state.dtype)  # constants of float64, made before x64 was switched off
    system, carry, dt, limit = stopped((system, carry, dt, limit))
    # Masses first: gravity holds them too, and would be blamed.
    status = Status.when(Flag.INVALID, ~jnp.all(system.mass > 0), step=carry.step)
    status = status.then(Status.when(Flag.NONFINITE, _has_nonfinite(system.mass), step=carry.step))
    status = status.then(Status.when(Flag.NONFINITE, ~jnp.isfinite(carry.state.time), step=carry.step))
    status = status.then(Status.when(Flag.INVALID, ~jnp.isfinite(dt), step=carry.step))
    for i, effect in enumerate(system.parts):
        bad = effect.invalid()
        if bad is not None:
            status = status.then(Status.when(Flag.INVALID, bad, step=carry.step, effect=i))
        status = status.then(Status.when(Flag.NONFINITE, _has_nonfinite(effect), step=carry.step, effect=i))
        error = precise.errors[i] if i < len(precise.errors) else None
        if error is not None:
            status = status.then(Status.when(Flag.PRECISION, error > SPOILT, step=carry.step, effect=i))
    status = status.then(look(ready, carry))
    if limit is not None:
        # A hair of slack: a dt set to the limit itself is not above it after rounding.
        slack = jnp.asarray(1 + 8 * float(jnp.finfo(limit.dtype).eps), limit.dtype)
        status = status.then(Status.when(Flag.DT_LIMIT, jnp.abs(dt) > limit * slack, step=carry.step))
    return lax.stop_gradient(status)


def inspect(system: BoundSystem, precise: Precision, start: State, after: Carry, status: Status) -> Status:
    """The status brought up to date at the end of a block of a run from `start`."""
    return precise.look(system, after, status.then(look(system, after, start)))


def look(system: BoundSystem, carry: Carry, start: State | None = None) -> Status:
    """Status of one state: is it finite, and what the effects have to report, also since `start`."""
    system, state, start = stopped((system, carry.state, start))
    bad = _nonfinite(state)
    node = jnp.argmax(jnp.ravel(bad))
    status = Status.when(Flag.NONFINITE, jnp.any(bad), step=carry.step, node=node, count=jnp.sum(bad))
    for i, effect in enumerate(system.parts):
        for found in (*effect.diagnose(state), *(() if start is None else effect.diagnose_since(start, state))):
            raised = Status.when(found.flag, found.count > 0, step=carry.step, node=found.node, effect=i, count=found.count)
            status = status.then(raised)
    return status


def settle(advance: Callable[[Carry], Carry], first: Carry, status: Status, system: BoundSystem) -> Status:
    """The final status: a run that failed is replayed from `first` to name the step, the node and the effect."""
    known = (status.step, status.node, status.effect)

    def replay(_: None) -> tuple[Array, Array, Array]:
        last, failed = lax.while_loop(
            lambda pair: ~_has_failed(system, pair[1].state) & (pair[1].step < status.step),
            lambda pair: (pair[1], advance(pair[1])),
            (first, first),
        )
        bad = jnp.ravel(_nonfinite(failed.state))
        found = (jnp.argmax(bad).astype(jnp.int32), _blame(system, last.state, failed.state))
        # A spring may be too long for its square in a state that is finite: then it is known already which force that was.
        return failed.step, *jax.tree.map(partial(jnp.where, jnp.any(bad)), found, known[1:])

    has_failed = status.has(Flag.NONFINITE) & (status.step > first.step)
    step, node, effect = lax.cond(has_failed, replay, lambda _: known, None)
    return lax.stop_gradient(Status(status.flags, step, node, effect, status.count))


def _has_failed(system: BoundSystem, state: State) -> Array:
    """Whether a state is not finite, or a force says so of what it makes of the state."""
    failed = jnp.any(_nonfinite(state))
    for effect in system.parts:
        for found in effect.diagnose(state):
            if found.flag == Flag.NONFINITE:
                failed = failed | (found.count > 0)
    return failed


def _blame(system: BoundSystem, state: State, failed: State) -> Array:
    """Index of the first force that is not finite in this state; else, where only temperatures failed in the next, of the first rule
    that sets them; else -1.
    """
    effect = jnp.asarray(NOWHERE, jnp.int32)
    heaters = [i for i, part in enumerate(system.parts) if part.sets_temperature]
    if heaters:
        moves_on = ~jnp.any(_nonfinite(replace(failed, temperature=None)))
        effect = jnp.where(moves_on, jnp.asarray(heaters[0], jnp.int32), effect)
    for i, force in reversed(list(enumerate(system.forces))):
        bad = jnp.any(jnp.stack([~jnp.all(jnp.isfinite(a)) for a in force.force(state)]))
        effect = jnp.where(bad, jnp.asarray(i, jnp.int32), effect)
    return effect


def _has_nonfinite(constants: Any) -> Array:
    bad = jnp.zeros((), bool)
    for leaf in jax.tree.leaves(eqx.filter(constants, eqx.is_inexact_array)):
        bad = bad | ~jnp.all(jnp.isfinite(leaf))
    return bad


def _nonfinite(state: State) -> Array:
    bad = [~jnp.isfinite(a) for v in (state.position, state.velocity) for a in v]
    bad += [] if state.temperature is None else [~jnp.isfinite(state.temperature)]
    total = bad[0]
    for more in bad[1:]:
        total = total | more
    return total
