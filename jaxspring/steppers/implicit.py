"""Implicit steppers: stable at steps far above the explicit limit.

    BackwardEuler        v' at x' = x + dt v'                                                     order 1, damps every motion
    ImplicitMidpoint     v* at x* = x + dt/2 v*;   x' = x + dt v*,  v' = 2 v* - v                 order 2, keeps energy of linear systems
    BDF2                 v' at x' = (4 x - x_1 + 2 dt v') / 3, from (4 v - v_1) / 3               order 2, damps stiff motions

where v at x means M (v - v0) / h = f(x, v). Each is one stage (`stage.py`): a linear solve with M/h + G + h K, or Newton's method. What
rests on an obstacle is held inside the solve (`resting.py`).

What enters: springs (K, the tangent clamped positive semi-definite), data springs (K), drag, dashpots and Rayleigh damping (G). What is
taken at the old time: the change of a stiffness that follows an image, the slope of an image under `ImageAttraction`, the turning of a
dashpot, and any force that names neither; Newton's step takes all of them at the new time. Loads are taken at the stage's time.

Source: slide "Implicit Solution" for backward Euler; Hairer and Wanner (1996) for the others.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.linearisation import Linearisation, Tangent
from ..linalg.base import LinearSolver, SolveInfo
from ..linalg.cg import JaxCG
from ..linalg.exact import ExactSolver
from ..linalg.implicit import grown
from ..state import State
from ..status import NOWHERE, Flag, Status
from ..vector import Vector
from .base import Stepper
from .energy_watch import EnergyWatch
from .newton import Newton, NewtonStage
from .resting import solved
from .stage import LinearStage, Stage, known_velocities

# Stands for a dt of zero [s].
_SHORT = 1e-10


class Memory(eqx.Module):
    """What an implicit stepper carries.

    Attributes:
        solver: what the linear solver carries, such as a factor.
        info: how the last solve ended.
        history: earlier states, where the method needs them.
        energy: what the energy did so far, where nothing can feed energy in; else None.
        pushed: change of velocity by obstacles that held nodes in the last step [m/s]; None where there are none.
    """

    solver: Any
    info: SolveInfo
    history: Any
    energy: EnergyWatch | None
    pushed: Vector | None = None


class ImplicitStepper(Stepper):
    """A stepper of implicit stages. Abstract.

    Attributes:
        solver: for the linear systems.
        newton: None for one linear solve per step; a `Newton` for a converged step.
        stiffness: what stands for K in the linear solve; `Secant()` is the slides' form, stable only below omega dt = 2.
        adjoint: solver of the derivatives of Newton's steps, whose matrix is the exact one.
    """

    solver: LinearSolver
    newton: Newton | None
    stiffness: Linearisation
    adjoint: ExactSolver

    def __init__(
        self,
        solver: LinearSolver | None = None,
        newton: bool | Newton | None = None,
        stiffness: Linearisation | None = None,
        adjoint: ExactSolver | None = None,
    ):
        """Check that the options fit together.

        Args:
            solver: for the linear systems; `JaxCG()` unless said.
            newton: True or a `Newton` for converged steps, False for one linear solve per step; None is the method's own choice.
            stiffness: what stands for K in the single linear solve; `Tangent()` unless said.
            adjoint: solver of the derivatives of Newton's steps; `ExactSolver()` unless said.

        Raises:
            ValueError: `stiffness` with Newton's method, or `adjoint` without.
        """
        self.solver = JaxCG() if solver is None else solver
        wanted = self.is_newton_by_default() if newton is None else newton
        self.newton = Newton() if wanted is True else (wanted or None)
        self.stiffness = Tangent() if stiffness is None else stiffness
        self.adjoint = ExactSolver() if adjoint is None else adjoint
        if self.newton is not None and stiffness is not None:
            raise ValueError(
                "stiffness says what a single linear solve uses; Newton's directions are always the clamped tangent. Pass one."
            )
        if self.newton is None and adjoint is not None:
            raise ValueError("adjoint serves Newton's steps; the derivative of a linear solve uses the solver itself. Pass newton=True.")

    @classmethod
    @abc.abstractmethod
    def is_newton_by_default(cls) -> bool:
        """Whether the order of the method needs converged steps."""

    @abc.abstractmethod
    def stage(self, system: BoundSystem, state: State, dt: Array, history: Any) -> Stage:
        """The equations of this step."""

    @abc.abstractmethod
    def finish(self, state: State, dt: Array, stage: Stage, y: Vector) -> State:
        """The new state from the stage's velocity."""

    def ends(self, stage: Stage, state: State, dt: Array) -> tuple[Vector, Array]:
        """Origin [m] and time [s]: the step ends at origin + time y."""
        return stage.origin, stage.h

    def remember(self, state: State) -> Any:
        """What of the state before a step the next one needs."""
        return None

    def first_history(self, state: State) -> Any:
        """What stands for the states before the first one."""
        return None

    def energy_slack(self, dtype: DTypeLike) -> float:
        """Rise of the energy above its lowest that is not yet reported: a share of the scale of `EnergyWatch`.

        A single linear step stretches what turns, by the fourth order of the angle: a good run gains that in its first step.
        """
        return 2e-5 if dtype == jnp.float64 else 1e-3

    def init(self, system: BoundSystem, state: State) -> Memory:
        """An empty memory of the right shape."""
        dt = jnp.ones((), state.dtype)
        history = self.first_history(state)
        stage = self.stage(system, state, dt, history)
        resting, pushed = self._resting(stage, state, dt), None
        if resting is not None:
            stage, pushed = stage.resting(*resting.taken(resting.held)), Vector.zeros_like(state.velocity)
        carried = self.solver.init(stage.matrix(state, self.stiffness))
        nothing = SolveInfo(jnp.zeros((), state.dtype), jnp.zeros((), jnp.int32), Status.ok())
        return Memory(carried, nothing, history, EnergyWatch.of(system, state), pushed)

    @property
    def runs_backward(self) -> bool:
        """Whether dt may be negative: backward in time the matrix is not positive definite."""
        return False

    def step(self, system: BoundSystem, state: State, dt: Array, memory: Memory) -> tuple[State, Memory]:
        """One stage, and the state after it; with dt = 0, which no matrix survives, the state itself."""
        stands = dt == 0
        # In so short a step masses outweigh all else: what is computed in vain never fails.
        new, after = self._step(system, state, jnp.where(stands, jnp.asarray(_SHORT, dt.dtype), dt), memory)
        after = eqx.tree_at(lambda m: m.info.status, after, after.info.status.only_if(~stands))
        if after.pushed is not None:
            after = eqx.tree_at(lambda m: m.pushed, after, after.pushed.map(lambda a: jnp.where(stands, jnp.zeros_like(a), a)))
        dx, dv = grown(_rates, (system, state), dt, (state.position, state.velocity))
        old = state.moved(state.position + dx, state.velocity + dv, new.time)
        return jax.tree.map(lambda old, moved: jnp.where(stands, old, moved), old, new), after

    def _step(self, system: BoundSystem, state: State, dt: Array, memory: Memory) -> tuple[State, Memory]:
        stage = self.stage(system, state, dt, memory.history)
        if self.newton is None:
            problem: Any = LinearStage(self.solver, self.stiffness)
        else:
            problem = NewtonStage(self.adjoint, None, self.solver, self.newton)
        resting = self._resting(stage, state, dt)
        found = solved(problem, stage, resting, memory.solver, self.finish, state, dt)
        stage, new, info = found.stage, found.state, found.info
        status = _breakdown(stage, new).then(info.status)
        energy = memory.energy
        if energy is not None:
            # A rule changes the energy between steps: what it left is where this step began.
            energy = energy.shifted(system, state) if system.rules else energy
            energy = energy.after(stage, new, info.residual)
            status = status.then(Status.when(Flag.ENERGY_ROSE, energy.rose(self.energy_slack(state.dtype))))
        pushed = None if found.push is None else (dt / system.mass) * found.push
        return new, Memory(found.memory, SolveInfo(info.residual, info.iterations, status), self.remember(state), energy, pushed)

    def _resting(self, stage: Stage, state: State, dt: Array) -> Any:
        """What rests on obstacles where the step begins; None where there are none."""
        return stage.system.resting(state, *self.ends(stage, state, dt), state.time + dt)

    def report(self, memory: Memory) -> SolveInfo:
        """How the last solve ended."""
        return memory.info

    def pushed(self, memory: Memory) -> Vector | None:
        """Of the nodes that the last solve held."""
        return memory.pushed


