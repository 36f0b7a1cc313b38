"""Hard cases L1 and L3: a bounce is right in value, energy and derivative for every stepper; corners in every order of their planes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice(2)  # without springs, unless a test adds one: the second node tells that nodes do not mix
GROUND, UP = (0.0, 0.0), (0.0, 1.0)


def exact(h, v, e, g, floor, duration):
    """Height of a ball after this time, bounce by bounce; takes complex numbers, whose imaginary part carries a derivative."""
    s, left = h - floor, duration
    while True:
        root = np.sqrt(v * v + 2 * g * s)
        t = 2 * s / (root - v) if np.real(v) < 0 else (v + root) / g if np.real(g) > 0 else np.inf
        if np.real(t) >= np.real(left):
            return floor + s + v * left - g * left * left / 2
        s, v, left = 0.0 * s, -e * (v - g * t), left - t
        if np.real(g) > 0 and np.real(2 * v / g) <= np.real(left * (1 - e)):
            return floor


def exact_derivatives(p):
    return [exact(*(x + 1e-30j * (i == j) for i, x in enumerate(p))).imag / 1e-30 for j in range(len(p))]


def height(p, stepper, n_steps, drag=None):
    """The same by rollout."""
    h, v, e, g, floor, duration = (p[i] for i in range(6))
    nought = jnp.zeros_like(h)
    forces = [js.Gravity(jnp.stack([nought, -g]))]
    forces += [] if drag is None else [js.Drag(drag)]
    start = js.State.from_points(
        NET, jnp.stack([nought, h, nought + 3.0, h + 50.0]).reshape(2, 2), jnp.stack([nought, v] * 2).reshape(2, 2)
    )
    system = js.System(NET, 1.0, forces, rules=js.Floor(jnp.stack([nought, floor]), UP, restitution=e))
    return js.rollout(system, start, stepper, duration / n_steps, n_steps).state.position.y[0]


# h0, v0, e, g, floor, T
CASES = {
    "up first": (1.0, 0.3, 0.8, 10.0, 0.0, 0.75),
    "keeps all, six bounces": (1.0, 0.0, 1.0, 10.0, 0.25, 4.6),
    "half": (1.0, -0.5, 0.5, 10.0, -0.4, 1.1),
    "in the first step": (1e-3, -1.0, 0.7, 10.0, 0.0, 0.15),
    "in the last step": (1.0, 0.0, 0.6, 10.0, 0.0, 0.449),
    "two in the last step": (1.0, 0.0, 0.5, 10.0, 0.0, 1.33),
    "no weight": (0.333, -1.0, 0.6, 0.0, 0.0, 1.0),
    "from the plane": (0.0, 2.0, 0.9, 10.0, 0.0, 0.7),
    "into the plane": (0.0, -2.0, 0.9, 10.0, 0.0, 0.2),
    "comes to rest": (1.0, 0.0, 0.2, 10.0, 0.3, 1.0),
    "stops": (1.0, 0.0, 0.0, 10.0, 0.3, 1.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.VelocityVerlet(), js.RungeKutta4(), js.ImplicitMidpoint()], ids=lambda s: type(s).__name__)
def test_l1_a_bounce_in_closed_form(stepper):
    """L1: height and its derivatives by h0, v0, e, g, the floor's height and T are those of the motion, by whole steps of any place."""
    inputs = np.array(list(CASES.values()))
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda p: height(p, stepper, 75))))(inputs)
    for name, p, value, slope in zip(CASES, inputs, values, slopes, strict=True):
        np.testing.assert_allclose(value, exact(*p).real, atol=1e-9, err_msg=name)
        np.testing.assert_allclose(slope, exact_derivatives(p), atol=1e-9, rtol=1e-9, err_msg=name)


@pytest.mark.slow
def test_l1_symplectic_euler_is_of_order_one():
    """L1: an eighth of dt brings the errors of value and derivatives to about an eighth."""
    inputs = np.array([CASES["up first"], CASES["keeps all, six bounces"], CASES["half"]])
    error = []
    for n_steps in (250, 2000):
        values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda p, n=n_steps: height(p, js.SymplecticEuler(), n))))(inputs)
        right = np.array([exact(*p).real for p in inputs]), np.array([exact_derivatives(p) for p in inputs])
        error.append((np.abs(values - right[0]), np.abs(slopes - right[1]).max(axis=1)))
    for coarse, fine in zip(*error, strict=True):
        assert np.all(coarse / fine > 4)


HIGH = [js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4(), js.ImplicitMidpoint(), js.BDF2()]


