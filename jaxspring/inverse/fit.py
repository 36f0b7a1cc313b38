"""Fitting parameters to a loss by gradients.

One iteration is one compiled program: the loss, its gradient, the optimiser's update, and the checks. The host between two iterations
keeps the best, writes history and checkpoints, and decides whether to stop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from .. import printing
from .._arrays import own
from ..numerics import is_traced
from ..progress import Progress, Stopwatch
from ..status import Flag, Status
from .checkpoint import Checkpoint, Snapshot, expect_same_loss, read_checkpoint, write_checkpoint
from .determined import Undetermined, from_jacobian, from_zeros, slopes
from .explain import Seen, explanation
from .fingerprint import fingerprint
from .iteration import Objective, Report, first_memory, iterate, prepare, refuse_invalid, warn_of_zero_gradients
from .optimisers import Optimiser, as_optimiser
from .stopping import Stop, StopReason
from .transforms import to_constrained, to_free, transform_per_leaf

if TYPE_CHECKING:
    import optax

PyTree = Any


@dataclass(frozen=True)
class History:
    """What each iteration found, as NumPy arrays of one length; entry i is after i updates.

    Attributes:
        loss: the loss.
        gradient_norm: Euclidean norm of the gradient in unconstrained coordinates.
        seconds: wall time of the iteration [s]; the first of a call includes the compilation.
    """

    loss: np.ndarray
    gradient_norm: np.ndarray
    seconds: np.ndarray


@dataclass(frozen=True)
class Fit:
    """What `fit` returns.

    Attributes:
        parameters: those of the lowest loss.
        last: those of the last iteration.
        value: the lowest loss.
        iteration: the iteration of the lowest loss.
        history: loss, gradient norm and seconds of every iteration.
        carried: what the loss handed on last (None without).
        info: what else the loss returned last (None without).
        best_carried: what the loss handed on at its lowest (None without).
        status: NONFINITE, INVALID, INTERRUPTED or the warning UNDETERMINED, with the iteration as its step; see `raise_for_status`.
        reason: why it ended.
        undetermined: what the data leave open, see `Undetermined`; None where nothing is known to be.
        explanation: the status in words.
    """

    parameters: PyTree
    last: PyTree
    value: float
    iteration: int
    history: History
    carried: PyTree
    info: PyTree
    best_carried: PyTree
    status: Status
    reason: StopReason
    undetermined: Undetermined | None
    explanation: str

    def __str__(self) -> str:
        """A few lines for a person."""
        named, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(self.parameters, eqx.is_array))
        lines = [f"{jax.tree_util.keystr(path)} {printing.numbers(leaf)}" for path, leaf in named]
        return printing.under(f"Fit: loss {self.value:.6g} at iteration {self.iteration}, {self.reason.name}; {self.explanation}", lines)


@dataclass(frozen=True)
class Iteration:
    """What `on_iteration` is told.

    Attributes:
        index: updates done so far; the first call has 0.
        loss: the loss after them.
        gradient_norm: norm of its gradient in unconstrained coordinates.
        seconds: wall time since the fit began [s].
        is_best: whether this is the lowest loss so far.
        info: what the loss returned besides its value (None without).
        carried: what the loss hands to the next iteration (None without).
        objective, free: how to get the parameters.
    """

    index: int
    loss: float
    gradient_norm: float
    seconds: float
    is_best: bool
    info: PyTree
    carried: PyTree
    objective: Objective
    free: PyTree

    @property
    def parameters(self) -> PyTree:
        """The parameters of this iteration."""
        return self.objective.parameters(self.free)


def fit(
    loss: Callable[..., Any],
    parameters: PyTree,
    optimiser: Optimiser | optax.GradientTransformation | None = None,
    n_iterations: int = 100,
    on_iteration: Callable[[Iteration], bool | None] | None = None,
    carried: PyTree = None,
    transforms: PyTree = None,
    stop: Stop | None = None,
    checkpoint: Checkpoint | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Fit:
    """Minimise a loss over the inexact arrays in `parameters`.

    Args:
        loss: `loss(parameters) -> value`, or with `carried`, `loss(parameters, carried) -> (value, (carried, info))`. The same function
            object again does not compile again; a new lambda does.
        parameters: a system, a part of one (see `select`), a dictionary: any tree. Numbers become arrays; integer and boolean arrays
            and functions stay as they are.
        optimiser: an optax transformation, `LBFGS()`, or `LeastSquares()` (then `loss` returns residuals); None is Adam at 0.05.
        n_iterations: updates, at most; the loss is evaluated once more than that. With `resume`, those done before count.
        on_iteration: called with an `Iteration` after each evaluation; returning True ends the fit.
        carried: auxiliary state handed from iteration to iteration and not differentiated, such as a warm start.
        transforms: see `transform_per_leaf`: `{"stiffness": Positive()}`, one for all, or a prefix tree.
        stop: rules for an earlier end.
        checkpoint: where and how often to save.
        resume: go on from the checkpoint, bit for bit as if unbroken.
        progress: shows a bar.

    Returns:
        A `Fit` with the best parameters. A loss or gradient that is not finite, or a parameter that a constructor would refuse, ends it
        with a status, never an exception; Ctrl-C too, with what was done.

    Raises:
        ValueError: a start outside its transform's domain or that a constructor refuses; nothing to train.
        CheckpointError: the checkpoint is damaged or belongs to another fit.

    >>> import jax.numpy as jnp
    >>> result = fit(lambda p: jnp.sum((p - 3.0) ** 2), jnp.zeros(2), n_iterations=300)
    >>> bool(jnp.all(jnp.abs(result.parameters - 3) < 1e-2))
    True
    """
    _check_kinds(loss, parameters, on_iteration, stop, checkpoint)
    _check_numbers(n_iterations, resume, checkpoint)
    clock = Stopwatch()
    optimiser = as_optimiser(optimiser)
    trained, rest = prepare(parameters)
    chosen = transform_per_leaf(transforms, trained)
    objective = Objective(loss, rest, chosen, carried is not None)
    free = to_free(chosen, trained)
    refuse_invalid(objective.parameters(free))
    carried = jax.tree.map(_as_array, carried)
    empty = {"loss": [], "gradient_norm": [], "seconds": []}
    start = Snapshot(free, free, first_memory(objective, optimiser, free, carried), carried, carried, 0, -1, empty)
    identity = {"coordinates": "; ".join(map(str, chosen)), "optimiser": _settings(optimiser)}
    start, known_loss = read_checkpoint(checkpoint, start, identity) if resume and checkpoint is not None else (start, None)
    run = _Run(objective, optimiser, start, identity, checkpoint, known_loss)
    reason = run.to_end(n_iterations, stop or Stop(), on_iteration, progress, clock)
    return run.result(reason, trained)


class _Run:
    """The host's side of a fit: what changes from iteration to iteration."""

    def __init__(
        self,
        objective: Objective,
        optimiser: Any,
        start: Snapshot,
        identity: dict[str, Any],
        checkpoint: Checkpoint | None,
        known_loss: float | None,
    ):
        self.objective, self.optimiser, self.identity, self.checkpoint = objective, optimiser, identity, checkpoint
        self.known_loss = known_loss  # what the first evaluation must give where this goes on from a checkpoint
        self.now = start  # where the next evaluation starts
        self.done: Snapshot | None = None  # where the last evaluation started, which a resumed fit would do again
        self.report, self.zeros = None, None
        self.history = start.history
        self.best, self.best_iteration, self.last = start.best, start.best_iteration, start.parameters
        self.status, self.info, self.carried, self.best_carried = Status.ok(), None, start.carried, start.best_carried

    def to_end(self, n_iterations: int, stop: Stop, on_iteration: Any, progress: Progress | None, clock: Stopwatch) -> StopReason:
        """Iterate until something says stop; what was done is kept whatever happens."""
        reason = None
        try:
            while reason is None:
                report = self._advance()
                reason = self._judge(report, n_iterations, stop, on_iteration, clock)
                if progress is not None:
                    progress.update(min(len(self.history["loss"]) - 1, n_iterations), n_iterations)
                if reason is None:
                    if self.checkpoint is not None and self.now.iteration and self.now.iteration % self.checkpoint.every == 0:
                        self._save()
                    self.now = self._next(report)
        except KeyboardInterrupt:
            if not self.history["loss"]:
                raise
            reason = StopReason.INTERRUPTED
            self.status = self.status.then(Status.when(Flag.INTERRUPTED, True, step=len(self.history["loss"]) - 1))
        if reason is not StopReason.FAILED:
            self._save()
        return reason

    def result(self, reason: StopReason, started: PyTree) -> Fit:
        """The outcome, in the user's coordinates."""
        undetermined = self._undetermined(reason, started)
        self.status = self.status.then(Status.when(Flag.UNDETERMINED, undetermined is not None, step=self.best_iteration))
        value = self.history["loss"][self.best_iteration] if self.best_iteration >= 0 else float("nan")
        back = self.objective.parameters
        history = History(*(np.asarray(self.history[name]) for name in ("loss", "gradient_norm", "seconds")))
        last, best = (self.carried, self.info), self.best_carried
        if not self.objective.has_carried:
            last, best = (None, None), None
        words = "OK" if int(self.status.flags) == 0 else explanation(self.status, self._seen(), undetermined)
        ends = (self.status, reason, undetermined, words)
        return Fit(back(self.best), back(self.last), value, self.best_iteration, history, *last, best, *ends)

    def _undetermined(self, reason: StopReason, started: PyTree) -> Undetermined | None:
        """What the data leave open: by the Jacobian of least squares, else by gradients that were always zero."""
        if self.report is None or reason is StopReason.FAILED:
            return None
        linear = self.optimiser.linearised(self.objective, self.best, self.report.memory, self.now.carried)
        if linear is None:
            return from_zeros(self.zeros) if len(self.history["loss"]) > 1 else None
        residuals, jacobian = map(np.asarray, linear)
        transforms = self.objective.transforms
        return from_jacobian(jacobian, residuals, started, to_constrained(transforms, self.best), slopes(transforms, self.best))

    def _seen(self) -> Seen:
        index = len(self.history["loss"]) - 1
        bad = np.zeros(0, bool) if self.report is None else self.report.checks.bad_gradients
        return Seen(self.objective, self.last, self.now.carried, index, self.history["loss"][index], bad)

    def _advance(self) -> Report:
        watch = Stopwatch()
        report = iterate(self.objective, self.optimiser, self.now.parameters, self.now.memory, self.now.carried)
        _refuse_traced("what the loss reads", report.checks)
        report = eqx.tree_at(lambda r: r.checks, report, jax.device_get(report.checks))
        index = self.now.iteration
        checks = report.checks
        if self.checkpoint is not None and self.known_loss is not None:
            expect_same_loss(self.checkpoint, float(checks.value), self.known_loss, checks.value.dtype)
            self.known_loss = None
        if index == 0:
            warn_of_zero_gradients(checks.zeros)
        self.report, self.done = report, self.now
        self.zeros = checks.zeros if self.zeros is None else jax.tree.map(np.logical_and, self.zeros, checks.zeros)
        self.history["loss"].append(float(checks.value))
        self.history["gradient_norm"].append(float(checks.gradient_norm))
        self.history["seconds"].append(watch.seconds)
        self.last, self.info, self.carried = report.at, report.info, report.carried
        for flag, raised in ((Flag.NONFINITE, checks.is_nonfinite), (Flag.INVALID, checks.is_invalid)):
            if raised:
                self.status = self.status.then(Status.when(flag, True, step=index))
        return report

    def _judge(self, report: Report, n_iterations: int, stop: Stop, on_iteration: Any, clock: Stopwatch) -> StopReason | None:
        """Keep the best, tell the user, and say why to stop."""
        losses, checks = self.history["loss"], report.checks
        index, loss = len(losses) - 1, float(checks.value)
        usable = not (checks.is_nonfinite or checks.is_invalid)
        is_best = usable and (self.best_iteration < 0 or loss < losses[self.best_iteration])
        if is_best:
            self.best, self.best_iteration, self.best_carried = report.at, index, report.carried
        asked = None
        if on_iteration is not None:
            norm = float(checks.gradient_norm)
            told = Iteration(index, loss, norm, clock.seconds, is_best, report.info, report.carried, self.objective, report.at)
            asked = on_iteration(told)
            if asked is not None and np.ndim(asked):
                raise TypeError(f"on_iteration returned {type(asked).__name__} of shape {np.shape(asked)}; expected True to end, or None.")
        if not usable:
            return StopReason.FAILED
        if asked:
            return StopReason.CALLBACK
        if bool(checks.is_done):
            return StopReason.CONVERGED
        if index >= n_iterations:
            return StopReason.ITERATIONS
        return stop.reason(losses, float(checks.gradient_norm), clock.seconds)

    def _next(self, report: Report) -> Snapshot:
        done = len(self.history["loss"])
        return Snapshot(report.after, self.best, report.memory, report.carried, self.best_carried, done, self.best_iteration, self.history)

    def _save(self) -> None:
        """Write where the last evaluation started, and what it gave: it is done again on resuming, to see that the loss is the same."""
        if self.checkpoint is not None and self.done is not None:
            write_checkpoint(self.checkpoint, self.done, self.identity)


