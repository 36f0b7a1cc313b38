"""Where the results of a job go: a folder that appears at the end, whole. Until then there is at most a checkpoint beside it."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import pathlib
import platform
import shutil
from collections.abc import Iterator, Mapping
from typing import Any

import jax

from .._version import __version__
from ..archive import atomic_folder
from .command import REPORT, FailedError, check_replaceable, file_names

CHECKPOINT = "checkpoint.npz"
PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "equinox", "optax", "optimistix", "lineax", "diffrax", "matplotlib", "pillow", "tifffile")


class ResultFolder:
    """The folder of a job's results.

    Attributes:
        out: where it will be.
        checkpoint: a file beside it, for a job that can be taken up; so the folder is never half full.
    """

    def __init__(self, out: pathlib.Path):
        self.out = out
        self.checkpoint = out.absolute().with_name(f"{out.absolute().name}.{CHECKPOINT}")

    def take_up(self) -> None:
        """See that there is a checkpoint to go on from: that of an interrupted run, or the one that a finished run put into its folder.

        Raises:
            OSError: there is none, or it cannot be copied.
        """
        if self.checkpoint.exists():
            return
        finished = self.out / CHECKPOINT
        if not finished.exists():
            raise FileNotFoundError(f"--resume: there is no checkpoint of {self.out}; run without --resume first.")
        shutil.copyfile(finished, self.checkpoint)

    @contextlib.contextmanager
    def filling(self, report: Mapping[str, Any], keep_checkpoint: bool = False, lost: str = "a new run") -> Iterator[pathlib.Path]:
        """A folder beside `out`, for the job to write into. It holds the report, and stands in the place of `out` once the block has ended.

        Args:
            report: what `report.json` holds; no NaN and no infinity. Its `files` are those of the folder: by them a later job knows that
                it may replace them.
            keep_checkpoint: the checkpoint goes into the folder, so that a later run can go on from a finished one; else it is deleted.
            lost: what `--resume` spares where the results could not be written.

        Raises:
            ValueError: the report has an entry `files` of its own.
            FailedError: the folder cannot be written, or holds what no job wrote. What was there before is there still, and so is the
                checkpoint.
        """
        if "files" in report:
            raise ValueError("the report has an entry 'files', which is for the names of the folder's files; rename it.")
        try:
            with atomic_folder(self.out) as folder:
                yield folder
                if keep_checkpoint:
                    shutil.copyfile(self.checkpoint, folder / CHECKPOINT)
                whole = {**report, "files": sorted({REPORT, *file_names(folder)})}
                (folder / REPORT).write_text(json.dumps(whole, indent=2, allow_nan=False) + "\n", encoding="utf-8")
                if self.out.exists():
                    check_replaceable(self.out)
        except OSError as error:
            again = f"; --resume tries again without {lost}." if self.checkpoint.exists() else "."
            raise FailedError(f"the results could not be written ({error}){again}") from error
        self.checkpoint.unlink(missing_ok=True)


def versions() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    found = {"jaxspring": __version__, "python": platform.python_version(), "device": jax.devices()[0].device_kind}
    for package in PACKAGES:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


__all__ = ["ResultFolder", "versions"]
