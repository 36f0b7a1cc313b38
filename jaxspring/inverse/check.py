"""Is the gradient the gradient? Compared with central differences in float64, along random directions of every leaf.

    slope       D(h) = (L(p + h d) - L(p - h d)) / 2h,  extrapolated (4 D(h/2) - D(h)) / 3       error h^4
    Taylor      |L(p + h d) - L(p) - h g.d| falls as h^2; with a wrong gradient only as h

The step h is chosen where two successive extrapolations agree best, which does not look at the gradient.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._arrays import own
from ..files import leaf_name
from ..numerics import cast_inexact
from ..status import Flag, Status
from .iteration import prepare
from .optimisers import one_number

PyTree = Any
N_STEPS = 14
# Of the size of the direction, which is that of the leaf: from 1/10 down to 1/80,000, halved each time.
LARGEST_STEP = 0.1


@dataclass(frozen=True)
class LeafCheck:
    """The gradient with respect to one leaf, along one random direction.

    Attributes:
        name: path of the leaf.
        gradient: slope by the gradient, g.d with |d| = 1.
        difference: slope by central differences.
        error: their distance, relative to the larger of |gradient of this leaf| and 1e-6 |loss| / |leaf|.
        taylor_order: observed order of the Taylor remainder: 2 for a right gradient, 1 for a wrong one, NaN where the loss is linear
            along the direction to round-off.
    """

    name: str
    gradient: float
    difference: float
    error: float
    taylor_order: float


@dataclass(frozen=True)
class GradientCheck:
    """What `check_gradient` returns.

    Attributes:
        leaves: one entry per trained leaf.
        value: the loss.
        status: NONFINITE where the loss or a gradient is not finite.
    """

    leaves: tuple[LeafCheck, ...]
    value: float
    status: Status

    @property
    def explanation(self) -> str:
        """The status in words."""
        if bool(self.status.is_ok):
            return "OK"
        bad = ", ".join(leaf.name for leaf in self.leaves if not np.isfinite(leaf.gradient))
        return f"NONFINITE: the loss is {self.value}" if not np.isfinite(self.value) else f"NONFINITE: the gradient by {bad} is not finite"

    @property
    def error(self) -> float:
        """The largest error of any leaf; NaN where something is not finite."""
        return float(np.max([leaf.error for leaf in self.leaves]))

    def __str__(self) -> str:
        """The table: a row per leaf."""
        rows = [f"{'leaf':30} {'gradient':>14} {'differences':>14} {'error':>9} {'order':>6}"]
        for leaf in self.leaves:
            numbers = f"{leaf.gradient:14.6e} {leaf.difference:14.6e} {leaf.error:9.1e} {leaf.taylor_order:6.2f}"
            rows.append(f"{leaf.name:30} {numbers}")
        return "\n".join(rows)


def check_gradient(loss: Callable[[PyTree], Any], parameters: PyTree, seed: int = 0) -> GradientCheck:
    """Compare the gradient of a loss with central differences, in float64 whatever the parameters are.

    Args:
        loss: parameters -> one number. What it closes over stays in its own precision; build the scene from `parameters` where
            float32 constants would limit the comparison.
        parameters: any tree; its inexact arrays are checked, one random direction each.
        seed: of the directions.

    Returns:
        A `GradientCheck`; `print` it for a table. Nothing is raised for a wrong gradient.

    Raises:
        TypeError: a loss that is no function.

    >>> print(check_gradient(lambda p: jnp.sum(p**3), jnp.ones(4)).error < 1e-9)
    True
    """
    if not callable(loss):
        raise TypeError(f"loss is a {type(loss).__name__}; expected a function of the parameters: check_gradient(loss, parameters).")
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True), np.errstate(all="ignore"):
        wide = jax.tree.map(_widened, parameters, is_leaf=lambda x: isinstance(x, np.ndarray))
        trained, rest = prepare(wide)

        @jax.jit
        def value_of(p: PyTree) -> Any:
            return one_number(loss(eqx.combine(p, rest)))

        value, gradient = jax.jit(jax.value_and_grad(value_of))(trained)
        named = jax.tree_util.tree_leaves_with_path(trained)
        checks = []
        for i, ((path, leaf), slope) in enumerate(zip(named, jax.tree.leaves(gradient), strict=True)):
            direction = rng.standard_normal(leaf.shape)
            direction = direction / (np.linalg.norm(direction) or 1)
            along = _Line(value_of, trained, i, direction, float(value))
            checks.append(_check_leaf(leaf_name(path), along, leaf, np.asarray(slope)))
        finite = bool(np.isfinite(value)) and all(bool(jnp.all(jnp.isfinite(g))) for g in jax.tree.leaves(gradient))
    return GradientCheck(tuple(checks), float(value), Status.when(Flag.NONFINITE, not finite))


@dataclass(frozen=True)
class _Line:
    """The loss along one direction of one leaf."""

    value_of: Callable[[PyTree], Any]
    trained: PyTree
    index: int
    direction: np.ndarray
    start: float

    def at(self, step: float) -> float:
        leaves, treedef = jax.tree.flatten(self.trained)
        leaves[self.index] = leaves[self.index] + jnp.asarray(step * self.direction)
        return float(self.value_of(treedef.unflatten(leaves)))


def _check_leaf(name: str, along: _Line, leaf: Any, gradient: np.ndarray) -> LeafCheck:
    size = float(np.linalg.norm(leaf))
    steps = LARGEST_STEP * (size or 1) * 0.5 ** np.arange(N_STEPS)
    above, below = (np.array([along.at(sign * h) for h in steps]) for sign in (1, -1))
    central = (above - below) / (2 * steps)
    better = (4 * central[1:] - central[:-1]) / 3
    difference = float(better[1:][np.argmin(_nan_last(np.abs(np.diff(better))))])
    slope = float(np.sum(gradient * along.direction))
    scale = max(float(np.linalg.norm(gradient)), 1e-6 * abs(along.start) / (size or 1))
    wrong = abs(slope - difference)
    error = wrong / scale if scale else wrong
    return LeafCheck(name, slope, difference, error, _order(np.abs(above - along.start - steps * slope), along.start))


def _order(remainder: np.ndarray, value: float) -> float:
    """Median order over the steps whose remainder is well above round-off."""
    clear = remainder > 1e4 * np.finfo(float).eps * max(abs(value), np.finfo(float).tiny)
    orders = np.log2(remainder[:-1] / np.where(clear[1:], remainder[1:], 1))[clear[:-1] & clear[1:]]
    return float(np.median(orders[-3:])) if len(orders) else float("nan")


def _nan_last(values: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(values), values, np.inf)


def _widened(leaf: Any) -> Any:
    if isinstance(leaf, np.ndarray) and leaf.dtype.kind == "f":
        return own("parameters", leaf, jnp.float64)
    return cast_inexact(leaf, jnp.float64)
