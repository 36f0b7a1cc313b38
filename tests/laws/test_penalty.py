"""Penalty contact: energy, matrices, rest, bounce, friction, belts, derivatives, in every kind of run."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests.reference import central_difference

c = js.contact
ONE = js.lattice(1)
UP, GROUND = (0.0, 1.0), (0.0, 0.0)


def rows(v):
    return np.stack([np.asarray(a) for a in v], axis=-1)


def points_about(obstacle, dim, n=40):
    """Places just inside and just outside of an obstacle."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.5, 1.5, (4000, dim))
    d = np.asarray(obstacle.distance(js.Vector(tuple(jnp.asarray(a) for a in x.T)), jnp.asarray(0.0)))
    near = x[np.abs(d) < 0.2]
    return near[:n], rng.normal(size=(n, dim))


def saddle(x, t):
    """Bent both ways, with a gradient that is not of length one."""
    return 2 * x.z - x.x * x.x + 0.5 * x.y * x.y


AROUND = {
    "sphere": (c.Sphere((0.0, 0.0, 0.0), 1.0), 3),
    "bowl": (c.SignedDistance(lambda x, t: 1.0 - x.norm(), reads_time=False), 3),
    "capsule": (c.Capsule((0.0, 0.0, 0.0), (0.7, 0.0, 0.0), 0.6), 3),
    "saddle": (c.SignedDistance(saddle, reads_time=False), 3),
    "disc": (c.Sphere((0.0, 0.0), 1.0), 2),
    "slope": (c.Plane((0.0, 0.0, 0.0), (1.0, 2.0, 2.0)), 3),
}


@pytest.mark.parametrize("name", AROUND)
def test_force_and_matrices_are_derivatives(name):
    """The push is minus the gradient of the energy; the exact blocks are minus its derivative; those of the default are positive, and equal
    to the exact ones where the surface bends the other way; damper and friction have the blocks of their derivative by the velocity.
    """
    obstacle, dim = AROUND[name]
    x, v = points_about(obstacle, dim)
    net = js.Graph.from_edges(np.zeros((0, 2), int), len(x))
    state = js.State.from_points(net, x, v)
    elastic = js.System(net, 1.0, c.Penalty(obstacle, 300.0, onset=0.05))
    rough = js.System(net, 1.0, c.Penalty(obstacle, 300.0, 4.0, 0.6, 0.05, 1.5))

    @jax.jit
    def all_of(state):
        def at(x):
            return state.moved(x, state.velocity)

        def moved(v):
            return state.moved(state.position, v)

        energy = jax.grad(lambda x: elastic.energy(at(x)).total)(state.position)
        _, by_place = jax.jvp(lambda x: elastic.force(at(x)), (state.position,), (state.velocity,))
        _, by_velocity = jax.jvp(lambda v: rough.force(moved(v)), (state.velocity,), (state.position,))
        exact = elastic.stiffness_blocks(state, js.steppers.ExactTangent())
        clamped = elastic.stiffness_blocks(state, js.steppers.Tangent())
        damping = rough.damping_blocks(state)
        return (
            (elastic.force(state), energy, by_place, by_velocity, exact.product(state.velocity), damping.product(state.position)),
            [elastic.matrix(b, state).node_blocks() for b in (exact, clamped, damping)],
        )

    (force, energy, by_place, by_velocity, exact, damped), matrices = all_of(state)
    np.testing.assert_allclose(rows(force), -rows(energy), atol=1e-10)
    np.testing.assert_allclose(rows(exact), -rows(by_place), atol=1e-9)
    np.testing.assert_allclose(rows(damped), -rows(by_velocity), atol=1e-9)
    k, clamped, g = (np.stack([rows(row) for row in m], axis=-1) for m in matrices)
    assert np.linalg.eigvalsh(clamped).min() > -1e-10
    assert np.linalg.eigvalsh(g).min() > -1e-10
    assert (np.linalg.norm(k, axis=(1, 2)) > 1).sum() > 5  # some touch
    if name == "bowl":
        np.testing.assert_allclose(clamped, k, atol=1e-9)
    if name in ("sphere", "capsule", "disc"):
        assert np.linalg.eigvalsh(k).min() < -1  # the exact block of a ball is not positive
    if name == "saddle":
        # Of the bend across the normal, exactly the positive part.
        n = np.stack([-2 * x[:, 0], x[:, 1], 2 * np.ones(len(x))], axis=-1)
        across = np.eye(3) - n[:, :, None] * n[:, None] / (n * n).sum(axis=1)[:, None, None]
        bend = across @ k @ across
        values, vectors = np.linalg.eigh(bend)
        positive = np.einsum("nik,nk,njk->nij", vectors, np.maximum(values, 0), vectors)
        np.testing.assert_allclose(across @ clamped @ across, positive, atol=1e-9)


