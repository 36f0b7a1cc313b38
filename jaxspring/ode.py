"""The bridge to diffrax: adaptive steps, high orders, implicit solvers, and an independent reference for `rollout`.

    y = (position, velocity)        dy/dt = (velocity, acceleration)

Held nodes have derivative zero and stay exactly where they are. Nodes on a schedule are put there at every evaluation.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._arrays import Numbers, given
from ._checks import as_inexact, finite, has_shape, is_concrete
from .bound import BoundSystem, reads_velocity
from .events import on_states
from .forces.base import acts, remembers
from .numerics import linear_call
from .state import State
from .status import Flag, Status
from .system import System, as_system
from .vector import Vector
from .watch import Carry, Precision, begin, look

if TYPE_CHECKING:
    import diffrax

Y = tuple[Vector, Vector]


class OdeInfo(eqx.Module):
    """What the solver did.

    Attributes:
        n_steps: steps tried.
        n_accepted: steps taken.
        n_rejected: steps tried again with a smaller dt.
        solver_result: diffrax's own verdict, a `diffrax.RESULTS`.
        interpolation: the solution as a function of time, where `saveat` has `dense=True`: see `OdeResult.at`.
    """

    n_steps: Array
    n_accepted: Array
    n_rejected: Array
    solver_result: Any
    interpolation: Any


class OdeResult(eqx.Module):
    """What `diffeqsolve` returns.

    Attributes:
        state: the state at t1, or the last one reached.
        saved: states (or whatever SaveAt's `fn` returns) at `times`, stacked on a leading axis; None without `saveat`.
        times: [s], in the structure of `saveat`; infinite in slots that were not reached.
        status: what went wrong, if anything; see `raise_for_status`.
        info: facts about the run.
        event: booleans in the structure of the event's conditions: which one ended the run, at `state.time`. All are False where the
            run came to t1 or failed; None without an event.
        effects: names of the system's forces, for messages (static).
    """

    state: State
    saved: Any
    times: Any
    status: Status
    info: OdeInfo
    event: Any
    effects: tuple[str, ...] = eqx.field(static=True)

    def at(self, time: Numbers) -> State:
        """The state at any time [s] between the start and the end; needs `saveat=diffrax.SaveAt(dense=True)`."""
        if self.info.interpolation is None:
            raise ValueError("this result keeps no interpolation. Pass saveat=diffrax.SaveAt(dense=True) to diffeqsolve.")
        times = (self.info.interpolation.t0, self.info.interpolation.t1)
        if all(is_concrete(value) for value in (time, *times)):
            low, high = sorted(float(value) for value in times)
            slack = float(jnp.finfo(self.state.dtype).eps) * max(abs(low), abs(high))
            if not np.all((np.asarray(time) >= low - slack) & (np.asarray(time) <= high + slack)):
                raise ValueError(f"time = {time} lies outside this run, which went from {float(times[0])} to {float(times[1])}.")
        time = as_inexact("time", time, self.state.dtype)
        position, velocity = self.info.interpolation.evaluate(time)
        return self.state.moved(position, velocity, time)


def diffeqsolve(
    system: System,
    state: State,
    t1: Numbers,
    solver: diffrax.AbstractSolver | None = None,
    dt0: Numbers | None = None,
    saveat: diffrax.SaveAt | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    max_steps: int | None = 4096,
    event: diffrax.Event | None = None,
) -> OdeResult:
    """Solve a system from `state.time` to `t1` by a diffrax solver: explicit, implicit or semi-implicit.

    Args:
        system: what is simulated.
        state: where it starts. Float32 in, float32 out.
        t1: time of the end [s]; before `state.time` runs backward.
        solver: `diffrax.Tsit5()` unless said. Semi-implicit ones need forces that do not depend on velocity.
        dt0: first step [s]; None lets the controller choose. Negative where t1 lies before the start.
        saveat: a `diffrax.SaveAt`. What it saves are `State`s; its own `fn` is called as fn(time, state, system).
        stepsize_controller: None takes constant steps of `dt0` where that is given, and else adapts the step to a relative and
            absolute tolerance of sqrt(eps): 1.5e-8 in float64, 3.5e-4 in float32.
        adjoint: how derivatives are taken; `diffrax.RecursiveCheckpointAdjoint()` (reverse mode) unless said.
        progress_meter: e.g. `diffrax.TqdmProgressMeter()`.
        max_steps: most steps to try.
        event: a `diffrax.Event`, which ends the run early. Its conditions are called as cond_fn(time, state, system). A boolean ends the
            run at the end of the step; a number that changes its sign ends it at the zero, to the tolerance of the event's `root_finder`
            (without one at the end of the step, whose time has no derivative by the parameters). With a root finder the final state and
            its time are differentiable. A number that is zero at the start counts as crossed when it comes back. t1 may be infinite.

    Returns:
        An `OdeResult`. Trouble is in its status, never an exception: NONFINITE, MAX_STEPS, SOLVER; call `raise_for_status(result)`.

    Raises:
        ValueError: times that are not finite or of the wrong sign; options that do not fit together; a system with rules.
        TypeError: a solver that wants the right-hand side split (implicit-explicit, stochastic); a derivative that `adjoint` lacks.

    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=js.Springs(net, 1.0, 1.0))
    >>> print(diffeqsolve(system, js.State.from_points(net, net.grid()), t1=1.0).state.time)
    1.0
    """
    import diffrax

    _check_options(solver, saveat, stepsize_controller, adjoint, progress_meter, max_steps, event)
    _check_times(state.checked(), t1, dt0, may_be_infinite=event is not None)
    _check_parts(as_system(system))
    t1 = as_inexact("t1", t1, state.dtype)
    dt0 = None if dt0 is None else as_inexact("dt0", dt0, state.dtype)
    if stepsize_controller is None:
        tolerance = float(jnp.finfo(state.dtype).eps) ** 0.5
        adaptive = diffrax.PIDController(rtol=tolerance, atol=tolerance)
        stepsize_controller = adaptive if dt0 is None else diffrax.ConstantStepSize()
    solver = diffrax.Tsit5() if solver is None else solver
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    with _mode_named(adjoint):
        return _solve(system, state, t1, solver, dt0, saveat, stepsize_controller, adjoint, meter, max_steps, event)


@contextlib.contextmanager
def _mode_named(adjoint: Any) -> Iterator[None]:
    """Forward mode through an adjoint of reverse mode ends in a sentence that names the one to take."""
    try:
        yield
    except TypeError as error:
        if "forward-mode" not in str(error):
            raise
        raise TypeError(
            f"{type(adjoint).__name__} takes derivatives in reverse mode only, and this is forward mode (jvp, jacfwd, linearize, hessian). "
            "Pass adjoint=diffrax.ForwardMode() for jvp and jacfwd, or diffrax.DirectAdjoint(), which takes both modes, for hessian."
        ) from error


@eqx.filter_jit
def _solve(
    system: System,
    state: State,
    t1: Array,
    solver: Any,
    dt0: Array | None,
    saveat: Any,
    controller: Any,
    adjoint: Any,
    meter: Any,
    max_steps: int | None,
    event: Any,
) -> OdeResult:
    import diffrax

    ready = system.bind(state.dtype)
    # A cache is kept up to date by rollout alone: without it each evaluation makes its own.
    start = ready.alone(state)
    first = Carry(start, None, jnp.zeros((), jnp.int32))
    before = begin(system, ready, Precision.of(ready, start), first, jnp.zeros((), state.dtype), None)
    end = diffrax.SubSaveAt(t1=True)
    scene = _Scene(ready, dataclasses.replace(start, position=None, velocity=None))
    y0 = (start.position, start.velocity)
    solution = diffrax.diffeqsolve(
        _terms(ready, start, solver),
        solver,
        start.time,
        t1,
        dt0,
        y0,
        args=scene,
        saveat=diffrax.SaveAt(subs=end) if saveat is None else _with_end(saveat, end),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=meter,
        event=None if event is None else on_states(event, _as_state, _flow, (start.time, y0, scene), t1),
    )
    found: Any = solution
    if isinstance(adjoint, diffrax.ForwardMode):
        found = eqx.tree_at(lambda s: (s.ts, s.ys), solution, _forward_only((solution.ts, solution.ys)))
    times, frames = (found.ts, found.ys) if saveat is None else (found.ts[1], found.ys[1])
    last = _as_state(times[0], jax.tree.map(lambda a: a[0], frames), _Scene(ready, start))
    names = ("num_steps", "num_accepted_steps", "num_rejected_steps")
    n_steps, n_accepted, n_rejected = (jnp.asarray(found.stats[name], jnp.int32) for name in names)
    status = before.then(look(ready, Carry(last, None, n_steps), start)).then(_verdict(solution.result, n_steps))
    return OdeResult(
        state=last,
        saved=None if saveat is None else found.ys[0],
        times=None if saveat is None else found.ts[0],
        status=jax.lax.stop_gradient(status),
        info=OdeInfo(n_steps, n_accepted, n_rejected, solution.result, solution.interpolation),
        event=solution.event_mask,
        effects=system.effects,
    )


def _forward_only(tree: Any) -> Any:
    """The tree, whose derivative in reverse mode is an error that says so."""
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(_marked(arrays), rest)


@jax.custom_jvp
def _marked(arrays: Any) -> Any:
    return arrays


@_marked.defjvp
def _marked_jvp(primals: Any, tangents: Any) -> Any:
    return primals[0], linear_call(lambda _, tangent: tangent, _refuse_reverse, None, tangents[0])


def _refuse_reverse(_: Any, cotangent: Any) -> Any:
    raise TypeError(
        "ForwardMode takes derivatives in forward mode only (jvp, jacfwd), and this is reverse mode (grad, jacrev). Leave the adjoint out, "
        "or pass diffrax.DirectAdjoint(), which takes both modes."
    )


class _Scene(eqx.Module):
    """The system, and a state that holds all that does not move."""

    system: BoundSystem
    like: State


def _as_state(time: Array, y: Y, scene: _Scene) -> State:
    return scene.system.constrain(scene.like.moved(*y, time.astype(y[0].dtype)))


def _flow(time: Any, y: Any, scene: Any) -> Any:
    """dy/dt. Module-level, so that diffrax compiles it once."""
    state = _as_state(time, y, scene)
    return state.velocity, scene.system.acceleration(state)


def _drift(time: Any, velocity: Any, scene: Any) -> Any:
    return scene.system.hold(velocity)


def _kick(time: Any, position: Any, scene: Any) -> Any:
    return _flow(time, (position, Vector.zeros_like(position)), scene)[1]


def _terms(system: BoundSystem, state: State, solver: Any) -> Any:
    """The right-hand side in the form that the solver wants."""
    import diffrax

    structure, name = solver.term_structure, type(solver).__name__
    if isinstance(structure, tuple):
        if system.motion is not None or any(reads_velocity(force, state) for force in system.forces):
            raise ValueError(
                f"{name} splits position from velocity, so it cannot take forces that depend on velocity (drag, dashpots), nor moved "
                f"nodes. Use another solver, or rollout with SymplecticEuler() or VelocityVerlet()."
            )
        return diffrax.ODETerm(_drift), diffrax.ODETerm(_kick)
    if get_origin(structure) is not None:
        # Implicit-explicit solvers among them: with all forces in its implicit part, diffrax 0.7.2's KenCarp4 stalls at tolerance 1e-6.
        raise TypeError(
            f"{name} wants a right-hand side split in parts (stiff and not, or drift and noise); the forces of a system are one. "
            f"Use a solver of one term: diffrax.Tsit5(), or diffrax.Kvaerno5() where the springs are stiff."
        )
    return diffrax.ODETerm(_flow)


class _OfState(eqx.Module):
    """A function for SaveAt that sees a `State` where diffrax gives (position, velocity)."""

    function: Callable[[Array, Any, Any], Any]

    def __call__(self, time: Array, y: Y, scene: _Scene) -> Any:
        return self.function(time, _as_state(time, y, scene), scene.system)


def _with_end(saveat: Any, end: Any) -> Any:
    """The user's SaveAt on states, and beside it the last state."""
    import diffrax

    def is_sub(leaf: Any) -> bool:
        return isinstance(leaf, diffrax.SubSaveAt)

    subs = jax.tree.map(lambda sub: eqx.tree_at(lambda s: s.fn, sub, _OfState(sub.fn)), saveat.subs, is_leaf=is_sub)
    return eqx.tree_at(lambda s: s.subs, saveat, (subs, end), is_leaf=lambda leaf: leaf is None)


