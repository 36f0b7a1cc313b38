"""Pictures of a robot that learns: how far it walked after each iteration, both walks from the side, and both as an animation.

Springs are coloured by their command: blue where the rest length is shortened, red where it is lengthened, grey where nobody drives them.
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..drawing import new_figure

DPI = 110
N_SHOWN = 6
N_ANIMATED = 50
COLOURS = "coolwarm"


def draw_learning(path: pathlib.Path, distances: list[float]) -> None:
    """The distance over the iterations.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(7, 4, DPI)
    axes = figure.add_subplot()
    axes.plot(distances, color="tab:blue")
    best = int(np.argmax(distances))
    axes.plot(best, distances[best], "o", color="tab:orange", label=f"farthest: {distances[best]:.2f} m, iteration {best}")
    axes.axhline(distances[0], color="0.5", linewidth=0.8, linestyle=":", label=f"before: {distances[0]:.2f} m")
    axes.set(xlabel="iteration", ylabel="distance walked (m)", title="Learning")
    axes.legend()
    figure.savefig(path, metadata={"Software": None})


def draw_walks(path: pathlib.Path, walks: dict[str, Any]) -> None:
    """Both walks from the side, next to each other on one scale: six moments each, evenly spaced in time, from the top down.

    Raises:
        ImportError: matplotlib is not installed.
    """
    box, scale = _box(walks), _scale(walks)
    panel = 5.6 * (box[3] - box[2]) / (box[1] - box[0])  # inches high
    figure = new_figure(13, N_SHOWN * (panel + 0.3) + 0.6, DPI)
    columns = figure.subplots(N_SHOWN, len(walks), sharex=True, sharey=True).T
    for column, (name, frames) in zip(columns, walks.items(), strict=True):
        for axes, i in zip(column, np.linspace(0, len(frames.time) - 1, N_SHOWN).round().astype(int), strict=True):
            _panel(axes, frames, int(i), box, scale)
            axes.set_title(f"{name}, {_moment(frames, int(i))}", fontsize=9)
            axes.label_outer()
    _colour_bar(figure, list(np.ravel(columns)), scale)
    figure.savefig(path, metadata={"Software": None})


def draw_animation(path: pathlib.Path, walks: dict[str, Any]) -> None:
    """Both walks at once, one above the other, as an animated GIF at the pace of the simulated time where that is 2 s or more.

    Raises:
        ImportError: matplotlib or pillow is not installed.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter

    box, scale = _box(walks), _scale(walks)
    panel = 6.5 * (box[3] - box[2]) / (box[1] - box[0])  # inches high
    figure = new_figure(8, len(walks) * (panel + 0.5) + 0.5, 80)
    rows = figure.subplots(len(walks), 1, sharex=True)
    _colour_bar(figure, list(rows), scale)
    duration = float(next(iter(walks.values())).time[-1])
    chosen = np.linspace(0, len(next(iter(walks.values())).time) - 1, N_ANIMATED).round().astype(int)

    def show(frame: int) -> list[Any]:
        for axes, (name, frames) in zip(rows, walks.items(), strict=True):
            axes.clear()
            i = int(chosen[frame])
            _panel(axes, frames, i, box, scale)
            axes.set_title(f"{name}: {_moment(frames, i)}")
        rows[0].set_xlabel("")
        return []

    per_second = max(1, min(25, round(N_ANIMATED / duration)))
    FuncAnimation(figure, show, frames=len(chosen)).save(path, writer=PillowWriter(fps=per_second))


def _panel(axes: Any, frames: Any, i: int, box: tuple[float, float, float, float], scale: float) -> None:
    """The body from the side, on the ground, with the place where its middle began."""
    from matplotlib.collections import LineCollection

    side = frames.points[i][:, [0, -1]]
    axes.axhspan(box[2], 0.0, color="0.85", linewidth=0)
    axes.axvline(frames.points[0][:, 0].mean(), color="0.6", linewidth=0.8, linestyle=":")
    growth = frames.growth[i]
    is_driven = np.ptp(frames.growth, axis=0) > 0
    lines = side[frames.edges]
    axes.add_collection(LineCollection(lines[~is_driven], colors="0.75", linewidths=0.7))
    driven = LineCollection(lines[is_driven], array=growth[is_driven], cmap=COLOURS, clim=(1 - scale, 1 + scale), linewidths=1.8)
    axes.add_collection(driven)
    axes.plot(*side.T, "o", color="0.25", markersize=2.5)
    axes.set(xlim=box[:2], ylim=box[2:], aspect="equal", xlabel="x (m)", ylabel="height (m)")


def _moment(frames: Any, i: int) -> str:
    """Time and distance in words."""
    return f"{frames.time[i]:.2f} s, {round(float(frames.distance[i]), 2) + 0.0:+.2f} m"


def _colour_bar(figure: Any, axes: list[Any], scale: float) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    colours = ScalarMappable(Normalize(1 - scale, 1 + scale), COLOURS)
    figure.colorbar(colours, ax=axes, shrink=0.8, pad=0.02, aspect=25, label="rest length over that at rest")


def _box(walks: dict[str, Any]) -> tuple[float, float, float, float]:
    """Edges of the drawing [m]: all that is seen in any walk, and some ground."""
    points = np.concatenate([frames.points[..., [0, -1]].reshape(-1, 2) for frames in walks.values()])
    (left, _), (right, top) = points.min(axis=0), points.max(axis=0)
    margin = 0.08 * max(top, 0.5 * (right - left) / 2)
    return left - margin, right + margin, -margin, top + margin


def _scale(walks: dict[str, Any]) -> float:
    """Largest change of a rest length in any walk; 1 where nothing is driven."""
    return max(float(np.abs(frames.growth - 1).max()) for frames in walks.values()) or 1.0


__all__ = ["draw_animation", "draw_learning", "draw_walks"]
