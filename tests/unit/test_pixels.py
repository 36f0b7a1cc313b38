"""Moments of the pixels, the error they give, and the pixels' springs, against sums over every pixel in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.images.image import Image
from jaxspring.linalg.cg import JaxCG
from jaxspring.scenes.reconstruction.pixels import MIDDLE, Moments, PixelSprings, best_height, membrane_energy
from jaxspring.scenes.reconstruction.raster import PixelGrid, draw, locate, locate_uniform

NODES = (7, 8)


class Case:
    """A distorted mesh over a rough image."""

    def __init__(self, rng, dtype="float64", shape=(61, 75)):
        self.net = js.lattice(NODES)
        self.image = Image(rng.random(shape).astype(dtype))
        self.grid = PixelGrid.of(self.image)
        x, y = (np.array(a) for a in self.grid.uniform_nodes(NODES))
        x[:, 1:-1] += 0.35 * x[0, 1] * rng.uniform(-1, 1, x[:, 1:-1].shape)
        y[1:-1] += 0.35 * y[1, 0] * rng.uniform(-1, 1, y[1:-1].shape)
        self.x, self.y = jnp.asarray(x), jnp.asarray(y)
        self.z = jnp.asarray(rng.random(NODES).astype(dtype))
        self.flip = jnp.asarray(rng.random((NODES[0] - 1, NODES[1] - 1)) < 0.5)
        self.triangle = locate(self.x, self.y, self.flip, self.grid, locate_uniform(self.grid, self.flip.shape)).triangle
        self.values = self.image.values.reshape(-1)
        self.moments = Moments.of(self.values, self.grid, self.triangle, self.x, self.y, self.flip)

    def weights(self):
        """(P, N) barycentric weight of each node at each pixel: how the surface follows the heights."""
        unit = jnp.eye(self.net.n_nodes).reshape(-1, *NODES)
        columns = jax.vmap(lambda z: draw(self.x, self.y, z, self.flip, self.grid, self.triangle).reshape(-1))(unit)
        return np.asarray(columns).T


@pytest.fixture
def case(rng):
    return Case(rng)


def test_error_is_that_of_every_pixel(case):
    """The quadratic in the moments equals the sum of squares over the drawn surface, triangle by triangle."""
    pixels = np.ravel(draw(case.x, case.y, case.z, case.flip, case.grid, case.triangle)) - np.asarray(case.values)
    expected = np.bincount(np.asarray(case.triangle), pixels**2, 2 * case.flip.size)
    found = case.moments.squared_error(case.x, case.y, case.z, case.flip)
    np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-10)
    assert int(jnp.sum(case.moments.count)) == case.grid.n_pixels


def test_single_precision_is_enough(rng):
    """In float32, 500 pixels from the corner, the error is right to 1e-5 of itself."""
    case = Case(rng, "float32", (500, 511))
    drawn = np.asarray(draw(case.x, case.y, case.z, case.flip, case.grid, case.triangle), np.float64)
    expected = np.sum((drawn - np.asarray(case.image.values, np.float64)) ** 2)
    found = case.moments.squared_error(case.x, case.y, case.z, case.flip)
    assert found.dtype == np.float32
    assert float(jnp.sum(found)) == pytest.approx(expected, rel=1e-5)


def test_derivative_of_the_error(case, rng):
    """In x, y and z, with the triangles held, it is that of central differences over every pixel."""
    step = tuple(jnp.asarray(rng.standard_normal(NODES)) for _ in range(3))

    def by_moments(h):
        return jnp.sum(case.moments.squared_error(*(a + h * s for a, s in zip((case.x, case.y, case.z), step, strict=True)), case.flip))

    def by_pixels(h):
        x, y, z = (a + h * s for a, s in zip((case.x, case.y, case.z), step, strict=True))
        return np.sum((np.ravel(draw(x, y, z, case.flip, case.grid, case.triangle)) - np.asarray(case.values)) ** 2)

    assert float(jax.grad(by_moments)(0.0)) == pytest.approx((by_pixels(1e-6) - by_pixels(-1e-6)) / 2e-6, rel=1e-6)


def test_normal_equations_are_sums_over_pixels(case, rng):
    """N = W'W and b = W'(d - middle), with W the barycentric weights of all pixels."""
    weights = case.weights()
    equations = case.moments.normal_equations(case.x, case.y, case.flip)
    z = rng.standard_normal(NODES)
    np.testing.assert_allclose(np.ravel(equations.apply(jnp.asarray(z))), weights.T @ (weights @ z.ravel()), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.ravel(equations.right_side), weights.T @ (np.asarray(case.values) - MIDDLE), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.ravel(equations.diagonal()), np.sum(weights**2, axis=0), rtol=1e-9)


def test_best_height_is_numpys_least_squares(case):
    """Without membrane the height is that of numpy.linalg.lstsq on all pixels."""
    z, info = best_height(
        case.moments.normal_equations(case.x, case.y, case.flip), case.net, jnp.asarray(0.0), case.z, JaxCG(tolerance=1e-13)
    )
    expected, *_ = np.linalg.lstsq(case.weights(), np.asarray(case.values), rcond=None)
    np.testing.assert_allclose(np.ravel(z), expected, rtol=1e-8)
    assert bool(info.status.is_ok)


def test_best_height_is_where_the_pixels_springs_rest(case):
    """At the height (N + r L) z = b the pixels' springs and the mesh's springs along z balance: no force is left."""
    k_height, k_pixel = 0.3, 2.0
    equations = case.moments.normal_equations(case.x, case.y, case.flip)
    z, _ = best_height(equations, case.net, jnp.asarray(k_height / k_pixel), case.z, JaxCG(tolerance=1e-13))
    springs = js.Springs(case.net, k_height, 0.0, axes=(2,))
    system = js.System(case.net, 1.0, (springs, PixelSprings(equations, k_pixel)))
    points = np.stack([np.ravel(a) for a in (case.x, case.y, z)], axis=1)
    force = system.force(js.State.from_points(case.net, points))
    assert float(jnp.max(force.norm())) < 1e-10
    away = js.State.from_points(case.net, points + np.array([0.0, 0.0, 1e-3]))
    assert float(jnp.max(system.force(away).z)) < 0


def test_bound_of_the_pixels_springs_bounds(case):
    """No eigenvalue of k N exceeds its row sums."""
    equations = case.moments.normal_equations(case.x, case.y, case.flip)
    springs = PixelSprings(equations, 2.0)
    state = js.State.from_points(case.net, np.zeros((case.net.n_nodes, 3)))
    largest = np.linalg.eigvalsh(2.0 * case.weights().T @ case.weights()).max()
    assert largest <= float(jnp.max(springs.stiffness_bound(state)))


def test_error_is_stationary_at_the_best_height(case):
    """Error plus membrane has no slope in z there, so the height's own derivative may be stopped."""
    ratio = 0.05
    z, _ = best_height(
        case.moments.normal_equations(case.x, case.y, case.flip), case.net, jnp.asarray(ratio), case.z, JaxCG(tolerance=1e-13)
    )

    def objective(z):
        return jnp.sum(case.moments.squared_error(case.x, case.y, z, case.flip)) + ratio * membrane_energy(case.net, z)

    assert float(jnp.max(jnp.abs(jax.grad(objective)(z)))) < 1e-9
    assert float(jnp.max(jnp.abs(jax.grad(objective)(z + 0.01)))) > 1e-3