@pytest.mark.slow
def test_at_rest_as_deep_as_the_load_asks():
    """In `equilibrium` a weight stands at m g / k + w / 2 below the surface, and at the top of a ball too; its derivatives are those of the
    formula, and -1 by the radius. The dt of one node alone is 2 sqrt(m / k).
    """
    net = js.lattice(1)

    def depth(k, radius):
        ball = c.Penalty(c.Sphere((0.0, -radius), radius), k, onset=0.01)
        # Held along x: on the top of a ball nothing stands by itself.
        system = js.System(net, 2.0, (ball, js.Gravity((0.0, -10.0))), free=jnp.array([[False, True]]))
        found = js.equilibrium(system, js.State.from_points(net, [[0.0, 0.0]]))
        return -found.state.position.y[0], found.status

    value, by = jax.jit(jax.value_and_grad(lambda k, r: depth(k, r)[0], argnums=(0, 1)))(jnp.asarray(500.0), jnp.asarray(3.0))
    np.testing.assert_allclose(value, 20 / 500 + 0.005, rtol=1e-8)
    np.testing.assert_allclose(by, (-20 / 500**2, 0.0), atol=1e-10)
    system = js.System(net, 2.0, c.Penalty(c.Plane(GROUND, UP), 500.0))
    state = js.State.from_points(net, [[0.0, 5.0]])
    np.testing.assert_allclose(js.stable_dt(system, state), 2 * np.sqrt(2 / 500))


def bounce(k, damping, onset, dt, n_steps, stepper, h0=0.1):
    """Height and speed of a ball of 1 kg dropped at 1 m/s without weight, and its status."""
    ground = c.Penalty(c.Plane(GROUND, UP), k, damping, onset=onset)
    system = js.System(ONE, 1.0, ground)
    start = js.State.from_points(ONE, jnp.stack([0 * h0, h0])[None], [[0.0, -1.0]])
    run = js.rollout(system, start, stepper, dt, n_steps)
    return run.state.position.y[0], run.state.velocity.y[0], run.status


