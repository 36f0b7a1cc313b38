"""What the data leave open: directions of the parameters along which the residuals do not change, or less than their scatter.

    r(p + a n) = r(p) + O(a^2)        n: an undetermined direction, J n = 0 with J = dr/dp

Two readings of J, each with columns made comparable, so that units do not matter:

    rank        columns of unit length; a singular value below eps^(2/3) of the largest is rounding
    scatter     columns per size of the parameter; with s^2 = sum r^2 / (residuals - parameters), the standard error along the i-th
                singular direction is s / (i-th singular value): above 1, not even the parameter's size is known

Source: Golub & Van Loan, Matrix Computations, section 5.5 (numerical rank); Bates & Watts, Nonlinear Regression Analysis, section 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..files import leaf_name
from .transforms import Transform

PyTree = Any
# Entries with less than this share of an undetermined direction are rounding. Of a share: squared.
LEAST_SHARE = 1e-4
MOST_NAMED = 6
# Of the angle between residuals and a column at a minimum. A choice: what is left to gain is a millionth of the sum of squares.
LARGEST_COSINE = 1e-3


@dataclass(frozen=True)
class Undetermined:
    """Part of the parameters that the data do not determine.

    Attributes:
        count: how many directions are open.
        entries: the tree of the trained parameters with booleans: which entries take part in such a direction.
        directions: the tree of the trained parameters with a leading axis of `count`: changes of the parameters that leave the residuals
            as they are to first order, in the parameters' own units, as large as the parameters. None where only gradients are known.
        names: the entries that take part, such as `k` or `stiffness[3]`; long lists are cut.
    """

    count: int
    entries: PyTree
    directions: PyTree
    names: tuple[str, ...]

    def __str__(self) -> str:
        """What is open, and what to do."""
        names = ", ".join(self.names)
        if self.directions is None:
            return f"the gradient with respect to {names} was exactly zero at every iteration, so the loss left them where they started"
        many = f"{self.count} directions" if self.count > 1 else "one direction"
        return (
            f"the residuals leave {many} of the parameters open, in {names}: their values rest on the start, or on noise. "
            "Fix one of them, tie them, or add data that tell them apart (see undetermined.directions)"
        )


def from_jacobian(jacobian: np.ndarray, residuals: np.ndarray, start: PyTree, best: PyTree, slopes: PyTree) -> Undetermined | None:
    """What a Jacobian of the residuals leaves open; None where it determines everything.

    Args:
        jacobian: (R, P) derivatives by the unconstrained coordinates, in the order of the raveled leaves.
        residuals: (R,).
        start: parameters at the start, in the user's coordinates.
        best: parameters now.
        slopes: derivative of each parameter by its unconstrained coordinate.
    """
    eps = float(np.finfo(jacobian.dtype).eps)
    jacobian, residuals = jacobian.astype(np.float64), residuals.astype(np.float64)
    size = np.concatenate([_sizes(a, b) for a, b in zip(jax.tree.leaves(start), jax.tree.leaves(best), strict=True)])
    slope = np.concatenate([np.ravel(np.asarray(leaf, np.float64)) for leaf in jax.tree.leaves(slopes)])
    with np.errstate(all="ignore"):
        relative = jacobian * (size / slope)
    # Where a transform is saturated the parameter sits on its bound: that holds it, not the data.
    is_inside = (slope != 0) & np.all(np.isfinite(relative), axis=0)
    if not np.all(np.isfinite(jacobian)) or not np.any(is_inside):
        return None
    relative = relative[:, is_inside]
    n_rows, n_inside = relative.shape
    compressed = np.asarray(np.linalg.qr(relative, mode="r")) if n_rows > n_inside else relative
    found = _rank_null(compressed, eps)
    if n_rows > n_inside and _is_at_minimum(relative, residuals):
        _, values, rows = np.linalg.svd(compressed, full_matrices=False)
        is_vague = values * np.sqrt(n_rows - n_inside) < np.linalg.norm(residuals)
        found = _joined(found, rows[is_vague])
    open_ = np.zeros((len(found), len(size)))
    open_[:, is_inside] = found
    if not len(open_):
        return None
    open_ = open_ / np.max(np.abs(open_), axis=1, keepdims=True)
    shares = np.sum(open_**2, axis=0) > LEAST_SHARE
    entries, directions = _like(best, shares), _like(best, open_ * size)
    return Undetermined(len(open_), entries, directions, _names(entries))


def from_zeros(zeros: PyTree) -> Undetermined | None:
    """What gradients leave open that were exactly zero throughout; None where none was, or where all were (a fit at rest)."""
    count = sum(int(np.sum(mask)) for mask in jax.tree.leaves(zeros))
    if count == 0 or count == sum(np.size(mask) for mask in jax.tree.leaves(zeros)):
        return None
    return Undetermined(count, zeros, None, _names(zeros))


def slopes(transforms: tuple[Transform, ...], free: PyTree) -> PyTree:
    """Derivative of each parameter by its unconstrained coordinate."""
    leaves, treedef = jax.tree.flatten(free)
    return treedef.unflatten([jax.jvp(t.constrain, (u,), (jnp.ones_like(u),))[1] for t, u in zip(transforms, leaves, strict=True)])


def _sizes(start: Any, best: Any) -> np.ndarray:
    """What counts as a large change of each entry: the size of its array at the start (1 where it was zero), or a third of it now."""
    start, best = np.asarray(start, np.float64), np.asarray(best, np.float64)
    at_start, now = (float(np.sqrt(np.mean(a**2))) if a.size else 0.0 for a in (start, best))
    return np.full(start.size, max(at_start or 1.0, now / 3))


def _is_at_minimum(matrix: np.ndarray, residuals: np.ndarray) -> bool:
    """Whether the residuals are scatter: nearly at right angles to every column."""
    lengths = np.linalg.norm(matrix, axis=0) * np.linalg.norm(residuals)
    return bool(np.all(np.abs(residuals @ matrix) <= LARGEST_COSINE * lengths))


def _rank_null(matrix: np.ndarray, eps: float) -> np.ndarray:
    """(n, P) orthonormal directions that the matrix maps to nothing but rounding."""
    lengths = np.linalg.norm(matrix, axis=0)
    is_idle = lengths <= eps * np.max(lengths, initial=0)
    kept = np.flatnonzero(~is_idle)
    idle = np.eye(len(lengths))[is_idle]
    if not len(kept):
        return idle
    _, values, rows = np.linalg.svd(matrix[:, kept] / lengths[kept], full_matrices=True)
    rank = int(np.sum(values > eps ** (2 / 3) * values[0]))
    rest = np.zeros((len(kept) - rank, len(lengths)))
    rest[:, kept] = rows[rank:] / lengths[kept]
    rest, _ = np.linalg.qr((rest / np.linalg.norm(rest, axis=1, keepdims=True)).T)
    return np.concatenate([idle, rest.T])


def _joined(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Orthonormal rows that span both sets of orthonormal rows; what lies within 6 degrees of the first adds nothing."""
    _, sines, rows = np.linalg.svd(second - second @ first.T @ first, full_matrices=False)
    return np.concatenate([first, rows[sines > 0.1]])


def _like(tree: PyTree, columns: np.ndarray) -> PyTree:
    """(..., P) columns as a tree of arrays (..., *shape)."""
    leaves, treedef = jax.tree.flatten(tree)
    ends = np.cumsum([np.size(leaf) for leaf in leaves])[:-1]
    parts = np.split(columns, ends, axis=-1)
    return treedef.unflatten([part.reshape(columns.shape[:-1] + np.shape(leaf)) for part, leaf in zip(parts, leaves, strict=True)])


def _names(entries: PyTree) -> tuple[str, ...]:
    """Whole leaves by name, single entries with their index, as many as a sentence holds."""
    found: list[str] = []
    for path, mask in jax.tree_util.tree_leaves_with_path(entries):
        name = leaf_name(path)
        if np.all(mask) and np.size(mask):
            found.append(name)
        else:
            found += [f"{name}[{', '.join(str(int(i)) for i in index)}]" for index in np.argwhere(mask)]
    return tuple(found) if len(found) <= MOST_NAMED else (*found[:MOST_NAMED], f"and {len(found) - MOST_NAMED} more")
