"""Observation functions and adaptation, against NumPy, closed forms of surfaces and central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from jaxspring.images import (
    Combined,
    Curvature,
    GradientMagnitude,
    Image,
    Intensity,
    adaptation,
    gradient_magnitude,
    principal_curvatures,
)
from jaxspring.images.observation import image_gradient


def wavy(ny=14, nx=17):
    """A smooth image without flat spots or umbilics at its pixels."""
    y, x = np.mgrid[:ny, :nx].astype(float)
    return np.sin(0.7 * x + 0.2) + 0.8 * np.cos(0.5 * y + 0.3 * x) + 0.03 * x * y


def test_gradient_equals_numpy(rng, dtype):
    """Central differences, one-sided on the border, are `numpy.gradient` with the pixel's spacing."""
    pixels = rng.random((9, 12)).astype(dtype)
    dx, dy = image_gradient(Image(pixels, spacing=(0.5, 2.0)))
    expected_dy, expected_dx = np.gradient(pixels.astype(float), 2.0, 0.5)
    tolerance = {"float32": 1e-6, "float64": 1e-14}[dtype.name]
    np.testing.assert_allclose(dx, expected_dx, atol=tolerance)
    np.testing.assert_allclose(dy, expected_dy, atol=tolerance)
    assert dx.dtype == dtype


def test_gradient_magnitude_of_a_plane():
    """The plane z = 3 x - 4 y has the magnitude 5 at every pixel, border included."""
    y, x = np.mgrid[:5, :6] * 0.5
    np.testing.assert_allclose(gradient_magnitude(Image(3 * x - 4 * y, spacing=0.5)), 5.0, rtol=1e-13)


@pytest.mark.parametrize(
    ("surface", "expected"),
    [
        (lambda x, y: (x**2 + y**2) / 2, (1.0, 1.0)),
        (lambda x, y: -(x**2) / 2, (0.0, -1.0)),
        (lambda x, y: x * y, (1.0, -1.0)),
        (lambda x, y: x**2 / 2 + 3 * y**2 / 2, (3.0, 1.0)),
    ],
    ids=["bowl", "ridge", "saddle", "valley"],
)
def test_curvatures_of_quadratics_at_the_apex(surface, expected):
    """Second differences are exact on quadratics: where the slope is zero the curvatures are those of the formula."""
    y, x = np.mgrid[-2:3, -2:3] * 0.5
    larger, smaller = principal_curvatures(Image(surface(x, y), spacing=0.5))
    assert (larger[2, 2], smaller[2, 2]) == pytest.approx(expected, abs=1e-12)


def test_curvatures_of_a_cylinder_on_its_slope():
    """Off the apex too, a cylinder of radius 2 lying askew has curvatures 0 and -1/2, with an error of order h^2."""
    errors = []
    for n in (20, 40, 80):
        y, x = np.mgrid[-0.5 : 0.5 : (n + 1) * 1j, 0.2 : 1.2 : (n + 1) * 1j]
        across = 0.8 * x + 0.6 * y
        larger, smaller = principal_curvatures(Image(np.sqrt(4 - across**2), spacing=1 / n))
        same_places = np.s_[n // 5 : -n // 5 : n // 20, n // 5 : -n // 5 : n // 20]
        errors.append([np.abs(larger[same_places]).max(), np.abs(smaller[same_places] + 0.5).max()])
    assert max(errors[-1]) < 1e-3
    np.testing.assert_allclose(np.log2(np.divide(errors[1], errors[2])), 2.0, atol=0.1)


def test_curvature_observation_is_the_larger_absolute_one():
    """max(|kappa_1|, |kappa_2|)."""
    image = Image(wavy())
    larger, smaller = principal_curvatures(image)
    np.testing.assert_allclose(Curvature()(image), np.maximum(np.abs(larger), np.abs(smaller)), atol=1e-14)


def test_adaptation_is_smoothing_then_division_by_the_maximum():
    """A = G_sigma * |grad d|, a / max a, against NumPy and SciPy."""
    pixels = wavy()
    dy, dx = np.gradient(pixels)
    expected = ndimage.gaussian_filter(np.hypot(dx, dy), 1.5, mode="reflect", radius=6)
    np.testing.assert_allclose(adaptation(Image(pixels), 1.5).values, expected / expected.max(), atol=1e-14)


@pytest.mark.parametrize(
    "observation",
    [GradientMagnitude(), Curvature(), Intensity(), lambda image: -image.values],
    ids=["gradient", "curvature", "intensity", "user's own"],
)
def test_adaptation_lies_in_the_unit_interval(rng, dtype, observation):
    """Whatever is observed, a signed quantity or a function of one's own included, the result is an image within [0, 1] that reaches 1."""
    image = Image((rng.standard_normal((9, 10)) - 5).astype(dtype), spacing=2.0, origin=1.0)
    seen = adaptation(image, 2.0, observation)
    assert seen.dtype == dtype
    assert seen.spacing == image.spacing
    assert seen.values.min() >= 0
    assert seen.values.max() == pytest.approx(1.0, abs=1e-6)


def test_combined_is_the_weighted_sum():
    """w1 |grad d| + w2 kappa."""
    image = Image(wavy())
    both = Combined((GradientMagnitude(), Curvature()), (2.0, 0.5))
    np.testing.assert_allclose(both(image), 2 * GradientMagnitude()(image) + 0.5 * Curvature()(image), atol=1e-14)
    with pytest.raises(ValueError, match="2 observations and 1 weights"):
        Combined((GradientMagnitude(), Curvature()), (2.0,))


@pytest.mark.slow
@pytest.mark.parametrize("first", [GradientMagnitude(), Intensity()], ids=repr)
def test_derivatives_of_adaptation(rng, first):
    """With respect to the pixels, sigma and the weights, the reverse gradient along a random direction equals the central difference."""
    weight = rng.standard_normal((14, 17))
    start = (Image(wavy(), spacing=1.3), jnp.asarray(1.7), Combined((first, Curvature()), (0.7, 0.3)))

    @eqx.filter_jit
    def loss(scene):
        image, sigma, observe = scene
        return jnp.sum(weight * adaptation(image, sigma, observe, radius=8).values)

    gradient = eqx.filter_jit(eqx.filter_grad(loss))(start)
    leaves, tree = jax.tree.flatten(start)
    for i, slope in enumerate(jax.tree.leaves(gradient)):
        direction = jnp.asarray(rng.standard_normal(slope.shape))
        ends = [loss(jax.tree.unflatten(tree, [*leaves[:i], leaves[i] + h * direction, *leaves[i + 1 :]])) for h in (1e-6, -1e-6)]
        assert jnp.sum(slope * direction) == pytest.approx(float(ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-6)


def test_jit_and_vmap_of_adaptation(rng):
    """A batch of images gives what each gives alone."""
    stack = rng.random((3, 6, 7))

    def adapt(pixels):
        return adaptation(Image(pixels), 1.0, Curvature(), radius=4).values

    np.testing.assert_allclose(jax.jit(jax.vmap(adapt))(stack), [jax.jit(adapt)(pixels) for pixels in stack], atol=1e-12)
