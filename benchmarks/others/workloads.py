"""The scenes that every contender gets, and how the numbers of a workload are named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import jaxspring as js
from benchmarks import fluid, heat, scenes

from . import references
from .layouts import Scene

DT = np.float32(0.05)
CHECKED_STEPS = 20
NODE_STEPS = "million node-steps / s"
IMPLICIT_STIFFNESS, IMPLICIT_DT = 1e4, 0.4
FLUID_DT = 2e-3


@dataclass(frozen=True)
class Workload:
    """One thing that all contenders do.

    Attributes:
        name: how it is called at the command line.
        group: the diagram that it belongs to.
        size: where it stands in that diagram: nodes, points or particles.
        make: its scene.
        n_steps, quick_steps: of one run.
        contenders: who takes part, if installed.
        reference: (scene, n_steps) -> what is right, in float64.
        items: what is counted in a step; the number of nodes unless said.
        unit: what is counted in a second.
        checked: steps after which results are compared.
    """

    name: str
    group: str
    size: int
    make: Callable[[], Scene]
    n_steps: int
    quick_steps: int
    contenders: tuple[str, ...]
    reference: Callable[[Scene, int], np.ndarray]
    items: Callable[[Scene], float] | None = None
    unit: str = NODE_STEPS
    checked: int = CHECKED_STEPS


def _scene(kind: str, system: js.System, state: js.State, **more: Any) -> Scene:
    springs = scenes.springs_of(system)
    return Scene(
        {
            "kind": kind,
            "x": np.asarray(state.points, np.float32),
            "v": np.asarray(state.velocities, np.float32),
            "edges": np.asarray(system.net.edges, np.int32),
            "k": np.asarray(springs.stiffness, np.float32),
            "l": np.asarray(springs.rest_length, np.float32),
            "dt": DT,
            **more,
        }
    )


def cloth(n: int, kind: str = "cloth") -> Scene:
    """An n x n cloth with three kinds of springs."""
    system, state = scenes.sheet(n)
    net = system.net
    assert isinstance(net, js.Lattice)
    offsets = np.array(net.offsets)
    assert (offsets[:, 0] >= 0).all(), "hand-written programs walk down the rows"
    return _scene(kind, system, state, shape=np.array(net.shape), offsets=offsets)


def mesh(n_nodes: int, kind: str = "mesh") -> Scene:
    """A Delaunay mesh; `order` is that of reverse Cuthill and McKee."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    system, state = scenes.mesh(n_nodes)
    i, j = system.net.edges.T
    joined = coo_array((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n_nodes, n_nodes)).tocsr()
    return _scene(kind, system, state, order=np.asarray(reverse_cuthill_mckee(joined, symmetric_mode=True), np.int32))


def batch(n_cloths: int, n: int) -> Scene:
    """Many small cloths, alike but for their start and their stiffness: x and k have a leading axis."""
    one, rng = cloth(n, "batch"), np.random.default_rng(1)
    x = one["x"] + (0.02 * rng.standard_normal((n_cloths, n * n, 3))).astype(np.float32)
    k = (1 + 0.1 * rng.random((n_cloths, len(one["edges"])))).astype(np.float32)
    names = ("kind", "edges", "l", "dt", "shape", "offsets")
    return Scene({**{name: one[name] for name in names}, "x": x, "v": np.zeros_like(x), "k": k})


def block(n: int) -> Scene:
    """Heat in a block of n x n x n nodes, at half of the explicit limit."""
    net, conductance, start = heat.block(n)
    offsets = np.array(net.offsets)
    assert offsets.tolist() == np.eye(3, dtype=int)[::-1].tolist(), "hand-written programs walk along the axes"
    g = np.asarray(net.flatten(conductance), np.float32)
    rate = np.bincount(np.ravel(net.edges), np.repeat(g, 2))
    values = {"kind": "heat", "shape": np.array(net.shape), "edges": np.asarray(net.edges, np.int32), "g": g}
    return Scene({**values, "start": start.astype(np.float32), "dt": np.float32(0.5 / rate.max())})


