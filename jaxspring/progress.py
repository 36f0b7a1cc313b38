"""A progress bar and host callbacks for long runs, and runs that can be interrupted.

An eager run is cut into chunks that share one compiled program; between chunks the host shows the bar, calls the user's callback and
lets Ctrl-C through. Inside `jit` or `grad` the same reports come from the device, between blocks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import SupportsInt, TextIO

import equinox as eqx

N_CHUNKS = 20
LONG_RUN = 80_000_000  # node-steps, a second on a CPU: Ctrl-C waits for no more


class Progress(eqx.Module):
    """What to tell the host during a run.

    Attributes:
        label: text before the bar.
        callback: called as callback(steps_done, n_steps) after every chunk; None calls nothing.
        stream: where the bar is drawn (None: standard error). A stream that is no terminal gets one line at the end.
        bar: whether to draw the bar.
    """

    label: str = eqx.field(static=True, default="rollout")
    callback: Callable[[int, int], None] | None = eqx.field(static=True, default=None)
    stream: TextIO | None = eqx.field(static=True, default=None)
    bar: bool = eqx.field(static=True, default=True)

    def update(self, done: SupportsInt, total: int) -> None:
        """Draw the bar and call the callback; for the host."""
        done = int(done)
        if self.bar:
            draw_bar(self.label, done, total, stream=self.stream)
        if self.callback is not None:
            self.callback(done, total)


def draw_bar(label: str, done: int, total: int, note: str = "", stream: TextIO | None = None, width: int = 30) -> None:
    """One line `label [#####     ]  50 %  note`, drawn over itself on a terminal; elsewhere only the last line is written."""
    out = sys.stderr if stream is None else stream
    filled = width if total <= 0 else width * done // total
    percent = 100 if total <= 0 else 100 * done // total
    line = f"{label} [{'#' * filled}{' ' * (width - filled)}] {percent:3d} %  {note}"
    is_last = done >= total
    if out.isatty():
        out.write("\r" + line.ljust(79) + ("\n" if is_last else ""))
        out.flush()
    elif is_last:
        out.write(line.rstrip() + "\n")


class Stopwatch:
    """Seconds since it was made."""

    def __init__(self) -> None:
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Elapsed time [s]."""
        return time.perf_counter() - self._start