@pytest.mark.slow
@pytest.mark.parametrize("stepper", HIGH, ids=lambda s: type(s).__name__)
def test_l1_a_ball_keeps_its_height(stepper):
    """L1: restitution 1, 20 s in steps of 0.01 s: the ball still rises to 1 m within 2 mm, and implicit steps raise no alarm."""
    system = js.System(NET, 1.0, js.Gravity((0.0, -9.81)), rules=js.Floor(GROUND, UP, restitution=1.0))
    start = js.State.from_points(NET, [[0.0, 1.0], [2.0, 1.0]])
    run = js.rollout(system, start, stepper, 1e-2, 2000, save_every=1, observe=lambda s: s.position.y)
    js.raise_for_status(run)
    np.testing.assert_allclose(run.saved[-200:].max(axis=0), 1.0, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=lambda s: type(s).__name__)
def test_l1_balls_come_to_rest(stepper, dtype):
    """L1: balls of restitution 0 to 0.8 are at rest after 10 s, exactly on the plane; derivatives are finite, and 0 by the height."""

    def end(e, h):
        system = js.System(NET, 1.0, js.Gravity((0.0, -9.81)), rules=js.Floor(GROUND, UP, restitution=e))
        start = js.State.from_points(NET, jnp.stack([0 * h, h, 0 * h + 3, 2 * h]).reshape(2, 2))
        run = js.rollout(system, start, stepper, 1e-2, 1000)
        return run.state.position.y.sum(), (run.state.position.y, run.state.velocity.y)

    e = jnp.asarray([0.0, 0.2, 0.5, 0.8], dtype)
    slope, (y, v) = jax.jit(jax.vmap(jax.grad(end, argnums=(0, 1), has_aux=True), in_axes=(0, None)))(e, jnp.asarray(1.0, dtype))
    assert np.all(y == 0)
    np.testing.assert_allclose(v, 0, atol=0)
    np.testing.assert_array_equal(slope[1], 0)
    assert np.all(np.isfinite(slope[0]))


# Highly accurate numbers by an integrator with events: at T the height, and its derivatives by h0, v0, e, g and the last parameter.
SPRING = (1.686645, [0.517733, 0.078249, 0.028879, -0.071796, -0.030487])  # k = 30 about height 1, g = 5, h0 = 1, v0 = -8, e = 0.7, T = 0.7
DRAG = 0.527925  # by h0: drag 1.5, h0 = 1, v0 = -1, e = 0.8, g = 10, T = 0.75


@pytest.mark.slow
def test_l1_with_a_spring():
    """L1: with a spring to the ceiling, values are of order 2 and derivatives by h0, v0, e, g and k of order 1, to the known numbers."""
    pair = js.lattice(2)
    free = np.array([False, True])

    def end(p, n_steps):
        h, v, e, g, k = (p[i] for i in range(5))
        nought = jnp.zeros_like(h)
        # Rest length 0 from the held node at height 1: a spring about height 1.
        start = js.State.from_points(pair, jnp.stack([nought + 1.0, h])[:, None], jnp.stack([nought, v])[:, None])
        forces = (js.Springs(pair, k, 0.0), js.Gravity(-g[None]))
        system = js.System(pair, 1.0, forces, free, rules=js.Floor((0.0,), (1.0,), restitution=e))
        return js.rollout(system, start, js.VelocityVerlet(), 0.7 / n_steps, n_steps).state.position.x[1]

    value, slope = jax.jit(jax.value_and_grad(lambda p: end(p, 1400)))(jnp.array([1.0, -8.0, 0.7, 5.0, 30.0]))
    assert value == pytest.approx(SPRING[0], abs=1e-5)
    np.testing.assert_allclose(slope, SPRING[1], atol=1e-3)


@pytest.mark.slow
def test_l1_with_drag():
    """L1: a damper's force changes at the impact: without that the derivative by the height would be -0.19 at every dt."""
    p = jnp.array([1.0, -1.0, 0.8, 10.0, 0.0, 0.75])
    slope = jax.jit(jax.grad(lambda p: height(p, js.VelocityVerlet(), 1500, drag=1.5)))(p)
    assert slope[0] == pytest.approx(DRAG, abs=2e-3)


class AirDrag(js.Force):
    """-c |v| v: a force of one's own that names no damping."""

    coefficient: jax.Array

    def force(self, state):
        return -self.coefficient * state.velocity.norm() * state.velocity


