"""The main job from an image to a folder: fit, measure, and write report, mesh and pictures.

Until the folder is whole there is only a checkpoint beside it, which a later call may go on from; in the end it moves into the folder.
"""

from __future__ import annotations

import hashlib
import math
import pathlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...archive import write_archive
from ...images.files import ImageError
from ...images.image import Image
from ...inverse.checkpoint import Checkpoint
from ...inverse.fit import Iteration
from ...inverse.stopping import StopReason
from ...progress import Stopwatch, draw_bar
from ..command import FailedError, StoppedError, Written
from ..drawing import canvas_and_figure
from ..folder import ResultFolder, versions
from .constants import Constants, ConstantsSettings, fit_constants
from .extras import Extras, fitted_surface, greatest_errors
from .fitting import Reconstructed, SpringSettings, fit_springs
from .pictures import draw_pictures


@dataclass(frozen=True)
class Job:
    """What is to be done.

    Attributes:
        image: the data.
        name: what the image is called in the report.
        nodes: (ny, nx) of the mesh.
        parameters: what is fitted.
        n_iterations: updates of the parameters.
        out: the folder for the results.
        extras: what is done with the fitted mesh besides.
    """

    image: Image
    name: str
    nodes: tuple[int, int]
    parameters: tuple[str, ...]
    n_iterations: int
    out: pathlib.Path
    extras: Extras = Extras()  # noqa: RUF009 (frozen, holds no array)

    def run(self, resume: bool) -> Written:
        """Fit and write.

        Raises:
            ImageError: the image is too small for a surface.
            CheckpointError: the checkpoint is damaged or of another problem.
            OSError: there is no checkpoint to go on from, or none can be written.
            ImportError: what draws the pictures is not installed.
            StoppedError: Ctrl-C; there is a checkpoint to go on from.
            FailedError: the fit failed, or the folder could not be written.
        """
        canvas_and_figure()
        if min(self.image.shape) < 2:
            size = "{} x {}".format(*self.image.shape)
            raise ImageError(f"{self.name}: {size} pixels hold no surface; an image needs 2 x 2 at least.")
        place = ResultFolder(self.out)
        if resume:
            place.take_up()
        clock, bar = Stopwatch(), _Bar(self)
        found = self._fit(bar, self._checkpoint(place.checkpoint), resume)
        done = len(found.fit.history.loss) - 1
        if found.fit.reason is StopReason.INTERRUPTED:
            raise StoppedError(f"{done} iterations")
        status = found.fit.status.then(found.status)
        if not bool(status.is_ok):
            raise FailedError(f"the fit failed after {done} iterations: {status.describe()}.")
        finished = self.extras.make(self.image, found)
        report = {**self._report(found, bar, clock.seconds), **finished.report()}
        with place.filling(report, keep_checkpoint=True, lost="fitting anew") as folder:
            write_archive(folder / "mesh.npz", mesh_arrays(found), {"kind": "mesh"})
            pictures = draw_pictures(folder, self.image, found)
            finished.write(folder, self.image)
        complaint = finished.complaint()
        if complaint is not None:
            raise FailedError(complaint)
        return Written(table(report) + finished.table(), f"report.json, mesh.npz and {len(pictures)} pictures")

    def _fit(self, bar: _Bar, place: Checkpoint, resume: bool) -> Reconstructed:
        if self.parameters == ("stiffness",):
            settings = SpringSettings(nodes=self.nodes, n_iterations=self.n_iterations)
            return fit_springs(self.image, settings, bar, place, resume)
        of_constants = ConstantsSettings(nodes=self.nodes, n_iterations=self.n_iterations)
        return fit_constants(self.image, self.parameters, of_constants, bar, place, resume)

    def _values(self, found: Reconstructed) -> dict[str, dict[str, float]]:
        """What was fitted, before and after: the constants by name, or a summary of all stiffnesses."""
        if self.parameters == ("stiffness",):
            return {"before": summary(found.law_stiffness), "after": summary(found.stiffness)}
        usual = Constants.usual(found.scene)
        return {
            "before": {name: float(getattr(usual, name)) for name in self.parameters},
            "after": {name: float(found.fit.parameters[name]) for name in self.parameters},
        }

    def _checkpoint(self, path: pathlib.Path) -> Checkpoint:
        """Where the fit is saved, and of which problem it is."""
        pixels = np.ascontiguousarray(self.image.values)
        digest = hashlib.sha256(pixels.data)
        if self.image.weights is not None:
            digest.update(np.ascontiguousarray(self.image.weights).data)
        digest = digest.hexdigest()[:16]
        size, nodes = ("{}x{}".format(*pair) for pair in (self.image.shape, self.nodes))
        note = f"image {size} {digest}, nodes {nodes}, {','.join(self.parameters)}"
        return Checkpoint(str(path), every=25, note=note)

    def _report(self, found: Reconstructed, bar: _Bar, seconds: float) -> dict[str, Any]:
        history, values = found.fit.history, np.asarray(self.image.values)
        of_call = history.seconds[bar.first :]
        run = float(np.sum(of_call[1:]))
        compile_ = max(float(of_call[0]) - (run / max(len(of_call) - 1, 1)), 0.0)
        return {
            "image": {"name": self.name, "pixels": list(self.image.shape), "holes": int(self.image.n_holes)},
            "settings": {"nodes": list(self.nodes), "parameters": list(self.parameters), "iterations": self.n_iterations},
            "versions": versions(),
            "rmse": {
                name: {"sampled": errors.sampled, "best": errors.best}
                for name, errors in (("uniform", found.uniform), ("law", found.law.rmse), ("fitted", found.fitted.rmse))
            },
            "greatest_error": greatest_errors(self.image, found),
            "folds": found.fitted.folds,
            "folds_at_worst": max(bar.folds, found.fitted.folds),
            "outside": found.fitted.outside,
            "unreached": 0 if found.fitted.unreached is None else int(found.fitted.unreached.sum()),
            "range": [float(values.min()), float(values.max())],
            "seconds": {"compile": compile_, "run": run, "other": max(seconds - run - compile_, 0.0), "total": seconds},
            "iterations": {"done": len(history.loss) - 1, "best": found.fit.iteration, "ended": found.fit.reason.value},
            "loss": history.loss.tolist(),
            "parameters": self._values(found),
        }


