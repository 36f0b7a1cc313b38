"""Fixed steps in time: `rollout`.

The steps run in blocks of about sqrt(n_steps), a scan of scans, both levels rematerialised in reverse mode: the memory of a gradient
grows with the square root of the number of steps, and costs one more forward run. Status is taken once per block: NaN is sticky, so a
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

from ._checks import finite, is_concrete
from .blocks import Adjoint, Checkpointed, Plan, make_plan, run_blocks
from .linalg.base import SolveInfo
from .numerics import is_traced, stopped
from .progress import LONG_RUN, N_CHUNKS, Progress
from .state import State
from .status import EXPLANATION, Flag, StabilityWarning, Status
from .steppers.base import Stepper
from .steppers.stability import dt_limit
from .system import System
from .watch import Carry, Solves, begin, inspect, settle


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


class Resume(eqx.Module):
    """What an unbroken run carries besides its state: pass it to `rollout(resume=...)` to go on bit for bit."""

    start_time: Array
    step: Array
    memory: Any


class _Job(eqx.Module):
    """How a run is done: the arguments of `rollout` besides where it starts."""

    stepper: Stepper
    dt: Array
    observe: Callable[[State], Any] | None
    plan: Plan = eqx.field(static=True)
    keep_solves: bool = eqx.field(static=True)

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
        resume: for going on bit for bit.
        effects: names of the system's forces and rules, for messages (static).
    """

    state: State
    saved: Any
    status: Status
    info: Info
    resume: Resume
    effects: tuple[str, ...] = eqx.field(static=True)


def rollout(
    system: System,
    state: State,
    stepper: Stepper,
    dt: Any,
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
        resume: the `resume` of an earlier result, to go on as if unbroken.
        keep_solves: keep in each frame how the last solve of an implicit stepper ended, in `info.solves_saved`.

    Returns:
        A `Result`. Trouble is in its status, never an exception: call `raise_for_status(result)`. An eager call that is interrupted
        (Ctrl-C) returns what was done, with INTERRUPTED.

    Raises:
        ValueError: n_steps or save_every that do not fit, a dt that is not finite, a negative one where the stepper does not run backward,
            `observe` without `save_every`.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=js.Springs(net, 1.0, 1.0))
    >>> result = rollout(system, js.State.from_points(net, net.grid()), js.SymplecticEuler(), dt=0.1, n_steps=10)
    >>> print(result.state.time)
    1.0
    """
    _check_steps(n_steps, save_every, observe, check_every)
    if is_concrete(dt):
        finite("dt", dt)
        if np.any(np.asarray(dt) < 0) and not stepper.runs_backward:
            raise ValueError(f"dt = {dt}, but {type(stepper).__name__} does not run backward. Use VelocityVerlet(), or a positive dt.")
    dt = jnp.asarray(dt, state.dtype)
    plan = make_plan(n_steps, save_every, Checkpointed() if adjoint is None else adjoint, check_every)
    resume = Resume(state.time, jnp.zeros((), jnp.int32), _Unset()) if resume is None else resume
    job = _Job(stepper, dt, observe, plan, keep_solves)
    if is_traced(system, state, resume, job):
        return _compiled(system, state, resume, job, progress)
    result = _run_eagerly(system, state, resume, job, progress)
    _warn(result, dt)
    return result


def _warn(result: Result, dt: Array) -> None:
    """Warn of a dt and a dtype that may be at fault, at the line that called `rollout`."""
    if result.info.stable_dt is not None and bool(result.status.has(Flag.DT_LIMIT)):
        limit = float(result.info.stable_dt)
        if abs(float(dt)) > limit:
            text = f"{EXPLANATION[Flag.DT_LIMIT]}: dt = {float(dt):.6g} s, but this run is surely stable only up to {limit:.6g} s"
        else:
            text = (
                f"dt = {float(dt):.6g} s was below stable_dt at the start, but later the limit fell below it (`result.status` says where): "
                f"particles moved or met too fast, farther in a step than half the list's skin or for the fluid's collision_dt, or a "
                f"node became too hot. Lower dt, or widen the skin"
            )
        warnings.warn(f"DT_LIMIT: {text}.", StabilityWarning, stacklevel=3)
    if bool(result.status.has(Flag.PRECISION)):
        warnings.warn(f"PRECISION: {EXPLANATION[Flag.PRECISION]}.", StabilityWarning, stacklevel=3)


class _Begun(eqx.Module):
    """What is made once, before the first step: constants as the loop wants them, the memory of the stepper, what is wrong already."""

    ready: System
    state: State
    resume: Resume
    limit: Array | None
    status: Status

    def at(self, result: Result) -> _Begun:
        """The same where a part of the run has ended."""
        return eqx.tree_at(lambda b: (b.state, b.resume, b.status), self, (result.state, result.resume, Status.ok()))


def _begin(system: System, state: State, resume: Resume, job: _Job) -> _Begun:
    ready = system.prepare(state.dtype)
    start = ready.begin(state)
    still, still_start = stopped((ready, start))
    limit = dt_limit(still, still_start, job.stepper)
    memory = job.stepper.init(ready, start) if isinstance(resume.memory, _Unset) else resume.memory
    status = begin(system, ready, Carry(start, memory, resume.step), job.dt, limit)
    if not job.stepper.runs_backward:
        status = status.then(Status.when(Flag.INVALID, stopped(job.dt) < 0, step=resume.step))
    return _Begun(ready, start, Resume(resume.start_time, resume.step, memory), limit, status)


def _proceed(begun: _Begun, job: _Job, progress: Progress | None = None) -> Result:
    """The steps, and how they ended."""
    ready, resume, limit = begun.ready, begun.resume, begun.limit
    still, info = stopped(ready), job.stepper.report(resume.memory)
    if job.keep_solves and (info is None or job.plan.save_every is None):
        raise ValueError("keep_solves keeps how an implicit stepper's solves ended in each frame: pass save_every and an implicit stepper.")
    found = Status.ok() if ready.followers else None
    carry = Carry(begun.state, resume.memory, resume.step, None if info is None else Solves.none(info), found)

    advance = partial(_advance, ready, job.stepper, job.dt, resume.start_time)

    def report(carry: Carry) -> None:
        if progress is not None:
            jax.debug.callback(partial(progress.update, total=job.plan.n_steps), carry.step)

    first = stopped(carry)
    (carry, status), frames = run_blocks(advance, partial(inspect, ready, begun.state), job.keep, report, (carry, begun.status), job.plan)
    saved, solves_saved = (None, None) if frames is None else frames
    if carry.solves is None:
        # The replay of a failed run is not part of what is differentiated.
        still_dt, still_time = stopped((job.dt, resume.start_time))
        status = settle(partial(_advance, still, job.stepper, still_dt, still_time), first, status, still)
    else:
        # An implicit step looks at itself, so that nothing need be replayed. What was wrong before the first step comes first.
        at_start = status.step == 0
        status = status.only_if(at_start).then(carry.solves.status).then(status.only_if(~at_start))
    if carry.found is not None:
        status = status.then(carry.found)
    return Result(
        state=carry.state,
        saved=saved,
        status=_in_user_order(status, begun.state),
        info=Info(limit, carry.step, carry.solves, solves_saved),
        resume=Resume(resume.start_time, carry.step, carry.memory),
        effects=ready.effects,
    )


def _run(system: System, state: State, resume: Resume, job: _Job, progress: Progress | None = None) -> Result:
    """The whole run as one traced program."""
    return _proceed(_begin(system, state, resume, job), job, progress)


def _in_user_order(status: Status, state: State) -> Status:
    """The status naming the node by the user's number, where the topology has its own."""
    permutation = state.layout.permutation
    if permutation is None:
        return status
    named = jnp.asarray(permutation.order)[jnp.maximum(status.node, 0)]
    return eqx.tree_at(lambda s: s.node, status, jnp.where(status.node >= 0, named, status.node))


