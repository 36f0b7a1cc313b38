"""Rayleigh damping: its damping ratios, what it does to energy and to turning bodies, its bounds and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxspring as js
from tests.step_matrices import in_numpy

A, B = 0.3, 0.04
MASS = np.linspace(1.0, 2.0, 5)


def test_every_mode_decays_with_its_ratio():
    """Each mode of a chain of five masses between pins is an oscillator with zeta = a / (2 w) + b w / 2, and stays that mode."""
    net, stiffness = js.lattice(7), np.array([20.0, 35.0, 15.0, 40.0, 25.0, 30.0])
    mass = np.array([1.0, 1.2, 0.7, 1.0, 2.0, 0.9, 1.0])
    free = np.array([False] + [True] * 5 + [False])
    rows = np.diff(np.eye(7), axis=0)
    k = (rows.T @ np.diag(stiffness) @ rows)[1:-1, 1:-1]
    squared, modes = scipy.linalg.eigh(k, np.diag(mass[1:-1]))
    w, damping = np.sqrt(squared), js.Rayleigh(A, B)
    system = js.System(net, mass, (js.Springs(net, stiffness, 1.0), damping), free=free)
    zeta = A / (2 * w) + B * w / 2
    np.testing.assert_allclose(damping.damping_ratio(w), zeta, rtol=1e-14)

    moved = 1e-3 * np.concatenate([[0.0], modes.sum(axis=1), [0.0]])[:, None]
    start = js.State.from_points(net, net.grid() + moved)
    end = np.asarray(js.rollout(system, start, js.RungeKutta4(), 0.005, 200).state.points) - net.grid()
    slow = w * np.sqrt(1 - zeta**2)
    expected = 1e-3 * np.exp(-zeta * w) * (np.cos(slow) + zeta * w / slow * np.sin(slow))
    np.testing.assert_allclose(modes.T @ (mass[1:-1] * end[1:-1, 0]), expected, atol=1e-10)
    np.testing.assert_array_equal(end[[0, -1]], 0)


@pytest.fixture(scope="module")
def body():
    """Five nodes in space and nine springs at rest length."""
    flat = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 1.1, 0.0], [0.4, 0.3, 0.9], [1.1, 1.2, 0.8]])
    net = js.Graph.from_edges([(i, j) for i in range(5) for j in range(i) if (i, j) != (4, 0)], 5)
    springs = js.Springs(net, np.linspace(10.0, 30.0, 9), net.lengths(flat))
    return js.System(net, MASS, (springs, js.Rayleigh(A, B))), flat


@pytest.fixture(scope="module")
def damping_force(body):
    """(positions, velocities) -> (N, D) force of the damping alone, compiled once; the coefficients may be others."""
    system, _ = body

    @jax.jit
    def force(points, velocities, a=A, b=B):
        state = js.State.from_points(system.net, points, velocities)
        new = js.replace(system, mass_rate=a, stiffness_time=b)
        v = new.force(state) - new.forces[0].force(state)
        return jnp.stack([system.net.flatten_nodes(f) for f in v], axis=-1)

    return force


def test_matrix_of_a_stretched_body(body, damping_force):
    """-dF/dv is a M + b K where no spring is squeezed, K from the list of springs; the blocks are that matrix."""
    system, flat = body
    points = 1.2 * flat + 0.02 * np.random.default_rng(1).normal(size=flat.shape)
    length, springs = np.asarray(system.net.lengths(points)), system.forces[0]
    k, l = np.asarray(springs.stiffness), np.asarray(springs.rest_length)
    assert np.all(length > l)
    expected = in_numpy(system.net, points, B * k * (1 - l / length), B * k * l / length, A * MASS).toarray()
    state = js.State.from_points(system.net, points)
    np.testing.assert_allclose(system.matrix(system.damping_blocks(state), state).to_dense(), expected, atol=1e-12)
    v = np.random.default_rng(2).normal(size=(5, 3))
    np.testing.assert_allclose(damping_force(points, v).ravel(), -expected @ v.ravel(), atol=1e-12)


@settings(max_examples=50)
@given(st.integers(0, 2**31), st.floats(0.0, 3.0), st.floats(0.0, 2.0))
def test_it_never_feeds_energy(body, damping_force, seed, size, noise):
    """The power f . v is not positive, however squeezed, stretched or crumpled the body is: K is clamped."""
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(5, 3))
    f = np.asarray(damping_force(size * body[1] + noise * rng.normal(size=(5, 3)), v, 0.0, B))
    assert np.sum(f * v) <= 1e-12 * np.sum(np.abs(f * v))


def test_turning_is_damped_where_springs_are_stretched_only(body, damping_force):
    """A body that turns rigidly feels nothing of b K at rest length; stretched by a tenth it feels a torque, but no net force."""
    flat = body[1]
    v = np.cross([0.3, -0.2, 1.0], flat)
    np.testing.assert_allclose(damping_force(flat, v, 0.0, B), 0, atol=1e-12)
    f = np.asarray(damping_force(1.1 * flat, v, 0.0, B))
    assert np.cross(flat - flat.mean(axis=0), f).sum(axis=0)[2] < -0.1
    np.testing.assert_allclose(f.sum(axis=0), 0, atol=1e-12)


@pytest.mark.slow
def test_a_squeezed_run_of_implicit_steps_loses_energy(body):
    """Implicit steps at ten times the explicit limit take it implicitly: the energy falls in every one, and pins do not move."""
    system, flat = body
    free = np.arange(5) > 0
    pinned = js.System(system.net, MASS, system.forces, free=free)
    points = 0.7 * flat + 0.05 * np.random.default_rng(3).normal(size=flat.shape)
    start = js.State.from_points(system.net, points)
    dt = 10 * js.stable_dt(pinned, start)
    solver = js.CG(preconditioner=js.linalg.Jacobi())
    run = js.rollout(pinned, start, js.BackwardEuler(solver), dt, 4, save_every=1, observe=lambda s: pinned.energy(s).total)
    js.raise_for_status(run)
    assert np.all(np.diff([pinned.energy(start).total, *run.saved]) < 0)
    np.testing.assert_array_equal(run.state.points[0], points[0])


def test_the_step_limit_knows_it(body):
    """`stable_dt` counts a + b w^2 as the damping rate, w^2 the bound of the springs; SemiImplicit needs only that of the springs."""
    system, flat = body
    state = js.State.from_points(system.net, flat)
    undamped = js.System(system.net, MASS, system.forces[0])
    limit = js.stable_dt(undamped, state)
    squared = (2 / limit) ** 2
    c = A + B * squared
    assert float(js.stable_dt(system, state)) == pytest.approx(float(4 / (c + np.sqrt(c * c + 4 * squared))), rel=1e-12)
    assert js.stable_dt(system, state, js.SemiImplicit()) == limit


@pytest.mark.slow
def test_gradients_by_both_coefficients_and_the_stiffness():
    """Reverse mode is forward mode and central differences; a replaced stiffness reaches the damping too."""
    net = js.lattice(4)
    points = 0.1 * np.random.default_rng(4).normal(size=(4, 2)) + np.array([[0.9, 0.0]]) * np.arange(4.0)[:, None]
    start = js.State.from_points(net, points)

    def loss(theta):
        system = js.System(net, 1.0, (js.Springs(net, 20.0, 1.0), js.Rayleigh(theta[0], theta[1])), free=np.arange(4) > 0)
        system = js.replace(system, stiffness=theta[2])
        return jnp.sum(js.rollout(system, start, js.SymplecticEuler(), 0.03, 10).state.position.y ** 2)

    theta, h = jnp.array([A, B, 20.0]), 1e-4
    reverse = jax.jit(jax.grad(loss))(theta)
    np.testing.assert_allclose(reverse, jax.jit(jax.jacfwd(loss))(theta), rtol=1e-11)
    near = jax.jit(jax.vmap(loss))(theta[None] + h * jnp.concatenate([jnp.eye(3), -jnp.eye(3)]))
    np.testing.assert_allclose(reverse, (near[:3] - near[3:]) / (2 * h), rtol=1e-5)


def test_forces_that_are_given_and_precision(body):
    """Forces given to it alone are damped, whatever else the system holds; float32 states stay float32."""
    system, flat = body
    net, v = system.net, np.random.default_rng(6).normal(size=(5, 3))
    state = js.State.from_points(net, 1.1 * flat, v)
    soft = js.Springs(net, 5.0, 1.0)
    own = js.System(net, MASS, (system.forces[0], js.Rayleigh(A, B, forces=soft)))
    of_soft = js.System(net, MASS, (soft, js.Rayleigh(A, B)))
    of_own, of_other = (s.force(state) - s.forces[0].force(state) for s in (own, of_soft))
    np.testing.assert_allclose(of_own.z, of_other.z, rtol=1e-12, atol=1e-14)
    single = js.State.from_points(net, flat.astype(np.float32), v.astype(np.float32))
    assert own.force(single).dtype == own.bind(np.float32).force(single).dtype == np.float32


def test_coefficients_from_two_ratios_and_wrong_ones():
    """Two ratios at two frequencies are met; what cannot be met, is negative, or stands outside a system is refused."""
    damping = js.Rayleigh.from_ratios((2.0, 0.02), (10.0, 0.05))
    np.testing.assert_allclose(damping.damping_ratio(np.array([2.0, 10.0])), [0.02, 0.05], rtol=1e-14)
    with pytest.raises(ValueError, match=r"mass_rate = -.*negative damping"):
        js.Rayleigh.from_ratios((2.0, 0.02), (10.0, 0.5))
    with pytest.raises(ValueError, match=r"stiffness_time has shape \(2,\)"):
        js.Rayleigh(0.1, [0.1, 0.2])
    with pytest.raises(ValueError, match="Put it in a System"):
        js.Rayleigh(0.1, 0.1).force(js.State.from_points(js.lattice(2), [[0.0], [1.0]]))
    other = js.Springs(js.lattice(3), 1.0)
    with pytest.raises(ValueError, match="another topology"):
        js.System(js.lattice(2), 1.0, js.Rayleigh(0.1, 0.1, forces=other))
