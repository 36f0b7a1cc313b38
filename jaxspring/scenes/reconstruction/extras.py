"""What `jaxspring fit` does with a fitted mesh on request: break it, bound its greatest error, write it as a TIN.

`--break` and `--max-error` each start from the fitted mesh with its best heights. What is exported is the surface that was asked for last:
the bounded one, else the broken one, else the fitted one.
"""

from __future__ import annotations

import pathlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...archive import write_archive
from ...images.image import Image
from ..drawing import new_figure
from .bounded import BoundedSurface, bound_error
from .break_lines import length_of
from .fitting import Reconstructed
from .given import seen
from .pictures import extent_of
from .pieces import BrokenSurface, break_surface
from .report import uniform_errors
from .tin import Tin
from .tin_files import save_tin
from .triangles import triangle_corners


@dataclass(frozen=True)
class Extras:
    """What is asked for.

    Attributes:
        step: the lowest step that breaks [unit of the image], or None.
        max_error: bound of the greatest error [unit of the image], or None.
        export: endings of the files to be written.
    """

    step: float | None = None
    max_error: float | None = None
    export: tuple[str, ...] = ()

    def make(self, image: Image, found: Reconstructed) -> Finished:
        """The surfaces that are asked for."""
        mesh = fitted_surface(found)
        broken = None if self.step is None else break_surface(image, mesh.points, mesh.triangles, self.step)
        bounded = None if self.max_error is None else bound_error(image, mesh.points, mesh.triangles, self.max_error)
        return Finished(self, mesh, broken, bounded)


@dataclass(frozen=True)
class Finished:
    """What was made.

    Attributes:
        asked: for what.
        mesh: the fitted surface.
        broken: with breaks, or None.
        bounded: with its error bounded, or None.
    """

    asked: Extras
    mesh: Tin
    broken: BrokenSurface | None
    bounded: BoundedSurface | None

    def report(self) -> dict[str, Any]:
        """Entries of `report.json`."""
        found: dict[str, Any] = {}
        if self.broken is not None:
            breaks = self.broken.breaks
            found["breaks"] = {
                "step": self.asked.step,
                "springs": breaks.n_broken,
                "lines": len(breaks.lines),
                "length": length_of(breaks.lines),
                "steepest": breaks.steepest,
                "rmse": self.broken.rmse,
                "greatest_error": self.broken.greatest,
            }
        if self.bounded is not None:
            found["max_error"] = {
                "bound": self.asked.max_error,
                "holds": self.bounded.holds,
                "greatest_error": self.bounded.greatest,
                "rmse": self.bounded.rmse,
                "nodes": len(self.bounded.tin.points),
                "triangles": len(self.bounded.tin.triangles),
                "worst_pixel": list(self.bounded.worst),
            }
        return found

    def write(self, folder: pathlib.Path, image: Image) -> None:
        """Files and pictures."""
        tin, lines = self.mesh, ()
        if self.broken is not None:
            tin, breaks = self.broken.tin, self.broken.breaks
            lines = breaks.lines
            joined = np.concatenate([*lines, np.zeros((0, 2))])
            ends = np.cumsum([len(line) for line in lines]).astype(np.int64)
            arrays = {"broken": np.asarray(breaks.net.edges)[breaks.broken], "line_points": joined, "line_ends": ends}
            write_archive(folder / "breaks.npz", {**arrays, "points": tin.points, "triangles": tin.triangles}, {"kind": "breaks"})
            draw_breaks(folder / "breaks.png", image, self.broken)
        if self.bounded is not None:
            tin = self.bounded.tin
        for ending in self.asked.export:
            save_tin(folder / f"tin.{ending}", tin, lines)

    def table(self) -> str:
        """Lines for the terminal, each after a line break."""
        text = ""
        if self.broken is not None:
            broken, n_lines = self.broken, len(self.broken.breaks.lines)
            text += f"\n{broken.breaks.n_broken} springs broken along {n_lines} lines: "
            text += f"rmse {broken.rmse:.5g}, greatest error {broken.greatest:.5g}"
        if self.bounded is not None:
            text += f"\n{len(self.bounded.tin.points)} nodes hold the greatest error at {self.bounded.greatest:.5g}"
        return text

    def complaint(self) -> str | None:
        """Why the bound does not hold, or None."""
        found = self.bounded
        if found is None or found.holds:
            return None
        row, column = found.worst
        return (
            f"--max-error {self.asked.max_error:g} cannot be held with as many nodes as pixels: with {len(found.tin.points)} nodes the "
            f"greatest error is {found.greatest:g}, at pixel ({row}, {column}). The folder is written, with that surface; raise the bound."
        )


def fitted_surface(found: Reconstructed) -> Tin:
    """The fitted mesh with its best heights, its chosen diagonals as triangles."""
    mesh = found.fitted
    points = np.stack([np.ravel(a) for a in (mesh.x, mesh.y, mesh.z_best)], axis=-1).astype(np.float64)
    return Tin(points, triangle_corners(mesh.flip))


def greatest_errors(image: Image, found: Reconstructed) -> dict[str, dict[str, float]]:
    """The largest error of each mesh over all pixels, under both rules, in the image's unit."""
    truth = seen(image)
    drawn = {
        "uniform": uniform_errors(found.scene)[1:],
        "law": (found.law.image_sampled, found.law.image_best),
        "fitted": (found.fitted.image_sampled, found.fitted.image_best),
    }
    return {
        name: {rule: float(np.nanmax(np.abs(surface - truth))) for rule, surface in zip(("sampled", "best"), pair, strict=True)}
        for name, pair in drawn.items()
    }


def draw_breaks(path: pathlib.Path, image: Image, found: BrokenSurface) -> None:
    """The break lines over the image, and what is left of the error in one piece and broken, on one scale."""
    values = seen(image)
    extent = left, right, bottom, top = extent_of(image)
    whole = found.unbroken.drawn(image) - values
    limit = float(np.nanpercentile(np.abs(whole), 99)) or 1.0
    figure = new_figure(15, 5 * min(max((bottom - top) / (right - left), 0.3), 2.0) + 0.7, 110, "compressed")
    axes = figure.subplots(1, 3)
    axes[0].imshow(values, cmap="gray", extent=extent)
    for line in found.breaks.lines:
        axes[0].plot(*line.T, color="tab:red", linewidth=1.2)
    axes[0].set_title(f"{found.breaks.n_broken} broken springs")
    for panel, error, name in ((axes[1], whole, "in one piece"), (axes[2], found.drawn - values, "broken")):
        shown = panel.imshow(error, cmap="RdBu_r", extent=extent, vmin=-limit, vmax=limit)
        panel.set_title(f"error {name}: rmse {np.sqrt(np.nanmean(error**2)):.4g}")
    figure.colorbar(shown, ax=axes, label="surface minus image", fraction=0.03, pad=0.01)
    figure.savefig(path, metadata={"Software": None})


__all__ = ["Extras", "Finished", "fitted_surface", "greatest_errors"]
