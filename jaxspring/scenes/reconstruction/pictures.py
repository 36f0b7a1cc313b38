"""Pictures of a reconstruction: the image with both meshes, what they recover, where they err, and how the loss fell.

Needs the extra `viz`.
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from ...images.image import Image
from ..drawing import canvas_and_figure
from .fitting import Reconstructed
from .given import pixel_weights, seen, weighted_rms
from .report import uniform_errors
from .triangles import triangle_corners

DPI = 130


def draw_pictures(folder: pathlib.Path, image: Image, found: Reconstructed) -> tuple[str, ...]:
    """Write the pictures into a folder; returns their names.

    Raises:
        ImportError: matplotlib is not installed.
    """
    canvas, figure_of = canvas_and_figure()
    values = seen(image)
    left, right, bottom, top = extent_of(image)
    width = min(6.0, 4.5 * max((right - left) / (bottom - top), 0.5))
    height = max(width * (bottom - top) / (right - left), 1.0) + 0.7  # inches, with title and labels
    uniform_sampled, uniform_best = uniform_errors(found.scene)[1:]
    surfaces = {
        "uniform mesh": (uniform_sampled, uniform_best),
        "start of the fit": (found.law.image_sampled, found.law.image_best),
        "fitted mesh": (found.fitted.image_sampled, found.fitted.image_best),
    }

    def figure(width: float, height: float) -> Any:
        # "compressed" keeps panels of a fixed aspect, and their colour bar, together.
        return figure_of((width, height), DPI, layout="compressed")

    drawings = {
        "meshes.png": lambda: _meshes(figure(3 * width, height), image, values, found),
        "reconstructions.png": lambda: _reconstructions(figure(4 * width + 1, height), image, values, surfaces),
        "errors.png": lambda: _errors(figure(3 * width + 1, 2 * height), image, values, surfaces),
        "loss.png": lambda: _loss(figure_of((7, 4), DPI, layout="constrained"), found),
    }
    for name, draw in drawings.items():
        drawn = draw()
        canvas(drawn)
        drawn.savefig(folder / name, metadata={"Software": None})
    return tuple(drawings)


def extent_of(image: Image) -> tuple[float, float, float, float]:
    """Outer edges of the outermost pixels, for rows that run down."""
    (ny, nx), (sx, sy), (ox, oy) = image.shape, map(float, image.spacing), map(float, image.origin)
    return (ox - sx / 2, ox + (nx - 0.5) * sx, oy + (ny - 0.5) * sy, oy - sy / 2)


def _label(axes: Any, image: Image) -> None:
    # Where nobody gave a spacing, the unit is the pixel.
    unit = "pixels" if all(float(spacing) == 1 for spacing in image.spacing) else "m"
    axes.set(xlabel=f"x ({unit})", ylabel=f"y ({unit})")
    axes.label_outer()


def _meshes(figure: Any, image: Image, values: np.ndarray, found: Reconstructed) -> Any:
    x, y = (np.asarray(a) for a in found.scene.rest)
    straight = np.zeros_like(found.fitted.flip)
    panels = (("image", None), ("uniform mesh", (x, y, straight)), ("fitted mesh", (found.fitted.x, found.fitted.y, found.fitted.flip)))
    for axes, (title, mesh) in zip(figure.subplots(1, 3), panels, strict=True):
        axes.imshow(values, cmap="gray", extent=extent_of(image))
        if mesh is not None:
            axes.triplot(np.ravel(mesh[0]), np.ravel(mesh[1]), triangle_corners(mesh[2]), color="tab:orange", linewidth=0.35)
        axes.set_title(title)
        _label(axes, image)
    return figure


def _reconstructions(figure: Any, image: Image, values: np.ndarray, surfaces: dict[str, tuple[np.ndarray, np.ndarray]]) -> Any:
    panels = [("image", values), *((f"{name}, best heights", best) for name, (_, best) in surfaces.items())]
    for axes, (title, picture) in zip(figure.subplots(1, 4), panels, strict=True):
        axes.imshow(picture, cmap="gray", extent=extent_of(image), vmin=np.nanmin(values), vmax=np.nanmax(values))
        axes.set_title(title)
        _label(axes, image)
    figure.colorbar(figure.axes[0].images[0], ax=figure.axes, label="value of the image", fraction=0.03, pad=0.01)
    return figure


def _errors(figure: Any, image: Image, values: np.ndarray, surfaces: dict[str, tuple[np.ndarray, np.ndarray]]) -> Any:
    """Signed errors under both rules, all on one scale: the 99th percentile of the uniform mesh's."""
    limit = float(np.nanpercentile(np.abs(surfaces["uniform mesh"][0] - values), 99)) or 1.0
    rows = figure.subplots(2, 3)
    for rule, (row, label) in enumerate(zip(rows, ("sampled", "best"), strict=True)):
        for axes, (name, pair) in zip(row, surfaces.items(), strict=True):
            error = pair[rule] - values
            axes.imshow(error, cmap="RdBu_r", extent=extent_of(image), vmin=-limit, vmax=limit)
            axes.set_title(f"{name}, {label} heights: rmse {weighted_rms(error, pixel_weights(image)):.4g}")
            _label(axes, image)
    figure.colorbar(figure.axes[0].images[0], ax=figure.axes, label="surface minus image", fraction=0.03, pad=0.01)
    return figure


def _loss(figure: Any, found: Reconstructed) -> Any:
    axes = figure.subplots()
    axes.plot(found.fit.history.loss, color="tab:blue")
    axes.axvline(found.fit.iteration, color="tab:orange", linewidth=0.8, label=f"lowest, iteration {found.fit.iteration}")
    axes.set_xlabel("iteration")
    axes.set_ylabel("loss (log of the error)")
    axes.legend()
    return figure
