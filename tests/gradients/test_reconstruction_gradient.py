"""The gradient of the main job's loss, against finite differences of a reference written in NumPy, pixel by pixel.

The reference shares no code with the library: springs from an edge list, a loop of kicks and drifts, every pixel tried against every
triangle, heights by a dense solve.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.images.image import Image
from jaxspring.linalg.cg import JaxCG
from jaxspring.scenes.reconstruction.loss import SpringLoss, SurfaceError, begin
from jaxspring.scenes.reconstruction.scene import Reconstruction, Relaxation
from jaxspring.scenes.reconstruction.stiffness_map import StiffnessMap

NY, NX = 6, 7
RELAXATION = Relaxation(n_steps=30, dt=1.1, damping=0.2)
WEIGHT, MEMBRANE = 0.7, 1e-3


def smooth_picture(rng, shape=(33, 41)):
    """A few waves: an image with slopes everywhere."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    waves = [np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-0.5, 0.5, (6, 3))]
    picture = np.sum(waves, axis=0)
    return (picture - picture.min()) / np.ptp(picture)


@pytest.fixture
def case(rng):
    scene = Reconstruction(Image(smooth_picture(rng)), (NY, NX))
    law = jnp.asarray(np.exp(rng.uniform(-1, 1, scene.net.n_springs)))
    flip = jnp.asarray(rng.random((NY - 1, NX - 1)) < 0.5)
    # Age 1: the diagonals are not chosen anew in this evaluation.
    carried = eqx.tree_at(lambda c: (c.flip, c.age), begin(scene, law), (flip, jnp.asarray(1, jnp.int32)))
    return scene, StiffnessMap.around(scene.net, law), carried


def loss_of(scene, springs, implicit):
    error = SurfaceError(scene, WEIGHT, MEMBRANE, JaxCG(tolerance=1e-13), implicit)
    return SpringLoss(error, springs, RELAXATION)


def rolled_out(scene, stiffness, carried):
    """Kick and drift on an edge list: the mesh at the end, two (N,) arrays."""
    tail, head = scene.net.edges.T
    masses = np.zeros(NY * NX)
    np.add.at(masses, tail, np.asarray(carried.mass_of))
    np.add.at(masses, head, np.asarray(carried.mass_of))
    row, column = np.divmod(np.arange(NY * NX), NX)
    free = [(column > 0) & (column < NX - 1), (row > 0) & (row < NY - 1)]
    mesh = []
    for position, moves in zip((carried.x, carried.y), free, strict=True):
        x, v = np.ravel(position).astype(float), np.zeros(NY * NX)
        for _ in range(RELAXATION.n_steps):
            pull = stiffness * (x[head] - x[tail])
            force = np.zeros_like(x)
            np.add.at(force, tail, pull)
            np.add.at(force, head, -pull)
            v = v + RELAXATION.dt * moves * (force / masses - RELAXATION.damping * v)
            x = x + RELAXATION.dt * v
        mesh.append(x)
    return mesh


def weights_of_pixels(x, y, flip, shape):
    """(P, N) barycentric weights, every pixel tried against every triangle, and the triangle that each pixel is in."""
    py, px = (a.ravel() for a in np.mgrid[: shape[0], : shape[1]])
    weights, holder = np.zeros((px.size, NY * NX)), np.full(px.size, -1)
    for cell in range((NY - 1) * (NX - 1)):
        i, j = divmod(cell, NX - 1)
        nw, ne, sw, se = i * NX + j, i * NX + j + 1, (i + 1) * NX + j, (i + 1) * NX + j + 1
        for half, nodes in enumerate([(nw, ne, sw), (ne, se, sw)] if flip[i, j] else [(nw, ne, se), (nw, se, sw)]):
            system = np.vstack([x[list(nodes)], y[list(nodes)], np.ones(3)])
            w = np.linalg.solve(system, np.vstack([px, py, np.ones(px.size)])).T
            inside = (w.min(axis=1) > -1e-12) & (holder < 0)
            holder[inside] = 2 * cell + half
            weights[np.ix_(inside, nodes)] = w[inside]
    assert np.all(holder >= 0)
    return weights, holder


