"""One implicit stage: the velocity y that solves the equations of motion at the state which it reaches.

    M (y - v0) / h = f(x0 + h y, y, t)                                              implicit
    M (y - v0) / h = f_p - K (x0 + h y - x_p) - G (y - v_p)         linearised at a predictor p

Backward Euler, the implicit midpoint rule and BDF2 are this stage with other x0, v0, h and t. The linearised form is one solve with

    A = M/h + G + h K

Held coordinates are known beforehand: they are no part of the solve, and do not move by a rounding error. So is the velocity along the
directions that obstacles take from nodes which rest on them (`resting.py`).

Source: slide "Implicit Solution", with the tangent stiffness and the force in place of K x.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.linearisation import Linearisation
from ..linalg.base import LinearSolver, SolveInfo
from ..linalg.implicit import ImplicitProblem, implicitly
from ..linalg.iterative import norm
from ..linalg.operators import Blocks, SpringMatrix, isotropic
from ..numerics import stopped
from ..state import State
from ..vector import Vector


class Stage(eqx.Module):
    """What is given of a stage.

    Attributes:
        system: masses, forces and constraints.
        origin: x0 [m].
        velocity: v0 [m/s].
        h: [s].
        time: t [s], when the forces are taken.
        predictor: the state at which forces are linearised.
        known: velocity of held and moved coordinates [m/s] that leads to their place at t, zero elsewhere.
        scheduled: velocity of moved coordinates at t [m/s], zero elsewhere, which damping feels; None where nothing is moved.
        starts_there: whether x0 is the predictor's position (static).
        taken: directions along which nodes rest, of length one or zero, at right angles; the velocities along them are in `known`.
        fixed: nodes that rest and stick: all of their velocity is known; None where nothing can rest.
    """

    system: BoundSystem
    origin: Vector
    velocity: Vector
    h: Array
    time: Array
    predictor: State
    known: Vector
    scheduled: Vector | None
    starts_there: bool = eqx.field(static=True)
    taken: tuple[Vector, ...] = ()
    fixed: Array | None = None

    def resting(self, directions: tuple[Vector, ...], sticks: Array, carried: Vector) -> Stage:
        """The same where nodes rest: these directions are taken, some nodes stick, and what is taken is `carried` [m/s]."""
        return replace(self, taken=directions, fixed=sticks, known=self.known + carried)

    def full(self, y: Vector) -> Vector:
        """`y` where free, the known velocity where not."""
        return self._of(Blocks()).pick(y, self.known)

    def reached(self, y: Vector) -> State:
        """The state that the velocity `y` leads to."""
        v = self.full(y)
        x = self.origin + self.h * v
        if self.scheduled is not None:
            v = self.system.matrix(Blocks(), self.predictor).pick(v, self.scheduled)
        return self.predictor.moved(x, v, self.time)

    def inertia(self, y: Vector) -> Vector:
        """M (y - v0) / h [N]."""
        return (self.system.mass.astype(y.dtype) / self.h) * (self.full(y) - self.velocity)

    def matrix(self, state: State, linearisation: Linearisation) -> SpringMatrix:
        """M/h + G + h K at a state."""
        return self.matrix_of(self.blocks(state, linearisation))

    def matrix_of(self, blocks: Blocks) -> SpringMatrix:
        """These blocks as a matrix, identity where held."""
        # Computed once: without the barrier XLA computes every block anew in each loop and preconditioner that reads it.
        return lax.optimization_barrier(self._of(blocks))

    def blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """M/h + G + h K at a state, no coordinate held."""
        inertia = Blocks((isotropic(self.system.mass.astype(state.dtype) / self.h, state.position),))
        stiffness = self.system.stiffness_blocks(state, linearisation).scaled(self.h)
        return inertia + self.system.damping_blocks(state) + stiffness

    def rounding(self) -> Array:
        """What rounding of the positions makes of the forces [N]: a net at rest has no other force to compare with."""
        at = self.predictor
        largest = at.position.largest()
        bounds = [bound for bound in (force.stiffness_bound(at) for force in self.system.forces) if bound is not None]
        stiffness = self.system.hold(at.position.map(lambda a: sum(bounds, start=jnp.zeros_like(a))))
        return 8 * float(jnp.finfo(largest.dtype).eps) * largest * norm(stiffness)

    def on_free(self, r: Vector, y: Vector) -> Vector:
        """Equations where free, y = 0 where known."""
        return self._of(Blocks()).pick(r, y)

    def _of(self, blocks: Blocks) -> SpringMatrix:
        matrix = self.system.matrix(blocks, self.predictor)
        if self.fixed is None:
            return matrix
        free = tuple(~self.fixed if m is None else m & ~self.fixed for m in matrix.free)
        return replace(matrix, free=free).taking(self.taken)


class LinearStage(ImplicitProblem):
    """The linearised stage: one linear solve.

    Attributes:
        solver: for A.
        linearisation: what stands for K.
    """

    solver: LinearSolver
    linearisation: Linearisation

    def residual(self, stage: Stage, y: Vector) -> Vector:
        """A y - b where free [N]."""
        return stage.on_free(self.unbalanced(stage, self.given(stage), y), y)

    def given(self, stage: Stage) -> tuple[Blocks, Vector]:
        """A and b, whoever is held."""
        return stage.blocks(stage.predictor, self.linearisation), self._right_side(stage)

    def unbalanced(self, stage: Stage, given: tuple[Blocks, Vector], y: Vector) -> Vector:
        """A y - b everywhere [N]: where nodes are held, what holds them."""
        blocks, right_side = given
        return blocks.product(stage.full(y)) - right_side

    def scale(self, stage: Stage, given: tuple[Blocks, Vector]) -> Array:
        """Size of the forces [N]."""
        return norm(given[1])

    def solve_linearised(self, stage: Stage, y: Vector, right_side: Vector) -> Vector:
        """A^-1 right_side."""
        matrix = stage.matrix(stage.predictor, self.linearisation)
        return self.solver.solve_in_step(matrix, right_side, None, self.solver.init(matrix))[0]

    def solve(self, stage: Stage, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """The stage's velocity with its derivative, how the solve ended, and what the solver carries on."""
        still = stopped(stage)
        y, info, memory = self.find(still, self.given(still), memory)
        return self.derived(stage, y, info), info, memory

    def find(self, stage: Stage, given: tuple[Blocks, Vector], memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """The same without a derivative."""
        blocks, right_side = given
        matrix = stage.matrix_of(blocks)
        if stage.system.motion is not None or stage.fixed is not None:
            right_side = right_side - matrix.blocks.product(stage.known)
        zero = Vector.zeros_like(right_side)
        return self.solver.find_in_step(matrix, stage.on_free(right_side, zero), stage.predictor.velocity, memory)

    def derived(self, stage: Stage, y: Vector, info: SolveInfo) -> Vector:
        """A solution that `find` gave, with its derivative."""
        return implicitly(self, stage, y)

    def _right_side(self, stage: Stage) -> Vector:
        """b = M v0 / h + f_p + G v_p - K (x0 - x_p) [N]."""
        at = stage.predictor
        b = (stage.system.mass.astype(at.dtype) / stage.h) * stage.velocity + stage.system.force(at)
        damping = stage.system.damping_blocks(at)
        b = b + damping.product(at.velocity)
        if stage.scheduled is not None:
            # A takes moved nodes at the velocity that leads to their place.
            b = b - damping.product(stage.scheduled - stage.known)
        if stage.starts_there:
            return b
        return b - stage.system.stiffness_blocks(at, self.linearisation).product(stage.origin - at.position)


def known_velocities(system: BoundSystem, origin: Vector, h: Array, time: Array) -> tuple[Vector, Vector | None]:
    """Of the held (zero) and of the moved coordinates, the velocity that leads to their place at `time` and that at `time` [m/s]."""
    zero = Vector.zeros_like(origin)
    if system.motion is None:
        return zero, None
    place, velocity = system.motion.at(time)
    moved = system.moved_nodes
    known = zero.map(lambda z, to, x: jnp.where(moved, ((to.astype(x.dtype) - x) / h), z), place, origin)
    return known, zero.map(lambda z, v: jnp.where(moved, v.astype(z.dtype), z), velocity)


__all__ = ["LinearStage", "Stage", "known_velocities"]
