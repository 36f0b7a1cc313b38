"""Derivatives of heat by melting point, latent heat, conductivity, capacity and heater power, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

FINE, ITERATION = js.JaxCG(tolerance=1e-13), js.thermal.HeatIteration(tolerance=1e-14)
SCHEMES = [
    (js.thermal.ExplicitHeat(), 0.1),
    (js.thermal.BackwardEulerHeat(FINE, ITERATION), 1.0),
    (js.thermal.CrankNicolsonHeat(FINE, ITERATION), 0.3),
    (js.thermal.SplitHeat(ITERATION), 1.0),
    (js.thermal.SymmetricSplitHeat(ITERATION), 0.3),
]
NET = js.lattice((3, 4))
START = np.array([300.0, 310, 320, 330, 305, 315, 325, 380, 352, 361, 370, 390])
PROBE, HEATER = np.random.default_rng(5).normal(size=24), np.arange(12) == 5
AT = np.array([340.0, 25.0, 1.5, 1.2, 30.0])
QUICK = {"xla_backend_optimization_level": 0}  # programs that run for milliseconds


def loss(scheme, dt):
    """A random sum of end temperatures and enthalpies, of [melting, latent, conductivity, capacity, heater power].

    The long steps along axes are stored: a step that is computed again is compiled again. The other schemes' go by the default.
    """
    adjoint = js.StoreAll() if isinstance(scheme, js.thermal.SplitHeat | js.thermal.SymmetricSplitHeat) else None

    def of(p):
        melting, latent, conductivity, capacity, power = p
        boundaries = (
            js.thermal.FixedTemperature(NET, np.arange(12) == 0, lambda t: 300.0 + t),
            js.thermal.Radiation(NET, np.arange(12) == 11, 0.8, 600.0, 0.05),
        )
        source = power * jnp.asarray(HEATER.reshape(3, 4), p.dtype)
        g = js.thermal.conductances(NET, conductivity, 1.0)
        heat = js.Heat(NET, capacity, g, scheme, boundaries, source, latent=js.thermal.LatentHeat(melting, latent))
        start = js.State.from_points(NET, NET.grid(), temperature=START)
        end = js.rollout(js.System(NET, 1.0, rules=heat), start, js.Still(), dt, 4, adjoint=adjoint)
        return jnp.sum(PROBE * jnp.concatenate([jnp.ravel(end.state.temperature), jnp.ravel(end.state.enthalpy)])), end.status

    return of


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "dt"), SCHEMES, ids=lambda p: type(p).__name__ if isinstance(p, js.thermal.HeatScheme) else "")
def test_reverse_mode_is_the_difference(scheme, dt):
    """Melting point, latent heat, conductivity, capacity, heater power, with nodes that melt, a held one and radiation: to 1e-6."""
    of = loss(scheme, dt)
    gradient, status = jax.jit(jax.grad(of, has_aux=True), compiler_options=QUICK)(jnp.asarray(AT))
    assert int(status.flags) == 0
    steps = 1e-4 * np.diag(AT)
    value = jax.jit(lambda p: of(p)[0], compiler_options=QUICK)
    values = np.array([value(jnp.asarray(p)) for p in AT + np.concatenate([steps, -steps])])
    differences = (values[:5] - values[5:]) / (2 * np.diag(steps))
    np.testing.assert_allclose(gradient, differences, rtol=1e-6, atol=1e-6 * np.abs(differences).max())
    assert np.all(np.abs(differences) > 1e-4)


@pytest.mark.slow
def test_forward_mode_is_reverse_mode():
    """Jacobians both ways agree to 1e-9 through implicit steps with latent heat and radiation."""
    of = loss(*SCHEMES[1])
    direction = jnp.asarray(np.random.default_rng(2).normal(size=5))
    forward = jax.jit(lambda p: jax.jvp(lambda p: of(p)[0], (p,), (direction,))[1])(jnp.asarray(AT))
    reverse = jax.jit(jax.grad(lambda p: of(p)[0]))(jnp.asarray(AT)) @ direction
    assert float(forward) == pytest.approx(float(reverse), rel=1e-9)


@pytest.mark.slow
def test_a_step_that_was_not_found_has_no_gradient():
    """One iteration where more are needed: SOLVER, and NaN, never the derivative of a half-found temperature."""
    of = loss(js.thermal.BackwardEulerHeat(iteration=js.thermal.HeatIteration(max_iter=1)), 1.0)
    gradient, status = jax.grad(of, has_aux=True)(jnp.asarray(AT))
    assert bool(status.has(js.Flag.SOLVER))
    assert np.all(np.isnan(gradient))
