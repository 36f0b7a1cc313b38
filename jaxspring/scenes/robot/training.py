"""Training: Adam along the gradient of the distance by every weight of the controller."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array

from ...inverse.checkpoint import Checkpoint
from ...inverse.fit import Fit, Iteration, fit
from ...inverse.optimisers import Adam
from .scene import Robot, distance

N_ITERATIONS = 100
LEARNING_RATE = 0.005
LARGEST_NORM = 1.0  # m per unit of weight: an impact that is just missed makes a gradient long


class _Loss(eqx.Module):
    """Minus the distance [m]."""

    robot: Robot

    def __call__(self, controller: Any) -> Array:
        return -distance(self.robot, controller)


def train(
    robot: Robot,
    n_iterations: int = N_ITERATIONS,
    learning_rate: float = LEARNING_RATE,
    on_iteration: Callable[[Iteration], bool | None] | None = None,
    checkpoint: Checkpoint | None = None,
    resume: bool = False,
) -> Fit:
    """Controllers that walk farther and farther.

    Args:
        robot: who walks; it starts with its own controller.
        n_iterations: updates.
        learning_rate: of Adam; it falls along a cosine to a twentieth.
        on_iteration: as in `fit`.
        checkpoint: as in `fit`.
        resume: as in `fit`.

    Returns:
        A `Fit`: `parameters` is the controller that walked farthest, `history.loss` minus the distances [m].
    """
    optimiser = Adam(learning_rate, decay_over=max(n_iterations, 1), largest_norm=LARGEST_NORM)
    return fit(_Loss(robot), robot.controller, optimiser, n_iterations, on_iteration, checkpoint=checkpoint, resume=resume)


__all__ = ["train"]
