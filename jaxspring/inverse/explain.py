"""What ended a fit, in a fit's own words: its steps are iterations, and what failed is a loss."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..files import leaf_name
from ..status import EXPLANATION, Flag, Status
from .determined import Undetermined
from .iteration import Objective, invalid_effects

PyTree = Any
# The loss, functions that it calls, and functions that those call.
DEEPEST = 3


@dataclass(frozen=True)
class Seen:
    """The last evaluation of a fit.

    Attributes:
        objective: the loss in unconstrained coordinates.
        free: where it was evaluated.
        carried: what it was given besides.
        iteration: which evaluation it was.
        loss: what it returned.
        bad_gradients: per trained leaf, whether its gradient is not finite.
    """

    objective: Objective
    free: PyTree
    carried: PyTree
    iteration: int
    loss: float
    bad_gradients: np.ndarray


def explanation(status: Status, seen: Seen, undetermined: Undetermined | None) -> str:
    """A sentence or two for each flag of a fit's status; OK where there is none."""
    flags = Flag(int(status.flags))
    words = {flag: EXPLANATION[flag] for flag in Flag if flag and flag in flags}
    if Flag.NONFINITE in words:
        words[Flag.NONFINITE] = _of_nonfinite(seen)
    if Flag.INVALID in words:
        words[Flag.INVALID] = _of_invalid(seen)
    if Flag.UNDETERMINED in words:
        words[Flag.UNDETERMINED] = str(undetermined)
    if Flag.INTERRUPTED in words:
        words[Flag.INTERRUPTED] = f"interrupted after iteration {seen.iteration}; the result holds the best parameters until then"
    return "; ".join(f"{flag.name}: {text}" for flag, text in words.items()) or "OK"


def _of_nonfinite(seen: Seen) -> str:
    bad = [_count(leaf_name(path), leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(seen.free)]
    bad = [text for text in bad if text]
    state = f"the parameters are not finite either ({bad[0]})" if bad else "the parameters are finite"
    if np.isfinite(seen.loss):
        names = [leaf_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(seen.free)]
        which = ", ".join(name for name, is_bad in zip(names, seen.bad_gradients, strict=True) if is_bad)
        what = (
            f"the loss is finite ({seen.loss:.6g}) at iteration {seen.iteration}, but its gradient with respect to {which} is not, where "
            f"{state}. A square root or a norm at zero does that, or a solve inside that failed: see check_gradient, and the status inside"
        )
    else:
        what = f"the loss is {seen.loss} at iteration {seen.iteration}, where {state}"
        what += "".join(f". The {text}" for text in _residuals(seen))
    data = [text for name, value in nonfinite_inputs(seen.objective.loss) if (text := _count(name, value))]
    if data:
        return f"{what}. The loss reads {'; '.join(data)}: leave such entries out, or replace them by a number and give them no weight"
    if seen.iteration == 0 and not np.isfinite(seen.loss):
        return f"{what}. So the start has no loss: call the loss on it by hand, and raise_for_status on the runs inside (is dt too long?)"
    if seen.iteration > 0:
        return f"{what}. The last step led there: take a smaller learning rate, or keep parameters in their range by transforms="
    return what


def _of_invalid(seen: Seen) -> str:
    bad = [name for name, is_bad in invalid_effects(seen.objective.parameters(seen.free)) if bool(is_bad)]
    return (
        f"at iteration {seen.iteration} a constant has a value that its constructor would refuse: {', '.join(bad)}. "
        "Keep it in its range by transforms=, such as Positive()"
    )


def _residuals(seen: Seen) -> list[str]:
    """Which residuals are not finite, where the loss returns an array or a tree of them."""
    value = eqx.filter_jit(lambda objective, free, carried: objective(free, carried)[0])(seen.objective, seen.free, seen.carried)
    leaves = jax.tree_util.tree_leaves_with_path(value)
    if len(leaves) == 1 and np.ndim(leaves[0][1]) == 0:
        return []
    return [text for path, leaf in leaves if (text := _count(f"residual {leaf_name(path)}" if path else "residual", leaf))][:1]


def nonfinite_inputs(function: Any, depth: int = DEEPEST) -> Iterator[tuple[str, np.ndarray]]:
    """Name and value of every array that a function reads from outside and that holds NaN or infinity."""
    if depth == 0:
        return
    if isinstance(function, functools.partial):
        yield from _bad_arrays("an argument", (function.args, function.keywords))
        yield from nonfinite_inputs(function.func, depth)
        return
    function = inspect.unwrap(function)
    if inspect.ismethod(function):
        yield from _bad_arrays("self", function.__self__)
        function = function.__func__
    if not inspect.isfunction(function):
        yield from _bad_arrays(type(function).__name__, function)
        return
    read = inspect.getclosurevars(function)
    for name, value in {**read.globals, **read.nonlocals}.items():
        if inspect.ismodule(value) or inspect.isclass(value):
            continue
        if callable(value) and not isinstance(value, eqx.Module):
            is_neighbour = getattr(value, "__module__", None) == function.__module__
            yield from nonfinite_inputs(value, depth - 1) if is_neighbour else ()
        else:
            yield from _bad_arrays(name, value)


def _bad_arrays(name: str, tree: PyTree) -> Iterator[tuple[str, np.ndarray]]:
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if isinstance(leaf, (np.ndarray, jax.Array, float)) and _count("", leaf):
            yield (f"{name} ({leaf_name(path)})" if path else name), np.asarray(leaf)


def _count(name: str, leaf: Any) -> str:
    """How many entries of an array are not finite, and which is the first; empty where all are."""
    if not np.issubdtype(getattr(leaf, "dtype", type(leaf)), np.inexact):
        return ""
    bad = np.argwhere(~np.isfinite(np.asarray(leaf)))
    if not len(bad):
        return ""
    index = f"[{', '.join(str(int(i)) for i in bad[0])}]" if np.ndim(leaf) else ""
    return f"{name}{index} = {np.asarray(leaf)[tuple(bad[0])]}" + (f" and {len(bad) - 1} more that are not finite" if len(bad) > 1 else "")