def picture(n: int, n_points: int, kind: str) -> Scene:
    """A smooth image with noise, and points inside it: off the lines between pixels, where the slope jumps."""
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:n, :n] / n
    values = np.sin(9 * x) * np.cos(7 * y) + 0.1 * rng.standard_normal((n, n))
    points = rng.integers(0, n - 1, (2, n_points)) + rng.uniform(0.01, 0.99, (2, n_points))
    return Scene({"kind": kind, "image": values.astype(np.float32), "x": points[0].astype(np.float32), "y": points[1].astype(np.float32)})


def liquid(n: int) -> Scene:
    """The Lennard-Jones liquid of `benchmarks.fluid`."""
    points, speeds = fluid.liquid(n)
    values = {"kind": "fluid", "x": points, "v": speeds, "reach": fluid.REACH, "skin": fluid.SKIN}
    return Scene({**values, "capacity": fluid.CAPACITY, "dt": FLUID_DT})


def stiff(n: int) -> Scene:
    """The cloth, ten thousand times as stiff; dt is about a hundred times the explicit limit."""
    scene = cloth(n, "implicit")
    names = ("kind", "x", "v", "edges", "l", "shape", "offsets")
    return Scene({**{name: scene[name] for name in names}, "k": scene["k"] * np.float32(IMPLICIT_STIFFNESS), "dt": np.float32(IMPLICIT_DT)})


LATTICE = ("jaxspring", "warp", "newton", "numba", "taichi", "c")
GRADIENT = ("jaxspring", "warp", "taichi", "c")


def _nodes(scene: Scene) -> float:
    return float(scene["x"].size / 3)


def _of_points(scene: Scene) -> float:
    return float(scene["x"].size)


def every() -> list[Workload]:
    """All workloads, in the order in which they are run."""
    positions, gradient = references.positions, references.gradient
    found = [
        Workload(f"cloth {n}", "cloth", n * n, lambda n=n: cloth(n), steps, steps // 40 * 10, LATTICE, positions)
        for n, steps in ((32, 4000), (128, 1000), (512, 240), (1024, 100))
    ]
    found += [
        Workload(f"delaunay {n}", "Delaunay mesh", n, lambda n=n: mesh(n), steps, steps // 40 * 10, LATTICE, positions)
        for n, steps in ((1000, 4000), (10_000, 1000), (100_000, 200))
    ]
    found += [
        Workload(f"gradient cloth {n}", "gradient, cloth", n * n, lambda n=n: cloth(n, "gradient cloth"), 1000, 200, GRADIENT, gradient)
        for n in (32, 128)
    ]
    found += [
        Workload(f"gradient delaunay {n}", "gradient, mesh", n, lambda n=n: mesh(n, "gradient mesh"), s, s // 4, GRADIENT, gradient)
        for n, s in ((1000, 900), (10_000, 196), (100_000, 100))
    ]
    others = ("jaxspring", "warp", "numba", "c")
    found.append(Workload("batch 1024", "batch", 1024 * 256, lambda: batch(1024, 16), 200, 100, others, references.many_positions, _nodes))
    found.append(Workload("heat 64", "heat", 64**3, lambda: block(64), 200, 50, others, references.temperatures, lambda s: s["start"].size))
    samplers, points = ("jaxspring", "warp", "numba", "torch", "c"), "million points / s"
    for kind, reference in (("image", references.samples), ("gradient image", references.slopes)):
        make: Callable[[], Scene] = lambda kind=kind: picture(512, 1_000_000, kind)  # noqa: E731 (a function each)
        found.append(Workload(kind, "image", 1_000_000, make, 10, 5, samplers, reference, _of_points, points, 1))
    fluids, pairs = ("jaxspring", "jax-md", "warp", "numba"), "million pairs / s"
    found.append(
        Workload("lennard-jones", "liquid", 8000, lambda: liquid(8000), 100, 20, fluids, references.flow, references.n_pairs, pairs)
    )
    found.append(
        Workload("implicit 64", "implicit", 64**2, lambda: stiff(64), 5, 3, ("jaxspring", "scipy"), references.implicit, checked=2)
    )
    return found
