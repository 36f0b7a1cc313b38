"""The bridge to diffrax: adaptive steps, high orders, implicit solvers, and an independent reference for `rollout`.

    y = (position, velocity)        dy/dt = (velocity, acceleration)

Held nodes have derivative zero and stay exactly where they are. Nodes on a schedule are put there at every evaluation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ._checks import finite, is_concrete
from .state import State
from .status import Flag, Status
from .system import System
from .vector import Vector
from .watch import Carry, begin, look

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
        effects: names of the system's forces, for messages (static).
    """

    state: State
    saved: Any
    times: Any
    status: Status
    info: OdeInfo
    effects: tuple[str, ...] = eqx.field(static=True)

    def at(self, time: Any) -> State:
        """The state at any time [s] between the start and the end; needs `saveat=diffrax.SaveAt(dense=True)`."""
        if self.info.interpolation is None:
            raise ValueError("this result keeps no interpolation. Pass saveat=diffrax.SaveAt(dense=True) to diffeqsolve.")
        time = jnp.asarray(time, self.state.dtype)
        position, velocity = self.info.interpolation.evaluate(time)
        return self.state.moved(position, velocity, time)


def diffeqsolve(
    system: System,
    state: State,
    t1: Any,
    solver: diffrax.AbstractSolver | None = None,
    dt0: Any = None,
    saveat: diffrax.SaveAt | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    max_steps: int | None = 4096,
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

    Returns:
        An `OdeResult`. Trouble is in its status, never an exception: NONFINITE, MAX_STEPS, SOLVER; call `raise_for_status(result)`.

    Raises:
        ValueError: times that are not finite or of the wrong sign; options that do not fit together; a system with rules, which
            need fixed steps.
        TypeError: a solver that wants the right-hand side split: implicit-explicit or stochastic.

    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=js.Springs(net, 1.0, 1.0))
    >>> result = diffeqsolve(system, js.State.from_points(net, net.grid()), t1=1.0)
    >>> print(result.state.time)
    1.0
    """
    import diffrax

    solver = diffrax.Tsit5() if solver is None else solver
    _check_times(state, t1, dt0)
    if system.rules:
        names = ", ".join(type(rule).__name__ for rule in system.rules)
        raise ValueError(f"{names} acts after steps of fixed length, which an adaptive solver does not take. Use rollout.")
    t1 = jnp.asarray(t1, state.dtype)
    dt0 = None if dt0 is None else jnp.asarray(dt0, state.dtype)
    if stepsize_controller is None:
        tolerance = float(jnp.finfo(state.dtype).eps) ** 0.5
        is_constant = dt0 is not None
        stepsize_controller = diffrax.ConstantStepSize() if is_constant else diffrax.PIDController(rtol=tolerance, atol=tolerance)
    adjoint = diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint
    meter = diffrax.NoProgressMeter() if progress_meter is None else progress_meter
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and saveat is not None:
        raise ValueError("BacksolveAdjoint knows the last state only: leave out saveat, or use another adjoint.")
    return _solve(system, state, t1, solver, dt0, saveat, stepsize_controller, adjoint, meter, max_steps)


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
) -> OdeResult:
    import diffrax

    ready = system.prepare(state.dtype)
    # A list of neighbours is kept up to date by rollout alone: without one each evaluation makes its own.
    start = ready.constrain(dataclasses.replace(state, neighbours=None))
    before = begin(system, ready, Carry(start, None, jnp.zeros((), jnp.int32)), jnp.zeros((), state.dtype), None)
    end = diffrax.SubSaveAt(t1=True)
    solution = diffrax.diffeqsolve(
        _terms(ready, start, solver),
        solver,
        start.time,
        t1,
        dt0,
        (start.position, start.velocity),
        args=_Scene(ready, dataclasses.replace(start, position=None, velocity=None)),
        saveat=diffrax.SaveAt(subs=end) if saveat is None else _with_end(saveat, end),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=meter,
    )
    found: Any = solution
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
        effects=system.effects,
    )


class _Scene(eqx.Module):
    """The system, and a state that holds all that does not move."""

    system: System
    like: State


def _as_state(time: Array, y: Y, scene: _Scene) -> State:
    return scene.system.constrain(scene.like.moved(*y, time.astype(y[0].dtype)))


def _flow(time: Any, y: Any, scene: Any) -> Any:
    """Dy/dt. Module-level, so that diffrax compiles it once."""
    state = _as_state(time, y, scene)
    return state.velocity, scene.system.acceleration(state)


def _drift(time: Any, velocity: Any, scene: Any) -> Any:
    return scene.system.hold(velocity)


def _kick(time: Any, position: Any, scene: Any) -> Any:
    return _flow(time, (position, Vector.zeros_like(position)), scene)[1]


def _terms(system: System, state: State, solver: Any) -> Any:
    """The right-hand side in the form that the solver wants."""
    import diffrax

    structure, name = solver.term_structure, type(solver).__name__
    if isinstance(structure, tuple):
        if system.motion is not None or _reads_velocity(system, state):
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


def _reads_velocity(system: System, state: State) -> bool:
    """Whether the program of the acceleration reads the velocity at all."""

    def acceleration(velocity: Vector) -> Vector:
        return system.acceleration(eqx.tree_at(lambda s: s.velocity, state, velocity))

    program = jax.make_jaxpr(acceleration)(state.velocity).jaxpr
    read = {id(v) for equation in program.eqns for v in equation.invars} | {id(v) for v in program.outvars}
    return any(id(v) in read for v in program.invars)


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
    gave_up = (result != codes.successful) & ~too_long
    return Status.when(Flag.MAX_STEPS, too_long, step=n_steps).then(Status.when(Flag.SOLVER, gave_up, step=n_steps))


def _check_times(state: State, t1: Any, dt0: Any) -> None:
    for name, value in (("t1", t1), ("dt0", dt0)):
        if value is not None and is_concrete(value):
            finite(name, value)
    if dt0 is None or not all(is_concrete(value) for value in (state.time, t1, dt0)):
        return
    if dt0 == 0 or (float(t1) - float(state.time)) * float(dt0) < 0:
        raise ValueError(f"dt0 = {dt0} does not lead from state.time = {float(state.time)} to t1 = {t1}. Change the sign of dt0.")
