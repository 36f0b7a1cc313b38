"""A surface from scattered points: each pulls the mesh through the barycentric weights of the triangle that holds it.

With b the three weights of point p in its triangle, e = b'z - z_p its residual and w its weight, the heights minimise

    sum_p w rho(e) + r z'L z / 2,       rho(e) = e^2 / 2           for |e| <= delta          (Huber; delta = infinity: least squares)
                                                 delta (|e| - delta / 2)   beyond

so a far point pulls with a constant force, whatever its distance. The minimum is found by reweighted least squares: springs of weight
w min(1, delta / |e|), solved exactly (`posterior.py`), until the heights stand still. Derivatives are those of the minimum, by one Newton
step with the second derivative of the energy: implicit, at the cost of one more solve. Between the places where a residual is delta the
energy is quadratic, so that this step also ends what reweighting, which is slow near the end, has begun.

Source: Huber (1964), "Robust estimation of a location parameter"; Holland & Welsch (1977) for the reweighting.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..._arrays import as_mask
from ..._checks import as_inexact, finite, has_shape, positive
from ...images.points import PointCloud
from ...inverse.fit import Iteration
from ...numerics import stopped
from ...progress import Progress
from .fitting import Reconstructed, SpringSettings, fit_springs
from .loss import MEMBRANE
from .pixels import MIDDLE, Moments, NormalEquations
from .posterior import LONGEST_ROW, Rows, exact_height, rows, solve_rows
from .raster import PixelGrid, draw, locate
from .triangles import Flip, Node, refuse_folds

MOST_REWEIGHTINGS = 100


class Loss(NamedTuple):
    """The heights in units of the points' range, and what is known of them."""

    z: Node
    variance: Node
    residual: Array
    share: Array
    unreached: Array
    n_lost: Array
    n_done: Array
    n_crossed: Array


@dataclass(frozen=True)
class PointSettings:
    """How a mesh is fitted to points.

    Attributes:
        springs: how the mesh adapts, to the image that the points are averaged into.
        huber: residual beyond which a point pulls with a constant force [m]; 1.345 times the noise is usual. None: least squares.
        pixels: (ny, nx) of that image; None: two points to a pixel.
        outline: (x0, y0, x1, y1) that the mesh covers, in the coordinates of the points [m]; None: their box.
    """

    springs: SpringSettings = field(default_factory=SpringSettings)
    huber: float | None = None
    pixels: tuple[int, int] | None = None
    outline: tuple[float, float, float, float] | None = None


@dataclass(frozen=True)
class PointSurface:
    """A surface over scattered points.

    Attributes:
        x, y: (ny, nx) nodes, from `corner` [m].
        z: (ny, nx) heights [m].
        flip: (ny-1, nx-1) which diagonal cuts each cell.
        corner: the cloud's corner (X, Y) [m].
        unreached: (ny, nx) nodes that no point decides: the springs of the points around weigh less than one spring along z, so that their
            heights come from their neighbours.
        residual: (P,) surface minus point [m]; NaN outside the mesh.
        share: (P,) what the loss left of each point's weight, 1 within `huber`; 0 outside the mesh.
        n_outside: points outside the mesh, which were not used.
        variance: (ny, nx) of the heights, over that of the noise of a point of weight 1.
        n_reweightings: solves that the loss took; 0 for least squares.
        is_settled: whether this is the minimum: the last step, exact where no residual crosses `huber`, took none across.
        mesh: the fit that the mesh is from, or None.
    """

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    flip: np.ndarray
    corner: tuple[float, float]
    unreached: np.ndarray
    residual: np.ndarray
    share: np.ndarray
    n_outside: int
    variance: np.ndarray
    n_reweightings: int
    is_settled: bool
    mesh: Reconstructed | None = None

    @property
    def rmse(self) -> float:
        """Root mean square of the residuals [m], all points within the mesh alike."""
        return float(np.sqrt(np.nanmean(self.residual**2)))

    def error_bars(self, noise: float) -> np.ndarray:
        """Standard deviation of the heights (ny, nx) [m], for independent noise of this deviation [m] at a point of weight 1.

        With `huber` it counts each point by what the loss left of its weight.
        """
        positive("noise", noise, "It is a standard deviation.")
        return noise * np.sqrt(self.variance)


