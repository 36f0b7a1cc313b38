"""Gaussian smoothing, against SciPy, its own symmetry and central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxspring.images import Image, smooth, smoothing_radius


def scipy_smooth(pixels, sigma, radius):
    return ndimage.gaussian_filter(pixels.astype(float), sigma, mode="reflect", radius=radius)


@pytest.mark.parametrize(("shape", "sigma"), [((17, 23), 0.7), ((17, 23), 2.0), ((130, 70), 9.5), ((5, 3), 4.0), ((1, 30), 1.5)])
def test_equals_scipy(rng, dtype, shape, sigma):
    """The same kernel and border rule as `scipy.ndimage.gaussian_filter`, also where the kernel is wider than the image."""
    pixels = rng.random(shape).astype(dtype)
    smoothed = smooth(Image(pixels), sigma).values
    assert smoothed.dtype == dtype
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype.name]
    np.testing.assert_allclose(smoothed, scipy_smooth(pixels, sigma, smoothing_radius(sigma)), atol=tolerance)


def test_sigma_is_a_length(rng):
    """With pixels 2 wide and 0.5 high, sigma 1.5 is 0.75 pixel along x and 3 along y."""
    pixels = rng.random((20, 30))
    smoothed = smooth(Image(pixels, spacing=(2.0, 0.5)), 1.5).values
    np.testing.assert_allclose(smoothed, scipy_smooth(pixels, (3.0, 0.75), 12), atol=1e-14)


def test_keeps_the_mean(rng):
    """Reflection at the outer pixel edges neither gains nor loses grey."""
    pixels = rng.random((20, 30))
    assert smooth(Image(pixels), 3.0).values.mean() == pytest.approx(pixels.mean(), rel=1e-14)


def test_zero_sigma_is_the_identity(rng, dtype):
    """sigma = 0 returns the pixels bitwise, by the concrete and by the traced way, and its derivative is exactly 0."""
    image = Image(rng.random((8, 9)).astype(dtype))
    np.testing.assert_array_equal(smooth(image, 0.0).values, image.values)
    for sigma in (0.0, 1e-30, 1e-6, 0.05):
        value, slope = jax.jvp(lambda s: smooth(image, s, radius=4).values, (jnp.asarray(sigma, dtype),), (jnp.ones((), dtype),))
        np.testing.assert_array_equal(value, image.values)
        np.testing.assert_array_equal(slope, 0)


@pytest.mark.parametrize("sigma", [0.2, 0.5, 1.7])
def test_derivative_with_respect_to_sigma(rng, sigma):
    """Reverse and forward derivative equal the central difference of SciPy's filter."""
    image, weight = Image(rng.random((12, 15))), rng.random((12, 15))

    @jax.jit
    def loss(sigma):
        return jnp.sum(weight * smooth(image, sigma, radius=8).values ** 2)

    def reference(sigma):
        return np.sum(weight * scipy_smooth(np.asarray(image.values), sigma, 8) ** 2)

    expected = (reference(sigma + 1e-5) - reference(sigma - 1e-5)) / 2e-5
    assert jax.grad(loss)(sigma) == pytest.approx(expected, rel=1e-7, abs=1e-8)
    assert jax.jacfwd(loss)(sigma) == pytest.approx(expected, rel=1e-7, abs=1e-8)


def test_is_its_own_transpose_in_the_pixels(rng):
    """<G u, w> = <u, G w>, and the reverse derivative with respect to the pixels is G w."""
    u, w = rng.standard_normal((2, 12, 40))

    def blur(pixels):
        return smooth(Image(pixels), 2.5, radius=10).values

    assert jnp.vdot(blur(u), w) == pytest.approx(float(jnp.vdot(u, blur(w))), rel=1e-12)
    np.testing.assert_allclose(jax.vjp(blur, jnp.asarray(u))[1](jnp.asarray(w))[0], blur(w), atol=1e-14)


def test_jit_and_vmap_over_sigma(rng):
    """A batch of traced sigmas gives what each gives alone."""
    image = Image(rng.random((8, 9)))
    sigmas = jnp.array([0.0, 0.8, 2.0])
    batch = jax.jit(jax.vmap(lambda s: smooth(image, s, radius=8).values))(sigmas)
    np.testing.assert_allclose(batch, [smooth(image, float(s), radius=8).values for s in sigmas], atol=1e-14)


def test_traced_sigma_needs_a_radius(rng):
    """Without a radius the error says so; a traced sigma beyond half the radius gives NaN, never a kernel cut short."""
    image = Image(rng.random((8, 9)))
    with pytest.raises(TypeError, match="Pass radius="):
        jax.jit(lambda s: smooth(image, s).values)(1.0)
    with pytest.raises(TypeError, match="Pass radius="):
        jax.jit(lambda image: smooth(image, 1.0).values)(image)
    blur = jax.jit(lambda s: smooth(image, s, radius=4).values)
    assert np.isfinite(blur(2.0)).all()
    assert np.isnan(blur(2.1)).all()
    assert np.isnan(blur(jnp.nan)).all()


@pytest.mark.parametrize(
    ("sigma", "radius", "error", "message"),
    [
        (-1.0, None, ValueError, "sigma is -1.0"),
        (np.nan, None, ValueError, "sigma is nan"),
        (np.inf, 3, ValueError, "sigma is inf"),
        (2.0, 3, ValueError, "pass radius >= 4"),
        (0.0, -1, ValueError, "radius = -1"),
        (1.0, 4.0, TypeError, "radius must be an int"),
        (1.0, True, TypeError, "radius must be an int"),
    ],
)
def test_bad_arguments_are_refused(sigma, radius, error, message):
    """Each error names the argument and its value."""
    with pytest.raises(error, match=message):
        smooth(Image(np.ones((3, 3))), sigma, radius)
