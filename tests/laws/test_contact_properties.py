"""Laws of contact, whatever is drawn: energy never rises, friction keeps to its cone, nothing goes inside, bodies keep their momentum."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

N, STEPS, G = 6, 80, 10.0
NODES = js.Graph.from_edges(np.zeros((0, 2), int), N)
RADIUS = 0.5


@jax.jit
def thrown(points, velocities, slope, friction, restitution, dt):
    """Nodes thrown at a slope and a disc: places, velocities, impulses and distances after each step, whether all was well, and waited."""
    normal = jnp.stack([jnp.sin(slope), jnp.cos(slope)])
    floor = js.Floor(0 * normal, normal, friction[0], restitution[0])
    disc = js.contact.Contact(js.contact.Sphere(0.3 * normal, RADIUS), friction[1], restitution[1])
    system = js.System(NODES, 1.0, js.Gravity((0.0, -G)), rules=(floor, disc, js.contact.Impulses()))

    def look(state):
        given = js.contact.impulses(system, state)
        sizes = jnp.stack([jnp.stack([i.normal.norm(), i.friction.norm()]) for i in given])
        return state.points, state.velocities, sizes, jnp.stack([floor.height(state), disc.distance(state)])

    run = js.rollout(system, js.State.from_points(NODES, points, velocities), js.VelocityVerlet(), dt, STEPS, save_every=1, observe=look)
    return run.saved, run.status.is_ok, run.status.has(js.Flag.IMPACTS)


part = st.floats(0.0, 1.0)


@pytest.mark.slow
@hypothesis.given(st.integers(0, 2**31), st.floats(-0.6, 0.6), st.tuples(part, part), st.tuples(part, part), st.floats(0.002, 0.03))
# In the wedge between both a node is braked short of the disc.
@hypothesis.example(989821581, 0.5770024065314762, (0.65045927, 0.68844673), (0.38892142, 0.1350965), 0.021195175565459447)
@hypothesis.example(485126280, -0.5785302949236296, (0.19111027, 0.97553297), (0.10747722, 0.45208878), 0.018239165055794655)
@hypothesis.settings(max_examples=60)
def test_no_contact_feeds_energy_in(seed, slope, friction, restitution, dt):
    """A slope and a disc on it, friction 0 to 1, restitution 0 to 1, any dt: no node's energy rises, friction is at most mu times the
    normal impulse of each obstacle in each step (on the disc both to the order of a step), and nobody is inside by 10 micrometres, or
    by 1 mm where the status says that a node had to wait in the wedge.
    """
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1.5, 1.2], [1.5, 3.0], (N, 2))
    velocities = rng.normal(0, 2.0, (N, 2))
    inputs = (np.array(v, float) for v in (slope, friction, restitution, dt))
    (x, v, given, distances), is_ok, waited = thrown(points, velocities, *inputs)
    assert bool(is_ok)
    x, v, given = (np.asarray(a) for a in (x, v, given))
    energy = 0.5 * np.sum(v**2, axis=-1) + G * x[..., 1]
    scale = np.abs(energy[0]).max() + 1
    # On the disc the slide of a step is of order 2 in the angle that it turns.
    turned = np.max(np.sum(v**2, axis=-1)) * (dt / RADIUS) ** 2
    assert np.max(np.diff(energy, axis=0)) <= (1e-12 + 1e-3 * turned) * scale
    over = np.max(given[:, :, 1] - np.array(friction)[:, None] * given[:, :, 0], axis=(0, 2))
    assert over[0] <= 1e-12 * scale
    assert over[1] <= 1e-12 * scale + 0.05 * turned
    assert np.min(distances) >= (-1e-3 if waited else -1e-5)


BODIES = js.Graph.from_edges(np.concatenate([[(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)], [(4, 5), (5, 6), (6, 4)]]), 7)
SHAPE = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [2.2, 0.1], [3.1, 0.2], [2.6, 1.0]]) * 0.5


@jax.jit
def collided(velocities, mass, friction, dt):
    """Two bodies of springs that meet: momenta before and after, and how much the faster one slowed down."""
    apart = js.contact.NodeContact(BODIES, 0.27, 2e3, onset=0.05, damping=1.0, friction=friction, creep=0.1)
    system = js.System(BODIES, mass, (js.Springs(BODIES, 5e3, BODIES.lengths(SHAPE)), apart))
    start = js.State.from_points(BODIES, SHAPE, velocities)
    run = js.rollout(system, start, js.VelocityVerlet(), dt, 200)
    push = jnp.max(jnp.abs(run.state.velocities - velocities))
    return system.momentum(start), system.momentum(run.state), push, run.status.is_ok


@pytest.mark.slow
@hypothesis.given(st.integers(0, 2**31), st.floats(0.0, 1.0), st.floats(2e-4, 1e-3))
@hypothesis.settings(max_examples=20)
def test_bodies_that_meet_keep_their_momentum(seed, friction, dt):
    """To rounding, with unequal masses, damper and friction, at any dt."""
    rng = np.random.default_rng(seed)
    velocities = rng.normal(0, 0.3, (7, 2)) + np.array([[4.0, 0.0]] * 4 + [[-4.0, 0.0]] * 3)
    mass = rng.uniform(0.5, 2.0, 7)
    before, after, push, is_ok = collided(velocities, mass, np.array(friction), np.array(dt))
    assert bool(is_ok)
    assert push > 0.1
    np.testing.assert_allclose(after, before, atol=1e-12 * np.abs(mass @ np.abs(velocities)).max() * 200)
