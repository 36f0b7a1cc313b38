"""numba: the whole loop over steps in one compiled function, on one thread or two.

Lattices row by row on component arrays, as in C: each spring once, its pulls kept in a row until both ends have been reached. Graphs in
three forms, of which the fastest is taken: over springs, over a table of both ends of every node, and over slices of 16 nodes.
"""

from __future__ import annotations

import os
from typing import Any

import numba as nb
import numpy as np

from . import numba_others
from .layouts import LANES, NOWHERE, Forms, Program, Scene, incident, of_springs, padded, slices, sorted_graph

THREADS = int(os.environ.get("NUMBA_NUM_THREADS", "1"))
ONE, TINY = np.float32(1), np.float32(1e-30)
# Of the lattice's families: rows down and columns to the right, from tail to head.
OFFSETS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))
fast = nb.njit(fastmath=True, error_model="numpy")
threaded = nb.njit(fastmath=True, error_model="numpy", parallel=True)


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    kind = str(scene["kind"])
    counts = sorted({1, THREADS})
    if kind == "cloth":
        return {f"rows, {n} thread(s)": lambda n=n: cloth(scene, n) for n in counts}
    if kind == "batch":
        return {f"rows, {n} thread(s)": lambda n=n: batch(scene, n) for n in counts}
    if kind == "mesh":
        found: Forms = {"springs, 1 thread": lambda: over_springs(scene)}
        found |= {f"ends, {n} thread(s)": lambda n=n: over_ends(scene, n) for n in counts}
        return found | {f"slices, {n} thread(s)": lambda n=n: over_slices(scene, n) for n in counts}
    return numba_others.forms(scene, counts)


