"""Sheets of a fabric: hung by corners, laid over a ball and a table, a flag, and two tests of a fabric laboratory.

    sheet      equilateral triangles, springs and hinges of the fabric's constants                  `fabric`, `rectangle`, `disc`
    steps      backward Euler: cloth in measured units is stiff in stretch and soft in bending
    obstacles  `Contact`, with friction; what rests is held inside the implicit solve
    air        quadratic drag and friction on every triangle                                        `Air`

Gravity acts along -z. Each scene is a function of a `ClothSettings`; `SCENES` names them for the command.

Source: slide "Cloth simulation" names the task; Cusick (1968), "The measurement of fabric drape", for the disc of 15 cm over 9 cm; Peirce
(1930), "The handle of cloth as a measurable quantity", for the overhanging strip.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._checks import finite, nonnegative, positive
from ...cloth.constants import Cloth, fabric
from ...cloth.materials import INTERLOCK, Material
from ...cloth.meshes import ROW, disc, rectangle
from ...contact.base import Obstacle
from ...contact.obstacles import Cylinder, Sphere
from ...contact.rule import Contact
from ...forces.air import Air
from ...forces.loads import Gravity
from ...state import State
from ...steppers.base import Stepper
from ...steppers.implicit import BackwardEuler
from ...system import System
from ...topology.mesh_checks import borders
from ...vector import Vector

GRAVITY = 9.81  # [m/s^2]
SUPPORT, SPECIMEN = 0.09, 0.15  # radii of Cusick's test [m]
AT_EDGE = 0.4  # spacings
CHORD = 41.5  # degrees below the horizontal at which the bending test reads its length


@dataclass(frozen=True)
class ClothSettings:
    """What all scenes share.

    Attributes:
        material: the fabric: a `Fabric`, `KES`, `FAST`, or a published one.
        size: side of the sheet [m]; the length of the strip in the bending test. Cusick's disc has its own.
        spacing: of the nodes [m].
        duration: simulated time [s].
        dt: time step [s].
        wind: speed of the air along x [m/s], for the flag.
        friction: of cloth on what it lies on.

    Raises:
        ValueError: a size, a spacing or a time that is not positive, a sheet of less than two spacings.

    >>> settings = ClothSettings(material=js.cloth.Fabric(0.324, (205.0, 1014.0), 27.0, 5e-5), size=0.3, spacing=0.03)
    >>> print(f"{hanging(settings).cloth.mass.sum():.4f} kg")
    0.0292 kg
    """

    material: Material = INTERLOCK
    size: float = 0.5
    spacing: float = 0.02
    duration: float = 2.0
    dt: float = 0.01
    wind: float = 6.0
    friction: float = 0.4

    def __post_init__(self) -> None:
        for name in ("size", "spacing", "duration", "dt"):
            positive(name, np.asarray(getattr(self, name), float), "Give it in metres or seconds.")
        nonnegative("friction", np.asarray(self.friction, float), "It would push the cloth on.")
        finite("wind", np.asarray(self.wind, float))
        if self.size < 2 * self.spacing:
            raise ValueError(f"size = {self.size} is less than two spacings of {self.spacing}; expected more nodes than that.")


class ClothScene(eqx.Module):
    """A sheet, ready to run.

    Attributes:
        cloth: net, springs, hinges and masses.
        triangles: (F, 3) of the net.
        points: (N, 3) at rest [m].
        system: with gravity, air and obstacles.
        state: the start.
        stepper: for `js.rollout`.
        obstacle: what it lies on, or None.
        border: (B,) nodes around the sheet, in order; none of a mesh of the user's, which may have several.
        settings: the numbers (static).
    """

    cloth: Cloth
    triangles: np.ndarray
    points: np.ndarray
    system: System
    state: State
    stepper: Stepper
    obstacle: Obstacle | None
    border: np.ndarray
    settings: ClothSettings = eqx.field(static=True)

    def made_of(self, material: Material) -> ClothScene:
        """The same scene, cut from another fabric. Differentiable in the fabric's constants, also inside `jit`, where no net can be made.

        >>> scene = cusick(ClothSettings(spacing=0.03))
        >>> moved = jax.grad(lambda density: jnp.sum(scene.made_of(js.cloth.Fabric(density, 30.0, 11.0, 4e-5)).cloth.mass))(0.2)
        >>> print(f"{moved:.4f}")  # the disc's area [m^2]
        0.0702
        """
        cloth = fabric(self.cloth.net, self.points, material)
        forces = (*cloth.forces, *self.system.forces[len(cloth.forces) :])
        free = None if self.system.free is None else cloth.net.flatten_nodes(cast(Array, self.system.free))  # whole nodes
        system = System(cloth.net, cloth.mass, forces, free=free, rules=self.system.rules or ())
        return replace(self, cloth=cloth, system=system, settings=replace(self.settings, material=material))


Builder = Callable[[ClothSettings], ClothScene]


def hanging(settings: ClothSettings) -> ClothScene:
    """A sheet that lies level at first, held by the two corners of one side, and swings down.

    Args:
        settings: fabric, side, spacing, air.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = hanging(ClothSettings(size=0.2, spacing=0.1))
    >>> int((~scene.system.free).sum()), round(float(scene.cloth.mass.sum()) / 0.04, 3)
    (2, 0.187)
    """
    net, points = rectangle(settings.size, settings.size, settings.spacing)
    side = points[:, 1] > points[:, 1].max() - 1e-9 * settings.size
    held = side & ((points[:, 0] <= points[side, 0].min()) | (points[:, 0] >= points[side, 0].max()))
    return _scene(settings, net, points, held)


def on_ball(settings: ClothSettings) -> ClothScene:
    """A sheet that falls onto a ball of a quarter of its side.

    Args:
        settings: fabric, side, spacing, friction.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = on_ball(ClothSettings(size=0.2, spacing=0.1))
    >>> round(float(scene.obstacle.radius), 3)
    0.05
    """
    net, points = rectangle(settings.size, settings.size, settings.spacing)
    radius = settings.size / 4
    middle = points.mean(axis=0)
    ball = Sphere((middle[0], middle[1], -radius - 0.01 * settings.size), radius)
    return _scene(settings, net, points, None, ball)


def on_table(settings: ClothSettings) -> ClothScene:
    """A sheet that falls onto a round table of 0.3 of its side, and hangs over the edge.

    Args:
        settings: fabric, side, spacing, friction.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = on_table(ClothSettings(size=0.2, spacing=0.1))
    >>> bool((scene.obstacle.distance(scene.state.position, scene.state.time) > 0).all())
    True
    """
    net, points = rectangle(settings.size, settings.size, settings.spacing)
    middle, top = points.mean(axis=0), -0.01 * settings.size
    upper, lower = ((middle[0], middle[1], top - depth * settings.size) for depth in (0.0, 1.0))
    return _scene(settings, net, points, None, Cylinder(upper, lower, 0.3 * settings.size))


def flag(settings: ClothSettings) -> ClothScene:
    """A sheet held along one side, upright, in wind along x with gusts of a fifth of it.

    Args:
        settings: fabric, length, spacing, wind.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = flag(ClothSettings(size=0.2, spacing=0.05, wind=4.0))
    >>> bool((abs(scene.state.points[:, 2] - scene.points[:, 1]) < 1e-6).all())
    True
    """
    net, flat = rectangle(settings.size, 0.6 * settings.size, settings.spacing)
    upright = flat[:, [0, 2, 1]]
    held = flat[:, 0] < flat[:, 0].min() + 1e-9 * settings.size
    # What is flat in the wind stays so: a small wave to begin with.
    wave = 0.01 * settings.size * np.sin(2 * np.pi * flat[:, 0] / settings.size)
    return _scene(settings, net, flat, held, places=upright + wave[:, None] * [0, 1, 0], wind=_Gusts(jnp.asarray(settings.wind)))


def cantilever(settings: ClothSettings) -> ClothScene:
    """A strip, clamped level at one end: the bending test. Its rows lie across it, about which it bends; of warp, along x.

    The first bend is at the clamp's last row, and stands for half a row to either side: the free length begins half a row before it.
    Across, a net of triangles and hinges has Poisson's ratio -1/3: a strip that is narrow, or soft to stretch, bends as with up to a ninth
    less than B.

    Args:
        settings: fabric, free length (`size`), spacing.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = cantilever(ClothSettings(size=0.08, spacing=0.02))
    >>> n_held = int((~scene.system.free).sum())
    >>> n_held, len(scene.points), round(float(scene.points[:, 0].max()), 3)  # x begins at the clamp
    (16, 38, 0.08)
    """
    n_rows = max(2, round(settings.size / (ROW * settings.spacing) - 0.5))
    row = settings.size / (n_rows + 0.5)
    net, across = rectangle(max(4 * settings.spacing, settings.size / 4), (n_rows + 2) * row, row / ROW)
    points = across[:, [1, 0, 2]] - [1.5 * row, 0, 0]
    clamped = points[:, 0] < 0.75 * row
    return _scene(settings, net, points, clamped)


def cusick(settings: ClothSettings) -> ClothScene:
    """A disc of 15 cm, held level by one of 9 cm on it: the drape test.

    Args:
        settings: fabric, spacing; `size` is not asked.

    Returns:
        A `ClothScene`, ready for `js.rollout`.

    >>> scene = cusick(ClothSettings(spacing=0.03))
    >>> round(float(drape_coefficient(scene, scene.state)), 6)  # flat yet
    1.0
    """
    net, points = disc(SPECIMEN, settings.spacing)
    away = np.hypot(points[:, 0], points[:, 1])
    # What is near to the edge of the support is put onto it, else the overhang would be that of the mesh; nearer than half of a triangle's
    # height, so that no triangle has all its corners there.
    near = np.abs(away - SUPPORT) < AT_EDGE * settings.spacing
    points[near] *= (SUPPORT / away[near])[:, None]
    held = near | (away < SUPPORT)
    return _scene(settings, net, points, held)


def with_mesh(settings: ClothSettings, net: Any, points: np.ndarray) -> ClothScene:
    """A flat mesh of the user's, held where it is highest along y, to a quarter of an edge, and hanging from there."""
    edge = np.median(np.linalg.norm(np.diff(points[np.asarray(net.edges)], axis=1)[:, 0], axis=1))
    held = points[:, 1] > points[:, 1].max() - 0.25 * edge
    return _scene(settings, net, points, held, has_border=False)


