"""What went wrong, as a value: failures are numbers inside `jit` and exceptions outside.

Every result carries a `Status`. It names the flags that were raised and, for the first trouble, the step, the node and the effect.
`raise_for_status` is the one way from a status to an exception.
"""

from __future__ import annotations

import enum
import warnings
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Int, UInt32

from .processes import gathered, is_readable


class Flag(enum.IntFlag):
    """Kinds of trouble. Those in `WARNINGS` leave a usable result; the others do not."""

    OK = 0
    NONFINITE = 1
    ENERGY_ROSE = 2
    CG_MAXITER = 4
    CG_INDEFINITE = 8
    LINE_SEARCH = 16
    MECHANISM = 32
    PIVOT = 64
    COINCIDENT = 128
    OVERLAP = 256
    OUTSIDE = 512
    NEIGHBOUR_OVERFLOW = 1024
    MAX_STEPS = 2048
    INTERRUPTED = 4096
    DT_LIMIT = 8192
    INVALID = 16384
    PRECISION = 32768
    SOLVER = 65536
    UNSTABLE = 131072
    UNDETERMINED = 262144
    IMPACTS = 524288
    BOX = 1048576
    INSIDE = 2097152
    STRAIN = 4194304
    DEGENERATE = 8388608


WARNINGS = (
    Flag.COINCIDENT
    | Flag.OVERLAP
    | Flag.OUTSIDE
    | Flag.DT_LIMIT
    | Flag.PRECISION
    | Flag.UNDETERMINED
    | Flag.IMPACTS
    | Flag.INSIDE
    | Flag.STRAIN
    | Flag.DEGENERATE
)

EXPLANATION = {
    Flag.NONFINITE: "a position, velocity or temperature is NaN or infinite, or a spring so long that its square is; try a smaller dt "
    "(see stable_dt), or look for a bad parameter",
    Flag.ENERGY_ROSE: "an implicit step raised the energy; try a smaller dt, or Newton's step",
    Flag.CG_MAXITER: "conjugate gradients ran out of iterations; raise max_iter, loosen the tolerance or use a preconditioner",
    Flag.CG_INDEFINITE: "the matrix is not positive definite; conjugate gradients cannot be trusted on it",
    Flag.LINE_SEARCH: "the line search found no step that lowers the potential",
    Flag.MECHANISM: "the net can move without a force; pin more nodes or add springs",
    Flag.PIVOT: "a pivot of the factorisation is not positive",
    Flag.COINCIDENT: "the ends of a spring with a rest length coincide, so its direction is undefined and its pull was taken as zero",
    Flag.OVERLAP: "particles overlap; their repulsion was capped",
    Flag.OUTSIDE: "nodes lie outside the image and take its border value",
    Flag.NEIGHBOUR_OVERFLOW: "the neighbour list is too small, nothing was left out; raise its capacity to the count or more",
    Flag.MAX_STEPS: "the adaptive solver ran out of steps; raise max_steps or loosen the tolerance",
    Flag.INTERRUPTED: "interrupted; the result holds what was done until then",
    Flag.DT_LIMIT: "dt is too long: above the stability limit (see stable_dt), or for particles that move or meet so fast",
    Flag.PRECISION: "rounding of such large coordinates spoils the forces; move the scene to the origin, or use float64",
    Flag.SOLVER: "the solver gave up: its solve did not reach the accuracy it needs, or its step shrank to the least allowed",
    Flag.UNSTABLE: "the forces balance, but the shape is no minimum of the energy: a small push makes it buckle; start from one",
    Flag.UNDETERMINED: "the data leave some of the parameters open; fix or tie them, or add data",
    Flag.IMPACTS: "a node met more obstacles in one step than are followed, and waited at the last one; lower dt",
    Flag.INSIDE: "nodes are inside an obstacle (the deepest is named): they go no deeper and are not lifted; move them out with "
    "js.contact.push_out, or move the obstacle",
    Flag.STRAIN: "springs stay stretched beyond their limit: their ends may be held too far apart; else raise sweeps, or lower dt",
    Flag.DEGENERATE: "an edge without length or a triangle without area, or elements folded onto each other, leave bending without a "
    "direction, and its moment there was taken as zero",
    Flag.BOX: "the box is too small: a spring has reached half a period, where its pull turns to another image of its node, or a fluid's "
    "cut-off is beyond it; use a larger box, shorter springs or cut-off",
    Flag.INVALID: "a parameter has a value that its constructor would refuse (sign, NaN or infinity)",
}

