"""Hard cases K3 to K5: nodes moved by a schedule, arrays of one entry, derivatives that steps used to lose."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxspring as js

CHAIN = js.lattice(3)
SHAKEN = js.Motion(jnp.array([True, False, False]), lambda t: js.Vector((jnp.stack([jnp.sin(5 * t), 0 * t, 0 * t]),)))
ORDERS = [
    (js.ForwardEuler(), 1),
    (js.SymplecticEuler(), 1),
    (js.VelocityVerlet(), 2),
    (js.RungeKutta4(), 4),
    (js.SemiImplicit(), 1),
    (js.BackwardEuler(), 1),
    (js.BackwardEuler(newton=True), 1),
    (js.ImplicitMidpoint(), 2),
    (js.ImplicitMidpoint(newton=False), 2),
    (js.BDF2(), 2),
]


@pytest.fixture(scope="module")
def shaken():
    """(T, [x1, x2, v1, v2]): where two nodes are that hang by springs and dashpots on one that moves as sin(5 t), by SciPy."""

    def slope(t, y):
        x, v = np.array([np.sin(5 * t), *y[:2]]), np.array([5 * np.cos(5 * t), *y[2:]])
        # Springs of 9 N/m, dashpots of 1 N s/m, Rayleigh damping of 0.05 s, drag of 0.5 N s/m.
        pull = 9 * (np.diff(x) - 1) + (1 + 0.05 * 9) * np.diff(v)
        return [*y[2:], pull[1] - pull[0] - 0.5 * y[2], -pull[1] - 0.5 * y[3]]

    return solve_ivp(slope, (0, 0.4), [1.0, 2.0, 0.0, 0.0], rtol=1e-12, atol=1e-13, method="DOP853").y[:, -1]


@pytest.mark.slow
@pytest.mark.parametrize(("stepper", "order"), ORDERS, ids=lambda p: type(p).__name__ if isinstance(p, js.Stepper) else str(p))
def test_k3_a_moved_node_costs_no_order(stepper, order, shaken):
    """Springs, dashpots, Rayleigh damping and drag beside a moved node: halving dt divides the error by 2**order."""
    forces = (js.Springs(CHAIN, 9.0, 1.0), js.Dashpots(CHAIN, 1.0), js.Rayleigh(0.0, 0.05), js.Drag(0.5))
    system = js.System(CHAIN, 1.0, forces, motion=SHAKEN)
    start = js.State.from_points(CHAIN, [[0.0], [1.0], [2.0]])

    def error(n):
        end = js.rollout(system, start, stepper, 0.4 / n, n).state
        return np.max(np.abs(np.concatenate([end.points[1:, 0], end.velocities[1:, 0]]) - shaken))

    n = 40 if isinstance(stepper, js.ForwardEuler) else 20  # below its limit
    assert np.log2(error(n) / error(2 * n)) == pytest.approx(order, abs=0.2)


SOLVERS = [js.JaxCG(), js.CG(), js.JaxCG(preconditioner=js.linalg.Unpreconditioned())]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("stepper", [js.BackwardEuler(s) for s in SOLVERS] + [js.BackwardEuler(newton=True)], ids=range(4))
def test_k4_one_node_falls_as_two_do(stepper, dtype):
    """Backward Euler: y = y0 - g dt^2 n (n + 1) / 2, status OK, and dy/dg that closed form's."""

    def height(g, n_nodes):
        net = js.Graph.from_edges(np.zeros((0, 2), int), n_nodes)
        start = js.State.from_points(net, jnp.stack([jnp.arange(n_nodes, dtype=dtype), jnp.ones(n_nodes, dtype)], axis=1))
        run = js.rollout(js.System(net, 1.0, js.Gravity(jnp.stack([jnp.zeros((), dtype), -g]))), start, stepper, 0.01, 3)
        return run.state.position.y[0], run.status

    for n_nodes in (1, 2):
        (y, status), slope = jax.value_and_grad(height, has_aux=True)(jnp.asarray(9.81, dtype), n_nodes)
        assert status.describe() == "OK"
        assert y == pytest.approx(1 - 9.81 * 6e-4, rel=1e-6)
        assert slope == pytest.approx(-6e-4, rel=1e-5)


@pytest.mark.parametrize("is_jitted", [False, True], ids=["eager", "jit"])
def test_k4_one_number_is_solved_for(is_jitted):
    """3 x = b, for a hundred b: x, the residual and the status."""
    solve = lambda b: js.CG().solve(lambda x: 3.0 * x, b)  # noqa: E731
    for b in np.random.default_rng(1).normal(size=(100, 1)):
        x, info = (jax.jit(solve) if is_jitted else solve)(jnp.asarray(b))
        np.testing.assert_allclose(x, b / 3, rtol=1e-12)
        assert bool(info.status.is_ok)
        if not is_jitted:
            break


