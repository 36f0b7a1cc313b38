"""Warp on what is no spring net: conduction, samples of images, the liquid of `benchmarks.fluid_peers`."""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false

import importlib
from typing import Any

import numpy as np
import warp as wp

from .layouts import Forms, Program, Scene, of_axes, of_peer


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    make: Any = {"heat": heat, "image": image, "gradient image": slopes, "fluid": fluid}
    return {"kernel": lambda: make[str(scene["kind"])](scene)}


@wp.kernel
def conduct(
    gx: wp.array(dtype=float),
    gy: wp.array(dtype=float),
    gz: wp.array(dtype=float),
    before: wp.array(dtype=float),
    row: int,
    layer: int,
    dt: float,
    after: wp.array(dtype=float),
):
    """One node of a block with a border that nothing conducts to."""
    z, y, x = wp.tid()
    i = (z + 1) * layer + (y + 1) * row + x + 1
    here = before[i]
    flow = gx[i] * (before[i + 1] - here) - gx[i - 1] * (here - before[i - 1])
    flow += gy[i] * (before[i + row] - here) - gy[i - row] * (here - before[i - row])
    flow += gz[i] * (before[i + layer] - here) - gz[i - layer] * (here - before[i - layer])
    after[i] = here + dt * flow


def heat(scene: Scene) -> Program:
    """All steps in one graph."""
    shape = tuple(scene["shape"].tolist())
    g = [wp.array(np.pad(a, 1).ravel(), dtype=float) for a in of_axes(scene)]
    start = wp.array(np.pad(scene["start"].reshape(shape), 1).ravel(), dtype=float)
    t, graphs, last = [wp.clone(start) for _ in range(2)], {}, [0]
    row, layer = shape[2] + 2, (shape[1] + 2) * (shape[2] + 2)

    def step(old: Any, new: Any) -> None:
        wp.launch(conduct, dim=shape, inputs=[g[2], g[1], g[0], old, row, layer, scene.number("dt")], outputs=[new])

    def run(n_steps: int) -> None:
        if n_steps not in graphs:
            step(t[0], t[1])
            with wp.ScopedCapture() as capture:
                for s in range(n_steps):
                    step(t[s % 2], t[(s + 1) % 2])
            graphs[n_steps] = capture.graph
        wp.copy(t[0], start)
        wp.capture_launch(graphs[n_steps])
        last[0] = n_steps % 2

    return Program(run, lambda: t[last[0]].numpy().reshape([n + 2 for n in shape])[1:-1, 1:-1, 1:-1].ravel())


@wp.func
def bilinear(picture: wp.array2d(dtype=float), x: float, y: float):
    """The value at one point."""
    u = wp.clamp(x, 0.0, float(picture.shape[1] - 1))
    v = wp.clamp(y, 0.0, float(picture.shape[0] - 1))
    i, j = wp.min(int(u), picture.shape[1] - 2), wp.min(int(v), picture.shape[0] - 2)
    tx, ty = u - float(i), v - float(j)
    low = picture[j, i] + tx * (picture[j, i + 1] - picture[j, i])
    high = picture[j + 1, i] + tx * (picture[j + 1, i + 1] - picture[j + 1, i])
    return low + ty * (high - low)


@wp.kernel
def sample(picture: wp.array2d(dtype=float), x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array(dtype=float)):
    """One point."""
    p = wp.tid()
    out[p] = bilinear(picture, x[p], y[p])


@wp.kernel
def squared(picture: wp.array2d(dtype=float), x: wp.array(dtype=float), y: wp.array(dtype=float), out: wp.array(dtype=float)):
    """One point's part of the loss; Warp differentiates it."""
    p = wp.tid()
    value = bilinear(picture, x[p], y[p])
    out[p] = value * value


def _arrays(scene: Scene, differentiable: bool) -> tuple[Any, ...]:
    picture = wp.array(scene["image"], dtype=float)
    x, y = (wp.array(scene[name], dtype=float, requires_grad=differentiable) for name in ("x", "y"))
    return picture, x, y, wp.zeros(len(scene["x"]), dtype=float, requires_grad=differentiable)


def image(scene: Scene) -> Program:
    """Bilinear samples."""
    *inputs, out = _arrays(scene, False)

    def run(n_steps: int) -> None:
        for _ in range(n_steps):
            wp.launch(sample, dim=len(out), inputs=inputs, outputs=[out])

    return Program(run, out.numpy)


def slopes(scene: Scene) -> Program:
    """The slopes of their squares, by the kernel's own adjoint."""
    picture, x, y, out = _arrays(scene, True)
    ones = wp.ones_like(out)

    def run(n_steps: int) -> None:
        for _ in range(n_steps):
            x.grad.zero_()
            y.grad.zero_()
            out.grad.fill_(1.0)
            arrays = {"adj_inputs": [None, x.grad, y.grad], "adj_outputs": [ones]}
            wp.launch(squared, dim=len(out), inputs=[picture, x, y], outputs=[out], adjoint=True, **arrays)

    return Program(run, lambda: np.stack([x.grad.numpy(), y.grad.numpy()]))


def fluid(scene: Scene) -> Program:
    """The hash grid of `benchmarks.fluid_peers`, which imports jax for another peer."""
    peers = importlib.import_module("benchmarks.fluid_peers")
    return of_peer(peers.warp(scene["x"], scene["v"], scene.number("reach"), scene.number("skin")), scene)
