"""Hard cases A: topology and input. (Lines that need an implicit step are not here.)"""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.laws import spring_pull
from jaxspring.status import Flag, StabilityWarning
from tests.reference import Traces, chaotic_net, relative_error, spring_forces

PAIR = np.array([[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]])


def pair_of_springs(stiffness, edges=((0, 1),)):
    net = js.Graph.from_edges(edges, 2)
    return js.System(net, 1.0, js.Springs(net, stiffness, 1.0)), js.State.from_points(net, PAIR)


def chain_system(n=4, stiffness=10.0, mass=1.0, forces=()):
    net = js.lattice(n)
    return js.System(net, mass, (js.Springs(net, stiffness, 1.0), *forces)), js.State.from_points(net, 1.1 * net.grid())


def along_x(system, state):
    return system.net.flatten_nodes(system.force(state).x)


def run(system, state, stepper=None, dt=0.01, n_steps=10, **options):
    return js.rollout(system, state, js.SymplecticEuler() if stepper is None else stepper, dt, n_steps, **options)


def flags(result):
    return Flag(int(result.status.flags))


def test_a1_a_spring_to_itself_is_refused():
    """A spring from a node to itself has no direction: the constructor names it."""
    with pytest.raises(ValueError, match="spring 0 joins node 0 to itself"):
        js.Graph.from_edges([(0, 0), (1, 0)], 2)


def test_a1_unvalidated_its_pull_is_zero_and_the_gradient_finite():
    """Were one let through: the other spring still pulls with exactly 100 N, and the gradient is finite (a naive norm gives NaN)."""
    points = jnp.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    tails, heads = np.array([0, 1]), np.array([0, 0])

    def forces(points):
        d = js.Vector(tuple(points[heads, i] - points[tails, i] for i in range(3)))
        pull = jnp.stack(list(spring_pull(js.Hooke(), d, jnp.asarray(100.0), jnp.asarray(1.0))), axis=-1)
        return jnp.zeros_like(points).at[tails].add(pull).at[heads].add(-pull)

    np.testing.assert_array_equal(forces(points), [[100, 0, 0], [-100, 0, 0]])
    assert np.isfinite(jax.jacrev(forces)(points)).all()


def test_a2_two_springs_in_parallel_add_up():
    """Two springs of 50 N/m between the same nodes pull exactly like one of 100; one of them reversed, to rounding."""
    one, state = pair_of_springs(100.0)
    expected = np.array([[50.0, 0, 0], [-50.0, 0, 0]])  # 100 N/m times 0.5 m
    assert relative_error(along_x(one, state), expected[:, 0]) <= 1e-15
    for edges in ([(0, 1), (0, 1)], [(0, 1), (1, 0)]):
        two, state = pair_of_springs([50.0, 50.0], edges)
        assert relative_error(along_x(two, state), expected[:, 0]) <= 1e-15
    two, state = pair_of_springs([50.0, 50.0], [(0, 1), (0, 1)])
    np.testing.assert_array_equal(two.force(state).x, one.force(state).x)


@pytest.mark.parametrize("net", [js.Graph.from_edges(np.zeros((0, 2), int), 2), js.lattice((2, 1), js.SHEAR)], ids=["graph", "lattice"])
def test_a3_no_springs(net):
    """Without springs nothing pulls, the energy is 0, no dt is too long, and free nodes coast: x = v t."""
    assert net.n_springs == 0
    assert net.edges.shape == (0, 2)
    for stiffness in (100.0, np.zeros(0)):
        system = js.System(net, 1.0, js.Springs(net, stiffness, 1.0))
        state = js.State.from_points(net, np.zeros((2, 3)), np.ones((2, 3)))
        np.testing.assert_array_equal(jnp.stack(list(system.force(state))), 0)
        assert system.energy(state).potential == (0,)
        assert js.stable_dt(system, state) == np.inf
        result = run(system, state, dt=1.0, n_steps=3)
        assert flags(result) == Flag.OK
        np.testing.assert_array_equal(result.state.points, 3)
    assert np.shape(net.lengths(np.zeros((2, 3)))) == (0,)


def test_a4_zero_nodes():
    """A network needs a node."""
    for build in (lambda: js.Graph.from_edges(np.zeros((0, 2), int), 0), lambda: js.lattice(0), lambda: js.lattice((3, 0))):
        with pytest.raises(ValueError, match="at least 1"):
            build()


