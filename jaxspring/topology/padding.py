"""Different nets as one batch: brought to the same shapes, so that one program serves them all, under `vmap`.

Nodes of all nets are put into the same classes by their number of springs; places that a net has no node for hold a node that nothing
acts on, and springs that it does not have are copies of its first one with the stiffness zero, which no node reads.

Source: the classes are those of `ends.py`; the layout is ours.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._arrays import Numbers, own
from .end_tables import WIDEST, by_class, common, tables
from .ends import Ends
from .graph import Graph
from .listed import digest_of
from .permutation import Permutation


class PaddedGraph(Graph):
    """One of the nets of a `NetBatch`, or all of them with their arrays stacked. Its nodes and springs are numbered by places."""

    @property
    def edges(self) -> np.ndarray:
        """Not known: each net of the batch has its own.

        Raises:
            TypeError: always. What needs the list of springs, as direct solvers, multigrid, pictures and files do, takes one net alone.
        """
        raise TypeError(
            "a net of a batch has no list of springs of its own: all nets share one program. Direct solvers, multigrid, pictures and files "
            "take one of the nets that were given to pad_nets; JaxCG and CG work in batches."
        )


class NetBatch(eqx.Module):
    """Nets of like size as one: map over `net` and over what `points`, `at_nodes` and `at_springs` make of the nets' own arrays.

    Attributes:
        net: the nets, every array with the nets on its first axis.
        free: (B, N) True where there is a node: pass each net's row as the system's `free`, or and it with one of your own.
        nodes: for each net, from its nodes to places (static).
        springs: for each net, from its springs to places (static).
        n_nodes: number of nodes of each net (static).
        n_springs: number of springs of each net (static).
        anchors: the node of each net whose place empty places share (static).
    """

    net: PaddedGraph
    free: Bool[Array, "B N"]
    nodes: tuple[Permutation, ...] = eqx.field(static=True)
    springs: tuple[Permutation, ...] = eqx.field(static=True)
    n_nodes: tuple[int, ...] = eqx.field(static=True)
    n_springs: tuple[int, ...] = eqx.field(static=True)
    anchors: tuple[int, ...] = eqx.field(static=True)

    def points(self, points: Sequence[Numbers]) -> Array:
        """For each net (N_b, D) positions [m] -> (B, N, D). Empty places lie where a node of the net is.

        Raises:
            ValueError: another number of arrays than nets, or of rows than nodes.
        """
        arrays = self._each("points", points, self.n_nodes)
        return _stacked(self.nodes, arrays, [a[i] for a, i in zip(arrays, self.anchors, strict=True)])

    def at_nodes(self, values: Sequence[Numbers], fill: float = 0.0) -> Array:
        """For each net (N_b, ...) values of its nodes -> (B, N, ...), `fill` at empty places: velocities 0, masses 1.

        Raises:
            ValueError: another number of arrays than nets, or of rows than nodes.
        """
        return _stacked(self.nodes, self._each("values", values, self.n_nodes), [fill] * len(self.nodes))

    def at_springs(self, values: Sequence[Numbers], fill: float = 0.0) -> Array:
        """For each net (E_b,) values of its springs -> (B, E), `fill` for springs that it does not have: stiffness 0, rest length 1.

        Raises:
            ValueError: another number of arrays than nets, or of rows than springs.
        """
        return _stacked(self.springs, self._each("values", values, self.n_springs), [fill] * len(self.springs))

    def of_nodes(self, values: Numbers) -> list[Array]:
        """(B, N, ...) -> for each net (N_b, ...), in its own order."""
        return _apart(self.nodes, self.n_nodes, values)

    def of_springs(self, values: Numbers) -> list[Array]:
        """(B, E, ...) -> for each net (E_b, ...), in its own order."""
        return _apart(self.springs, self.n_springs, values)

    def _each(self, name: str, values: Sequence[Numbers], counts: tuple[int, ...]) -> list[Array]:
        arrays = [own(f"{name}[{b}]", a) for b, a in enumerate(values)]
        if len(arrays) != len(counts):
            raise ValueError(f"{name} holds {len(arrays)} arrays for {len(counts)} nets.")
        for b, (a, n) in enumerate(zip(arrays, counts, strict=True)):
            if a.ndim == 0 or a.shape[0] != n:
                raise ValueError(f"{name}[{b}] has shape {a.shape}; net {b} asks for {n} rows.")
        return arrays


def pad_nets(nets: Sequence[Graph], capacity: tuple[int, int, int] | None = None) -> NetBatch:
    """Different graphs as one batch, for `jax.vmap` and `js.batch`: one compile, one program.

    With a capacity, batches made one after the other share that program as well, such as a mesh that is refined while it runs. Such nets
    are told apart by their capacity alone: broken springs of one mean nothing to another.

    Args:
        nets: one or more graphs, with or without periods alike. What a batch costs is what its largest net costs, for each of them.
        capacity: room for so many nodes, springs, and springs at a node; None: what these nets need.

    Returns:
        A `NetBatch`: the stacked net, and what brings arrays of the nets to its places and back.

    Raises:
        ValueError: no net, a net without springs, one with more than 64 springs at a node, periods in some nets only; more than there
            is room for, or a node without a spring where a capacity is given.
        TypeError: a net that is no `Graph`.

    >>> import jax
    >>> import jaxspring as js
    >>> chain, star = js.Graph.from_edges([(0, 1), (1, 2)], 3), js.Graph.from_edges([(0, 1), (0, 2), (0, 3)], 4)
    >>> batch = pad_nets([chain, star])
    >>> def pulled(net, points, k, free):
    ...     system = js.System(net, 1.0, js.Springs(net, k, 1.0), free=free)
    ...     return system.force(js.State.from_points(net, points)).x
    >>> x = batch.points([[[0.0], [2.0], [4.0]], [[0.0], [2.0], [2.0], [2.0]]])
    >>> k = batch.at_springs([[1.0, 1.0], [1.0, 1.0, 1.0]])
    >>> for force in batch.of_nodes(jax.vmap(pulled)(batch.net, x, k, batch.free)):
    ...     print(force)
    [ 1.  0. -1.]
    [ 3. -1. -1. -1.]
    """
    nets = list(nets)
    _check(nets)
    pairs = [net.edges for net in nets]
    degrees = [np.bincount(p.ravel(), minlength=net.n_nodes) for net, p in zip(nets, pairs, strict=True)]
    for b, degree in enumerate(degrees):
        if degree.max() > WIDEST:
            raise ValueError(f"nets[{b}] has a node with {degree.max()} springs; in a batch of nets a node has {WIDEST} at most.")
    falling, n_springs = _room(degrees, pairs, capacity)
    at = np.argsort(by_class(falling))
    made = [_placed_net(net, p, d, falling, at, n_springs) for net, p, d in zip(nets, pairs, degrees, strict=True)]
    every = [ends if ends.real is not None else dataclasses.replace(ends, real=jnp.ones(ends.entries.shape, bool)) for ends, *_ in made]
    ends = jax.tree.map(lambda *leaves: jnp.stack(leaves), *every)
    stacked = PaddedGraph(
        ends=ends,
        box=None if nets[0].box is None else jnp.stack([jnp.asarray(net.box) for net in nets]),
        triangles=None,
        count=len(falling),
        nodes=Permutation(np.arange(len(falling))),
        springs=Permutation(np.arange(n_springs)),
        digest=_digest(nets, pairs, capacity),
        name=None,
    )
    nodes, springs = tuple(p for _, p, _, _ in made), tuple(s for *_, s, _ in made)
    free = jnp.asarray(np.stack([p.order < net.n_nodes for p, net in zip(nodes, nets, strict=True)]))
    counts = tuple(net.n_nodes for net in nets), tuple(len(p) for p in pairs)
    return NetBatch(stacked, free, nodes, springs, *counts, anchors=tuple(a for *_, a in made))


def _check(nets: list[Any]) -> None:
    if not nets:
        raise ValueError("no net was given; expected one or more graphs.")
    for b, net in enumerate(nets):
        if not isinstance(net, Graph) or isinstance(net, PaddedGraph):
            raise TypeError(f"nets[{b}] is a {type(net).__name__}; expected a Graph. Lattices of one shape need no padding.")
        if net.n_springs == 0:
            raise ValueError(f"nets[{b}] has no spring.")
        if (net.box is None) != (nets[0].box is None) or (net.box is not None and net.box.shape != nets[0].box.shape):
            raise ValueError(f"nets[{b}] and nets[0] have not the same periodic coordinates; all nets of a batch have, or none.")


def _digest(nets: list[Any], pairs: list[np.ndarray], capacity: tuple[int, int, int] | None) -> str:
    """Of the nets and their springs; where there is a capacity, of that alone."""
    if capacity is not None:
        return digest_of(np.array([[-1, -1], [len(nets), -1], capacity[:2], [capacity[2], -1]]))
    return digest_of(np.concatenate([np.concatenate([p, [[net.n_nodes, -1]]]) for net, p in zip(nets, pairs, strict=True)]))


def _room(degrees: list[np.ndarray], pairs: list[np.ndarray], capacity: tuple[int, int, int] | None) -> tuple[np.ndarray, int]:
    """Widths of the places of nodes, in falling order, and how many springs; ValueError where the capacity has no room for a net."""
    if capacity is None:
        return common(degrees), max(len(p) for p in pairs)
    n_nodes, n_springs, most = capacity
    if not 0 < most <= WIDEST:
        raise ValueError(f"capacity gives a node room for {most} springs; expected 1 to {WIDEST}.")
    for b, (degree, edges) in enumerate(zip(degrees, pairs, strict=True)):
        needs = (("nodes", len(degree), n_nodes), ("springs", len(edges), n_springs), ("springs at a node", int(degree.max()), most))
        for what, needed, room in needs:
            if needed > room:
                raise ValueError(f"nets[{b}] has {needed} {what}, but the capacity has room for {room}. Pass a larger one.")
        if not degree.all():
            raise ValueError(f"nets[{b}]: node {int(np.argmin(degree))} has no spring; with a capacity every node needs one.")
    return common([*degrees, np.full(n_nodes, most)]), n_springs


def _placed_net(
    net: Graph, pairs: np.ndarray, degree: np.ndarray, falling: np.ndarray, at: np.ndarray, n_springs: int
) -> tuple[Ends, Permutation, Permutation, int]:
    """Tables of one net; from its nodes and springs to places; the node whose place empty ones share."""
    n, size = net.n_nodes, len(falling)
    # By rank: the node with most springs has the widest place. Among equals, near ones stay near.
    inner = net.nodes.inverse
    ranked = np.lexsort((inner, -degree))
    connected = ranked[degree[ranked] > 0]
    place = np.full(n, -1)
    # Inside a class in the net's own order, for locality.
    mine = at[: len(connected)]
    for w in np.unique(falling[: len(connected)]):
        of_class = np.flatnonzero(falling[: len(connected)] == w)
        nodes = connected[of_class]
        place[nodes[np.argsort(inner[nodes])]] = np.sort(mine[of_class])
    loners = ranked[degree[ranked] == 0]
    place[loners] = at[falling == 0][: len(loners)]
    order = np.full(size, -1)
    order[place] = np.arange(n)
    order[order < 0] = np.arange(n, size)
    kept = net.springs.order
    ends = _filled_up(tables(place[pairs[kept]], falling[by_class(falling)]), n_springs)
    springs = Permutation(np.concatenate([kept, np.arange(len(pairs), n_springs)]))
    anchor = int(order[place[degree > 0].min()])
    return ends, Permutation(order), springs, anchor


def _filled_up(ends: Ends, n_springs: int) -> Ends:
    """With copies of the first spring, up to so many."""
    count = ends.tails.shape[0]
    more = n_springs - count

    def longer(a: Array) -> Array:
        return jnp.concatenate([a, jnp.broadcast_to(a[:1], (more,))])

    entries = jnp.where(ends.entries >= count, ends.entries + more, ends.entries)
    tails, heads, at_tails, at_heads = (longer(a) for a in (ends.tails, ends.heads, ends.at_tails, ends.at_heads))
    exists = jnp.arange(n_springs) < count
    return dataclasses.replace(ends, entries=entries, tails=tails, heads=heads, at_tails=at_tails, at_heads=at_heads, exists=exists)


def _stacked(permutations: tuple[Permutation, ...], arrays: list[Array], fills: Sequence[Any]) -> Array:
    """Each array (n, ...) in the user's order, filled up, by places."""

    def placed(permutation: Permutation, a: Array, fill: Any) -> Array:
        more = jnp.broadcast_to(jnp.asarray(fill, a.dtype), (permutation.order.size - a.shape[0], *a.shape[1:]))
        return jnp.moveaxis(permutation.inward(jnp.moveaxis(jnp.concatenate([a, more]), 0, -1)), -1, 0)

    return jnp.stack([placed(*each) for each in zip(permutations, arrays, fills, strict=True)])


def _apart(permutations: tuple[Permutation, ...], counts: tuple[int, ...], values: Numbers) -> list[Array]:
    rows = own("values", values)
    if rows.ndim < 2 or rows.shape[:2] != (len(counts), permutations[0].order.size):
        raise ValueError(f"values has shape {rows.shape}; expected ({len(counts)}, {permutations[0].order.size}, ...).")
    return [jnp.moveaxis(p.outward(jnp.moveaxis(a, 0, -1)), -1, 0)[:n] for p, a, n in zip(permutations, rows, counts, strict=True)]


__all__ = ["NetBatch", "PaddedGraph", "pad_nets"]
