"""By numba, on what is no spring net: conduction, samples of images, the liquid of `benchmarks.fluid_peers`."""

# pyright: reportMissingImports=false, reportCallIssue=false

from __future__ import annotations

import importlib
from typing import Any

import numba as nb
import numpy as np

from .layouts import Forms, Program, Scene, of_axes, of_peer

TWO = np.float32(2)
fast = nb.njit(fastmath=True, error_model="numpy")
threaded = nb.njit(fastmath=True, error_model="numpy", parallel=True)


def forms(scene: Scene, counts: list[int]) -> Forms:
    """By the scene's kind."""
    kind = str(scene["kind"])
    if kind == "fluid":
        return {"list": lambda: fluid(scene)}
    make = {"heat": heat, "image": image, "gradient image": image}[kind]
    return {f"{n} thread(s)": lambda n=n: make(scene, n) for n in counts}


def _heat_layer(z, gx, gy, gz, old, new, dt):
    ny, nx = old.shape[1] - 2, old.shape[2] - 2
    for y in range(1, ny + 1):
        a, b, c = gx[z, y], gy[z, y], gz[z, y]
        b0, c0 = gy[z, y - 1], gz[z - 1, y]
        t, t1, t0, t3, t2, to = old[z, y], old[z, y + 1], old[z, y - 1], old[z + 1, y], old[z - 1, y], new[z, y]
        for i in range(1, nx + 1):
            here = t[i]
            flow = a[i] * (t[i + 1] - here) - a[i - 1] * (here - t[i - 1])
            flow += b[i] * (t1[i] - here) - b0[i] * (here - t0[i])
            flow += c[i] * (t3[i] - here) - c0[i] * (here - t2[i])
            to[i] = here + dt * flow


heat_layer: Any = fast(_heat_layer)


@fast
def heat_steps(gx, gy, gz, t, dt, n_steps):
    for s in range(n_steps):
        for z in range(1, t.shape[1] - 1):
            heat_layer(z, gx, gy, gz, t[s % 2], t[(s + 1) % 2], dt)


@threaded
def heat_steps_threaded(gx, gy, gz, t, dt, n_steps):
    for s in range(n_steps):
        for z in nb.prange(1, t.shape[1] - 1):
            heat_layer(z, gx, gy, gz, t[s % 2], t[(s + 1) % 2], dt)


def heat(scene: Scene, threads: int) -> Program:
    """A border of nodes that nothing conducts to."""
    g = np.pad(of_axes(scene), ((0, 0), (1, 1), (1, 1), (1, 1)))
    start = np.pad(scene["start"].reshape(scene["shape"]), 1)
    t, dt, last = np.stack([start, start]), np.float32(scene["dt"]), [0]

    def run(n_steps: int) -> None:
        t[0], last[0] = start, n_steps % 2
        (heat_steps if threads == 1 else heat_steps_threaded)(g[2], g[1], g[0], t, dt, n_steps)

    return Program(run, lambda: t[last[0], 1:-1, 1:-1, 1:-1].ravel())


def _sample_points(image, x, y, out):
    ny, nx = image.shape
    flat = image.ravel()
    for p in nb.prange(len(x)):
        u, v = min(max(x[p], np.float32(0)), np.float32(nx - 1)), min(max(y[p], np.float32(0)), np.float32(ny - 1))
        i, j = min(np.int32(u), np.int32(nx - 2)), min(np.int32(v), np.int32(ny - 2))
        tx, ty, at = u - np.float32(i), v - np.float32(j), np.uint32(j * np.int32(nx) + i)
        low = flat[at] + tx * (flat[at + 1] - flat[at])
        high = flat[at + nx] + tx * (flat[at + nx + 1] - flat[at + nx])
        out[p] = low + ty * (high - low)


def _slope_points(image, x, y, out):
    ny, nx = image.shape
    flat = image.ravel()
    for p in nb.prange(len(x)):
        u, v = min(max(x[p], np.float32(0)), np.float32(nx - 1)), min(max(y[p], np.float32(0)), np.float32(ny - 1))
        i, j = min(np.int32(u), np.int32(nx - 2)), min(np.int32(v), np.int32(ny - 2))
        tx, ty, at = u - np.float32(i), v - np.float32(j), np.uint32(j * np.int32(nx) + i)
        down, up = flat[at + 1] - flat[at], flat[at + nx + 1] - flat[at + nx]
        low, high = flat[at] + tx * down, flat[at + nx] + tx * up
        twice = TWO * (low + ty * (high - low))
        out[0, p] = twice * (down + ty * (up - down)) if u == x[p] else np.float32(0)
        out[1, p] = twice * (high - low) if v == y[p] else np.float32(0)


def image(scene: Scene, threads: int) -> Program:
    """Bilinear samples, or the slopes of their squares."""
    slopes = str(scene["kind"]) == "gradient image"
    program: Any = (fast if threads == 1 else threaded)(_slope_points if slopes else _sample_points)
    picture, x, y = scene["image"], scene["x"], scene["y"]
    out = np.zeros((2, len(x)) if slopes else len(x), np.float32)

    def run(n_steps: int) -> None:
        for _ in range(n_steps):
            program(picture, x, y, out)

    return Program(run, lambda: out)


def fluid(scene: Scene) -> Program:
    """The list of `benchmarks.fluid_peers`, which imports jax for another peer."""
    peers = importlib.import_module("benchmarks.fluid_peers")
    return of_peer(peers.numba(scene["x"], scene["v"], scene.number("reach"), scene.number("skin")), scene)
