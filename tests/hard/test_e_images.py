"""Hard cases E: images. (Those that need a force are tested with the forces.)"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.images import (
    Bilinear,
    Combined,
    CubicSpline,
    Curvature,
    GradientMagnitude,
    Image,
    adaptation,
    gradient_magnitude,
    image_from_array,
)

METHODS = [Bilinear(), CubicSpline()]


@pytest.mark.parametrize("method", METHODS, ids=repr)
@pytest.mark.parametrize("row", [-0.5, -1.5, 10.0 + 3])
def test_e1_outside_is_clamped(rng, method, row):
    """Outside, the value is the border's and the slope across the border is exactly 0; the point is counted as outside."""
    image = Image(rng.random((10, 8)))
    value, _, slope = image.sample_with_gradient(3.0, row, method)
    assert value == pytest.approx(float(image.values[0 if row < 0 else -1, 3]), abs=1e-14)
    assert slope == 0
    assert jax.grad(lambda y: image.sample(3.0, y, method))(row) == 0
    assert image.outside(3.0, row)
    turned = Image(image.values.T)
    turned_value, turned_slope, _ = turned.sample_with_gradient(row, 3.0, method)
    assert turned_value == pytest.approx(float(value), abs=1e-14)
    assert turned_slope == 0
    assert turned.outside(row, 3.0)


def test_e1_the_border_itself_is_inside(rng):
    """A node that slides along the border is not outside, and its slope is that of the cell beside it, not half of it."""
    image = Image(rng.random((10, 8)))
    x, y = jnp.array([0.0, 7.0, 3.0, 3.0]), jnp.array([4.0, 4.0, 0.0, 9.0])
    assert not image.outside(x, y).any()
    _, dx, dy = image.sample_with_gradient(x, y)
    v = image.values
    np.testing.assert_allclose(dx[:2], [v[4, 1] - v[4, 0], v[4, 7] - v[4, 6]], atol=1e-15)
    np.testing.assert_allclose(dy[2:], [v[1, 3] - v[0, 3], v[9, 3] - v[8, 3]], atol=1e-15)
    np.testing.assert_array_equal(jax.grad(lambda x: image.sample(x, y).sum())(x)[:2], dx[:2])


