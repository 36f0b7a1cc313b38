"""Sampling between pixels, against SciPy, closed forms and central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxspring.images import Bilinear, CubicSpline, Image, Sampling

METHODS = [Bilinear(), CubicSpline()]
TOLERANCE = {"float32": 2e-6, "float64": 1e-13}


@pytest.fixture
def pixels(rng, dtype):
    return rng.random((17, 23)).astype(dtype)


def points(rng, image, n=60, beyond=0.0):
    """Random points over the image, and up to `beyond` pixels outside it."""
    ny, nx = image.shape
    return rng.uniform(-beyond, nx - 1 + beyond, n), rng.uniform(-beyond, ny - 1 + beyond, n)


def central_difference(f, x, step=1e-6):
    return (f(x + step) - f(x - step)) / (2 * step)


def test_bilinear_equals_scipy_inside_and_outside(pixels, rng):
    """Bilinear with clamping is SciPy's order 1 with mode "nearest"."""
    image = Image(pixels)
    x, y = (a.astype(pixels.dtype) for a in points(rng, image, beyond=4.0))
    expected = ndimage.map_coordinates(pixels.astype(float), [y, x], order=1, mode="nearest")
    value = image.sample(x, y)
    assert value.dtype == pixels.dtype
    np.testing.assert_allclose(value, expected, atol=TOLERANCE[pixels.dtype.name])


def test_cubic_spline_equals_scipy_up_to_the_border(pixels, rng):
    """The spline of the mirrored image is SciPy's order 3 with mode "mirror"."""
    image = Image(pixels)
    x, y = (a.astype(pixels.dtype) for a in points(rng, image))
    expected = ndimage.map_coordinates(pixels.astype(float), [y, x], order=3, mode="mirror")
    value = image.sample(x, y, CubicSpline())
    assert value.dtype == pixels.dtype
    np.testing.assert_allclose(value, expected, atol=20 * TOLERANCE[pixels.dtype.name])


