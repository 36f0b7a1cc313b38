"""Hard cases F1 to F4 and F9: heat at, above and far above the explicit limit, degenerate constants, two time steps."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag

GRID = js.lattice((40, 40))
SPACING, CONDUCTIVITY = 0.1, 2.0


def body(net, scheme, **more):
    """A sheet of unit volumetric heat capacity and thickness, and its heat rule."""
    c = js.thermal.capacities(net, 1.0, 1.0, SPACING)
    return js.Heat(net, c, js.thermal.conductances(net, CONDUCTIVITY, SPACING), scheme, **more)


def go(heat, temperature, dt, n_steps):
    start = js.State.from_points(heat.net, heat.net.grid(SPACING), temperature=temperature)
    return js.rollout(js.System(heat.net, 1.0, rules=heat), start, js.Still(), dt, n_steps), start


def drift(heat, start, end):
    """Relative change of the body's heat."""
    return abs(float(js.thermal.total_heat(heat, end) / js.thermal.total_heat(heat, start)) - 1)


@pytest.mark.slow
def test_f1_explicit_heat_at_its_limit(rng):
    """F1: 40 x 40, 400 steps at dt = h^2 / (4 a): no new extreme, heat kept to 1e-14; at 1.05 of it DT_LIMIT, and it does blow up."""
    heat, limit = body(GRID, js.thermal.ExplicitHeat()), SPACING**2 / (4 * CONDUCTIVITY)
    t = rng.uniform(300, 400, 1600)
    run, start = go(heat, t, limit, 400)
    assert int(run.status.flags) == 0
    assert float(run.info.stable_dt) == pytest.approx(limit, rel=1e-12)
    assert t.min() <= float(run.state.temperature.min()) <= float(run.state.temperature.max()) <= t.max()
    assert drift(heat, start, run.state) <= 1e-14
    with pytest.warns(js.StabilityWarning, match="DT_LIMIT"):
        above, _ = go(heat, t, 1.05 * limit, 400)
    assert float(jnp.max(jnp.abs(above.state.temperature))) > 1e6


def test_f2_a_cosine_for_500_steps():
    """F2: an explicit cosine is multiplied by (1 - lambda dt) in every one of 500 steps, to 3e-15."""
    n, p, dt = 32, 3, 0.4
    mode = np.cos(p * np.pi * (np.arange(n) + 0.5) / n)
    heat = js.Heat(js.lattice(n), 1.0, 1.0)
    run, _ = go(heat, mode, dt, 500)
    factor = 1 - dt * 4 * np.sin(p * np.pi / (2 * n)) ** 2
    np.testing.assert_allclose(run.state.temperature, mode * factor**500, atol=3e-15)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [js.thermal.BackwardEulerHeat(), js.thermal.SplitHeat()], ids=lambda s: type(s).__name__)
def test_f3_steps_of_any_length(scheme, rng):
    """F3: dt = 10, 1e4 and 1e8 times the explicit limit: no new extreme, heat kept to 1e-13, and the mean in the end; a tolerance that
    rounding does not allow is reported, or reached.
    """
    net = js.lattice((12, 13))
    heat = body(net, scheme)
    t = rng.uniform(300, 400, 156)
    for times in (10, 1e4, 1e8):
        run, start = go(heat, t, times * SPACING**2 / (4 * CONDUCTIVITY), 12)
        assert int(run.status.flags) == 0
        end = np.asarray(run.state.temperature)
        assert t.min() - 1e-6 <= end.min() <= end.max() <= t.max() + 1e-6
        assert drift(heat, start, run.state) <= 1e-13
    np.testing.assert_allclose(end, t.mean(), rtol=1e-12)
    if isinstance(scheme, js.thermal.BackwardEulerHeat):
        tight, _ = go(body(net, js.thermal.BackwardEulerHeat(js.JaxCG(tolerance=1e-15))), t, 1e8 * SPACING**2, 1)
        assert bool(tight.status.has(Flag.CG_MAXITER)) or np.ptp(tight.state.temperature) < 1e-6


