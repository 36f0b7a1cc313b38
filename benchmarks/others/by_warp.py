"""Warp on the CPU, which takes one core: kernels over nodes and over springs, recorded once into a graph of all steps.

Nets in two forms, of which the faster is taken: each node from all its springs, or each spring added to both of its ends by atomics.
Gradients by Warp's own tape, with every step's state kept. Warp reads a kernel's source and annotations: no annotation is a string here.
"""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from . import warp_others
from .layouts import BELOW, NOWHERE, PAD, Forms, Program, Scene, incident, of_springs, padded, sorted_graph, to_springs

wp.config.quiet = True
wp.init()
wp.set_device("cpu")


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    kind = str(scene["kind"])
    differentiable = kind.startswith("gradient")
    for module in (None, warp_others):
        wp.set_module_options({"enable_backward": differentiable}, module)
    if kind in ("cloth", "mesh"):
        nodes: Callable[..., Any] = Lattice if kind == "cloth" else Ends
        return {"nodes": lambda: forward(scene, nodes(scene)), "springs": lambda: forward(scene, Springs(scene))}
    if kind in ("gradient cloth", "gradient mesh"):
        nodes = Lattice if kind == "gradient cloth" else Ends
        return {"nodes": lambda: gradient(nodes(scene, True)), "springs": lambda: gradient(Springs(scene, True))}
    if kind == "batch":
        return {"nodes": lambda: forward(scene, Lattice(scene))}
    return warp_others.forms(scene)


@wp.func
def pull(d: wp.vec3, k: float, l: float):
    """Pull on the end that `d` leads from."""
    return k * (1.0 - l / wp.length(d)) * d


@wp.kernel
def lattice_step(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    k: wp.array2d(dtype=float),
    l: wp.array2d(dtype=float),
    stride: int,
    layer: int,
    first: int,
    dt: float,
    x_new: wp.array(dtype=wp.vec3),
    v_new: wp.array(dtype=wp.vec3),
):
    """One node of a lattice with a border of springs of k = 0; `layer` is the size of one cloth of many."""
    b, row, column = wp.tid()
    i = b * layer + first + row * stride + column
    here = x[i]
    f = pull(x[i + 1] - here, k[0, i], l[0, i]) + pull(x[i - 1] - here, k[0, i - 1], l[0, i - 1])
    f += pull(x[i + stride] - here, k[1, i], l[1, i]) + pull(x[i - stride] - here, k[1, i - stride], l[1, i - stride])
    a = stride + 1
    f += pull(x[i + a] - here, k[2, i], l[2, i]) + pull(x[i - a] - here, k[2, i - a], l[2, i - a])
    c = stride - 1
    f += pull(x[i + c] - here, k[3, i], l[3, i]) + pull(x[i - c] - here, k[3, i - c], l[3, i - c])
    f += pull(x[i + 2] - here, k[4, i], l[4, i]) + pull(x[i - 2] - here, k[4, i - 2], l[4, i - 2])
    e = 2 * stride
    f += pull(x[i + e] - here, k[5, i], l[5, i]) + pull(x[i - e] - here, k[5, i - e], l[5, i - e])
    speed = v[i] + dt * f
    v_new[i] = speed
    x_new[i] = here + dt * speed


@wp.kernel
def ends_step(
    starts: wp.array(dtype=int),
    others: wp.array(dtype=int),
    springs: wp.array(dtype=int),
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    k: wp.array(dtype=float),
    l: wp.array(dtype=float),
    dt: float,
    x_new: wp.array(dtype=wp.vec3),
    v_new: wp.array(dtype=wp.vec3),
):
    """One node, from all its springs."""
    i = wp.tid()
    here = x[i]
    f = wp.vec3(0.0, 0.0, 0.0)
    for e in range(starts[i], starts[i + 1]):
        s = springs[e]
        f += pull(x[others[e]] - here, k[s], l[s])
    speed = v[i] + dt * f
    v_new[i] = speed
    x_new[i] = here + dt * speed


@wp.kernel
def spring_pulls(
    tails: wp.array(dtype=int),
    heads: wp.array(dtype=int),
    x: wp.array(dtype=wp.vec3),
    k: wp.array(dtype=float),
    l: wp.array(dtype=float),
    f: wp.array(dtype=wp.vec3),
):
    """One spring, added to both of its ends."""
    e = wp.tid()
    i, j = tails[e], heads[e]
    p = pull(x[j] - x[i], k[e], l[e])
    wp.atomic_add(f, i, p)
    wp.atomic_sub(f, j, p)


