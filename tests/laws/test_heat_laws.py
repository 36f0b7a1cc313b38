"""Heat is kept and makes no new extreme, whatever the body, the step and the scheme: properties of random bodies."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import jaxspring as js
from jaxspring.status import Flag
from jaxspring.thermal.phase import Equation, relaxed, searched

NET = js.lattice((3, 4))
GRAPH = js.Graph.from_edges(NET.edges[::-1], 12)
IMPLICIT = [js.thermal.BackwardEulerHeat(), js.thermal.CrankNicolsonHeat(), js.thermal.SplitHeat(), js.thermal.SymmetricSplitHeat()]


@eqx.filter_jit
def run(scheme, net, c, g, t, latent, q, dt):
    """Status, temperatures, and heat at the start, at the end and brought in, after five steps."""
    heat = js.Heat(net, c, g, scheme, source=net.node_field(q), latent=latent)
    system = js.System(net, 1.0, rules=heat)
    start = system.begin(js.State.from_points(net, NET.grid(), temperature=t))
    result = js.rollout(system, start, js.Still(), dt, 5)
    total = [js.thermal.total_heat(heat, state) for state in (start, result.state)]
    return result.status, result.state.temperatures, total, 5 * dt * jnp.sum(q)


def body(seed):
    """Capacities, conductances over six decades (some zero) and temperatures of a random body."""
    rng = np.random.default_rng(seed)
    g = 10 ** rng.uniform(-3, 3, 17) * (rng.random(17) > 0.1)
    return rng, jnp.asarray(10 ** rng.uniform(-1, 1, 12)), jnp.asarray(g), jnp.asarray(rng.uniform(300, 400, 12))


seeds = st.integers(0, 2**32 - 1)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", IMPLICIT, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("melts", [False, True], ids=["sensible", "latent"])
@settings(max_examples=40)
@given(seed=seeds, log_dt=st.floats(-4, 3), log_latent=st.floats(-1, 3), heated=st.booleans())
def test_heat_is_kept(scheme, melts, seed, log_dt, log_latent, heated):
    """Capacities, conductances, dt and latent heat over decades: what the body has gained is what its sources gave, to rounding, though
    solves end at 1e-8.
    """
    rng, c, g, t = body(seed)
    latent = js.thermal.LatentHeat(350.0, jnp.asarray(10**log_latent)) if melts else None
    q = jnp.asarray(rng.normal(size=12) * heated)
    status, end, (before, after), given_heat = run(scheme, NET, c, g, t, latent, q, jnp.asarray(10**log_dt))
    scale = float(before) + float(jnp.sum(jnp.abs(q))) * 5 * 10**log_dt
    # Half an explicit step of Crank-Nicolson moves up to dt G theta about, whose rounding is kept.
    moved = 10**log_dt * 1e3 * 100 if isinstance(scheme, (js.thermal.CrankNicolsonHeat, js.thermal.SymmetricSplitHeat)) else 0.0
    assert abs(float(after - before - given_heat)) <= 1e-12 * (scale + moved)
    assert np.all(np.isfinite(end))
    if log_dt < 0:
        assert not bool(status.has(Flag.SOLVER))


@pytest.mark.slow
@pytest.mark.parametrize("scheme", [IMPLICIT[0], IMPLICIT[2]], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("melts", [False, True], ids=["sensible", "latent"])
@settings(max_examples=40)
@given(seed=seeds, log_dt=st.floats(-4, 6), log_latent=st.floats(-1, 3))
def test_no_new_extreme(scheme, melts, seed, log_dt, log_latent):
    """Without sources no node becomes hotter than the hottest or colder than the coldest was, at any dt, to the solver's tolerance."""
    _, c, g, t = body(seed)
    latent = js.thermal.LatentHeat(350.0, jnp.asarray(10**log_latent)) if melts else None
    status, end, _, _ = run(scheme, NET, c, g, t, latent, jnp.zeros(12), jnp.asarray(10**log_dt))
    if bool(status.is_ok):
        slack = 1e-4 * float(jnp.ptp(t))
        assert float(jnp.min(t)) - slack <= float(jnp.min(end)) <= float(jnp.max(end)) <= float(jnp.max(t)) + slack
    assert np.all(np.isfinite(end))