class _Gusts(eqx.Module):
    """Wind along x that swells and turns by a fifth."""

    speed: Array

    def __call__(self, places: Vector, time: Array) -> Vector:
        turn = 2 * jnp.pi * time
        along = self.speed * (1 + 0.2 * jnp.sin(1.1 * turn)) * jnp.ones_like(places.x)
        across = 0.2 * self.speed * jnp.sin(1.7 * turn) * jnp.ones_like(places.x)
        return Vector((along, across, jnp.zeros_like(along)))


def _scene(
    settings: ClothSettings,
    net: Any,
    flat: np.ndarray,
    held: np.ndarray | None,
    obstacle: Obstacle | None = None,
    places: np.ndarray | None = None,
    wind: Any = None,
    has_border: bool = True,
) -> ClothScene:
    cloth = fabric(net, flat, settings.material)
    air = Air(net, drag=1.2, friction=0.02, wind=wind)
    forces = (*cloth.forces, air, Gravity((0.0, 0.0, -GRAVITY)))
    rules = () if obstacle is None else Contact(obstacle, friction=settings.friction)
    system = System(net, cloth.mass, forces, free=None if held is None else ~held, rules=rules)
    state = State.from_points(net, flat if places is None else places)
    triangles = np.asarray(net.triangles)
    border = np.asarray(max(borders(triangles), key=len) if has_border else [], int)
    return ClothScene(cloth, triangles, flat, system, state, BackwardEuler(), obstacle, border, settings)


