"""Taichi on the CPU: kernels over nodes and over springs, on one thread or two.

Forms: `nodes` reads neighbours, `springs` adds to both ends by atomics. `loop` means that the steps are a loop inside one kernel on one
thread; `threads` that Python launches a kernel of ten steps, each a parallel loop. Gradients by Taichi's own tape, every step kept.
Taichi reads a kernel's source and annotations: no annotation is a string here.
"""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false, reportCallIssue=false

import os
from typing import Any

import numpy as np
import taichi as ti

from .layouts import BELOW, NOWHERE, PAD, Forms, Program, Scene, incident, of_springs, padded, sorted_graph

THREADS = int(os.environ.get("OMP_NUM_THREADS", "1"))
ti.init(arch=ti.cpu, default_fp=ti.f32, cpu_max_num_threads=THREADS, offline_cache=False, log_level=ti.ERROR, fast_math=True)
BURST = 10


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    kind = str(scene["kind"])
    make: dict[str, Any] = {"cloth": lattice, "mesh": ends}
    if kind in make:
        found: Forms = {}
        for way in ("loop", "threads"):
            found[f"nodes, {way}"] = lambda way=way: make[kind](scene, way)
            found[f"springs, {way}"] = lambda way=way: over_springs(scene, way)
        return found
    if "robots" in kind:
        from . import taichi_robot

        return taichi_robot.forms(scene)
    return {"springs, tape": lambda: gradient(scene)}