def test_a5_a_lone_node_coasts():
    """A node without a spring, beside a chain of ten, moves by v dt and no more."""
    edges = [(i, i + 1) for i in range(9)]
    net = js.Graph.from_edges(edges, 11)
    points = np.c_[np.arange(11.0), np.zeros((11, 2))]
    velocities = np.zeros((11, 3))
    velocities[10, 1] = 1
    system = js.System(net, 1.0, js.Springs(net, 100.0, 1.0))
    result = run(system, js.State.from_points(net, points, velocities), dt=0.1, n_steps=1)
    assert flags(result) == Flag.OK
    np.testing.assert_array_equal(result.state.points[10], [10, 0.1, 0])
    np.testing.assert_array_equal(result.state.points[:10], points[:10])


def test_a6_a_node_without_mass():
    """Mass 0 is refused by name; let through by a traced value it is a status before the first step, not a silent NaN."""
    net = js.Graph.from_edges([(0, 1)], 3)
    with pytest.raises(ValueError, match=r"mass\[2\] = 0.0, but must be positive"):
        js.System(net, [1.0, 1.0, 0.0])

    def go(mass):
        state = js.State.from_points(net, np.eye(3), np.ones((3, 3)))
        return run(js.System(net, mass, js.Springs(net, 1.0, 1.0)), state).status

    status = jax.jit(go)(jnp.array([1.0, 1.0, 0.0]))
    assert status.has(Flag.INVALID)
    assert status.step == 0
    assert not status.is_ok


@pytest.mark.parametrize(
    ("edges", "error", "text"),
    [
        ([(0, 1), (1, 7)], ValueError, r"edges\[1\] = \(1, 7\) names node 7, .* n_nodes = 4"),
        ([(0, 1), (-1, 2)], ValueError, r"edges\[1\] = \(-1, 2\) names node -1"),
        (np.array([(0, 1), (2, 2**32 - 1)], np.uint32), ValueError, r"edges\[1\] = \(2, 4294967295\)"),
        (np.array([(0, 1), (2, 2**40)], np.int64), ValueError, r"edges\[1\] = \(2, 1099511627776\)"),
        (np.array([(0.0, 1.5)]), TypeError, r"edges has dtype float64, .*edges\[0\] = \[0\.  1\.5\]"),
        (np.array([(False, True)]), TypeError, r"edges has dtype bool"),
        (np.array([0, 1, 2]), ValueError, r"edges has shape \(3,\)"),
        (np.array([(0, 1, 2)]), ValueError, r"edges has shape \(1, 3\)"),
    ],
)
def test_a7_bad_node_numbers(edges, error, text, user_mode):
    """A node number that does not exist, or is no whole number, is named with its spring; JAX would read another node."""
    with pytest.raises(error, match=text):
        js.Graph.from_edges(edges, 4)


def run_of_arrays(v):
    net = js.lattice(4)
    system = js.System(net, v["mass"], js.Springs(net, v["stiffness"], v["rest_length"]))
    return run(system, js.State.from_points(net, v["points"], v["velocities"])).status


def spoiled(name, bad):
    """Arrays of a good run but for one bad number in the field `name`, and its place as a message writes it."""
    values = {"points": 1.1 * np.c_[np.arange(4.0)], "velocities": np.zeros((4, 1)), "mass": np.ones(4), "stiffness": np.ones(3)}
    values["rest_length"] = np.ones(3)
    at = (2, 0) if values[name].ndim == 2 else (1,)
    values[name][at] = bad
    return values, ", ".join(map(str, at))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["points", "velocities", "mass", "stiffness", "rest_length"])
def test_a8_nan_and_infinity(name, bad):
    """Refused with field and index; inside jit, where nothing can be looked at, NONFINITE before the first step."""
    values, place = spoiled(name, bad)
    with pytest.raises(ValueError, match=rf"{name}\[{place}\] = {bad}, but must be finite"):
        run_of_arrays(values)
    status = jax.jit(run_of_arrays)(values)
    assert status.has(Flag.NONFINITE)
    assert status.step == 0
    with pytest.raises(js.SimulationError, match=r"NONFINITE.*step 0"):
        js.raise_for_status(status)


