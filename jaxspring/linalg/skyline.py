"""The slides' direct solver: `Skyline`, an L D L' factorisation on the envelope.

Column j of the upper triangle is kept from its first nonzero row to the diagonal, which elimination does not leave: for an n x n lattice
n^3 entries instead of n^4. The layout is worked out once, when the solver is made; factoring and solving are compiled, with dense kernels.

    A = L D L'        factor about sum h^2 / 2 multiply-adds, solve about 2 sum h, for column heights h

For a sheet this is the solver that always ends; a lattice of n^3 nodes in space stores n^5 entries, and belongs to conjugate gradients.

Source: slide "Implicit Solution"; Jennings' variable band, Bathe's active columns (see `ordering`, `envelope`, `panels`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..numerics import is_traced, stopped
from ..status import Flag, Status
from ..topology.base import NodeLayout, Topology
from ..topology.permutation import Permutation
from ..vector import Vector
from .assembly import (
    Alike,
    SpringPlaces,
    alike_coordinates,
    entry_addresses,
    find_places,
    read_entries,
    store_entries,
)
from .base import LinearSolver, SolveInfo
from .envelope import Envelope, Panels, Profile
from .iterative import norm
from .operators import SpringMatrix
from .ordering import Given, Natural, Ordering, ReverseCuthillMcKee, smallest_profile
from .panels import factor_panels, solve_panels

# Corrections where directions are taken, of which the factor knows all but the share eps^0.4.
_FOR_TAKEN = 2


class Skyline(LinearSolver):
    """Direct solver: factors a positive definite matrix on its envelope, and keeps the factor while the matrix stands.

    One factor serves all coordinates where they are decoupled and alike by construction; coupled coordinates are factored together.
    A pivot that is not positive gives NaN, and a status PIVOT that names its node.

    Args:
        net: the net whose springs the matrices hold.
        more_nets: other nets on the same nodes.
        order: an `Ordering`, or (N,) integers, the node that is eliminated first, second, ...; None takes `Natural` or
            `ReverseCuthillMcKee`, whichever has the smaller profile.
        block: rows of a panel; None chooses by the profile.

    Attributes:
        ordering: the rule that was taken.
        envelope: what a factor keeps.

    Raises:
        ValueError: nets of different nodes; an order that is no permutation; a block that is not positive.
        TypeError: a net that is traced: make the solver outside `jit`.

    >>> import jaxspring as js
    >>> Skyline(js.lattice((10, 10)), order=Natural()).profile().entries
    1009
    """

    ordering: Ordering = eqx.field(static=True)
    envelope: Envelope = eqx.field(static=True)
    nodes: Permutation = eqx.field(static=True)
    springs: tuple[SpringPlaces, ...] = eqx.field(static=True)
    layout: NodeLayout = eqx.field(static=True)

    def __init__(self, net: Topology, *more_nets: Topology, order: Ordering | Any = None, block: int | None = None):
        nets = (net, *more_nets)
        _check(nets, block)
        edges = np.concatenate([n.edges for n in nets])
        orderings = (Natural(), ReverseCuthillMcKee()) if order is None else (order if isinstance(order, Ordering) else Given(order),)
        self.ordering, places, first = smallest_profile(edges, net.n_nodes, orderings)
        self.envelope = Envelope(places, first, block)
        self.layout = net.layout
        inner = self.layout.permutation
        self.nodes = Permutation(places if inner is None else inner.inverse[places])
        self.springs = tuple(SpringPlaces(n, places) for n in nets)

    def profile(self, coupled: int = 1) -> Profile:
        """Exact counts of one factor, for that many coupled coordinates: 1 where they decouple, D where they do not."""
        return self.envelope.profile(coupled)

    def factor(self, matrix: SpringMatrix) -> SkylineFactor:
        """Factor a matrix, for many right-hand sides. Derivatives by the matrix are not taken: see `solve_in_step`."""
        return self.init(matrix).factor

    def init(self, matrix: SpringMatrix) -> SkylineMemory:
        """The factor of a matrix, and the entries that identify it."""
        classes = alike_coordinates(matrix)
        entries = _read(self, stopped(matrix), classes)
        return SkylineMemory(entries, _factored(self, entries, classes, self._terms(matrix)))

    def solve_in_step(
        self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: SkylineMemory | None
    ) -> tuple[Vector, SolveInfo, SkylineMemory]:
        """Solve, with the factor in `memory` where that is of the same matrix, entry for entry; else with a new one.

        Differentiable in b and in the matrix, by implicit differentiation: the adjoint solve uses the same factor. `guess` is not needed.
        The status is PIVOT with the node, NONFINITE, or SOLVER where rounding left a residual above the square root of the precision.
        """
        memory = self.init(matrix) if memory is None else self._renewed(matrix, memory)
        solve: Callable = partial(_guarded, memory.factor, stopped(matrix))
        x, info = lax.custom_linear_solve(matrix, matrix.pick(b, Vector.zeros_like(b)), solve, symmetric=True, has_aux=True)
        return matrix.pick(x, b), info, memory

    def find_in_step(
        self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: SkylineMemory | None
    ) -> tuple[Vector, SolveInfo, SkylineMemory]:
        """As `solve_in_step`, without a derivative."""
        matrix, b = stopped((matrix, b))
        memory = self.init(matrix) if memory is None else self._renewed(matrix, memory)
        x, info = _guarded(memory.factor, matrix, matrix, matrix.pick(b, Vector.zeros_like(b)))
        return matrix.pick(x, b), info, memory

    def _renewed(self, matrix: SpringMatrix, memory: SkylineMemory) -> SkylineMemory:
        classes, found = memory.factor.classes, alike_coordinates(matrix)
        if not all(any(set(kept) <= set(groups) for groups in found) for kept in classes):
            raise ValueError(
                f"The memory was made for a matrix with the coordinates {classes} factored together; this one has {found}. "
                f"Make a memory with init(matrix) from a matrix built in the same way."
            )
        entries = _read(self, stopped(matrix), classes)
        is_same = jnp.all(jnp.stack([jnp.all(a == b) for a, b in zip(entries, memory.entries, strict=True)]))
        terms = self._terms(matrix)

        # A loop of one turn or none: unlike `cond`, it leaves a factor that is kept where it lies, without a copy.
        def renew(_: Any) -> tuple[Array, SkylineFactor]:
            return jnp.asarray(True), _factored(self, entries, classes, terms)

        _, factor = lax.while_loop(lambda carry: ~carry[0], renew, (is_same, memory.factor))
        return SkylineMemory(entries, factor)

    def _terms(self, matrix: SpringMatrix) -> tuple[SpringPlaces, ...]:
        return tuple(find_places(self.springs, term) for term in matrix.blocks.pairs)


class SkylineFactor(eqx.Module):
    """A factorised matrix.

    Attributes:
        panels: one (C, B, total) array for each number of coupled coordinates: C factors in the storage of `Panels`.
        status: OK, or PIVOT or NONFINITE with the node concerned.
        skyline: the solver that made it.
        classes: which coordinates are factored together, and which share a factor.
    """

    panels: tuple[Array, ...]
    status: Status
    skyline: Skyline
    classes: tuple[Alike, ...] = eqx.field(static=True)

    def solve(self, b: Vector) -> Vector:
        """A^-1 b, for a `Vector` in node shape; NaN where the factorisation failed. For many, use `vmap`."""
        return _solved(self, b)


class SkylineMemory(eqx.Module):
    """What `Skyline` carries from one step to the next.

    Attributes:
        entries: the entries of the matrix that was factored.
        factor: its factor.
    """

    entries: tuple[Array, ...]
    factor: SkylineFactor


def _by_size(skyline: Skyline, classes: tuple[Alike, ...]) -> list[tuple[Panels, tuple[Alike, ...]]]:
    """The classes by number of coupled coordinates: those of one number are factored side by side."""
    sizes = sorted({len(groups[0]) for groups in classes})
    return [(skyline.envelope.panels(d), tuple(c for c in classes if len(c[0]) == d)) for d in sizes]


@eqx.filter_jit
def _read(skyline: Skyline, matrix: SpringMatrix, classes: tuple[Alike, ...]) -> tuple[Array, ...]:
    """(C, M) entries, for each number of coupled coordinates."""
    terms = tuple(find_places(skyline.springs, term) for term in matrix.blocks.pairs)
    return tuple(
        jnp.stack([read_entries(matrix, groups[0], skyline.nodes, terms) for groups in alike]) for _, alike in _by_size(skyline, classes)
    )


@partial(jax.jit, static_argnums=(0, 2, 3))
def _factored(skyline: Skyline, entries: tuple[Array, ...], classes: tuple[Alike, ...], terms: tuple[SpringPlaces, ...]) -> SkylineFactor:
    stored, status = [], Status.ok()
    for values, (panels, _) in zip(entries, _by_size(skyline, classes), strict=True):
        addresses = entry_addresses(panels, terms)

        def factor(values: Array, addresses: Array = addresses, panels: Panels = panels) -> tuple[Array, Array]:
            return factor_panels(panels, store_entries(values, addresses, panels))

        factored, bad = _over_lanes(factor, values)
        stored.append(factored)
        lane = jnp.argmax(bad >= 0)
        node = jnp.asarray(skyline.envelope.order.order)[jnp.minimum(bad[lane], panels.n - 1) // panels.coupled]
        is_finite = jnp.all(jnp.isfinite(values))
        flag = Status.when(Flag.NONFINITE, ~is_finite, node=node).then(Status.when(Flag.PIVOT, is_finite & (bad[lane] >= 0), node=node))
        status = status.then(flag)
    return SkylineFactor(tuple(stored), status, skyline, classes)


@eqx.filter_jit
def _solved(factor: SkylineFactor, b: Vector) -> Vector:
    skyline = factor.skyline
    found: list[Array] = list(b)
    for stored, (panels, alike) in zip(factor.panels, _by_size(skyline, factor.classes), strict=True):
        d, most = panels.coupled, max(len(groups) for groups in alike)
        nothing = jnp.zeros(panels.n, b.dtype)
        right_sides = []
        for groups in alike:
            columns = [jnp.stack([skyline.nodes.inward(b[i].ravel()) for i in group], axis=-1).ravel() for group in groups]
            right_sides.append(jnp.stack([*columns, *[nothing] * (most - len(groups))], axis=-1))
        padded = jnp.pad(jnp.stack(right_sides), ((0, 0), (0, panels.padded - panels.n), (0, 0)))
        x = _over_lanes(partial(solve_panels, panels), stored, padded)[:, : panels.n]
        for lane, groups in enumerate(alike):
            for column, group in enumerate(groups):
                for place, i in enumerate(group):
                    found[i] = skyline.nodes.outward(x[lane, place::d, column]).reshape(b.shape)
    nan = jnp.full((), jnp.nan, b.dtype)
    return Vector(tuple(jnp.where(factor.status.is_ok, a, nan) for a in found))


def _guarded(factor: SkylineFactor, matrix: SpringMatrix, operator: Callable[[Vector], Vector], b: Vector) -> tuple[Vector, SolveInfo]:
    """Solve, correct by the residual where that pays, and look at what is left."""
    size = norm(b)
    is_zero = size == 0
    scale = jnp.maximum(size, jnp.finfo(size.dtype).tiny)
    unit = b / scale
    solve = matrix.within(factor.solve)
    x = solve(unit)
    left = unit - operator(x)
    # In float32 a correction takes most of the error of the solution for one more solve; in float64 there is little left to take, but
    # where directions are taken: each correction then takes all but the share eps^0.4 of it.
    n_corrections = _FOR_TAKEN if matrix.taken else int(unit.dtype == jnp.float32)
    for _ in range(n_corrections):
        x = x + solve(left)
        left = unit - operator(x)
    residual = norm(left)
    status = factor.status.then(Status.when(Flag.NONFINITE, factor.status.is_ok & ~jnp.isfinite(residual)))
    tolerance = jnp.sqrt(jnp.finfo(residual.dtype).eps)
    status = status.then(Status.when(Flag.SOLVER, status.is_ok & ~(residual <= tolerance)))
    return x * scale, SolveInfo(jnp.where(is_zero, jnp.zeros_like(residual), residual), jnp.asarray(n_corrections, jnp.int32), status)


def _over_lanes(function: Callable[..., Any], *arrays: Array) -> Any:
    """`function` of each lane; of a single one without a batch axis, whose kernels are faster."""
    if arrays[0].shape[0] > 1:
        return jax.vmap(function)(*arrays)
    return jax.tree.map(lambda a: a[None], function(*(a[0] for a in arrays)))


def _check(nets: tuple[Topology, ...], block: int | None) -> None:
    for i, net in enumerate(nets):
        if is_traced(net.unboxed()):
            raise TypeError(
                "Skyline looks at the springs of its nets, but these are traced. Make it outside jit, grad and vmap, and pass it in."
            )
        if net.layout != nets[0].layout:
            raise ValueError(
                f"net {i} has nodes of shape {net.node_shape}, in an order of its own, net 0 of shape {nets[0].node_shape}. All must be on "
                f"the same nodes, numbered in the same way inside."
            )
    if block is not None and block < 1:
        raise ValueError(f"block = {block}, but a panel needs at least one row. Pass e.g. block=32, or None to have it chosen.")


__all__ = ["Skyline", "SkylineFactor", "SkylineMemory"]
