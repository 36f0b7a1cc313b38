"""The loss of the main job: how badly the mesh at the end of a rollout recovers the image.

    value = w log rms_best + (1 - w) log rms_sampled

with the two rules for z: `best` is the equilibrium of one data spring per pixel (the least-squares spline of this mesh), `sampled` is
the image under the nodes. A mixture, because a mesh fitted for one rule alone gives away much of the other, and logarithms, because then
neither the image's contrast nor the size of the error sets the scale.

The loss is a pure function `loss(parameters, carried) -> value, (carried, facts)`. What one evaluation leaves for the next is `carried`:
mesh, triangles and heights to start from, none of them differentiated. The gradient is that of the rollout from the carried mesh. It is
exact where no pixel changes its triangle, and the loss is continuous where one does.

The height of the best rule minimises its own error with a little membrane energy. That sum is what enters the loss, so the height's own
derivative is zero there (envelope theorem) and may be stopped; `implicit_height=True` takes it by implicit differentiation all the same.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ...images.sampling import Bilinear
from ...linalg.cg import JaxCG
from ...numerics import stopped
from ...status import Status
from ...vector import Vector
from .pixels import Moments, best_height, membrane_energy
from .raster import locate, locate_uniform
from .scene import Reconstruction, Relaxation
from .stiffness_map import StiffnessMap
from .triangles import Flip, Node, count_folds

# A fit cannot be better than this mean square error, in units of the image's range: a constant image has a finite loss and gradient zero.
_SMALLEST_ERROR = 1e-14

# Springs along z, over all the pixels' springs that a node has on average: some triangles hold no pixel.
MEMBRANE = 1e-4


class Carried(eqx.Module):
    """What one evaluation of the loss leaves for the next.

    Attributes:
        x, y: mesh that the rollout starts from [m].
        z: height that the solver starts from [image range].
        triangle: (P,) triangle of each pixel, where its walk starts.
        flip: which diagonal cuts each cell.
        mass_of: (E,) stiffnesses that give the nodes' fictitious mass [N/m].
        age: evaluations so far.
    """

    x: Node
    y: Node
    z: Node
    triangle: Int[Array, " P"]
    flip: Flip
    mass_of: Float[Array, " E"]
    age: Int[Array, ""]


class Facts(eqx.Module):
    """What is known about a mesh.

    Attributes:
        rms_best, rms_sampled: errors over the pixels, by their weights, under either rule [image range].
        n_folds: triangles folded over.
        n_lost: pixels in no triangle.
        n_walk: steps of the pixels' walk.
        residual: of the height's solve.
        status: of the rollout and of that solve.
    """

    rms_best: Float[Array, ""]
    rms_sampled: Float[Array, ""]
    n_folds: Int[Array, ""]
    n_lost: Int[Array, ""]
    n_walk: Int[Array, ""]
    residual: Float[Array, ""]
    status: Status


class SurfaceError(eqx.Module):
    """Error of the surface over a given mesh, under both rules.

    Attributes:
        scene: image and lattice.
        weight: w of the best rule, in [0, 1].
        membrane: stiffness of the springs along z, over that of all pixels' springs that a node has on average.
        solver: for the height; None stands for `JaxCG(tolerance=1e-4)`, whose error in z enters the loss squared.
        implicit_height: take the height's derivative by implicit differentiation (static).
    """

    scene: Reconstruction
    weight: float = eqx.field(static=True, default=0.9)
    membrane: float = eqx.field(static=True, default=MEMBRANE)
    solver: JaxCG = JaxCG(tolerance=1e-4)
    implicit_height: bool = eqx.field(static=True, default=False)

    def __call__(self, x: Node, y: Node, carried: Carried) -> tuple[Array, tuple[Carried, Facts]]:
        """The loss of the mesh (x, y), what it leaves, and its facts."""
        scene, flip = self.scene, carried.flip
        location = locate(x, y, flip, scene.grid, carried.triangle)
        moments = Moments.of(scene.image.values.reshape(-1), scene.grid, location.triangle, x, y, flip)
        ratio = jnp.asarray(self.ratio, x.dtype)
        at = (x, y) if self.implicit_height else lax.stop_gradient((x, y))
        z, info = best_height(moments.normal_equations(*at, flip), scene.net, ratio, carried.z, self.solver)
        best = mean_error(scene, moments.squared_error(x, y, z, flip))
        tension = ratio * membrane_energy(scene.net, z) / scene.grid.total
        sampled = mean_error(scene, moments.squared_error(x, y, scene.image.surface(Bilinear()).value(x, y), flip))
        value = 0.5 * (self.weight * jnp.log(best + tension) + (1 - self.weight) * jnp.log(sampled))
        left = stopped(Carried(x, y, z, location.triangle, flip, carried.mass_of, carried.age + 1))
        facts = Facts(
            jnp.sqrt(best), jnp.sqrt(sampled), count_folds(x, y, flip), location.n_lost, location.n_steps, info.residual, info.status
        )
        return value, (left, stopped(facts))

    @property
    def ratio(self) -> Array | float:
        """Stiffness of the springs along z over that of a pixel's spring of weight one [pixels]."""
        return self.membrane * self.scene.grid.total / self.scene.net.n_nodes

    def per_cell(self, x: Node, y: Node, z: Node, carried: Carried, flip: Flip) -> tuple[Float[Array, "my mx"], Float[Array, "my mx"]]:
        """Squared error of each cell cut along `flip`, with heights `z` and with sampled heights [image range^2]."""
        location = locate(x, y, flip, self.scene.grid, carried.triangle)
        moments = Moments.of(self.scene.image.values.reshape(-1), self.scene.grid, location.triangle, x, y, flip)
        sampled = self.scene.image.surface(Bilinear()).value(x, y)
        return moments.squared_error(x, y, z, flip).sum(axis=0), moments.squared_error(x, y, sampled, flip).sum(axis=0)


