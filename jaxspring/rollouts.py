"""Fixed steps in time: `rollout`.

The steps run in blocks of about sqrt(n_steps), a scan of scans, both levels rematerialised in reverse mode: the memory of a gradient
grows with the square root of the number of steps, and costs two more forward runs. Status is taken once per block: NaN is sticky, so a
run that failed is replayed to find the step. Time is exact: t = t0 + i dt.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from . import printing
from ._arrays import Numbers
from ._checks import as_inexact, finite, has_shape, is_concrete
from .blocks import Adjoint, Checkpointed, Plan, make_plan, run_blocks
from .bound import BoundSystem
from .facts import of_functions
from .linalg.base import SolveInfo
from .numerics import is_traced, stopped
from .progress import LONG_RUN, N_CHUNKS, Progress
from .resume import Origin, Resume, check_kind, checksum, numbers, taken_up
from .state import State
from .status import EXPLANATION, WARNINGS, Flag, StabilityWarning, Status
from .steppers.base import Stepper
from .steppers.solves import Solves
from .steppers.stability import dt_limit
from .system import System, as_system
from .watch import Carry, Precision, begin, inspect, settle


class Info(eqx.Module):
    """Facts about a run.

    Attributes:
        stable_dt: largest dt [s] that is surely stable at the start; None where the stepper does not know.
        n_steps: steps that were done.
        solves: the solves of implicit steps summed up (iterations, largest residual, status); None for an explicit stepper.
        solves_saved: with `keep_solves`, the last solve before each frame, stacked on a leading axis (of every step if save_every=1).
    """

    stable_dt: Array | None
    n_steps: Array
    solves: Solves | None = None
    solves_saved: SolveInfo | None = None


class _Job(eqx.Module):
    """How a run is done: the arguments of `rollout` besides where it starts, and whether a failed run is replayed by the same program
    (static). An eager run leaves that out, which saves a fifth of the compile, and is done again with it where it failed.
    """

    stepper: Stepper
    dt: Array
    observe: Callable[[State], Any] | None
    plan: Plan = eqx.field(static=True)
    keep_solves: bool = eqx.field(static=True)
    functions: str = eqx.field(static=True)
    replays: bool = eqx.field(static=True, default=True)

    def keep(self, carry: Carry) -> tuple[Any, SolveInfo | None]:
        """What a frame holds."""
        frame = carry.state if self.observe is None else self.observe(carry.state)
        return frame, None if carry.solves is None or not self.keep_solves else carry.solves.last


class Result(eqx.Module):
    """What a rollout returns.

    Attributes:
        state: the last state.
        saved: states (or whatever `observe` returns) after steps save_every, 2 save_every, ..., stacked on a leading axis; else None.
        status: what went wrong, if anything; see `raise_for_status`.
        info: facts about the run.
        resume: for going on as if unbroken.
        effects: names of the system's forces and rules, for messages (static).
    """

    state: State
    saved: Any
    status: Status
    info: Info
    resume: Resume
    effects: tuple[str, ...] = eqx.field(static=True)

    def __str__(self) -> str:
        """A few lines for a person."""
        status = str(self.status) if is_traced(self.status) else self.status.describe(self.effects)
        frames = [] if self.saved is None else [f"frames of {type(self.saved).__name__} in `saved`"]
        return printing.under(f"Result after {printing.numbers(self.info.n_steps)} steps: {status}", [str(self.state), *frames])


def rollout(
    system: System,
    state: State,
    stepper: Stepper,
    dt: Numbers,
    n_steps: int,
    save_every: int | None = None,
    observe: Callable[[State], Any] | None = None,
    adjoint: Adjoint | None = None,
    progress: Progress | None = None,
    check_every: int | None = None,
    resume: Resume | None = None,
    keep_solves: bool = False,
) -> Result:
    """Advance a state by `n_steps` steps of `dt`.

    Args:
        system: what is simulated.
        state: where it starts. Float32 in, float32 out.
        stepper: how it steps, e.g. `SymplecticEuler()`.
        dt: time step [s]; may be traced. Zero returns the state unchanged; negative runs backward, by explicit steppers.
        n_steps: number of steps (static).
        save_every: keep a frame after every so many steps; must divide `n_steps`. None keeps none.
        observe: what to keep of a state in each frame; None keeps the whole state. A new lambda at every call compiles anew.
        adjoint: how reverse mode remembers; `Checkpointed()` unless said, or `StoreStates()`, `StoreAll()`.
        progress: a `Progress` shows a bar and may call the host between chunks of steps.
        check_every: look for trouble every so many steps instead of once per block.
        resume: the `resume` of an earlier result, to go on from its `state` as if unbroken. Where dt, a constant or the state has changed
            since, the stepper starts anew there, and time goes on from the state's.
        keep_solves: keep in each frame how the last solve of an implicit stepper ended, in `info.solves_saved`.

    Returns:
        A `Result`. Trouble is in its status, never an exception: call `raise_for_status(result)`. An eager call that is interrupted
        (Ctrl-C) returns what was done, with INTERRUPTED.

    Raises:
        ValueError: n_steps or save_every that do not fit, a dt that is not finite, a negative one where the stepper does not run backward,
            `observe` without `save_every`, a `resume` of another stepper, dtype, topology or list of effects, or of a batch.
        TypeError: a `resume` that is none.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=js.Springs(net, 1.0, 1.0))
    >>> result = rollout(system, js.State.from_points(net, net.grid()), js.SymplecticEuler(), dt=0.1, n_steps=10)
    >>> print(result.state.time)
    1.0
    """
    system = as_system(system)
    _check_steps(n_steps, save_every, observe, check_every)
    dt = _checked_dt(dt, state, stepper)
    plan = make_plan(n_steps, save_every, Checkpointed() if adjoint is None else adjoint, check_every)
    if resume is not None:
        check_kind(resume)
    job = _Job(stepper, dt, observe, plan, keep_solves, of_functions(system, observe))
    if is_traced(system, state, resume, job):
        return _compiled(system, state, resume, job, progress)
    result = _run_eagerly(system, state, resume, job, progress)
    _warn(result, dt)
    return result


def _warn(result: Result, dt: Array) -> None:
    """Warn of a dt and a dtype that may be at fault, at the line that called `rollout`."""
    raised = Flag(int(result.status.flags))
    if result.info.stable_dt is not None and Flag.DT_LIMIT in raised:
        limit = float(result.info.stable_dt)
        if abs(float(dt)) > limit:
            text = f"{EXPLANATION[Flag.DT_LIMIT]}: dt = {float(dt):.6g} s, but this run is surely stable only up to {limit:.6g} s"
        else:
            text = (
                f"dt = {float(dt):.6g} s was below stable_dt at the start, but later the limit fell below it (`result.status` says where): "
                f"particles moved or met too fast, farther in a step than half the list's skin or a node's radius or for the fluid's "
                f"collision_dt, or a node became too hot. Lower dt, or widen the skin"
            )
        warnings.warn(f"DT_LIMIT: {text}.", StabilityWarning, stacklevel=3)
    # A run that failed has grown too large as well, but that is not what was wrong.
    if Flag.PRECISION in raised and raised in WARNINGS:
        warnings.warn(f"PRECISION: {EXPLANATION[Flag.PRECISION]}.", StabilityWarning, stacklevel=3)


class _Begun(eqx.Module):
    """What is made once, before the first step: where the steps start, the memory of the stepper, what is wrong already.

    Attributes:
        state: where the steps start.
        resume: with the stepper's memory.
        limit: largest stable dt [s], or None.
        status: what is wrong before the first step.
        precise: how far coordinates may grow before rounding is looked at.
        is_fresh: whether no earlier run goes on here (static): steps are then counted from zero.
    """

    state: State
    resume: Resume
    limit: Array | None
    status: Status
    precise: Precision
    is_fresh: bool = eqx.field(static=True)

    def at(self, result: Result) -> _Begun:
        """The same where a part of the run has ended."""
        return eqx.tree_at(lambda b: (b.state, b.resume, b.status), self, (result.state, result.resume, Status.ok()))


def _begin(system: System, ready: BoundSystem, state: State, resume: Resume | None, job: _Job) -> _Begun:
    start = ready.begin(state)
    still, still_start = stopped((ready, start))
    limit = dt_limit(still, still_start, job.stepper)
    if resume is None:
        taken = _fresh(system, ready, state, start, job)
    else:
        taken, start = taken_up(resume, system, ready, state, start, job.stepper, job.dt)
    precise = Precision.of(ready, start)
    status = begin(system, ready, precise, Carry(start, taken.memory, taken.step), job.dt, limit)
    if not job.stepper.runs_backward:
        status = status.then(Status.when(Flag.INVALID, stopped(job.dt) < 0, step=taken.step))
    return _Begun(start, taken, limit, status, precise, resume is None)


def _fresh(system: System, ready: BoundSystem, state: State, start: State, job: _Job) -> Resume:
    """Where nothing goes on."""
    zero = jnp.zeros((), jnp.int32)
    memory, origin = job.stepper.init(ready, start), Origin.of(system, state, job.stepper)
    constants = checksum(numbers((system, job.stepper)))
    return Resume(state.time, zero, zero, state.time, job.dt, memory, constants, jnp.zeros((), jnp.uint32), origin)


def _proceed(ready: BoundSystem, begun: _Begun, job: _Job, progress: Progress | None = None) -> Result:
    """The steps, and how they ended."""
    resume, limit = begun.resume, begun.limit
    still, info = stopped(ready), job.stepper.report(resume.memory)
    if job.keep_solves and (info is None or job.plan.save_every is None):
        raise ValueError("keep_solves keeps how an implicit stepper's solves ended in each frame: pass save_every and an implicit stepper.")
    found = Status.ok() if ready.followers else None
    carry = Carry(begun.state, resume.memory, resume.step, None if info is None else Solves.none(info), found)
    clock = _Clock(resume.start_time, None if begun.is_fresh else resume.start_step, job.dt)

    def report(carry: Carry) -> None:
        if progress is not None:
            jax.debug.callback(partial(progress.update, total=job.plan.n_steps), carry.step - resume.step)

    first = stopped(carry)
    advance, look = partial(_advance, ready, job.stepper, clock), partial(inspect, ready, begun.precise, begun.state)
    (carry, status), frames = run_blocks(advance, look, job.keep, report, (carry, begun.status), job.plan)
    saved, solves_saved = (None, None) if frames is None else frames
    if carry.solves is None and job.replays:
        # The replay of a failed run is not part of what is differentiated.
        status = settle(partial(_advance, still, job.stepper, stopped(clock)), first, status, still)
    elif carry.solves is not None:
        # An implicit step looks at itself, so that nothing need be replayed. What was wrong before the first step comes first.
        at_start = status.step == resume.step
        status = status.only_if(at_start).then(carry.solves.status).then(status.only_if(~at_start))
    if carry.found is not None:
        status = status.then(carry.found)
    reached = (carry.step, carry.state.time, job.dt, carry.memory, checksum(carry.state))
    return Result(
        state=carry.state,
        saved=saved,
        status=_in_user_order(status, begun.state),
        info=Info(limit, carry.step, carry.solves, solves_saved),
        resume=eqx.tree_at(lambda r: (r.step, r.time, r.dt, r.memory, r.state), resume, reached, is_leaf=lambda leaf: leaf is None),
        effects=ready.effects,
    )


class _Clock(eqx.Module):
    """Time by the count of steps: t = t0 + (i - i0) dt; `start_step` i0 is None where it is zero."""

    start_time: Array
    start_step: Array | None
    dt: Array

    def at(self, index: Array) -> Array:
        """Time after so many steps [s]."""
        n_steps = index if self.start_step is None else index - self.start_step
        return self.start_time + n_steps.astype(self.dt.dtype) * self.dt


def _run(system: System, state: State, resume: Resume | None, job: _Job, progress: Progress | None = None) -> Result:
    """The whole run as one traced program."""
    ready = system.bind(state.dtype)
    return _proceed(ready, _begin(system, ready, state, resume, job), job, progress)


def _in_user_order(status: Status, state: State) -> Status:
    """The status naming the node by the user's number, where the topology has its own."""
    permutation = state.layout.permutation
    if permutation is None:
        return status
    named = jnp.asarray(permutation.order)[jnp.maximum(status.node, 0)]
    return eqx.tree_at(lambda s: s.node, status, jnp.where(status.node >= 0, named, status.node))


