"""The adaptive mesh on any triangles: borders along polygons, the mesh that rests as it is, the error and its gradient, a fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.cg import JaxCG
from jaxspring.scenes.reconstruction.planar import PlanarLoss, PlanarScene, begin, cotangents
from jaxspring.scenes.reconstruction.scene import Relaxation

HEXAGON = np.array([[5.0, 20.0], [20.0, 3.0], [45.0, 6.0], [55.0, 25.0], [38.0, 43.0], [14.0, 40.0]])


def holed():
    """A hexagon with a four-sided hole: nodes and triangles."""
    net, points = js.cloth.outline(HEXAGON, 4.0)
    points, triangles = points[:, :2], np.asarray(net.triangles)
    middle = points[triangles].mean(axis=1)
    kept = triangles[(np.abs(middle - [30, 23]) > [6, 5]).any(axis=1)]
    used, new = np.unique(kept, return_inverse=True)
    return points[used], new.reshape(-1, 3).astype(np.int32)


@pytest.fixture
def image():
    """A disc with a soft edge; no pixel lies on a side of a triangle, where the error has a kink."""
    y, x = np.mgrid[:48, :60]
    return js.Image(1 / (1 + np.exp(np.hypot(x - 38, y - 22) - 12)), origin=(0.137, 0.211))


def beyond(points, places, sides):
    """Distance of places from the lines through pairs of points."""
    a, b = points[sides[:, 0]], points[sides[:, 1]]
    u = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    d = places - a
    return np.abs(d[:, 0] * u[:, 1] - d[:, 1] * u[:, 0])


@pytest.mark.slow
def test_borders_slide_along_a_polygon_and_its_hole(rng):
    """Random stiffness over two decades: corners stay, other border nodes move along their own side alone, inner ones anywhere."""
    points, triangles = holed()
    net = js.from_triangles(triangles, len(points))
    border = js.reconstruction.SlidingBorder(net, points)
    corners = border.corners
    # Six of the hexagon; the hole's steps.
    for corner in HEXAGON:
        assert (np.linalg.norm(points[corners] - corner, axis=1) < 1e-9).any()
    k = jnp.asarray(np.exp(rng.uniform(-2, 2, net.n_springs)))
    mass = net.layout.flatten(net.incident_sum(net.split(k)))
    system = js.System(net, mass, (js.Springs(net, k, 0.0, axes=(0, 1)), js.Drag(0.1 * mass)), rules=border)
    end = js.rollout(system, js.State.from_points(net, points), js.SymplecticEuler(), dt=1.0, n_steps=300).state
    places, moved = np.asarray(end.points), np.linalg.norm(np.asarray(end.points) - points, axis=1)
    np.testing.assert_array_equal(places[corners], points[corners])
    sliding = np.setdiff1d(np.flatnonzero(border.on_border), corners)
    assert moved[sliding].max() > 0.3
    u = np.asarray(border.direction)[sliding]
    across = (places - points)[sliding]
    assert np.abs(across[:, 0] * u[:, 1] - across[:, 1] * u[:, 0]).max() < 1e-12
    speed = np.asarray(end.velocities)[sliding]
    assert np.abs(speed[:, 0] * u[:, 1] - speed[:, 1] * u[:, 0]).max() < 1e-12
    assert moved[~border.on_border].max() > 0.3


@pytest.mark.slow
def test_a_mesh_of_cotangents_rests_as_it_is(image):
    """Nothing but the image moves the first mesh, however irregular; right angles get a little stiffness."""
    net, points = js.cloth.rectangle(58.0, 46.0, 6.0)
    points = points + 0.5
    points = points[:, :2] + 0.5 * np.sin(points[:, 1::-1]) * (np.abs(points[:, :2] - [29.5, 23.5]) < [28.9, 22.9])
    scene = PlanarScene(image, points, net.triangles)
    end = jax.jit(lambda: scene.relax(scene.shape, scene.rest, Relaxation(500, 1.0, 0.1)).state.points)()
    np.testing.assert_allclose(end, points, atol=1e-9)
    square = cotangents(
        np.array([[0.0, 0], [1, 0], [0, 1], [1, 1]]), np.array([[0, 1, 2], [1, 3, 2]]), np.array([[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]])
    )
    np.testing.assert_allclose(square, [0.5, 0.5, 0.015, 0.5, 0.5])


@pytest.mark.slow
def test_error_and_gradient_of_a_fit(image, rng):
    """The loss is that of every pixel, its gradient that of central differences; a fit lowers the error, without folds."""
    net, points = js.cloth.outline(HEXAGON, 4.0)  # convex: there nothing folds
    points, triangles = points[:, :2], net.triangles
    scene = PlanarScene(image, points, triangles)
    start = begin(scene, scene.rest)
    loss = PlanarLoss(scene, jnp.log(scene.shape), Relaxation(10, 1.0, 0.1), solver=JaxCG(tolerance=1e-12))
    run = eqx.filter_jit(lambda v: loss(v, start))
    zero = loss.zero()
    step = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), zero)
    value, (left, (error, folds, lost, status)) = run(zero)
    js.raise_for_status(status)
    tin = js.reconstruction.Tin(np.column_stack([left.points, left.z]), np.asarray(scene.corners))
    located = np.isfinite(tin.drawn(image))
    expected = np.sqrt(np.nansum((tin.drawn(image) - np.asarray(scene.image.values)) ** 2) / located.sum())
    assert (~located).sum() > 0
    assert abs(int(lost) - (~located).sum()) <= 3
    assert int(folds) == 0
    assert float(error) == pytest.approx(expected, rel=1e-3)
    slope = (run(jax.tree.map(lambda s: 1e-5 * s, step))[0] - run(jax.tree.map(lambda s: -1e-5 * s, step))[0]) / 2e-5
    gradient = jax.grad(lambda v: loss(v, start)[0])(zero)
    found = sum(float(jnp.vdot(g, s)) for g, s in zip(jax.tree.leaves(gradient), jax.tree.leaves(step), strict=True))
    assert found == pytest.approx(float(slope), rel=1e-4)
    assert np.isfinite(value)
    settings = js.reconstruction.PlanarSettings(n_iterations=40, learning_rate=0.05)
    fitted = js.reconstruction.fit_triangles(image, points, triangles, settings)
    js.raise_for_status(fitted.status)
    before = js.reconstruction.fitted_tin(image, points, triangles).errors(image)
    after = fitted.tin.errors(image)
    assert after.rmse < before.rmse / 1.2
    assert after.folds == int(folds) == 0
    assert abs(after.outside - before.outside) <= 3


def test_refining_by_error_and_by_observation(image):
    """Nodes up to the number asked for, where the edge is; far from it triangles stay."""
    net, points = js.cloth.rectangle(59.0, 47.0, 8.0)
    for observation in (None, js.images.Curvature(), lambda image: jnp.abs(image.values - 0.5) < 0.4):
        found = js.reconstruction.refine_by_error(image, points, net.triangles, 200, observation=observation)
        assert 170 < found.mesh.n_nodes <= 200
        middle = found.points[found.mesh.triangles].mean(axis=1)
        gap = np.abs(np.hypot(middle[:, 0] - 38, middle[:, 1] - 22) - 12)
        assert found.mesh.level[gap < 2].mean() > 1 > found.mesh.level[gap > 12].mean()
        assert found.stiffness.shape == (found.mesh.net.n_springs,)
    with pytest.raises(ValueError, match="already"):
        js.reconstruction.refine_by_error(image, points, net.triangles, 5)
    with pytest.raises(ValueError, match="one number per pixel"):
        js.reconstruction.refine_by_error(image, points, net.triangles, 200, observation=lambda image: np.zeros(3))


def test_triangles_that_are_no_surface_are_refused(image):
    """A side of three triangles, by its nodes."""
    points = np.array([[0.0, 0], [1, 0], [0, 1], [1, 1], [2, 2]])
    with pytest.raises(ValueError, match="more than two triangles"):
        PlanarScene(image, points, [[0, 1, 2], [1, 2, 3], [1, 2, 4]])
    with pytest.raises(ValueError, match="the net has 3 nodes"):
        js.reconstruction.SlidingBorder(js.from_triangles([[0, 1, 2]], 3), np.zeros((2, 2)))
