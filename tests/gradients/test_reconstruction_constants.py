"""Gradients of the loss with respect to the physical constants of the slides' mesh, through 30 steps, against central differences."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.images.image import Image
from jaxspring.linalg.cg import JaxCG
from jaxspring.scenes.reconstruction.constants import NAMES, ConstantsLoss, ConstantsSettings, adapted, fit_constants, prepare_constants


def smooth_picture(rng, shape=(37, 45)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.sum([np.sin(a * x + b * y + c) for a, b, c in rng.uniform(-0.4, 0.4, (6, 3))], axis=0)


@pytest.fixture
def case(rng):
    loss, carried = prepare_constants(Image(smooth_picture(rng)), ConstantsSettings(nodes=(6, 7)))
    wide = loss.others.replaced({"sigma": 2.0 * loss.others.sigma})
    return ConstantsLoss(loss.scene, wide, loss.radius, n_steps=30, solver=JaxCG(tolerance=1e-13)), carried


@pytest.mark.slow
def test_gradient_of_every_constant(case):
    """Each of the six agrees with central differences to 1e-6, where no pixel changes its triangle."""
    loss, carried = case
    values = {name: getattr(loss.others, name) for name in NAMES}
    value_and_grad = eqx.filter_jit(eqx.filter_value_and_grad(loss, has_aux=True))
    (value, (left, facts)), gradient = value_and_grad(values, carried)
    assert bool(facts.status.is_ok)
    for name in NAMES:
        # Of fourth order: the loss bends so quickly with sigma that the error of two points, h^2, would be as large as the bound.
        # Which pixels lie near a border hangs on rounding: the step is the largest that no pixel crosses one in.
        for h in float(values[name]) * np.array([1e-5, 4e-6, 1.6e-6]):
            moved = [value_and_grad({**values, name: values[name] + steps * h}, carried)[0] for steps in (-2, -1, 1, 2)]
            if all(np.array_equal(after.triangle, left.triangle) for _, (after, _) in moved):
                break
        else:
            pytest.fail(f"a pixel changes its triangle within 3.2e-6 of {name}")
        found = [float(value) for value, _ in moved]
        differences = (8 * (found[2] - found[1]) - (found[3] - found[0])) / (12 * h)
        scale = max(abs(float(gradient[name])), 1e-6 * abs(float(value)) / float(values[name]))
        assert abs(float(gradient[name]) - differences) < 1e-6 * scale, name
        assert float(gradient[name]) != 0


@pytest.mark.slow
def test_fit_of_constants_lowers_the_loss(rng):
    """A few iterations on all six lower the loss; what was not named stays."""
    image = Image(smooth_picture(rng))
    settings = ConstantsSettings(nodes=(6, 7), n_iterations=5)
    found = fit_constants(image, ("k_max", "sigma", "k_data", "drag", "k_pixel"), settings)
    losses = found.fit.history.loss
    assert losses[-1] < losses[0]
    assert set(found.fit.parameters) == {"k_max", "sigma", "k_data", "drag", "k_pixel"}
    assert found.fitted.folds == 0
    assert found.fitted.rmse.best < found.uniform.best * 1.5


def test_unknown_constant_is_refused(rng):
    """A misspelt name is an error that lists the right ones."""
    with pytest.raises(ValueError, match="k_data"):
        fit_constants(Image(rng.random((8, 9))), ("k_dta",))


@pytest.mark.slow
def test_equal_bounds_leave_the_mesh_alone(case):
    """With k_min = k_max the law has nothing to follow: the lattice stays uniform."""
    loss, _ = case
    same = loss.others.replaced({"k_max": jnp.asarray(1.0)})
    mesh = adapted(loss.scene, same)
    np.testing.assert_allclose(mesh.x, loss.scene.rest.x, atol=1e-9)
