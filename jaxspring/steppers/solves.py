"""The linear or nonlinear solves of a run of implicit steps, summed up."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..linalg.base import SolveInfo
from ..status import NOWHERE, Status


class Solves(eqx.Module):
    """The solves of a run of implicit steps, summed up.

    Attributes:
        iterations: of all solves together; -1 where the solver does not tell.
        residual: the largest.
        status: of all solves, joined; its step is the first that had trouble.
        last: how the last one ended.
    """

    iterations: Array
    residual: Array
    status: Status
    last: SolveInfo

    @staticmethod
    def none(info: SolveInfo) -> Solves:
        """Before the first solve; `info` tells types only."""
        return Solves(jnp.zeros_like(info.iterations), jnp.zeros_like(info.residual), Status.ok(), info)

    def then(self, info: SolveInfo, step: Array) -> Solves:
        """One more solve, in this step."""
        nowhere = jnp.asarray(NOWHERE, jnp.int32)
        placed = eqx.tree_at(lambda s: s.step, info.status, jnp.where(info.status.flags != 0, step, nowhere))
        return self.joined(Solves(info.iterations, info.residual, placed, info))

    def joined(self, later: Solves) -> Solves:
        """With the solves of a later part of the run."""
        unknown = later.iterations < 0
        iterations = jnp.where(unknown, later.iterations, self.iterations + later.iterations)
        return Solves(iterations, jnp.maximum(self.residual, later.residual), self.status.then(later.status), later.last)


__all__ = ["Solves"]