def _settings(optimiser: Any) -> dict[str, str]:
    """Those of an optimiser that a resumed fit must share."""
    return {name: value for name, value in fingerprint(optimiser).items() if name not in optimiser.may_change}


def _as_array(leaf: Any) -> Any:
    """Numbers as arrays of fixed type, so that no iteration is traced twice."""
    if isinstance(leaf, np.ndarray):
        return own("carried", leaf)
    return jax.numpy.asarray(leaf, jax.numpy.result_type(leaf)) if eqx.is_array_like(leaf) else leaf


def _check_numbers(n_iterations: int, resume: bool, checkpoint: Checkpoint | None) -> None:
    if isinstance(n_iterations, bool) or not isinstance(n_iterations, (int, np.integer)):
        raise TypeError(f"n_iterations = {n_iterations!r}; expected a whole number.")
    if n_iterations < 0:
        raise ValueError(f"n_iterations = {n_iterations}; expected zero or more.")
    if resume and checkpoint is None:
        raise ValueError("resume=True needs to know from where: pass checkpoint=Checkpoint(path).")


def _check_kinds(loss: Any, parameters: PyTree, on_iteration: Any, stop: Any, checkpoint: Any) -> None:
    if not callable(loss):
        raise TypeError(f"loss is a {type(loss).__name__}; expected a function of the parameters: fit(loss, parameters).")
    if on_iteration is not None and not callable(on_iteration):
        raise TypeError(f"on_iteration is a {type(on_iteration).__name__}; expected a function of an `Iteration`.")
    if stop is not None and not isinstance(stop, Stop):
        raise TypeError(f"stop is a {type(stop).__name__}; expected Stop(target=..., gradient_norm=..., ...).")
    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        raise TypeError(f"checkpoint is a {type(checkpoint).__name__}; expected Checkpoint(path, every=25).")
    _refuse_traced("parameters", parameters)


def _refuse_traced(what: str, tree: PyTree) -> None:
    """TypeError where `fit` itself is called inside a transformation of JAX."""
    if is_traced(tree):
        raise TypeError(
            f"fit was called inside jit, grad or vmap: {what} hold traced values. It decides on the host after each iteration; call it "
            "outside. For the derivative of a fitted parameter by the data use the implicit function theorem on the gradient of the loss."
        )
