"""What strangers ran into with contact: friction on what does not slide yet, and small obstacles far along a long step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

c = js.contact
ONE = js.Graph.from_edges(np.zeros((0, 2), int), 1)
GROUND = {
    "floor": lambda mu, e: js.Floor((0.0, 0.0), (0.0, 1.0), mu, e),
    "ball": lambda mu, e: c.Contact(c.Sphere((0.0, -1.0), 1.0), mu, e),
    "box": lambda mu, e: c.Contact(c.Box((0.0, -1.0), (9.0, 1.0)), mu, e),
}


def ended(rule, start, pull, stepper, n_steps=40):
    """Place and speed along the ground after steps of 10 ms from (x, y, vx) under (gx, -10)."""
    x, y, vx = start
    zero = jnp.zeros_like(vx)
    state = js.State.from_points(ONE, jnp.stack([x + zero, y + zero])[None], jnp.stack([vx, zero])[None])
    run = js.rollout(js.System(ONE, 1.0, js.Gravity(jnp.stack([pull, zero - 10.0])), rules=rule), state, stepper, 0.01, n_steps)
    return jnp.stack([run.state.points[0, 0], run.state.velocities[0, 0]])


@pytest.mark.slow
def test_dropped_straight_down_friction_stops_any_small_speed():
    """Friction takes all of a small speed along a ball: so the derivative by that speed says, also where it is zero. On a ball of radius
    1 the node lands 0.3 m per m/s aside, and bounces off as the normal there turns: from dx/dv = t = 0.3 s to 0.3 + 0.45 * 0.1.
    """

    def end(vx):
        return ended(GROUND["ball"](0.5, 0.5), (0.0, 0.45, vx), jnp.zeros_like(vx), js.VelocityVerlet())

    both = jax.jit(lambda vx: (end(vx), jax.jacrev(end)(vx)))
    difference = (both(1e-5)[0] - both(-1e-5)[0]) / 2e-5
    np.testing.assert_allclose(difference, (0.345, 0.45), atol=1e-9)
    np.testing.assert_allclose(both(0.0)[1], (0.345, 0.45), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ground", "stepper", "slopes"),
    [
        ("floor", js.VelocityVerlet(), jax.jacrev),
        ("box", js.SymplecticEuler(), jax.jacfwd),
    ],
)
def test_what_rests_within_the_cone_has_no_derivative(ground, stepper, slopes):
    """A node at rest stays, whatever small push or speed along the ground it has: v^2 / (2 mu g) has no slope at v = 0."""

    def end(push):
        return ended(GROUND[ground](0.5, 0.0), (0.0, 0.0, push[1]), push[0], stepper)

    np.testing.assert_array_equal(jax.jit(slopes(end))(jnp.zeros(2)), 0.0)


@pytest.mark.parametrize("obstacle", [c.Sphere((0.0, 0.0, 0.0), 1e-3), c.Capsule((0.0, -5.0, 0.0), (0.0, 5.0, 0.0), 1e-3)])
@pytest.mark.parametrize("dt", [0.02, 0.3])
def test_no_fast_node_passes_a_ball_of_a_millimetre(obstacle, dt):
    """4,000 nodes aimed at it, at 5 to 5,000 m/s, to its very edge: each bounces as a line meets a ball, v - (1 + e) (n . v) n."""
    n, radius, e = 4000, 1e-3, 0.5
    rng = np.random.default_rng(0)
    aside, speed = rng.uniform(0.0, 1.0, n) * radius, rng.uniform(5, 5000, n)
    points = np.c_[aside, np.zeros(n), rng.uniform(1.0, 1.5, n)]
    velocities = np.c_[np.zeros((n, 2)), -speed]
    normal = np.c_[aside / radius, np.zeros(n), np.sqrt(1 - (aside / radius) ** 2)]
    exact = velocities - (1 + e) * (normal * velocities).sum(axis=1, keepdims=True) * normal
    net = js.Graph.from_edges(np.zeros((0, 2), int), n)
    system = js.System(net, 1.0, rules=c.Contact(obstacle, restitution=e))
    run = js.rollout(system, js.State.from_points(net, points, velocities), js.VelocityVerlet(), dt, 20)
    arrives = speed * 20 * dt > points[:, 2] + radius
    assert arrives.sum() > 1500
    np.testing.assert_allclose(
        np.asarray(run.state.velocities)[arrives] / speed[arrives, None], (exact / speed[:, None])[arrives], atol=1e-6
    )