def fit_points(
    cloud: PointCloud,
    settings: PointSettings | None = None,
    on_iteration: Callable[[Iteration], bool | None] | None = None,
    progress: Progress | None = None,
) -> PointSurface:
    """A mesh that adapts to scattered points, and its best heights.

    The points are averaged into an image with holes; its springs are fitted as those of any image (`fit_springs`), and the heights of that
    mesh are solved from the points themselves.

    Args:
        cloud: the points.
        settings: see `PointSettings`.
        on_iteration: called after each evaluation, as in `fit`.
        progress: shows a bar.

    Returns:
        The surface; `result.mesh` is the fit of the mesh.

    Raises:
        ValueError: an outline without points, a mesh too small or with rows of more than 400 nodes.
    """
    settings = PointSettings() if settings is None else settings
    image = cloud.image(settings.pixels, settings.outline, median=settings.huber is not None)
    found = fit_springs(image, settings.springs, on_iteration, progress=progress)
    mesh = found.fitted
    surface = point_heights(cloud, mesh.x, mesh.y, mesh.flip, settings.huber, settings.springs.membrane)
    return replace(surface, mesh=found)


def point_heights(
    cloud: PointCloud,
    x: Array | np.ndarray,
    y: Array | np.ndarray,
    flip: Array | np.ndarray | None = None,
    huber: float | None = None,
    membrane: float = MEMBRANE,
) -> PointSurface:
    """The best heights of a given mesh over scattered points.

    Args:
        cloud: the points.
        x: (ny, nx) nodes of a lattice whose border is a rectangle, from the cloud's corner [m].
        y: (ny, nx) likewise.
        flip: (ny-1, nx-1) which diagonal cuts each cell; None: from the first row's left to the next row's right.
        huber: residual beyond which a point pulls with a constant force [m]; None: least squares.
        membrane: stiffness of the springs along z over that of the points' springs that a node has on average.

    Returns:
        The surface. Points outside the mesh are counted and not used.

    Raises:
        ValueError: shapes that do not fit, a folded mesh, a huber or membrane that is not positive, no point within the mesh.
    """
    x, y = as_inexact("x", x, cloud.z.dtype), as_inexact("y", y, cloud.z.dtype)
    if x.ndim != 2 or min(x.shape) < 2 or x.shape[1] > LONGEST_ROW:
        raise ValueError(f"x has shape {x.shape}; expected (ny, nx), at least 2 each and nx at most {LONGEST_ROW}.")
    has_shape("y", y, {"as x": x.shape})
    cells = x.shape[0] - 1, x.shape[1] - 1
    flip = jnp.zeros(cells, bool) if flip is None else jnp.asarray(as_mask("flip", flip, ", one per cell"))
    has_shape("flip", flip, {"one per cell": cells})
    finite("x", x)
    finite("y", y)
    for name, value in (("huber", huber), ("membrane", membrane)):
        if value is not None:
            positive(name, value, "Without it nothing holds a node that no point reaches." if name == "membrane" else "It is a residual.")
    refuse_folds(x, y, flip)
    inside, grid, start = places_of(cloud, x, y)
    low, extent = _scale(np.asarray(cloud.z, np.float64))
    delta = None if huber is None else jnp.asarray(huber / extent, x.dtype)
    values = (cloud.z[jnp.asarray(np.flatnonzero(inside))] - low) / extent
    found = best_of_points(grid, values, start, x, y, flip, jnp.asarray(membrane, x.dtype), delta)
    residual, share = np.full(cloud.n_points, np.nan), np.zeros(cloud.n_points)
    residual[inside], share[inside] = extent * np.asarray(found.residual), np.asarray(found.share)
    return PointSurface(
        x=np.asarray(x),
        y=np.asarray(y),
        z=low + extent * np.asarray(found.z, np.float64),
        flip=np.asarray(flip),
        corner=cloud.corner,
        unreached=np.asarray(found.unreached),
        residual=residual,
        share=share,
        n_outside=cloud.n_points - int(inside.sum()),
        variance=np.asarray(found.variance, np.float64),
        n_reweightings=int(found.n_done),
        is_settled=int(found.n_crossed) == 0,
    )


