"""When a fit ends."""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence

import equinox as eqx


class StopReason(enum.Enum):
    """Why a fit ended."""

    ITERATIONS = "all iterations were done"
    GRADIENT = "the gradient norm fell below its limit"
    DECREASE = "the loss fell too little over the window"
    TARGET = "the target loss was reached"
    SECONDS = "the time was up"
    CONVERGED = "the optimiser saw no further progress"
    CALLBACK = "on_iteration asked for it"
    FAILED = "the loss, its gradient or a parameter became unusable"
    INTERRUPTED = "it was interrupted"


class Stop(eqx.Module):
    """Rules that end a fit before its last iteration; None leaves a rule out.

    Attributes:
        gradient_norm: stop at or below this Euclidean norm, in unconstrained coordinates.
        relative_decrease: stop where the best loss fell by less than this fraction over the last `window` iterations.
        window: iterations that `relative_decrease` looks back.
        target: stop at or below this loss.
        seconds: stop after this long, the compilation included [s].
    """

    gradient_norm: float | None = eqx.field(static=True, default=None)
    relative_decrease: float | None = eqx.field(static=True, default=None)
    window: int = eqx.field(static=True, default=20)
    target: float | None = eqx.field(static=True, default=None)
    seconds: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        for name in ("gradient_norm", "relative_decrease", "seconds"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"{name} = {value}; expected zero or more, or None.")
        if self.window < 1:
            raise ValueError(f"window = {self.window}; expected 1 or more iterations.")

    def reason(self, losses: Sequence[float], gradient_norm: float, seconds: float) -> StopReason | None:
        """Why to stop after these losses, or None to go on."""
        if self.target is not None and losses[-1] <= self.target:
            return StopReason.TARGET
        if self.gradient_norm is not None and gradient_norm <= self.gradient_norm:
            return StopReason.GRADIENT
        if self.relative_decrease is not None and len(losses) > self.window:
            before, now = min(losses[: -self.window]), min(losses)
            if math.isfinite(before) and before - now < self.relative_decrease * abs(before):
                return StopReason.DECREASE
        if self.seconds is not None and seconds >= self.seconds:
            return StopReason.SECONDS
        return None
