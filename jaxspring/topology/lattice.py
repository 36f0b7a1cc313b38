"""Regular lattices in one, two and three dimensions.

A node field is an array of shape (n,), (ny, nx) or (nz, ny, nx). A spring family is one offset: its springs join every node `i`
to node `i + offset`. Differences and sums on the nodes are shifted slices (see `shifts`), so no index is ever read. On a periodic
axis the slice is a roll, and `box` (the period in each coordinate, [m]) takes the nearest image: see `periods`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._arrays import Edges, Numbers, whole_number
from .._checks import is_concrete
from ..numerics import linear_call
from ..vector import Vector
from . import shifts
from .base import Topology
from .edge_field import EdgeField
from .identity import NetIdentity
from .overlay import Overlay
from .periods import as_box, check_wrapped, minimum_image

Offset = tuple[int, ...]


class SpringFamilies:
    """A choice of lattice springs; add choices with `+`.

    A spring of BEND (flexion), of rest length twice the spacing h, stores k h^2 phi^4 / 32 where the row turns by phi: it keeps a sheet
    from folding, but has no bending stiffness where the row is straight, whatever k is. `js.cloth.AngularJoints` and `js.cloth.Hinges`
    have one.

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
        name: tells it from other nets of the same springs, or None: see `named`.
    """

    shape: tuple[int, ...] = eqx.field(static=True)
    offsets: tuple[Offset, ...] = eqx.field(static=True)
    periodic: tuple[bool, ...] = eqx.field(static=True)
    box: Array | None
    name: str | None = eqx.field(static=True, default=None)

    @property
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field."""
        return self.shape

    @property
    def identity(self) -> NetIdentity:
        """Shape, offsets, what wraps, and the name."""
        return NetIdentity("Lattice", (self.shape, self.offsets, tuple(map(bool, self.periodic))), self.name)

    @property
    def node_permutation(self) -> None:
        """Nodes keep the user's order: row-major."""
        return None

    @property
    def grid_shape(self) -> shifts.Grid:
        """What the functions of `shifts` need to know."""
        return shifts.Grid(self.shape, self.offsets, self.periodic)

    @property
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape in which each family's values are kept; it has margins of springs that do not exist (see `shifts`)."""
        return tuple(self.grid_shape.extended(offset) for offset in self.offsets)

    @property
    def family_sizes(self) -> tuple[int, ...]:
        """Number of springs in each family."""
        return tuple(math.prod(self.grid_shape.actual(offset)) for offset in self.offsets)

    @property
    def edges(self) -> np.ndarray:
        """(E, 2) tail and head of each spring: family by family, row-major inside a family."""
        numbers = np.arange(self.n_nodes).reshape(self.shape)
        pairs = []
        for offset in self.offsets:
            steps = [0 if wraps else o for o, wraps in zip(offset, self.periodic, strict=True)]
            tails = tuple(slice(max(-o, 0), n - max(o, 0)) for o, n in zip(steps, self.shape, strict=True))
            heads = np.roll(numbers, [-o for o in offset], range(len(offset)))
            pairs.append(np.stack([numbers[tails].ravel(), heads[tails].ravel()], axis=-1))
        return np.concatenate(pairs).astype(np.int32) if pairs else np.zeros((0, 2), np.int32)

    def with_edges(self, edges: Edges, name: str | None = None) -> Overlay:
        """A further net over the same nodes: see `Topology.with_edges`."""
        return Overlay.on(self.layout, self.box, edges, name)

    def unboxed(self) -> Lattice:
        """The same springs without periods."""
        return eqx.tree_at(lambda net: net.box, self, None, is_leaf=lambda leaf: leaf is None)

    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail along each spring, by shifted slices. A place that a family keeps for no spring has 1 m along each coordinate,
        so that a law of one's own divides by no zero there.
        """
        apart, together = partial(_difference_anywhere, self.grid_shape), partial(_minus_accumulate_anywhere, self.grid_shape)
        columns = [linear_call(apart, together, (), a) for a in x]
        families = self.own(Vector(parts) for parts in zip(*columns, strict=True))
        wrapped = families if self.box is None else self.own(minimum_image(d, self.box) for d in families)
        entries = zip(wrapped.families, self.offsets, strict=True)
        return self.own(d.map(partial(shifts.inside, self.grid_shape, offset=offset, fill=1)) for d, offset in entries)

    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node: each pull on its tail, the opposite on its head, by shifted slices."""
        forward = partial(_minus_accumulate, self.grid_shape)
        backward = partial(_difference, self.grid_shape)
        columns = zip(*(pull.components for pull in pulls.families), strict=True)
        return -Vector(tuple(linear_call(forward, backward, (), tuple(column)) for column in columns))

    def net_pull(self, pull: Callable[..., Vector], x: Vector | tuple[Vector, ...], *fields: Any) -> Vector:
        """Sum of the pulls at each node without masks, since pulls vanish in the margins."""
        moving = x if isinstance(x, tuple) else (x,)
        if not self.offsets:
            return Vector.zeros_like(moving[0])
        apart, together = partial(_difference_anywhere, self.grid_shape), partial(_minus_accumulate_anywhere, self.grid_shape)
        differences = []
        for i, v in enumerate(moving):
            columns = [linear_call(apart, together, (), a) for a in v]
            families = (Vector(parts) for parts in zip(*columns, strict=True))
            differences.append(self.own(families if i or self.box is None else (minimum_image(d, self.box) for d in families)))
        pulls = self.map_springs(pull, *differences, *fields)
        back = zip(*(p.components for p in pulls.families), strict=True)
        return -Vector(tuple(linear_call(together, apart, (), tuple(column)) for column in back))

    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node."""
        if not self.offsets:
            return jnp.zeros(self.shape)
        return linear_call(partial(_sum_at_nodes, self.grid_shape), partial(_sum_of_ends, self.grid_shape), (), values.families)

    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""
        ends = linear_call(partial(_sum_of_ends, self.grid_shape), partial(_sum_at_nodes, self.grid_shape), (), a)
        return self.own(0.5 * both for both in ends)

    def split(self, flat: Array) -> EdgeField:
        """(E,) array -> edge field, by static slices. Springs that do not exist get the value 1: no length divides by zero."""
        families, start = [], 0
        for offset, size in zip(self.offsets, self.family_sizes, strict=True):
            actual = lax.slice(flat, (start,), (start + size,)).reshape(self.grid_shape.actual(offset))
            families.append(shifts.extend(self.grid_shape, actual, offset, 1.0))
            start += size
        return self.own(families)

    def _flatten(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array."""
        entries = zip(field.families, self.offsets, strict=True)
        flat = [jnp.ravel(shifts.crop(self.grid_shape, entry, offset)) for entry, offset in entries]
        return jnp.concatenate(flat) if flat else jnp.zeros((0,))

    def _by_family(self, value: Mapping[Any, Any], name: str) -> tuple[Any, ...]:
        """One number for each offset, from a mapping whose keys are STRUCTURAL, SHEAR, ... or sums of them."""
        found: dict[Offset, Any] = {}
        for springs, number in value.items():
            if not isinstance(springs, SpringFamilies):
                raise TypeError(
                    f"{name} has the key {springs!r:.60}; expected families of springs, e.g. {{STRUCTURAL: 100.0, SHEAR: 50.0}}."
                )
            offsets = springs.offsets(len(self.shape))
            if not set(offsets) & set(self.offsets):
                raise ValueError(f"{name} names {springs}, but this lattice has no such springs. Leave {springs} out.")
            if not set(offsets).isdisjoint(found):
                raise ValueError(f"{name} names the springs of {springs} twice. Name each family once.")
            found.update(dict.fromkeys(offsets, number))
        missing = [offset for offset in self.offsets if offset not in found]
        if missing:
            raise ValueError(f"{name} says nothing of the springs along {missing[0]} (index offset). Name every family of the lattice.")
        return tuple(found[offset] for offset in self.offsets)

    def inside(self, field: EdgeField, fill: float) -> EdgeField:
        """The field with `fill` where a family's margin holds no spring."""
        entries = zip(field.families, self.offsets, strict=True)
        return self.own(shifts.inside(self.grid_shape, entry, offset, fill) for entry, offset in entries)

    def grid(self, spacing: float | Sequence[float] | None = None) -> np.ndarray:
        """(N, D) rest positions [m] of a grid with `spacing` along x (last axis), y, z.

        None is 1 m, and the period over the number of nodes along an axis that wraps.

        Raises:
            ValueError: a spacing that does not fit the period of an axis that wraps.
        """
        wanted = np.broadcast_to(np.asarray(1.0 if spacing is None else spacing, float), (len(self.shape),))
        steps = [self._step(axis, h, spacing is None) for axis, h in enumerate(wanted[::-1])][::-1]
        axes = np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij")
        return np.stack([axis.ravel() * h for axis, h in zip(axes[::-1], steps, strict=True)], axis=-1)

    def _step(self, axis: int, spacing: float, may_be_chosen: bool) -> float:
        """The spacing along an axis, which must close where the axis wraps."""
        coordinate, n = len(self.shape) - 1 - axis, self.shape[axis]
        if not self.periodic[axis] or self.box is None or not is_concrete(self.box) or self.box.shape[0] <= coordinate:
            return spacing
        period = float(self.box[coordinate])
        if period == 0 or abs(n * spacing - period) <= 1e-6 * period:
            return spacing
        if may_be_chosen:
            return period / n
        name = "xyz"[coordinate]
        raise ValueError(
            f"spacing = {spacing} along {name} takes {n} nodes once round {n * spacing:.9g} m, but box[{coordinate}] = {period:.9g} m. "
            f"The wrapped springs alone would be stretched. Pass spacing = {period / n:.9g}, or build the lattice with a period of "
            f"{n * spacing:.9g}; strain a net by its points."
        )