NOWHERE = -1


class Status(eqx.Module):
    """Flags raised, and where the first of them was.

    Attributes:
        flags: bit mask of `Flag`; 0 is OK.
        step: step at whose end the first trouble was seen (0: before the first step; -1: no trouble).
        node: node concerned, in the user's order (-1: none in particular).
        effect: index into the system's forces (-1: none in particular).
        count: how many nodes or springs were concerned.
    """

    flags: UInt32[Array, "*batch"]
    step: Int[Array, "*batch"]
    node: Int[Array, "*batch"]
    effect: Int[Array, "*batch"]
    count: Int[Array, "*batch"]

    def __str__(self) -> str:
        """What went wrong, in words; the tree where it is traced."""
        return repr(self) if isinstance(self.flags, Tracer) else self.describe()

    @staticmethod
    def ok() -> Status:
        """A status with no flag."""
        nowhere = jnp.asarray(NOWHERE, jnp.int32)
        return Status(jnp.zeros((), jnp.uint32), nowhere, nowhere, nowhere, jnp.zeros((), jnp.int32))

    @staticmethod
    def when(
        flag: Flag,
        condition: ArrayLike,
        *,
        step: ArrayLike = NOWHERE,
        node: ArrayLike = NOWHERE,
        effect: int = NOWHERE,
        count: ArrayLike = 1,
    ) -> Status:
        """A status with `flag` where `condition` holds, and OK where it does not."""
        raised = jnp.asarray(condition, jnp.bool_)

        def pick(value: Any, otherwise: int) -> Array:
            return jnp.where(raised, jnp.asarray(value, jnp.int32), jnp.asarray(otherwise, jnp.int32))

        flags = jnp.where(raised, jnp.asarray(int(flag), jnp.uint32), jnp.asarray(0, jnp.uint32))
        return Status(flags, pick(step, NOWHERE), pick(node, NOWHERE), pick(effect, NOWHERE), pick(count, 0))

    def then(self, later: Status) -> Status:
        """Joined with a later status: flags are joined; place and count are those of the first error, else of the first warning."""
        warning = jnp.asarray(int(WARNINGS), jnp.uint32)
        nothing = jnp.asarray(0, jnp.uint32)
        worse = ((self.flags & ~warning) == nothing) & ((later.flags & ~warning) != nothing)
        take = (self.flags == nothing) | worse

        def choose(old: Array, new: Array) -> Array:
            return jnp.where(take, new, old)

        return Status(
            self.flags | later.flags,
            choose(self.step, later.step),
            choose(self.node, later.node),
            choose(self.effect, later.effect),
            choose(self.count, later.count),
        )

    def only_if(self, condition: Array) -> Status:
        """The status where `condition` holds, OK where it does not."""
        return jax.tree.map(lambda raised, ok: jnp.where(condition, raised, ok), self, Status.ok())

    @property
    def is_ok(self) -> Array:
        """Whether no error was raised (warnings allowed)."""
        return (self.flags & jnp.asarray(int(~WARNINGS) & 0xFFFFFFFF, jnp.uint32)) == jnp.asarray(0, jnp.uint32)

    def has(self, flag: Flag) -> Array:
        """Whether `flag` was raised."""
        return (self.flags & jnp.asarray(int(flag), jnp.uint32)) != jnp.asarray(0, jnp.uint32)

    def describe(self, effects: tuple[str, ...] = (), step_word: str = "step") -> str:
        """What went wrong, errors before warnings: of a batch in how many lanes, and the place in the first lane that failed.

        Args:
            effects: names of the forces and rules, in the order of their indices.
            step_word: what a step is called, such as "iteration".

        Not for traced values.
        """
        if not is_readable(self):
            return "of scenes in several processes: call raise_for_status in all of them"
        flags = np.asarray(self.flags)
        errors, warned = (flags & int(~WARNINGS & 0xFFFFFFFF)) != 0, (flags & int(WARNINGS)) != 0
        if not np.any(flags):
            return "OK"
        is_bad = errors if np.any(errors) else warned
        first = tuple(int(i) for i in np.argwhere(is_bad)[0])
        place = self._place(first, effects, step_word)
        found = [flag for flag in Flag if flag and np.any(flags & int(flag))]
        found.sort(key=lambda flag: flag in WARNINGS)
        if not flags.ndim:
            names = "; ".join(f"{flag.name}: {EXPLANATION[flag]}" for flag in found)
            return names + (f" (first at {', '.join(place)})" if place else "")
        counts = "; ".join(f"{flag.name} in {np.sum((flags & int(flag)) != 0)}: {EXPLANATION[flag]}" for flag in found)
        own = " and ".join(flag.name or "" for flag in found if flags[first] & int(flag))
        lane = first[0] if len(first) == 1 else first
        alarms = f"{errors.sum()} of {flags.size} lanes failed" if np.any(errors) else "no lane failed"
        alarms += f", {warned.sum()} of {flags.size} warn" if np.any(warned) else ""
        return f"{alarms}. {counts} (first {'failing' if np.any(errors) else 'warning'} lane: {', '.join([f'lane {lane}', own, *place])})"

    def _place(self, lane: tuple[int, ...], effects: tuple[str, ...], step_word: str) -> list[str]:
        """Step, node, effect and count of one lane, as far as they are known."""
        step, node, effect, count = (int(np.asarray(a)[lane]) for a in (self.step, self.node, self.effect, self.count))
        place = [f"{step_word} {step}"] if step != NOWHERE else []
        place += [f"node {node}"] if node != NOWHERE else []
        if effect != NOWHERE:
            name = effects[effect] if effect < len(effects) else str(effect)
            place += [f"effect {effect} ({name})" if effects.count(name) > 1 else f"effect {name}"]
        return place + ([f"count {count}"] if count > 1 else [])


