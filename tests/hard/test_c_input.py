"""Hard cases of input and geometry that need an implicit step: A3, A5, A12, A13, B6, C9 and C12."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag
from tests.hard.test_c_implicit import LIMIT, cloth

IMPLICIT = [js.BackwardEuler(), js.BackwardEuler(newton=True), js.ImplicitMidpoint(), js.BDF2()]
each_stepper = pytest.mark.parametrize("stepper", IMPLICIT, ids=["BackwardEuler", "Newton", "ImplicitMidpoint", "BDF2"])


@each_stepper
def test_a3_implicit_without_springs(stepper):
    """Two free nodes without springs coast: x = v t, status OK, nothing to iterate."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 2)
    start = js.State.from_points(net, np.zeros((2, 3)), np.ones((2, 3)))
    run = js.rollout(js.System(net, 1.0, js.Springs(net, 100.0, 1.0)), start, stepper, 1.0, 1)
    assert int(run.status.flags) == Flag.OK
    np.testing.assert_array_equal(run.state.points, 1.0)


def test_a5_implicit_lone_node():
    """A node without a spring, beside a chain of ten at rest, moves by v dt exactly."""
    net = js.Graph.from_edges([(i, i + 1) for i in range(9)], 11)
    points, velocities = np.c_[np.arange(11.0), np.zeros((11, 2))], np.zeros((11, 3))
    velocities[10, 1] = 1
    system = js.System(net, 1.0, js.Springs(net, 100.0, 1.0))
    run = js.rollout(system, js.State.from_points(net, points, velocities), js.BackwardEuler(), 0.1, 1)
    assert int(run.status.flags) == Flag.OK
    np.testing.assert_array_equal(run.state.points[10], [10, 0.1, 0])
    np.testing.assert_array_equal(run.state.points[:10], points[:10])


def test_a12_implicit_negative_stiffness():
    """Negative stiffness: the exact matrix is called indefinite, but not where dt = 0 asks for no solve; the clamped one drops the spring's
    part: the step of its force alone.
    """
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.0], [1.5]])
    system = js.System(net, 1.0, js.Springs(net, -10.0, 1.0, allow_negative_stiffness=True))
    exact = js.rollout(system, start, js.BackwardEuler(stiffness=js.steppers.ExactTangent()), 1.0, 1)
    assert bool(exact.status.has(Flag.CG_INDEFINITE))
    assert int(js.rollout(system, start, js.BackwardEuler(stiffness=js.steppers.ExactTangent()), 0.0, 1).status.flags) == Flag.OK
    clamped = js.rollout(system, start, js.BackwardEuler(), 1.0, 1)
    assert bool(clamped.status.is_ok)
    # a = -k (r - l) / m = 5 m/s^2 outward on either node, one second long.
    np.testing.assert_allclose(clamped.state.points[:, 0], [-5.0, 6.5], rtol=1e-12)


@each_stepper
def test_a13_no_time_and_time_reversed(stepper):
    """With dt = 0 the state comes back unchanged; dt < 0 is refused, and a status where it is traced."""
    net = js.lattice(3)
    start = js.State.from_points(net, [[0.0], [1.1], [2.5]], [[0.3], [0.0], [-0.2]])
    system = js.System(net, 1.0, js.Springs(net, 10.0, 1.0))
    still = js.rollout(system, start, stepper, 0.0, 2)
    assert int(still.status.flags) == Flag.OK
    np.testing.assert_array_equal(still.state.points, start.points)
    np.testing.assert_array_equal(still.state.velocities, start.velocities)
    with pytest.raises(ValueError, match=r"dt = -0\.1, but .* does not run backward"):
        js.rollout(system, start, stepper, -0.1, 2)
    assert bool(jax.jit(lambda dt: js.rollout(system, start, stepper, dt, 1).status)(-0.1).has(Flag.INVALID))


