"""The adaptive mesh on any triangles in the plane: the slides' law, and one stiffness per spring fitted through the rollout.

A spring of rest length zero along every side, a border that slides along itself, heights by least squares over the pixels. As on the
lattice the fictitious mass of a node is the sum of its springs' stiffnesses, so that one dt serves all. In a triangulation of a convex
outline every state at rest is free of folds (Tutte 1963, Floater 1997); folds are counted all the same.

    loss     1/2 log (mean square error + membrane energy) of the best heights: their own derivative is zero there
    law      k = c ((1 - a) k_min + a k_max),   c = (cot alpha + cot beta) / 2 of the first mesh, at least `LEAST` of their median
    log k    = log k_law + u + sum_m avg S^m v_m,    S = half the node, half the mean of its neighbours: long waves for the optimiser

With the cotangents alone the first mesh is at rest as it is, whatever its triangles (Pinkall and Polthier 1993): so nothing but the image
moves it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..._arrays import Numbers
from ..._checks import triangle_indices
from ...forces.adaptive import ImageStiffness
from ...forces.damping import Drag
from ...forces.springs import Springs
from ...images.image import Image
from ...images.smoothing import smooth
from ...inverse.fit import Fit, fit
from ...inverse.optimisers import Adam
from ...linalg.cg import JaxCG
from ...numerics import stopped
from ...rollouts import Result, rollout
from ...state import State
from ...status import Status
from ...steppers.explicit import SymplecticEuler
from ...system import System
from ...topology.builders import from_triangles
from ...topology.edge_field import EdgeField
from ...topology.graph import Graph
from ...topology.mesh_checks import Sides
from .border import SlidingBorder
from .given import cross, plane_points, springs_along
from .planar_pixels import PixelSums, PlanarHeights
from .raster import PixelGrid, walk
from .scene import Relaxation
from .tin import Tin, fitted_tin, locate_pixels

# Sweeps of smoothing of each field of long waves.
WAVES = (2, 8, 32)
LARGEST_LOG = 9.0
# Least stiffness of the first mesh over its median: of sides across from right angles, which would else have none.
LEAST = 0.03
LAW_RUN, LAW_UPDATES = Relaxation(n_steps=10, dt=1.0, damping=0.15), 60
FINAL_RUN = Relaxation(n_steps=3000, dt=1.3, damping=0.03)
_SMALLEST_ERROR = 1e-14


class PlanarScene(eqx.Module):
    """An image and the triangles that are to recover it.

    Attributes:
        image: the data, scaled to [0, 1].
        net: a spring along every side.
        rest: (N, 2) nodes to start from [m].
        border: keeps the border on itself.
        grid: where the pixels are.
        corners: (T, 3) nodes of the triangles.
        across: (3 T,) the triangle across each side.
        shape: (E,) stiffness at which the first mesh is at rest [N/m].
        area: of all pixels, over the square root of the number of cells: what areas are rounded by [m^2].
        inside: (P,) how much pixels count: 0 outside the outline and in holes, else their weight, or 1.
    """

    image: Image
    net: Graph
    rest: Float[Array, "N 2"]
    border: SlidingBorder
    grid: PixelGrid
    corners: Int[Array, "T 3"]
    across: Int[Array, " T3"]
    shape: Float[Array, " E"]
    area: Array
    inside: Float[Array, " P"]

    def __init__(self, image: Image, points: Numbers, triangles: Numbers):
        """Check the mesh, wind its triangles alike.

        Raises:
            ValueError: triangles that do not fit, a side of more than two triangles, no pixel in any of them.
        """
        places = plane_points(points)
        corners = wound(places, triangle_indices("triangles", triangles, len(places)))
        self.image = image.normalised()
        self.net = from_triangles(corners, len(places))
        self.rest = jnp.asarray(places, image.dtype)
        self.border = SlidingBorder(self.net, places)
        self.grid = PixelGrid.of(self.image)
        self.corners = jnp.asarray(corners)
        self.across = jnp.asarray(_across(corners))
        located = locate_pixels(self.image, places, corners)
        inside = jnp.asarray(located.triangle >= 0, image.dtype)
        self.inside = inside if self.grid.weights is None else inside * self.grid.weights
        if not (np.asarray(self.inside) > 0).any():
            raise ValueError("no pixel that counts lies in any triangle. Nodes are in the unit of the image's spacing, from its origin.")
        # What areas are rounded by: of all pixels, over the square root of the number of cells.
        self.area = (self.grid.x[-1] - self.grid.x[0]) * (self.grid.y[-1] - self.grid.y[0]) / (len(corners) // 2 + 1) ** 0.5
        self.shape = jnp.asarray(cotangents(places, corners, np.asarray(self.net.edges)), image.dtype)

    def system(self, stiffness: Array, damping: float) -> System:
        """The mesh in the plane: (E,) stiffness [N/m], mass and drag by the stiffnesses too. The state at rest does not depend on these."""
        mass = self.net.layout.flatten(self.net.incident_sum(self.net.split(stiffness)))
        springs = Springs(self.net, stiffness, 0.0, axes=(0, 1))
        return System(self.net, mass, (springs, Drag(damping * mass)), rules=self.border)

    def relax(self, stiffness: Array, points: Array, relaxation: Relaxation) -> Result:
        """Damped steps from `points` (N, 2) toward the equilibrium of `stiffness` (E,) [N/m]."""
        system = self.system(stiffness, relaxation.damping)
        start = State.from_points(self.net, points)
        return rollout(system, start, SymplecticEuler(), dt=relaxation.dt, n_steps=relaxation.n_steps)

    def adapt(self, rule: ImageStiffness) -> tuple[Array, Array]:
        """Stiffness (E,) and places (N, 2) of a law, brought to rest together."""
        ready = rule.bind(self.net, self.rest.dtype)

        def stiffness(points: Array) -> Array:
            return self.shape * self.net.flatten(ready.stiffness(self.net, State.from_points(self.net, points)))

        def update(points: Array, _: None) -> tuple[Array, None]:
            return self.relax(stiffness(points), points, LAW_RUN).state.points, None

        points, _ = lax.scan(update, self.rest, None, length=LAW_UPDATES)
        return stiffness(points), points


@dataclass(frozen=True)
class PlanarSettings:
    """How one stiffness per spring of a triangulation is fitted.

    Attributes:
        n_iterations: gradient steps.
        learning_rate: of Adam at the start, on the logarithms; it falls along a cosine to a twentieth.
        momentum: of Adam.
        k_min, k_max: of the law that the fit starts from [N/m]; equal ones start from the mesh as it is.
        sigma: width of the law's Gaussian, in the unit of the image's spacing.
        relaxation: the rollout of each iteration.
    """

    n_iterations: int = 400
    learning_rate: float = 0.1
    momentum: float = 0.95
    k_min: float = 1.0
    k_max: float = 1.0
    sigma: float = 1.0
    relaxation: Relaxation = Relaxation()  # noqa: RUF009 (frozen, holds no array)


class PlanarCarried(eqx.Module):
    """What one evaluation leaves for the next: places (N, 2), heights (N,), triangle of each pixel (P,)."""

    points: Array
    z: Array
    triangle: Array


class PlanarLoss(eqx.Module):
    """The loss as a function of the variables of the stiffness, through the rollout.

    Attributes:
        scene: image and mesh.
        log_law: (E,) log of the stiffness at variables of zero.
        relaxation: the rollout.
        membrane: stiffness of the springs along z over that of all pixels' springs that a node has on average.
        solver: of the heights.
    """

    scene: PlanarScene
    log_law: Array
    relaxation: Relaxation = Relaxation()
    membrane: float = eqx.field(static=True, default=1e-4)
    solver: JaxCG = JaxCG(tolerance=1e-4)

    def zero(self) -> dict[str, Array]:
        """Variables of the law itself."""
        n = self.scene.net.n_nodes
        waves = {f"wave_{m}": jnp.zeros(n, self.log_law.dtype) for m in WAVES}
        return {"spring": jnp.zeros_like(self.log_law), **waves}

    def stiffness(self, variables: dict[str, Array]) -> Array:
        """(E,) stiffness of every spring [N/m]."""
        net = self.scene.net
        change, ones = variables["spring"], net.split(jnp.ones_like(self.log_law))
        degree = net.incident_sum(ones)
        for m in WAVES:
            # Half of what the neighbours are on average: sums over a node's springs of (own + other) / 2, less half the own.
            def sweep(v: Array, _: None) -> tuple[Array, None]:
                return net.incident_sum(net.average(v)) / degree, None

            smoothed, _ = lax.scan(sweep, net.layout.unflatten(variables[f"wave_{m}"]), None, length=m)
            change = change + net.flatten(_as_field(net, net.average(smoothed)))
        return jnp.exp(jnp.clip(self.log_law + change, -LARGEST_LOG, LARGEST_LOG))

    def __call__(self, variables: dict[str, Array], carried: PlanarCarried) -> tuple[Array, tuple[PlanarCarried, Any]]:
        """Value, and (what the next evaluation starts from, (error, folds, pixels outside, status))."""
        scene = self.scene
        stiffness = self.stiffness(variables)
        result = scene.relax(stiffness, carried.points, self.relaxation)
        value, left, facts = self.measure(result.state.points, carried)
        return value, (left, (*facts, stopped(result.status)))

    def measure(self, points: Array, carried: PlanarCarried) -> tuple[Array, PlanarCarried, tuple[Array, Array, Array]]:
        """The loss of places (N, 2), what they leave, and error, folds, pixels outside."""
        scene = self.scene
        held = lax.stop_gradient(points)
        vertices = [held[scene.corners[:, i], axis] for axis in range(2) for i in range(3)]
        n_triangles = scene.corners.shape[0]
        found = walk(vertices, scene.across, scene.grid, carried.triangle, scene.area, 4 * int(n_triangles**0.5) + 8)
        sums = PixelSums.of(scene.image.values.reshape(-1), scene.inside, scene.grid, found.triangle, held, scene.corners)
        n_pixels = jnp.sum(scene.inside)
        ratio = self.membrane * n_pixels / scene.net.n_nodes
        heights = PlanarHeights(sums, held, scene.corners, scene.net)
        z = lax.stop_gradient(heights.best(ratio, carried.z, self.solver))
        tension = ratio * heights.membrane_energy(z) / n_pixels
        error = jnp.maximum(jnp.sum(sums.squared_error(points, z, scene.corners)) / n_pixels, _SMALLEST_ERROR)
        folds = jnp.sum(doubled_areas(held, scene.corners) <= 0).astype(jnp.int32)
        left = stopped(PlanarCarried(points, z, found.triangle))
        return 0.5 * jnp.log(error + tension), left, stopped((jnp.sqrt(error), folds, found.n_lost))


@dataclass(frozen=True)
class PlanarFit:
    """What `fit_triangles` returns.

    Attributes:
        tin: the fitted mesh at rest, with its best heights [unit of the image].
        stiffness: (E,) of the springs along its sides, in the order of `tin.net.edges` [N/m].
        fit: history, status and reason.
        status: of the last relaxation.
    """

    tin: Tin
    stiffness: np.ndarray
    fit: Fit
    status: Status


def fit_triangles(
    image: Image, points: Numbers, triangles: Numbers, settings: PlanarSettings | None = None, stiffness: Any = None
) -> PlanarFit:
    """Recover an image with a mesh of any triangles whose springs are fitted through the rollout.

    The mesh may be a Delaunay triangulation, one of a mesh file, an outline with holes, or a refined one. Its border slides along itself,
    corners stay. Pixels outside have no say.

    Args:
        image: the data.
        points: (N, 2) or (N, 3) nodes to start from, in the unit of the image's spacing.
        triangles: (T, 3) node numbers.
        settings: see `PlanarSettings`.
        stiffness: (E,) to start from [N/m], in the order of `from_triangles(triangles, N).edges`; None: the law of the settings.

    Returns:
        `PlanarFit`.

    Raises:
        ValueError: triangles that do not fit the points.
    """
    settings = PlanarSettings() if settings is None else settings
    scene = PlanarScene(image, points, triangles)
    dtype = scene.rest.dtype
    if stiffness is not None:
        start, places = jnp.asarray(stiffness, dtype), scene.rest
    elif settings.k_min == settings.k_max:
        start, places = settings.k_min * scene.shape, scene.rest
    else:
        start, places = _adapted(scene, ImageStiffness(smooth(scene.image, settings.sigma), settings.k_min, settings.k_max, 0.0, radius=0))
    loss = PlanarLoss(scene, jnp.log(start), settings.relaxation)
    carried = begin(scene, places)
    optimiser = Adam(settings.learning_rate, settings.momentum, decay_over=settings.n_iterations)
    found = fit(loss, loss.zero(), optimiser, settings.n_iterations, carried=carried)
    k = loss.stiffness(found.parameters)
    end = _at_rest(scene, k, found.best_carried.points)
    tin = fitted_tin(image, np.asarray(end.state.points, np.float64), np.asarray(scene.corners))
    return PlanarFit(tin, np.asarray(k), found, end.status)


def begin(scene: PlanarScene, points: Array) -> PlanarCarried:
    """The first `PlanarCarried`: pixels found on the host. A pixel outside starts its walk in triangle 0 and ends at the border."""
    located = locate_pixels(scene.image, np.asarray(points, np.float64), np.asarray(scene.corners))
    z = scene.image.sample(points[:, 0], points[:, 1])
    return PlanarCarried(points, z, jnp.asarray(np.maximum(located.triangle, 0), jnp.int32))


@eqx.filter_jit
def _adapted(scene: PlanarScene, rule: ImageStiffness) -> tuple[Array, Array]:
    return scene.adapt(rule)


@eqx.filter_jit
def _at_rest(scene: PlanarScene, stiffness: Array, points: Array) -> Result:
    return scene.relax(stiffness, points, FINAL_RUN)


def doubled_areas(points: Array, corners: Array) -> Array:
    """(T,) twice the signed area of every triangle."""
    a, b, c = (points[corners[:, i]] for i in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def cotangents(points: np.ndarray, corners: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(E,) half the sum of the cotangents of the angles across each side, at least `LEAST` of their median."""
    total = np.zeros(len(edges))
    for i in range(3):
        a, b, c = corners[:, i], corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]
        u, v = points[b] - points[a], points[c] - points[a]
        twice = np.abs(cross(u, v))
        place = springs_along(edges, np.stack([b, c], axis=-1), len(points))
        np.add.at(total, place, 0.5 * (u * v).sum(axis=1) / np.where(twice > 0, twice, 1))
    return np.maximum(total, LEAST * np.median(total[total > 0]))


