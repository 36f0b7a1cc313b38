"""By numba: the whole loop over steps in one compiled function, on one thread or two.

Lattices row by row on component arrays, as in C: each spring once, its pulls kept in a row until both ends have been reached. Graphs in
three forms, of which the fastest is taken: over springs, over a table of both ends of every node, and over slices of 16 nodes.
"""

# pyright: reportMissingImports=false, reportCallIssue=false

from __future__ import annotations

import os
from typing import Any

import numba as nb
import numpy as np

from . import numba_others
from .layouts import LANES, NOWHERE, Forms, Program, Scene, abreast, incident, of_springs, one_by_one, slices, sorted_graph

THREADS = int(os.environ.get("NUMBA_NUM_THREADS", "1"))
ONE, TINY = np.float32(1), np.float32(1e-30)
# Columns between two rows, which no spring reaches: those of bend springs.
BORDER = 2
# Values of a component that are worked on at a time.
CHUNK = 1024
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
    """Pulls of the springs of some rows and one family, and their sums at the tails. All arrays begin at the first node."""
    for j in range(len(k)):
        d0, d1, d2 = h0[j] - x0[j], h1[j] - x1[j], h2[j] - x2[j]
        w = k[j] * (ONE - l[j] / np.sqrt(max(d0 * d0 + d1 * d1 + d2 * d2, TINY)))
        p0[j], p1[j], p2[j] = w * d0, w * d1, w * d2
        s0[j] += w * d0
        s1[j] += w * d1
        s2[j] += w * d2


@fast
def pull_rows(begin, end, place, stride, lanes, k, l, x, pulls, sums):
    """Pulls of the springs whose tails are in rows `begin` to `end`, kept from row `place` on."""
    n, first, at = (end - begin) * stride, BORDER * lanes + begin * stride, BORDER * lanes + place * stride
    sums[:, :n] = 0
    x0, x1, x2 = x[0, first:], x[1, first:], x[2, first:]
    for f in range(len(OFFSETS)):
        down, right = OFFSETS[f]
        head, p = first + down * stride + right * lanes, pulls[f]
        ks, ls = k[f, first : first + n], l[f, first : first + n]
        h0, h1, h2 = x[0, head:], x[1, head:], x[2, head:]
        pull_family(ks, ls, x0, x1, x2, h0, h1, h2, p[0, at:], p[1, at:], p[2, at:], sums[0], sums[1], sums[2])


@fast
def move_component(own, a, b, c, d, e, f, x, to, v, dt):
    """Velocities and positions of some rows, for one component."""
    for j in range(len(own)):
        u = v[j] + dt * (own[j] - a[j] - b[j] - c[j] - d[j] - e[j] - f[j])
        v[j] = u
        to[j] = x[j] + dt * u


@fast
def move_rows(begin, end, stride, lanes, x, to, v, dt, pulls, sums):
    """What the springs with an end there make of these rows; their own pulls are kept from row 2 on, those of two rows above before."""
    n, first, at = (end - begin) * stride, BORDER * lanes + begin * stride, BORDER * lanes + 2 * stride
    for c in range(3):
        right, below, across = pulls[0, c, at - lanes :], pulls[1, c, at - stride :], pulls[2, c, at - stride - lanes :]
        back, two, two_below = pulls[3, c, at - stride + lanes :], pulls[4, c, at - 2 * lanes :], pulls[5, c, at - 2 * stride :]
        rows = (x[c, first:], to[c, first:], v[c, first:])
        move_component(sums[c, :n], right, below, across, back, two, two_below, rows[0], rows[1], rows[2], dt)


@fast
def step_rows(begin, end, stride, lanes, k, l, x, to, v, dt, pulls, sums):
    """One step of some rows, several at a time; the two above are computed for their pulls alone."""
    pulls[:, :, : BORDER * lanes + 2 * stride] = 0
    above = min(begin, 2)
    pull_rows(begin - above, begin, 2 - above, stride, lanes, k, l, x, pulls, sums)
    size = sums.shape[1] // stride
    for i in range(begin, end, size):
        last = min(i + size, end)
        pull_rows(i, last, 2, stride, lanes, k, l, x, pulls, sums)
        move_rows(i, last, stride, lanes, x, to, v, dt, pulls, sums)
        for row in range(2):
            old, new = BORDER * lanes + (last - i + row) * stride, BORDER * lanes + row * stride
            pulls[:, :, new : new + stride] = pulls[:, :, old : old + stride]


