"""Hard cases C5, C6 and D3, and what must hold of an implicit step for any stiffness, dt and crumple."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxspring as js
from jaxspring.status import Flag
from tests.hard.test_c_implicit import LIMIT, cloth


@eqx.filter_jit
def one_step(system, start, stepper, dt):
    """A step's status, its solve and the state after it."""
    run = js.rollout(system, start, stepper, dt, 1)
    return run.status, run.info.solves, run.state


@pytest.mark.slow
@pytest.mark.parametrize("preconditioner", [js.linalg.BlockJacobi(), js.linalg.Jacobi()], ids=lambda p: type(p).__name__)
def test_c5_stiffness_over_eight_decades(preconditioner, dtype):
    """C5: springs of 1e-4 to 1e4 N/m in one cloth, dt = 100 times the limit: OK within 2,200 iterations, with the true residual."""
    system, start, _ = cloth(12, dtype)
    k = 10 ** np.random.default_rng(5).uniform(-4, 4, system.net.n_springs)
    status, solves, _ = one_step(
        js.replace(system, stiffness=k), start, js.BackwardEuler(js.CG(preconditioner=preconditioner)), 100 * LIMIT
    )
    assert bool(status.is_ok)
    assert int(solves.iterations) <= 2200
    assert float(solves.residual) <= (1e-8 if dtype == np.float64 else 1e-4)


@pytest.mark.slow
def test_c6_masses_over_six_decades(dtype):
    """C6: masses of 10 mg to 10 kg side by side, dt = 100 times the limit: OK within 100 iterations in both precisions."""
    system, start, _ = cloth(12, dtype)
    mass = 0.01 * 10 ** np.random.default_rng(5).uniform(-3, 3, system.net.n_nodes)
    status, solves, _ = one_step(js.replace(system, mass=mass), start, js.BackwardEuler(js.CG()), 100 * LIMIT)
    assert bool(status.is_ok)
    assert int(solves.iterations) <= 100


@pytest.mark.slow
def test_d3_ten_steps_three_ways():
    """D3: ten steps of an 8 x 8 cloth, solved to 1e-12: reverse mode is forward mode to 1e-10, central differences to 3e-9.

    The cloth is stretched by a tenth in a frame: where a spring goes slack, the clamped tangent of a linear step has a kink.
    """
    loose, _, _ = cloth(8, gravity=9.81)
    flat = np.concatenate([loose.net.grid(0.11), np.zeros((64, 1))], axis=1)
    inside = np.all((loose.net.grid() > 0) & (loose.net.grid() < 7), axis=1)
    bumps = 0.01 * np.random.default_rng(3).normal(size=flat.shape) * inside[:, None]
    system = js.System(loose.net, 0.01, loose.forces, free=inside)
    start = js.State.from_points(loose.net, flat + bumps)

    def mean_height(log_k):
        stepper = js.BackwardEuler(js.JaxCG(tolerance=1e-12))
        return jnp.mean(js.rollout(js.replace(system, stiffness=jnp.exp(log_k)), start, stepper, 10 * LIMIT, 10).state.position.z)

    at, h = float(np.log(1e4)), 1e-3
    value_and_slope = jax.jit(jax.value_and_grad(mean_height))
    reverse = float(value_and_slope(at)[1])
    forward = float(jax.jit(lambda q: jax.jvp(mean_height, (q,), (1.0,))[1])(at))
    f = [float(value_and_slope(at + m * h)[0]) for m in (-2, -1, 1, 2)]
    assert forward == pytest.approx(reverse, rel=1e-10)
    assert (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * h) == pytest.approx(reverse, rel=3e-9)


def test_a_rise_of_a_ten_thousandth_is_told():
    """One spring, one step in closed form, x' = (1 + u/2, 1) and v' = (u/2, 1): ENERGY_ROSE where a ten-thousandth of the energy exchanged
    was gained, silence where it was lost.
    """
    net = js.lattice(2)
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), free=np.array([False, True]))

    def changes(u):
        return np.array([-3 / 8 * u**2, 0.5 * (np.hypot(1 + u / 2, 1) - 1) ** 2])

    for share in (1e-4, -1e-4):
        u = scipy.optimize.brentq(lambda u, share=share: changes(u).sum() - share * np.abs(changes(u)).sum(), 0.1, 5.0)
        start = js.State.from_points(net, [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [u, 1.0]])
        run = js.rollout(system, start, js.BackwardEuler(), 1.0, 1)
        np.testing.assert_allclose(run.state.points[1], [1 + u / 2, 1], rtol=1e-12)
        assert bool(run.status.has(Flag.ENERGY_ROSE)) == (share > 0)


NET = js.lattice((4, 4), springs=js.STRUCTURAL + js.SHEAR)
FLAT = np.concatenate([NET.grid(1.0), np.zeros((16, 1))], axis=1)
SHEET = js.System(NET, 1.0, js.Springs(NET, 1.0, NET.lengths(FLAT)), free=np.arange(16) > 0)


