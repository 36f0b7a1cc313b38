"""What a linear solver is: an object that solves with a `SpringMatrix`, and says how that ended."""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array

from ..numerics import stopped
from ..status import Status
from ..vector import Vector
from .operators import SpringMatrix


class SolveInfo(eqx.Module):
    """How a linear solve ended.

    Attributes:
        residual: true residual |b - A x| / |b|; 0 where b is zero.
        iterations: how many there were, -1 where the solver does not tell.
        status: OK, CG_MAXITER (the tolerance was not reached), CG_INDEFINITE, PIVOT, SOLVER or NONFINITE.
    """

    residual: Array
    iterations: Array
    status: Status


class LinearSolver(eqx.Module):
    """Solves A x = b for the matrices of implicit steps. Abstract; `JaxCG`, `CG` and `Skyline` are final.

    A solver may carry something from one solve to the next, such as a factor: `init` makes it, `solve_in_step` returns the new one.
    """

    def init(self, matrix: SpringMatrix) -> Any:
        """What the solver carries before its first solve; None where it carries nothing."""
        return None

    @abc.abstractmethod
    def solve_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """Solve `matrix` x = b, differentiably in b and in the matrix; `guess` is where an iteration starts."""

    def find_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """The same without a derivative: for steps, whose derivative is that of their equations.

        A solver that is written with `lax.custom_linear_solve` spares its rules here, which compile long; and what that tells besides
        its solution gets a batch axis wherever a tangent has one, as under `jacfwd`.
        """
        return stopped(self.solve_in_step(*stopped((matrix, b, guess, memory))))


__all__ = ["LinearSolver", "SolveInfo"]