def _advance(system: BoundSystem, stepper: Stepper, clock: _Clock, carry: Carry) -> Carry:
    index, dt = carry.step + 1, clock.dt
    state, memory = stepper.step(system, carry.state, dt, carry.memory)
    state = eqx.tree_at(lambda s: s.time, state, clock.at(index))
    info = stopped(stepper.report(memory))
    solves = carry.solves if carry.solves is None or info is None else carry.solves.then(info, index)
    state = state if system.motion is None else system.constrain(state)
    if carry.found is None:
        return Carry(state, memory, index, solves)
    moved = state
    state, status = system.follow(carry.state, moved, dt, stepper.pushed(memory))
    if any(part.moves or part.breaks or part.drives for _, part in system.followers):
        memory = stepper.after_rules(system, carry.state, moved, state, dt, memory)
    status = stopped(eqx.tree_at(lambda s: s.step, status, jnp.where(status.flags != 0, index, status.step)))
    return Carry(state, memory, index, solves, carry.found.then(status))


_compiled = eqx.filter_jit(_run)
_compiled_begin = eqx.filter_jit(lambda system, state, *rest: _begin(system, system.bind(state.dtype), state, *rest))
_compiled_proceed = eqx.filter_jit(lambda system, begun, job: _proceed(system.bind(begun.state.dtype), begun, job))