def by_trial(c, g, t, latent):
    """Temperatures and latent heats of a chain of three after a backward step of 1 s, melting at 350: of the 27 ways in which its nodes
    can be solid, melting or liquid, the one whose linear system has an answer of that kind.
    """
    a = np.diag(c) + np.array([[g[0], -g[0], 0], [-g[0], g[0] + g[1], -g[1]], [0, -g[1], g[1]]])
    heat = c * (t - 350) + latent * (t > 350)
    for phases in itertools.product((-1, 0, 1), repeat=3):
        phase = np.array(phases)
        moves, over, h = phase != 0, np.zeros(3), np.where(phase == 1, latent, 0.0)
        over[moves] = np.linalg.solve(a[np.ix_(moves, moves)], (heat - h)[moves])
        h = np.where(moves, h, heat - a @ over)
        if np.all(over * phase >= 0) and np.all((h >= 0) & (h <= latent)):
            return 350 + over, h
    raise AssertionError("no phases fit")


@pytest.mark.slow
def test_every_chain_that_melts_is_solved(rng):
    """Conductances over five decades, latent heat over three: each of 400 long steps is found; full Newton steps cycle in many."""
    net, n = js.lattice(3), 400
    c, g, latent = rng.uniform(0.5, 2, (n, 3)), 10.0 ** rng.integers(-2, 4, (n, 2)), 10.0 ** rng.integers(0, 4, n)
    t = rng.integers(300, 401, (n, 3)).astype(float)

    @jax.jit
    @jax.vmap
    def step(c, g, t, latent):
        heat = js.Heat(net, c, g, js.thermal.SplitHeat(), latent=js.thermal.LatentHeat(350.0, latent))
        start = js.State.from_points(net, net.grid(), temperature=t)
        end = js.rollout(js.System(net, 1.0, rules=heat), start, js.Still(), 1.0, 1)
        return end.status.flags, end.state.temperature, end.state.enthalpy

    flags, temperature, enthalpy = step(*(jnp.asarray(a) for a in (c, g, t, latent)))
    np.testing.assert_array_equal(flags, 0)
    expected = [by_trial(*chain) for chain in zip(c, g, t, latent, strict=True)]
    np.testing.assert_allclose(temperature, [theta for theta, _ in expected], atol=1e-5)
    np.testing.assert_allclose(enthalpy, [h for _, h in expected], atol=1e-4)