@pytest.mark.slow
def test_l1_with_a_drag_of_ones_own():
    """L1: with quadratic drag and no weight, height and derivatives by h0, |v0|, e and c against the closed form, of order one in dt."""
    duration = 0.7

    def end(p, n_steps):
        h, v, e, c = p
        start = js.State.from_points(NET, jnp.stack([h, h + 9])[:, None], jnp.stack([-v, -v])[:, None])
        system = js.System(NET, 1.0, AirDrag(c), rules=js.Floor((0.0,), (1.0,), restitution=e))
        return js.rollout(system, start, js.VelocityVerlet(), duration / n_steps, n_steps).state.position.x[0]

    def right(p):
        h, v, e, c = p
        return jnp.log(1 + c * e * v * jnp.exp(-c * h) * (duration - (jnp.exp(c * h) - 1) / (c * v))) / c

    p = tuple(map(jnp.asarray, (0.5, 3.0, 0.8, 0.9)))
    value, slope = jax.jit(jax.value_and_grad(lambda p: end(p, 700)))(p)
    np.testing.assert_allclose(value, right(p), atol=1e-5)
    np.testing.assert_allclose(slope, jax.grad(right)(p), atol=3e-3)


@pytest.mark.slow
def test_l1_two_joined_by_a_dashpot():
    """L1: the impact of one of two nodes that a dashpot joins changes the force on both: places and derivatives against closed forms."""
    pair, duration, c, e = js.lattice(2), 1.0, 0.9, 0.7

    def end(p, n_steps):
        start = js.State.from_points(pair, jnp.stack([p[0], p[1]])[:, None], jnp.stack([p[2], p[3]])[:, None])
        system = js.System(pair, 1.0, js.Dashpots(pair, c), rules=js.Floor((0.0,), (1.0,), restitution=e))
        return js.rollout(system, start, js.VelocityVerlet(), duration / n_steps, n_steps).state.position.x

    def flown(x, v, t):
        mean, half = (v[0] + v[1]) / 2, (v[0] - v[1]) / 2
        decay = np.exp(-2 * c * t)
        way = half * (1 - decay) / (2 * c)
        return (x[0] + mean * t + way, x[1] + mean * t - way), (mean + half * decay, mean - half * decay)

    def right(p):
        t = 0.3
        for _ in range(30):
            x, v = flown(p[:2], p[2:], t)
            t = t - x[0] / v[0]
        x, v = flown(p[:2], p[2:], t)
        return np.array(flown((0.0 * t, x[1]), (-e * v[0], v[1]), duration - t)[0])

    p = np.array([0.6, 1.5, -2.0, -0.5])
    derivatives = np.stack([right(p + 1e-30j * np.eye(4)[i]).imag / 1e-30 for i in range(4)], axis=1)
    error = []
    for n_steps in (100, 800):
        f = jax.jit(lambda p, n=n_steps: (end(p, n), jax.jacfwd(lambda p: end(p, n))(p)))
        value, slopes = f(jnp.asarray(p))
        error.append((np.abs(value - right(p)).max(), np.abs(slopes - derivatives).max()))
    assert error[1][0] < 1e-5
    assert error[1][1] < 3e-3
    assert error[0][1] / error[1][1] > 4


@pytest.mark.slow
def test_a_floor_that_is_far_changes_no_bit():
    """Where nothing meets a floor, the states are those without it, to the last bit, with Verlet and damping too."""
    net = js.lattice(5)
    forces = (js.Springs(net, 30.0, 0.9), js.Dashpots(net, 0.5), AirDrag(jnp.asarray(0.1)), js.Gravity((0.3, -9.81)))
    start = js.State.from_points(net, np.c_[np.arange(5.0), np.zeros(5)], np.eye(5, 2))
    ends = [
        js.rollout(js.System(net, 1.0, forces, rules=rules), start, js.VelocityVerlet(), 0.01, 50).state.points
        for rules in ((), js.Floor((0.0, -50.0), UP))
    ]
    np.testing.assert_array_equal(*ends)


def thrown(normals, order, n_steps=60, restitution=0.8, dt=0.02, velocity=None, size=1.0):
    """Places and velocities of 40 nodes thrown about between planes through the origin, given in this order; and the run."""
    normals = np.asarray(normals)
    rng = np.random.default_rng(7)
    net, dim = js.lattice(40), normals.shape[1]
    down = -np.eye(dim)[-1]
    inward = normals.sum(axis=0) / np.linalg.norm(normals.sum(axis=0))
    points = rng.uniform(0.3, 1.0, (40, 1)) * inward + rng.normal(scale=1e-3, size=(40, dim))
    start = js.State.from_points(net, size * points, rng.normal(size=(40, dim)) if velocity is None else np.zeros((40, dim)))
    floors = tuple(js.Floor(np.zeros(dim), normals[i], restitution=restitution + 0.1 * i) for i in order)
    system = js.System(net, 1.0, js.Gravity(9.81 * down), rules=floors)
    return js.rollout(system, start, js.VelocityVerlet(), dt, n_steps)