def sampled(image, x, y):
    """Bilinear interpolation."""
    j, i = (np.minimum(a.astype(int), n - 2) for a, n in ((x, image.shape[1]), (y, image.shape[0])))
    u, v = x - j, y - i
    return (1 - v) * ((1 - u) * image[i, j] + u * image[i, j + 1]) + v * ((1 - u) * image[i + 1, j] + u * image[i + 1, j + 1])


def reference(scene, springs, carried, variables):
    """Value of the loss, and the triangle of every pixel."""
    image = np.asarray(scene.image.values)
    x, y = rolled_out(scene, np.asarray(springs.stiffness(variables)), carried)
    weights, holder = weights_of_pixels(x, y, np.asarray(carried.flip), image.shape)
    tail, head = scene.net.edges.T
    incidence = np.eye(NY * NX)[head] - np.eye(NY * NX)[tail]
    laplacian = MEMBRANE * image.size / (NY * NX) * incidence.T @ incidence
    z = np.linalg.solve(weights.T @ weights + laplacian, weights.T @ image.ravel())
    best = (np.sum((weights @ z - image.ravel()) ** 2) + z @ laplacian @ z) / image.size
    other = np.mean((weights @ sampled(image, x, y) - image.ravel()) ** 2)
    return 0.5 * (WEIGHT * np.log(best) + (1 - WEIGHT) * np.log(other)), holder


@pytest.mark.slow
@pytest.mark.parametrize("implicit", [False, True], ids=["stopped height", "implicit height"])
def test_gradient_through_the_rollout_is_that_of_every_pixel(case, rng, implicit):
    """Where no pixel changes its triangle, it agrees with central differences of the brute-force loss to 1e-6."""
    scene, springs, carried = case
    loss = loss_of(scene, springs, implicit)
    variables = jnp.asarray(0.1 * rng.standard_normal(scene.net.n_springs))
    (value, _), gradient = jax.jit(jax.value_and_grad(loss, has_aux=True))(variables, carried)
    expected, holder = reference(scene, springs, carried, variables)
    assert float(value) == pytest.approx(expected, abs=1e-9)
    for _ in range(3):
        step = rng.standard_normal(scene.net.n_springs)
        h = 1e-6
        (above, one), (below, other) = (reference(scene, springs, carried, variables + s * h * step) for s in (1, -1))
        assert np.array_equal(one, holder)
        assert np.array_equal(other, holder)
        assert float(gradient @ step) == pytest.approx((above - below) / (2 * h), rel=1e-6)


@pytest.mark.slow
def test_height_may_be_stopped_only_where_it_minimises_the_loss(case, rng):
    """Stopped and implicit heights give one gradient; with a height that minimises something else they would not."""
    scene, springs, carried = case
    variables = jnp.asarray(0.1 * rng.standard_normal(scene.net.n_springs))
    gradients = [jax.jit(jax.grad(loss_of(scene, springs, i), has_aux=True))(variables, carried)[0] for i in (False, True)]
    np.testing.assert_allclose(*gradients, rtol=1e-7, atol=1e-9)
    # The same loss at a height solved with three iterations is not stationary there.
    rough = eqx.tree_at(lambda c: c.z, carried, carried.z + 0.3)
    unsolved = SpringLoss(SurfaceError(scene, WEIGHT, MEMBRANE, JaxCG(max_iter=1), False), springs, RELAXATION)
    wrong = jax.jit(jax.grad(unsolved, has_aux=True))(variables, rough)[0]
    assert np.max(np.abs(wrong - gradients[0])) > 1e-4


@pytest.mark.slow
def test_what_is_carried_has_no_gradient(case):
    """The mesh handed to the next evaluation is a number, not a function of the stiffness; each evaluation ages it by one."""
    scene, springs, carried = case
    loss = loss_of(scene, springs, False)
    step = springs.zero() + 0.1

    @eqx.filter_jit
    def moved(variables):
        return jax.jvp(lambda v: loss(v, carried)[1], (variables,), (step,))

    (left, facts), (tangent, _) = moved(springs.zero())
    assert not np.any(tangent.x)
    assert not np.any(tangent.z)
    assert int(left.age) == 2
    assert int(facts.n_lost) == 0
    assert int(facts.n_folds) == 0
