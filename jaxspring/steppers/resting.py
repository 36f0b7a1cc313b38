"""An implicit step with obstacles: what rests on them is held inside the solve, and let go where it pulls or slides.

    1. who rests where the step begins is held            `contact/resting.py`
    2. the stage is solved; R = M (y - v0) / h - f is the force that holds
    3. whom R would have to pull, or to hold beyond friction, is let go; back to 2 while there are any, SWEEPS times at most
    4. the obstacles' rule sees the acceleration of the step without R / M, and stops what R presses, as in any step: friction, impulses
       and books are its own

What the net makes of the hold is in the solve: a column of resting nodes does not sag.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

from ..linalg.base import SolveInfo
from ..linalg.implicit import SOLUTION
from ..numerics import stopped
from ..state import State
from ..status import Flag, Status
from ..vector import Vector
from .stage import Stage

Finish = Callable[[State, Array, Stage, Vector], State]
SWEEPS = 8  # each lets go all who pull; few steps need more than two


class Solved(eqx.Module):
    """A solved stage.

    Attributes:
        stage: with what was held.
        state: the new one, with its derivative.
        info: how the solve ended.
        memory: what the solver carries on.
        push: the force of the obstacles [N]; None where there are none.
    """

    stage: Stage
    state: State
    info: SolveInfo
    memory: Any
    push: Vector | None


def solved(problem: Any, stage: Stage, resting: Any, memory: Any, finish: Finish, state: State, dt: Array) -> Solved:
    """The stage's solution, nodes held that rest.

    Args:
        problem: how it is solved: a `LinearStage` or a `NewtonStage`.
        stage: nobody held.
        resting: who rests on what (`contact.resting.Resting`); None where there are no obstacles.
        memory: what the solver carries.
        finish: (state, dt, stage, y) -> the new state.
        state: where the step begins.
        dt: [s].
    """
    if resting is None:
        y, info, memory = problem.solve(stage, memory)
        return Solved(stage, finish(state, dt, stage, y), info, memory, None)
    still, lying, *begun = stopped((stage, resting, state, dt))
    given = problem.given(still)
    # Less than this is the error of a solve.
    least = float(jnp.finfo(stage.h.dtype).eps) ** 0.5 * problem.scale(still, given)

    def force(stage: Stage, resting: Any, held: Any, given: Any, y: Vector, state: State, dt: Array) -> Vector:
        """What holds the nodes [N]: what the equations leave over, and what changes the velocity that they give to that of the obstacle."""
        over = problem.unbalanced(stage, given, y)
        if resting.ends is None:
            return over
        v = finish(state, dt, stage, y).velocity
        return over + (stage.system.mass / dt) * (resting.ended(held, v) - v)

    def sweep(carry: Any) -> Any:
        held, let_go, *_, memory, count = carry
        held = held.without(let_go)
        now = still.resting(*lying.taken(held))
        y, info, memory = problem.find(now, given, memory)
        return held, lying.let_go(held, force(now, lying, held, given, y, *begun), least), y, info, memory, count + 1

    zero = jnp.zeros((), jnp.int32)
    nothing = SolveInfo(jnp.zeros_like(stage.h), zero, Status.ok())
    begin = (lying.held, lying.held.nobody(), Vector.zeros_like(stage.origin), nothing, memory, zero)
    # One loop also for the first sweep, so that the solve is compiled once.
    end = lax.while_loop(lambda carry: (carry[-1] == 0) | (carry[1].is_any() & (carry[-1] < SWEEPS)), sweep, begin)
    held, glued, y, info, memory, _ = end
    # Kept like the solution itself: reverse mode need not sweep again.
    held, glued = jax.tree.map(lambda a: checkpoint_name(a, SOLUTION), (held, glued))
    stage = stage.resting(*resting.taken(held))
    y = problem.derived(stage, y, info)
    push = resting.push(held, glued, force(stage, resting, held, problem.given(stage), y, state, dt))
    new = finish(state, dt, stage, y)
    new = new.moved(new.position, resting.ended(held, new.velocity))
    left = jnp.any(jnp.stack(glued.lies), axis=0)
    node = jnp.argmax(jnp.ravel(left)).astype(jnp.int32)
    status = info.status.then(Status.when(Flag.IMPACTS, jnp.any(left), node=node, count=jnp.sum(left)))
    return Solved(stage, new, SolveInfo(info.residual, info.iterations, status), memory, push)


__all__ = ["Solved", "solved"]