def _verdict(result: Any, n_steps: Array) -> Status:
    """What diffrax says, as a status."""
    import diffrax

    codes = diffrax.RESULTS
    too_long = (result == codes.max_steps_reached) | (result == codes.max_steps_rejected)
    gave_up = (result != codes.successful) & (result != codes.event_occurred) & ~too_long
    return Status.when(Flag.MAX_STEPS, too_long, step=n_steps).then(Status.when(Flag.SOLVER, gave_up, step=n_steps))


def _check_parts(system: System) -> None:
    """ValueError naming what acts after steps, or remembers. A cache changes no result, and commands are
    taken at every moment; anything else would be left out.
    """
    lasting = [part for part in system.parts if not part.is_cache and not part.drives]
    rules = [type(part).__name__ for part in lasting if acts(part) or remembers(part)]
    if rules:
        raise ValueError(
            f"{', '.join(rules)}: this acts after steps of fixed length, which an adaptive solver does not take. Use rollout, or leave it "
            "out of the system (an event= can end a run at a contact)."
        )


def _check_options(solver: Any, saveat: Any, controller: Any, adjoint: Any, meter: Any, max_steps: Any, event: Any) -> None:
    """TypeError where an option is of another kind, such as a class that was not called; ValueError where two do not fit together."""
    import diffrax

    kinds = {
        "solver": (solver, diffrax.AbstractSolver, "diffrax.Tsit5()"),
        "saveat": (saveat, diffrax.SaveAt, "diffrax.SaveAt(ts=...)"),
        "stepsize_controller": (controller, diffrax.AbstractStepSizeController, "diffrax.PIDController(rtol=1e-6, atol=1e-6)"),
        "adjoint": (adjoint, diffrax.AbstractAdjoint, "diffrax.DirectAdjoint()"),
        "progress_meter": (meter, diffrax.AbstractProgressMeter, "diffrax.TqdmProgressMeter()"),
        "event": (event, diffrax.Event, "diffrax.Event(lambda time, state, system: state.position.y[0], optimistix.Newton(1e-8, 1e-8))"),
    }
    for name, (value, kind, example) in kinds.items():
        if value is not None and not isinstance(value, kind):
            what = f"the class {value.__name__}, not called" if isinstance(value, type) else f"a {type(value).__name__}"
            raise TypeError(f"{name} is {what}; expected a diffrax object such as {example}, or None.")
    if max_steps is not None and (isinstance(max_steps, bool) or not isinstance(max_steps, (int, np.integer)) or max_steps < 1):
        raise ValueError(f"max_steps = {max_steps!r}; expected a whole number of 1 or more, or None for no limit.")
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and saveat is not None:
        raise ValueError("BacksolveAdjoint knows the last state only: leave out saveat, or use another adjoint.")
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and event is not None:
        raise ValueError("BacksolveAdjoint cannot go back over an event. Leave the adjoint out, or use DirectAdjoint or ForwardMode.")


def _check_times(state: State, t1: Any, dt0: Any, *, may_be_infinite: bool) -> None:
    for name, value in (("t1", t1), ("dt0", dt0)):
        if value is None:
            continue
        has_shape(name, given(name, value), {"one number": ()})
        is_endless = name == "t1" and may_be_infinite and is_concrete(value) and np.all(np.isinf(value))
        if is_concrete(value) and not is_endless:
            finite(name, value)
    if dt0 is None or not all(is_concrete(value) for value in (state.time, t1, dt0)):
        return
    if dt0 == 0 or (float(t1) - float(state.time)) * float(dt0) < 0:
        raise ValueError(f"dt0 = {dt0} does not lead from state.time = {float(state.time)} to t1 = {t1}. Change the sign of dt0.")
