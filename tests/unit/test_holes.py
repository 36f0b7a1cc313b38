"""Pixels with weights, and holes: nothing is read from a hole, and nothing is fitted to one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.images import Holes, image_from_array
from jaxspring.images.holes import continued
from jaxspring.linalg.cg import JaxCG
from jaxspring.scenes.reconstruction.fitting import _variance
from jaxspring.scenes.reconstruction.loss import SurfaceError, begin
from jaxspring.scenes.reconstruction.raster import draw, locate
from jaxspring.scenes.reconstruction.report import measure, uniform_errors

NODES = (9, 10)
SHAPE = (41, 46)


@pytest.fixture(scope="module")
def holed():
    """A wavy surface whose every third pixel is missing, and a block of four cells, up to the border; and its weights."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    values = np.sin(x / 9) + np.cos(y / 7)
    weights = rng.uniform(0.5, 2.0, SHAPE) * (rng.random(SHAPE) < 2 / 3)
    weights[15:, 30:] = 0
    return values, weights


def scene_of(values, weights):
    scene = js.reconstruction.Reconstruction(js.Image(values, weights=weights), NODES)
    return SurfaceError(scene), begin(scene, jnp.ones(scene.net.n_springs))


@pytest.fixture(scope="module")
def case(holed):
    """The mesh over the holed image, and what is measured of it; NaN stands in the holes."""
    values, weights = holed
    error, carried = scene_of(np.where(weights > 0, values, np.nan), weights)
    return error, carried, measure(error, carried, diagonals=False)


def dense(error, carried):
    """N + r L and b as matrices of NumPy, from the drawn hats of every node, pixel by pixel."""
    scene, n = error.scene, error.scene.net.n_nodes
    triangle = locate(carried.x, carried.y, carried.flip, scene.grid, carried.triangle).triangle
    hats = jax.vmap(lambda z: draw(carried.x, carried.y, z, carried.flip, scene.grid, triangle))(jnp.eye(n).reshape(n, *NODES))
    hats = np.asarray(hats).reshape(n, -1)
    weights = np.ravel(scene.image.weights)
    apart = np.zeros((scene.net.n_springs, n))
    for row, (tail, head) in enumerate(np.asarray(scene.net.edges)):
        apart[row, [tail, head]] = -1, 1
    ratio = 1e-4 * weights.sum() / n
    return (hats * weights) @ hats.T + ratio * apart.T @ apart, hats @ (weights * np.ravel(scene.image.values)), hats, ratio


def test_continuation_keeps_data_and_range_and_is_linear(rng):
    """Under holes stand averages of the data: within their range, affine in them, the same by NumPy and JAX, not read from the holes."""
    for shape in ((13, 20), (1, 7), (5, 1), (1, 1)):
        values, weights = rng.normal(size=shape), (rng.random(shape) < 0.3).astype(float)
        weights[0, 0] = 1
        known = weights > 0
        filled = continued(np.where(known, values, np.nan), weights)
        np.testing.assert_array_equal(filled[known], values[known])
        assert values[known].min() <= filled.min()
        assert filled.max() <= values[known].max()
        np.testing.assert_allclose(continued(3 - 2 * values, weights), 3 - 2 * filled, atol=1e-12)
        np.testing.assert_allclose(continued(jnp.asarray(np.where(known, values, np.nan)), jnp.asarray(weights)), filled, atol=1e-14)


def test_an_image_reads_nothing_from_holes(rng):
    """What stands under a hole changes no bit, the derivative with respect to it is zero, and other values keep the holes."""
    values, weights = rng.random((6, 7)), np.ones((6, 7))
    weights[2:4, 3] = weights[5, 6] = 0
    hole = weights == 0
    images = [js.Image(np.where(hole, what, values), weights=weights) for what in (np.nan, np.inf, -9999.0)]
    for image in images[1:]:
        np.testing.assert_array_equal(image.values, images[0].values)
    assert (images[0].n_holes, js.Image(values).n_holes) == (3, 0)
    square = jax.jit(jax.grad(lambda v: jnp.sum(js.Image(v, weights=weights).normalised().values ** 2)))
    slope = square(jnp.asarray(np.where(hole, np.nan, values)))
    assert np.isfinite(slope).all()
    assert not np.asarray(slope)[hole].any()
    again = images[0].with_values(jnp.asarray(np.where(hole, np.nan, 2 * values)))
    np.testing.assert_allclose(again.values, 2 * images[0].values)
    assert again.filled().weights is None


