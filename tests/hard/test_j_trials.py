"""Hard cases J: found in trials of the design. (Lines that need an implicit step are not here.)"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag
from tests.reference import central_difference, relative_error, spring_forces

STEPPERS = [js.ForwardEuler(), js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()]


@pytest.mark.parametrize("stepper", STEPPERS, ids=repr)
def test_j2_a_loss_on_a_pin(rng, stepper):
    """A pinned node stays where it is, so a loss on its position has derivative one by its start and exactly zero by all else."""
    net = js.lattice(4)
    free = [False, True, True, True]

    def pin(x0, v0, k):
        system = js.System(net, 1.0, (js.Springs(net, k, 1.0), js.Drag(0.1)), free=free)
        end = js.rollout(system, js.State.from_points(net, x0, v0), stepper, 0.01, 50).state
        return end.points[0, 0] + 0.5 * end.velocities[0, 1]

    x0 = jnp.asarray(np.c_[np.arange(4.0), np.zeros(4)] + 0.1 * rng.normal(size=(4, 2)))
    value, (by_x, by_v, by_k) = jax.jit(jax.value_and_grad(pin, argnums=(0, 1, 2)))(x0, jnp.ones((4, 2)), jnp.full(3, 50.0))
    assert value == x0[0, 0]
    expected = np.zeros((4, 2))
    expected[0, 0] = 1
    np.testing.assert_array_equal(by_x, expected)
    np.testing.assert_array_equal(by_v, 0)
    np.testing.assert_array_equal(by_k, 0)


def star(n):
    return js.Graph.from_edges([(0, i) for i in range(1, n + 1)], n + 1)


def test_j3_a_star(rng):
    """10^4 springs on one hub: right forces, and tables, temporary memory and work in proportion to the springs."""

    def measured(n):
        net = star(n)
        points = rng.normal(size=(n + 1, 2))
        k = np.full(n, 3.0)

        def loss(k):
            force = js.Springs(net, k, 0.5).force(js.State.from_points(net, points))
            return jnp.sum(net.flatten_nodes(force.x) ** 2), jnp.stack([net.flatten_nodes(f) for f in force], axis=-1)

        program = jax.jit(jax.value_and_grad(loss, has_aux=True)).lower(k).compile()
        (_, force), gradient = program(k)
        expected = spring_forces(points, net.edges, 3.0, 0.5)
        assert relative_error(force, expected) <= 1e-11
        # F is linear in every k: d(sum F_x^2)/dk_i = 2 sum F_x dF_x/dk_i, and dF/dk_i is the spring's own pull over k.
        pull = -expected[1:, 0] / 3
        np.testing.assert_allclose(gradient, 2 * pull * (expected[0, 0] - expected[1:, 0]), rtol=1e-9, atol=1e-9)
        tables = sum(a.size for a in jax.tree.leaves(net.ends))
        return tables, program.memory_analysis().temp_size_in_bytes, program.cost_analysis()["flops"]

    small, large = measured(1_000), measured(10_000)
    # Each end of a spring is listed with neighbour, entry and, at the hub, whether it is there; each spring with its nodes and places.
    # The hub's columns of 64 springs have a node each and are summed in further rounds.
    assert large[0] <= (3 * 2 + 4 + 0.1) * 10_000 + 200
    assert large[1] <= 10 * small[1]
    assert large[2] <= 10.2 * small[2]


@pytest.mark.parametrize(
    "field", [js.Vector((jnp.ones(2), jnp.zeros(2))), js.topology.EdgeField((jnp.ones(2),))], ids=["vector", "edge field"]
)
def test_j4_numpy_on_the_left(field):
    """A NumPy number or array with a field gives a field or a TypeError, never an object array."""
    two = np.float32(2)
    for combined in (two * field, field * two, field + two, two + field, two - field, field / two, np.asarray(2.0) * field):
        assert type(combined) is type(field)
        assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(combined))
    if isinstance(field, js.Vector):
        np.testing.assert_array_equal((np.array([1.0, 3.0]) * field).x, [1, 3])
        np.testing.assert_array_equal((np.array([1.0, 3.0]) - field).x, [0, 2])
    else:
        with pytest.raises(TypeError, match=r"network\.edge_field"):
            np.ones(2) * field
    for other in ("a", [1.0, 2.0], None):
        with pytest.raises(TypeError):
            other * field


def test_j5_stiffness_in_the_users_order(rng):
    """On a graph whose nodes and springs are renumbered inside, gradients by a flat stiffness come back in the user's order."""
    sheet = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)
    names = rng.permutation(20)
    edges = rng.permutation(names[sheet.edges])
    net = js.Graph.from_edges(edges, 20)
    np.testing.assert_array_equal(net.edges, edges)
    points = np.empty((20, 2))
    points[names] = sheet.grid() + 0.1 * rng.normal(size=(20, 2))
    k = rng.uniform(1, 2, len(edges))

    def energy(k):
        return js.Springs(net, k, 0.9).energy(js.State.from_points(net, points))

    expected = 0.5 * (np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1) - 0.9) ** 2
    np.testing.assert_allclose(jax.jit(jax.grad(energy))(k), expected, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.vmap(jax.grad(energy)))(jnp.stack([k, 2 * k])), [expected, expected], rtol=1e-12)
    for program in (jax.jit(jax.grad(energy)).lower(k), jax.jit(jax.vmap(jax.grad(energy))).lower(jnp.stack([k, k]))):
        assert "scatter" not in program.as_text()