@pytest.mark.parametrize("gap", [0.0, 1e-200])
def test_triangle_without_area_or_pixel_is_harmless(case, gap):
    """Two nodes in one place, or almost: error, heights and derivatives stay finite."""
    origin = case.x[3, 4], case.y[3, 4]  # there, so that the gap is not rounded away
    grid = PixelGrid(case.grid.x - origin[0], case.grid.y - origin[1], case.grid.shape)
    x, y = (case.x - origin[0]).at[3, 3].set(gap), (case.y - origin[1]).at[3, 3].set(0.0)
    triangle = locate(x, y, case.flip, grid, case.triangle).triangle

    def error(x, y):
        moments = Moments.of(case.values, grid, triangle, x, y, case.flip)
        z, _ = best_height(moments.normal_equations(x, y, case.flip), case.net, jnp.asarray(1e-3), case.z)
        return jnp.sum(moments.squared_error(x, y, z, case.flip))

    value, gradient = jax.value_and_grad(error, argnums=(0, 1))(x, y)
    assert np.isfinite(value)
    assert all(np.all(np.isfinite(g)) for g in gradient)


def test_negative_spring_is_refused(case):
    """A negative constant is named."""
    with pytest.raises(ValueError, match="stiffness"):
        PixelSprings(case.moments.normal_equations(case.x, case.y, case.flip), -1.0)
