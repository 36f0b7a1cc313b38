"""Pictures of a lens: the image before and after, the mesh on both, the magnification that was wanted and achieved, and the ramp.

Needs the extra `viz`.
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ..drawing import new_figure
from ..reconstruction.triangles import triangle_corners
from .search import turned
from .warp import Warp

DPI = 110
COLOURS = "PuOr_r"


def eight_bits(channels: np.ndarray, of: np.ndarray) -> np.ndarray:
    """Channels (1 or 3, ny, nx) as pixels (ny, nx) or (ny, nx, 3) of 8 bits; black and white are those of the image `of`."""
    low, high = float(of.min()), float(of.max())
    if low >= 0 and high <= 255 and high > 1:
        low, high = 0.0, 255.0
    pixels = np.moveaxis(np.asarray(channels, float), 0, -1)
    pixels = np.clip(255 * (pixels - low) / (high - low if high > low else 1.0), 0, 255).round().astype(np.uint8)
    return pixels[..., 0] if pixels.shape[-1] == 1 else pixels


def save_pixels(path: pathlib.Path, pixels: np.ndarray) -> None:
    """A picture of the very pixels.

    Raises:
        ImportError: Pillow is not installed.
    """
    import PIL.Image

    PIL.Image.fromarray(pixels).save(path)


def draw_mesh(path: pathlib.Path, before: np.ndarray, after: np.ndarray, warp: Warp) -> None:
    """Both images with the mesh over them.

    Raises:
        ImportError: matplotlib is not installed.
    """
    ny, nx = warp.shape
    figure = new_figure(12, 5.6 * min(max(ny / nx, 0.4), 1.6) + 0.7, DPI, layout="compressed")
    triangles = triangle_nodes(warp)
    meshes = ((warp.mesh.x, warp.mesh.y), tuple(warp.position))
    for axes, pixels, (x, y), title in zip(figure.subplots(1, 2), (before, after), meshes, ("before", "after"), strict=True):
        axes.imshow(pixels, cmap="gray", vmin=0, vmax=255)
        axes.triplot(np.ravel(x), np.ravel(y), triangles, color="tab:orange", linewidth=0.4)
        axes.set(title=title, xlabel="x (pixels)", ylabel="y (pixels)", xlim=(-0.5, nx - 0.5), ylim=(ny - 0.5, -0.5))
    figure.savefig(path, metadata={"Software": None})


def draw_magnification(path: pathlib.Path, warp: Warp) -> None:
    """What was wanted of each cell and what it has, where the cells are shown; and how far shapes are stretched.

    Raises:
        ImportError: matplotlib is not installed.
    """
    ny, nx = warp.shape
    figure = new_figure(15, 4.4 * min(max(ny / nx, 0.4), 1.6) + 0.7, DPI, layout="compressed")
    panels = figure.subplots(1, 3)
    wanted, achieved = np.log2(np.asarray(warp.wanted)), np.log2(np.asarray(warp.magnification))
    limit = max(np.abs(wanted).max(), np.abs(achieved).max(), 0.1)
    _cells(panels[0], warp, wanted, cmap=COLOURS, vmin=-limit, vmax=limit)
    drawn = _cells(panels[1], warp, achieved, cmap=COLOURS, vmin=-limit, vmax=limit)
    panels[0].set_title("magnification, wanted (1: what is left)")
    panels[1].set_title("magnification, achieved")
    ticks = np.linspace(-limit, limit, 7)
    bar = figure.colorbar(drawn, ax=list(panels[:2]), label="linear magnification", fraction=0.04, pad=0.01, ticks=ticks)
    bar.ax.set_yticklabels([f"{2**tick:.2f}" for tick in ticks])
    drawn = _cells(panels[2], warp, np.asarray(warp.anisotropy).max(axis=0), cmap="magma", vmin=1)
    panels[2].set_title("larger over smaller stretch")
    figure.colorbar(drawn, ax=panels[2], label="anisotropy", fraction=0.04, pad=0.01)
    figure.savefig(path, metadata={"Software": None})


def draw_animation(path: pathlib.Path, frames: list[np.ndarray]) -> None:
    """The ramp, forth and back, as an animated GIF.

    Raises:
        ImportError: Pillow is not installed.
    """
    import PIL.Image

    series = [PIL.Image.fromarray(frame) for frame in (*frames, *frames[-2:0:-1])]
    series[0].save(path, save_all=True, append_images=series[1:], duration=80, loop=0)


def triangle_nodes(warp: Warp) -> np.ndarray:
    """(T, 3) node numbers of the triangles."""
    return triangle_corners(turned(warp.mesh.cells))


def _cells(axes: Any, warp: Warp, values: np.ndarray, cmap: str, vmin: float, vmax: float | None = None) -> Any:
    """Cells in colour, where they are shown."""
    x, y = (np.asarray(a) for a in warp.position)
    drawn = axes.pcolormesh(x, y, values, cmap=cmap, vmin=vmin, vmax=vmax, shading="flat")
    axes.set(aspect="equal", xlabel="x (pixels)", ylabel="y (pixels)")
    axes.invert_yaxis()
    return drawn


__all__ = ["draw_animation", "draw_magnification", "draw_mesh", "eight_bits", "save_pixels", "triangle_nodes"]