def test_a9_whole_number_positions():
    """Integer positions become floating, and the gradient works (jax.grad refuses integers)."""
    net = js.lattice(4)
    state = js.State.from_points(net, np.arange(12, dtype=np.int32).reshape(4, 3))
    assert state.dtype == jnp.float64

    def energy(state, k):
        return js.System(net, 1.0, js.Springs(net, k, 1.0)).energy(state).total

    by_state, by_k = jax.grad(energy, argnums=(0, 1))(state, 2.0)
    length = np.sqrt(27.0)  # neighbours differ by (3, 3, 3)
    assert by_k == pytest.approx(3 * 0.5 * (length - 1) ** 2, rel=1e-14)
    np.testing.assert_allclose(by_state.position.x, 2 * (length - 1) * 3 / length * np.array([-1, 0, 0, 1]), rtol=1e-14, atol=1e-14)


class Witness(js.Force):
    """No force, but it tells when it is traced."""

    tell: Traces = eqx.field(static=True)

    def force(self, state):
        self.tell()
        return js.Vector.zeros_like(state.position)


def test_a10_mixed_precisions():
    """Float32 positions with float64 constants and a float64 dt stay float32, in results and in forces, without compiling twice."""
    net = js.lattice(4)
    traces = Traces()
    forces = (js.Springs(net, np.full(3, 10.0), np.float64(1.0)), js.Drag(0.1), js.Gravity((0.0, -9.81)), Witness(traces))
    system = js.System(net, np.float64(1.0), forces)
    state = js.State.from_points(net, np.c_[np.arange(4), np.zeros(4)].astype(np.float32))
    assert system.force(state).dtype == jnp.float32
    assert system.energy(state).total.dtype == jnp.float32
    assert js.stable_dt(system, state).dtype == jnp.float32
    state = run(system, state, dt=np.float64(1e-3), n_steps=100).state
    traces.count = 0
    state = run(system, state, dt=np.float64(1e-3), n_steps=100).state
    assert traces.count == 0
    assert {leaf.dtype for leaf in jax.tree.leaves(state)} == {np.dtype("float32")}


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_a11_half_precision_is_refused(half):
    """Three digits do not make a difference of positions."""
    net = js.lattice(4)
    with pytest.raises(TypeError, match="half precision"):
        js.State.from_points(net, jnp.zeros((4, 3), half))
    with pytest.raises(TypeError, match="half precision"):
        js.Springs(net, jnp.ones(3, half), 1.0)


def test_a12_negative_stiffness():
    """Refused by name; where it is asked for, it pushes: f = k (r - l) with k < 0. (What an implicit step says of it: with those.)"""
    net = js.lattice(2)
    with pytest.raises(ValueError, match=r"stiffness\[0\] = -10.0, but must be zero or more.*allow_negative_stiffness"):
        js.Springs(net, [-10.0], 1.0)
    state = js.State.from_points(net, [[0.0], [1.5]])
    springs = js.Springs(net, -10.0, 1.0, allow_negative_stiffness=True)
    np.testing.assert_allclose(springs.force(state).x, [-5, 5], rtol=1e-15)
    assert flags(run(js.System(net, 1.0, springs), state, n_steps=1)) == Flag.OK
    with pytest.raises(ValueError, match="must be finite"):
        js.Springs(net, np.nan, 1.0, allow_negative_stiffness=True)


def test_a13_constants_of_the_wrong_sign():
    """A length, a mass and a drag below zero are refused."""
    net = js.lattice(2)
    with pytest.raises(ValueError, match=r"rest_length = -1\.0, but must be zero or more"):
        js.Springs(net, 1.0, -1.0)
    with pytest.raises(ValueError, match=r"mass = -1\.0, but must be positive"):
        js.System(net, -1.0)
    with pytest.raises(ValueError, match=r"gamma = -1\.0, but must be zero or more"):
        js.Drag(-1.0)


@pytest.mark.parametrize("stepper", [js.ForwardEuler(), js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()], ids=repr)
def test_a13_no_time_no_motion(stepper):
    """With dt = 0 every step returns its state unchanged, to the bit."""
    system, state = chain_system()
    state = eqx.tree_at(lambda s: s.velocity, state, state.velocity + 0.3)
    result = run(system, state, stepper, dt=0.0)
    assert flags(result) == Flag.OK
    jax.tree.map(np.testing.assert_array_equal, result.state, state)