def whole_model(mass, k, l, gamma, g):
    """A model built from traced values only; the sum of its squared positions after ten steps, and its status."""
    net = js.lattice(4)
    system = js.System(net, mass, (js.Springs(net, k, l), js.Drag(gamma), js.Gravity(g)))
    state = js.State.from_points(net, 1.2 * np.c_[np.arange(4.0), np.zeros(4)])
    result = js.rollout(system, state, js.SymplecticEuler(), 0.02, 10)
    return jnp.sum(result.state.points**2), result.status


GOOD = {"mass": np.ones(4), "k": np.full(3, 10.0), "l": np.ones(3), "gamma": np.asarray(0.5), "g": np.array([0.0, -9.81])}


def test_j6_models_built_inside_transformations():
    """A system built inside jit, grad and vmap from traced values works, and its gradient is right."""
    value, gradient = jax.jit(jax.value_and_grad(lambda p: whole_model(**p)[0]))(GOOD)
    for name in GOOD:
        at = np.unravel_index(np.argmax(np.abs(gradient[name])), GOOD[name].shape)

        def along(x, name=name, at=at):
            moved = GOOD[name].copy()
            moved[at] = x
            return whole_model(**{**GOOD, name: moved})[0]

        expected = central_difference(along, float(GOOD[name][at]), 1e-4)
        assert float(gradient[name][at]) == pytest.approx(expected, rel=1e-6)
    batch = jax.tree.map(lambda a: np.stack([a, a]), GOOD)
    many, status = jax.jit(jax.vmap(lambda p: whole_model(**p)))(batch)
    np.testing.assert_allclose(many, value, rtol=1e-14)
    assert np.all(status.flags == 0)


@pytest.mark.parametrize(
    ("name", "bad", "effect"),
    [("mass", -1.0, -1), ("k", -1.0, 0), ("l", -0.1, 0), ("gamma", -0.5, 1), ("mass", np.nan, -1), ("k", np.nan, 0), ("g", np.inf, 2)],
)
def test_j6_bad_traced_values_are_statuses(name, bad, effect):
    """What a constructor would refuse, had it been able to look, is a status at step 0 that names the effect."""
    values = {key: np.array(value) for key, value in GOOD.items()}
    values[name][(-1,) * values[name].ndim] = bad
    _, status = jax.jit(lambda p: whole_model(**p))(values)
    assert status.has(Flag.NONFINITE if not np.isfinite(bad) else Flag.INVALID)
    assert not status.is_ok
    assert (int(status.step), int(status.effect)) == (0, effect)


@pytest.mark.slow
def test_j7_a_prime_number_of_steps(rng):
    """10,007 steps, which no block divides: the gradient is that of a plain scan, in as little memory as 10,000 steps."""
    net = js.lattice((10, 10))
    state = js.State.from_points(net, 1.1 * net.grid() + 0.02 * rng.normal(size=(100, 2)))

    def gradient(n_steps, adjoint=None):
        def loss(k):
            system = js.System(net, 1.0, (js.Springs(net, k, 1.0), js.Drag(0.5)))
            end = js.rollout(system, state, js.SymplecticEuler(), 1e-2, n_steps, adjoint=adjoint).state
            return jnp.sum(end.position.dot(end.position))

        return jax.jit(jax.grad(loss)).lower(jnp.asarray(20.0)).compile()

    even, prime, stored = gradient(10_000), gradient(10_007), gradient(10_007, js.StoreAll())
    k = jnp.asarray(20.0)
    assert float(prime(k)) == pytest.approx(float(stored(k)), rel=1e-12)
    assert prime.memory_analysis().temp_size_in_bytes <= min(1.1 * even.memory_analysis().temp_size_in_bytes, 2 * 2**20)
