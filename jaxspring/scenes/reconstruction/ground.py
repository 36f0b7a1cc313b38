"""Which points of a cloud are ground: a cloth thrown over the cloud, turned upside down.

With heights turned over, h = -z, the ground lies above what stands on it, and a cloth that falls from above comes to rest on the ground and
hangs across the pits that buildings and trees leave. Each node has a floor, the highest h of the points nearest to it. A step is

    fall    h_new = h + (1 - DAMPING) (h - h_old) - g dt^2                        nodes that are not held
    pull    h += RELAXED sum_q (h_q - h) / d_q / sum_q 1 / d_q                    PULLS times the rigidness; 16 neighbours q at distance d_q
    floor   h below its floor: put on it, and held from then on

The pull is that of threads under one tension, whose vertical part is the slope; neighbours are those of structural, shear and bending
springs. A cloth across a square pit of n nodes hangs about g dt^2 n^2 / (23 rigidness) deep. Nodes without a point near have no floor.
At the end nodes that still hang beside a held one, with floors that differ by less than `step`, are laid on theirs: steep slopes.

A point is ground where it is nearer to the cloth than a threshold.

Source: Zhang et al. (2016), "An easy-to-use airborne LiDAR data filtering method based on cloth simulation", Remote Sensing 8, 501, which
pulls along the springs one after the other; here all are pulled at once, by weights that a net of uneven spacing needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..._checks import as_inexact, positive
from ...images.points import PointCloud
from .points import places_of
from .raster import draw, locate
from .triangles import Node, refuse_folds

DAMPING = 0.01
RELAXED = 0.9
PULLS = 3
# Rows and columns of nodes beyond the points, and how far above the highest the cloth begins [m].
MARGIN, ABOVE = 2, 0.05
# Share of the threshold that no node moves further than in a step of a cloth at rest.
STILL = 0.01
_HALF = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0), (2, 2), (2, -2))
NEIGHBOURS = (*_HALF, *((-row, -column) for row, column in _HALF))


@dataclass(frozen=True)
class GroundSettings:
    """How the cloth falls. The defaults are those in use for airborne scans in metres.

    Attributes:
        resolution: distance between nodes of the even cloth [m].
        rigidness: 1 for steep mountains, 2 for hills, 3 for flat land with buildings.
        threshold: distance from the cloth below which a point is ground [m].
        step: difference of neighbouring floors up to which a hanging node is laid down at the end [m]; None: none is.
        dt: time step [s].
        gravity: [m/s^2], of the falling cloth; a small one falls gently.
        n_steps: most steps.

    Raises:
        ValueError: a number that is not above zero.
    """

    resolution: float = 0.5
    rigidness: int = 3
    threshold: float = 0.5
    step: float | None = 0.3
    dt: float = 0.65
    gravity: float = 0.2
    n_steps: int = 500

    def __post_init__(self) -> None:
        for name in ("resolution", "rigidness", "threshold", "dt", "gravity", "n_steps"):
            positive(name, getattr(self, name), "The cloth would not fall, or would be of no size.")
        if self.step is not None:
            positive("step", self.step, "Pass None to lay down no hanging node.")


class Ground(NamedTuple):
    """What the cloth found.

    Attributes:
        is_ground: (P,) which points are ground; False outside the cloth.
        above: (P,) height of each point over the cloth [m]; NaN outside it.
        x, y: (ny, nx) nodes of the cloth, from `corner` [m].
        z: (ny, nx) the cloth, right side up [m].
        is_held: (ny, nx) nodes that lie on a point; the others hang.
        corner: the cloud's corner (X, Y) [m].
        n_outside: points outside the cloth.
        n_steps: steps that it fell.
        is_settled: whether it was at rest at the end.
    """

    is_ground: np.ndarray
    above: np.ndarray
    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    is_held: np.ndarray
    corner: tuple[float, float]
    n_outside: int
    n_steps: int
    is_settled: bool


def ground_of_points(
    cloud: PointCloud, settings: GroundSettings | None = None, mesh: tuple[Array | np.ndarray, Array | np.ndarray] | None = None
) -> Ground:
    """Throw a cloth over a cloud and tell ground from what stands on it.

    Args:
        cloud: the points.
        settings: see `GroundSettings`.
        mesh: (x, y) nodes of a lattice, each (ny, nx), from the cloud's corner [m], such as one that adapted to the terrain. Without it
            an even one of `settings.resolution` that reaches two nodes beyond the points.

    Returns:
        Which points are ground, and the cloth.

    Raises:
        ValueError: a mesh of fewer than 3 x 3 nodes, or folded; no point in it.
    """
    settings = GroundSettings() if settings is None else settings
    x, y = _even(cloud, settings.resolution) if mesh is None else (as_inexact("mesh", a, cloud.z.dtype) for a in mesh)
    if x.ndim != 2 or min(x.shape) < 3 or y.shape != x.shape:
        raise ValueError(f"mesh has x of shape {x.shape} and y of shape {y.shape}; a cloth needs one shape (ny, nx), 3 x 3 at least.")
    flip = jnp.zeros((x.shape[0] - 1, x.shape[1] - 1), bool)
    refuse_folds(x, y, flip)
    inside, grid, start = places_of(cloud, x, y)
    z = cloud.z[jnp.asarray(np.flatnonzero(inside))]
    # Counted from the lowest point, so that float32 keeps its digits where land is high.
    low = jnp.min(z)
    floor = jnp.asarray(_floors(x, y, grid.x, grid.y, z - low), x.dtype)
    step = jnp.asarray(0.0 if settings.step is None else settings.step, x.dtype)
    drop, still = (jnp.asarray(a, x.dtype) for a in (settings.gravity * settings.dt**2, STILL * settings.threshold))
    fallen = fall(x, y, floor, drop, still, step, PULLS * settings.rigidness, settings.n_steps)
    cloth = low - fallen.height
    triangle = locate(x, y, flip, grid, start).triangle
    above = np.full(cloud.n_points, np.nan)
    above[inside] = np.asarray(z - draw(x, y, cloth, flip, grid, triangle).reshape(-1))
    return Ground(
        is_ground=np.abs(np.nan_to_num(above, nan=np.inf)) < settings.threshold,
        above=above,
        x=np.asarray(x),
        y=np.asarray(y),
        z=np.asarray(cloth),
        is_held=np.asarray(fallen.is_held),
        corner=cloud.corner,
        n_outside=cloud.n_points - int(inside.sum()),
        n_steps=int(fallen.n_steps),
        is_settled=bool(fallen.change <= still),
    )


class Fallen(NamedTuple):
    """The cloth upside down: heights, which nodes are held, steps done, and the largest change in the last."""

    height: Node
    is_held: Array
    n_steps: Array
    change: Array


@jax.jit
def fall(x: Node, y: Node, floor: Node, drop: Array, still: Array, step: Array, n_pulls: Array | int, n_steps: Array | int) -> Fallen:
    """Let the cloth fall on `floor` (upside down; minus infinity where there is none) and lie still.

    Args:
        x: (ny, nx) of the nodes [m].
        y: (ny, nx) of the nodes [m].
        floor: (ny, nx) [m].
        drop: g dt^2 [m].
        still: largest change in a step of a cloth at rest [m].
        step: of `GroundSettings` [m]; 0 lays no node down.
        n_pulls: how often neighbours pull in a step.
        n_steps: most steps.
    """
    weights = _tension(x, y)

    def pull(_: int, h: Node, held: Array) -> Node:
        mean = sum((w * jnp.roll(h, offset, (0, 1)) for w, offset in zip(weights, NEIGHBOURS, strict=True)), jnp.zeros_like(h))
        return jnp.where(held, h, h + RELAXED * (mean - h))

    def one(carry: tuple[Node, Node, Array, Array, Array]) -> tuple[Node, Node, Array, Array, Array]:
        h, before, held, n, _ = carry
        moved = jnp.where(held, h, h + (1 - DAMPING) * (h - before) - drop)
        moved = lax.fori_loop(0, n_pulls, partial(pull, held=held), moved)
        below = (moved < floor) & ~held
        change = jnp.max(jnp.where(held | below, 0, jnp.abs(moved - h)))
        return jnp.where(below, floor, moved), h, held | below, n + 1, change

    top = jnp.full_like(x, jnp.max(floor) + ABOVE)
    first = top, top, jnp.zeros(x.shape, bool), jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, x.dtype)
    h, _, held, n_done, change = lax.while_loop(lambda c: (c[4] > still) & (c[3] < n_steps), one, first)
    held = _laid(floor, held, step)
    return Fallen(jnp.where(held, floor, h), held, n_done, change)


def _laid(floor: Node, held: Array, step: Array) -> Array:
    """Held nodes, and all that are joined to one by neighbours whose floors differ by less than `step`."""

    def spread(held: Array) -> Array:
        for down, right in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            exists = _exists(floor.shape, down, right)
            other = jnp.roll(floor, (down, right), (0, 1))
            near = jnp.where(jnp.isfinite(floor) & jnp.isfinite(other), jnp.abs(floor - jnp.where(jnp.isfinite(other), other, 0)), jnp.inf)
            held = held | (jnp.roll(held, (down, right), (0, 1)) & exists & (near < step))
        return held

    def grows(pair: tuple[Array, Array]) -> Array:
        return jnp.any(pair[0] != pair[1])

    return lax.while_loop(grows, lambda pair: (pair[1], spread(pair[1])), (held, spread(held)))[1]


def _tension(x: Node, y: Node) -> list[Node]:
    """1/d of every neighbour over the sum of all, zero where there is none, in the order of NEIGHBOURS as `jnp.roll` shifts."""
    weights = []
    for down, right in NEIGHBOURS:
        exists = _exists(x.shape, down, right)
        away = jnp.hypot(x - jnp.roll(x, (down, right), (0, 1)), y - jnp.roll(y, (down, right), (0, 1)))
        weights.append(jnp.where(exists, 1 / jnp.where(exists, away, 1), 0).astype(x.dtype))
    total = sum(weights[1:], weights[0])
    return [w / total for w in weights]


def _exists(shape: tuple[int, ...], down: int, right: int) -> np.ndarray:
    """(ny, nx) where what `jnp.roll` shifts to a node by so many rows and columns is a neighbour, not one from beyond the other border."""
    row, column = np.indices(shape)
    return (row >= down) & (row < shape[0] + down) & (column >= right) & (column < shape[1] + right)


def _even(cloud: PointCloud, resolution: float) -> tuple[Array, Array]:
    """Nodes of an even lattice, `MARGIN` beyond the points."""
    sides = [np.arange(-MARGIN, np.ceil(float(jnp.max(a)) / resolution) + MARGIN + 1) * resolution for a in (cloud.x, cloud.y)]
    x, y = np.meshgrid(*sides)
    return jnp.asarray(x, cloud.z.dtype), jnp.asarray(y, cloud.z.dtype)


def _floors(x: Array, y: Array, px: Array, py: Array, z: Array) -> np.ndarray:
    """(ny, nx) the highest -z of the points whose nearest node this is; minus infinity where there is none."""
    from scipy.spatial import KDTree

    nodes = np.column_stack([np.ravel(x), np.ravel(y)])
    _, nearest = KDTree(nodes).query(np.column_stack([px, py]))
    floor = np.full(len(nodes), -np.inf)
    np.maximum.at(floor, nearest, -np.asarray(z, np.float64))
    return floor.reshape(x.shape)