@pytest.mark.slow
@each_stepper
def test_a13_no_time_has_a_derivative(stepper):
    """With dt = 0 the derivative of the end by the start is the identity, not what a division by dt would make of it."""
    net = js.lattice(3)
    start = js.State.from_points(net, [[0.0], [1.1], [2.5]], [[0.3], [0.0], [-0.2]])
    system = js.System(net, 1.0, js.Springs(net, 10.0, 1.0))
    weights = jnp.asarray([2.0, -3.0, 5.0])

    def weighed(x):
        end = js.rollout(system, start.moved(js.Vector((x,)), start.velocity), stepper, 0.0, 2).state
        return jnp.sum(weights * end.position.x)

    np.testing.assert_array_equal(jax.grad(weighed)(start.position.x), weights)


@pytest.mark.slow
def test_b6_a_squeezed_cloth():
    """A 12 x 12 cloth squeezed to 60 %: its exact stiffness has eigenvalues below -1e4, the clamped one none; the step solves with the
    clamped one and is called indefinite with the exact one.
    """
    system, _, _ = cloth()
    net = system.net
    flat = np.concatenate([net.grid(0.1), np.zeros((144, 1))], axis=1)
    start = js.State.from_points(net, 0.6 * flat + 1e-3 * np.random.default_rng(3).normal(size=flat.shape))

    def eigenvalues(kind):
        blocks = system.bind(start.dtype).stiffness_blocks(start, kind)
        return np.linalg.eigvalsh(np.asarray(system.matrix(blocks, start).to_dense()))

    assert eigenvalues(js.steppers.ExactTangent())[0] < -1e4
    assert eigenvalues(js.steppers.Tangent())[0] >= -1e-9
    clamped = js.rollout(system, start, js.BackwardEuler(js.CG()), 100 * LIMIT, 1)
    # The sheet springs open, and gains energy in so long a step: that is told, too. The solve itself is sound.
    assert not bool(clamped.status.has(Flag.CG_INDEFINITE))
    assert float(clamped.info.solves.residual) <= 1e-8
    exact = js.rollout(system, start, js.BackwardEuler(js.CG(), stiffness=js.steppers.ExactTangent()), 100 * LIMIT, 1)
    assert bool(exact.status.has(Flag.CG_INDEFINITE))


@pytest.mark.parametrize("solver", [js.JaxCG(), js.CG()], ids=lambda s: type(s).__name__)
def test_c9_a_free_chain_at_rest(solver):
    """K x = f on a free 10-chain: balanced forces are solved, a net force is an error, nothing gives zeros without an iteration."""
    net = js.lattice(10)
    start = js.State.from_points(net, net.grid())
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0)).bind(start.dtype)
    matrix = system.matrix(system.stiffness_blocks(start, js.steppers.Tangent()), start)

    def solve(f):
        return solver.solve_in_step(matrix, js.Vector((jnp.asarray(f),)), None, None)[:2]

    ends = np.zeros(10)
    ends[[0, -1]] = -1, 1
    x, info = solve(ends)
    assert bool(info.status.is_ok)
    np.testing.assert_allclose(np.diff(x.x), 1.0, rtol=1e-6)
    _, info = solve(np.ones(10))
    assert bool(info.status.has(Flag.CG_INDEFINITE) | info.status.has(Flag.CG_MAXITER))
    x, info = solve(np.zeros(10))
    assert bool(info.status.is_ok)
    assert int(info.iterations) == 0
    np.testing.assert_array_equal(x.x, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(("stepper", "order"), [(IMPLICIT[0], 1), (IMPLICIT[2], 2), (IMPLICIT[3], 2)], ids=["1", "2", "BDF2"])
def test_c12_implicit_orders_on_an_oscillator(stepper, order):
    """One mass on a spring, omega = 3: halving dt divides the distance from the closed form by 2**order."""
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.0], [1.1]])
    system = js.System(net, 1.0, js.Springs(net, 9.0, 1.0), free=np.array([False, True]))

    def error(n):
        run = js.rollout(system, start, stepper, 1.0 / n, n)
        return abs(float(run.state.position.x[1]) - 1.0 - 0.1 * np.cos(3.0))

    n = 512 if order == 1 else 128
    assert np.log2(error(n) / error(2 * n)) == pytest.approx(order, abs=0.1)
