"""Floors: a block on an incline, what is held, what is pushed off, and every way to pass the numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice(2)
GROUND, UP = (0.0, 0.0), (0.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=lambda s: type(s).__name__)
def test_a_block_on_an_incline(stepper):
    """It holds where tan a <= mu, to the last digit; else it slides with g (sin a - mu cos a) along the slope, and not off it."""
    g, slope, time = 9.81, np.radians(20.0), 1.0
    down, normal = np.array([np.cos(slope), -np.sin(slope)]), np.array([np.sin(slope), np.cos(slope)])

    def end(mu):
        system = js.System(NET, 1.0, js.Gravity((0.0, -g)), rules=js.Floor(GROUND, normal, mu, 0.3))
        start = js.State.from_points(NET, [[0.0, 0.0], list(2.0 * down)])
        state = js.rollout(system, start, stepper, time / 200, 200).state
        return state.points, state.velocities

    mu = np.array([0.0, 0.2, 0.35, 0.37, 1.0])  # tan 20 degrees is 0.364
    points, velocities = (np.asarray(a) for a in jax.jit(jax.vmap(end))(mu))
    moved = np.asarray(points) - np.array([[[0.0, 0.0], 2.0 * down]])
    rate = g * np.maximum(np.sin(slope) - mu * np.cos(slope), 0)
    np.testing.assert_allclose(velocities @ down, np.broadcast_to((rate * time)[:, None], (5, 2)), atol=1e-9)
    order = 1.01 * rate.max() * time / 400 if isinstance(stepper, js.SymplecticEuler) else 1e-9
    np.testing.assert_allclose(moved @ down, np.broadcast_to((0.5 * rate * time**2)[:, None], (5, 2)), atol=order)
    np.testing.assert_allclose(moved[3:], 0, atol=1e-12)
    np.testing.assert_allclose(moved @ normal, 0, atol=1e-13)
    np.testing.assert_allclose(velocities @ normal, 0, atol=1e-13)


@pytest.mark.slow
def test_what_is_held_takes_no_part():
    """Below a plane or on it, held and scheduled nodes stay as they are; one that is held along x bounces along y alone."""
    net = js.lattice(4)
    points = [[0.0, -1.0], [1.0, 0.2], [2.0, 0.5], [3.0, 0.5]]
    free = np.array([[False, False], [True, True], [False, True], [True, True]])
    path = js.Motion(jnp.array([False, True, False, False]), lambda t: js.Vector((jnp.ones(4), 0.2 - t * jnp.ones(4))))
    slope = np.array([0.6, 0.8])
    system = js.System(net, 1.0, js.Gravity((0.0, -10.0)), free, path, rules=js.Floor((2.0, 0.0), slope, 0.0, 0.5))
    start = js.State.from_points(net, points)
    run = js.rollout(system, start, js.VelocityVerlet(), 0.01, 60)
    assert run.state.points[0].tolist() == points[0]
    np.testing.assert_allclose(run.state.points[1], [1.0, -0.4], atol=1e-12)
    # Along y alone: it falls 0.5 m to the plane under x = 2 and comes back with half of its speed.
    fall = np.sqrt(2 * 0.5 / 10)
    left = 0.6 - fall
    np.testing.assert_allclose(run.state.points[2], [2.0, 0.5 * 10 * fall * left - 5 * left**2], atol=1e-9)
    # The free node above the slope is thrown along the normal.
    assert run.state.points[3, 0] > 3.1


@pytest.mark.slow
def test_a_node_at_rest_is_pushed_off():
    """A node that a spring will lift rests until the spring pulls more than the weight, then rises with it; its gradient wakes with it."""
    pair = js.lattice(2)
    free = np.array([False, True])

    def end(lift, stiffness):
        path = js.Motion(jnp.array([True, False]), lambda t: js.Vector((0.5 + lift * t * jnp.ones(2),)))
        forces = (js.Springs(pair, stiffness, 0.5), js.Gravity((-10.0,)), js.Drag(2.0))
        system = js.System(pair, 1.0, forces, free, path, rules=js.Floor((0.0,), (1.0,)))
        start = js.State.from_points(pair, [[0.5], [0.0]])
        state = js.rollout(system, start, js.VelocityVerlet(), 0.01, 200).state
        return state.position.x[1]

    f = jax.jit(jax.value_and_grad(end, argnums=(0, 1)))
    # The spring pulls 100 lift t: below the weight of 10 until t = 2 s.
    low, slope = f(jnp.asarray(0.049), jnp.asarray(100.0))
    assert float(low) == 0
    np.testing.assert_array_equal(slope, 0)
    high, slope = f(jnp.asarray(1.0), jnp.asarray(100.0))
    assert 1.5 < float(high) < 2.2
    h = 1e-4
    central = [(f(1.0 + h, 100.0)[0] - f(1.0 - h, 100.0)[0]) / (2 * h), (f(1.0, 100.0 + h)[0] - f(1.0, 100.0 - h)[0]) / (2 * h)]
    np.testing.assert_allclose(slope, central, rtol=1e-3)


@pytest.mark.slow
def test_constants_of_a_floor_may_be_traced(dtype):
    """Point, normal, restitution and friction under jit, grad and vmap: gradients agree with differences, of a node that friction holds
    on the slope too; with dt = 0 they are finite.
    """

    def end(c, dt):
        floor = js.Floor(c[:2], c[2:4], c[4], c[5])
        system = js.System(NET, 1.0, js.Gravity(jnp.asarray([0.0, -10.0], dtype)), rules=floor)
        start = js.State.from_points(NET, jnp.asarray([[0.0, 0.5], [1.0, 0.0]], dtype), jnp.asarray([[1.0, 0.0], [1.0, 0.0]], dtype))
        return js.rollout(system, start, js.VelocityVerlet(), dt, 32).state.points[0].sum()

    # Point, normal, friction, restitution: one that bounces, one that comes to rest.
    given = np.array([[0.0, 0.1, 0.1, 1.0, 0.05, 0.6], [0.0, 0.1, 0.1, 1.0, 0.6, 0.05]])
    h = 1e-6
    rows = np.concatenate([given, given, *(c + s * h * np.eye(6) for c in given for s in (1, -1))])
    dt = np.where(np.isin(np.arange(28), (2, 3)), 0.0, 0.0125)
    f = jax.jit(jax.vmap(jax.value_and_grad(end, argnums=(0, 1))))
    values, (slopes, by_dt) = f(jnp.asarray(rows, dtype), jnp.asarray(dt, dtype))
    assert values.dtype == dtype
    assert np.all(np.isfinite(slopes))
    np.testing.assert_array_equal(values[2:4], 0.5)
    np.testing.assert_array_equal(slopes[2:4], 0)
    np.testing.assert_allclose(by_dt[2:4], 32.0)  # of the position, by n dt: the velocity
    if dtype == np.float64:
        up, down = np.asarray(values)[4:].reshape(2, 2, 6).transpose(1, 0, 2)
        np.testing.assert_allclose(slopes[:2], (up - down) / (2 * h), rtol=1e-6, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("curved", [False, True], ids=["planes", "any obstacle"])
def test_where_a_slide_stops(curved):
    """At v^2 / (2 mu g), within a step and over many, short of a wall or thrown back by it with e; and so its derivatives."""
    mu, e, g, dt = 0.5, 0.5, 10.0, 0.05
    ground = js.contact.SignedDistance(lambda x, t: x[1], reads_time=False) if curved else js.contact.Plane(GROUND, UP)
    rules = (js.contact.Contact(ground, mu), js.contact.Contact(js.contact.Plane((0.0, 0.0), (1.0, 0.0)), 0.0, e))
    speed = np.array([0.1, 0.1, 0.1, 0.2, 1.03, 1.03])
    way = speed**2 / (2 * mu * g)
    gap = way * np.array([0.5, 0.9, 1.1, 3.0, 0.7, 1.2])
    net = js.lattice(6)
    system = js.System(net, 1.0, js.Gravity((0.0, -g)), rules=rules)

    def places(gap, speed):
        flat = jnp.zeros_like(gap)
        start = js.State.from_points(net, jnp.stack([gap, flat], 1), jnp.stack([-speed, flat], 1))
        return js.rollout(system, start, js.VelocityVerlet(), dt, 8).state.points[:, 0]

    stops = np.where(gap > way, gap - way, e * e * (way - gap))
    along = np.random.default_rng(3).normal(size=(2, 6))
    found, turned = jax.jit(lambda *at: jax.jvp(places, at, tuple(along)))(gap, speed)
    np.testing.assert_allclose(found, stops, rtol=1e-6)
    np.testing.assert_allclose(turned, np.where(gap > way, 1.0, -e * e) * (along[0] - along[1] * speed / (mu * g)), rtol=1e-5)
