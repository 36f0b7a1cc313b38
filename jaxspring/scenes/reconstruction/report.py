"""What a reconstruction is worth: root mean square errors over all pixels, in the image's own unit.

Two rules for the heights, never compared with each other: `sampled` takes the image under each node, `best` the least-squares heights of
the mesh. The reference is the bilinear spline on the regular grid with as many nodes: the stricter one, as the same nodes joined by
triangles do worse.

Errors are taken from the drawn surface, pixel by pixel in double precision, not from the sums that the fit uses. Where pixels have
weights w they are sqrt(sum w e^2 / sum w): over the pixels that have data, where the weights are ones and zeros.

With holes the best heights are solved exactly: the error of an iterative solve hides where only the weak springs along z hold a node.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...linalg.cg import JaxCG
from .given import pixel_weights, weighted_rms
from .loss import MEMBRANE, Carried, SurfaceError, choose_diagonals
from .pixels import Moments, best_height
from .posterior import LONGEST_ROW, exact_height
from .raster import draw, locate
from .scene import Reconstruction
from .triangles import Node, count_folds

# The last heights are solved to what float32 can hold.
_SOLVER = JaxCG(tolerance=1e-5)


class Errors(NamedTuple):
    """Root mean square errors under the two rules, by the pixels' weights, in the image's unit."""

    sampled: float
    best: float


class Surface(NamedTuple):
    """A mesh and what it makes of the image.

    Attributes:
        x, y: (ny, nx) nodes [m].
        flip: (ny-1, nx-1) which diagonal cuts each cell.
        z_sampled, z_best: (ny, nx) heights under either rule, in the image's unit.
        image_sampled, image_best: (rows, columns) the surfaces drawn, in the image's unit.
        rmse: their errors.
        folds: triangles folded over.
        outside: pixels in no triangle.
        unreached: (ny, nx) nodes that no datum decides: the springs of the pixels around them weigh less than one spring along z, so that
            their heights come from their neighbours. None where the image has no weights.
    """

    x: np.ndarray
    y: np.ndarray
    flip: np.ndarray
    z_sampled: np.ndarray
    z_best: np.ndarray
    image_sampled: np.ndarray
    image_best: np.ndarray
    rmse: Errors
    folds: int
    outside: int
    unreached: np.ndarray | None = None


def measure(error: SurfaceError, carried: Carried, diagonals: bool = True) -> Surface:
    """The surface over the mesh in `carried`, under both rules; with `diagonals`, each cell is first cut along its better one."""
    scene = error.scene
    if diagonals:
        carried = _choose(error, carried)
    z_sampled, z_best, sampled, best, folds, lost, unreached = _draw_both(error, carried)
    truth = _own_unit(scene, scene.image.values)
    sampled, best, z_sampled, z_best = (_own_unit(scene, a) for a in (sampled, best, z_sampled, z_best))
    rmse = Errors(*(weighted_rms(drawn - truth, pixel_weights(scene.image)) for drawn in (sampled, best)))
    x, y, flip = (np.asarray(a) for a in (carried.x, carried.y, carried.flip))
    return Surface(x, y, flip, z_sampled, z_best, sampled, best, rmse, int(folds), int(lost), _host(unreached))


def uniform_errors(scene: Reconstruction) -> tuple[Errors, np.ndarray, np.ndarray]:
    """Errors of the bilinear spline on the regular grid, and the two images it makes (sampled, best), in the image's unit."""
    weights = scene.image.weights
    truth = _own_unit(scene, scene.image.values)
    rows, columns = (_hats(n, p) for n, p in zip(scene.net.shape, truth.shape, strict=True))
    at_nodes = _own_unit(scene, scene.image.sample(scene.rest.x, scene.rest.y))
    sampled = rows @ at_nodes @ columns.T
    if weights is None:
        # Least squares for a tensor product of hats: along each axis by itself.
        best = rows @ (np.linalg.pinv(rows) @ truth @ np.linalg.pinv(columns).T) @ columns.T
    else:
        best = rows @ _weighted_spline(rows, columns, truth, np.asarray(weights, np.float64)) @ columns.T
    return Errors(*(weighted_rms(drawn - truth, pixel_weights(scene.image)) for drawn in (sampled, best))), sampled, best


def _weighted_spline(rows: np.ndarray, columns: np.ndarray, truth: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(ny, nx) heights of the bilinear spline that minimise the weighted squares and the same little membrane energy as the meshes'."""
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    (_, ny), (_, nx) = rows.shape, columns.shape
    hats = sparse.kron(sparse.csr_array(rows), sparse.csr_array(columns)).tocsr()
    apart = [sparse.eye_array(n - 1, n, k=1) - sparse.eye_array(n - 1, n) for n in (ny, nx)]
    laplacian = sparse.kron(apart[0].T @ apart[0], sparse.eye_array(nx)) + sparse.kron(sparse.eye_array(ny), apart[1].T @ apart[1])
    w = weights.ravel()
    matrix = hats.T @ (w[:, None] * hats) + MEMBRANE * w.sum() / (ny * nx) * laplacian
    return np.asarray(spsolve(sparse.csc_array(matrix), hats.T @ (w * truth.ravel()))).reshape(ny, nx)


@eqx.filter_jit
def _choose(error: SurfaceError, carried: Carried) -> Carried:
    return choose_diagonals(error, carried)


@eqx.filter_jit
def _draw_both(error: SurfaceError, carried: Carried) -> tuple[Node, Node, Node, Node, jax.Array, jax.Array, jax.Array | None]:
    scene, x, y, flip = error.scene, carried.x, carried.y, carried.flip
    location = locate(x, y, flip, scene.grid, carried.triangle)
    moments = Moments.of(scene.image.values.reshape(-1), scene.grid, location.triangle, x, y, flip)
    equations, ratio, unreached = moments.normal_equations(x, y, flip), jnp.asarray(error.ratio, x.dtype), None
    if scene.grid.weights is None or x.shape[1] > LONGEST_ROW:
        best, _ = best_height(equations, scene.net, ratio, carried.z, _SOLVER)
    else:
        best, _ = exact_height(equations, ratio)
    if scene.grid.weights is not None:
        unreached = equations.diagonal() < ratio
    sampled = scene.image.sample(x, y)
    drawn = [draw(x, y, z, flip, scene.grid, location.triangle) for z in (sampled, best)]
    return sampled, best, drawn[0], drawn[1], count_folds(x, y, flip), location.n_lost, unreached


def _own_unit(scene: Reconstruction, scaled: jax.Array) -> np.ndarray:
    return float(scene.low) + float(scene.extent) * np.asarray(scaled, np.float64)


def _host(mask: jax.Array | None) -> np.ndarray | None:
    return None if mask is None else np.asarray(mask)


def _hats(n_nodes: int, n_pixels: int) -> np.ndarray:
    """(n_pixels, n_nodes) linear hat functions of evenly spread nodes, at the pixels."""
    t = np.arange(n_pixels) * (n_nodes - 1) / (n_pixels - 1)
    return np.maximum(0.0, 1.0 - np.abs(t[:, None] - np.arange(n_nodes)[None, :]))