Vectors = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
Numbers = ti.types.ndarray(dtype=ti.f32, ndim=1)
Families = ti.types.ndarray(dtype=ti.f32, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.func
def pull(d, k, l):
    """Pull on the end that `d` leads from."""
    return k * (1.0 - l / d.norm()) * d


@ti.func
def lattice_node(i: ti.i32, stride: ti.i32, x: ti.template(), k: ti.template(), l: ti.template()):
    """Force on a node of a lattice with a border of springs of k = 0."""
    f = ti.math.vec3(0.0)
    for s in ti.static(range(6)):
        head = ti.static((0, 1, 1, 1, 0, 2)[s]) * stride + ti.static((1, 0, 1, -1, 2, 0)[s])
        f += pull(x[i + head] - x[i], k[s, i], l[s, i]) + pull(x[i - head] - x[i], k[s, i - head], l[s, i - head])
    return f


@ti.kernel
def lattice_loop(
    n_steps: ti.i32,
    ny: ti.i32,
    nx: ti.i32,
    stride: ti.i32,
    first: ti.i32,
    dt: ti.f32,
    k: Families,
    l: Families,
    x: Vectors,
    v: Vectors,
    f: Vectors,
):
    """All steps on one thread."""
    ti.loop_config(serialize=True)
    for _ in range(n_steps):
        for row in range(ny):
            for i in range(first + row * stride, first + row * stride + nx):
                f[i] = lattice_node(i, stride, x, k, l)
        for row in range(ny):
            for i in range(first + row * stride, first + row * stride + nx):
                v[i] += dt * f[i]
                x[i] += dt * v[i]


@ti.kernel
def lattice_burst(
    ny: ti.i32, nx: ti.i32, stride: ti.i32, first: ti.i32, dt: ti.f32, k: Families, l: Families, x: Vectors, v: Vectors, y: Vectors
):
    """Ten steps, each a parallel loop, from one buffer to the other."""
    for _ in ti.static(range(BURST // 2)):
        for row, column in ti.ndrange(ny, nx):
            i = first + row * stride + column
            v[i] += dt * lattice_node(i, stride, x, k, l)
            y[i] = x[i] + dt * v[i]
        for row, column in ti.ndrange(ny, nx):
            i = first + row * stride + column
            v[i] += dt * lattice_node(i, stride, y, k, l)
            x[i] = y[i] + dt * v[i]


@ti.func
def end_node(i: ti.i32, starts: ti.template(), others: ti.template(), k: ti.template(), l: ti.template(), x: ti.template()):
    """Force on a node from all its springs."""
    f = ti.math.vec3(0.0)
    for e in range(starts[i], starts[i + 1]):
        f += pull(x[others[e]] - x[i], k[e], l[e])
    return f


@ti.kernel
def ends_loop(n_steps: ti.i32, dt: ti.f32, starts: Whole, others: Whole, k: Numbers, l: Numbers, x: Vectors, v: Vectors, f: Vectors):
    """All steps on one thread."""
    ti.loop_config(serialize=True)
    for _ in range(n_steps):
        for i in range(v.shape[0]):
            f[i] = end_node(i, starts, others, k, l, x)
        for i in range(v.shape[0]):
            v[i] += dt * f[i]
            x[i] += dt * v[i]


@ti.kernel
def ends_burst(dt: ti.f32, starts: Whole, others: Whole, k: Numbers, l: Numbers, x: Vectors, v: Vectors, y: Vectors):
    """Ten steps, each a parallel loop, from one buffer to the other."""
    for _ in ti.static(range(BURST // 2)):
        for i in range(v.shape[0]):
            v[i] += dt * end_node(i, starts, others, k, l, x)
            y[i] = x[i] + dt * v[i]
        for i in range(v.shape[0]):
            v[i] += dt * end_node(i, starts, others, k, l, y)
            x[i] = y[i] + dt * v[i]


@ti.kernel
def springs_loop(n_steps: ti.i32, dt: ti.f32, tails: Whole, heads: Whole, k: Numbers, l: Numbers, x: Vectors, v: Vectors, f: Vectors):
    """All steps on one thread."""
    ti.loop_config(serialize=True)
    for _ in range(n_steps):
        for e in range(k.shape[0]):
            p = pull(x[heads[e]] - x[tails[e]], k[e], l[e])
            f[tails[e]] += p
            f[heads[e]] -= p
        for i in range(v.shape[0]):
            v[i] += dt * f[i]
            x[i] += dt * v[i]
            f[i] = ti.math.vec3(0.0)


@ti.kernel
def springs_burst(dt: ti.f32, tails: Whole, heads: Whole, k: Numbers, l: Numbers, x: Vectors, v: Vectors, f: Vectors):
    """Ten steps, each two parallel loops."""
    for _ in ti.static(range(BURST)):
        for e in range(k.shape[0]):
            p = pull(x[heads[e]] - x[tails[e]], k[e], l[e])
            f[tails[e]] += p
            f[heads[e]] -= p
        for i in range(v.shape[0]):
            v[i] += dt * f[i]
            x[i] += dt * v[i]
            f[i] = ti.math.vec3(0.0)


def _array(values: np.ndarray, dtype: Any) -> Any:
    made = ti.ndarray(dtype, shape=values.shape if dtype is not ti.math.vec3 else values.shape[:1])
    made.from_numpy(np.ascontiguousarray(values))
    return made


def _vectors(*values: np.ndarray) -> list[Any]:
    return [_array(a.astype(np.float32), ti.math.vec3) for a in values]


def _run(steps: Any, way: str, start: np.ndarray, speed: np.ndarray, back: Any) -> Program:
    """`steps(n_steps, x, v, other)` from the start."""
    x, v, other = _vectors(start, speed, start if way == "nodes threads" else start * 0)

    def run(n_steps: int) -> None:
        x.from_numpy(start)
        v.from_numpy(speed)
        steps(n_steps, x, v, other)
        ti.sync()

    return Program(run, lambda: back(x.to_numpy()))


def _bursts(n_steps: int) -> range:
    assert n_steps % BURST == 0, "whole bursts"
    return range(n_steps // BURST)


def lattice(scene: Scene, way: str) -> Program:
    """Nodes of a lattice with a border."""
    (ny, nx), stride = scene["shape"].tolist(), int(scene["shape"][1]) + PAD
    above = BELOW * stride

    def flat(values: np.ndarray, fill: float) -> np.ndarray:
        wide = padded(values, fill).reshape(len(values), -1)
        return np.pad(wide, ((0, 0), (above, PAD)), constant_values=fill)

    k, l = (_array(flat(of_springs(scene[name], (ny, nx), scene["offsets"]), 0), ti.f32) for name in ("k", "l"))
    start, speed = (np.ascontiguousarray(flat(scene[name].T.reshape(3, ny, nx), fill).T) for name, fill in (("x", NOWHERE), ("v", 0)))
    numbers = (ny, nx, stride, above + PAD, scene.number("dt"), k, l)

    def steps(n_steps: int, x: Any, v: Any, other: Any) -> None:
        if way == "loop":
            lattice_loop(n_steps, *numbers, x, v, other)
            return
        for _ in _bursts(n_steps):
            lattice_burst(*numbers, x, v, other)

    places = above + PAD + np.arange(ny)[:, None] * stride + np.arange(nx)
    return _run(steps, f"nodes {way}", start, speed, lambda x: x[places.ravel()])


def _in_order(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Nodes in the order for locality where a scene has one: order, edges, springs, and the way back."""
    if "order" in scene:
        order, edges, springs = sorted_graph(scene)
    else:
        order, edges, springs = np.arange(len(scene["x"])), scene["edges"], np.arange(len(scene["k"]))

    def back(x: np.ndarray) -> np.ndarray:
        out = np.empty_like(x)
        out[order] = x
        return out

    return order, edges, springs, back


def ends(scene: Scene, way: str) -> Program:
    """Each node from all its springs."""
    order, edges, springs, back = _in_order(scene)
    starts, others, which = incident(edges, len(order))
    tables = [_array(a, ti.i32) for a in (starts, others)] + [_array(scene[name][springs][which], ti.f32) for name in ("k", "l")]
    dt = scene.number("dt")

    def steps(n_steps: int, x: Any, v: Any, other: Any) -> None:
        if way == "loop":
            ends_loop(n_steps, dt, *tables, x, v, other)
            return
        for _ in _bursts(n_steps):
            ends_burst(dt, *tables, x, v, other)

    return _run(steps, f"nodes {way}", scene["x"][order], scene["v"][order], back)


def over_springs(scene: Scene, way: str) -> Program:
    """Each spring added to both of its ends."""
    order, edges, springs, back = _in_order(scene)
    tables = [_array(a, ti.i32) for a in edges.T] + [_array(scene[name][springs], ti.f32) for name in ("k", "l")]
    dt = scene.number("dt")

    def steps(n_steps: int, x: Any, v: Any, other: Any) -> None:
        if way == "loop":
            springs_loop(n_steps, dt, *tables, x, v, other)
            return
        for _ in _bursts(n_steps):
            springs_burst(dt, *tables, x, v, other)

    return _run(steps, way, scene["x"][order], scene["v"][order], back)


def gradient(scene: Scene) -> Program:
    """Fields for every step, and Taichi's tape."""
    from .taichi_gradient import record

    order, edges, springs, _ = _in_order(scene)
    runs: dict[int | str, Any] = {}

    def run(n_steps: int) -> None:
        if n_steps not in runs:
            runs[n_steps] = record(
                scene["x"][order], scene["v"][order], edges, scene["k"][springs], scene["l"][springs], scene.number("dt"), n_steps
            )
        runs["last"] = runs[n_steps]()

    def result() -> np.ndarray:
        out = np.empty((2, len(springs)), np.float32)
        out[:, springs] = runs["last"]
        return out

    return Program(run, result)
