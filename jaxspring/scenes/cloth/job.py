"""A cloth from its settings to a folder: run the scene, measure it, and write report, mesh, frames, pictures and animation.

Until the folder is whole there is a checkpoint beside it, from which a later call goes on to the same bits.
"""

from __future__ import annotations

import hashlib
import itertools
import pathlib
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...contact.obstacles import Cylinder, Sphere
from ...export.surfaces import save_obj
from ...export.vtk import save_vtk
from ...progress import Progress, Stopwatch
from ...state import State
from ...system import System
from ..command import Written
from ..drawing import canvas_and_figure
from ..folder import ResultFolder, versions
from ..parts import PartedRun
from .pictures import draw_animation, draw_energy, draw_last, draw_strip
from .scene import SPECIMEN, SUPPORT, ClothScene, chord_angle, drape_coefficient


@dataclass(frozen=True)
class Frames:
    """What was seen of a run, host arrays.

    Attributes:
        time: (T,) [s].
        points: (T, N, 3) [m].
        energy: by name (T,) [J]; of the height from that of the start.
        strain: (T, F) the largest of a triangle's springs.
        triangles: (F, 3).
        obstacle: (P, 3, 3) corners of the triangles that show what the cloth lies on [m]; (0, 3, 3) without one.
    """

    time: np.ndarray
    points: np.ndarray
    energy: dict[str, np.ndarray]
    strain: np.ndarray
    triangles: np.ndarray
    obstacle: np.ndarray


class _Look(eqx.Module):
    """What a frame keeps."""

    system: System

    def __call__(self, state: State) -> tuple[Any, ...]:
        energy = self.system.energy(state)
        stored = [jnp.zeros((), state.dtype) if e is None else e for e in energy.potential]
        return state.time, state.points, state.velocities, jnp.stack([energy.kinetic, *stored])


class ClothRun(PartedRun):
    """A run of a cloth.

    Attributes:
        scene: what runs.
    """

    def __init__(self, name: str, scene: ClothScene):
        self.scene = scene
        settings = scene.settings
        drawn = np.ascontiguousarray(scene.points).tobytes() + np.ascontiguousarray(scene.triangles).tobytes()
        about = {"kind": f"cloth {name}", "settings": numbers_of(scene), "mesh": hashlib.sha256(drawn).hexdigest()[:16]}
        n_steps = max(1, round(settings.duration / settings.dt))
        super().__init__(scene.system, scene.state, scene.stepper, n_steps, settings.duration, _Look(scene.system), about)

    def series(self) -> State:
        """The frames as one state with an axis of frames."""
        time, points, velocities, _ = self.frames
        net = self.scene.cloth.net
        return jax.vmap(lambda p, v, t: State.from_points(net, p, v, time=t))(points, velocities, time)

    def seen(self) -> Frames:
        """The frames, ready to be drawn."""
        time, points, _, energy = self.frames
        names = ["motion", *(type(force).__name__ for force in self.scene.system.forces)]
        named = {name: energy[:, i] for i, name in enumerate(names) if name != "Air"}
        named["Gravity"] = named["Gravity"] - named["Gravity"][0]
        triangles = np.asarray(self.scene.triangles)
        return Frames(time, points, named, strains(self.scene.points, points, triangles), triangles, solid(self.scene))


def numbers_of(scene: ClothScene) -> dict[str, Any]:
    """The scene in numbers, for the report."""
    s, f = scene.settings, scene.cloth.fabric
    of_fabric = {"density": f.density, "stretch": f.stretch, "shear": f.shear, "bending": f.bending}
    return {
        **{name: getattr(s, name) for name in ("size", "spacing", "duration", "dt", "wind", "friction")},
        "fabric": {name: np.asarray(value).tolist() for name, value in of_fabric.items()},
        "nodes": len(scene.points),
    }


