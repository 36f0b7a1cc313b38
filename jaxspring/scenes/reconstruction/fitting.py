"""The main job: fit one stiffness per spring, by gradients through the rollout, until the mesh recovers the image.

The start is the slides' law. Then each iteration relaxes the mesh by a rollout from where the last one ended, evaluates the loss and
follows its gradient; every 25 iterations each cell may change its diagonal. At the end the mesh is brought to rest and measured.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..._checks import positive
from ...images.image import Image
from ...inverse.checkpoint import Checkpoint
from ...inverse.fit import Fit, Iteration, fit
from ...inverse.optimisers import Adam
from ...progress import Progress
from ...state import State
from ...status import Status
from .loss import MEMBRANE, Carried, SpringLoss, SurfaceError, begin
from .pixels import Moments
from .posterior import LONGEST_ROW, exact_height
from .raster import locate
from .report import Errors, Surface, measure, uniform_errors
from .scene import Reconstruction, Relaxation
from .stiffness_map import StiffnessMap

# The law moves its mesh in short runs between which the stiffness follows; the small step leaves room for a stiffness that grows.
LAW_RUN = Relaxation(n_steps=10, dt=1.0, damping=0.15)
LAW_UPDATES = 60
# The fitted mesh at the end: long, and damped for modes far slower than those of an even mesh.
FINAL_RUN = Relaxation(n_steps=3000, dt=1.3, damping=0.03)


@dataclass(frozen=True)
class SpringSettings:
    """How one stiffness per spring is fitted. The defaults serve every image.

    Attributes:
        nodes: (ny, nx) of the mesh.
        n_iterations: gradient steps.
        learning_rate: of Adam at the start, on the variables of `StiffnessMap`; it falls along a cosine to a twentieth.
        momentum: of Adam.
        k_min, k_max: of the slides' law that the fit starts from [N/m]; only their ratio matters.
        sigma: width of the law's Gaussian, in distances between nodes.
        weight: share of the least-squares rule in the loss.
        membrane: stiffness of the springs along z over that of all pixels' springs that a node has on average. A node at a hole,
            held by few pixels at the far ends of its triangles, takes up their noise times up to 1 / sqrt(4 membrane pixels per node):
            raise it, to 1e-3 or 1e-2, where data are noisy and full of holes.
        relaxation: the rollout of each iteration.
    """

    nodes: tuple[int, int] = (41, 41)
    n_iterations: int = 700
    learning_rate: float = 0.15
    momentum: float = 0.95
    k_min: float = 1.0
    k_max: float = 30.0
    sigma: float = 0.25
    weight: float = 0.9
    membrane: float = MEMBRANE
    relaxation: Relaxation = Relaxation()  # noqa: RUF009 (frozen, holds no array)


@dataclass(frozen=True)
class Reconstructed:
    """What `fit_springs` returns.

    Attributes:
        scene: image and lattice.
        uniform: errors of the bilinear spline on the regular grid.
        law, fitted: surfaces of the slides' law before the fit, and of the fitted springs, both at rest.
        law_stiffness, stiffness: (E,) [N/m] before and after.
        carried: the fitted mesh, to go on from.
        error: how surfaces over the scene are measured.
        fit: history, status and reason of the fit.
        status: of the last relaxation.
    """

    scene: Reconstruction
    uniform: Errors
    law: Surface
    fitted: Surface
    law_stiffness: Any
    stiffness: Any
    carried: Carried
    fit: Fit
    status: Status
    error: SurfaceError

    def error_bars(self, noise: float) -> np.ndarray:
        """Standard deviation of the best heights of the fitted mesh, given that of the data's noise; see `posterior.py`.

        Exact for independent Gaussian noise on this mesh. What the mesh cannot show, being piecewise linear, is not in it. Over a hole it
        grows with the distance from the data, as far as the weak springs along z allow.

        Args:
            noise: standard deviation of a pixel of weight 1, in the image's unit; one of weight w has noise / sqrt(w).

        Returns:
            (ny, nx), in the image's unit.

        Raises:
            ValueError: a noise that is not positive; a mesh whose rows have more than 400 nodes.
        """
        positive("noise", noise, "It is a standard deviation.")
        n_columns = self.fitted.x.shape[1]
        if n_columns > LONGEST_ROW:
            raise ValueError(f"the mesh has rows of {n_columns} nodes; error bars are made for at most {LONGEST_ROW}. Fit fewer columns.")
        return noise * np.sqrt(np.asarray(_variance(self.error, self._final)))

    def surface_of(self, image: Image) -> Surface:
        """Another image of the same pixels on the fitted mesh: a colour, a band, another time. Only the heights are its own.

        Args:
            image: of the shape, spacing and origin of the one that the mesh was fitted to, in any unit; weights may differ.

        Returns:
            The mesh with the heights and errors of that image.

        Raises:
            ValueError: an image of other pixels.
        """
        own, ours = (np.array([*i.shape, *i.spacing, *i.origin]) for i in (image, self.scene.image))
        if not (own == ours).all():
            raise ValueError(f"image has (ny, nx), spacing and origin {own}, but the mesh was fitted to one of {ours}. Cut it to the same.")
        nodes = self.fitted.x.shape[0], self.fitted.x.shape[1]
        error = SurfaceError(Reconstruction(image, nodes), self.error.weight, self.error.membrane)
        start = eqx.tree_at(lambda c: c.z, self._final, error.scene.image.sample(self._final.x, self._final.y))
        return measure(error, start, diagonals=False)

    @property
    def _final(self) -> Carried:
        """The fitted mesh, its cells cut as it was measured."""
        return eqx.tree_at(lambda c: c.flip, self.carried, jnp.asarray(self.fitted.flip))


def prepare_springs(image: Image, settings: SpringSettings) -> tuple[SpringLoss, Carried]:
    """The loss, and what its first evaluation starts from: the mesh of the slides' law. `loss.springs.zero()` are its variables."""
    scene = Reconstruction(image, settings.nodes)
    rule = scene.law(settings.k_min, settings.k_max, settings.sigma * scene.spacing)
    stiffness, mesh = adapt(scene, rule)
    loss = SpringLoss(
        SurfaceError(scene, settings.weight, settings.membrane), StiffnessMap.around(scene.net, stiffness), settings.relaxation
    )
    return loss, begin(scene, stiffness, mesh.position)