def _advance(system: System, stepper: Stepper, dt: Array, start_time: Array, carry: Carry) -> Carry:
    index = carry.step + 1
    state, memory = stepper.step(system, carry.state, dt, carry.memory)
    state = eqx.tree_at(lambda s: s.time, state, start_time + index.astype(dt.dtype) * dt)
    info = stopped(stepper.report(memory))
    solves = carry.solves if carry.solves is None or info is None else carry.solves.then(info, index)
    state = state if system.motion is None else system.constrain(state)
    if carry.found is None:
        return Carry(state, memory, index, solves)
    state, status = system.follow(carry.state, state, dt)
    status = stopped(eqx.tree_at(lambda s: s.step, status, jnp.where(status.flags != 0, index, status.step)))
    return Carry(state, memory, index, solves, carry.found.then(status))


_compiled = eqx.filter_jit(_run)
_compiled_begin = eqx.filter_jit(_begin)
_compiled_proceed = eqx.filter_jit(_proceed)


def _run_eagerly(system: System, state: State, resume: Resume, job: _Job, progress: Progress | None) -> Result:
    """The run in chunks, with the host between them where somebody watches or the run is long."""
    plan = job.plan
    # A piece costs some passes over the state: without a watcher each is long enough for that not to show.
    n_pieces = N_CHUNKS if progress is not None else min(N_CHUNKS, plan.n_steps * math.prod(state.position.shape) // LONG_RUN)
    pieces = plan.pieces(n_pieces)
    if len(pieces) == 1 and progress is None:
        return _compiled(system, state, resume, job)
    result: Any = None
    frames, done = [], 0
    begun = _compiled_begin(system, state, resume, job)
    try:
        for piece in pieces:
            latest = _compiled_proceed(begun, replace(job, plan=piece))
            if len(pieces) > 1 or progress is not None:
                jax.block_until_ready(latest)
            if result is not None:
                latest = eqx.tree_at(lambda r: (r.status, r.info), latest, (result.status.then(latest.status), _joined(result, latest)))
            result, begun, done = latest, begun.at(latest), done + piece.n_steps
            frames.append((latest.saved, latest.info.solves_saved))
            if progress is not None:
                progress.update(done, plan.n_steps)
    except KeyboardInterrupt:
        if result is None:
            raise
        stopped_here = Status.when(Flag.INTERRUPTED, True, step=result.resume.step)
        result = eqx.tree_at(lambda r: r.status, result, result.status.then(stopped_here))
    if len(frames) > 1 and plan.save_every is not None:
        saved = jax.tree.map(lambda *parts: jnp.concatenate(parts), *frames)
        result = Result(result.state, saved[0], result.status, replace(result.info, solves_saved=saved[1]), result.resume, result.effects)
    return result


def _joined(first: Result, latest: Result) -> Info:
    solves = latest.info.solves
    if solves is not None and first.info.solves is not None:
        solves = first.info.solves.joined(solves)
    return Info(first.info.stable_dt, latest.info.n_steps, solves, latest.info.solves_saved)


class _Unset(eqx.Module):
    """A stepper's memory that is not made yet."""


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