class SimulationError(RuntimeError):
    """A simulation ended with an error in its status."""


class StabilityWarning(UserWarning):
    """A simulation ended with a warning in its status, or is about to be run above its stability limit."""


class HasStatus(Protocol):
    """A result: whatever has a status."""

    @property
    def status(self) -> Status:
        """What went wrong, if anything."""
        ...


def raise_for_status(result: Status | HasStatus) -> None:
    """Raise `SimulationError` where `result` (or a `Status`) holds an error; warn where it holds a warning only.

    Inside `jit` a status is a traced value: return it and call this outside. Where scenes are in several processes, call it in all.

    Args:
        result: what a public function returned, or the status itself.

    Raises:
        SimulationError: an error was raised.
        TypeError: a status that is traced.
    """
    status = result if isinstance(result, Status) else result.status
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(status)):
        raise TypeError("raise_for_status was called on a traced status. Return the result from jit, and call it outside.")
    status, note = gathered(status), getattr(result, "effects", ())
    if not bool(np.all(np.asarray(status.is_ok))):
        hint = gathered(getattr(getattr(result, "info", None), "stable_dt", None))
        # Of the lane that the text names.
        failed = np.argwhere(~np.asarray(status.is_ok))[0]
        least = np.inf if hint is None else float(np.broadcast_to(np.asarray(hint), np.shape(status.flags))[tuple(failed)])
        limit = f" The stability limit of this run was dt = {least:.6g}." if np.isfinite(least) else ""
        raise SimulationError((getattr(result, "explanation", "") or status.describe(note)) + "." + limit)
    if bool(np.any(np.asarray(status.flags) != 0)):
        warnings.warn(getattr(result, "explanation", "") or status.describe(note), StabilityWarning, stacklevel=2)