def fit_springs(
    image: Image,
    settings: SpringSettings | None = None,
    on_iteration: Callable[[Iteration], bool | None] | None = None,
    checkpoint: Checkpoint | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Recover an image with a spring mesh whose stiffnesses are fitted through the rollout.

    Args:
        image: the data; node positions are in the unit of its spacing.
        settings: see `SpringSettings`.
        on_iteration: called after each evaluation, as in `fit`.
        checkpoint: where and how often to save, as in `fit`.
        resume: go on from the checkpoint.
        progress: shows a bar.

    Returns:
        Meshes before and after, errors under both rules, stiffnesses (E,) [N/m], and the fit.

    Raises:
        ValueError: an image or a mesh too small for a surface.
    """
    settings = SpringSettings() if settings is None else settings
    loss, carried = prepare_springs(image, settings)
    start = loss.springs.zero()
    if checkpoint is not None:
        checkpoint = dataclasses.replace(checkpoint, note=f"{checkpoint.note}, start {_digest(loss.springs.log_law)}")
    law, _ = settle(loss, start, carried)
    optimiser = Adam(settings.learning_rate, settings.momentum, decay_over=settings.n_iterations)
    found = fit(loss, start, optimiser, settings.n_iterations, on_iteration, carried, None, None, checkpoint, resume, progress)
    mesh, status = settle(loss, found.parameters, found.best_carried)
    return compare(loss.error, law, mesh, found, status)


def _digest(log_law: Any) -> str:
    """Of the stiffness that the variables are relative to. Its last digits decide into which of many states at rest the law's mesh falls,
    so another machine or version can start elsewhere: there a checkpoint's variables would mean other springs.
    """
    return hashlib.sha256(np.ascontiguousarray(log_law).data).hexdigest()[:16]


def compare(error: SurfaceError, law: Carried, mesh: Carried, found: Fit, status: Status) -> Reconstructed:
    """The result of a fit: the law's mesh and the fitted one, both at rest, measured alike beside the regular grid."""
    uniform, _, _ = uniform_errors(error.scene)
    surfaces = measure(error, law), measure(error, mesh)
    return Reconstructed(error.scene, uniform, *surfaces, law.mass_of, mesh.mass_of, mesh, found, status, error)


def settle(loss: SpringLoss, variables: Any, carried: Carried) -> tuple[Carried, Status]:
    """The mesh of `variables` brought to rest from the one in `carried`."""
    stiffness = loss.springs.stiffness(variables)
    result = _relax(loss.error.scene, stiffness, carried)
    x, y = result.state.position
    return eqx.tree_at(lambda c: (c.x, c.y, c.mass_of), carried, (x, y, stiffness)), result.status


@eqx.filter_jit
def _variance(error: SurfaceError, carried: Carried) -> Any:
    """(ny, nx) diagonal of (N + r L)^-1 for the mesh in `carried`."""
    scene, x, y, flip = error.scene, carried.x, carried.y, carried.flip
    triangle = locate(x, y, flip, scene.grid, carried.triangle).triangle
    moments = Moments.of(scene.image.values.reshape(-1), scene.grid, triangle, x, y, flip)
    return exact_height(moments.normal_equations(x, y, flip), error.ratio)[1]


@eqx.filter_jit
def _relax(scene: Reconstruction, stiffness: Any, carried: Carried) -> Any:
    return scene.relax(stiffness, scene.at_rest(carried.x, carried.y), FINAL_RUN)


@eqx.filter_jit
def adapt(scene: Reconstruction, rule: Any) -> tuple[Any, State]:
    """(E,) stiffness [N/m] and mesh of a law, brought to rest together in the plane."""
    return scene.adapt(rule, LAW_RUN, LAW_UPDATES)