@wp.kernel
def move(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    f: wp.array(dtype=wp.vec3),
    dt: float,
    x_new: wp.array(dtype=wp.vec3),
    v_new: wp.array(dtype=wp.vec3),
):
    """One node after its force is known."""
    i = wp.tid()
    speed = v[i] + dt * f[i]
    v_new[i] = speed
    x_new[i] = x[i] + dt * speed


@wp.kernel
def square(x: wp.array(dtype=wp.vec3), counts: wp.array(dtype=float), total: wp.array(dtype=float)):
    """The loss: the sum of squared positions of the nodes that count."""
    i = wp.tid()
    wp.atomic_add(total, 0, counts[i] * wp.dot(x[i], x[i]))


class Lattice:
    """Nodes of a lattice, or of many of them, with a border."""

    def __init__(self, scene: Scene, differentiable: bool = False):
        (ny, nx), self._offsets = scene["shape"].tolist(), scene["offsets"]
        self._dt, shape = scene.number("dt"), (ny, nx)
        many = scene["x"].reshape(-1, ny * nx, 3)
        n = len(many)
        self._above = BELOW * (nx + PAD)
        # The border above is that below the cloth before; the first one has its own.
        start, speed = (self._flat(a, fill) for a, fill in ((many, NOWHERE), (scene["v"].reshape(many.shape), 0.0)))
        k = of_springs(scene["k"].reshape(n, -1), shape, self._offsets)
        l = of_springs(np.broadcast_to(scene["l"], (n, len(scene["l"]))), shape, self._offsets)
        self.k, self.l = (wp.array(self._dense(a), dtype=float, requires_grad=differentiable) for a in (k, l))
        self.start, self.speed, self.n_forces = start, speed, 0
        self._shape, self._stride, self._layer = (n, ny, nx), nx + PAD, (ny + BELOW) * (nx + PAD)
        counts = np.zeros(len(start), np.float32)
        self._places = (
            self._above + PAD + (np.arange(n)[:, None, None] * self._layer + np.arange(ny)[:, None] * self._stride + np.arange(nx))
        )
        counts[self._places.ravel()] = 1
        self.counts = counts

    def _border(self, values: np.ndarray, fill: float) -> np.ndarray:
        return np.concatenate([np.full((*values.shape[:-1], self._above), fill, np.float32), values, values[..., :PAD] * 0 + fill], axis=-1)

    def _flat(self, many: np.ndarray, fill: float) -> np.ndarray:
        n, _, _ = many.shape
        wide = padded(many.transpose(2, 0, 1).reshape(3, n, *self._grid(many)), fill)
        return np.ascontiguousarray(self._border(wide.reshape(3, -1), fill).T)

    def _dense(self, values: np.ndarray) -> np.ndarray:
        wide = padded(np.moveaxis(values, 1, 0), 0)
        return self._border(wide.reshape(len(wide), -1), 0)

    def _grid(self, many: np.ndarray) -> tuple[int, int]:
        nx = self._above // BELOW - PAD
        return many.shape[1] // nx, nx

    def step(self, x: Any, v: Any, f: Any, x_new: Any, v_new: Any) -> None:
        """Launch one step."""
        inputs = [x, v, self.k, self.l, self._stride, self._layer, self._above + PAD, self._dt]
        wp.launch(lattice_step, dim=self._shape, inputs=inputs, outputs=[x_new, v_new])

    def points(self, x: np.ndarray) -> np.ndarray:
        """Positions in the user's order and shape."""
        found = x[self._places.ravel()].reshape(self._shape[0], -1, 3)
        return found[0] if len(found) == 1 else found

    def constants(self, values: np.ndarray) -> np.ndarray:
        """(E,) of what is kept dense."""
        dense = values[:, self._places[0].ravel()].reshape(len(values), *self._shape[1:])
        return to_springs(dense, self._offsets)