class BackwardEuler(ImplicitStepper):
    """Backward Euler: one linear solve, or a converged step with `newton=True`."""

    __init__ = ImplicitStepper.__init__  # said again for type checkers, which would make one of the fields

    @classmethod
    def is_newton_by_default(cls) -> bool:
        """Whether the order needs converged steps: one linear solve keeps order 1."""
        return False

    def stage(self, system: BoundSystem, state: State, dt: Array, history: None) -> Stage:
        """The forces at the end of the step."""
        return _stage(system, state, state.position, state.velocity, dt, state.time + dt)

    def finish(self, state: State, dt: Array, stage: Stage, y: Vector) -> State:
        """The stage's state is the new state."""
        return stage.reached(y)


class ImplicitMidpoint(ImplicitStepper):
    """The implicit midpoint rule, converged unless `newton=False`: order 2, no damping of its own.

    It keeps the energy of linear systems. Motions above the step's resolution ring without dying out: `BDF2` damps them.
    """

    __init__ = ImplicitStepper.__init__  # said again for type checkers, which would make one of the fields

    @classmethod
    def is_newton_by_default(cls) -> bool:
        """Whether the order needs converged steps: the clamped tangent of one solve would lower it where springs are squeezed."""
        return True

    def stage(self, system: BoundSystem, state: State, dt: Array, history: None) -> Stage:
        """The forces in the middle of the step."""
        return _stage(system, state, state.position, state.velocity, 0.5 * dt, state.time + 0.5 * dt)

    def finish(self, state: State, dt: Array, stage: Stage, y: Vector) -> State:
        """x + dt v*, 2 v* - v."""
        middle = stage.full(y)
        return state.moved(state.position + dt * middle, stage.system.hold(2 * middle - state.velocity), state.time + dt)

    def ends(self, stage: Stage, state: State, dt: Array) -> tuple[Vector, Array]:
        """x and dt."""
        return state.position, dt

    def energy_slack(self, dtype: DTypeLike) -> float:
        """A fifth: the rule keeps a nearby energy, about which the true one swings."""
        return 0.2


