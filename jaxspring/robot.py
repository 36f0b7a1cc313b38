"""Driven springs: actuation, controllers, and a soft robot that learns to walk."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .forces.actuation import Actuation as Actuation
    from .forces.controllers import NeuralController as NeuralController
    from .forces.controllers import Oscillators as Oscillators
    from .scenes.robot.body import Body as Body
    from .scenes.robot.body import body_of_cells as body_of_cells
    from .scenes.robot.scene import Robot as Robot
    from .scenes.robot.scene import RobotSettings as RobotSettings
    from .scenes.robot.scene import distance as distance
    from .scenes.robot.scene import walk as walk
    from .scenes.robot.scene import walking_robot as walking_robot
    from .scenes.robot.training import train as train
else:
    __all__, __getattr__, __dir__ = _face(__name__)
