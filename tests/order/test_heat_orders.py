"""How fast heat converges: in dt against SciPy, in space against the half-space and Stefan's front."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.special

import jaxspring as js

FINE, ITERATION = js.JaxCG(tolerance=1e-13), js.thermal.HeatIteration(tolerance=1e-13)
SCHEMES = [
    (js.thermal.ExplicitHeat(), 1),
    (js.thermal.BackwardEulerHeat(FINE, ITERATION), 1),
    (js.thermal.CrankNicolsonHeat(FINE, ITERATION), 2),
    (js.thermal.SplitHeat(ITERATION), 1),
    (js.thermal.SymmetricSplitHeat(ITERATION), 2),
]


@eqx.filter_jit
def after(heat, temperature, dt, n_steps):
    """Temperatures of a body that does not move."""
    start = js.State.from_points(heat.net, heat.net.grid(), temperature=temperature)
    return js.rollout(js.System(heat.net, 1.0, rules=heat), start, js.Still(), dt, n_steps).state


@pytest.mark.slow
@pytest.mark.parametrize(("scheme", "order"), SCHEMES, ids=lambda p: type(p).__name__ if isinstance(p, js.thermal.HeatScheme) else str(p))
def test_error_falls_as_dt_to_the_order(scheme, order):
    """A sheet that convects, radiates, is heated in time and held at a corner: halving dt divides the distance from SciPy by 2**order."""
    net, rng = js.lattice((3, 4)), np.random.default_rng(3)
    c, g = rng.uniform(1, 2, 12), rng.uniform(0.5, 1.5, net.n_springs)
    here, held, t0 = np.arange(12) < 5, np.arange(12) == 11, rng.uniform(300, 900, 12)
    boundaries = (
        js.thermal.FixedTemperature(net, held, lambda t: 500.0 + 100.0 * t),
        js.thermal.Convection(net, here, 2.0, 280.0, 0.3),
        js.thermal.Radiation(net, ~here, 0.9, 400.0, 0.5),
    )

    def source(t):
        return jnp.sin(3 * t) * 50.0 * jnp.asarray(here.reshape(3, 4), float)

    heat = js.Heat(net, c, g, scheme, boundaries, source)

    def rate(t, y):
        y = np.where(held, 500.0 + 100.0 * t, y)
        flux = np.zeros(12)
        for (a, b), k in zip(net.edges, g, strict=True):
            flux[a] += k * (y[b] - y[a])
            flux[b] -= k * (y[b] - y[a])
        flux += here * (0.6 * (280.0 - y) + 50.0 * np.sin(3 * t)) + ~here * 0.9 * 5.670374419e-8 * 0.5 * (400.0**4 - y**4)
        return np.where(held, 100.0, flux / c)

    t0[held] = 500.0
    exact = scipy.integrate.solve_ivp(rate, (0, 0.5), t0, method="DOP853", rtol=1e-12, atol=1e-10).y[:, -1]
    error = [np.abs(np.ravel(after(heat, t0, 0.5 / n, n).temperature) - exact).max() for n in (20, 40)]
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.1)
    assert error[1] < 5.0


@pytest.fixture(scope="module")
def block():
    """A block in space with random material, its temperatures and its dense matrix of rates, C^-1 K [1/s]."""
    net, rng = js.lattice((4, 5, 3)), np.random.default_rng(1)
    c, g, t0 = rng.uniform(1, 2, 60), rng.uniform(0.2, 2, net.n_springs), rng.uniform(300, 400, 60)
    rows = np.zeros((net.n_springs, 60))
    for row, (a, b) in zip(rows, net.edges, strict=True):
        row[a], row[b] = 1, -1
    return net, c, g, t0, rows.T @ np.diag(g) @ rows / c[:, None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scheme", "order"), [(js.thermal.SplitHeat(), 1), (js.thermal.SymmetricSplitHeat(), 2)], ids=lambda p: type(p).__name__
)
def test_axes_in_turn_have_their_order_in_space(block, scheme, order):
    """Against the matrix exponential of a block: halving dt divides the error by 2**order, and heat is kept to rounding."""
    net, c, g, t0, rates = block
    exact, error = scipy.linalg.expm(-rates) @ t0, []
    for n in (16, 32):
        end = after(js.Heat(net, c, g, scheme), t0, jnp.asarray(1 / n), n).temperature
        error.append(np.abs(np.ravel(end) - exact).max())
        assert float(np.sum(c * np.ravel(end))) == pytest.approx(np.sum(c * t0), rel=1e-14)
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [1.0, 1e2, 1e4])
def test_the_symmetric_split_is_stable_in_space(block, dt):
    """The distance from the mean, weighed with the capacities, shrinks in every one of 100 steps of any length."""
    net, c, g, t0, _ = block
    start = js.State.from_points(net, net.grid(), temperature=t0)
    system = js.System(net, 1.0, rules=js.Heat(net, c, g, js.thermal.SymmetricSplitHeat()))
    seen = every_temperature(system, start, jnp.asarray(dt))
    distance = np.sqrt((c * (np.vstack([t0, seen]) - np.sum(c * t0) / np.sum(c)) ** 2).sum(1))
    assert np.all((np.diff(distance) < 0) | (distance[1:] < 1e-9))


@eqx.filter_jit
def every_temperature(system, start, dt):
    """(100, N) temperatures after each of 100 steps."""
    return js.rollout(system, start, js.Still(), dt, 100, save_every=1, observe=lambda state: state.temperatures).saved


@pytest.mark.slow
def test_the_half_space():
    """A half-space whose surface is set to 1: erfc(x / (2 sqrt(a t))) with an error that falls as h^2, half cells, explicit at r = 0.4."""
    error = []
    for n in (20, 40):
        net, h = js.lattice(4 * n + 1), 1 / n
        cells = js.thermal.HalfCells()
        c, g = js.thermal.capacities(net, 1.0, 1.0, h, 1.0, cells), js.thermal.conductances(net, 1.0, h, 1.0, cells)
        surface = js.thermal.FixedTemperature(net, np.arange(4 * n + 1) == 0, 1.0)
        end = after(js.Heat(net, c, g, boundaries=surface), 0.0, 0.4 * h * h, n * n // 2)
        x = np.arange(4 * n + 1) * h
        error.append(np.abs(np.asarray(end.temperature) - scipy.special.erfc(x / (2 * np.sqrt(0.2)))).max())
    assert np.log2(error[0] / error[1]) == pytest.approx(2, abs=0.1)
    assert error[1] < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize(("stefan", "root"), [(0.5, 0.464786), (2.0, 0.800601)])
@pytest.mark.parametrize(
    ("scheme", "times"), [(js.thermal.ExplicitHeat(), 0.4), (js.thermal.BackwardEulerHeat(), 8.0)], ids=["explicit", "backward"]
)
def test_the_front_of_melting(scheme, times, stefan, root):
    """Stefan's front s = 2 lambda sqrt(a t), lambda exp(lambda^2) erf lambda = Ste / sqrt(pi): within 1 % after 80 cells; heat kept."""
    n, cells = 121, js.thermal.HalfCells()
    net = js.lattice(n)
    c, g = js.thermal.capacities(net, 1.0, 1.0, 1.0, 1.0, cells), js.thermal.conductances(net, 1.0, 1.0, 1.0, cells)
    wall = js.thermal.FixedTemperature(net, np.arange(n) == 0, 1.0)
    latent = js.thermal.LatentHeat(0.0, c / stefan)
    n_steps = int((80 / (2 * root)) ** 2 / times)
    heat = js.Heat(net, c, g, scheme, wall, latent=latent)
    end = after(heat, 0.0, times, n_steps)
    front = float(jnp.sum(end.enthalpy)) * stefan  # cells melted, in spacings
    assert front == pytest.approx(2 * root * np.sqrt(n_steps * times), rel=0.01)
    liquid = np.asarray(end.temperature[: int(front) - 1])
    x = np.arange(len(liquid))
    profile = 1 - scipy.special.erf(x / (2 * np.sqrt(n_steps * times))) / scipy.special.erf(root)
    np.testing.assert_allclose(liquid, profile, atol=0.02)