def lattice(
    shape: int | Sequence[int],
    springs: SpringFamilies = STRUCTURAL,
    periodic: bool | Sequence[bool] = False,
    box: Numbers | None = None,
) -> Lattice:
    """A chain, a sheet or a block of nodes: shape n or (n,), (ny, nx), (nz, ny, nx).

    Args:
        shape: nodes along each axis, slowest first, as in `array.shape`.
        springs: sum of STRUCTURAL, SHEAR (2-D diagonals, 3-D face diagonals), BODY (3-D body diagonals) and BEND (second
            neighbours, which have no stiffness against a first small bending: see `SpringFamilies`).
        periodic: whether an axis wraps round, for all axes or one each.
        box: (D,) period of each coordinate [m] where an axis wraps; zero where a coordinate does not. Required if any axis wraps.

    Returns:
        The net, without points: `net.grid(spacing)` has those of the rest shape, (N, D) [m].

    Raises:
        ValueError: an empty lattice, more than three axes, a family that this dimension lacks, a wrap without a box, a period that is
            negative, not finite, or zero along an axis that wraps.

    >>> net = lattice((3, 4), springs=STRUCTURAL + SHEAR)
    >>> net.n_nodes, net.n_springs
    (12, 29)
    """
    given = tuple(shape) if isinstance(shape, Iterable) and getattr(shape, "ndim", 1) else (shape,)
    shape = tuple(whole_number("shape", n) for n in given)
    if not 1 <= len(shape) <= 3:
        raise ValueError(f"shape = {shape} has {len(shape)} axes; expected 1 (chain), 2 (sheet) or 3 (block).")
    if min(shape) < 1:
        raise ValueError(f"shape = {shape} holds no node; every axis needs at least 1.")
    wraps = (periodic,) * len(shape) if isinstance(periodic, (bool, np.bool_)) else tuple(bool(p) for p in periodic)
    if len(wraps) != len(shape):
        raise ValueError(f"periodic has {len(wraps)} entries, but shape = {shape} has {len(shape)} axes.")
    offsets = tuple(o for o in springs.offsets(len(shape)) if all(w or abs(s) < n for s, n, w in zip(o, shape, wraps, strict=True)))
    box = as_box(box)
    if any(wraps):
        check_wrapped(shape, wraps, box)
        _check_wrap(shape, wraps, offsets)
    return Lattice(shape, offsets, wraps, box)


