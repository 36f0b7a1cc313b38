"""Pictures of the melting block: six frames side by side, and an animation, coloured by temperature."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from .scene import MeltSettings

DPI = 110
N_PANELS = 6


def draw_strip(path: pathlib.Path, frames: Any, settings: MeltSettings) -> None:
    """Six frames, evenly spaced in time.

    Raises:
        ImportError: matplotlib is not installed.
    """
    canvas, figure_of = _matplotlib()
    figure = figure_of((13, 8), DPI, layout="constrained")
    canvas(figure)
    chosen = np.linspace(0, len(frames.time) - 1, N_PANELS).round().astype(int)
    axes = [figure.add_subplot(2, 3, i + 1, projection="3d") for i in range(N_PANELS)]
    dots = [_panel(a, frames, int(i), settings) for a, i in zip(axes, chosen, strict=True)]
    figure.colorbar(dots[0], ax=axes, shrink=0.7, label="temperature (K)")
    figure.savefig(path, metadata={"Software": None})


def draw_animation(path: pathlib.Path, frames: Any, settings: MeltSettings) -> None:
    """All frames as an animated GIF, 12 a second.

    Raises:
        ImportError: matplotlib or pillow is not installed.
    """
    canvas, figure_of = _matplotlib()
    from matplotlib.animation import FuncAnimation, PillowWriter

    figure = figure_of((6, 5), 80)
    canvas(figure)
    axes = figure.add_subplot(projection="3d")
    dots = _panel(axes, frames, 0, settings)
    figure.colorbar(dots, ax=axes, shrink=0.7, pad=0.12, label="temperature (K)")

    def show(i: int) -> list[Any]:
        axes.clear()
        return [_panel(axes, frames, i, settings)]

    FuncAnimation(figure, show, frames=len(frames.time)).save(path, writer=PillowWriter(fps=12))


def _panel(axes: Any, frames: Any, i: int, settings: MeltSettings) -> Any:
    centimetres = 100 * frames.points
    x, y, z = centimetres[i].T
    dots = axes.scatter(
        x, y, z, c=frames.temperatures[i], cmap="inferno", vmin=settings.start, vmax=settings.plate, s=60, edgecolors="0.3", linewidths=0.2,
        depthshade=False,
    )  # fmt: skip
    half = float(np.percentile(np.abs(centimetres[..., :2]), 99.5)) * 1.05
    top = float(centimetres[..., 2].max())
    axes.set(xlim=(-half, half), ylim=(-half, half), zlim=(0, top), xlabel="x (cm)", ylabel="y (cm)", zlabel="z (cm)")
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=4)
    axes.zaxis.labelpad = -1
    axes.patch.set_alpha(0)  # else the next panel hides the label of z
    axes.set_box_aspect((1, 1, top / (2 * half)))
    axes.view_init(elev=14, azim=-60)
    axes.set_title(f"t = {frames.time[i]:.2f} s, {100 * frames.melted[i]:.0f} % molten")
    return dots


def _matplotlib() -> tuple[Any, Any]:
    try:
        # Not pyplot: it would choose a window system, and keep every figure.
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ImportError("Pictures need matplotlib: pip install jaxspring[viz]") from error
    return FigureCanvasAgg, Figure


__all__ = ["draw_animation", "draw_strip"]