@pytest.mark.slow
def test_what_a_melting_step_minimises_falls(rng):
    """F of `thermal/phase.py`, in NumPy: no higher after a relaxation; after a search the lowest of Newton's step, its halves, and the one
    that stops at the melting point.
    """
    k, n_crossed = np.zeros((12, 12)), 0

    @jax.jit
    def both(c, g, t0, y, latent, dt, dtheta, loss):
        cooling = js.thermal.Convection(NET, np.ones(12, bool), loss, 300.0, 1.0)
        heat = js.Heat(NET, c, g, boundaries=cooling, latent=js.thermal.LatentHeat(350.0, latent)).ready(y.dtype)
        flow = heat.flow(js.State.from_points(NET, NET.grid(), temperature=y), cuts=False)
        equation = Equation(flow, flow.entered(t0, None), dt, jnp.ones(()))
        found = searched(equation, equation.matrix(y), y, equation.missing(y), dtheta)
        return flow.temperature(relaxed(equation, y)) - 350, flow.temperature(found) - 350

    for seed in range(60):
        c, g, t0 = map(np.asarray, body(seed)[1:])
        latent, dt, loss = 10.0 ** rng.uniform(0, 3), 10.0 ** rng.uniform(-2, 2), 10.0 ** rng.uniform(-2, 3, 12)
        k[:] = 0
        for (a, b), conductance in zip(NET.edges, g, strict=True):
            k[[a, b], [a, b]] += conductance
            k[[a, b], [b, a]] -= conductance
        matrix = np.diag(c + dt * loss) + dt * k
        heat = c * (t0 - 350) + latent * (t0 > 350) - dt * loss * 50.0
        h = latent * rng.integers(0, 2, 12)
        over = rng.uniform(0, 50, 12) * np.where(h > 0, 1, -1)  # each node solid or liquid

        def f(over, matrix=matrix, heat=heat, latent=latent):
            return over @ matrix @ over / 2 - heat @ over + latent * np.maximum(over, 0).sum()

        dtheta = np.linalg.solve(matrix, heat - h - matrix @ over)
        shaped = [jnp.asarray(a).reshape(3, 4) for a in (t0, over + h / c, dtheta)]
        rested, reached = (np.ravel(a) for a in both(c, g, shaped[0], shaped[1], latent, dt, shaped[2], loss))
        crosses = over * (over + dtheta) < 0
        tried = [over + 0.5**i * dtheta for i in range(13 if crosses.any() else 1)] + [np.where(crosses, 0, over + dtheta)]
        slack = 1e-12 * (abs(f(over)) + over @ matrix @ over + abs(heat) @ abs(over))
        assert f(rested) <= f(over) + slack
        assert f(reached) <= min(map(f, tried)) + slack
        n_crossed += crosses.any()
    assert n_crossed > 40


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=seeds, share=st.floats(0.01, 1.0), log_latent=st.floats(-1, 3))
@example(seed=0, share=1.0, log_latent=0.0)
def test_explicit_heat_up_to_its_limit(seed, share, log_latent):
    """At any share of the reported limit: no new extreme, and heat kept to 1e-13, with latent heat."""
    _, c, g, t = body(seed)
    heat = js.Heat(NET, c, g)
    limit = float(js.stable_dt(js.System(NET, 1.0, rules=heat), js.State.from_points(NET, NET.grid(), temperature=t)))
    latent = js.thermal.LatentHeat(350.0, jnp.asarray(10**log_latent))
    status, end, (before, after), _ = run(
        js.thermal.ExplicitHeat(), NET, c, g, t, latent, jnp.zeros(12), jnp.asarray(min(share * limit, 1e3))
    )
    assert not bool(status.has(Flag.DT_LIMIT))
    assert float(jnp.min(t)) - 1e-10 <= float(jnp.min(end)) <= float(jnp.max(end)) <= float(jnp.max(t)) + 1e-10
    assert float(after) == pytest.approx(float(before), rel=1e-13)


@pytest.mark.slow
def test_a_graph_is_its_lattice(rng):
    """The same springs as a graph, in another order, give the lattice's temperatures, implicit and with latent heat."""
    _, c, g, t = body(7)
    latent = js.thermal.LatentHeat(350.0, 30.0)
    scheme = js.thermal.BackwardEulerHeat(js.JaxCG(1e-13), js.thermal.HeatIteration(1e-13))
    on_lattice = run(scheme, NET, c, g, t, latent, jnp.ones(12), jnp.asarray(0.5))[1]
    on_graph = run(scheme, GRAPH, c, g[::-1], t, latent, jnp.ones(12), jnp.asarray(0.5))[1]
    np.testing.assert_allclose(on_graph, on_lattice, rtol=1e-10)


def test_float32_stays_float32(dtype):
    """Temperatures and enthalpies keep the state's precision, whatever that of the constants, with heat kept to its rounding."""
    heat = js.Heat(NET, 1.0, np.full(17, 0.2), js.thermal.BackwardEulerHeat(), latent=js.thermal.LatentHeat(350.0, 20.0))
    start = js.State.from_points(NET, NET.grid().astype(dtype), temperature=np.linspace(300, 400, 12))
    system = js.System(NET, 1.0, rules=heat)
    end = js.rollout(system, start, js.Still(), 0.7, 20).state
    assert end.temperature.dtype == end.enthalpy.dtype == dtype
    gain = float(js.thermal.total_heat(heat, end) / js.thermal.total_heat(heat, system.begin(start))) - 1
    assert abs(gain) <= 100 * np.finfo(dtype).eps
