"""C by hand, compiled here with the vector instructions of this machine; on one thread or two."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .layouts import LANES, NOWHERE, Forms, Program, Scene, abreast, of_axes, of_springs, one_by_one, padded, slices, to_springs

THREADS = int(os.environ.get("OMP_NUM_THREADS", "1"))
FLAGS = ("-O3", "-march=native", "-ffast-math", "-shared", "-fPIC")


def library(name: str, threads: int) -> Any:
    """A source of this folder, compiled; with OpenMP for several threads."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise SystemExit("there is no C compiler named cc")
    source = Path(__file__).with_name(f"{name}.c")
    openmp = "-fopenmp" if threads > 1 else "-fopenmp-simd"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.so"
        done = subprocess.run([compiler, *FLAGS, openmp, str(source), "-o", str(path), "-lm"], capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"cc: {(done.stderr.strip().splitlines() or ['failed'])[-1]}")
        return ctypes.CDLL(str(path))


def at(array: np.ndarray) -> ctypes.c_void_p:
    """Address of an array's numbers; it keeps the array alive."""
    assert array.flags.c_contiguous
    return array.ctypes.data_as(ctypes.c_void_p)


def forms(scene: Scene) -> Forms:
    """By the scene's kind; each on one thread and on all."""
    kind = str(scene["kind"])
    make: dict[str, tuple[Callable[..., Program], str]] = {
        "cloth": (cloth, "lattice"),
        "gradient cloth": (cloth_gradient, "lattice"),
        "batch": (batch, "lattice"),
        "heat": (heat, "lattice"),
        "mesh": (mesh, "graph"),
        "gradient mesh": (mesh_gradient, "graph"),
        "image": (image, "sampling"),
        "gradient image": (image, "sampling"),
    }
    function, source = make[kind]
    return {f"{n} thread{'s' * (n > 1)}": lambda n=n: function(scene, library(source, n), n) for n in sorted({1, THREADS})}


def cloth(scene: Scene, c: Any, threads: int) -> Program:
    """One cloth; two buffers of positions."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    k, l = (of_springs(scene[name], (ny, nx), offsets) for name in ("k", "l"))
    start, speed = (scene[name].T.reshape(3, ny, nx) for name in ("x", "v"))
    start, speed = padded(start, NOWHERE), padded(speed, 0)
    x, v, dt, last = np.stack([start, start]), speed.copy(), ctypes.c_float(scene.number("dt")), [0]

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        c.cloth(ny, nx, 1, at(k), at(l), at(x), at(v), dt, n_steps, 2, threads)

    return Program(run, lambda: x[last[0], :, :ny, LANES:].reshape(3, -1).T)


def cloth_gradient(scene: Scene, c: Any, threads: int) -> Program:
    """Forward with all positions kept, then the adjoint by hand."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    k, l = (of_springs(scene[name], (ny, nx), offsets) for name in ("k", "l"))
    start, speed = (scene[name].T.reshape(3, ny, nx) for name in ("x", "v"))
    start, speed = padded(start, NOWHERE), padded(speed, 0)
    dt, result, kept = ctypes.c_float(scene.number("dt")), np.zeros((2, *k.shape), np.float32), {}

    def run(n_steps: int) -> None:
        x, v, g, b = _adjoint_arrays(kept, start, speed, n_steps)
        result[...] = 0
        c.cloth(ny, nx, 1, at(k), at(l), at(x), at(v), dt, n_steps, n_steps + 1, threads)
        c.cloth_gradient(ny, nx, at(k), at(l), at(x), at(g), at(b), at(result), at(result[1]), dt, n_steps, threads)

    return Program(run, lambda: np.stack([to_springs(result[i], offsets) for i in range(2)]))


def batch(scene: Scene, c: Any, threads: int) -> Program:
    """Sixteen cloths side by side, so that a register holds one node of each."""
    (ny, nx), offsets = scene["shape"].tolist(), scene["offsets"]
    blocks, left = len(scene["x"]) // LANES, LANES * LANES

    def bordered(a: np.ndarray, fill: float) -> np.ndarray:
        out = np.full((blocks, 3, ny + 2, nx * LANES + left), fill, np.float32)
        out[..., :ny, left:] = abreast(a.transpose(0, 2, 1).reshape(-1, 3, ny, nx))
        return out

    k = abreast(of_springs(scene["k"], (ny, nx), offsets))
    l = np.repeat(of_springs(scene["l"], (ny, nx), offsets), LANES, axis=-1)
    start, speed = bordered(scene["x"], NOWHERE), bordered(scene["v"], 0)
    x, v, dt, last = np.stack([start, start], axis=1), speed.copy(), ctypes.c_float(scene.number("dt")), [0]

    def run(n_steps: int) -> None:
        x[:, 0], v[...], last[0] = start, speed, n_steps % 2
        c.cloths(blocks, ny, nx, at(k), at(l), at(x), at(v), dt, n_steps, threads)

    return Program(run, lambda: one_by_one(x[:, last[0], :, :ny, left:]))