@fast
def work_space(stride, lanes):
    """Pulls and sums of as many rows as lie well in the cache."""
    size = max(2, CHUNK // stride)
    return np.zeros((6, 3, BORDER * lanes + (size + 2) * stride), np.float32), np.zeros((3, size * stride), np.float32)


@fast
def cloth_steps(rows, stride, lanes, k, l, x, v, dt, n_steps):
    pulls, sums = work_space(stride, lanes)
    for t in range(n_steps):
        step_rows(0, rows, stride, lanes, k, l, x[t % 2], x[(t + 1) % 2], v, dt, pulls, sums)


@threaded
def cloth_steps_threaded(rows, stride, k, l, x, v, dt, n_steps, threads):
    spaces = [work_space(stride, 1) for _ in range(threads)]
    for t in range(n_steps):
        for part in nb.prange(threads):
            begin, end = rows * part // threads, rows * (part + 1) // threads
            step_rows(begin, end, stride, 1, k, l, x[t % 2], x[(t + 1) % 2], v, dt, spaces[part][0], spaces[part][1])


def bordered(values: np.ndarray, lanes: int, fill: float) -> np.ndarray:
    """(..., ny, nx * lanes) -> (..., n) with two columns between rows, two rows below, and a little at both ends: offsets stay inside."""
    *leading, ny, nx = values.shape
    wide = np.full((*leading, ny + 3, nx + BORDER * lanes), fill, np.float32)
    wide[..., :ny, :nx] = values
    return np.concatenate([np.full((*leading, BORDER * lanes), fill, np.float32), wide.reshape(*leading, -1)], axis=-1)


def inner(flat: np.ndarray, ny: int, nx: int, lanes: int) -> np.ndarray:
    """The way back."""
    return flat[..., BORDER * lanes :].reshape(*flat.shape[:-1], ny + 3, nx + BORDER * lanes)[..., :ny, :nx]


def cloth(scene: Scene, threads: int) -> Program:
    """One cloth; two buffers of positions."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    assert tuple(map(tuple, offsets.tolist())) == OFFSETS
    k, l = (bordered(of_springs(scene[name], (ny, nx), offsets), 1, 0) for name in ("k", "l"))
    start, speed = (bordered(scene[name].T.reshape(3, ny, nx), 1, fill) for name, fill in (("x", NOWHERE), ("v", 0)))
    x, v, dt, last = np.stack([start, start]), speed.copy(), np.float32(scene["dt"]), [0]

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        if threads == 1:
            cloth_steps(ny, nx + BORDER, 1, k, l, x, v, dt, n_steps)
        else:
            cloth_steps_threaded(ny, nx + BORDER, k, l, x, v, dt, n_steps, threads)

    return Program(run, lambda: inner(x[last[0]], ny, nx, 1).reshape(3, -1).T)


@fast
def blocks(rows, stride, k, l, x, v, dt, n_steps):
    for b in range(len(k)):
        cloth_steps(rows, stride, LANES, k[b], l, x[b], v[b], dt, n_steps)


@threaded
def blocks_threaded(rows, stride, k, l, x, v, dt, n_steps):
    for b in nb.prange(len(k)):
        cloth_steps(rows, stride, LANES, k[b], l, x[b], v[b], dt, n_steps)


def batch(scene: Scene, threads: int) -> Program:
    """Sixteen cloths side by side, so that a register holds one node of each."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    n_blocks = len(scene["x"]) // LANES
    k = bordered(abreast(of_springs(scene["k"], (ny, nx), offsets)), LANES, 0)
    l = bordered(np.repeat(of_springs(scene["l"], (ny, nx), offsets), LANES, axis=-1), LANES, 0)
    parts = (scene[name].transpose(0, 2, 1).reshape(-1, 3, ny, nx) for name in ("x", "v"))
    start, speed = (bordered(abreast(part), LANES, fill) for part, fill in zip(parts, (NOWHERE, 0), strict=True))
    x, v, dt, last = np.stack([start, start], axis=1), speed.copy(), np.float32(scene["dt"]), [0]
    assert x.shape[0] == n_blocks

    def run(n_steps: int) -> None:
        x[:, 0], v[...], last[0] = start, speed, n_steps % 2
        (blocks if threads == 1 else blocks_threaded)(ny, (nx + BORDER) * LANES, k, l, x, v, dt, n_steps)

    return Program(run, lambda: one_by_one(inner(x[:, last[0]], ny, nx * LANES, LANES)))


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
