"""Three small scenes on which accuracy is bought with time: a chain, a stiff cloth, the mesh that recovers an image. Float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js
from jaxspring.images.smoothing import smooth
from jaxspring.scenes.reconstruction.scene import Reconstruction

SMOOTHING = 0.25  # width of the Gaussian of the law, over the spacing of the mesh
CRUMPLE = 3e-4  # [m]
HEAVIER = 1.5  # mass of the reconstruction mesh over the sum of its stiffnesses at the start

LONG_TO_COMPILE = (
    "ForwardEuler",
    "SemiImplicit",
    "BackwardEuler",
    "BackwardEuler, Newton",
    "ImplicitMidpoint",
    "BDF2",
    "diffrax Tsit5",
    "diffrax Kvaerno5",
)


@dataclass(frozen=True)
class Scene:
    """One problem: from `start` to `t1`.

    Attributes:
        name: of files.
        title: of tables.
        system: the system for a value of the constant by which is differentiated.
        constant: its name.
        value: its value.
        start: the first state.
        t1: time of the end [s].
        explicit, implicit: numbers of steps, for explicit steppers and for those that solve.
        without_derivative: methods whose derivative is left out, to spare its compilation.
        most_kvaerno: most steps of diffrax's Kvaerno5, which factors a dense matrix in each.
    """

    name: str
    title: str
    system: Callable[[jax.Array], js.System]
    constant: str
    value: float
    start: js.State
    t1: float
    explicit: tuple[int, ...]
    implicit: tuple[int, ...]
    without_derivative: tuple[str, ...] = ()
    most_kvaerno: int = 200_000

    def loss(self, position: js.Vector) -> jax.Array:
        """Mean square displacement of the nodes [m^2]."""
        moved = position - self.start.position
        return jnp.mean(moved.dot(moved))


def chain(n: int = 17) -> Scene:
    """A metre of n nodes, both ends held, straight and at rest: it falls and swings, k = 200 N/m, 10 g a node, drag."""
    net = js.lattice(n)
    points = np.stack([np.linspace(0, 1, n), np.zeros(n)], axis=1)
    free = ~np.isin(np.arange(n), [0, n - 1])
    forces = (js.Springs(net, 200.0, 1 / (n - 1)), js.Gravity([0.0, -9.81]), js.Drag(0.01))
    system = js.System(net, 0.01, forces, free=free)
    start = js.State.from_points(net, points)
    return Scene(
        "chain",
        f"hanging chain, {n} nodes",
        lambda k: js.replace(system, stiffness=k),
        "stiffness",
        200.0,
        start,
        0.5,
        (32, 128, 512, 2048, 8192),
        (16, 64, 256, 1024),
    )


def cloth(n: int = 10) -> Scene:
    """A sheet a little crumpled, two corners held, that falls by its weight: k = 1e5 N/m, 10 g a node, drag; explicit limit 0.16 ms.

    Crumpled by a centimetre, as in the hard cases, it only rings: then an implicit step, which damps that, is wrong at every dt.
    """
    net = js.lattice((n, n), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.concatenate([net.grid(0.1), np.zeros((n * n, 1))], axis=1)
    points = flat + CRUMPLE * np.random.default_rng(3).normal(size=flat.shape)
    free = ~np.isin(np.arange(n * n), [0, n - 1])
    forces = (js.Springs(net, 1e5, net.lengths(flat)), js.Gravity([0.0, 0.0, -9.81]), js.Drag(0.02))
    system = js.System(net, 0.01, forces, free=free)
    return Scene(
        "cloth",
        f"stiff pinned cloth, {n} x {n} nodes",
        lambda k: js.replace(system, stiffness=k),
        "stiffness",
        1e5,
        js.State.from_points(net, points),
        0.1,
        (256, 512, 1024, 4096, 16384),
        (16, 64, 256, 1024),
        LONG_TO_COMPILE,
        25,
    )


def mesh(n: int = 11) -> Scene:
    """The slides' mesh over a smooth picture, from the uniform lattice: image stiffness in the plane, data springs, drag.

    Read by cubic splines. With bilinear reading the force has a kink at every border of a pixel, and no method keeps its order.
    """
    y, x = np.mgrid[:48, :56]
    picture = np.sin(0.21 * x + 0.09 * y) + np.sin(-0.13 * x + 0.24 * y + 1.0) + np.exp(-((x - 30) ** 2 + (y - 20) ** 2) / 40)
    scene = Reconstruction(js.Image(picture), (n, n))
    net, spline = scene.net, js.images.CubicSpline()
    rule = js.ImageStiffness(smooth(scene.image, SMOOTHING * scene.spacing), 1.0, 30.0, 0.0, radius=0, sampling=spline)
    points = np.concatenate([np.stack([np.ravel(a) for a in scene.rest], axis=1), np.zeros((n * n, 1))], axis=1)
    start = js.State.from_points(net, points)
    at_start = net.flatten(rule.bind(net, start.dtype).stiffness(net, start))
    mass = HEAVIER * net.incident_sum(net.split(at_start))
    forces = (
        js.Springs(net, rule, 0.0, axes=(0, 1)),
        js.Springs(net, 0.05, 0.0, axes=(2,)),
        js.DataSprings(scene.image, 1.0, sampling=spline),
        js.Drag(0.15 * mass),
    )
    system = js.System(net, mass, forces, free=scene.sliding(3))
    return Scene(
        "mesh",
        f"reconstruction mesh, {n} x {n} nodes",
        lambda k: js.replace(system, k_max=k),
        "k_max",
        30.0,
        start,
        32.0,
        (16, 32, 64, 256, 1024),
        (16, 64, 256),
        LONG_TO_COMPILE,
        200,
    )