def _scale(z: np.ndarray) -> tuple[float, float]:
    """A height and a range by which heights become numbers of about one: of most points, since an outlier may be anywhere."""
    low, high = np.quantile(z, [0.02, 0.98])
    return float(low), float(high - low) or float(np.ptp(z)) or 1.0


class _Problem(eqx.Module):
    """Points in the triangles that hold them, and the mesh."""

    grid: PixelGrid
    weights: Array
    values: Array
    triangle: Array
    x: Node
    y: Node
    flip: Flip
    ratio: Array
    delta: Array | None

    def equations(self, share: Array) -> NormalEquations:
        """The springs of the points, each at a share of its weight."""
        weighted = eqx.tree_at(lambda g: g.weights, self.grid, self.weights * share, is_leaf=lambda leaf: leaf is None)
        return Moments.of(self.values, weighted, self.triangle, self.x, self.y, self.flip).normal_equations(self.x, self.y, self.flip)

    def residual(self, z: Node) -> Array:
        """(P,) surface minus point."""
        return draw(self.x, self.y, z, self.flip, self.grid, self.triangle).reshape(-1) - self.values

    def share(self, error: Array) -> Array:
        """(P,) what the loss leaves of each weight."""
        size = jnp.abs(error)
        return jnp.ones_like(size) if self.delta is None else jnp.where(size > self.delta, self.delta / jnp.maximum(size, self.delta), 1)


@eqx.filter_jit
def best_of_points(
    grid: PixelGrid, values: Array, start: Array, x: Node, y: Node, flip: Flip, membrane: Array, delta: Array | None
) -> Loss:
    """The heights that minimise the energy, for values in [0, 1] or so; differentiable in values, weights, x and y.

    Args:
        grid: the points' places and weights, all within the mesh.
        values: (P,) their heights.
        start: (P,) triangles that the search for each point begins in.
        x: (ny, nx) of the nodes.
        y: (ny, nx) of the nodes.
        flip: diagonals.
        membrane: as in `point_heights`.
        delta: of Huber's loss, in the unit of the values; None for least squares.
    """
    location = locate(x, y, flip, grid, start)
    weights = jnp.ones_like(values) if grid.weights is None else grid.weights
    problem = _Problem(grid, weights, values, location.triangle, x, y, flip, membrane * jnp.sum(weights) / x.size, delta)
    if delta is None:
        z, variance = exact_height(problem.equations(jnp.ones_like(values)), problem.ratio)
        n_done = n_crossed = jnp.zeros((), jnp.int32)
    else:
        settled, n_done = _reweighted(stopped(problem))
        z, variance, n_crossed = _with_derivatives(problem, delta, settled)
    error = problem.residual(z)
    share = problem.share(error)
    unreached = problem.equations(share).diagonal() < problem.ratio
    return Loss(z, variance, error, share, unreached, location.n_lost, n_done, n_crossed)


