"""Periods: space that repeats itself along some coordinates.

    nearest image    d - L round(d / L)        L: the period [m]; a coordinate of period zero does not repeat

Positions are never wrapped: a node may travel through any number of boxes, and differences take the nearest image. A spring (or a pair) of
half a period has two images that are as near, and beyond it the other one is taken: its pull turns round (see `forces.in_box`).
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._checks import as_inexact, is_concrete
from ..vector import Vector


def nearest_image(d: Array, period: Array) -> Array:
    """A difference [m] shifted by whole periods to its nearest image; a period of zero leaves it alone."""
    period, turns = period.astype(d.dtype), turns_of(d, period)
    return d - period * turns


def turns_of(d: Array, period: Array) -> Array:
    """How many whole periods are in a difference, to the nearest number; a constant to every derivative."""
    period = period.astype(d.dtype)
    repeats = period > 0
    per_period = jnp.where(repeats, 1 / jnp.where(repeats, period, jnp.ones_like(period)), jnp.zeros_like(period))
    # Where a difference has no digit left below a period it is not shifted: what is out of reach stays there.
    most = 0.125 / float(jnp.finfo(d.dtype).eps)
    return lax.stop_gradient(jnp.clip(jnp.round(d * per_period), -most, most))


def minimum_image(d: Vector, box: Array) -> Vector:
    """`d` shifted by whole periods to its shortest image; a period of zero leaves that coordinate alone."""
    check_dim(box, d.dim)
    return Vector(tuple(nearest_image(a, period) for a, period in zip(d, box, strict=True)))


def check_dim(box: Array | None, dim: int) -> None:
    """Raise ValueError unless the box has a period for each coordinate."""
    if box is not None and box.shape[0] != dim:
        raise ValueError(
            f"box has {box.shape[0]} periods, but positions have {dim} coordinates. Give the net one period per coordinate, "
            f"0 where it does not repeat."
        )


def as_box(box: Any) -> Array | None:
    """The periods as an array (D,), each a positive length or zero.

    Raises:
        ValueError: another shape, a period that is negative or not finite, named with its index.
    """
    if box is None:
        return None
    box = as_inexact("box", box)
    if box.ndim != 1 or box.shape[0] not in (1, 2, 3):
        raise ValueError(f"box has shape {box.shape}; expected (D,): one period per coordinate, 0 where it is not periodic.")
    if is_concrete(box):
        for axis, period in enumerate(np.asarray(box).tolist()):
            if not (np.isfinite(period) and period >= 0):
                raise ValueError(
                    f"box[{axis}] = {period} along {'xyz'[axis]}; expected a period above zero [m], or 0 where {'xyz'[axis]} does not "
                    f"repeat. Unchecked, springs would keep the length of no image."
                )
    return box


def check_wrapped(shape: tuple[int, ...], wraps: tuple[bool, ...], box: Array | None) -> None:
    """Raise ValueError where an axis of a lattice wraps and its coordinate has no period. x is the last axis.

    With more coordinates than axes a period of zero is allowed: such a lattice may close on itself in space, as a ring or a tube.
    """
    if box is None:
        raise ValueError("A periodic lattice needs box=(period of x, y, ...) [m]: without it a wrapped spring would span the lattice.")
    dim = len(shape)
    if not is_concrete(box) or box.shape[0] > dim:
        return
    periods = np.asarray(box)
    if box.shape[0] < dim:
        if periods.any():
            raise ValueError(f"box has {box.shape[0]} periods, but shape = {shape} has {dim} axes. Give one period for each, x first.")
        return
    for axis, wrap in enumerate(wraps):
        coordinate = dim - 1 - axis
        if wrap and not periods[coordinate] > 0:
            name = "xyz"[coordinate]
            raise ValueError(
                f"axis {axis} wraps, but box[{coordinate}] = {periods[coordinate]} gives {name} no period: a wrapped spring would span the "
                f"lattice. Give its period [m], the number of nodes times their spacing; box is ordered x, y, z, and {name} is axis {axis}."
            )


def same_box(one: Any, other: Any) -> bool:
    """Whether two boxes have the same periods, as far as they are known; none is as periods of zero."""
    if not all(is_concrete(box) for box in (one, other) if box is not None):
        return True
    a, b = (np.zeros(3) if box is None else np.pad(np.asarray(box, float), (0, 3 - len(box))) for box in (one, other))
    return bool(np.allclose(a, b, rtol=1e-6, atol=0))


def longest(box: Any) -> float:
    """Length [m] that no nearest image exceeds: half the diagonal of the box; infinite where a coordinate has no period."""
    if box is None or not is_concrete(box):
        return np.inf
    periods = np.asarray(box, float)
    return float(np.linalg.norm(periods) / 2) if (periods > 0).all() else np.inf


def box_of(net: Any) -> Any:
    """(D,) periods of a net, or None."""
    return getattr(net, "box", None)


__all__ = [
    "as_box",
    "box_of",
    "check_dim",
    "check_wrapped",
    "longest",
    "minimum_image",
    "nearest_image",
    "same_box",
    "turns_of",
]