def test_a_bounce():
    """Without damper the speed comes back, and the derivative of the height by the start is -1; with one the restitution is
    exp(-pi z / sqrt(1 - z**2)) of the damping ratio z as the onset gets short; each in one compiled program for all cases.
    """
    k, dt, n = 2000.0, 2e-4, 2000

    @jax.jit
    @jax.vmap
    def all_of(damping, onset):
        of_height = jax.value_and_grad(lambda h: bounce(k, damping, onset, dt, n, js.VelocityVerlet(), h)[0])
        return (*bounce(k, damping, onset, dt, n, js.VelocityVerlet()), of_height(jnp.asarray(0.1))[1])

    ratio = np.array([0.0, 0.1, 0.3])
    _, v, status, slope = all_of(2 * ratio * np.sqrt(k), np.array([5e-3, 2e-4, 2e-4]))
    assert (np.asarray(status.flags) == 0).all()
    np.testing.assert_allclose(v[0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(slope[0], -1.0, rtol=1e-3)
    np.testing.assert_allclose(v[1:], np.exp(-np.pi * ratio / np.sqrt(1 - ratio**2))[1:], rtol=2e-2)


def test_implicit_steps_far_above_the_limit():
    """Newton's backward Euler at eight times the explicit limit: a ball that falls comes to rest where its weight asks, with no
    alarm.
    """
    k = 1e5
    system = js.System(ONE, 1.0, (c.Penalty(c.Plane(GROUND, UP), k, onset=1e-4), js.Gravity((0.0, -10.0))))
    start = js.State.from_points(ONE, [[0.0, 0.1]])
    assert js.stable_dt(system, start) < 0.05 / 7.9
    run = js.rollout(system, start, js.BackwardEuler(newton=True), 0.05, 80)
    assert int(run.status.flags) == 0
    np.testing.assert_allclose(run.state.position.y, -(10 / k + 5e-5), rtol=1e-6)
    np.testing.assert_allclose(run.state.velocity.y, 0, atol=1e-6)


def test_energy_never_rises():
    """Of 30 balls thrown at a disc in every way, with damper and friction, none has more energy later than earlier."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    ground = c.Penalty(c.Sphere((0.0, 0.0), 1.0), 800.0, 6.0, 0.5, 0.02, 0.1)
    system = js.System(net, 1.0, ground)
    rng = np.random.default_rng(5)

    def energies(x, v):
        run = js.rollout(system, js.State.from_points(net, x[None], v[None]), js.VelocityVerlet(), 5e-4, 2000, save_every=20)
        return jax.vmap(lambda state: system.energy(state).total)(run.saved)

    angle = rng.uniform(0, 2 * np.pi, 30)
    x = 1.05 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    found = np.asarray(jax.jit(jax.vmap(energies))(x, -3 * x + rng.normal(size=(30, 2))))
    assert (found[:, -1] < 0.9 * found[:, 0]).sum() > 20
    assert np.diff(found, axis=1).max() < 1e-6 * found.max()


def slide(friction, creep=1e-3):
    """Speed along a slope of 20 degrees after 0.5 s, from rest."""
    slope = np.radians(20.0)
    normal = np.array([np.sin(slope), np.cos(slope)])
    ground = c.Penalty(c.Plane(GROUND, normal), 1000.0, 40.0, friction, onset=1e-2, creep=creep)
    system = js.System(ONE, 1.0, (ground, js.Gravity((0.0, -10.0))))
    start = js.State.from_points(ONE, [-(10 * np.cos(slope) / 1000 + 5e-3) * normal])
    run = js.rollout(system, start, js.SemiImplicit(), 1e-3, 500)
    return run.state.velocities[0] @ np.array([np.cos(slope), -np.sin(slope)]), run.status


def test_a_block_on_an_incline():
    """It creeps slower than `creep` where tan a <= mu; else it slides with g (sin a - mu cos a): the cone of Coulomb."""
    mu = np.array([0.0, 0.2, 0.35, 0.40, 1.0])  # tan 20 degrees is 0.364
    speed, _ = jax.jit(jax.vmap(slide))(mu)
    a = np.radians(20.0)
    np.testing.assert_allclose(speed[:3], 0.5 * 10 * (np.sin(a) - mu[:3] * np.cos(a)), rtol=1e-3, atol=1e-3)
    assert (np.abs(speed[3:]) < 1e-3).all()
    # The share y of the creep at which friction 2 y - y**2 balances the pull.
    np.testing.assert_allclose(speed[3:], 1e-3 * (1 - np.sqrt(1 - np.tan(a) / mu[3:])), rtol=1e-4)


def test_a_belt_drags_and_a_piston_lifts():
    """A plane that moves along itself brings a node to its speed by friction, at the deceleration mu g; one that rises carries it up."""
    belt = c.Penalty(c.Moving(c.Plane(GROUND, UP), lambda t: jnp.stack([2.0 * t, 0.1 * t])), 1000.0, 40.0, 0.5, onset=1e-2, creep=1e-2)
    system = js.System(ONE, 1.0, (belt, js.Gravity((0.0, -10.0))))
    start = js.State.from_points(ONE, [[0.0, -0.015]], [[0.0, 0.1]])
    run = js.rollout(system, start, js.SemiImplicit(), 1e-3, 600, save_every=200)
    np.testing.assert_allclose(run.saved.velocity.x[0, 0], 0.5 * 10 * 0.2, rtol=1e-2)
    np.testing.assert_allclose(run.state.velocities[0], [2.0, 0.1], atol=1e-3)
    assert system.forces[0].energy(start) is None  # the belt feeds energy in
    assert system.forces[0].can_feed


CHAIN = js.lattice(4)
LINE = np.c_[0.3 * np.arange(4) - 0.4, 1.1 * np.ones(4)]


def draped(radius, stiffness, stepper, dt, n_steps):
    """Mean height of a chain that falls on a disc."""
    forces = (
        js.Springs(CHAIN, 200.0, 0.3),
        js.Drag(0.2),
        js.Gravity((0.0, -10.0)),
        c.Penalty(c.Sphere((0.05, 0.0), radius), stiffness, 1.0, 0.3, onset=0.02, creep=0.1),
    )
    run = js.rollout(js.System(CHAIN, 0.1, forces), js.State.from_points(CHAIN, LINE), stepper, dt, n_steps)
    return jnp.mean(run.state.position.y), run.status


@pytest.mark.slow
def test_derivatives_of_a_run():
    """Through implicit steps of one linear solve, damper and friction and the bend of a disc in the matrix, the derivative by radius and
    stiffness is that of central differences; `vmap` gives each lane's own; the obstacle is an argument of one compiled program.
    """
    n_traces = 0

    def height(radius, stiffness):
        nonlocal n_traces
        n_traces += 1
        return draped(radius, stiffness, js.BackwardEuler(), 4e-3, 75)[0]

    both = jax.jit(jax.vmap(jax.value_and_grad(height, argnums=(0, 1))))
    h = 1e-5
    radius = jnp.array([1.0, 1.0 + h, 1.0 - h, 1.0, 1.0])
    stiffness = jnp.array([400.0, 400.0, 400.0, 400.0 + 400 * h, 400.0 - 400 * h])
    z, (by_radius, by_stiffness) = both(radius, stiffness)
    both(radius + 0.1, stiffness)
    assert n_traces == 1
    assert z[0] > 0.9
    np.testing.assert_allclose(by_radius[0], (z[1] - z[2]) / (2 * h), rtol=1e-5)
    np.testing.assert_allclose(by_stiffness[0], (z[3] - z[4]) / (800 * h), rtol=1e-4)


@pytest.mark.slow
def test_in_diffrax_as_in_rollout():
    """`diffeqsolve` with tight tolerances ends where small steps of Runge and Kutta do."""
    ground = c.Penalty(c.Sphere((0.0, -1.0), 1.0), 500.0, 3.0, 0.4, onset=0.05, creep=0.2)
    system = js.System(ONE, 1.0, (ground, js.Gravity((0.0, -10.0))))
    start = js.State.from_points(ONE, [[0.1, 0.2]], [[0.5, 0.0]])
    fine = js.rollout(system, start, js.RungeKutta4(), 2.5e-4, 2000).state.points
    adaptive = js.diffeqsolve(system, start, 0.5)
    js.raise_for_status(adaptive)
    np.testing.assert_allclose(adaptive.state.points, fine, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "match", "build"),
    [
        (TypeError, "obstacle is 3, a int; expected a Obstacle", lambda: c.Penalty(3, 1.0)),
        (ValueError, "stiffness = -1.0, but must be zero or more. A negative stiffness pulls", lambda: c.Penalty(c.Plane(GROUND, UP), -1)),
        (ValueError, r"friction = -1.0, but must be zero or more. It would feed", lambda: c.Penalty(c.Plane(GROUND, UP), 1, friction=-1)),
        (ValueError, "onset = 0.0, but must be positive", lambda: c.Penalty(c.Plane(GROUND, UP), 1, onset=0)),
        (ValueError, "creep = -1.0, but must be positive", lambda: c.Penalty(c.Plane(GROUND, UP), 1, friction=1, creep=-1)),
        (
            ValueError,
            "the plane has 2 coordinates, the positions have 3",
            lambda: c.Penalty(c.Plane(GROUND, UP), 1).force(js.State.from_points(ONE, [[0.0, 0.0, 0.0]])),
        ),
    ],
)
def test_bad_constants_are_refused_by_name(kind, match, build):
    """Each says what is wrong, where, and what to do."""
    with pytest.raises(kind, match=match):
        build()


def test_constants_that_went_bad_later_are_invalid():
    """A radius that turned negative, a stiffness that is NaN, an onset of zero: `invalid` tells, as every run asks before it starts."""
    good = c.Penalty(c.Sphere((0.0, -1.0), 1.0), 500.0)
    assert not bool(good.invalid())
    for where, value in ((lambda p: p.obstacle.radius, -1.0), (lambda p: p.law.stiffness, jnp.nan), (lambda p: p.law.onset, 0.0)):
        assert bool(eqx.tree_at(where, good, jnp.asarray(value)).invalid())


def test_replace_reaches_every_constant():
    """`js.replace` finds stiffness, radius and the others, and gives them to the constructor that checks."""
    system = js.System(ONE, 1.0, c.Penalty(c.Sphere((0.0, -1.0), 1.0), 500.0, 1.0))
    new = js.replace(system, stiffness=7.0, radius=2.0, onset=0.5)
    assert [float(a) for a in (new.forces[0].law.stiffness, new.forces[0].obstacle.radius, new.forces[0].law.onset)] == [7.0, 2.0, 0.5]
    with pytest.raises(ValueError, match="radius = -2"):
        js.replace(system, radius=-2.0)


def test_the_law_is_smooth():
    """Push, energy, grip and friction and their first derivatives have no jump at the onset, at the surface and at the creep speed."""
    law = c.Penalty(c.Plane(GROUND, UP), 1.0, 1.0, 1.0, onset=0.1, creep=0.2).law
    for at in (0.0, 0.1):
        for function in (law.push, law.energy, law.grip):
            below, above = (central_difference(lambda s, f=function: f(jnp.asarray(s)), at + e, 1e-7) for e in (-2e-7, 2e-7))
            assert abs(below - above) < 2e-4
    for s in (0.03, 0.2):
        np.testing.assert_allclose(central_difference(lambda s: law.energy(jnp.asarray(s)), s, 1e-6), law.push(jnp.asarray(s)), rtol=1e-6)
        np.testing.assert_allclose(central_difference(lambda s: law.push(jnp.asarray(s)), s, 1e-6), law.slope(jnp.asarray(s)), rtol=1e-6)
    for v in (0.05, 0.2, 0.4):
        share = central_difference(lambda v: v * law.drag(jnp.asarray(v)), v, 1e-7)
        np.testing.assert_allclose(share, law.drag_slope(jnp.asarray(v)), atol=1e-5)
    assert float(law.drag(jnp.asarray(0.4)) * 0.4) == 1.0
