"""The command `jaxspring melt`: run the scene, check it, and write report, pictures and animation.

The folder appears at the end, whole.
"""

from __future__ import annotations

import json
import math
import pathlib
import time
from dataclasses import asdict, dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ...archive import atomic_folder
from ...forces.base import Step
from ...progress import Progress, Stopwatch
from ...rollouts import Result, rollout
from ...state import State
from ...status import Flag
from ...steppers.explicit import SymplecticEuler
from ...thermal.fusing import melted_fraction
from ...thermal.ledger import Ledger, energy_ledger
from .pictures import draw_animation, draw_strip
from .scene import Melting, MeltSettings, melting_block

FRAMES = 60


@dataclass(frozen=True)
class MeltOutcome:
    """How a run ended.

    Attributes:
        is_interrupted: by Ctrl-C; nothing was written.
        failure: one line, or empty where the folder was written.
        table: what happened, for the terminal.
    """

    is_interrupted: bool = False
    failure: str = ""
    table: str = ""


@dataclass(frozen=True)
class Frames:
    """What was seen of a run, host arrays.

    Attributes:
        time: (T,) [s].
        points: (T, N, 3) [m].
        temperatures: (T, N) [K].
        melted: (T,) share of the particles that no spring holds.
    """

    time: np.ndarray
    points: np.ndarray
    temperatures: np.ndarray
    melted: np.ndarray


class _Look(eqx.Module):
    """What a frame keeps."""

    net: Any

    def __call__(self, state: State) -> tuple[Any, ...]:
        return state.time, state.points, state.temperatures, melted_fraction(self.net, state)


def run_melting(scene: Melting, settings: MeltSettings, progress: Progress | None = None) -> tuple[Result, Frames]:
    """Run the scene for its duration, in steps of at most its dt; keep `FRAMES` frames, or as many as there are steps, and the start."""
    every = math.ceil(settings.n_steps / FRAMES)
    n_steps = every * min(FRAMES, settings.n_steps)
    dt = settings.duration / n_steps  # so that equal frames fill the duration
    look = _Look(scene.net)
    result = rollout(scene.system, scene.state, SymplecticEuler(), dt, n_steps, save_every=every, observe=look, progress=progress)
    frames = jax.tree.map(lambda a, b: np.concatenate([np.asarray(a)[None], np.asarray(b)]), look(scene.state), result.saved)
    return result, Frames(*frames)


def melt(settings: MeltSettings, out: pathlib.Path, progress: Progress | None = None) -> MeltOutcome:
    """Run, check and write.

    Raises:
        OSError: the folder cannot be written.
        ImportError: matplotlib is not installed.
    """
    clock = Stopwatch()
    scene = melting_block(settings)
    result, frames = run_melting(scene, settings, progress)
    if bool(result.status.has(Flag.INTERRUPTED)):
        return MeltOutcome(is_interrupted=True)
    if not bool(result.status.is_ok):
        return MeltOutcome(failure=f"the run failed: {result.status.describe(result.effects)}.")
    seconds = {"run": clock.seconds, **seconds_per_effect(scene, result.state)}
    report = report_of(scene, settings, result.state, frames, seconds)
    lowest = report["lowest_particle_m"]
    if lowest < -1e-6 * settings.spacing:
        return MeltOutcome(failure=f"a particle is {-lowest:.3g} m below the floor.")
    with atomic_folder(out) as folder:
        draw_strip(folder / "strip.png", frames, settings)
        draw_animation(folder / "melting.gif", frames, settings)
        (folder / "report.json").write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return MeltOutcome(table=table(report))


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
    ready = scene.system.prepare(end.dtype)
    rules = tuple(rule for book in ready.rules or () if isinstance(book, Ledger) for rule in book.rules)
    dt = jax.numpy.zeros((), end.dtype)
    found = {}
    for force in ready.forces:
        found[type(force).__name__] = _fastest(eqx.filter_jit(lambda f, s: f.force(s)), (force, end), repeats)
    for rule in rules:
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


__all__ = ["Frames", "MeltOutcome", "exchanged", "melt", "report_of", "run_melting", "seconds_per_effect", "table"]
