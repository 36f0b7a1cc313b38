"""Scenes as files, and the layouts that hand-written programs read fast. NumPy alone: every environment has it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# Columns kept free left of a row: a vector register of float32. A row's right border is the left one of the next.
PAD = 16
# Rows kept free below, for springs over two rows.
BELOW = 2
# Where nodes that do not exist are: away from all others, so that no length is zero.
NOWHERE = 1e6
# Nodes that one vector register takes at a time.
LANES = 16


class Program(NamedTuple):
    """A contender's form of a workload, ready to run.

    Attributes:
        run: takes so many steps from the start, and returns when they are done.
        result: what the last run gave, in the user's order.
    """

    run: Callable[[int], Any]
    result: Callable[[], np.ndarray]


# Name -> a function that builds the program.
Forms = dict[str, Callable[[], Program]]


class Scene:
    """Named arrays and numbers, in a file of NumPy's."""

    def __init__(self, values: dict[str, Any]):
        self._values = values

    @classmethod
    def load(cls, path: Path) -> Scene:
        with np.load(path) as file:
            return cls({name: file[name] for name in file.files})

    def save(self, path: Path) -> None:
        np.savez(path, **self._values)

    def __getitem__(self, name: str) -> np.ndarray:
        return np.asarray(self._values[name])

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def number(self, name: str) -> Any:
        """A float or an int."""
        return self[name].item()

    def with_steps(self, n_steps: int) -> Scene:
        return Scene({**self._values, "n_steps": n_steps})


class Slices(NamedTuple):
    """A graph for vector registers: nodes in slices of 16, each padded to its largest degree; each spring stands at both of its ends.

    Attributes:
        nodes: (M,) the user's node at each place, -1 where there is none.
        starts: (S + 1,) where each slice's entries begin.
        heads: entries: the place of the other end; a place that pads names the node itself, with k = 0.
        springs: entries: which spring it is, -1 where it pads.
    """

    nodes: np.ndarray
    starts: np.ndarray
    heads: np.ndarray
    springs: np.ndarray


def of_springs(values: np.ndarray, shape: tuple[int, int], offsets: np.ndarray) -> np.ndarray:
    """(F, ny, nx) one number a node and family, at the spring's tail; zero where there is no spring. Also (B, F, ny, nx)."""
    ny, nx = shape
    leading = values.shape[:-1]
    dense = np.zeros((*leading, len(offsets), ny, nx), np.float32)
    begin = 0
    for family, (dy, dx) in enumerate(offsets):
        rows, columns = slice(0, ny - dy), slice(max(-dx, 0), nx - max(dx, 0))
        part = dense[..., family, rows, columns]
        size = part.shape[-2] * part.shape[-1]
        part[...] = values[..., begin : begin + size].reshape(part.shape)
        begin += size
    return dense


