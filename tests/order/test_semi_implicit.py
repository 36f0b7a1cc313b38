"""`SemiImplicit`: damping of any strength in an otherwise explicit step; its order, its limit, its derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

TIGHT = js.JaxCG(tolerance=1e-12)
CHEAP = js.JaxCG(tolerance=1e-12, preconditioner=js.linalg.Unpreconditioned())  # to compile


def chain(*damping):
    """A crumpled chain of four nodes in the plane, one end pinned and the other on a rail, with these dampers."""
    rng = np.random.default_rng(5)
    net = js.lattice(4)
    points = 0.1 * rng.normal(size=(4, 2)) + np.array([[1.0, 0.0]]) * np.arange(4.0)[:, None]
    free = np.ones((4, 2), bool)
    free[0], free[3, 1] = False, False
    forces = (js.Springs(net, 20.0, 0.9), *(make(net) for make in damping))
    start = js.State.from_points(net, points, np.where(free, rng.normal(size=(4, 2)), 0.0))
    return js.System(net, np.arange(1.0, 5.0), forces, free=free), start


def drag(net, gamma=0.8):
    return js.Drag(gamma * np.arange(1.0, 5.0))


def dashpots(net, damping=0.7):
    return js.Dashpots(net, damping)


@pytest.mark.slow
def test_error_falls_as_dt():
    """Halving dt halves the distance from a fine Runge-Kutta run, on a nonlinear net with pins, drag and dashpots."""
    system, start = chain(drag, dashpots)

    def end(stepper, n_steps):
        step, state = eqx.filter_jit(stepper.step), start
        memory = stepper.init(system, start)
        for _ in range(n_steps):
            state, memory = step(system, state, jnp.asarray(0.4 / n_steps), memory)
        return state.points

    exact = end(js.RungeKutta4(), 200)
    coarse, fine = (float(jnp.max(jnp.abs(end(js.SemiImplicit(TIGHT), n) - exact))) for n in (80, 160))
    assert np.log2(coarse / fine) == pytest.approx(1, abs=0.1)


def test_c2_drag_that_doubles_an_explicit_step_dies_out():
    """With gamma = 3000, m = 1, dt = 1e-3: the explicit velocity doubles in each step, this one is divided by 1 + gamma dt / m."""
    net = js.lattice(2)
    system = js.System(net, 1.0, js.Drag(3000.0))
    start = js.State.from_points(net, [[0.0], [1.0]], [[1.0], [2.0]])
    assert jnp.isinf(js.stable_dt(system, start, js.SemiImplicit()))
    run = js.rollout(system, start, js.SemiImplicit(), 1e-3, 10)
    np.testing.assert_allclose(run.state.velocities[:, 0], np.array([1.0, 2.0]) * 0.25**10, rtol=1e-12)
    assert run.info.solves is None
    with pytest.warns(js.StabilityWarning, match="DT_LIMIT"):
        explicit = js.rollout(system, start, js.SymplecticEuler(), 1e-3, 10)
    np.testing.assert_allclose(explicit.state.velocities[:, 0], np.array([1.0, 2.0]) * 2.0**10, rtol=1e-12)


def test_the_limit_is_that_of_the_undamped_springs():
    """`stable_dt` knows no damping here, and with dashpots far above it a run at the limit loses energy, which its solves report."""
    system, start = chain()
    limit = js.stable_dt(system, start)
    damped, _ = chain(lambda net: drag(net, 3000.0), lambda net: dashpots(net, 3000.0))
    assert js.stable_dt(damped, start, js.SemiImplicit()) == limit
    assert js.stable_dt(damped, start) < 0.1 * limit  # where damping is taken at the old velocity
    run = js.rollout(damped, start, js.SemiImplicit(js.CG()), limit, 20)
    js.raise_for_status(run)
    assert 0 < damped.energy(run.state).total < damped.energy(start).total
    assert int(run.info.solves.iterations) > 0
    assert float(run.info.solves.residual) <= 1e-8


def test_damping_that_names_no_blocks_still_limits():
    """A force of the user's that gives its damping's bound but no blocks is taken at the old velocity, and lowers the limit."""

    class Wind(js.Force):
        def force(self, state):
            return -(30.0 * state.velocity)

        def damping_bound(self, state):
            return jnp.asarray(30.0, state.dtype)

    system, start = chain(lambda net: Wind())
    assert js.stable_dt(system, start, js.SemiImplicit()) == js.stable_dt(system, start, js.SymplecticEuler())


@pytest.mark.slow
def test_one_step_with_dashpots_is_the_dense_solve():
    """(M + dt G) dv = dt f over the free coordinates by NumPy, G and f by derivatives of the force; held coordinates stay bit for bit."""
    system, start = chain(drag, dashpots)
    free, h = np.stack([np.asarray(m).ravel() for m in system.free], axis=1).ravel(), 0.3

    def force(v):
        return jnp.stack(system.force(js.State.from_points(system.net, start.points, v.reshape(4, 2))).components, axis=-1).ravel()

    g = -np.asarray(jax.jacfwd(force)(start.velocities.ravel()))[np.ix_(free, free)]
    m = np.repeat(np.asarray(system.mass).ravel(), 2)[free]
    dv = np.zeros(8)
    dv[free] = np.linalg.solve(np.diag(m) + h * g, h * np.asarray(force(start.velocities.ravel()))[free])
    end = js.rollout(system, start, js.SemiImplicit(js.Skyline(system.net)), h, 1).state
    np.testing.assert_allclose(end.velocities, start.velocities + dv.reshape(4, 2), atol=1e-10)
    np.testing.assert_array_equal(end.points[~free.reshape(4, 2)], start.points[~free.reshape(4, 2)])


def test_dashpots_feel_a_moved_node_at_its_new_velocity():
    """A node that hangs on a moved one by a dashpot of any strength follows at once; zero dt changes nothing."""
    net = js.lattice(2)
    motion = js.Motion(jnp.array([True, False]), lambda t: js.Vector((jnp.array([1.0, 0.0]) * t * t,)))
    system = js.System(net, 1.0, js.Dashpots(net, 1e9), motion=motion)
    start = js.State.from_points(net, [[0.0], [1.0]])
    run = js.rollout(system, start, js.SemiImplicit(TIGHT), 0.1, 5)
    np.testing.assert_allclose(run.state.velocities[:, 0], [1.0, 1.0], rtol=1e-7)
    still = js.rollout(system, start, js.SemiImplicit(TIGHT), 0.0, 5)
    np.testing.assert_array_equal(still.state.points, start.points)
    assert bool(still.status.is_ok)


def test_a_run_that_breaks_says_where():
    """A load that becomes infinite at the third step: NONFINITE, the step, the node and the effect, though it is solved for."""
    net = js.lattice(3)
    load = js.Load(lambda t: js.Vector((jnp.where(t > 0.15, jnp.array([0.0, jnp.inf, 0.0]), 0.0),)))
    system = js.System(net, 1.0, (js.Dashpots(net, 1.0), load))
    run = js.rollout(system, js.State.from_points(net, net.grid()), js.SemiImplicit(), 0.1, 4)
    assert bool(run.status.has(js.Flag.NONFINITE))
    assert (int(run.status.step), int(run.status.effect)) == (3, 1)


@pytest.mark.slow
def test_reverse_forward_and_differences_agree():
    """Gradients by the strengths of drag and dashpots, in both modes, against central differences over a batch."""

    def loss(c):
        system, start = chain(lambda net: drag(net, c), lambda net: dashpots(net, c))
        return jnp.sum(js.rollout(system, start, js.SemiImplicit(CHEAP), 0.05, 2).state.position.y ** 2)

    c, h = 3.0, 1e-3
    batch = jax.jit(jax.vmap(loss))(c + h * jnp.array([-2.0, -1.0, 1.0, 2.0]))
    reverse = float(jax.jit(jax.grad(loss))(c))
    assert reverse == pytest.approx(float(jax.jit(lambda c: jax.jvp(loss, (c,), (1.0,))[1])(c)), rel=1e-9)
    assert reverse == pytest.approx(float(batch @ jnp.array([1.0, -8.0, 8.0, -1.0]) / (12 * h)), rel=1e-7)