SCENES: dict[str, Builder] = {
    "hanging": hanging,
    "ball": on_ball,
    "table": on_table,
    "flag": flag,
    "cantilever": cantilever,
    "drape": cusick,
}


def drape_coefficient(scene: ClothScene, state: State) -> Array:
    """Cusick's coefficient: the share of the overhanging ring that is still shadow, (A - pi r^2) / (pi (R^2 - r^2)).

    The shadow is what the border's projection encloses, so that the coefficient has a derivative; where folds reach under one another, it
    counts the ground between them twice.

    Args:
        scene: of `cusick`.
        state: the scene's, at any time.

    Returns:
        () 1 where flat; about 0 where what overhangs hangs straight down.

    >>> scene = cusick(ClothSettings(spacing=0.03))
    >>> down = scene.points * [[0.8, 0.8, 1.0]]
    >>> round(float(drape_coefficient(scene, State.from_points(scene.cloth.net, down))), 3)
    0.435
    """

    def area(points: Array) -> Array:
        x, y = points[:, 0], points[:, 1]
        return 0.5 * jnp.abs(jnp.sum(x * jnp.roll(y, -1) - y * jnp.roll(x, -1)))

    # Of the polygon that the disc is, so that what does not drape has 1.
    whole = area(jnp.asarray(scene.points, state.dtype)[scene.border])
    support = math.pi * SUPPORT**2
    return (area(state.points[scene.border]) - support) / (whole - support)


def chord_angle(scene: ClothScene, state: State) -> Array:
    """How far the chord from the clamp, at x = 0, to the free end of a cantilever points below the horizontal [degrees]."""
    end = scene.points[:, 0] > scene.points[:, 0].max() - 1e-9
    tip = jnp.mean(state.points[np.flatnonzero(end)], axis=0)
    return jnp.degrees(jnp.arctan2(-tip[2], tip[0]))


__all__ = [
    "SCENES",
    "ClothScene",
    "ClothSettings",
    "cantilever",
    "chord_angle",
    "cusick",
    "drape_coefficient",
    "flag",
    "hanging",
    "on_ball",
    "on_table",
    "with_mesh",
]