def test_cubic_spline_forgets_the_border_rule_inside(rng):
    """Twenty pixels inside, SciPy's mode "nearest" gives the same spline."""
    pixels = rng.random((60, 60))
    x, y = rng.uniform(20, 39, (2, 50))
    expected = ndimage.map_coordinates(pixels, [y, x], order=3, mode="nearest")
    np.testing.assert_allclose(Image(pixels).sample(x, y, CubicSpline()), expected, atol=1e-10)


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_passes_through_every_pixel(pixels, method):
    """At a node the value is the pixel: bitwise for bilinear, to rounding for the spline."""
    y, x = np.indices(pixels.shape)
    value = Image(pixels).sample(x.astype(pixels.dtype), y.astype(pixels.dtype), method)
    tolerance = 0 if isinstance(method, Bilinear) else 20 * TOLERANCE[pixels.dtype.name]
    np.testing.assert_allclose(value, pixels, atol=tolerance)


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_spacing_and_origin_only_rename_the_points(rng, method):
    """An image of spacing s at origin o, read at o + s p, is the unit image read at p; slopes divide by s."""
    pixels = rng.random((9, 12))
    x, y = points(rng, Image(pixels), beyond=2.0)
    plain = Image(pixels).sample_with_gradient(x, y, method)
    scaled = Image(pixels, spacing=(2.0, 0.5), origin=(-3.0, 7.0)).sample_with_gradient(2 * x - 3, y / 2 + 7, method)
    for got, expected in zip(scaled, (plain[0], plain[1] / 2, plain[2] * 2), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-12)


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_slopes_are_the_derivatives_of_the_value(rng, method):
    """The slopes returned, autodiff and central differences agree, inside and outside."""
    image = Image(rng.random((9, 12)), spacing=(0.5, 2.0), origin=(1.0, -1.0))
    x, y = points(rng, image, beyond=3.0)
    x, y = 1 + 0.5 * x, -1 + 2 * y
    surface = image.surface(method)
    value, dx, dy = surface.value_and_gradient(x, y)
    np.testing.assert_array_equal(value, surface.value(x, y))
    ones = jnp.ones_like(x)
    np.testing.assert_allclose(dx, jax.jvp(lambda x: surface.value(x, y), (x,), (ones,))[1], atol=1e-13)
    np.testing.assert_allclose(dy, jax.grad(lambda y: surface.value(x, y).sum())(jnp.asarray(y)), atol=1e-13)
    np.testing.assert_allclose(dx, central_difference(lambda x: surface.value(x, y), x), atol=1e-8)
    np.testing.assert_allclose(dy, central_difference(lambda y: surface.value(x, y), y), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_derivative_with_respect_to_pixels_spacing_and_origin(rng, method):
    """The reverse gradient along a random direction equals the central difference, for every leaf of the image."""
    image = Image(rng.random((7, 8)), spacing=(1.5, 0.8), origin=(0.3, -0.2))
    x, y = points(rng, image, n=30)
    x, y = 1.5 * x + 0.3, 0.8 * y - 0.2
    target = rng.random(30)

    @jax.jit
    def loss(image):
        return jnp.sum((image.sample(x, y, method) - target) ** 2)

    gradient = jax.jit(jax.grad(loss))(image)
    for leaf in (lambda image: image.values, lambda image: image.spacing[0], lambda image: image.origin[1]):
        direction = jnp.asarray(rng.standard_normal(leaf(image).shape))
        along = central_difference(lambda h: loss(eqx.tree_at(leaf, image, leaf(image) + h * direction)), 0.0)  # noqa: B023
        assert jnp.sum(leaf(gradient) * direction) == pytest.approx(float(along), rel=1e-6, abs=1e-8)


def test_second_derivatives_of_the_spline(rng):
    """The Hessian of the spline is symmetric and equals central differences of its slopes."""
    surface = Image(rng.random((9, 9))).surface(CubicSpline())
    hessian = jax.jit(jax.hessian(lambda p: surface.value(p[0], p[1])))(jnp.array([3.4, 5.1]))
    slopes = jax.jit(lambda x: jnp.stack(surface.value_and_gradient(x, 5.1)[1:]))
    np.testing.assert_allclose(hessian[0], central_difference(slopes, 3.4), atol=1e-8)
    assert hessian[0, 1] == pytest.approx(float(hessian[1, 0]), abs=1e-14)


def test_spline_is_smooth_across_pixels_and_border(rng):
    """Slope and curvature of the spline do not jump at a pixel; its slope does not jump where the clamped outside begins."""
    surface = Image(rng.random((9, 9))).surface(CubicSpline())

    @jax.jit
    def slope(x):
        return surface.value_and_gradient(x, 3.3)[1]

    step = 1e-9
    assert slope(4.0 - step) == pytest.approx(float(slope(4.0 + step)), abs=1e-7)
    assert jax.grad(slope)(4.0 - step) == pytest.approx(float(jax.grad(slope)(4.0 + step)), abs=1e-7)
    assert slope(0.0 + step) == pytest.approx(0.0, abs=1e-7)
    assert slope(8.0 - step) == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("method", METHODS, ids=repr)
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (1, 40)])
def test_small_images(rng, method, shape):
    """A constant stays that constant everywhere, and one lone pixel along an axis has no slope there."""
    x, y = rng.uniform(-2, 42, (2, 20))
    value, dx, dy = Image(np.full(shape, 2.5)).sample_with_gradient(x, y, method)
    np.testing.assert_allclose(value, 2.5, atol=1e-14)
    np.testing.assert_allclose(dx, 0, atol=1e-14)
    np.testing.assert_allclose(dy, 0, atol=1e-14)
    _, dx, dy = Image(rng.random(shape)).sample_with_gradient(x, y, method)
    for n, slope in zip(shape, (dy, dx), strict=True):
        assert n > 1 or np.all(np.abs(slope) < 1e-14)


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_jit_and_vmap_over_images_and_points(rng, method):
    """Compiled and batched, the values are those of a loop."""
    stack, (x, y) = rng.random((3, 6, 7)), rng.uniform(0, 5, (2, 3, 10))

    def sample(pixels, x, y):
        return Image(pixels).sample(x, y, method)

    expected = [sample(*scene) for scene in zip(stack, x, y, strict=True)]
    np.testing.assert_allclose(jax.jit(jax.vmap(sample))(stack, x, y), expected, atol=1e-13)


def test_traced_once_for_new_pixels_spacing_and_origin(rng):
    """Nothing but shapes and types is fixed while tracing."""
    n_traces = 0

    @eqx.filter_jit
    def sample(image, x):
        nonlocal n_traces
        n_traces += 1
        return image.sample(x, x)

    for spacing in (1.0, 2, np.float32(0.5), (1.0, 3.0)):
        sample(Image(rng.random((5, 5)), spacing, origin=spacing), jnp.ones(3))
    assert n_traces == 1


def test_gradient_with_respect_to_position_holds_no_scatter(rng):
    """Differentiating positions alone never scatters into the image."""
    image = Image(rng.random((16, 16)))
    x = jnp.linspace(0.0, 15.0, 40)

    def program(f, *arguments):
        return jax.jit(jax.grad(f)).lower(*arguments).as_text()

    assert "scatter" not in program(lambda x: image.sample(x, x).sum(), x)
    assert "scatter" in program(lambda image: image.sample(x, x).sum(), image)


def test_result_has_the_type_of_the_points(rng):
    """A float32 state stays float32 over a float64 image, and Python numbers give the default type."""
    image = Image(rng.random((5, 5)))
    x = jnp.ones(3, jnp.float32)
    assert {a.dtype for a in image.sample_with_gradient(x, x)} == {jnp.dtype("float32")}
    assert image.sample(1, 2).dtype == jnp.float64
    assert image.sample(x, 2.0).shape == (3,)