def test_a13_backward_in_time(rng):
    """Verlet with -dt retraces its path: on a chaotic net of 576 nodes, 500 steps there and back, to 5e-10."""
    system, state = chaotic_net(rng)
    there = run(system, state, js.VelocityVerlet(), dt=5e-3, n_steps=500)
    back = run(system, there.state, js.VelocityVerlet(), dt=-5e-3, n_steps=500)
    assert np.abs(there.state.points - state.points).max() > 0.1
    assert np.abs(back.state.points - state.points).max() <= 5e-10
    assert abs(back.state.time) <= 1e-15


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a13_dt_that_is_no_time(bad):
    """NaN and infinity are refused."""
    with pytest.raises(ValueError, match=f"dt = {bad}, but must be finite"):
        run(*chain_system(), dt=bad)


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=repr)
def test_a14_no_step_and_one_step(stepper):
    """No step is the initial state, one step one frame, and the results have one structure."""
    system, state = chain_system()
    none, one = (run(system, state, stepper, n_steps=n, save_every=1) for n in (0, 1))
    jax.tree.map(np.testing.assert_array_equal, none.state, state)
    assert none.saved.position.x.shape == (0, 4)
    assert one.saved.position.x.shape == (1, 4)
    np.testing.assert_array_equal(one.saved.position.x[0], one.state.position.x)
    assert jax.tree.structure(none) == jax.tree.structure(one)
    assert flags(none) == flags(one) == Flag.OK
    assert int(none.info.n_steps) == 0
    bare = run(system, state, stepper, n_steps=0)
    jax.tree.map(np.testing.assert_array_equal, bare.state, state)


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("n", [1, 3])
def test_a16_every_dimension_and_one_node(dim, n):
    """Chains of one and of three nodes live in 1, 2 and 3 dimensions."""
    net = js.lattice(n)
    points = np.zeros((n, dim))
    points[:, 0] = 1.5 * np.arange(n)
    system, state = js.System(net, 1.0, js.Springs(net, 4.0, 1.0)), js.State.from_points(net, points)
    expected = spring_forces(points, net.edges, 4.0, 1.0)
    np.testing.assert_allclose(np.stack(list(system.force(state)), axis=-1), expected, atol=1e-15)
    assert flags(run(system, state, n_steps=2)) == Flag.OK


def test_a16_four_dimensions_are_refused():
    """Space has at most three."""
    with pytest.raises(ValueError, match=r"points has shape \(3, 4\)"):
        js.State.from_points(js.lattice(3), np.zeros((3, 4)))
    with pytest.raises(ValueError, match="4 axes"):
        js.lattice((2, 2, 2, 2))


@pytest.mark.parametrize("kind", ["lattice", "graph"])
def test_a17_a_large_net_against_numpy(rng, dtype, kind):
    """Forces of 89,102 springs on 22,500 nodes are NumPy's: 3e-4 in float32, 1e-10 in float64."""
    net = js.lattice((150, 150), js.STRUCTURAL + js.SHEAR)
    assert (net.n_nodes, net.n_springs) == (22_500, 89_102)
    if kind != "lattice":
        net = js.Graph.from_edges(net.edges, net.n_nodes)
    points = (np.c_[js.lattice((150, 150)).grid(), np.zeros(22_500)] + 0.1 * rng.normal(size=(22_500, 3))).astype(dtype)
    k, l = (rng.uniform(0.5, 1.5, 89_102).astype(dtype) for _ in range(2))
    springs, state = js.Springs(net, k, l), js.State.from_points(net, points)
    force = jax.jit(lambda: net.flatten_nodes(jnp.stack(list(springs.force(state)))))()
    assert relative_error(force.T, spring_forces(points, net.edges, k, l)) <= (3e-4 if dtype == np.float32 else 1e-10)


def test_warnings_of_a_run_are_warnings():
    """A run above the stable dt warns once, by a class of its own that can be silenced."""
    system, state = chain_system()
    with pytest.warns(StabilityWarning, match="DT_LIMIT"):
        run(system, state, dt=0.9, n_steps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", StabilityWarning)
        run(system, state, dt=0.9, n_steps=1)