def test_e2_constant_image(dtype):
    """Nothing to see: adaptation is 0 everywhere, and every derivative is finite."""
    observation = Combined((GradientMagnitude(), Curvature()), (1.0, 1.0))

    def loss(image, sigma):
        seen = adaptation(image, sigma, observation, radius=6).values
        return jnp.sum(seen), seen

    image = Image(np.full((9, 9), 7.0, dtype))
    gradient, seen = jax.jit(jax.grad(loss, argnums=(0, 1), has_aux=True))(image, jnp.asarray(1.5, dtype))
    np.testing.assert_array_equal(seen, 0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    value, dx, dy = image.sample_with_gradient(jnp.asarray(3.3, dtype), jnp.asarray(4.4, dtype))
    assert (value, dx, dy) == (7, 0, 0)


def test_e2_flat_spot_in_an_image(rng):
    """One pixel with zero gradient: the derivative of the magnitude there is finite (zero), not NaN."""
    pixels = rng.random((7, 7))
    pixels[2:5, 2:5] = 1.0
    gradient = jax.grad(lambda p: gradient_magnitude(Image(p)).sum())(jnp.asarray(pixels))
    assert np.isfinite(gradient).all()


def test_e3_nan_pixel():
    """Refused with its index, or filled on request; untouched it would spoil both neighbouring cells, exact node positions included."""
    pixels = np.ones((20, 20))
    pixels[10, 10] = np.nan
    with pytest.raises(ValueError, match=r"values\[10, 10\] is nan .*1 of 400"):
        Image(pixels)
    assert image_from_array(pixels, fill=3.0).values[10, 10] == 3
    traced = jax.jit(lambda p: Image(p).sample(jnp.array([8.9, 9.0, 9.5, 10.5, 11.0]), 10.0))(pixels)
    np.testing.assert_array_equal(np.isnan(traced), [False, True, True, True, False])


@pytest.mark.parametrize("method", METHODS, ids=repr)
def test_e4_coordinates_that_are_no_place(rng, dtype, method):
    """NaN and infinity give NaN, in value and slopes; 1e12 clamps to the corner."""
    image = Image(rng.random((6, 5)).astype(dtype))
    x = jnp.asarray([np.nan, np.inf, -np.inf, 1e12, -1e12], dtype)
    for values in image.sample_with_gradient(x, jnp.full_like(x, 2.0), method):
        np.testing.assert_array_equal(np.isnan(values), [True, True, True, False, False])
    for values in image.sample_with_gradient(jnp.full_like(x, 2.0), x, method):
        np.testing.assert_array_equal(np.isnan(values), [True, True, True, False, False])
    np.testing.assert_array_equal(np.isnan(image.sample(x, 2.0, method)), [True, True, True, False, False])
    assert image.sample(x, x, method)[3] == pytest.approx(float(image.values[-1, -1]), abs=1e-5)
    assert image.outside(x, x).all()


@pytest.mark.parametrize("name", ["uint8", "int16", "uint16", "int64", "bool"])
def test_e5_whole_numbers_become_floating(name):
    """Half way between 2 and 3 is 2.5, not 3, and the pixels have a gradient."""
    image = Image(np.array([[2, 3], [2, 3]]).astype(name))
    assert image.dtype == jnp.float64
    assert image.sample(0.5, 0.5) == (1.0 if name == "bool" else 2.5)
    np.testing.assert_allclose(jax.grad(lambda image: image.sample(0.5, 0.5))(image).values, 0.25)


def test_e6_odd_shapes():
    """One pixel, one row and one column work; no pixel and three channels are errors that name the shape."""
    assert Image(np.array([[4.0]])).sample(0.3, -2.0) == 4
    assert Image(np.array([[4.0, 6.0]])).sample(0.5, 9.0) == 5
    assert Image(np.array([[4.0], [6.0]])).sample(9.0, 0.5) == 5
    for shape in ((0, 0), (0, 5), (5, 0)):
        with pytest.raises(ValueError, match=rf"shape \({shape[0]}, {shape[1]}\)"):
            Image(np.zeros(shape))
    with pytest.raises(ValueError, match=r"shape \(4, 5, 3\)"):
        Image(np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match=r"shape \(7,\)"):
        Image(np.zeros(7))


def test_e7_x_runs_along_columns():
    """img[y, x] = 10 y + x reads 2 at (x, y) = (2, 0); with the axes swapped it would read 20."""
    y, x = np.indices((4, 5))
    image = Image(10 * y + x)
    assert image.sample(2.0, 0.0) == 2
    assert image.sample_with_gradient(2.0, 1.0) == (12, 1, 10)


def test_e8_slope_at_a_kink():
    """On the kink of |r - 4| bilinear takes the right-hand slope, +1; the spline's slope there is continuous, 0 by symmetry."""
    image = Image(np.abs(np.arange(9.0) - 4)[:, None] * np.ones(3))
    assert image.sample_with_gradient(1.0, 4.0)[2] == 1
    assert jax.grad(lambda y: image.sample(1.0, y))(4.0) == 1
    step = 1e-9
    slopes = [image.sample_with_gradient(1.0, y, CubicSpline())[2] for y in (4.0 - step, 4.0, 4.0 + step)]
    np.testing.assert_allclose(slopes, 0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("observation", [GradientMagnitude(), Curvature()], ids=repr)
def test_e10_harsh_images(rng, dtype, observation):
    """On a one-pixel checkerboard, camera noise and a range of 55,040, adaptation stays within [0, 1] and k within its bounds."""

    @jax.jit
    @functools.partial(jax.value_and_grad, argnums=(0, 1), has_aux=True)
    def adapt(image, sigma):
        seen = adaptation(image, sigma, observation, radius=8).values
        return jnp.sum(seen), seen

    y, x = np.indices((32, 32))
    for pixels in ((x + y) % 2 * 255, rng.integers(0, 256, (32, 32)), rng.integers(0, 2, (32, 32)) * 55040):
        (_, a), gradient = adapt(Image(pixels.astype(dtype)), jnp.asarray(1.0, dtype))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        assert a.min() >= 0
        assert a.max() <= 1
        k_min, k_max = 1, 30
        k = (1 - a) * k_min + a * k_max
        rounding = 4 * k_max * float(jnp.finfo(dtype).eps)
        assert k.min() >= k_min - rounding
        assert k.max() <= k_max + rounding