def test_gradient_keeps_float32_in_64_bit_mode(rng):
    """A float32 image is differentiated in float32 although 64 bits are on."""
    image = Image(rng.random((5, 5)).astype(np.float32), spacing=0.5)
    x = jnp.ones(3, jnp.float32)
    gradient = jax.grad(lambda image: image.sample(x, x, CubicSpline()).sum())(image)
    assert {leaf.dtype for leaf in jax.tree.leaves(gradient)} == {jnp.dtype("float32")}


def test_user_sampling_rule(rng):
    """A rule of one's own needs the three functions only: here the mean of each cell's corners."""

    class CellMean(Sampling):
        def coefficients(self, values):
            return values

        def weights(self, t):
            return jnp.full_like(t, 0.5), jnp.full_like(t, 0.5)

        def slopes(self, t):
            return jnp.zeros_like(t), jnp.zeros_like(t)

    pixels = rng.random((4, 4))
    assert Image(pixels).sample(1.3, 2.6, CellMean()) == pytest.approx(pixels[2:4, 1:3].mean())


def test_as_users_run_it(user_mode, rng):
    """In 32 bits, a float64 array becomes float32 and samples follow."""
    image = Image(rng.random((5, 5)))
    assert image.dtype == jnp.float32
    assert image.sample(np.array([1.5, 2.5]), np.array([0, 1])).dtype == jnp.float32


def test_points_of_two_shapes_are_refused(rng):
    """x and y are one array each, of one shape."""
    with pytest.raises(ValueError, match=r"x has shape \(3,\) and y has shape \(2,\)"):
        Image(rng.random((4, 4))).sample(np.ones(3), np.ones(2))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spacing": 0.0}, "spacing along x is 0.0"),
        ({"spacing": (1.0, -2.0)}, "spacing along y is -2.0"),
        ({"spacing": (1.0, 1.0, 1.0)}, "one number or a pair"),
        ({"spacing": np.nan}, "spacing along x is nan"),
        ({"origin": np.inf}, "origin along x is inf"),
        ({"origin": np.ones((2, 2))}, "one number or a pair"),
    ],
)
def test_bad_geometry_is_refused(arguments, message):
    """Spacing is positive and finite, origin finite, each one number or a pair."""
    with pytest.raises(ValueError, match=message):
        Image(np.ones((3, 3)), **arguments)


@pytest.mark.parametrize("name", ["float16", "complex128", "str"])
def test_types_without_real_numbers_are_refused(name):
    """Half precision, complex numbers and text are a TypeError that names the type."""
    with pytest.raises(TypeError, match="values has dtype"):
        Image(np.ones((3, 3)).astype(name))


def test_foreign_numbers_are_converted():
    """Big-endian, long double and Fortran-ordered pixels become ordinary ones."""
    expected = np.arange(6.0).reshape(2, 3)
    for dtype in (">f8", ">i2", ">f4", np.longdouble):
        np.testing.assert_array_equal(Image(np.asfortranarray(expected.astype(dtype))).values, expected)


def test_too_large_for_the_type_is_refused(user_mode):
    """A pixel that overflows in float32 is named, not turned into infinity."""
    with pytest.raises(ValueError, match=r"values\[1, 0\] is inf in float32"):
        Image(np.array([[1.0], [1e300]]))


def test_built_inside_jit_and_grad(rng):
    """Construction from traced pixels, spacing and origin works; shape and type are still checked."""
    pixels = jnp.asarray(rng.random((4, 4)))
    gradient = jax.jit(jax.grad(lambda p, s: Image(p * 2, spacing=(s, 1.0), origin=s).sample(2.0, 2.0), argnums=(0, 1)))(pixels, 1.0)
    assert gradient[0].sum() == pytest.approx(2.0)
    assert np.isfinite(gradient[1])
    with pytest.raises(ValueError, match=r"shape \(4, 4, 3\)"):
        jax.jit(lambda p: Image(p).sample(0.0, 0.0))(jnp.ones((4, 4, 3)))


def test_with_values_and_normalised(rng):
    """Other pixels keep geometry and type; normalised pixels span [0, 1], a constant image is 0."""
    image = Image((3 + 5 * rng.random((4, 5))).astype(np.float32), spacing=2.0)
    scaled = image.normalised()
    assert (float(scaled.values.min()), float(scaled.values.max())) == (0.0, 1.0)
    assert scaled.dtype == jnp.float32
    assert scaled.spacing == image.spacing
    np.testing.assert_array_equal(Image(np.full((2, 2), 7.0)).normalised().values, 0)
    with pytest.raises(ValueError, match=r"shape \(4, 4\)"):
        image.with_values(jnp.ones((4, 4)))
