"""Drag, dashpots, gravity and given loads."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js


@pytest.fixture
def moving(rng):
    """A sheet in general position and motion, with unequal masses."""
    net = js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR)
    points = np.concatenate([net.grid(), np.zeros((12, 1))], axis=1) + 0.1 * rng.normal(size=(12, 3))
    return net, js.State.from_points(net, points, rng.normal(size=(12, 3))), rng.uniform(1, 2, 12)


def flat(net, vector):
    return np.stack([np.asarray(net.flatten_nodes(a)) for a in vector], axis=-1)


def test_drag_is_minus_gamma_v(moving):
    """One drag for all nodes, and one per node."""
    net, state, gamma = moving
    np.testing.assert_array_equal(flat(net, js.Drag(0.3).force(state)), -0.3 * np.asarray(state.velocities))
    per_node = js.Drag(gamma).force(state)
    np.testing.assert_array_equal(flat(net, per_node), -gamma[:, None] * np.asarray(state.velocities))


def test_dashpots_against_numpy(moving, rng):
    """On i c ((v_j - v_i) . u) u, on j the opposite, one spring after the other."""
    net, state, _ = moving
    c = rng.uniform(1, 2, net.n_springs)
    x, v = np.asarray(state.points), np.asarray(state.velocities)
    expected = np.zeros_like(x)
    for (i, j), one in zip(net.edges, c, strict=True):
        u = (x[j] - x[i]) / np.linalg.norm(x[j] - x[i])
        expected[i] += one * np.dot(v[j] - v[i], u) * u
        expected[j] -= one * np.dot(v[j] - v[i], u) * u
    np.testing.assert_allclose(flat(net, js.Dashpots(net, c).force(state)), expected, atol=1e-13)


def test_dashpots_keep_momentum_and_only_take_energy(moving):
    """Forces and torques of dashpots sum to zero, and their power is never positive."""
    net, state, _ = moving
    force = flat(net, js.Dashpots(net, 2.0).force(state))
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-13)
    np.testing.assert_allclose(np.cross(np.asarray(state.points), force).sum(axis=0), 0, atol=1e-13)
    assert (force * np.asarray(state.velocities)).sum() < 0


def test_dashpots_ignore_rigid_motion(moving):
    """A net that moves and turns as a whole feels no dashpot."""
    net, state, _ = moving
    x = np.asarray(state.points)
    rigid = np.array([1.0, 2.0, 3.0]) + np.cross(np.array([0.3, -0.2, 0.5]), x)
    force = js.Dashpots(net, 2.0).force(js.State.from_points(net, x, rigid))
    np.testing.assert_allclose(flat(net, force), 0, atol=1e-13)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_dashpots_of_no_length(mode):
    """With both ends at one place the force is zero, and its derivatives are finite."""
    net = js.lattice(2)

    def force(points):
        state = js.State.from_points(net, points, np.array([[0.0, 0.0], [100.0, 50.0]]))
        return jnp.stack(list(js.Dashpots(net, 1e3).force(state)))

    np.testing.assert_array_equal(force(jnp.zeros((2, 2))), 0)
    assert np.isfinite(mode(force)(jnp.zeros((2, 2)))).all()


def test_dashpots_across_a_period():
    """On a ring, relative velocity is a plain difference: a velocity is not wrapped by the period."""
    net = js.lattice(4, periodic=True, box=(4.0,))
    v = np.array([[0.0], [0.0], [0.0], [10.0]])
    force = js.Dashpots(net, 1.0).force(js.State.from_points(net, net.grid(), v))
    np.testing.assert_allclose(force.x, [10.0, 0.0, 10.0, -20.0])


def test_gravity_weighs_each_node(moving):
    """Weight m g with the system's masses; the force is minus the gradient of the energy."""
    net, state, m = moving
    g = np.array([0.1, 0.2, -9.81])
    system = js.System(net, m, js.Gravity(g))
    np.testing.assert_allclose(flat(net, system.force(state)), m[:, None] * g, rtol=1e-15)
    np.testing.assert_allclose(flat(net, system.acceleration(state)), np.broadcast_to(g, (12, 3)), rtol=1e-15)
    gradient = jax.grad(lambda x: system.energy(js.State.from_points(net, x)).total)(state.points)
    np.testing.assert_allclose(gradient, -m[:, None] * g, rtol=1e-14)


def test_loads_constant_and_in_time(moving, rng):
    """A constant load is what was given, with energy -f . x; a function of time is taken at the state's time."""
    net, state, _ = moving
    push = rng.normal(size=(12, 3))
    load = js.Load.from_points(net, push)
    np.testing.assert_array_equal(flat(net, load.force(state)), push)
    assert load.energy(state) == pytest.approx(-(push * np.asarray(state.points)).sum())
    growing = js.Load(lambda t: t * load.value)
    later = js.State.from_points(net, state.points, time=2.5)
    np.testing.assert_array_equal(flat(net, growing.force(later)), 2.5 * push)
    assert growing.energy(later) is None


@pytest.mark.parametrize(
    ("stepper", "error"), [(js.SymplecticEuler(), 1e-2), (js.VelocityVerlet(), 1e-4), (js.RungeKutta4(), 1e-9)], ids=repr
)
def test_a_load_in_time_drives_the_right_motion(stepper, error):
    """A free mass under f = sin t follows x = t - sin t: each stage of a step reads the load at its own time (dt = 0.01)."""
    net = js.lattice(1)
    system = js.System(net, 1.0, js.Load(lambda t: js.Vector((jnp.sin(t)[None],))))
    result = js.rollout(system, js.State.from_points(net, [[0.0]]), stepper, dt=1e-2, n_steps=200)
    assert result.state.points[0, 0] == pytest.approx(2 - np.sin(2), abs=error)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.Drag(-1.0), "gamma = -1.0"),
        (lambda: js.Drag([0.0, np.inf]), r"gamma\[1\] = inf"),
        (lambda: js.Dashpots(js.lattice(3), [1.0, -1.0]), r"damping\[1\] = -1.0"),
        (lambda: js.Gravity(9.81), "acceleration has shape"),
        (lambda: js.Gravity([0, np.nan]), r"acceleration\[1\] = nan"),
        (lambda: js.Load.from_points(js.lattice(3), np.ones((2, 3))), "forces has shape"),
        (lambda: js.Gravity([0, -9.81]).force(js.State.from_points(js.lattice(1), [[0.0, 0.0]])), "no masses"),
        (lambda: js.Gravity([0, -9.81], 1.0).force(js.State.from_points(js.lattice(1), [[0.0]])), "2 coordinates"),
        (lambda: js.Load(lambda t: t).force(js.State.from_points(js.lattice(1), [[0.0]])), "a load must be a Vector"),
    ],
)
def test_wrong_loads_are_refused(make, message):
    """Each wrong constant or shape is a ValueError that names it."""
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("value", [np.ones((3, 2)), jnp.ones((3, 2)), [[1.0, 0.0]], None])
def test_a_load_that_is_no_vector(value):
    """An array of forces is refused when the load is built, and pointed to `from_points`."""
    with pytest.raises(TypeError, match=r"expected a Vector .* Load.from_points\(net, forces\)"):
        js.Load(value)