class _Sorted:
    """Nodes in the order for locality, where a scene has one."""

    def __init__(self, scene: Scene, differentiable: bool):
        if "order" in scene:
            self._order, self._edges, self._springs = sorted_graph(scene)
        else:
            self._order, self._edges, self._springs = np.arange(len(scene["x"])), scene["edges"], np.arange(len(scene["k"]))
        self._dt, self.start, self.speed = scene.number("dt"), scene["x"][self._order], scene["v"][self._order]
        self.k, self.l = (wp.array(scene[name][self._springs], dtype=float, requires_grad=differentiable) for name in ("k", "l"))
        self.counts = np.ones(len(self._order), np.float32)

    def points(self, x: np.ndarray) -> np.ndarray:
        """Positions in the user's order."""
        out = np.empty_like(x)
        out[self._order] = x
        return out

    def constants(self, values: np.ndarray) -> np.ndarray:
        """(E,) in the user's order."""
        out = np.empty_like(values)
        out[self._springs] = values
        return out


class Ends(_Sorted):
    """Each node from all its springs."""

    def __init__(self, scene: Scene, differentiable: bool = False):
        super().__init__(scene, differentiable)
        self._table = [wp.array(a, dtype=int) for a in incident(self._edges, len(self._order))]
        self.n_forces = 0

    def step(self, x: Any, v: Any, f: Any, x_new: Any, v_new: Any) -> None:
        """Launch one step."""
        wp.launch(ends_step, dim=len(self._order), inputs=[*self._table, x, v, self.k, self.l, self._dt], outputs=[x_new, v_new])


class Springs(_Sorted):
    """Each spring added to both of its ends."""

    def __init__(self, scene: Scene, differentiable: bool = False):
        super().__init__(scene, differentiable)
        self._ends = [wp.array(np.ascontiguousarray(a), dtype=int) for a in self._edges.T]
        self.n_forces = 1

    def step(self, x: Any, v: Any, f: Any, x_new: Any, v_new: Any) -> None:
        """Launch one step; `f` is zero when the first begins."""
        f.zero_()
        wp.launch(spring_pulls, dim=len(self.k), inputs=[*self._ends, x, self.k, self.l], outputs=[f])
        wp.launch(move, dim=len(x), inputs=[x, v, f, self._dt], outputs=[x_new, v_new])


def forward(scene: Scene, net: Any) -> Program:
    """All steps recorded into one graph, which each run replays."""
    start, speed = (wp.array(a, dtype=wp.vec3) for a in (net.start, net.speed))
    x, v = [wp.clone(start) for _ in range(2)], [wp.clone(speed) for _ in range(2)]
    f, graphs, last = wp.zeros_like(start) if net.n_forces else None, {}, [0]

    def run(n_steps: int) -> None:
        if n_steps not in graphs:
            graphs.clear()
            net.step(x[0], v[0], f, x[1], v[1])  # what compiles, compiles before it is recorded
            with wp.ScopedCapture() as capture:
                for t in range(n_steps):
                    net.step(x[t % 2], v[t % 2], f, x[(t + 1) % 2], v[(t + 1) % 2])
            graphs[n_steps] = capture.graph
        wp.copy(x[0], start)
        wp.copy(v[0], speed)
        wp.capture_launch(graphs[n_steps])
        last[0] = n_steps % 2

    return Program(run, lambda: net.points(x[last[0]].numpy()))


def gradient(net: Any) -> Program:
    """A tape of all steps, recorded once; a run goes forward and back along it."""
    counts, total = wp.array(net.counts, dtype=float), wp.zeros(1, dtype=float, requires_grad=True)
    made: dict[int, Any] = {}

    def record(n_steps: int) -> Callable[[], None]:
        def states(values: np.ndarray, n: int) -> list[Any]:
            return [wp.array(values, dtype=wp.vec3, requires_grad=True) for _ in range(n)]

        x, v, f = states(net.start, n_steps + 1), states(net.speed, n_steps + 1), states(net.start * 0, n_steps * net.n_forces)
        tape = wp.Tape()

        def whole() -> None:
            for t in range(n_steps):
                net.step(x[t], v[t], f[t] if f else None, x[t + 1], v[t + 1])
            wp.launch(square, dim=len(x[0]), inputs=[x[-1], counts], outputs=[total])

        with tape:
            whole()
        tape.backward(total)
        with wp.ScopedCapture() as capture:
            total.zero_()
            tape.zero()
            whole()
            tape.backward(total)
        made[n_steps] = (x, v, f, tape, capture.graph)
        return lambda: wp.capture_launch(capture.graph)

    runs: dict[int, Callable[[], None]] = {}

    def run(n_steps: int) -> None:
        if n_steps not in runs:
            runs.clear()
            made.clear()
            runs[n_steps] = record(n_steps)
        runs[n_steps]()

    return Program(run, lambda: np.stack([net.constants(a.grad.numpy()) for a in (net.k, net.l)]))
