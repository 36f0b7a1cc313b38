"""A block from its settings to a folder: run the scene, check it, and write report, pictures and animation.

Until the folder is whole there is a checkpoint beside it, from which a later call goes on to the same bits.
"""

from __future__ import annotations

import pathlib
import time
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...forces.base import Step
from ...progress import Progress, Stopwatch
from ...state import State
from ...steppers.explicit import SymplecticEuler
from ...thermal.fusing import melted_fraction
from ...thermal.ledger import energy_ledger
from ..command import FailedError, Written
from ..drawing import canvas_and_figure
from ..folder import ResultFolder
from ..parts import PartedRun
from .pictures import draw_animation, draw_strip
from .scene import Melting, MeltSettings, melting_block


@dataclass(frozen=True)
class Frames:
    """What was seen of a run, host arrays.

    Attributes:
        time: (T,) [s].
        points: (T, N, 3) [m].
        temperatures: (T, N) [K].
        melted: (T,) share of the particles that no spring holds.
        alive: (T, E) which springs hold.
        edges: (E, 2) which particles they join.
    """

    time: np.ndarray
    points: np.ndarray
    temperatures: np.ndarray
    melted: np.ndarray
    alive: np.ndarray
    edges: np.ndarray


class _Look(eqx.Module):
    """What a frame keeps."""

    net: Any

    def __call__(self, state: State) -> tuple[Any, ...]:
        alive = self.net.flatten(state.alive)
        return state.time, state.points, state.temperatures, melted_fraction(self.net, state), alive


class MeltRun(PartedRun):
    """A run of the block."""

    def __init__(self, scene: Melting, settings: MeltSettings):
        self.scene, self.settings = scene, settings
        about = {"kind": "melt", "settings": asdict(settings)}
        super().__init__(scene.system, scene.state, SymplecticEuler(), settings.n_steps, settings.duration, _Look(scene.net), about)

    def seen(self) -> Frames:
        """The frames, ready to be drawn."""
        time, points, temperatures, melted, alive = self.frames
        return Frames(time, points, temperatures, melted, alive, np.asarray(self.scene.net.edges))


def melt(settings: MeltSettings, out: pathlib.Path, progress: Progress | None = None, resume: bool = False) -> Written:
    """Run, check and write; or go on from where an earlier call was interrupted.

    Raises:
        OSError: there is no checkpoint to go on from, or none can be written.
        CheckpointError: the checkpoint is damaged or of other settings.
        ImportError: what draws the pictures is not installed.
        StoppedError: Ctrl-C; there is a checkpoint to go on from.
        FailedError: the run failed, or the folder could not be written.
    """
    canvas_and_figure()
    clock = Stopwatch()
    run = MeltRun(melting_block(settings), settings)
    return run.complete(out, lambda place: _finish(run, place, clock), progress, resume)


def _finish(run: MeltRun, place: ResultFolder, clock: Stopwatch) -> Written:
    """Check, and fill the folder, all or nothing."""
    scene, settings, frames = run.scene, run.settings, run.seen()
    seconds = {"run": clock.seconds, **seconds_per_effect(scene, run.state)}
    report = report_of(scene, settings, run.state, frames, seconds)
    lowest = report["lowest_particle_m"]
    if lowest < -1e-6 * settings.spacing:
        raise FailedError(f"a particle is {-lowest:.3g} m below the floor.")
    with place.filling(report) as folder:
        draw_strip(folder / "strip.png", frames, settings)
        draw_animation(folder / "melting.gif", frames, settings)
    return Written(table(report), "report.json, strip.png and melting.gif")


def report_of(scene: Melting, settings: MeltSettings, end: State, frames: Frames, seconds: dict[str, float]) -> dict[str, Any]:
    """Everything `report.json` holds."""
    book = energy_ledger(scene.system, end)
    mechanical = exchanged(book)
    return {
        "settings": asdict(settings),
        "melted_fraction": {"time_s": frames.time.tolist(), "share": frames.melted.tolist()},
        "ledger_J": {key: book[key] for key in ("start", "end", "work", "rules", "integration", "residual")},
        "integration_over_exchanged": abs(book["integration"]) / mechanical if mechanical else 0.0,
        "impulses_kg_m_per_s": book["impulses"],
        "momentum_kg_m_per_s": np.asarray(scene.system.momentum(end), np.float64).tolist(),
        "lowest_particle_m": float(frames.points[..., 2].min()),
        "seconds": seconds,
    }


def exchanged(book: dict[str, Any]) -> float:
    """Mechanical energy that changed hands [J]: the absolute values of work and of what rules changed, heat aside, summed."""
    by_rules = sum(abs(value) for entry in book["rules"].values() for name, value in entry.items() if name != "heat")
    return by_rules + sum(abs(value) for value in book["work"].values())


def seconds_per_effect(scene: Melting, end: State, repeats: int = 10) -> dict[str, float]:
    """Seconds of one evaluation of each force and rule at the end of the run, compiled, the fastest of a few [s]."""
    ready = scene.system.bind(end.dtype)
    dt = jax.numpy.zeros((), end.dtype)
    found = {}
    for force in ready.forces:
        found[type(force).__name__] = _fastest(eqx.filter_jit(lambda f, s: f.force(s)), (force, end), repeats)
    for rule in (r for r in ready.rules or () if not r.watches):
        found[type(rule).__name__] = _fastest(eqx.filter_jit(lambda r, s: r.update(Step(s, s, dt), s)), (rule, end), repeats)
    return found


def table(report: dict[str, Any]) -> str:
    """The ledger for the terminal."""
    book = report["ledger_J"]
    lines = [
        f"melted: {100 * report['melted_fraction']['share'][-1]:.0f} % of the particles",
        f"{'energy [J]':<28}{'start':>12}{'end':>12}",
    ]
    lines += [f"  {name:<26}{book['start'][name]:>12.5g}{book['end'][name]:>12.5g}" for name in book["start"]]
    lines += [f"{'changed by [J]':<28}{'mechanical':>12}{'heat':>12}"]
    lines += [f"  {name:<26}{value:>12.5g}{0:>12}" for name, value in book["work"].items() if value]
    for name, entry in book["rules"].items():
        lines.append(f"  {name:<26}{sum(v for key, v in entry.items() if key != 'heat'):>12.5g}{entry['heat']:>12.5g}")
    share = 100 * report["integration_over_exchanged"]
    lines.append(f"  {'error of the steps':<26}{book['integration']:>12.5g}{'':>12}  {share:.2g} % of what was exchanged")
    return "\n".join(lines)


def _fastest(call: Any, arguments: tuple[Any, ...], repeats: int) -> float:
    jax.block_until_ready(call(*arguments))
    spent = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(call(*arguments))
        spent.append(time.perf_counter() - begun)
    return min(spent)


__all__ = ["Frames", "MeltRun", "exchanged", "melt", "report_of", "seconds_per_effect", "table"]