def strains(rest: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(T, F) the largest strain along the sides of each triangle."""

    def lengths(places: np.ndarray) -> np.ndarray:
        corners = places[..., triangles, :]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=-2), axis=-1)

    return np.max(lengths(points) / lengths(rest) - 1, axis=-1)


def solid(scene: ClothScene) -> np.ndarray:
    """Corners of the triangles that show the obstacle [m]; none without one."""
    turn = np.linspace(0, 2 * np.pi, 49)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if isinstance(scene.obstacle, Sphere):
        centre, radius = np.asarray(scene.obstacle.centre), float(scene.obstacle.radius)
        heights = np.cos(np.linspace(0, np.pi, 25))
        rings = [centre + radius * np.c_[np.sqrt(1 - z * z) * ring, np.full(len(ring), z)] for z in heights]
        return _between(rings)
    if isinstance(scene.obstacle, Cylinder):
        top, foot, radius = np.asarray(scene.obstacle.a), np.asarray(scene.obstacle.b), float(scene.obstacle.radius)
        around = radius * np.c_[ring, np.zeros(len(ring))]
        return _between([top + 0 * around, top + around, foot + around])
    return np.zeros((0, 3, 3))


def _between(rings: list[np.ndarray]) -> np.ndarray:
    """Triangles between every two rings of points."""
    found = []
    for a, b in itertools.pairwise(rings):
        found += [np.stack([a[:-1], a[1:], b[:-1]], axis=1), np.stack([a[1:], b[1:], b[:-1]], axis=1)]
    return np.concatenate(found)


def cloth_job(name: str, scene: ClothScene, out: pathlib.Path, progress: Progress | None = None, resume: bool = False) -> Written:
    """Run, measure and write; or go on from where an earlier call was interrupted.

    Raises:
        OSError: there is no checkpoint to go on from, or none can be written.
        CheckpointError: the checkpoint is damaged or of other settings.
        ImportError: what draws the pictures is not installed.
        StoppedError: Ctrl-C; there is a checkpoint to go on from.
        FailedError: the run failed, or the folder could not be written.
    """
    canvas_and_figure()
    clock, run = Stopwatch(), ClothRun(name, scene)
    return run.complete(out, lambda place: _finish(name, run, place, clock), progress, resume)


def _finish(name: str, run: ClothRun, place: ResultFolder, clock: Stopwatch) -> Written:
    """Measure, and fill the folder, all or nothing."""
    seconds, frames, series = clock.seconds, run.seen(), run.series()
    report = report_of(name, run, frames, series, seconds)
    with place.filling(report) as folder:
        _fill(folder, name, run, frames, series)
    return Written(table(report), "report.json, cloth.obj, frames in VTK, four pictures and cloth.gif")


def _fill(folder: pathlib.Path, name: str, run: ClothRun, frames: Frames, series: State) -> None:
    scene, net = run.scene, run.scene.cloth.net
    material = scene.cloth.fabric
    title = f"{name}: {len(scene.points)} nodes, {float(material.density):.3g} kg/m$^2$, B = {1e6 * float(material.bending[0]):.3g} µN m"
    save_obj(folder / "cloth.obj", run.state, net)
    save_vtk(folder / "frames", series, net, triangles=frames.triangles)
    draw_strip(folder / "strip.png", frames, title)
    draw_last(folder / "last.png", frames, title)
    draw_energy(folder / "energy.png", frames)
    draw_animation(folder / "cloth.gif", frames)


def report_of(name: str, run: ClothRun, frames: Frames, series: State, seconds: float) -> dict[str, Any]:
    """Everything `report.json` holds."""
    scene, state = run.scene, run.state
    simulated = float(frames.time[-1] - frames.time[run.done_before])
    report: dict[str, Any] = {
        "scene": name,
        "settings": numbers_of(scene),
        "versions": versions(),
        "realised": {key: None if found is None else float(found) for key, (_, found) in scene.cloth.compared().items()},
        "energy_J": {key: values.tolist() for key, values in frames.energy.items()},
        "time_s": frames.time.tolist(),
        "largest_strain": float(frames.strain[-1].max()),
        "largest_speed_m_per_s": float(np.linalg.norm(run.frames[2][-1], axis=1).max()),
        "penetration_m": _deepest(scene, series),
        "warnings": run.status.describe(run.effects),
        "seconds": {"run": seconds, "per_simulated_second": seconds / simulated if simulated else None},
    }
    if name == "drape":
        report["drape_coefficient"] = float(drape_coefficient(scene, state))
        report["radii_m"] = {"support": SUPPORT, "specimen": SPECIMEN}
    if name == "cantilever":
        report["chord_angle_degrees"] = float(chord_angle(scene, state))
    return report


def _deepest(scene: ClothScene, series: State) -> float | None:
    """How deep a node was inside the obstacle in any frame [m], 0 where none was; None without an obstacle."""
    if scene.obstacle is None:
        return None
    return max(0.0, -float(jnp.min(jax.vmap(scene.obstacle.distance)(series.position, series.time))))


def table(report: dict[str, Any]) -> str:
    """What was measured, for the terminal."""
    lines = [f"{report['scene']}: {report['settings']['nodes']} nodes, largest strain {100 * report['largest_strain']:.3g} %"]
    if report["penetration_m"] is not None:
        lines.append(f"deepest node {1e3 * report['penetration_m']:.3g} mm inside")
    if "drape_coefficient" in report:
        lines.append(f"drape coefficient {report['drape_coefficient']:.3f}")
    if "chord_angle_degrees" in report:
        lines.append(f"chord angle {report['chord_angle_degrees']:.2f} degrees")
    per_second = report["seconds"]["per_simulated_second"]
    lines.append(f"{report['seconds']['run']:.1f} s in all" + (f", {per_second:.1f} s per simulated second" if per_second else ""))
    return "\n".join(lines)


__all__ = ["ClothRun", "Frames", "cloth_job", "numbers_of", "report_of", "solid", "strains", "table"]
