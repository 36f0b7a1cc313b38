"""Pictures of the melting block: six frames side by side, and an animation. Particles by temperature, springs that hold, the plate."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..drawing import new_figure
from .scene import MeltSettings

DPI = 110
N_PANELS = 6


def draw_strip(path: pathlib.Path, frames: Any, settings: MeltSettings) -> None:
    """Six frames, evenly spaced in time, with a line that says what is drawn.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure(13, 7.2, DPI)
    chosen = np.linspace(0, len(frames.time) - 1, N_PANELS).round().astype(int)
    axes = [figure.add_subplot(2, 3, i + 1, projection="3d") for i in range(N_PANELS)]
    dots = [_panel(a, frames, int(i), settings) for a, i in zip(axes, chosen, strict=True)]
    figure.colorbar(dots[0], ax=axes, shrink=0.8, pad=0.03, aspect=30, label="temperature (K)")
    figure.suptitle(f"Block on a plate of {settings.plate:g} K. Dots: particles. Lines: springs that hold. Molten: no spring holds it.")
    figure.savefig(path, metadata={"Software": None})


def draw_animation(path: pathlib.Path, frames: Any, settings: MeltSettings) -> None:
    """All frames as an animated GIF, 12 a second.

    Raises:
        ImportError: matplotlib or pillow is not installed.
    """
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure = new_figure(6, 5, 80, layout=None)
    axes = figure.add_subplot(projection="3d")
    dots = _panel(axes, frames, 0, settings)
    figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.12, label="temperature (K)")

    def show(i: int) -> list[Any]:
        axes.clear()
        return [_panel(axes, frames, i, settings)]

    FuncAnimation(figure, show, frames=len(frames.time)).save(path, writer=PillowWriter(fps=12))


def _panel(axes: Any, frames: Any, i: int, settings: MeltSettings) -> Any:
    from matplotlib import colormaps
    from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

    centimetres = 100 * frames.points
    x, y, z = centimetres[i].T
    half = float(np.percentile(np.abs(centimetres[..., :2]), 99.5)) * 1.05
    top = float(centimetres[..., 2].max())
    axes.computed_zorder = False  # the plate is below all, whatever matplotlib guesses
    corners = [(-half, -half, 0.0), (half, -half, 0.0), (half, half, 0.0), (-half, half, 0.0)]
    axes.add_collection3d(Poly3DCollection([corners], facecolor=colormaps["inferno"](1.0), edgecolor="0.4", alpha=0.6, zorder=1))
    springs = centimetres[i][frames.edges[frames.alive[i]]]
    if len(springs):
        axes.add_collection3d(Line3DCollection(springs, colors="0.5", linewidths=0.5, zorder=2))
    dots = axes.scatter(
        x, y, z, c=frames.temperatures[i], cmap="inferno", vmin=settings.start, vmax=settings.plate, s=36, edgecolors="0.3", linewidths=0.2,
        depthshade=False, zorder=3,
    )  # fmt: skip
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(0, top), xlabel="x (cm)", ylabel="y (cm)", zlabel="z (cm)")
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=4)
    axes.zaxis.labelpad = -1
    axes.patch.set_alpha(0)  # else the next panel hides the label of z
    axes.set_box_aspect((1, 1, top / (2 * half)), zoom=1.1)
    axes.view_init(elev=14, azim=-60)
    axes.set_title(f"t = {frames.time[i]:.2f} s, {100 * frames.melted[i]:.0f} % molten", y=0.98)
    return dots


__all__ = ["draw_animation", "draw_strip"]
