"""A robot from its settings to a folder: train it, walk before and after, and write report, pictures and animation.

Until the folder is whole there is only a checkpoint beside it, which a later call may go on from; in the end it moves into the folder.
"""

from __future__ import annotations

import pathlib
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import numpy as np

from ...inverse.checkpoint import Checkpoint
from ...inverse.fit import Fit, Iteration
from ...inverse.stopping import StopReason
from ...progress import Stopwatch, draw_bar
from ...rollouts import Result
from ...state import State
from ...status import raise_for_status
from ...topology.base import Topology
from ..command import FailedError, StoppedError, Written
from ..drawing import canvas_and_figure
from ..folder import ResultFolder, versions
from .pictures import draw_animation, draw_learning, draw_walks
from .scene import Robot, RobotSettings, walk, walking_robot
from .training import train


@dataclass(frozen=True)
class Frames:
    """What was seen of a walk, host arrays.

    Attributes:
        time: (T,) [s].
        points: (T, N, D) [m].
        growth: (T, E) present rest length over the given one.
        edges: (E, 2) which nodes the springs join.
        distance: (T,) what the mean of x has gained [m].
    """

    time: np.ndarray
    points: np.ndarray
    growth: np.ndarray
    edges: np.ndarray
    distance: np.ndarray


class _Look(eqx.Module):
    """What a frame keeps."""

    net: Topology
    springs: Any

    def __call__(self, state: State) -> tuple[Any, ...]:
        return state.time, state.points, self.net.flatten(self.springs.growth(state))


def seen(robot: Robot, controller: Any = None) -> Frames:
    """A walk, every step of it.

    Raises:
        SimulationError: the run failed.
    """
    found: Result = walk(robot, controller, save_every=1, observe=_Look(robot.net, robot.system.forces[0]))
    raise_for_status(found)
    time, points, growth = (np.asarray(a) for a in found.saved)
    gained = points[..., 0].mean(axis=1) - np.asarray(robot.state.points)[:, 0].mean()
    return Frames(time, points, growth, np.asarray(robot.net.edges), gained)


def walk_job(settings: RobotSettings, n_iterations: int, out: pathlib.Path, resume: bool = False) -> Written:
    """Train and write; or go on from where an earlier call was interrupted.

    Raises:
        CheckpointError: the checkpoint is damaged or of other settings.
        OSError: there is no checkpoint to go on from, or none can be written.
        ImportError: what draws the pictures is not installed.
        StoppedError: Ctrl-C; there is a checkpoint to go on from.
        FailedError: the training failed, or the folder could not be written.
    """
    canvas_and_figure()
    clock, robot, place = Stopwatch(), walking_robot(settings), ResultFolder(out)
    if resume:
        place.take_up()

    def show(iteration: Iteration) -> None:
        draw_bar("walk", min(iteration.index, n_iterations), n_iterations, note=f"{-iteration.loss:.3f} m")

    checkpoint = Checkpoint(str(place.checkpoint), every=10, note=f"robot {asdict(settings)}")
    found = train(robot, n_iterations, on_iteration=show, checkpoint=checkpoint, resume=resume)
    done = len(found.history.loss) - 1
    if found.reason is StopReason.INTERRUPTED:
        raise StoppedError(f"{done} iterations")
    if not bool(found.status.is_ok):
        raise FailedError(f"the training failed after {done} iterations: {found.explanation}.")
    try:
        walks = {"before": seen(robot), "after": seen(robot, found.parameters)}
        report = report_of(settings, found, walks, clock.seconds)
        with place.filling(report, keep_checkpoint=True, lost="training anew") as folder:
            draw_learning(folder / "learning.png", report["distance_m"])
            draw_walks(folder / "walks.png", walks)
            draw_animation(folder / "walking.gif", walks)
    except KeyboardInterrupt:
        raise StoppedError(f"{done} iterations") from None
    return Written(table(report), "report.json, learning.png, walks.png, walking.gif and checkpoint.npz")


def report_of(settings: RobotSettings, found: Fit, walks: dict[str, Frames], seconds: float) -> dict[str, Any]:
    """Everything `report.json` holds."""
    distances, of_call = -found.history.loss, found.history.seconds
    run = float(np.sum(of_call[1:]))
    return {
        "settings": asdict(settings),
        "versions": versions(),
        "walked_m": {name: float(frames.distance[-1]) for name, frames in walks.items()},
        "iterations": {"done": len(distances) - 1, "best": found.iteration},
        "distance_m": distances.tolist(),
        "lowest_node_m": min(float(frames.points[..., -1].min()) for frames in walks.values()),
        "seconds": {"first_iteration": float(of_call[0]), "others": run, "total": seconds},
    }


def table(report: dict[str, Any]) -> str:
    """The distances, for the terminal."""
    walked, iterations, seconds = report["walked_m"], report["iterations"], report["seconds"]
    return (
        f"walked in {report['settings']['duration']:g} s: {walked['before']:.3f} m before, {walked['after']:.3f} m after "
        f"{iterations['best']} of {iterations['done']} iterations\n"
        f"{seconds['total']:.1f} s in all, the first iteration with its compiling {seconds['first_iteration']:.1f} s"
    )


__all__ = ["Frames", "report_of", "seen", "table", "walk_job"]
