"""Gradients by Taichi's tape: fields for every step, kernels of one step that the tape runs backwards."""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false

from collections.abc import Callable
from typing import Any

import numpy as np
import taichi as ti


def record(
    points: np.ndarray, speeds: np.ndarray, edges: np.ndarray, k: np.ndarray, l: np.ndarray, dt: float, n_steps: int
) -> Callable[[], np.ndarray]:
    """A run that goes forward and back and gives the (2, E) gradient."""
    n, m = len(points), len(edges)
    x, v, f = (ti.Vector.field(3, ti.f32, shape=(n_steps + 1, n), needs_grad=True) for _ in range(3))
    stiffness, rest = (ti.field(ti.f32, shape=m, needs_grad=True) for _ in range(2))
    ends, loss = ti.Vector.field(2, ti.i32, shape=m), ti.field(ti.f32, shape=(), needs_grad=True)
    ends.from_numpy(edges.astype(np.int32))
    stiffness.from_numpy(k)
    rest.from_numpy(l)

    @ti.kernel
    def begin(x0: ti.types.ndarray(dtype=ti.math.vec3, ndim=1), v0: ti.types.ndarray(dtype=ti.math.vec3, ndim=1)):
        for i in range(n):
            x[0, i] = x0[i]
            v[0, i] = v0[i]
        for t, i in f:
            f[t, i] = ti.math.vec3(0.0)

    @ti.kernel
    def pulls(t: ti.i32):
        for e in range(m):
            i, j = ends[e][0], ends[e][1]
            d = x[t, j] - x[t, i]
            p = stiffness[e] * (1.0 - rest[e] / d.norm()) * d
            f[t, i] += p
            f[t, j] -= p

    @ti.kernel
    def move(t: ti.i32):
        for i in range(n):
            v[t + 1, i] = v[t, i] + dt * f[t, i]
            x[t + 1, i] = x[t, i] + dt * (v[t, i] + dt * f[t, i])

    @ti.kernel
    def square():
        for i in range(n):
            loss[None] += x[n_steps, i].norm_sqr()

    start: Any = [ti.ndarray(ti.math.vec3, shape=n) for _ in range(2)]
    for array, values in zip(start, (points, speeds), strict=True):
        array.from_numpy(np.ascontiguousarray(values))

    def run() -> np.ndarray:
        begin(*start)
        loss[None] = 0
        with ti.ad.Tape(loss):
            for t in range(n_steps):
                pulls(t)
                move(t)
            square()
        return np.stack([stiffness.grad.to_numpy(), rest.grad.to_numpy()])

    return run