class BDF2(ImplicitStepper):
    """The two-step backward differentiation formula, converged unless `newton=False`; its first step is backward Euler's."""

    __init__ = ImplicitStepper.__init__  # said again for type checkers, which would make one of the fields

    @classmethod
    def is_newton_by_default(cls) -> bool:
        """Whether the order needs converged steps: the clamped tangent of one solve would lower it where springs are squeezed."""
        return True

    def first_history(self, state: State) -> tuple[Array, Vector, Vector]:
        """What stands for the state before the first: none, so that the first step is backward Euler's."""
        return jnp.zeros((), bool), state.position, state.velocity

    def remember(self, state: State) -> tuple[Array, Vector, Vector]:
        """The state before this step."""
        return jnp.ones((), bool), state.position, state.velocity

    def after_rules(self, system: BoundSystem, before: State, moved: State, now: State, dt: Array, memory: Memory) -> Memory:
        """For nodes that rules have moved or kicked, the state dt ago from which this step's acceleration a would have led here:
        x' - dt v' + dt^2 a / 2 and v' - dt a.
        """
        has_last, x, v = memory.history
        change = now.velocity - moved.velocity, now.position - moved.position
        is_kicked = jnp.any(jnp.stack([a != 0 for part in change for a in part]), axis=0)
        gained = moved.velocity - before.velocity

        def pick(new: Vector, old: Vector) -> Vector:
            return new.map(lambda a, b: jnp.where(is_kicked, a, b), old)

        past = now.position - dt * now.velocity + (0.5 * dt) * gained
        return eqx.tree_at(lambda m: m.history, memory, (has_last, pick(past, x), pick(now.velocity - gained, v)))

    def stage(self, system: BoundSystem, state: State, dt: Array, history: tuple[Array, Vector, Vector]) -> Stage:
        """Differences of this state and the last one, in the form that leaves a node at rest exactly where it is."""
        has_last, x, v = history
        third = jnp.where(has_last, jnp.asarray(1 / 3, dt.dtype), jnp.zeros((), dt.dtype))
        origin = state.position + third * (state.position - x)
        velocity = state.velocity + third * (state.velocity - v)
        return _stage(system, state, origin, velocity, (1 - third) * dt, state.time + dt)

    def finish(self, state: State, dt: Array, stage: Stage, y: Vector) -> State:
        """The stage's state is the new state."""
        return stage.reached(y)

    def energy_slack(self, dtype: DTypeLike) -> float:
        """A tenth: what the method lets fall is a sum over two steps."""
        return 0.1


def _rates(scene: tuple[BoundSystem, State]) -> tuple[Vector, Vector]:
    """How fast positions and velocities change."""
    system, state = scene
    return state.velocity, system.acceleration(state)


def _breakdown(stage: Stage, after: State) -> Status:
    """NONFINITE, naming the node and the first effect whose force was not finite before the step."""
    finite = [jnp.isfinite(a) for v in (after.position, after.velocity) for a in v]
    bad = ~jnp.all(jnp.stack(finite), axis=0)
    effect = jnp.asarray(NOWHERE, jnp.int32)
    for i, force in reversed(list(enumerate(stage.system.forces))):
        fails = ~jnp.all(jnp.isfinite(jnp.stack(force.force(stage.predictor).components)))
        effect = jnp.where(fails, jnp.asarray(i, jnp.int32), effect)
    node = jnp.argmax(jnp.ravel(bad)).astype(jnp.int32)
    status = Status.when(Flag.NONFINITE, jnp.any(bad), node=node, count=jnp.sum(bad))
    return eqx.tree_at(lambda s: s.effect, status, jnp.where(jnp.any(bad), effect, status.effect))


def _stage(system: BoundSystem, state: State, origin: Vector, velocity: Vector, h: Array, time: Array) -> Stage:
    predictor = state.moved(state.position, state.velocity, time)
    return Stage(system, origin, velocity, h, time, predictor, *known_velocities(system, origin, h, time), origin is state.position)


__all__ = ["BDF2", "BackwardEuler", "ImplicitMidpoint", "ImplicitStepper"]