class _Bar:
    """The progress bar, and what has to be seen in every iteration."""

    def __init__(self, job: Job):
        values = np.asarray(job.image.values)
        self.total, self.extent = job.n_iterations, float(values.max() - values.min())
        self.first, self.folds = -1, 0

    def __call__(self, iteration: Iteration) -> None:
        if self.first < 0:
            self.first = iteration.index
        self.folds = max(self.folds, int(iteration.info.n_folds))
        sampled, best = (float(rms) * self.extent for rms in (iteration.info.rms_sampled, iteration.info.rms_best))
        errors = f"rmse {sampled:.4g} sampled, {best:.4g} best"
        draw_bar("fit", min(iteration.index, self.total), self.total, note=errors)


def mesh_arrays(found: Reconstructed) -> dict[str, np.ndarray]:
    """The fitted mesh: `points` (N, 3) with the best heights, `z_sampled` (N,), `triangles` (T, 3), `edges` (E, 2), `stiffness` (E,) [N/m].

    Of an image with weights also `unreached` (N,): nodes whose heights come from their neighbours.

    x and y are in the unit of the image's spacing (pixels for the command), z in that of its values.
    """
    surface = fitted_surface(found)
    unreached = {} if found.fitted.unreached is None else {"unreached": np.ravel(found.fitted.unreached)}
    return {
        "points": surface.points,
        "z_sampled": np.ravel(found.fitted.z_sampled),
        "triangles": surface.triangles,
        "edges": np.asarray(found.scene.net.edges),
        "stiffness": np.asarray(found.stiffness),
        **unreached,
    }


def summary(stiffness: Any) -> dict[str, float]:
    """Smallest, median and largest stiffness [N/m], and how many; all of them are in mesh.npz."""
    k = np.asarray(stiffness, np.float64)
    return {"smallest": float(k.min()), "median": float(np.median(k)), "largest": float(k.max()), "count": int(k.size)}


def table(report: dict[str, Any]) -> str:
    """The errors of the three meshes, and their ratios to the uniform one."""
    rmse = report["rmse"]
    lines = [f"{'rmse':10} {'sampled':>12} {'best':>12}   {'uniform / it':>14}"]
    for name, errors in rmse.items():
        ratios = [rmse["uniform"][rule] / errors[rule] if errors[rule] else math.nan for rule in ("sampled", "best")]
        lines.append(f"{name:10} {errors['sampled']:12.5g} {errors['best']:12.5g}   {ratios[0]:6.2f} {ratios[1]:7.2f}")
    seconds = report["seconds"]
    lines.append(
        f"{report['iterations']['done']} iterations in {seconds['run']:.1f} s, after {seconds['compile']:.1f} s of compiling; "
        f"{report['folds']} folded triangles, {report['outside']} pixels outside the mesh"
    )
    if report["image"]["holes"]:
        total = math.prod(report["image"]["pixels"])
        lines.append(
            f"{report['image']['holes']} of {total} pixels are holes; {report['unreached']} nodes are reached by no datum and take their "
            "heights from their neighbours"
        )
    return "\n".join(lines)
