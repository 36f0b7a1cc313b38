"""A run in parts of equal numbers of frames, which can be kept and taken up.

Every part starts from the state alone, so that a run that was taken up goes through the very same programs as an unbroken one.
"""

from __future__ import annotations

import json
import math
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from ..archive import read_archive, write_archive
from ..files import FORM, expect_same, named_arrays, restored
from ..progress import Progress
from ..rollouts import rollout
from ..state import State
from ..status import Status
from ..steppers.base import Stepper
from ..system import System
from .command import FailedError, StoppedError, Written
from .folder import ResultFolder

FRAMES = 60


class PartedRun:
    """A run of a scene for some time, seen in at most `FRAMES` frames.

    Attributes:
        state: where the run is.
        frames: what was seen until now, the start included: what `look` gives, each with an axis of frames.
        status: of all parts.
        effects: names for the status.
        done_before: frames that an earlier call has done.
        n_frames, every, dt: frames besides the start, steps between them, and the step, such that equal frames fill the duration [s].
    """

    def __init__(self, system: System, state: State, stepper: Stepper, n_steps: int, duration: float, look: Any, about: dict[str, Any]):
        """From the start; `about` names the scene, for what is kept."""
        self.system, self.stepper, self.look = system, stepper, look
        self.n_frames, self.every = min(FRAMES, n_steps), math.ceil(n_steps / FRAMES)
        self.dt = duration / (self.every * self.n_frames)
        self.per_part = 3 if self.n_frames == FRAMES else 1
        self.state = system.bind(state.dtype).begin(state)
        self.status, self.effects, self.done_before = Status.ok(), (), 0
        self.frames = jax.tree.map(lambda a: np.asarray(a)[None], look(self.state))
        self._about = {"form": FORM, "dtype": str(state.dtype), **json.loads(json.dumps(about))}

    @property
    def done(self) -> int:
        """Frames done, besides the start."""
        return len(jax.tree.leaves(self.frames)[0]) - 1

    def go_on(self, progress: Progress | None = None, keep: pathlib.Path | None = None) -> None:
        """To the end, or to the first trouble; what was done is kept in a file after every part."""
        n_steps = self.every * self.per_part
        while self.done < self.n_frames and bool(self.status.is_ok):
            part = rollout(self.system, self.state, self.stepper, self.dt, n_steps, save_every=self.every, observe=self.look)
            self.frames = jax.tree.map(lambda a, b: np.concatenate([a, np.asarray(b)]), self.frames, part.saved)
            self.state, self.status, self.effects = part.state, self.status.then(part.status), part.effects
            if keep is not None and bool(self.status.is_ok):
                self._write(keep)
            if progress is not None:
                progress.update(self.done, self.n_frames)

    def complete(
        self, out: pathlib.Path, finish: Callable[[ResultFolder], Written], progress: Progress | None = None, resume: bool = False
    ) -> Written:
        """To the end, and what `finish` writes; or on from where an earlier call was interrupted.

        Raises:
            OSError: there is no checkpoint to go on from, or none can be written.
            CheckpointError: the checkpoint is damaged or of other settings.
            StoppedError: Ctrl-C; there is a checkpoint to go on from.
            FailedError: the run failed.
        """
        place = ResultFolder(out)
        if resume:
            place.take_up()
            self.read(place.checkpoint)
        self.done_before = self.done
        try:
            self.go_on(progress, place.checkpoint)
            if not bool(self.status.is_ok):
                raise FailedError(f"the run failed: {self.status.describe(self.effects)}.")
            return finish(place)
        except KeyboardInterrupt:
            if self.done == 0:
                raise
            raise StoppedError(f"{self.done} frames") from None

    def _write(self, path: pathlib.Path) -> None:
        arrays = {f"state/{name}": array for name, array in named_arrays(self.state).items()}
        arrays |= {f"frames/{i}": array for i, array in enumerate(jax.tree.leaves(self.frames))}
        write_archive(path, arrays, self._about)

    def read(self, path: pathlib.Path) -> None:
        """Take up what an earlier run kept.

        Raises:
            CheckpointError: the file is damaged, or of other settings.
            OSError: there is no such file.
        """
        archive = read_archive(path)
        expect_same(path, "problem", archive.about, self._about)
        of_state = {name.partition("/")[2]: array for name, array in archive.arrays.items() if name.startswith("state/")}
        self.state = restored(path, of_state, self.state)
        leaves, tree = jax.tree.flatten(self.frames)
        self.frames = jax.tree.unflatten(tree, [archive.arrays[f"frames/{i}"] for i in range(len(leaves))])


__all__ = ["FRAMES", "PartedRun"]
