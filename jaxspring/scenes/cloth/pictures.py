"""Pictures of a cloth: shaded surfaces, coloured by strain: six moments side by side, the last one large, and an animation.

Each triangle's shade is the cosine between its normal and a light from above, the same on both sides.
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..drawing import new_figure

DPI = 110
N_PANELS = 6
LIGHT = np.array([0.35, -0.45, 0.82])
COLOURS = "YlOrRd"


def draw_strip(path: pathlib.Path, frames: Any, title: str) -> None:
    """Six moments, evenly spaced in time.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(13, 8.4, DPI)
    chosen = np.linspace(0, len(frames.time) - 1, N_PANELS).round().astype(int)
    axes = [figure.add_subplot(2, 3, i + 1, projection="3d") for i in range(N_PANELS)]
    for a, i in zip(axes, chosen, strict=True):
        _panel(a, frames, int(i))
    _colour_bar(figure, axes, frames)
    figure.suptitle(title)
    figure.savefig(path, metadata={"Software": None})


def draw_last(path: pathlib.Path, frames: Any, title: str) -> None:
    """The last moment, large.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(7.5, 6, DPI)
    axes = figure.add_subplot(projection="3d")
    _panel(axes, frames, len(frames.time) - 1)
    _colour_bar(figure, [axes], frames)
    figure.suptitle(title)
    figure.savefig(path, metadata={"Software": None})


def draw_energy(path: pathlib.Path, frames: Any) -> None:
    """Energies over time.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(7, 4, DPI)
    axes = figure.add_subplot()
    for name, values in frames.energy.items():
        axes.plot(frames.time, 1e3 * values, label=name)
    axes.plot(frames.time, 1e3 * sum(frames.energy.values()), color="0.2", linestyle="--", label="sum")
    axes.set(xlabel="time (s)", ylabel="energy (mJ)", title="Energies: of the height from the start's, the others from rest")
    axes.legend()
    figure.savefig(path, metadata={"Software": None})


def draw_animation(path: pathlib.Path, frames: Any) -> None:
    """All frames as an animated GIF, at the pace of simulated time or slower.

    Raises:
        ImportError: matplotlib or pillow is not installed.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure = new_figure(6, 5, 80, layout=None)
    axes = figure.add_subplot(projection="3d")

    def show(i: int) -> list[Any]:
        axes.clear()
        _panel(axes, frames, i)
        return []

    pace = (len(frames.time) - 1) / float(frames.time[-1])
    FuncAnimation(figure, show, frames=len(frames.time)).save(path, writer=PillowWriter(fps=min(25, max(1, round(pace)))))


def _panel(axes: Any, frames: Any, i: int) -> None:
    """One moment."""
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    centimetres = 100 * frames.points
    surface = centimetres[i][frames.triangles]
    shown = np.clip(frames.strain[i] / _largest(frames), 0, 1)
    colours = colormaps[COLOURS](shown)
    colours[:, :3] *= _shades(surface)[:, None]
    axes.computed_zorder = False
    if len(frames.obstacle):
        solid = 100 * frames.obstacle
        grey = np.full((len(solid), 4), 1.0)
        grey[:, :3] = 0.75 * _shades(solid)[:, None]
        # All faces in one collection: matplotlib sorts by depth within one alone.
        surface, colours = np.concatenate([surface, solid]), np.concatenate([colours, grey])
    axes.add_collection3d(Poly3DCollection(surface, facecolors=colours, edgecolors="none", antialiased=False))
    low, high = centimetres.reshape(-1, 3).min(axis=0), centimetres.reshape(-1, 3).max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 0.1 * np.max(high - low))
    limits = {f"{name}lim": (m - h, m + h) for name, m, h in zip("xyz", middle, half, strict=True)}
    axes.set(**limits, xlabel="x (cm)", ylabel="y (cm)", zlabel="z (cm)")
    for name in "xyz":
        axes.locator_params(axis=name, nbins=4)
    axes.set_box_aspect(half / half.max(), zoom=0.85)
    axes.view_init(elev=22, azim=-60)
    axes.set_title(f"t = {frames.time[i]:.2f} s", y=0.98)


def _shades(corners: np.ndarray) -> np.ndarray:
    """Brightness of triangles (T, 3, 3), from 0.35 to 1."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    cosine = np.abs(normals @ LIGHT) / np.where(lengths > 0, lengths, 1)
    return 0.35 + 0.65 * cosine


def _largest(frames: Any) -> float:
    """Strain at the end of the scale: that of all but a hundredth of the triangles."""
    return max(float(np.percentile(frames.strain, 99)), 1e-4)


def _colour_bar(figure: Any, axes: list[Any], frames: Any) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(0, 100 * _largest(frames)), COLOURS)
    figure.colorbar(scale, ax=axes, shrink=0.7, pad=0.04, aspect=30, extend="max", label="largest strain of a triangle's springs (%)")


__all__ = ["draw_animation", "draw_energy", "draw_last", "draw_strip"]
