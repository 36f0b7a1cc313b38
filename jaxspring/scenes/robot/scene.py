"""A soft robot on the ground, which walks by changing the rest lengths of its springs.

    body         cells of springs and dashpots; the sides of the cells are driven        `body_of_cells`, `Springs`, `Dashpots`
    commands     by a network that knows the time, places and velocities                 `Actuation`, `NeuralController`
    ground       a plane with Coulomb's friction, and weight                             `Floor`, `Gravity`
    distance     what the mean of x gains in a run [m]; training follows its gradient through all steps and impacts

Source: mass-spring robots trained through the simulation as in Hu and others (2020); constants are this library's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._arrays import Numbers
from ..._checks import as_inexact, nonnegative, positive
from ...forces.actuation import Actuation
from ...forces.contact import Floor
from ...forces.controllers import NeuralController
from ...forces.damping import Dashpots
from ...forces.loads import Gravity
from ...forces.springs import Springs
from ...rollouts import Result, rollout
from ...state import State
from ...steppers.explicit import SymplecticEuler
from ...system import System
from ...topology.base import Topology
from .body import body_of_cells


@dataclass(frozen=True)
class RobotSettings:
    """The scene in numbers.

    Attributes:
        body: rows of cells from the top down, `#` where there is one.
        depth: cells across the way; 0 is a robot in two dimensions.
        cell: size of a cell [m].
        node_mass: [kg].
        stiffness: of each spring [N/m].
        damping: of each dashpot [N s/m].
        friction: of the ground.
        gravity: [m/s^2], downward.
        frequency: of the beat that the network hears [Hz].
        reach: by which share a command may change a rest length.
        n_hidden: width of the network.
        seed: of its first weights.
        dt: [s]; None takes 3.5 ms for a flat body and 1.25 ms for a deep one, whose nodes have up to 26 springs: with the other numbers
            as they are, every drawing is stable then.
        duration: of a walk [s].

    Raises:
        ValueError: a number that is not finite and positive (friction and gravity may be 0), a reach of 1 or more, a duration shorter than
            a step, a drawing without cells. The message names the field.
    """

    body: tuple[str, ...] = ("####", "#..#")
    depth: int = 0
    cell: float = 0.1
    node_mass: float = 0.05
    stiffness: float = 300.0
    damping: float = 1.15
    friction: float = 0.6
    gravity: float = 9.81
    frequency: float = 2.0
    reach: float = 0.2
    n_hidden: int = 16
    seed: int = 0
    dt: float | None = None
    duration: float = 2.0

    def __post_init__(self) -> None:
        for name in ("cell", "node_mass", "stiffness", "damping", "frequency", "reach", "n_hidden", "duration", "step"):
            positive("dt" if name == "step" else name, getattr(self, name), "The scene needs a positive number here.")
        for name in ("friction", "gravity"):
            nonnegative(name, getattr(self, name), "It would feed energy in, or turn the ground around.")
        if self.reach >= 1:
            raise ValueError(f"reach = {self.reach:g}; expected less than 1: a rest length would vanish.")
        if self.duration < self.step:
            raise ValueError(f"duration = {self.duration:g} s is shorter than a step, dt = {self.step:g} s. Pass {self.step:g} or more.")
        body_of_cells(self.body, self.cell, self.depth)

    @property
    def step(self) -> float:
        """Time step [s]."""
        return (1.25e-3 if self.depth else 3.5e-3) if self.dt is None else self.dt

    @property
    def n_steps(self) -> int:
        """The fewest steps that fill the duration."""
        return math.ceil(self.duration / self.step * (1 - 1e-9))  # less a little: 0.3 / 0.1 is above 3


class Robot(eqx.Module):
    """The scene, ready to run.

    Attributes:
        net: the springs of the body.
        system: forces and the ground; its first force is the driven springs.
        state: standing on the ground, at rest.
        settings: the numbers (static).
    """

    net: Topology
    system: System
    state: State
    settings: RobotSettings = eqx.field(static=True)

    @property
    def controller(self) -> Any:
        """What drives the springs: the parameters of a training."""
        return _controller(self.system)

    def driven_by(self, controller: Any) -> System:
        """The system with another controller of the same kind."""
        return eqx.tree_at(_controller, self.system, controller)


def walking_robot(
    settings: RobotSettings | None = None,
    controller: Callable[[State], Any] | None = None,
    net: Topology | None = None,
    points: Numbers | None = None,
    groups: Numbers | None = None,
    dtype: jnp.dtype | None = None,
) -> Robot:
    """The robot at rest, its lowest nodes on the ground.

    Args:
        settings: `RobotSettings()` unless said; its `body` and `depth` count where no net is given.
        controller: what drives it; a `NeuralController` with random weights unless said.
        net: a body of one's own, in two or three dimensions.
        points: (N, D) places of its nodes [m], x along the way and the last coordinate up, with no node below zero.
        groups: (E,) actuator of each of its springs, -1 where it has none; each spring has its own unless said.
        dtype: of the state; JAX's default unless said.

    Returns:
        A `Robot`: net, system, start and settings.

    Raises:
        ValueError: a net without points, or points and groups without a net; points in one dimension.

    >>> robot = walking_robot(RobotSettings(body=("##",), duration=0.1))
    >>> print(robot.net.n_nodes, robot.net.n_springs, robot.state.dim)
    6 11 2
    """
    s = RobotSettings() if settings is None else settings
    dtype = jnp.result_type(float) if dtype is None else dtype
    if (net is None) != (points is None) or (net is None and groups is not None):
        raise ValueError("a body of your own is a net with points, and groups if you like. Pass net=... and points=..., or none of them.")
    if net is None or points is None:
        body = body_of_cells(s.body, s.cell, s.depth)
        net, points, groups = body.net, body.points, body.groups
    points = as_inexact("points", points, dtype)
    start = State.from_points(net, points)
    if start.dim == 1:
        raise ValueError("points have one coordinate; a robot walks in two or three dimensions.")
    plan = Actuation(repr, groups)  # of its groups, before there is a controller for as many
    n_commands = net.n_springs if plan.n_groups is None else plan.n_groups
    if controller is None:
        key = jax.random.key(s.seed)
        controller = NeuralController.random(key, start, n_commands, s.n_hidden, s.frequency, s.cell, s.reach)
    up = jnp.zeros(start.dim).at[-1].set(1.0)
    actuation = Actuation(controller, plan.groups, 1 - s.reach, 1 + s.reach)
    springs = Springs(net, s.stiffness, net.lengths(points), actuation=actuation)
    forces = (springs, Dashpots(net, s.damping), Gravity(-s.gravity * up))
    system = System(net, s.node_mass, forces, rules=Floor(jnp.zeros(start.dim), up, s.friction))
    return Robot(net, system, start, s)


def walk(
    robot: Robot,
    controller: Any = None,
    n_steps: int | None = None,
    save_every: int | None = None,
    observe: Callable[[State], Any] | None = None,
) -> Result:
    """A run from the start, by `SymplecticEuler`.

    Args:
        robot: who walks.
        controller: of the same kind as the robot's own, which is taken unless said.
        n_steps: the settings' duration unless said.
        save_every: as in `rollout`.
        observe: as in `rollout`.

    Returns:
        A `Result`, as `rollout` gives it.

    >>> robot = walking_robot(RobotSettings(body=("##",), duration=0.1))
    >>> print(walk(robot, n_steps=2).info.n_steps)
    2
    """
    system = robot.system if controller is None else robot.driven_by(controller)
    n_steps = robot.settings.n_steps if n_steps is None else n_steps
    return rollout(system, robot.state, SymplecticEuler(), robot.settings.step, n_steps, save_every=save_every, observe=observe)


def distance(robot: Robot, controller: Any = None, n_steps: int | None = None) -> Array:
    """What the mean of x has gained at the end of a walk [m].

    Args:
        robot: who walks.
        controller: of the same kind as the robot's own, which is taken unless said.
        n_steps: the settings' duration unless said.

    Returns:
        A 0-d array [m], differentiable by the weights of the controller and by the robot's constants.

    >>> robot = walking_robot(RobotSettings(body=("##",), duration=0.1))
    >>> print(jax.grad(lambda controller: distance(robot, controller))(robot.controller).second.shape)
    (7, 16)
    """
    end = walk(robot, controller, n_steps).state
    return jnp.mean(end.position[0]) - jnp.mean(robot.state.position[0])


def _controller(system: System) -> Any:
    force: Any = system.forces[0]
    return force.actuation.controller


__all__ = ["Robot", "RobotSettings", "distance", "walk", "walking_robot"]