def to_springs(dense: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """(E,) from (F, ny, nx): the way back."""
    ny, nx = dense.shape[1:]
    parts = [dense[f, : ny - dy, max(-dx, 0) : nx - max(dx, 0)].ravel() for f, (dy, dx) in enumerate(offsets)]
    return np.concatenate(parts)


def padded(values: np.ndarray, fill: float) -> np.ndarray:
    """(..., ny + 2, 16 + nx) with a border of `fill`; and a register's length behind the last row, which its right border reads."""
    *leading, ny, nx = values.shape
    out = np.full((*leading, ny + BELOW, PAD + nx), fill, np.float32)
    out[..., :ny, PAD:] = values
    return out


def abreast(values: np.ndarray) -> np.ndarray:
    """(B, ..., ny, nx) -> (B / 16, ..., ny, nx * 16): sixteen cloths side by side, so that a register holds one node of each."""
    assert len(values) % LANES == 0, "whole registers"
    moved = np.moveaxis(values.reshape(-1, LANES, *values.shape[1:]), 1, -1)
    return np.ascontiguousarray(moved).reshape(*moved.shape[:-2], -1)


def one_by_one(values: np.ndarray) -> np.ndarray:
    """(B / 16, 3, ny, nx * 16) -> (B, ny * nx, 3): the way back."""
    apart = values.reshape(len(values), 3, -1, LANES)
    return apart.transpose(0, 3, 2, 1).reshape(len(values) * LANES, -1, 3)


def incident(edges: np.ndarray, n_nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N + 1,) starts, and for each entry the node at the other end and the spring: a compressed table of both ends."""
    ends = np.concatenate([edges[:, 0], edges[:, 1]])
    others = np.concatenate([edges[:, 1], edges[:, 0]])
    springs = np.tile(np.arange(len(edges)), 2)
    order = np.lexsort((others, ends))
    starts = np.searchsorted(ends[order], np.arange(n_nodes + 1))
    return starts.astype(np.int32), others[order].astype(np.int32), springs[order].astype(np.int32)


def sorted_graph(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes in the scene's order for locality: `order` (place -> user's node), edges by place, sorted by tail, and which spring each is."""
    order = scene["order"]
    place = np.empty_like(order)
    place[order] = np.arange(len(order), dtype=order.dtype)
    edges = place[scene["edges"]]
    springs = np.lexsort((edges.max(axis=1), edges.min(axis=1)))
    return order, edges[springs].astype(np.int32), springs


def slices(scene: Scene, window: int = 1024) -> Slices:
    """Nodes in the scene's order, sorted by degree in windows, so that a slice pads little and neighbours stay near."""
    edges, order = scene["edges"], scene["order"]
    n_nodes = len(order)
    degree = np.bincount(edges.ravel(), minlength=n_nodes)
    by_degree = np.lexsort((-degree[order], np.arange(n_nodes) // window))
    nodes = np.full(-(-n_nodes // LANES) * LANES, -1)
    nodes[:n_nodes] = order[by_degree]
    place = np.empty(n_nodes, int)
    place[nodes[:n_nodes]] = np.arange(n_nodes)
    starts, others, springs = incident(edges, n_nodes)
    widths = np.append(degree, 0)[nodes].reshape(-1, LANES).max(axis=1)
    begins = np.append(0, np.cumsum(widths * LANES))
    heads = np.empty(begins[-1], np.int32)
    which = np.full(begins[-1], -1, np.int32)
    for s, width in enumerate(widths):
        mine = nodes[s * LANES : (s + 1) * LANES]
        block, ids = (np.full((width, LANES), -1, np.int32) for _ in range(2))
        for lane, node in enumerate(mine):
            own = place[node] if node >= 0 else s * LANES + lane
            block[:, lane] = own
            if node >= 0:
                mine_at = slice(starts[node], starts[node + 1])
                block[: degree[node], lane] = place[others[mine_at]]
                ids[: degree[node], lane] = springs[mine_at]
        heads[begins[s] : begins[s + 1]] = block.ravel()
        which[begins[s] : begins[s + 1]] = ids.ravel()
    return Slices(nodes, begins.astype(np.int32), heads, which)


def of_axes(scene: Scene) -> np.ndarray:
    """(3, nz, ny, nx) conductances at the lower node of each axis, zero at the last."""
    shape = tuple(scene["shape"].tolist())
    dense, begin = np.zeros((3, *shape), np.float32), 0
    for axis in (2, 1, 0):
        part = dense[axis][tuple(slice(0, n - (a == axis)) for a, n in enumerate(shape))]
        part[...] = scene["g"][begin : begin + part.size].reshape(part.shape)
        begin += part.size
    return dense


def of_peer(peer: Any, scene: Scene) -> Program:
    """A peer of `benchmarks.fluid_peers` as a program here."""
    if peer is None:
        raise SystemExit("it cannot be imported")
    last: list[Any] = [None]
    programs: dict[int, Any] = {}

    def run(n_steps: int) -> None:
        if n_steps not in programs:  # made once: jax-md's compiles
            programs[n_steps] = peer.steps(scene.number("dt"), n_steps)
        last[0], _ = programs[n_steps]()

    return Program(run, lambda: np.asarray(last[0]))
