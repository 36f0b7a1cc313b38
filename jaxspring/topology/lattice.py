"""Regular lattices in one, two and three dimensions.

A node field is an array of shape (n,), (ny, nx) or (nz, ny, nx). A spring family is one offset: its springs join every node `i`
to node `i + offset`. Differences are shifted slices, and pulls are padded back, so no index is ever read:

    d = x[o:] - x[:-o]        f = pad(p, after) - pad(p, before)

On a periodic axis the slice is a roll, and `box` (the period in each coordinate, [m]) takes the minimum image.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._checks import as_inexact
from ..vector import Vector
from .base import Topology
from .edge_field import EdgeField

Offset = tuple[int, ...]


class SpringFamilies:
    """A choice of lattice springs; add choices with `+`.

    >>> (STRUCTURAL + BEND).offsets(2)
    ((0, 1), (1, 0), (0, 2), (2, 0))
    """

    def __init__(self, *kinds: tuple[str, int, int]):
        self._kinds = kinds

    def __add__(self, other: SpringFamilies) -> SpringFamilies:
        return SpringFamilies(*self._kinds, *(kind for kind in other._kinds if kind not in self._kinds))

    def __repr__(self) -> str:
        return " + ".join(name for name, _, _ in self._kinds)

    def offsets(self, dim: int) -> tuple[Offset, ...]:
        """Index offsets of the families in a lattice of `dim` dimensions, axes ordered as the array's.

        Raises ValueError for a family that a lattice of that dimension cannot have.
        """
        found: list[Offset] = []
        for name, n_axes, reach in self._kinds:
            if n_axes > dim:
                raise ValueError(f"{name} springs need a lattice of {n_axes} dimensions or more; this one has {dim}.")
            for offset in itertools.product((0, 1, -1), repeat=dim):
                moving = [o for o in offset if o]
                if len(moving) == n_axes and moving[0] == 1:
                    found.append(tuple(reach * o for o in offset))
        return tuple(found)


STRUCTURAL = SpringFamilies(("STRUCTURAL", 1, 1))
SHEAR = SpringFamilies(("SHEAR", 2, 1))
BODY = SpringFamilies(("BODY", 3, 1))
BEND = SpringFamilies(("BEND", 1, 2))


class Lattice(Topology):
    """Nodes on a regular grid, springs by constant index offsets. Build it with `lattice`.

    Attributes:
        shape: number of nodes along each axis.
        offsets: index offset of each spring family.
        periodic: per axis, whether it wraps.
        box: (D,) period of each coordinate [m], or None; zero means that the coordinate is not periodic.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    offsets: tuple[Offset, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)
    box: Array | None

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field."""
        return self.shape

    @property
    def node_permutation(self) -> None:
        """Nodes keep the user's order: row-major."""
        return None

    @property
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape of each family's tails."""
        return tuple(
            tuple(n if wraps else max(n - abs(o), 0) for n, o, wraps in zip(self.shape, offset, self.periodic, strict=True))
            for offset in self.offsets
        )

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) tail and head of each spring: family by family, row-major inside a family."""
        numbers = np.arange(self.n_nodes).reshape(self.shape)
        pairs = []
        for offset in self.offsets:
            tail, head = _ends(numbers, offset, self.periodic, np.roll)
            pairs.append(np.stack([tail.ravel(), head.ravel()], axis=-1))
        return np.concatenate(pairs).astype(np.int32) if pairs else np.zeros((0, 2), np.int32)

    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail along each spring, by shifted slices."""
        families = []
        for offset in self.offsets:
            ends = [_ends(a, offset, self.periodic, jnp.roll) for a in x]
            d = Vector(tuple(head - tail for tail, head in ends))
            families.append(d if self.box is None else minimum_image(d, self.box))
        return EdgeField(tuple(families))

    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node: each pull on its tail, the opposite on its head, by padding."""
        dim = len(pulls.families[0])
        totals: list[Any] = [None] * dim
        for offset, pull in zip(self.offsets, pulls.families, strict=True):
            for i, p in enumerate(pull):
                tail, head = _spread(p, offset, self.periodic)
                totals[i] = tail - head if totals[i] is None else totals[i] + (tail - head)
        return Vector(tuple(totals))

    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node."""
        total = None
        for offset, value in zip(self.offsets, values.families, strict=True):
            tail, head = _spread(value, offset, self.periodic)
            total = tail + head if total is None else total + (tail + head)
        return jnp.zeros(self.shape) if total is None else total

    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""
        ends = (_ends(a, offset, self.periodic, jnp.roll) for offset in self.offsets)
        return EdgeField(tuple(0.5 * (tail + head) for tail, head in ends))

    def split(self, flat: Array) -> EdgeField:
        """(E,) array -> edge field, by static slices."""
        families, start = [], 0
        for shape in self.family_shapes:
            size = int(np.prod(shape))
            families.append(lax.slice(flat, (start,), (start + size,)).reshape(shape))
            start += size
        return EdgeField(tuple(families))

    def flatten(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array."""
        return jnp.concatenate([jnp.ravel(entry) for entry in field.families]) if field.families else jnp.zeros((0,))

    def grid(self, spacing: float | Sequence[float] = 1.0) -> np.ndarray:
        """(N, D) rest positions [m] of a grid with `spacing` along x (last axis), y, z."""
        steps = np.broadcast_to(np.asarray(spacing, float), (len(self.shape),))
        axes = np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij")
        return np.stack([axis.ravel() * h for axis, h in zip(axes[::-1], steps, strict=True)], axis=-1)


def lattice(
    shape: int | Sequence[int],
    springs: SpringFamilies = STRUCTURAL,
    periodic: bool | Sequence[bool] = False,
    box: Any = None,
) -> Lattice:
    """A chain, a sheet or a block of nodes: shape n or (n,), (ny, nx), (nz, ny, nx).

    Args:
        shape: nodes along each axis, slowest first, as in `array.shape`.
        springs: sum of STRUCTURAL, SHEAR (2-D diagonals, 3-D face diagonals), BODY (3-D body diagonals) and BEND (second neighbours).
        periodic: whether an axis wraps round, for all axes or one each.
        box: (D,) period of each coordinate [m] where an axis wraps; zero where a coordinate does not. Required if any axis wraps.

    Raises:
        ValueError: an empty lattice, more than three axes, a family that this dimension lacks, a wrap without a box.

    >>> net = lattice((3, 4), springs=STRUCTURAL + SHEAR)
    >>> net.n_nodes, net.n_springs
    (12, 29)
    """
    shape = (int(shape),) if isinstance(shape, (int, np.integer)) else tuple(int(n) for n in shape)
    if not 1 <= len(shape) <= 3:
        raise ValueError(f"shape = {shape} has {len(shape)} axes; expected 1 (chain), 2 (sheet) or 3 (block).")
    if min(shape) < 1:
        raise ValueError(f"shape = {shape} holds no node; every axis needs at least 1.")
    wraps = (periodic,) * len(shape) if isinstance(periodic, (bool, np.bool_)) else tuple(bool(p) for p in periodic)
    if len(wraps) != len(shape):
        raise ValueError(f"periodic has {len(wraps)} entries, but shape = {shape} has {len(shape)} axes.")
    offsets = tuple(o for o in springs.offsets(len(shape)) if all(w or abs(s) < n for s, n, w in zip(o, shape, wraps, strict=True)))
    if any(wraps):
        _check_wrap(shape, wraps, offsets, box)
    return Lattice(shape, offsets, wraps, _as_box(box))


def minimum_image(d: Vector, box: Array) -> Vector:
    """`d` shifted by whole periods to its shortest image; a period of zero leaves that coordinate alone."""
    if box.shape[0] != d.dim:
        raise ValueError(f"box has {box.shape[0]} periods, but positions have {d.dim} coordinates.")

    def wrap(a: Array, period: Array) -> Array:
        period = period.astype(a.dtype)
        turns = jnp.round(a / jnp.where(period > 0, period, jnp.ones_like(period)))
        return a - jnp.where(period > 0, period, jnp.zeros_like(period)) * lax.stop_gradient(turns)

    return Vector(tuple(wrap(a, period) for a, period in zip(d, box, strict=True)))


def _as_box(box: Any) -> Array | None:
    if box is None:
        return None
    box = as_inexact("box", box)
    if box.ndim != 1 or box.shape[0] not in (1, 2, 3):
        raise ValueError(f"box has shape {box.shape}; expected (D,): one period per coordinate, 0 where it is not periodic.")
    return box


def _check_wrap(shape: tuple[int, ...], wraps: tuple[bool, ...], offsets: tuple[Offset, ...], box: Any) -> None:
    if box is None:
        raise ValueError("A periodic lattice needs box=(period of x, y, ...) [m]: without it a wrapped spring would span the lattice.")
    for axis, (n, wrap) in enumerate(zip(shape, wraps, strict=True)):
        reach = max((abs(offset[axis]) for offset in offsets), default=0)
        if wrap and n <= 2 * reach:
            raise ValueError(f"axis {axis} wraps with {n} nodes, but springs reach {reach} along it; needs at least {2 * reach + 1}.")


def _ends(a: Any, offset: Offset, periodic: tuple[bool, ...], roll: Any) -> tuple[Any, Any]:
    """Values at the tails and heads of a family."""
    tails, heads = [], []
    for n, o, wraps in zip(a.shape, offset, periodic, strict=True):
        lo, hi = (0, 0) if wraps else (max(-o, 0), max(o, 0))
        tails.append(slice(lo, max(n - hi, lo)))
        heads.append(slice(hi, max(n - lo, hi)))
    shifts = [(axis, -o) for axis, (o, wraps) in enumerate(zip(offset, periodic, strict=True)) if wraps and o]
    rolled = roll(a, [s for _, s in shifts], [axis for axis, _ in shifts]) if shifts else a
    return a[tuple(tails)], rolled[tuple(heads)]


def _spread(p: Array, offset: Offset, periodic: tuple[bool, ...]) -> tuple[Array, Array]:
    """A family's values placed at its tails and at its heads, in node shape."""
    zero = np.zeros((), p.dtype)
    at_tail, at_head = [], []
    for o, wraps in zip(offset, periodic, strict=True):
        lo, hi = (0, 0) if wraps else (max(-o, 0), max(o, 0))
        at_tail.append((lo, hi, 0))
        at_head.append((hi, lo, 0))
    tail = lax.pad(p, zero, at_tail)
    head = lax.pad(p, zero, at_head)
    shifts = [(axis, o) for axis, (o, wraps) in enumerate(zip(offset, periodic, strict=True)) if wraps and o]
    if shifts:
        head = jnp.roll(head, [s for _, s in shifts], [axis for axis, _ in shifts])
    return tail, head


__all__ = ["BEND", "BODY", "SHEAR", "STRUCTURAL", "Lattice", "SpringFamilies", "lattice", "minimum_image"]
