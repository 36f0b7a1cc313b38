"""Observed orders of the implicit steppers on a nonlinear net with pins and damping."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

END = 1.0
TIGHT = js.JaxCG(tolerance=1e-12)


@pytest.fixture(scope="module")
def scene():
    """A jittered chain in space, one end pinned and the other sliding, with drag and gravity; and where it is after a second."""
    rng = np.random.default_rng(5)
    net = js.lattice(8)
    points = 0.1 * rng.normal(size=(8, 3))
    points[:, 0] += np.arange(8)
    free = np.ones((8, 3), bool)
    free[0], free[-1, 1:] = False, False
    start = js.State.from_points(net, points, rng.normal(size=(8, 3)))
    system = js.System(net, 1.0, (js.Springs(net, 20.0, 0.9), js.Drag(0.3), js.Gravity([0.0, 0.0, -9.81])), free=free)
    # Runge-Kutta at a step whose error, of order 4, is far below those measured: 1e-9.
    return system, start, js.rollout(system, start, js.RungeKutta4(), END / 4000, 4000).state.points


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stepper", "order", "n"),
    [
        (js.BackwardEuler(TIGHT), 1, 640),
        (js.BackwardEuler(TIGHT, newton=True), 1, 640),
        (js.ImplicitMidpoint(TIGHT), 2, 80),
        (js.BDF2(TIGHT), 2, 80),
    ],
    ids=["BackwardEuler", "BackwardEuler, Newton", "ImplicitMidpoint", "BDF2"],
)
def test_error_falls_as_dt_to_the_order(scene, stepper, order, n):
    """Halving dt divides the distance from a fine Runge-Kutta run by 2**order."""
    system, start, reference = scene
    errors = []
    for steps in (n, 2 * n):
        run = js.rollout(system, start, stepper, END / steps, steps)
        js.raise_for_status(run)
        errors.append(float(jnp.max(jnp.abs(run.state.points - reference))))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)