def _reweighted(problem: _Problem) -> tuple[Node, Array]:
    """Heights that all but stand still under reweighting, from least squares on; and how many solves it took."""
    dtype = problem.x.dtype
    tolerance = _tolerance(dtype)

    def step(carry: tuple[Node, Array, Array, Array]) -> tuple[Node, Array, Array, Array]:
        before, share, n, _ = carry
        z, _ = exact_height(problem.equations(share), problem.ratio)
        return z, problem.share(problem.residual(z)), n + 1, jnp.max(jnp.abs(z - before))

    far = jnp.asarray(jnp.finfo(dtype).max, dtype)
    first = jnp.full_like(problem.x, far), jnp.ones_like(problem.values), jnp.zeros((), jnp.int32), far
    z, _, n_done, _ = lax.while_loop(lambda c: (c[3] > tolerance) & (c[2] < MOST_REWEIGHTINGS), step, first)
    return z, n_done


def _with_derivatives(problem: _Problem, delta: Array, z: Node) -> tuple[Node, Node, Array]:
    """The heights after Newton's step, with the derivatives of the minimum; the diagonal of the inverse by the weights that the loss left;
    and how many residuals the step took across delta. The energy is quadratic in between: where there are none, this is its minimum.
    """
    error = problem.residual(z)
    left = problem.equations(problem.share(error))
    matrix = rows(left, problem.ratio)
    # At the minimum this force is zero, but its derivative is not.
    force = _applied(matrix, z - MIDDLE) - left.right_side
    curved = problem.equations(jnp.where(jnp.abs(error) <= delta, 1, 0).astype(z.dtype))
    # Both matrices in one program.
    pair = jax.tree.map(lambda *a: jnp.stack(a), stopped(rows(curved, problem.ratio)), matrix)
    solved, variance = jax.vmap(solve_rows)(pair, jnp.stack([force, left.right_side]))
    after = z - solved[0]
    size, before = jnp.abs(problem.residual(after)), jnp.abs(error)
    crossed = ((size > delta) != (before > delta)) & (jnp.abs(size - delta) > _tolerance(z.dtype))
    return after, variance[1], jnp.sum(crossed, dtype=jnp.int32)


def _applied(matrix: Rows, z: Node) -> Node:
    """A block tridiagonal matrix times a node field."""
    diagonal, below = matrix
    with jax.default_matmul_precision("highest"):
        own = jnp.einsum("jab,jb->ja", diagonal, z)
        after = jnp.einsum("jab,jb->ja", below[:-1], z[1:])
        before = jnp.einsum("jba,jb->ja", below[:-1], z[:-1])
    return own + jnp.pad(after, ((0, 1), (0, 0))) + jnp.pad(before, ((1, 0), (0, 0)))


def _tolerance(dtype: jnp.dtype) -> float:
    """Change of the heights, in units of the points' range, below which reweighting ends."""
    return 1e-7 if dtype == jnp.float64 else 1e-5


def places_of(cloud: PointCloud, x: Array, y: Array) -> tuple[np.ndarray, PixelGrid, Array]:
    """Which points are within the rectangle that the mesh covers, its border included; those, in the place of pixels in one row; and the
    triangle where the search for each begins, that of the even lattice over the same rectangle.

    Raises:
        ValueError: no point is.
    """
    px, py, nodes_x, nodes_y = (np.asarray(a) for a in (cloud.x, cloud.y, x, y))
    west, east, south, north = nodes_x.min(), nodes_x.max(), nodes_y.min(), nodes_y.max()
    inside = (px >= west) & (px <= east) & (py >= south) & (py <= north)
    if not inside.any():
        raise ValueError(f"none of the {cloud.n_points} points is within the mesh. Give x and y from the cloud's corner, {cloud.corner}.")
    (ny, nx), chosen = x.shape, jnp.asarray(np.flatnonzero(inside))
    column = np.clip((px[inside] - west) / (east - west) * (nx - 1), 0, nx - 2).astype(np.int32)
    row = np.clip((py[inside] - south) / (north - south) * (ny - 1), 0, ny - 2).astype(np.int32)
    weights = None if cloud.weights is None else cloud.weights[chosen]
    return inside, PixelGrid(cloud.x[chosen], cloud.y[chosen], (1, chosen.size), weights), jnp.asarray(row * (nx - 1) + column)
