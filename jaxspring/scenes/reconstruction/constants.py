"""The physical constants of the slides' mesh, fitted through the rollout: k_min, k_max, sigma, k_data, drag; and k_pixel.

The mesh moves in space. In the plane its stiffness follows the image under the nodes; along z springs of stiffness `K_HEIGHT` smooth and
data springs of constant k_data pull each node to the image. The loss joins two errors over all pixels:

    value = w log rms_pixel + (1 - w) log rms_data

The data error is that of the heights at the end of the rollout. The pixel error is that of the heights at which one spring of constant
k_pixel per pixel balances the springs along z. Those minimise an energy, not this loss, so their derivative is taken implicitly and never
stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ...images.image import Image
from ...inverse.checkpoint import Checkpoint
from ...inverse.fit import Iteration, fit
from ...inverse.optimisers import Adam
from ...inverse.transforms import Positive
from ...linalg.cg import JaxCG
from ...numerics import stopped
from ...progress import Progress
from ...rollouts import rollout
from ...state import State
from ...steppers.explicit import SymplecticEuler
from ...vector import Vector
from .fitting import Reconstructed, adapt, compare
from .loss import Carried, Facts, SurfaceError, begin, mean_error
from .pixels import Moments, best_height
from .raster import locate
from .scene import Reconstruction
from .triangles import count_folds

NAMES = ("k_min", "k_max", "sigma", "k_data", "drag", "k_pixel")
# Springs along z [N/m], beside k_min = 1.
K_HEIGHT = 0.05
# Mass over the sum of the stiffnesses: room for a stiffness that grows during the rollout, and from one iteration to the next.
HEAVIER = 1.5
# Rollouts before the first iteration, in which nothing is fitted.
SETTLING_RUNS = 5


class Constants(eqx.Module):
    """Constants of the mesh.

    Attributes:
        k_min, k_max: bounds of the stiffness in the plane [N/m].
        sigma: width of the Gaussian that smooths the image before its gradient is observed [m].
        k_data: of the data spring at each node [N/m].
        drag: gamma / m [1/s].
        k_pixel: of the data spring at each pixel [N/m].
    """

    k_min: Array
    k_max: Array
    sigma: Array
    k_data: Array
    drag: Array
    k_pixel: Array

    @staticmethod
    def usual(scene: Reconstruction) -> Constants:
        """A start that serves every image: the law's of the fit of every spring, and data springs that outweigh the mesh's."""
        dtype = scene.image.dtype
        per_node = scene.grid.total / scene.net.n_nodes
        numbers = (1.0, 30.0, 0.25 * scene.spacing, 1.0, 0.15, 1 / per_node)
        return Constants(*(jnp.asarray(number, dtype) for number in numbers))

    def replaced(self, values: Mapping[str, Array]) -> Constants:
        """The same with some constants replaced; differentiable in them."""
        return Constants(*(jnp.asarray(values.get(name, getattr(self, name)), self.k_min.dtype) for name in NAMES))


class ConstantsLoss(eqx.Module):
    """The loss as a function of some of the constants, by name: `loss({"k_max": ...}, carried) -> value, (carried, facts)`.

    Attributes:
        scene: image and lattice.
        others: values of the constants that are not passed.
        radius: half width of the Gaussian in pixels, for the largest sigma that can occur (static).
        n_steps, dt: the rollout from the carried mesh (static).
        weight: share of the pixels' springs (static).
        solver: for their heights.
    """

    scene: Reconstruction
    others: Constants
    radius: int = eqx.field(static=True)
    n_steps: int = eqx.field(static=True, default=100)
    dt: float = eqx.field(static=True, default=1.0)
    weight: float = eqx.field(static=True, default=0.5)
    solver: JaxCG = JaxCG()

    def __call__(self, values: Mapping[str, Array], carried: Carried) -> tuple[Array, tuple[Carried, Facts]]:
        """Value, and (what the next evaluation starts from, facts)."""
        scene, flip, constants = self.scene, carried.flip, self.others.replaced(values)
        rule = scene.law(constants.k_min, constants.k_max, constants.sigma, self.radius)
        mass = HEAVIER * scene.net.incident_sum(scene.net.split(carried.mass_of))
        k_height = jnp.asarray(K_HEIGHT, mass.dtype)
        system = scene.adaptive_system(rule, k_height, constants.k_data, constants.drag * mass, mass)
        position = Vector((carried.x, carried.y, carried.z))
        start = State(jnp.zeros((), mass.dtype), position, Vector.zeros_like(position), scene.net.layout)
        result = rollout(system, start, SymplecticEuler(), dt=self.dt, n_steps=self.n_steps)
        x, y, z = result.state.position
        location = locate(x, y, flip, scene.grid, carried.triangle)
        moments = Moments.of(scene.image.values.reshape(-1), scene.grid, location.triangle, x, y, flip)
        equations = moments.normal_equations(x, y, flip)
        height, info = best_height(equations, scene.net, k_height / constants.k_pixel, lax.stop_gradient(z), self.solver)
        errors = [mean_error(scene, moments.squared_error(x, y, a, flip)) for a in (height, z)]
        value = 0.5 * (self.weight * jnp.log(errors[0]) + (1 - self.weight) * jnp.log(errors[1]))
        stiffness = scene.net.flatten(rule.stiffness(scene.net, result.state))
        left = Carried(x, y, z, location.triangle, flip, stiffness, carried.age + 1)
        facts = Facts(
            jnp.sqrt(errors[0]),
            jnp.sqrt(errors[1]),
            count_folds(x, y, flip),
            location.n_lost,
            location.n_steps,
            info.residual,
            result.status.then(info.status),
        )
        return value, (stopped(left), stopped(facts))


@dataclass(frozen=True)
class ConstantsSettings:
    """How constants are fitted.

    Attributes:
        nodes: (ny, nx) of the mesh.
        n_iterations: gradient steps.
        learning_rate: of Adam, on the logarithms; it falls along a cosine to a twentieth.
        largest_sigma: the Gaussian is cut for a sigma of so many times the start's; beyond, the fit ends with NONFINITE.
    """

    nodes: tuple[int, int] = (41, 41)
    n_iterations: int = 100
    learning_rate: float = 0.05
    largest_sigma: float = 4.0


def prepare_constants(image: Image, settings: ConstantsSettings) -> tuple[ConstantsLoss, Carried]:
    """The loss with the usual constants, and what its first evaluation starts from: the law's mesh, its heights settled as well.

    Else the mesh would still be moving by itself in the first iterations, and the loss with it.
    """
    scene = Reconstruction(image, settings.nodes)
    usual = Constants.usual(scene)
    loss = ConstantsLoss(scene, usual, scene.smoothing_radius(settings.largest_sigma * float(usual.sigma)))
    carried, settle = adapted(scene, usual), eqx.filter_jit(loss)
    for _ in range(SETTLING_RUNS):
        _, (carried, _) = settle({}, carried)
    return loss, carried


def fit_constants(
    image: Image,
    names: Sequence[str],
    settings: ConstantsSettings | None = None,
    on_iteration: Callable[[Iteration], bool | None] | None = None,
    checkpoint: Checkpoint | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> Reconstructed:
    """Fit some of `NAMES` through the rollout, each kept positive; `result.fit.parameters` has them by name.

    The law before and after is measured at rest, under the same two rules as `fit_springs`.

    Args:
        image: the data.
        names: constants to be fitted.
        settings: see `ConstantsSettings`.
        on_iteration: called after each evaluation, as in `fit`.
        checkpoint: where and how often to save, as in `fit`.
        resume: go on from the checkpoint.
        progress: shows a bar.

    Returns:
        Meshes of the law before and after, errors under both rules, stiffnesses (E,) [N/m], and the fit.

    Raises:
        ValueError: a name that is not in `NAMES`, or none.
    """
    unknown = [name for name in names if name not in NAMES]
    if unknown or not names:
        raise ValueError(f"names = {tuple(names)}; expected some of {', '.join(NAMES)}.")
    settings = ConstantsSettings() if settings is None else settings
    loss, carried = prepare_constants(image, settings)
    start = {name: getattr(loss.others, name) for name in names}
    adam = Adam(settings.learning_rate, decay_over=settings.n_iterations)
    found = fit(loss, start, adam, settings.n_iterations, on_iteration, carried, Positive(), None, checkpoint, resume, progress)
    law, mesh = (adapted(loss.scene, constants) for constants in (loss.others, loss.others.replaced(found.parameters)))
    return compare(SurfaceError(loss.scene), law, mesh, found, found.status)


def adapted(scene: Reconstruction, constants: Constants) -> Carried:
    """The mesh of the law with these constants, brought to rest in the plane."""
    rule = scene.law(constants.k_min, constants.k_max, constants.sigma)
    stiffness, state = adapt(scene, rule)
    return begin(scene, stiffness, state.position)