def _run_eagerly(system: System, state: State, resume: Resume | None, job: _Job, progress: Progress | None) -> Result:
    """The run in chunks, with the host between them where somebody watches or the run is long."""
    plan, job = job.plan, replace(job, replays=False)
    # A piece costs some passes over the state: without a watcher each is long enough for that not to show.
    n_pieces = N_CHUNKS if progress is not None else min(N_CHUNKS, plan.n_steps * math.prod(state.position.shape) // LONG_RUN)
    pieces = plan.pieces(n_pieces)
    if len(pieces) == 1 and progress is None:
        result = _compiled(system, state, resume, job)
        return _compiled(system, state, resume, replace(job, replays=True)) if _is_unnamed(result) else result
    begun = _compiled_begin(system, state, resume, job)
    # One name, so that Ctrl-C at any moment finds the result and its frames together.
    so_far: tuple[Any, tuple[Any, ...], int] = (None, (), 0)
    try:
        for piece in pieces:
            before, frames, done = so_far
            at, part = begun if before is None else begun.at(before), replace(job, plan=piece)
            latest = _compiled_proceed(system, at, part)
            if _is_unnamed(latest) and (before is None or not before.status.has(Flag.NONFINITE)):
                latest = _compiled_proceed(system, at, replace(part, replays=True))
            if len(pieces) > 1 or progress is not None:
                jax.block_until_ready(latest)
            frame = (latest.saved, latest.info.solves_saved)
            if before is not None:
                latest = eqx.tree_at(lambda r: (r.status, r.info), latest, (before.status.then(latest.status), _joined(before, latest)))
            so_far = (latest, (*frames, frame), done + piece.n_steps)
            if progress is not None:
                progress.update(so_far[2], plan.n_steps)
    except KeyboardInterrupt:
        if so_far[0] is None:
            raise
        stopped_here = Status.when(Flag.INTERRUPTED, True, step=so_far[0].resume.step)
        so_far = (eqx.tree_at(lambda r: r.status, so_far[0], so_far[0].status.then(stopped_here)), *so_far[1:])
    result: Any = so_far[0]
    frames = so_far[1]
    if len(frames) > 1 and plan.save_every is not None:
        saved, solves_saved = jax.tree.map(lambda *parts: jnp.concatenate(parts), *frames)
        result = replace(result, saved=saved, info=replace(result.info, solves_saved=solves_saved))
    return result


def _is_unnamed(result: Result) -> bool:
    """Whether a run of explicit steps failed at a step that is not known yet."""
    return result.info.solves is None and Flag.NONFINITE in Flag(int(result.status.flags))


def _joined(first: Result, latest: Result) -> Info:
    solves = latest.info.solves
    if solves is not None and first.info.solves is not None:
        solves = first.info.solves.joined(solves)
    return Info(first.info.stable_dt, latest.info.n_steps, solves, latest.info.solves_saved)


def _checked_dt(dt: Any, state: State, stepper: Stepper) -> Array:
    dt = as_inexact("dt", dt, state.checked().dtype)
    has_shape("dt", dt, {"one number": ()})
    if is_concrete(dt):
        finite("dt", dt)
        if np.asarray(dt) < 0 and not stepper.runs_backward:
            raise ValueError(f"dt = {dt}, but {type(stepper).__name__} does not run backward. Use VelocityVerlet(), or a positive dt.")
    return dt


def _check_steps(n_steps: int, save_every: int | None, observe: Any, check_every: int | None) -> None:
    for name, value, least in (("n_steps", n_steps, 0), ("save_every", save_every, 1), ("check_every", check_every, 1)):
        if value is None and name != "n_steps":
            continue
        if isinstance(value, Tracer) or not isinstance(value, (int, np.integer)) or isinstance(value, bool):
            raise TypeError(f"{name} = {value!r}; expected a whole number, known when the program is compiled.")
        if value < least:
            raise ValueError(f"{name} = {value}; expected {least} or more.")
    if observe is not None and save_every is None:
        raise ValueError("observe says what to keep of each frame, but save_every is None, so that there are no frames. Pass save_every.")
    if save_every is not None and n_steps % save_every:
        raise ValueError(
            f"n_steps = {n_steps} is not a multiple of save_every = {save_every}: the last {n_steps % save_every} steps would be in no "
            f"frame. Pass n_steps = {n_steps - n_steps % save_every} or {n_steps - n_steps % save_every + save_every}."
        )