def test_data_springs_pull_by_the_weight_under_the_node(rng):
    """F = k w(x, y) (d(x, y) - z), w read between pixels as d is; over a hole nothing pulls. Its derivative is that of differences."""
    values, weights = rng.random((6, 7)), rng.uniform(0, 2, (6, 7))
    weights[2:5, 3:6] = 0
    points = np.array([[0.3, 0.4, 0.1], [3.5, 3.5, 9.0], [2.4, 2.7, -1.0], [6.0, 5.0, 2.0]])
    net = js.lattice(4)
    image = js.Image(np.where(weights > 0, values, np.nan), weights=weights)
    system = js.System(net, 1.0, (js.DataSprings(image, 3.0),))

    def pull(z):
        state = js.State.from_points(net, jnp.asarray(points).at[:, 2].set(z))
        return system.bind(state.dtype).forces[0].force(state).z

    z = jnp.asarray(points[:, 2])
    cover, data = (js.Image(a).sample(points[:, 0], points[:, 1]) for a in (weights, np.asarray(image.values)))
    np.testing.assert_allclose(pull(z), 3 * cover * (data - z), rtol=1e-12)
    assert pull(z)[1] == 0
    np.testing.assert_allclose(jnp.diagonal(jax.jacfwd(pull)(z)), -3 * cover, rtol=1e-12)
    state = js.State.from_points(net, points)
    np.testing.assert_allclose(system.bind(state.dtype).forces[0].stiffness_bound(state), 3 * cover, rtol=1e-12)


def test_best_heights_are_the_weighted_least_squares(case):
    """Heights and errors against dense algebra over every pixel; nodes that no datum reaches are named, and have heights."""
    error, carried, found = case
    matrix, b, hats, ratio = dense(error, carried)
    z = np.linalg.solve(matrix, b)
    low, extent = float(error.scene.low), float(error.scene.extent)
    np.testing.assert_allclose(np.ravel(found.z_best), low + extent * z, atol=1e-10)
    weights = np.ravel(error.scene.image.weights)
    residual = extent * (z @ hats - np.ravel(error.scene.image.values))
    assert found.rmse.best == pytest.approx(np.sqrt(np.average(residual**2, weights=weights)), rel=1e-9)
    np.testing.assert_array_equal(np.ravel(found.unreached), (hats**2 * weights).sum(axis=1) < ratio)
    assert 0 < found.unreached.sum() < 30
    assert found.outside == 0


def test_uniform_mesh_is_measured_alike(holed):
    """The spline on the regular grid minimises the same weighted squares; weights of one change nothing but rounding."""
    values, weights = holed
    scene = scene_of(values, weights)[0].scene
    rows, columns = (
        np.maximum(0, 1 - np.abs(np.arange(p)[:, None] * (n - 1) / (p - 1) - np.arange(n))) for n, p in zip(NODES, SHAPE, strict=True)
    )
    hats = np.kron(rows, columns)
    root = np.sqrt(np.ravel(weights))
    truth = float(scene.low) + float(scene.extent) * np.ravel(scene.image.values)
    least = np.linalg.lstsq(root[:, None] * hats, root * truth)[0]
    found = uniform_errors(scene)[0].best
    best = np.sqrt(np.average((hats @ least - truth) ** 2, weights=np.ravel(weights)))
    assert best <= found < 1.001 * best
    whole = [uniform_errors(scene_of(values, w)[0].scene)[0].best for w in (None, np.full(SHAPE, 3.0))]
    assert whole[0] <= whole[1] < 1.001 * whole[0]


@pytest.mark.slow
def test_loss_with_weights_and_its_gradient(case, holed):
    """Weights that are all alike change nothing. With holes the gradient in the nodes is that of differences."""
    values, _ = holed
    value = jax.jit(lambda error, x, y, carried: error(x, y, carried)[0])
    error, carried = SurfaceError(case[0].scene, solver=JaxCG(tolerance=1e-12)), case[1]
    plain, first = scene_of(values, None)
    plain = SurfaceError(plain.scene, solver=error.solver)
    alike = SurfaceError(scene_of(values, np.full(SHAPE, 7.0))[0].scene, solver=error.solver)
    assert value(alike, first.x, first.y, first) == pytest.approx(float(value(plain, first.x, first.y, first)), rel=1e-7)
    shift = jnp.zeros(NODES).at[3, 4].set(1.0).at[5, 6].set(-0.7)
    start = carried.x.at[1:-1, 1:-1].add(0.01)
    slope = jax.jit(jax.grad(lambda t: error(start + t * shift, carried.y, carried)[0]))(0.0)
    h = 1e-5
    difference = (value(error, start + h * shift, carried.y, carried) - value(error, start - h * shift, carried.y, carried)) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-5)
    assert np.isfinite(float(slope))