@pytest.mark.parametrize(
    "scheme", [js.thermal.ExplicitHeat(), js.thermal.BackwardEulerHeat(), js.thermal.CrankNicolsonHeat()], ids=lambda s: type(s).__name__
)
def test_k4_one_node_is_heated(scheme):
    """6 W into 3 J/K for 0.5 s: one kelvin, by every scheme."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    heat = js.Heat(net, 3.0, np.zeros(0), scheme, source=6.0)
    run = js.rollout(js.System(net, 1.0, rules=heat), js.State.from_points(net, [[0.0]], temperature=300.0), js.Still(), 0.1, 5)
    assert run.status.describe() == "OK"
    np.testing.assert_allclose(run.state.temperature, 301.0, rtol=1e-12)


def test_a_norm_is_right_for_every_size():
    """|(3, 4) s| = 5 s where neither overflows nor underflows; its gradient too; zero, infinity and NaN stay what they are."""
    from jaxspring.linalg.iterative import norm

    for dtype, sizes in ((jnp.float32, (1e-37, 1e-20, 1e-13, 1.0, 1e19, 1e37)), (jnp.float64, (1e-305, 1e-150, 1.0, 1e154, 1e307))):
        for size in sizes:
            value, slope = jax.value_and_grad(norm)(jnp.asarray([3, 4], dtype) * jnp.asarray(size, dtype))
            assert float(value) / (5 * size) == pytest.approx(1, rel=1e-6)
            np.testing.assert_allclose(slope, [0.6, 0.8], rtol=1e-5)
        assert norm(jnp.zeros(2, dtype)) == 0
        assert norm(jnp.asarray([jnp.inf, 1], dtype)) == jnp.inf
        assert jnp.isnan(norm(jnp.asarray([jnp.nan, 1], dtype)))


def _pulled(stepper, dt, stiffness=9.0):
    """Position and velocity of the middle of three nodes after three steps."""
    forces = (js.Springs(CHAIN, stiffness, 1.0), js.Drag(0.5))
    start = js.State.from_points(CHAIN, [[0.0], [1.2], [2.0]], [[0.0], [0.7], [0.0]])
    system = js.System(CHAIN, 1.0, forces, free=np.array([False, True, False]))
    end = js.rollout(system, start, stepper, dt, 3).state
    return jnp.stack([end.points[1, 0], end.velocities[1, 0]])


@pytest.mark.slow
@pytest.mark.parametrize(
    "stepper", [js.SemiImplicit(), js.BackwardEuler(), js.BackwardEuler(newton=True), js.BDF2()], ids=["semi", "linear", "newton", "bdf2"]
)
def test_k5_dt_of_zero_has_a_derivative(stepper):
    """d(x, v)/ddt = 3 (v, a) after three steps of dt = 0, in reverse and forward mode; lanes of several dt are single runs."""
    force = -9 * 0.2 + 9 * (-0.2) - 0.5 * 0.7
    wanted = [3 * 0.7, 3 * force]
    np.testing.assert_allclose(jax.jit(jax.jacrev(lambda dt: _pulled(stepper, dt)))(0.0), wanted, rtol=1e-6)
    lanes, slopes = jax.jit(jax.vmap(lambda dt: jax.jvp(lambda t: _pulled(stepper, t), (dt,), (1.0,))))(jnp.array([0.0, 0.02]))
    np.testing.assert_allclose(slopes[0], wanted, rtol=1e-6)
    np.testing.assert_array_equal(lanes[0], [1.2, 0.7])
    np.testing.assert_allclose(lanes[1], _pulled(stepper, 0.02), rtol=1e-9)


@pytest.mark.slow
def test_k5_jacobians_of_newton_steps_are_those_of_the_equations():
    """A chain of three nodes 1.1 m apart, k = 50: dx/dk of one backward Euler step by hand, with jacfwd, jacrev and batched tangents."""
    net = js.lattice(3)
    start, system = js.State.from_points(net, net.grid(1.1)), js.System(net, 1.0, js.Springs(net, 50.0, 1.0))

    def end(k):
        return js.rollout(js.replace(system, stiffness=k), start, js.BackwardEuler(newton=True), 0.01, 1).state.points.ravel()

    # The outer nodes move by u towards the middle: u = dt^2 k (0.1 - u), so du/dk = dt^2 0.1 / (1 + dt^2 k)^2.
    slope = 1e-5 / (1 + 1e-4 * 50) ** 2
    forward = np.asarray(jax.jacfwd(end)(50.0))
    np.testing.assert_allclose(forward, [slope, 0, -slope], atol=1e-6 * slope)
    np.testing.assert_allclose(jax.jacrev(end)(50.0), forward, atol=1e-6 * slope)


def _loops(program, name="while"):
    """How many loops a program holds, the rules of derivatives and what is never run apart."""
    count = 0
    for equation in program.eqns:
        count += equation.primitive.name == name
        for value in equation.params.values():
            for inner in value if isinstance(value, (tuple, list)) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                count += _loops(inner, name) if hasattr(inner, "eqns") else 0
    return count


@pytest.mark.slow
def test_a_backward_pass_repeats_no_newton_iteration():
    """With `StoreStates`, a gradient holds the loops of one forward run and of one linear solve, which are fewer."""

    def end(k, adjoint):
        system = js.System(CHAIN, 1.0, js.Springs(CHAIN, k, 1.0))
        start = js.State.from_points(CHAIN, [[0.0], [1.2], [2.0]])
        return jnp.sum(js.rollout(system, start, js.BackwardEuler(newton=True), 0.1, 4, adjoint=adjoint).state.points ** 2)

    forward = _loops(jax.make_jaxpr(lambda k: end(k, js.StoreStates()))(9.0).jaxpr)
    gradient = _loops(jax.make_jaxpr(jax.grad(lambda k: end(k, js.StoreStates())))(9.0).jaxpr)
    assert forward < gradient < 2 * forward