def test_f4_conductivity_and_capacity_at_their_ends():
    """F4: an infinite conductivity and a capacity of zero are refused, no conductivity insulates, a cut link is cut though infinite."""
    net = js.lattice(4)
    with pytest.raises(ValueError, match=r"conductivity\[2\] = inf"):
        js.thermal.conductances(net, [1.0, 1.0, np.inf, 1.0], 1.0)
    with pytest.raises(ValueError, match=r"conductance\[1\] = inf"):
        js.Heat(net, 1.0, [1.0, np.inf, 1.0])
    with pytest.raises(ValueError, match=r"capacity\[3\] = 0"):
        js.Heat(net, [1.0, 1.0, 1.0, 0.0], 1.0)
    t = np.array([1.0, 2.0, 5.0, 7.0])
    insulated = js.Heat(net, 1.0, js.thermal.conductances(net, [1.0, 1.0, 0.0, 1.0], 1.0))
    np.testing.assert_allclose(go(insulated, t, 0.1, 200)[0].state.temperature, [1.5, 1.5, 5.0, 7.0], atol=1e-6)
    endless = eqx.tree_at(lambda h: h.conductance, js.Heat(net, 1.0, np.ones(3), cut_by=net), jnp.array([1.0, jnp.inf, 1.0]))
    alive = js.topology.EdgeField(tuple(a > 0.5 for a in net.split(jnp.array([1.0, 0.0, 1.0])).families))
    start = dataclasses.replace(js.State.from_points(net, net.grid(), temperature=t), alive=alive)
    np.testing.assert_allclose(endless.power(start), [1.0, -1.0, 2.0, -2.0])


@pytest.mark.slow
@pytest.mark.parametrize("latent", [None, js.thermal.LatentHeat(330.0, 0.4)], ids=["sensible", "latent"])
def test_f9_two_time_steps(latent, rng):
    """F9: 1,000 heat steps in one of the nodes, or one in 1,000: heat is kept to 1e-13, and what happens is what single steps do."""
    net = js.lattice((3, 4))
    t, dt = rng.uniform(300, 360, 12), 1e-5
    single = body(net, js.thermal.ExplicitHeat(), latent=latent)
    one_by_one, start = go(single, t, dt, 1000)
    start = single.begin(start)
    within, _ = go(body(net, js.thermal.ExplicitHeat(), latent=latent, substeps=1000), t, 1000 * dt, 1)
    np.testing.assert_allclose(within.state.temperature, one_by_one.state.temperature, rtol=1e-13)
    seldom, _ = go(body(net, js.thermal.ExplicitHeat(), latent=latent, every=1000), t, dt / 1000, 2000)
    np.testing.assert_allclose(seldom.state.temperature, go(single, t, dt, 2)[0].state.temperature, rtol=1e-13)
    for run in (one_by_one, within, seldom):
        assert int(run.status.flags) == 0
        assert drift(single, start, run.state) <= 1e-13


@pytest.mark.parametrize("wrap", [lambda rule: rule, lambda rule: (rule, js.Ledger())], ids=["Heat", "Ledger"])
def test_heat_that_blows_up_is_named(wrap):
    """A source that is infinite from 0.35 s on: NONFINITE at step 5, at its node, in the name of the rule and not of the springs."""
    net = js.lattice(4)
    heat = js.Heat(net, 1.0, 0.0, source=lambda t: jnp.where(jnp.arange(4) == 2, jnp.where(t > 0.35, jnp.inf, 1.0), 0.0))
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), rules=wrap(heat))
    run = js.rollout(system, js.State.from_points(net, net.grid(), temperature=300.0), js.SymplecticEuler(), 0.1, 20)
    assert bool(run.status.has(Flag.NONFINITE))
    assert (int(run.status.step), int(run.status.node), int(run.status.effect)) == (5, 2, 1)
    with pytest.raises(js.SimulationError, match=r"position, velocity or temperature is NaN.*effect Heat"):
        js.raise_for_status(run)