def wedge(angle):
    """Normals of two planes that stand at this angle [degrees], their opening upward."""
    half = np.radians(angle) / 2
    return [[np.cos(half), np.sin(half)], [-np.cos(half), np.sin(half)]]


CORNERS = {
    "60 degrees": wedge(60.0),
    "90 degrees": wedge(90.0),
    "150 degrees": wedge(150.0),
    "three in space": [[1.0, 0.0, 0.2], [-0.5, 0.8, 0.3], [-0.4, -0.9, 0.1]],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CORNERS)
def test_l3_the_order_of_the_planes_does_not_matter(name):
    """L3: in every order of two and three planes the states are the same, to the last bit, and no node is below a plane."""
    normals = np.array(CORNERS[name])
    runs = [thrown(normals, order) for order in itertools.permutations(range(len(normals)))]
    unit = normals / np.linalg.norm(normals, axis=1)[:, None]
    assert np.min(runs[0].state.points @ unit.T) > -1e-12
    moved = np.abs(np.asarray(runs[0].state.velocities)).max()
    assert moved > 0.1
    for run in runs[1:]:
        np.testing.assert_array_equal(run.state.points, runs[0].state.points)
        np.testing.assert_array_equal(run.state.velocities, runs[0].state.velocities)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["60 degrees", "90 degrees", "three in space"])
def test_l3_a_corner_holds(name):
    """L3: what is dropped into a corner ends in its point, at rest, and stays there without a word from the status."""
    order = range(len(CORNERS[name]))
    run = thrown(CORNERS[name], order, n_steps=1500, restitution=0.1, velocity=0)
    np.testing.assert_allclose(run.state.points, 0, atol=1e-6)
    np.testing.assert_allclose(run.state.velocities, 0, atol=1e-6)
    assert bool(run.status.is_ok)
    # In two planes no step holds more impacts than are followed; falling into three may, which is a warning.
    assert len(order) == 3 or int(run.status.flags) == 0
    rest = thrown(CORNERS[name], order, n_steps=5, restitution=0.1, velocity=0, size=0.0)
    np.testing.assert_allclose(rest.state.points, 0, atol=1e-15)
    assert int(rest.status.flags) == 0


@pytest.mark.slow
def test_l3_more_impacts_than_are_followed_are_counted():
    """L3: in a narrow corner a step would hold dozens of impacts: the nodes stay inside, finite, and the status counts them."""
    run = thrown(wedge(4.0), (0, 1), n_steps=3, dt=0.5)
    assert bool(run.status.has(js.Flag.IMPACTS))
    assert int(run.status.count) > 1
    assert bool(run.status.is_ok)  # a warning
    assert np.min(run.state.points @ np.array(wedge(4.0)).T) > -1e-9
    with pytest.warns(js.StabilityWarning, match="lower dt"):
        js.raise_for_status(run)


@pytest.mark.slow
def test_l3_a_box_in_closed_form():
    """L3: without weight a square box of restitution 1 unfolds into straight flight: places and derivatives of many impacts per step."""
    walls = tuple(js.Floor(p, n, restitution=1.0) for p, n in [((0, 0), (1, 0)), ((0, 0), (0, 1)), ((1, 1), (-1, 0)), ((1, 1), (0, -1))])
    net = js.lattice(7)
    points, velocities = np.random.default_rng(3).uniform(0.1, 0.9, (2, 7, 2))
    velocities = 8 * velocities - 3

    def end(points, velocities):
        start = js.State.from_points(net, points, velocities)
        run = js.rollout(js.System(net, 1.0, rules=walls), start, js.SymplecticEuler(), 0.25, 8)
        return run.state.points, run.state.velocities

    straight = points + 2.0 * velocities
    cell = np.floor(straight)
    sign = np.where(cell % 2 == 0, 1.0, -1.0)
    (x, v), (dx, dv) = jax.jit(lambda p, v: jax.jvp(end, (p, v), (jnp.ones_like(p), 2.0 * jnp.ones_like(v))))(points, velocities)
    np.testing.assert_allclose(x, np.where(sign > 0, straight - cell, 1 + cell - straight), atol=1e-9)
    np.testing.assert_allclose(v, sign * velocities, atol=1e-12)
    np.testing.assert_allclose(dx, sign * 5.0, atol=1e-9)  # 1 + T 2
    np.testing.assert_allclose(dv, sign * 2.0, atol=1e-9)