def heat(scene: Scene, c: Any, threads: int) -> Program:
    """Conduction; a border of nodes that nothing conducts to."""
    shape = tuple(scene["shape"].tolist())
    g = of_axes(scene)
    start = np.zeros((shape[0] + 2, shape[1] + 2, shape[2] + LANES), np.float32)
    inside = (slice(1, -1), slice(1, -1), slice(LANES - 1, -1))
    start[inside] = scene["start"].reshape(shape)
    wide = np.zeros((3, *start.shape), np.float32)
    wide[(slice(None), *inside)] = g
    t, dt, last = np.stack([start, start]), ctypes.c_float(scene.number("dt")), [0]

    def run(n_steps: int) -> None:
        t[0], last[0] = start, n_steps % 2
        c.heat(*shape, at(wide[2]), at(wide[1]), at(wide[0]), at(t), dt, n_steps, threads)

    return Program(run, lambda: t[last[0]][inside].ravel())


def _sliced(scene: Scene) -> tuple[Any, ...]:
    """What the library takes of the net, the table, and (M, 4) positions and velocities."""
    table = slices(scene)
    real = table.nodes >= 0
    k, l = (np.where(table.springs >= 0, scene[name][table.springs], np.float32(0)) for name in ("k", "l"))
    start, speed = np.zeros((2, len(table.nodes), 4), np.float32)
    start[real, :3], speed[real, :3] = scene["x"][table.nodes[real]], scene["v"][table.nodes[real]]
    return (len(table.nodes), at(table.starts), at(table.heads), at(k), at(l)), table, start, speed


def mesh(scene: Scene, c: Any, threads: int) -> Program:
    """Slices of 16 nodes; two buffers of positions."""
    arguments, table, start, speed = _sliced(scene)
    x, v, dt, last = np.stack([start, start]), speed.copy(), ctypes.c_float(scene.number("dt")), [0]
    real = table.nodes >= 0

    def run(n_steps: int) -> None:
        x[0], v[...], last[0] = start, speed, n_steps % 2
        c.graph(*arguments, at(x), at(v), dt, n_steps, 2, threads)

    def result() -> np.ndarray:
        out = np.empty_like(scene["x"])
        out[table.nodes[real]] = x[last[0]][real, :3]
        return out

    return Program(run, result)


def _adjoint_arrays(kept: dict[int, np.ndarray], start: np.ndarray, speed: np.ndarray, n_steps: int) -> tuple[np.ndarray, ...]:
    """All positions (kept from run to run), velocities, the gradient by the positions, and the adjoint of both."""
    if n_steps not in kept:
        kept.clear()
        kept[n_steps] = np.broadcast_to(start, (n_steps + 1, *start.shape)).copy()
    return kept[n_steps], speed.copy(), np.zeros_like(start), np.zeros((2, *start.shape), np.float32)


def mesh_gradient(scene: Scene, c: Any, threads: int) -> Program:
    """Forward with all positions kept, then the adjoint by hand; each end of a spring finds the same derivative."""
    arguments, table, start, speed = _sliced(scene)
    dt, result, kept = ctypes.c_float(scene.number("dt")), np.zeros((2, len(table.heads)), np.float32), {}

    def run(n_steps: int) -> None:
        x, v, g, b = _adjoint_arrays(kept, start, speed, n_steps)
        result[...] = 0
        c.graph(*arguments, at(x), at(v), dt, n_steps, n_steps + 1, threads)
        c.graph_gradient(*arguments, at(x), at(g), at(b), at(result), at(result[1]), dt, n_steps, threads)

    def of_springs_once() -> np.ndarray:
        real, out = table.springs >= 0, np.zeros((2, len(scene["k"])), np.float32)
        out[:, table.springs[real]] = result[:, real]
        return out

    return Program(run, of_springs_once)


def image(scene: Scene, c: Any, threads: int) -> Program:
    """Bilinear samples of a picture, or the slopes of their squares."""
    picture, x, y = scene["image"], scene["x"], scene["y"]
    slopes = str(scene["kind"]) == "gradient image"
    out = np.zeros((2, len(x)) if slopes else len(x), np.float32)

    def run(n_steps: int) -> None:
        for _ in range(n_steps):
            (c.slopes if slopes else c.samples)(*picture.shape, at(picture), len(x), at(x), at(y), at(out), threads)

    return Program(run, lambda: out)