def _check_wrap(shape: tuple[int, ...], wraps: tuple[bool, ...], offsets: tuple[Offset, ...]) -> None:
    for axis, (n, wrap) in enumerate(zip(shape, wraps, strict=True)):
        reach = max((abs(offset[axis]) for offset in offsets), default=0)
        if wrap and n <= 2 * reach:
            raise ValueError(f"axis {axis} wraps with {n} nodes, but springs reach {reach} along it; needs at least {2 * reach + 1}.")


def _difference(grid: shifts.Grid, _: Any, x: Array) -> tuple[Array, ...]:
    return shifts.difference(grid, x)


def _minus_accumulate(grid: shifts.Grid, _: Any, pulls: tuple[Array, ...]) -> Array:
    return -shifts.accumulate(grid, pulls)


def _difference_anywhere(grid: shifts.Grid, _: Any, x: Array) -> tuple[Array, ...]:
    return shifts.difference_anywhere(grid, x)


def _minus_accumulate_anywhere(grid: shifts.Grid, _: Any, pulls: tuple[Array, ...]) -> Array:
    return -shifts.accumulate_anywhere(grid, pulls)


def _sum_of_ends(grid: shifts.Grid, _: Any, a: Array) -> tuple[Array, ...]:
    return shifts.sum_of_ends(grid, a)


def _sum_at_nodes(grid: shifts.Grid, _: Any, values: tuple[Array, ...]) -> Array:
    return shifts.sum_at_nodes(grid, values)


__all__ = ["BEND", "BODY", "SHEAR", "STRUCTURAL", "Lattice", "SpringFamilies", "lattice"]
