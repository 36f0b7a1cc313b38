"""An implicit step with obstacles: what rests on them is held inside the solve, and let go where it pulls or slides.

    1. who rests where the step begins is held            `contact/resting.py`
    2. the stage is solved; R = M (y - v0) / h - f is the force that holds
    3. whom R would have to pull, or to hold beyond friction, is let go; back to 2 while there are any, SWEEPS times at most
    4. the obstacles' rule sees the acceleration of the step without R / M, and stops what R presses, as in any step: friction, impulses
       and books are its own

What the net makes of the hold is in the solve: a column of resting nodes does not sag.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name

from ..linalg.base import SolveInfo
from ..linalg.implicit import SOLUTION
from ..numerics import stopped
from ..status import Flag, Status
from ..vector import Vector
from .stage import Stage

SWEEPS = 8  # each lets go all who pull; few steps need more than two


class Solved(eqx.Module):
    """A solved stage.

    Attributes:
        stage: with what was held.
        y: its velocity, with its derivative.
        info: how the solve ended.
        memory: what the solver carries on.
        push: the force of the obstacles [N]; None where there are none.
    """

    stage: Stage
    y: Vector
    info: SolveInfo
    memory: Any
    push: Vector | None


def solved(problem: Any, stage: Stage, resting: Any, memory: Any) -> Solved:
    """The stage's solution, nodes held that rest.

    Args:
        problem: how it is solved: a `LinearStage` or a `NewtonStage`.
        stage: nobody held.
        resting: who rests on what (`contact.resting.Resting`); None where there are no obstacles.
        memory: what the solver carries.
    """
    if resting is None:
        return Solved(stage, *problem.solve(stage, memory), None)
    still, lying = stopped((stage, resting))
    given = problem.given(still)
    # Less than this is the error of a solve.
    least = float(jnp.finfo(stage.h.dtype).eps) ** 0.5 * problem.scale(still, given)

    def sweep(carry: Any) -> Any:
        held, let_go, *_, memory, count = carry
        held = held.without(let_go)
        now = still.resting(*lying.taken(held))
        y, info, memory = problem.find(now, given, memory)
        return held, lying.let_go(held, problem.unbalanced(now, given, y), least), y, info, memory, count + 1

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
    push = resting.push(held, glued, problem.unbalanced(stage, problem.given(stage), y))
    left = jnp.any(jnp.stack(glued.lies), axis=0)
    node = jnp.argmax(jnp.ravel(left)).astype(jnp.int32)
    status = info.status.then(Status.when(Flag.IMPACTS, jnp.any(left), node=node, count=jnp.sum(left)))
    return Solved(stage, y, SolveInfo(info.residual, info.iterations, status), memory, push)


__all__ = ["Solved", "solved"]
