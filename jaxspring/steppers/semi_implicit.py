"""An explicit step with implicit damping.

    (M + dt G) dv = dt f(x, v)        v' = v + dv        x' = x + dt v'

Everything but damping is taken at the old state, as symplectic Euler does. G = -df/dv of the forces that name `damping_blocks` (drag,
dashpots, Rayleigh damping) counts at the new velocity: the force is f(x, v) - G dv. For one motion of frequency w, with c = G / m,

    l^2 (1 + c dt) - l (2 + c dt - w^2 dt^2) + 1 = 0        |l| <= 1 where w^2 dt^2 <= 4 + 2 c dt

so that the stable step is at least that of the undamped springs, 2 / w, however strong the damping.

Source: slide "Implicit Solution" for the velocity at the new time; limit from the characteristic polynomial.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.base import Force
from ..linalg.base import LinearSolver, SolveInfo
from ..linalg.cg import JaxCG
from ..linalg.implicit import ImplicitProblem, implicitly
from ..linalg.operators import Blocks, SpringMatrix, isotropic
from ..numerics import stopped
from ..state import State
from ..status import Status
from ..vector import Vector
from .base import Stepper
from .explicit import SymplecticEuler
from .implicit import Memory, _breakdown
from .stage import Stage


class SemiImplicit(Stepper):
    """Symplectic Euler with the damping at the new velocity: order 1, stable for damping of any size. dt must not be negative.

    Drag alone costs a division per node. Damping that couples nodes or coordinates (`Dashpots`, `Rayleigh`) costs a linear solve per
    step, reported as those of the implicit steppers; the damping of a force that does not name its `damping_blocks` is taken at the
    old velocity.

    Attributes:
        solver: for M + dt G where that is no diagonal; `JaxCG()` unless said.
    """

    solver: LinearSolver

    def __init__(self, solver: LinearSolver | None = None):
        self.solver = JaxCG() if solver is None else solver

    def init(self, system: BoundSystem, state: State) -> Memory | None:
        """What the solver carries; None where nothing is solved."""
        kick = _Kick(system, state, jnp.ones((), state.dtype))
        if kick.is_diagonal:
            return None
        nothing = SolveInfo(jnp.zeros((), state.dtype), jnp.zeros((), jnp.int32), Status.ok())
        return Memory(self.solver.init(kick.matrix()), nothing, None, None)

    def step(self, system: BoundSystem, state: State, dt: Array, memory: Memory | None) -> tuple[State, Memory | None]:
        """v + dv, then x + dt of the new v."""
        kick = _Kick(system, state, dt)
        if memory is None:
            dv = kick.impulse().map(lambda impulse, a: impulse / a, kick.matrix().diagonal())
            return _moved(state, dt, system.hold(dv)), None
        dv, info, carried = _Solve(self.solver).solve(kick, memory.solver)
        new = _moved(state, dt, dv)
        given = Stage(system, state.position, state.velocity, dt, state.time, state, kick.known(), None, True)
        status = _breakdown(given, new).then(info.status)
        return new, Memory(carried, SolveInfo(info.residual, info.iterations, status), None, None)

    @property
    def runs_backward(self) -> bool:
        """Whether dt may be negative: damping backward in time grows without bound."""
        return False

    def report(self, memory: Memory | None) -> SolveInfo | None:
        """How the last solve ended; None where nothing is solved."""
        return None if memory is None else memory.info

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """That of symplectic Euler, with the damping that is taken at the old velocity."""
        return SymplecticEuler().limit(squared_frequency, damping, damping_floor)

    def lags_damping(self, effect: Force, state: State) -> bool:
        """Of forces that do not name their damping only."""
        return effect.damping_blocks(state) is None


class _Kick(eqx.Module):
    """What is given of a step: the equations (M + dt G) dv = dt f."""

    system: BoundSystem
    state: State
    dt: Array

    @property
    def is_diagonal(self) -> bool:
        """Whether no damping couples nodes or coordinates."""
        damping = self.system.damping_blocks(self.state)
        return not (damping.dyads or damping.springs or damping.cells)

    def matrix(self) -> SpringMatrix:
        """M + dt G."""
        inertia = Blocks((isotropic(self.system.mass.astype(self.state.dtype), self.state.position),))
        return self.system.matrix(inertia + self.system.damping_blocks(self.state).scaled(self.dt), self.state)

    def impulse(self) -> Vector:
        """dt f at the old state [N s]."""
        return self.dt * self.system.force(self.state)

    def known(self) -> Vector:
        """Change of velocity of held coordinates (none) and of moved ones, which their schedule gives [m/s]."""
        v = self.state.velocity
        if self.system.motion is None:
            return Vector.zeros_like(v)
        _, scheduled = self.system.motion.at(self.state.time + self.dt)
        moved = self.system.moved_nodes
        return v.map(lambda old, new: jnp.where(moved, new.astype(old.dtype) - old, jnp.zeros_like(old)), scheduled)


class _Solve(ImplicitProblem):
    """The change of velocity by a linear solve."""

    solver: LinearSolver

    def residual(self, kick: _Kick, dv: Vector) -> Vector:
        """(M + dt G) dv - dt f where free, dv less what is known elsewhere."""
        matrix, known = kick.matrix(), kick.known()
        return matrix.pick(matrix.blocks.product(matrix.pick(dv, known)) - kick.impulse(), dv - known)

    def solve_linearised(self, kick: _Kick, dv: Vector, right_side: Vector) -> Vector:
        """(M + dt G)^-1 right_side."""
        matrix = kick.matrix()
        return self.solver.solve_in_step(matrix, right_side, None, self.solver.init(matrix))[0]

    def solve(self, kick: _Kick, memory: object) -> tuple[Vector, SolveInfo, object]:
        """The change of velocity with its derivative, how the solve ended, and what the solver carries on."""
        still = stopped(kick)
        # Computed once: without the barrier XLA computes every block anew in each loop and preconditioner that reads it.
        matrix, known = lax.optimization_barrier(still.matrix()), still.known()
        right_side = still.impulse()
        if still.system.motion is not None:
            right_side = right_side - matrix.blocks.product(matrix.pick(Vector.zeros_like(known), known))
        dv, info, memory = self.solver.find_in_step(matrix, matrix.pick(right_side, known), None, memory)
        return implicitly(self, kick, dv), info, memory


def _moved(state: State, dt: Array, dv: Vector) -> State:
    v = state.velocity + dv
    return state.moved(state.position + dt * v, v)


__all__ = ["SemiImplicit"]
