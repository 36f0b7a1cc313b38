"""Melting, whatever the temperatures: springs soften within bounds, fuse for good, come back without energy, and heat is kept."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxspring as js
from jaxspring.status import Status

NET = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
ALONG = js.lattice((3, 4))
EDGES = np.asarray(NET.edges)
N, E = NET.n_nodes, NET.n_springs
FULL, MELTING, STEPS = 50.0, 350.0, 8
EPS = np.finfo(float).eps

seeds = st.integers(0, 2**32 - 1)


def mean_of_ends(temperature):
    return temperature[..., EDGES].mean(-1)


@functools.cache
def softened(dtype):
    """A compiled function of temperatures, limits [K] and sharpness: (E,) stiffnesses [N/m] on the exact ramp and on the smooth one."""

    @jax.jit
    def both(temperature, softening, melting, sharpness):
        state = js.State.from_points(NET, jnp.zeros((N, 2), dtype), temperature=temperature)
        rules = (js.thermal.ThermalStiffness(FULL, softening, melting), js.thermal.ThermalStiffness(FULL, softening, melting, sharpness))
        return tuple(NET.flatten(rule.stiffness(NET, state)) for rule in rules)

    return lambda *numbers: tuple(np.asarray(k, float) for k in both(*(jnp.asarray(n, dtype) for n in numbers)))


@pytest.mark.parametrize("precision", ["float32", "float64"])
@given(seed=seeds, log_width=st.floats(-3, 4), log_far=st.floats(-3, 6), log_b=st.floats(-2, 6))
def test_softening_stays_within_bounds(precision, seed, log_width, log_far, log_b):
    """Sharp or not, over decades of temperature: 0 <= k <= k0, and nothing gains stiffness as it gets warmer. The smooth ramp is within
    k0 ln 2 / b of the exact one, and so tends to it.
    """
    rng, both, b = np.random.default_rng(seed), softened(precision), 10**log_b
    # The smooth ramp is a difference of logarithms, over b.
    rounding = 8 * FULL * float(np.finfo(precision).eps) * (1 + 1 / b)
    cold = 300.0 + rng.normal(0.0, 10**log_far, N)
    warmer = cold + rng.exponential(10**log_far, N) * (rng.random(N) < 0.7)
    exact, smooth = zip(*(both(t, 300.0, 300.0 + 10**log_width, b) for t in (cold, warmer)), strict=True)
    for k in (*exact, *smooth):
        assert k.min() >= 0
        assert k.max() <= FULL
    assert np.all(exact[1] <= exact[0])
    assert np.all(smooth[1] <= smooth[0] + rounding)
    assert np.abs(np.subtract(smooth, exact)).max() <= FULL * np.log(2) / b + rounding


class Warmed(js.Rule):
    """Gives the nodes the temperatures and places of a list, one entry a step."""

    temperatures: jax.Array
    points: jax.Array

    def update(self, step, state):
        entry = jnp.round(state.time / step.dt).astype(int) - 1
        there = js.State.from_points(NET, self.points[entry])
        return dataclasses.replace(state, position=there.position, temperature=self.temperatures[entry].reshape(3, 4)), Status.ok()


@jax.jit
def history(temperatures, points, stiffness, hysteresis, reach):
    """What is alive, rest lengths and stored energy after each step of (steps, N) temperatures and (steps, N, 2) places; twice, without
    and with refreezing.
    """

    def run(refreezing):
        rules = (Warmed(temperatures, points), js.Fusing(NET, MELTING, refreezing))
        system = js.System(NET, 1.0, js.Springs(NET, stiffness, NET.lengths(NET.grid())), rules=rules)
        start = js.State.from_points(NET, NET.grid(), temperature=300.0)

        def look(state):
            rest = jnp.zeros(E) if state.rest_length is None else NET.flatten(state.rest_length)
            return NET.flatten(state.alive), rest, system.energy(state).potential[0]

        return js.rollout(system, start, js.Still(), 0.5, STEPS, save_every=1, observe=look).saved

    return run(None), run(js.thermal.Refreezing(hysteresis, reach))


@settings(max_examples=60)
@given(seed=seeds, swing=st.floats(1.0, 60.0), hysteresis=st.floats(0.0, 40.0), reach=st.floats(0.5, 2.0))
def test_springs_fuse_and_come_back(seed, swing, hysteresis, reach):
    """Any history of temperatures and places. Without refreezing no broken spring comes back, so that the number of living ones never
    grows. With it one comes back where cold and near, with its present length, and stores nothing at that moment.
    """
    rng = np.random.default_rng(seed)
    temperatures = MELTING - 0.3 * swing + swing * rng.normal(size=(STEPS, N))
    points = np.asarray(NET.grid()) + 0.3 * rng.normal(size=(STEPS, N, 2))
    stiffness = rng.uniform(1, 100, E)
    for_good, again = (
        tuple(np.asarray(a) for a in saved)
        for saved in history(*(jnp.asarray(a) for a in (temperatures, points, stiffness, hysteresis, reach)))
    )

    # Rounding of the mean may fall on either side of the melting point.
    theta = mean_of_ends(temperatures)
    if min(np.abs(theta - MELTING).min(), np.abs(theta - MELTING + hysteresis).min()) < 1e-9:
        return
    hot = theta >= MELTING
    np.testing.assert_array_equal(for_good[0], ~np.logical_or.accumulate(hot))
    assert np.all(np.diff(for_good[0].sum(1)) <= 0)

    alive, rest = np.ones(E, bool), np.asarray(NET.lengths(NET.grid()))
    length = np.linalg.norm(points[:, EDGES[:, 1]] - points[:, EDGES[:, 0]], axis=-1)
    for i in range(STEPS):
        kept = alive & ~hot[i]
        back = ~kept & (theta[i] <= MELTING - hysteresis) & ~hot[i] & (length[i] <= reach)
        rest = np.where(back, length[i], rest)
        stored = 0.5 * np.sum((stiffness * (length[i] - rest) ** 2)[kept])
        alive = kept | back
        np.testing.assert_array_equal(again[0][i], alive)
        np.testing.assert_allclose(again[1][i], rest, rtol=4 * EPS)
        assert again[2][i] == pytest.approx(stored, rel=1e-12, abs=1e-25)


@jax.jit
def phases(y, melting, latent, capacity):
    """Temperatures, latent heats, and y made of them again."""
    law = js.thermal.LatentHeat(melting, latent)
    theta, h = law.temperature(y, capacity), law.enthalpy(y, capacity)
    return theta, h, law.joined(theta, h, capacity)


@given(seed=seeds, melting=st.floats(1.0, 2000.0), log_latent=st.floats(-3, 6), log_capacity=st.floats(-3, 3), log_far=st.floats(-3, 4))
def test_temperature_and_enthalpy_are_one_variable(seed, melting, log_latent, log_capacity, log_far):
    """A node's heat above the solid at its melting point goes to temperature and enthalpy and back to rounding; neither ever falls as
    heat comes in; the enthalpy is between 0 and L, and the temperature is the melting point wherever it is strictly between.
    """
    latent, capacity = 10**log_latent, 10**log_capacity
    plateau = latent / capacity
    anywhere = np.random.default_rng(seed).uniform(-(10**log_far), plateau + 10**log_far, N)
    y = np.sort([0.0, plateau, *anywhere])
    theta, h, again = (np.asarray(a) for a in phases(*(jnp.asarray(a) for a in (y, melting, latent, capacity))))
    rounding = 4 * EPS * (melting + np.abs(y).max())
    np.testing.assert_allclose(again, y, atol=rounding)
    np.testing.assert_allclose(capacity * (theta - melting) + h, capacity * y, atol=capacity * rounding)
    assert np.all(np.diff(theta) >= 0)
    assert np.all(np.diff(h) >= 0)
    assert h.min() >= 0
    assert h.max() <= latent * (1 + 2 * EPS)
    inside = (h > 0) & (h < latent * (1 - 2 * EPS))
    np.testing.assert_array_equal(theta[inside], melting)


def scene(latent, conductance):
    """An insulated sheet that softens, melts and tears while it swings, with a book of its energy."""
    heat = js.Heat(ALONG, 1.0, conductance, latent=js.thermal.LatentHeat(MELTING, latent), cut_by=NET)
    springs = js.Springs(NET, js.thermal.ThermalStiffness(FULL, 320.0, 370.0), NET.lengths(NET.grid()))
    return js.System(NET, 1.0, (springs, js.Drag(0.3)), rules=(heat, js.Fusing(NET, MELTING), js.Ledger()))


@jax.jit
def torn(points, velocities, temperatures, latent, conductance):
    """The state at the start and after 20 steps, and the number of living springs after each."""
    system = scene(latent, conductance)
    start = js.State.from_points(NET, points, velocities, temperature=temperatures)
    run = js.rollout(system, start, js.SymplecticEuler(), 0.02, 20, save_every=1, observe=lambda s: jnp.sum(NET.flatten(s.alive)))
    return system.bind(start.dtype).begin(start), run.state, run.saved


@pytest.mark.slow
@settings(max_examples=40)
@given(seed=seeds, hot=st.floats(320.0, 420.0), log_latent=st.floats(-2, 2), log_conductance=st.floats(-2, 0.9))
def test_an_insulated_body_melts(seed, hot, log_latent, log_conductance):
    """Heat with latent heat is kept to rounding while springs break and conduct no more; fusing takes energy and never gives any,
    neither heat nor motion; the number of living springs never grows; the book closes.
    """
    rng = np.random.default_rng(seed)
    temperatures = rng.uniform(300.0, hot, N)
    latent, conductance = jnp.asarray(10**log_latent), jnp.asarray(10**log_conductance)
    points = np.asarray(NET.grid()) + 0.2 * rng.normal(size=(N, 2))
    start, end, living = torn(jnp.asarray(points), jnp.asarray(rng.normal(size=(N, 2))), jnp.asarray(temperatures), latent, conductance)
    system = scene(latent, conductance)
    book = js.energy_ledger(system, end)
    heat = system.rules[0]
    assert float(js.thermal.total_heat(heat, end)) == pytest.approx(float(js.thermal.total_heat(heat, start)), rel=1e-14)
    assert abs(book["rules"]["Heat"]["heat"]) <= 1e-11
    fusing = book["rules"]["Fusing"]
    # A difference of two sums that the compiler adds up each in its own order: nothing, to their rounding.
    assert fusing["Springs"] <= 4 * np.finfo(float).eps * book["start"]["Springs"]
    assert fusing["Drag"] == fusing["kinetic"] == fusing["heat"] == 0
    assert np.all(np.diff([E, *np.asarray(living)]) <= 0)
    assert abs(book["residual"]) < 1e-10