@eqx.filter_jit
def energies(stepper, k, points, velocities, dt):
    """Energy at the start and after each of five steps [J], and how the run ended."""
    system, start = js.replace(SHEET, stiffness=k), js.State.from_points(NET, points, velocities)
    run = js.rollout(system, start, stepper, dt, 5, save_every=1, observe=lambda state: system.energy(state).total)
    return jnp.concatenate([system.energy(start).total[None], run.saved]), run.status


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.BackwardEuler(), js.BackwardEuler(newton=True)], ids=["linear", "Newton"])
@settings(max_examples=40)
@given(
    log_k=st.floats(-4, 6),
    log_step=st.floats(-2, 3),
    crumple=st.sampled_from([0.0, 1e-9, 1e-3, 0.1, 0.5]),
    speed=st.sampled_from([0.0, 0.1, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_step_is_finite_and_tells_when_energy_rose(stepper, log_k, log_step, crumple, speed, seed):
    """Stiffness over ten decades, dt from 0.01 to 1,000 of sqrt(m/k), from flat to crumpled beyond recognition, at rest or moving: numbers
    always; a rise of the energy by more than a thousandth of what there was is always reported.
    """
    k = jnp.asarray(10.0**log_k)
    rng = np.random.default_rng(seed)
    points = FLAT + crumple * rng.standard_normal(FLAT.shape)
    # Of the speed of sound: sideways a flat sheet gives way, and a linear step stretches it.
    velocities = speed * jnp.sqrt(k) * rng.standard_normal(FLAT.shape)
    energy, status = energies(stepper, k, jnp.asarray(points), velocities, 10.0**log_step / jnp.sqrt(k))
    assert np.all(np.isfinite(energy))
    assert not bool(status.has(Flag.NONFINITE))
    rose = np.max(np.diff(energy)) > 1e-3 * energy[0] + 1e-12 * k
    assert bool(status.has(Flag.ENERGY_ROSE)) or not rose


def random_net(seed, kind):
    """Twelve nodes in space: joined at random in one piece, or in two pieces with a lone node beside them."""
    rng = np.random.default_rng(seed)
    if kind == "one piece":
        edges = [(i, int(rng.integers(i))) for i in range(1, 12)] + [tuple(rng.choice(12, 2, replace=False)) for _ in range(12)]
    else:
        edges = [(i, int(rng.integers(i))) for i in range(1, 6)] + [(i, int(rng.integers(6, i))) for i in range(7, 11)]
        edges += [tuple(rng.choice(6, 2, replace=False)) for _ in range(8)]
    return js.Graph.from_edges(edges, 12)


RANDOM_NETS = {kind: random_net(7, kind) for kind in ("one piece", "two pieces and a lone node")}


@eqx.filter_jit
def step_energies(net, stepper, mass, k, shape, points, times):
    """Energy before and after each of three steps of so many explicit limits [J], how they ended, and whether all is finite."""
    system = js.System(net, mass, js.Springs(net, k, net.lengths(shape)), free=np.arange(12) > 0)
    start = js.State.from_points(net, points)
    dt = times * js.stable_dt(system, start)
    run = js.rollout(system, start, stepper, dt, 3, save_every=1, observe=lambda state: system.energy(state).total)
    return jnp.concatenate([system.energy(start).total[None], run.saved]), run.status, jnp.all(jnp.isfinite(run.state.points))


@pytest.mark.slow
@pytest.mark.parametrize("kind", RANDOM_NETS)
@pytest.mark.parametrize("stepper", [js.BackwardEuler(js.CG()), js.BackwardEuler(newton=True)], ids=["linear", "Newton"])
@settings(max_examples=40)
@given(
    seed=st.integers(0, 2**32 - 1),
    log_times=st.floats(-1, 4),
    squeeze=st.sampled_from([0.0, 0.5, 1.0, 3.0]),
    n_coincident=st.integers(0, 3),
)
def test_random_nets_are_never_silent(kind, stepper, seed, log_times, squeeze, n_coincident):
    """Stiffness over eight decades, masses over six, dt from 0.1 to 10,000 explicit limits, squeezed, stretched, coincident, in pieces: the
    states are finite, and the energy did not rise or the status is an error.
    """
    rng = np.random.default_rng(seed)
    net = RANDOM_NETS[kind]
    k, mass = 10 ** rng.uniform(-4, 4, net.n_springs), 10 ** rng.uniform(-3, 3, 12)
    shape = rng.standard_normal((12, 3))
    points = squeeze * shape + 1e-3 * rng.standard_normal((12, 3))
    points[1 : 1 + n_coincident] = points[0]
    energy, status, is_finite = step_energies(net, stepper, *(jnp.asarray(a) for a in (mass, k, shape, points, 10**log_times)))
    rose = np.max(np.diff(energy)) > 1e-3 * energy[0]
    assert bool(is_finite)
    assert not bool(status.has(Flag.NONFINITE))
    assert not bool(status.is_ok) or not rose