@fast
def pull_family(k, l, x0, x1, x2, h0, h1, h2, p0, p1, p2, s0, s1, s2):
    """Pulls of the springs of one row and family, and their sums at the tails. All arrays begin at the row's first node."""
    for j in range(len(k)):
        d0, d1, d2 = h0[j] - x0[j], h1[j] - x1[j], h2[j] - x2[j]
        w = k[j] * (ONE - l[j] / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
        p0[j], p1[j], p2[j] = w * d0, w * d1, w * d2
        s0[j] += w * d0
        s1[j] += w * d1
        s2[j] += w * d2


@fast
def pull_row(i, lanes, k, l, x, pulls, sums):
    """Pulls of a row's springs; those of three rows are kept."""
    n, left = k.shape[2], LANES * lanes
    sums[...] = 0
    for f in range(len(OFFSETS)):
        down, right = OFFSETS[f]
        begin = left + right * lanes
        h, p = x[:, i + down, begin : begin + n], pulls[i % 3, f, :, left : left + n]
        t = x[:, i, left : left + n]
        pull_family(k[f, i], l[f, i], t[0], t[1], t[2], h[0], h[1], h[2], p[0], p[1], p[2], sums[0], sums[1], sums[2])


@fast
def move_component(own, a, b, c, d, e, f, x, to, v, dt):
    """Velocities and positions of a row, for one component."""
    for j in range(len(own)):
        u = v[j] + dt * (own[j] - a[j] - b[j] - c[j] - d[j] - e[j] - f[j])
        v[j] = u
        to[j] = x[j] + dt * u


@fast
def step_rows(begin, end, lanes, k, l, x, to, v, dt):
    """One step of some rows; those two above are computed for their pulls alone."""
    n, left, stride = k.shape[2], LANES * lanes, x.shape[2]
    pulls, sums = np.zeros((3, 6, 3, stride), np.float32), np.zeros((3, n), np.float32)
    for i in range(max(begin - 2, 0), end):
        pull_row(i, lanes, k, l, x, pulls, sums)
        if i >= begin:
            here, above, top = pulls[i % 3], pulls[(i + 2) % 3], pulls[(i + 1) % 3]
            for c in range(3):
                a, b = here[0, c, left - lanes :][:n], here[4, c, left - 2 * lanes :][:n]
                p, q, r = above[1, c, left:][:n], above[2, c, left - lanes :][:n], above[3, c, left + lanes :][:n]
                row = (x[c, i, left:][:n], to[c, i, left:][:n], v[c, i, left:][:n])
                move_component(sums[c], a, b, p, q, r, top[5, c, left:][:n], row[0], row[1], row[2], dt)


@fast
def cloth_steps(k, l, x, v, dt, n_steps, lanes):
    for t in range(n_steps):
        step_rows(0, k.shape[1], lanes, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


@threaded
def cloth_steps_threaded(k, l, x, v, dt, n_steps, threads):
    rows = k.shape[1]
    for t in range(n_steps):
        for part in nb.prange(threads):
            step_rows(rows * part // threads, rows * (part + 1) // threads, 1, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


def cloth(scene: Scene, threads: int) -> Program:
    """One cloth; two buffers of positions."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    assert tuple(map(tuple, offsets.tolist())) == OFFSETS
    k, l = (of_springs(scene[name], (ny, nx), offsets) for name in ("k", "l"))
    # A register's length more, so that a row's right border can be read behind the last row too.
    wide = [np.pad(scene[name].T.reshape(3, ny, nx), ((0, 0), (0, 0), (0, LANES)), constant_values=NOWHERE) for name in ("x", "v")]
    start, speed = padded(wide[0], NOWHERE), padded(wide[1], 0)
    x, v, dt, last = np.stack([start, start]), speed.copy(), scene["dt"], [0]

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        if threads == 1:
            cloth_steps(k, l, x, v, np.float32(dt), n_steps, 1)
        else:
            cloth_steps_threaded(k, l, x, v, np.float32(dt), n_steps, threads)

    return Program(run, lambda: x[last[0], :, :ny, LANES : LANES + nx].reshape(3, -1).T)


@fast
def one_block(k, l, x, v, dt, n_steps):
    cloth_steps(k, l, x, v, dt, n_steps, LANES)


@threaded
def blocks_threaded(k, l, x, v, dt, n_steps):
    for b in nb.prange(len(k)):
        one_block(k[b], l, x[b], v[b], dt, n_steps)


@fast
def blocks(k, l, x, v, dt, n_steps):
    for b in range(len(k)):
        one_block(k[b], l, x[b], v[b], dt, n_steps)


def batch(scene: Scene, threads: int) -> Program:
    """Sixteen cloths side by side, so that a register holds one node of each."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    n_cloths, n_blocks = len(scene["x"]), len(scene["x"]) // LANES

    def abreast(a: np.ndarray) -> np.ndarray:
        """(B, ..., ny, nx) -> (blocks, ..., ny, nx * 16)."""
        moved = np.moveaxis(a.reshape(n_blocks, LANES, *a.shape[1:]), 1, -1)
        return np.ascontiguousarray(moved).reshape(*moved.shape[:-2], -1)

    def bordered(a: np.ndarray, fill: float) -> np.ndarray:
        out = np.full((n_blocks, 3, ny + 2, (nx + 2 * LANES) * LANES), fill, np.float32)
        out[..., :ny, LANES * LANES : -LANES * LANES] = abreast(a.transpose(0, 2, 1).reshape(-1, 3, ny, nx))
        return out

    k = abreast(of_springs(scene["k"], (ny, nx), offsets))
    l = np.repeat(of_springs(scene["l"], (ny, nx), offsets), LANES, axis=-1)
    start, speed = bordered(scene["x"], NOWHERE), bordered(scene["v"], 0)
    x, v, dt, last = np.stack([start, start], axis=1), speed.copy(), np.float32(scene["dt"]), [0]

    def run(n_steps: int) -> None:
        x[:, 0], v[...], last[0] = start, speed, n_steps % 2
        (blocks if threads == 1 else blocks_threaded)(k, l, x, v, dt, n_steps)

    def result() -> np.ndarray:
        inner = x[:, last[0], :, :ny, LANES * LANES : -LANES * LANES].reshape(n_blocks, 3, ny * nx, LANES)
        return inner.transpose(0, 3, 2, 1).reshape(n_cloths, ny * nx, 3)

    return Program(run, result)


@fast
def spring_steps(tails, heads, k, l, x, v, dt, n_steps):
    """Every spring once, added to both of its ends."""
    f = np.zeros_like(x)
    for _ in range(n_steps):
        f[...] = 0
        for e in range(len(k)):
            i, j = tails[e], heads[e]
            d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            w = k[e] * (ONE - l[e] / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
            f[i, 0] += w * d0
            f[i, 1] += w * d1
            f[i, 2] += w * d2
            f[j, 0] -= w * d0
            f[j, 1] -= w * d1
            f[j, 2] -= w * d2
        for i in range(len(x)):
            for c in range(4):
                v[i, c] += dt * f[i, c]
                x[i, c] += dt * v[i, c]


@fast
def end_nodes(begin, end, starts, others, k, l, x, to, v, dt):
    """Some nodes, each from all of its springs."""
    for i in range(begin, end):
        f0 = f1 = f2 = np.float32(0)
        for e in range(starts[i], starts[i + 1]):
            j = others[e]
            d0, d1, d2 = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
            w = k[e] * (ONE - l[e] / np.sqrt(d0 * d0 + d1 * d1 + d2 * d2))
            f0, f1, f2 = f0 + w * d0, f1 + w * d1, f2 + w * d2
        v[i, 0] += dt * f0
        v[i, 1] += dt * f1
        v[i, 2] += dt * f2
        for c in range(3):
            to[i, c] = x[i, c] + dt * v[i, c]


@fast
def end_steps(starts, others, k, l, x, v, dt, n_steps):
    for t in range(n_steps):
        end_nodes(0, len(v), starts, others, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


@threaded
def end_steps_threaded(starts, others, k, l, x, v, dt, n_steps, threads):
    n = len(v)
    for t in range(n_steps):
        for p in nb.prange(threads):
            end_nodes(n * p // threads, n * (p + 1) // threads, starts, others, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


@fast
def some_slices(begin, end, starts, heads, k, l, x, to, v, dt):
    """Some slices of 16 nodes, a register of springs at a time. x: (3, M)."""
    f = np.zeros((3, LANES), np.float32)
    for s in range(begin, end):
        f[...] = 0
        f0, f1, f2 = f[0], f[1], f[2]
        own0, own1, own2 = x[0, s * LANES :][:LANES], x[1, s * LANES :][:LANES], x[2, s * LANES :][:LANES]
        for e in range(starts[s], starts[s + 1], LANES):
            hs, ks, ls = heads[e : e + LANES], k[e : e + LANES], l[e : e + LANES]
            for a in range(LANES):
                j = hs[a]
                d0, d1, d2 = x[0, j] - own0[a], x[1, j] - own1[a], x[2, j] - own2[a]
                w = ks[a] * (ONE - ls[a] / np.sqrt(max(d0 * d0 + d1 * d1 + d2 * d2, TINY)))
                f0[a] += w * d0
                f1[a] += w * d1
                f2[a] += w * d2
        for c in range(3):
            speed, here, there = v[c, s * LANES :][:LANES], x[c, s * LANES :][:LANES], to[c, s * LANES :][:LANES]
            for a in range(LANES):
                speed[a] += dt * f[c, a]
                there[a] = here[a] + dt * speed[a]


@fast
def slice_steps(starts, heads, k, l, x, v, dt, n_steps):
    for t in range(n_steps):
        some_slices(0, len(starts) - 1, starts, heads, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


@threaded
def slice_steps_threaded(starts, heads, k, l, x, v, dt, n_steps, threads):
    n = len(starts) - 1
    for t in range(n_steps):
        for p in nb.prange(threads):
            some_slices(n * p // threads, n * (p + 1) // threads, starts, heads, k, l, x[t % 2], x[(t + 1) % 2], v, dt)


def _fours(values: np.ndarray, order: np.ndarray) -> np.ndarray:
    """(N, 4), nodes in order: four numbers lie better than three."""
    return np.pad(values[order], ((0, 0), (0, 1)))


def _back(order: np.ndarray, values: np.ndarray) -> np.ndarray:
    out = np.empty((len(order), 3), np.float32)
    out[order] = values[:, :3]
    return out


def over_springs(scene: Scene) -> Program:
    """Nodes in the order for locality, springs sorted along."""
    order, edges, springs = sorted_graph(scene)
    tails, heads = (np.ascontiguousarray(a) for a in edges.T)
    k, l, dt = scene["k"][springs], scene["l"][springs], np.float32(scene["dt"])
    start, speed = _fours(scene["x"], order), _fours(scene["v"], order)
    x, v = start.copy(), speed.copy()

    def run(n_steps: int) -> None:
        x[...], v[...] = start, speed
        spring_steps(tails, heads, k, l, x, v, dt, n_steps)

    return Program(run, lambda: _back(order, x))


def over_ends(scene: Scene, threads: int) -> Program:
    """Nodes in the order for locality, each with its springs."""
    order, edges, springs = sorted_graph(scene)
    starts, others, which = incident(edges, len(order))
    k, l, dt = scene["k"][springs][which], scene["l"][springs][which], np.float32(scene["dt"])
    start, speed = _fours(scene["x"], order), _fours(scene["v"], order)
    x, v, last = np.stack([start, start]), speed.copy(), [0]

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        if threads == 1:
            end_steps(starts, others, k, l, x, v, dt, n_steps)
        else:
            end_steps_threaded(starts, others, k, l, x, v, dt, n_steps, threads)

    return Program(run, lambda: _back(order, x[last[0]]))


def over_slices(scene: Scene, threads: int) -> Program:
    """The table that C reads, on component arrays."""
    table = slices(scene)
    real, dt = table.nodes >= 0, np.float32(scene["dt"])
    k, l = (np.where(table.springs >= 0, scene[name][table.springs], np.float32(0)) for name in ("k", "l"))
    start, speed = np.zeros((2, 3, len(table.nodes)), np.float32)
    start[:, real], speed[:, real] = scene["x"][table.nodes[real]].T, scene["v"][table.nodes[real]].T
    x, v, heads, last = np.stack([start, start]), speed.copy(), table.heads.astype(np.uint32), [0]
    arguments: Any = (table.starts, heads, k, l, x, v, dt)

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        if threads == 1:
            slice_steps(*arguments, n_steps)
        else:
            slice_steps_threaded(*arguments, n_steps, threads)

    def result() -> np.ndarray:
        out = np.empty_like(scene["x"])
        out[table.nodes[real]] = x[last[0]][:, real].T
        return out

    return Program(run, result)