def mean_error(scene: Reconstruction, error: Array) -> Array:
    """Mean over the pixels, by their weights, of errors squared and summed per triangle, floored for its logarithm [image range^2]."""
    return jnp.maximum(jnp.sum(error) / scene.grid.total, _SMALLEST_ERROR)


class SpringLoss(eqx.Module):
    """The loss as a function of one variable per spring, through the rollout. See `StiffnessMap` for the variables.

    Attributes:
        error: of the surface over the mesh that the rollout ends in.
        springs: stiffness from the variables.
        relaxation: the rollout.
        choose_every: evaluations between two choices of the diagonals (static).
    """

    error: SurfaceError
    springs: StiffnessMap
    relaxation: Relaxation = Relaxation()
    choose_every: int = eqx.field(static=True, default=25)

    def __call__(self, variables: Float[Array, " E"], carried: Carried) -> tuple[Array, tuple[Carried, Facts]]:
        """Value, and (what the next evaluation starts from, facts)."""
        scene = self.error.scene
        carried = lax.cond(carried.age % self.choose_every == 0, partial(choose_diagonals, self.error), lambda c: c, carried)
        stiffness = self.springs.stiffness(variables)
        result = scene.relax(stiffness, scene.at_rest(carried.x, carried.y), self.relaxation, carried.mass_of)
        value, (left, facts) = self.error(result.state.position.x, result.state.position.y, carried)
        left = eqx.tree_at(lambda c: c.mass_of, left, stopped(stiffness))
        return value, (left, eqx.tree_at(lambda f: f.status, facts, stopped(result.status.then(facts.status))))


def begin(scene: Reconstruction, stiffness: Float[Array, " E"], mesh: Vector | None = None) -> Carried:
    """The first `Carried`: `mesh`, or the uniform lattice, every cell cut from north-west to south-east."""
    x, y = scene.rest if mesh is None else mesh
    flip = jnp.zeros(tuple(n - 1 for n in scene.net.shape), bool)
    z = scene.image.sample(x, y)
    return Carried(x, y, z, locate_uniform(scene.grid, flip.shape), flip, stiffness, jnp.zeros((), jnp.int32))


def choose_diagonals(error: SurfaceError, carried: Carried) -> Carried:
    """`carried` with each cell cut along the diagonal that has the smaller error on the present mesh, heights held."""

    def cut(flip: Array) -> tuple[Array, Array]:
        return error.per_cell(carried.x, carried.y, carried.z, carried, jnp.broadcast_to(flip, carried.flip.shape))

    # One after the other through one compiled body: half the compilation.
    best, sampled = lax.map(cut, jnp.asarray([False, True]))
    # Scaled by their totals, as their logarithms are in the loss.
    share = error.weight / jnp.maximum(jnp.sum(best[0]), _SMALLEST_ERROR)
    other = (1 - error.weight) / jnp.maximum(jnp.sum(sampled[0]), _SMALLEST_ERROR)
    flip: Bool[Array, "my mx"] = share * (best[0] - best[1]) + other * (sampled[0] - sampled[1]) > 0
    return eqx.tree_at(lambda c: c.flip, carried, flip)