def wound(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The triangles, all wound so that their area is positive."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return np.where((cross(b - a, c - a) < 0)[:, None], triangles[:, [0, 2, 1]], triangles)


def _across(corners: np.ndarray) -> np.ndarray:
    """(3 T,) the triangle across the side opposite to a, of all triangles, then b, then c; -1 across the border."""
    sides = Sides(corners)
    if sides.counts.max() > 2:
        raise ValueError(
            f"{sides.where(int(np.argmax(sides.counts)))} has more than two triangles; a surface over the plane has two at most."
        )
    _, one, other, _ = sides.shared()
    n = len(corners)
    # Runs come as a b of all triangles, b c, c a: opposite to c, a and b.
    opposite = np.full((3, n), -1)
    shared = np.flatnonzero(sides.counts == 2)
    partner = np.full((len(sides.counts), 2), -1)
    partner[shared, 0], partner[shared, 1] = one, other
    for run, corner in enumerate((2, 0, 1)):
        at = sides.of[run * n : (run + 1) * n]
        pair = partner[at]
        opposite[corner] = np.where(pair[:, 0] == np.arange(n), pair[:, 1], pair[:, 0])
    return opposite.ravel().astype(np.int32)


def _as_field(net: Graph, field: Any) -> EdgeField:
    return field if isinstance(field, EdgeField) else net.own((field,))


__all__ = ["PlanarFit", "PlanarLoss", "PlanarScene", "PlanarSettings", "fit_triangles"]
