"""Hard cases C: stepping in time. (Lines that need an implicit step are not here.)"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag, StabilityWarning
from tests.reference import chaotic_net

TWO = pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=repr)


def chain_32(rng):
    """A free chain of 32 unit masses, k = 1e4 N/m, at rest but for small random velocities."""
    net = js.lattice(32)
    velocities = 1e-3 * rng.normal(size=(32, 1))
    return js.System(net, 1.0, js.Springs(net, 1e4, 1.0)), js.State.from_points(net, net.grid(), velocities)


# The highest frequency of the free chain is 2 sqrt(k/m) cos(pi / 2N) = 200 cos(pi/64) per second.
DT_C = 2 / (200 * np.cos(np.pi / 64))


def energies(system):
    def observe(state):
        return system.energy(state).total

    return observe


@TWO
def test_c1_just_below_the_limit(rng, stepper):
    """At 0.99 of the critical dt the energy stays within 83 times its start for 5,000 steps; stable_dt() is not above the critical dt."""
    system, state = chain_32(rng)
    assert pytest.approx(0.0100121, abs=1e-7) == DT_C
    assert js.stable_dt(system, state, stepper) == pytest.approx(0.01, rel=1e-12)  # Gershgorin: 2 / sqrt(4 k / m), below DT_C
    result = js.rollout(system, state, stepper, 0.99 * DT_C, 5000, save_every=10, observe=energies(system))
    assert result.status.flags == 0
    assert np.max(result.saved) <= 83 * system.energy(state).total


@TWO
def test_c1_just_above_the_limit(rng, stepper):
    """At 1.01 of the critical dt the run ends in NONFINITE, and the error names the step and the stable dt."""
    system, state = chain_32(rng)
    with pytest.warns(StabilityWarning, match=r"DT_LIMIT.*dt = 0.0101122 s.*stable only up to 0.01 s"):
        result = js.rollout(system, state, stepper, 1.01 * DT_C, 5000)
    assert result.status.has(Flag.NONFINITE)
    step = int(result.status.step)
    # The growth per step at w dt = 2.02 is acosh(2 * 1.01^2 - 1) = 0.2826 for both steppers. It fails where the square of a length
    # leaves float64; before that it folds, for a time that hangs on the last bit: 0.16 to 0.50 of the rest over 96 runs.
    assert np.log(1e154) / 0.2826 < step < np.log(1e154) / 0.2826 * 1.8
    with pytest.raises(js.SimulationError, match=rf"step {step}.*stability limit of this run was dt = 0\.01\."):
        js.raise_for_status(result)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        last, first = (js.rollout(system, state, stepper, 1.01 * DT_C, n, check_every=1) for n in (step - 1, step))
    assert not last.status.has(Flag.NONFINITE)
    assert np.isfinite(last.state.points).all()
    assert first.status.step == step


def drag_only():
    net = js.lattice(2)
    system = js.System(net, 1.0, js.Drag(3000.0))
    return system, js.State.from_points(net, np.zeros((2, 1)), np.ones((2, 1)))


def test_c2_too_much_drag():
    """With gamma dt / m = 3 lagged drag doubles the speed at every step, and the run says DT_LIMIT: as a warning, and as a status."""
    system, state = drag_only()
    with pytest.warns(StabilityWarning, match="DT_LIMIT"):
        result = js.rollout(system, state, js.SymplecticEuler(), 1e-3, 10)
    np.testing.assert_allclose(result.state.velocities, 2.0**10, rtol=1e-12)  # (1 - 3)^10
    traced = jax.jit(lambda dt: js.rollout(system, state, js.SymplecticEuler(), dt, 10).status)
    assert traced(1e-3).has(Flag.DT_LIMIT)
    assert traced(1e-3).is_ok
    assert traced(6e-4).flags == 0  # 2 m / gamma = 0.667 ms
    assert traced(-1e-3).has(Flag.DT_LIMIT)  # backward, too
    assert js.stable_dt(system, state) == pytest.approx(2 / 3000, rel=1e-14)


def oscillator_error(stepper, n_steps, damping=0.0):
    """Error in x and v of a spring of frequency 3 and drag `damping` after one second, against the closed form."""
    net = js.lattice(2)
    effects = (js.Springs(net, 9.0, 0.0), js.Drag(damping)) if damping else js.Springs(net, 9.0, 0.0)
    system = js.System(net, 1.0, effects, free=[False, True])
    state = js.State.from_points(net, [[0.0], [1.0]])
    result = js.rollout(system, state, stepper, 1.0 / n_steps, n_steps)
    c = damping / 2
    w = np.sqrt(9 - c * c)
    decay = np.exp(-c)
    x = decay * (np.cos(w) + c / w * np.sin(w))
    v = -decay * 9 / w * np.sin(w)
    return abs(float(result.state.position.x[1]) - x) + abs(float(result.state.velocity.x[1]) - v)


@pytest.mark.parametrize("damping", [0.0, 1.0])
@pytest.mark.parametrize(
    ("stepper", "order"), [(js.ForwardEuler(), 1), (js.SymplecticEuler(), 1), (js.VelocityVerlet(), 2), (js.RungeKutta4(), 4)], ids=repr
)
def test_c12_order_of_convergence(stepper, order, damping):
    """Halving dt divides the error of an oscillator by 2^order, with drag as well as without (w = 3, one second)."""
    counts = (256, 512) if order == 1 else (64, 128)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)  # forward Euler is above its limit without drag: it has none
        coarse, fine = (oscillator_error(stepper, n, damping) for n in counts)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def reversed_run(system, state, dt):
    there = js.rollout(system, state, js.VelocityVerlet(), dt, 500).state
    turned = js.State.from_points(system.net, there.points, -there.velocities)
    back = js.rollout(system, turned, js.VelocityVerlet(), dt, 500).state
    return there, back


def test_c13_time_reversal(rng):
    """Verlet forth, velocities turned round, and back: a chaotic net of 576 nodes returns to 5e-10, a regular chain to 1e-12."""
    system, state = chaotic_net(rng)
    there, back = reversed_run(system, state, 5e-3)
    assert np.abs(there.points - state.points).max() > 0.1
    assert np.abs(back.points - state.points).max() <= 5e-10
    net = js.lattice(10)
    chain = js.System(net, 1.0, js.Springs(net, 100.0, 1.0))
    state = js.State.from_points(net, np.c_[1.05 * np.arange(10.0)], np.sin(np.arange(10.0))[:, None])
    there, back = reversed_run(chain, state, 5e-3)
    assert np.abs(there.points - state.points).max() > 0.1
    assert np.abs(back.points - state.points).max() <= 1e-12


@pytest.mark.parametrize("kind", ["lattice", "graph"])
@TWO
def test_c14_momentum(rng, stepper, kind):
    """A free net keeps its momentum to 1e-14 and its angular momentum to 1e-12 over 500 steps, relative to what its nodes carry."""
    sheet = js.lattice((6, 6), js.STRUCTURAL + js.SHEAR)
    net = sheet
    if kind != "lattice":
        net = js.Graph.from_edges(sheet.edges, 36)
    points = np.c_[sheet.grid(), np.zeros(36)] + 0.1 * rng.normal(size=(36, 3))
    mass = rng.uniform(0.5, 2.0, 36)
    state = js.State.from_points(net, points, rng.normal(size=(36, 3)))
    system = js.System(net, mass, js.Springs(net, 100.0, 1.0))
    end = js.rollout(system, state, stepper, 2e-3, 500).state
    carried = np.sum(mass[:, None] * np.abs(state.velocities))
    assert np.abs(system.momentum(end) - system.momentum(state)).max() <= 1e-14 * carried
    spin = np.sum(np.abs(mass[:, None] * np.cross(points, state.velocities)))
    assert np.abs(system.angular_momentum(end) - system.angular_momentum(state)).max() <= 1e-12 * spin


CHAIN_8 = js.lattice(8)


def soak_observe(state):
    """Energy and centre of mass of the 8-chain (k = 100 N/m, m = 1 kg, l = 1 m)."""
    d = state.position.x[1:] - state.position.x[:-1]
    energy = 0.5 * jnp.sum(state.velocity.x * state.velocity.x) + 50 * jnp.sum((d - 1) * (d - 1))
    return energy, jnp.mean(state.position.x)


@pytest.mark.slow
def test_c15_soak(dtype):
    """A million steps of an 8-chain: bounded energy without drift, a centre of mass that stays, one program, no growth of memory."""
    n_pieces, n_steps = 4, 250_000
    system = js.System(CHAIN_8, 1.0, js.Springs(CHAIN_8, 100.0, 1.0))
    # The two slowest modes: w dt is at most 0.038, so that the energy of Verlet swings by (w dt)^2 / 8 = 2e-4.
    velocities = sum(np.cos(np.pi * p * (np.arange(8) + 0.5) / 8) for p in (1, 2))[:, None].astype(dtype)
    state = js.State.from_points(CHAIN_8, (CHAIN_8.grid() - 3.5).astype(dtype), velocities)
    # Velocities in float32 do not sum to zero exactly: the centre moves with what is left, in a straight line.
    drift = float(np.mean(np.asarray(velocities, float)))
    resume, kept, sizes = None, [], []
    for _ in range(n_pieces):
        result = js.rollout(system, state, js.VelocityVerlet(), 5e-3, n_steps, save_every=250, observe=soak_observe, resume=resume)
        state, resume = result.state, result.resume
        assert result.status.flags == 0
        kept.append([np.array(a, float) for a in result.saved])
        del result
        sizes.append(sum(a.nbytes for a in jax.live_arrays()))
    energy, centre = (np.concatenate(column) for column in zip(*kept, strict=True))
    start = 0.5 * np.sum(np.asarray(velocities, float) ** 2)
    times = 5e-3 * 250 * np.arange(1, len(energy) + 1)
    slope = np.polyfit(np.linspace(0, 1, len(energy)), energy / start, 1)[0]
    assert np.abs(energy / start - 1).max() <= 1e-3
    # In float32 the rounding of a million kicks is a random walk of the energy of 2e-4 to 6e-4; it has no slope to speak of.
    assert abs(slope) <= (1e-3 if dtype == np.float32 else 1e-4)
    assert np.abs(centre - drift * times).max() <= (5e-2 if dtype == np.float32 else 1e-9)
    assert float(state.time) == pytest.approx(5e-3 * n_pieces * n_steps, rel=1e-6)
    assert max(sizes[1:]) <= sizes[0]