def test_error_bars_are_the_diagonal_of_the_inverse(case, rng):
    """Against the dense inverse; and against heights of a thousand disturbed problems, pixels and membrane alike."""
    error, carried, _ = case
    matrix, _, hats, ratio = dense(error, carried)
    scene, variance = error.scene, _variance(error, carried)
    np.testing.assert_allclose(np.ravel(variance), np.diag(np.linalg.inv(matrix)), rtol=1e-9)
    noise, weights, n = 0.1, np.ravel(scene.image.weights), 4000
    pixels = hats @ (np.sqrt(weights)[:, None] * rng.normal(size=(weights.size, n)))
    edges = np.asarray(scene.net.edges)
    springs = rng.normal(size=(len(edges), n))
    membrane = np.zeros((scene.net.n_nodes, n))
    np.add.at(membrane, edges[:, 1], springs)
    np.subtract.at(membrane, edges[:, 0], springs)
    drawn = np.linalg.solve(matrix, noise * (pixels + np.sqrt(ratio) * membrane))
    np.testing.assert_allclose(drawn.std(axis=1), noise * np.sqrt(np.ravel(variance)), rtol=0.06)


def test_a_fitted_mesh_serves_other_images(case):
    """Its own image gives its own heights, 5 - 2 times it 5 - 2 times the heights; other pixels are refused. Error bars are in its unit."""
    error, carried, found = case
    nothing = dict.fromkeys(("uniform", "law", "law_stiffness", "stiffness", "fit", "status"))
    fitted = js.reconstruction.Reconstructed(scene=error.scene, fitted=found, carried=carried, error=error, **nothing)
    low, extent = float(error.scene.low), float(error.scene.extent)
    own = error.scene.image.with_values(low + extent * error.scene.image.values)
    np.testing.assert_allclose(fitted.surface_of(own).z_best, found.z_best, atol=1e-10)
    other = fitted.surface_of(own.with_values(5 - 2 * own.values))
    np.testing.assert_allclose(other.z_best, 5 - 2 * found.z_best, atol=1e-10)
    np.testing.assert_allclose(other.rmse, 2 * np.array(found.rmse), rtol=1e-9)
    np.testing.assert_allclose(np.ravel(fitted.error_bars(0.3)), 0.3 * np.sqrt(np.diag(np.linalg.inv(dense(error, carried)[0]))), rtol=1e-8)
    with pytest.raises(ValueError, match="was fitted to one of"):
        fitted.surface_of(js.Image(np.ones((5, 5))))
    with pytest.raises(ValueError, match="noise = 0"):
        fitted.error_bars(0.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda i: js.ImageAttraction(i, 1.0), "a potential must be known everywhere. Pass image.filled"),
        (lambda i: js.DataSprings(i, 1.0, conservative=True), "would fall over a hole"),
        (lambda i: js.contact.HeightField(i), "a ground must be somewhere"),
        (lambda i: js.Image(i.values, weights=np.zeros((3, 3))), "zero everywhere"),
        (lambda i: js.Image(i.values, weights=-np.eye(3)), r"weights\[0, 0\] is -1.0"),
        (lambda i: js.Image(i.values, weights=np.full((3, 3), np.nan)), r"weights\[0, 0\] is nan"),
        (lambda i: js.Image(i.values, weights=np.ones((3, 2))), "one weight per pixel"),
        (lambda i: js.Image(np.full((3, 3), np.nan), weights=np.eye(3)), r"values\[0, 0\] is nan"),
        (lambda i: image_from_array(np.ones((3, 3)), fill=1.0, holes=Holes()), "both given"),
        (lambda i: image_from_array(np.zeros((3, 3)), holes=Holes(nodata=0)), "zero everywhere"),
        (lambda i: image_from_array(np.full((3, 3), np.nan), holes=Holes()), "not finite"),
    ],
)
def test_what_cannot_be_honoured_is_refused(build, message):
    """By name, with what to do."""
    with pytest.raises(ValueError, match=message):
        build(js.Image(np.ones((3, 3)), weights=np.eye(3)))


def test_holes_of_arrays():
    """Numbers, NaN where asked, masks; an image without any carries no weights."""
    pixels = np.array([[1.0, -9999.0, np.nan], [0.0, 5.0, 6.0]], np.float32)
    assert image_from_array(pixels, holes=Holes(nodata=(-9999, 0.0), nan=True)).weights.tolist() == [[1, 0, 0], [0, 1, 1]]
    masked = np.ma.masked_equal(np.array([[1, 2], [3, 4]]), 3)
    assert image_from_array(masked, holes=Holes()).weights.tolist() == [[1, 1], [0, 1]]
    assert image_from_array(np.ones((2, 2)), holes=Holes(nodata=0)).weights is None
    assert js.Image(np.ones((2, 2)), weights=np.array([[True, False], [True, True]])).weights.dtype == np.float64
    with pytest.raises(TypeError, match="nodata holds 'x'"):
        Holes(nodata=("x",))  # pyright: ignore[reportArgumentType]
