"""Driven springs: what a rest length is, when a command holds, whose work it is."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

CHAIN = js.lattice(3)
SHEET = js.lattice((2, 3), js.STRUCTURAL + js.SHEAR)
GRAPH = js.Graph.from_edges([(0, 3), (3, 1), (2, 1), (0, 2)], 4)
SQUARE = np.array([[0.0, 0.0], [1.1, 0.2], [0.1, 1.0], [1.0, 1.2]])
STEPPERS = [
    js.VelocityVerlet(),
    js.RungeKutta4(),
    js.SemiImplicit(),
    js.BackwardEuler(newton=True),
    js.ImplicitMidpoint(),
    js.BDF2(),
]


class Fixed(eqx.Module):
    """A command from outside."""

    command: jax.Array

    def __call__(self, state):
        return self.command


pytestmark = pytest.mark.usefixtures("sooner")


class Reflex(eqx.Module):
    """A closed loop: each spring of a graph is asked to shorten by how fast its ends move, and by the time."""

    weights: jax.Array

    def __call__(self, state):
        """(4,) commands."""
        return 1 + 0.3 * jnp.tanh(self.weights @ jnp.concatenate([state.position.x, state.velocity.y]) + jnp.sin(3 * state.time))


def reflex(dtype=float):
    return Reflex(jnp.asarray(np.random.default_rng(5).normal(size=(4, 8)), dtype))


def driven(controller=None, low=0.5, high=1.5, rules=()):
    actuation = js.robot.Actuation(reflex() if controller is None else controller, low=low, high=high)
    forces = (js.Springs(GRAPH, 30.0, [1.0, 1.1, 0.9, 1.2], actuation=actuation), js.Drag(0.2))
    return js.System(GRAPH, 0.5, forces, rules=rules)


def start(dtype=float):
    return js.State.from_points(GRAPH, jnp.asarray(SQUARE, dtype), jnp.asarray(0.3 * SQUARE[::-1] - 0.2, dtype))


@pytest.mark.parametrize("net", [SHEET, GRAPH], ids=["lattice", "graph"])
def test_a_rest_length_is_the_product(net):
    """Given or remembered length, times expansion, times command: of each spring, of its group, of all; passive springs stay."""
    n, rng = net.n_springs, np.random.default_rng(0)
    given, changed, own, groups = rng.uniform(1, 2, n), rng.uniform(1, 2, n), rng.uniform(0.8, 1.2, n), rng.integers(-1, 3, n)
    by_group = np.array([0.7, 1.3, 9.0])
    of_group = np.where(groups < 0, 1.0, np.clip(by_group, 0.5, 1.5)[groups])
    points = rng.normal(size=(net.n_nodes, 2))
    state = js.State.from_points(net, points, temperature=rng.uniform(300, 400, net.n_nodes))
    expansion = js.thermal.ThermalExpansion(1e-3, 300.0)
    warm = 1 + 1e-3 * (np.asarray(state.temperatures)[net.edges].mean(axis=1) - 300.0)
    for controller, labels, expected in (
        (lambda state: 0.9, None, 0.9),
        (lambda state: own, None, own),
        (lambda state: by_group, groups, of_group),
        (lambda state: 0.8, groups, np.where(groups < 0, 1.0, 0.8)),
    ):
        springs = js.Springs(net, 1.0, given, actuation=js.robot.Actuation(controller, labels))
        np.testing.assert_allclose(net.flatten(springs.natural_length(state)), given * expected, rtol=1e-14)
        warmed = js.Springs(net, 1.0, given, expansion=expansion, actuation=js.robot.Actuation(controller, labels))
        remembered = state.with_rest_length(net, net.split(jnp.asarray(changed)))
        np.testing.assert_allclose(net.flatten(warmed.natural_length(remembered)), changed * warm * expected, rtol=1e-14)
        # Bound, as in a run, it is the same; the pull is that of these lengths.
        bound = js.System(net, 1.0, warmed).force(remembered)
        d = points[net.edges[:, 1]] - points[net.edges[:, 0]]
        pull = ((1 - changed * warm * expected / np.linalg.norm(d, axis=1))[:, None]) * d
        force = np.zeros_like(points)
        np.add.at(force, net.edges[:, 0], pull)
        np.subtract.at(force, net.edges[:, 1], pull)
        np.testing.assert_allclose(np.stack([net.flatten_nodes(a) for a in bound], axis=-1), force, atol=1e-12)


def test_bad_input_is_named():
    """What cannot drive springs is refused where it is made, and an answer of another shape when it is asked for."""
    for wrong, kind, match in (
        (lambda: js.robot.Actuation(3.0), TypeError, "controller is a float"),
        (lambda: js.robot.Actuation(abs, groups=[0.5, 1.0]), TypeError, "groups"),
        (lambda: js.robot.Actuation(abs, groups=[0, -2]), ValueError, r"groups\[1\] = -2"),
        (lambda: js.robot.Actuation(abs, low=0.0), ValueError, "low"),
        (lambda: js.robot.Actuation(abs, low=1.2, high=1.1), ValueError, "low at most high"),
        (lambda: js.Springs(CHAIN, 1.0, 1.0, actuation=abs), TypeError, "actuation"),
        (lambda: js.Springs(CHAIN, 1.0, 1.0, actuation=js.robot.Actuation(abs, groups=[0, 1, 2])), ValueError, r"expected \(2,\)"),
    ):
        with pytest.raises(kind, match=match):
            wrong()
    three = js.System(CHAIN, 1.0, js.Springs(CHAIN, 1.0, 1.0, actuation=js.robot.Actuation(lambda state: jnp.ones(3))))
    with pytest.raises(ValueError, match="what the controller gives"):
        three.force(js.State.from_points(CHAIN, CHAIN.grid()))
    traced = js.rollout(
        eqx.tree_at(lambda s: s.forces[0].actuation.low, driven(), jnp.asarray(2.0)), start(), js.SymplecticEuler(), 0.01, 1
    )
    assert bool(traced.status.has(js.Flag.INVALID))


def test_a_new_controller_acts_at_once():
    """A run that goes on from a state asks the controller that it is given, as in a loop of one step a call; with `resume`, too, where it
    is another: v = dt k (c - 1) / m = 0.2, and its derivative by c.
    """
    net = js.lattice(2)

    def gone(state, action, resume=None):
        springs = js.Springs(net, 100.0, 1.0, actuation=js.robot.Actuation(Fixed(action)))
        system = js.System(net, 1.0, springs, free=np.array([False, True]))
        return js.rollout(system, state, js.SymplecticEuler(), 0.01, 1, resume=resume)

    first = gone(js.State.from_points(net, net.grid()), jnp.asarray(1.0))
    for resume in (None, first.resume):
        value, slope = jax.value_and_grad(lambda c, resume=resume: gone(first.state, c, resume).state.velocity.x[1])(jnp.asarray(1.2))
        assert float(value) == pytest.approx(0.2, rel=1e-12)
        assert float(slope) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: f"{type(s).__name__}{'' if getattr(s, 'newton', None) is None else ' newton'}")
def test_a_command_holds_for_a_step(stepper):
    """A step of driven springs is that of passive ones with the rest lengths of its beginning, though the controller reads places and
    velocities; the next step has the command of the state between the two. Not so of BDF2, which looks back a step.
    """
    system, dt = driven(), 0.02
    springs = system.forces[0]
    passive = js.System(GRAPH, 0.5, (js.Springs(GRAPH, 30.0, springs.rest_length), js.Drag(0.2)))

    @jax.jit
    def held(state, lengths):
        return js.rollout(js.replace(passive, rest_length=lengths), state, stepper, dt, 1).state

    n_steps = 1 if isinstance(stepper, js.BDF2) else 2
    run = js.rollout(system, start(), stepper, dt, n_steps)
    js.raise_for_status(run)
    state = start()
    for _ in range(n_steps):
        state = held(state, springs.rest_length * springs.actuation.controller(state))
    np.testing.assert_allclose(run.state.points, state.points, rtol=1e-12)
    np.testing.assert_allclose(run.state.velocities, state.velocities, rtol=1e-10)
    np.testing.assert_allclose(system.recall(run.state, 0), springs.actuation.controller(run.state), rtol=1e-13)


def test_a_command_is_of_the_state_after_all_rules():
    """A controller that reads a speed sees it after the floor has stopped it, whatever the order of the parts."""
    net = js.lattice(2)
    speed = js.robot.Actuation(lambda state: 1 + 0.1 * state.velocity.y[0])
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0, actuation=speed), rules=js.Floor((0.0, 0.0), (0.0, 1.0)))
    falls = js.State.from_points(net, [[0.0, 0.01], [1.0, 0.01]], [[0.0, -2.0], [0.0, -2.0]])
    end = js.rollout(system, falls, js.SymplecticEuler(), 0.1, 1).state
    assert float(end.velocity.y[0]) == 0
    assert float(system.recall(system.begin(falls), 0)) == pytest.approx(0.8)
    assert float(system.recall(end, 0)) == 1.0


@pytest.mark.slow
def test_the_ledger_books_the_work_of_actuators():
    """Between held ends the actuators' work is the change of k/2 (r - l c)^2, exactly; where all moves, the books close, and only the
    work of the actuators can have brought energy in.
    """
    net, k, l, r = js.lattice(2), 40.0, 1.0, 1.25
    beat = js.robot.Actuation(lambda state: 1 + 0.3 * jnp.sin(state.time))
    held = js.System(net, 1.0, js.Springs(net, k, l, actuation=beat), free=[False, False], rules=js.Ledger())
    run = js.rollout(held, js.State.from_points(net, [[0.0], [r]]), js.SymplecticEuler(), 0.01, 100)
    book = js.energy_ledger(held, run.state)
    stored = [k / 2 * (r - l * (1 + 0.3 * math.sin(t))) ** 2 for t in (0.0, 1.0)]
    assert book["work"]["Springs"] == pytest.approx(stored[1] - stored[0], rel=1e-12)
    assert abs(book["integration"]) < 1e-12
    assert abs(book["residual"]) < 1e-12
    errors = []
    system = driven(rules=js.Ledger())
    for dt in (4e-3, 1e-3):
        book = js.energy_ledger(system, js.rollout(system, start(), js.SymplecticEuler(), dt, round(0.8 / dt)).state)
        assert abs(book["residual"]) < 1e-12
        assert book["work"]["Drag"] < 0 < book["work"]["Springs"]
        errors.append(abs(book["integration"]))
    assert errors[1] < 0.5 * errors[0] < 0.2 * book["work"]["Springs"]


@pytest.mark.slow
def test_a_run_goes_on_bit_for_bit(tmp_path):
    """In two parts, and through a file, a run with commands ends in the bits of the unbroken one."""
    system, stepper = driven(), js.VelocityVerlet()

    def run(state, n_steps, resume=None):
        return js.rollout(system, state, stepper, 0.01, n_steps, adjoint=js.Checkpointed(block=10), resume=resume)

    whole, half = run(start(), 40), run(start(), 20)
    js.save(tmp_path / "half.npz", half.state)
    read = js.load(tmp_path / "half.npz", like=system.begin(start()))
    for state in (half.state, read):
        on = run(state, 20, half.resume)
        for a, b in zip(jax.tree.leaves(on.state), jax.tree.leaves(whole.state), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_controllers_are_batched_and_keep_the_dtype():
    """`vmap` over weights gives each lane its own run; float32 stays float32 though the weights are float64."""

    def end(weights, dtype=float):
        return js.rollout(driven(Reflex(weights)), start(dtype), js.SymplecticEuler(), 0.01, 20).state

    weights = jnp.asarray(np.random.default_rng(6).normal(size=(3, 4, 8)))
    lanes = jax.vmap(lambda w: end(w).points)(weights)
    np.testing.assert_allclose(lanes[2], end(weights[2]).points, rtol=1e-13)
    single = end(weights[2], jnp.float32)
    assert {leaf.dtype for leaf in jax.tree.leaves(single) if eqx.is_inexact_array(leaf)} == {jnp.dtype(jnp.float32)}
    np.testing.assert_allclose(single.points, lanes[2], rtol=1e-5)


@pytest.mark.slow
def test_without_steps_the_command_is_of_every_moment():
    """`diffeqsolve` asks the controller all the time: fixed steps come near its answer at order one. `equilibrium` holds the command of
    the state that it is given.
    """
    system = driven()
    exact = js.diffeqsolve(system, start(), 0.4).state.points
    coarse, fine = (np.abs(js.rollout(system, start(), js.VelocityVerlet(), 0.4 / n, n).state.points - exact).max() for n in (160, 640))
    assert coarse / fine == pytest.approx(4, rel=0.15)
    assert fine < 0.02
    pair = js.lattice(2)
    follower = js.robot.Actuation(lambda state: 1 + 0.2 * (state.position.x[1] - 1.5))
    pulled = js.System(pair, 1.0, js.Springs(pair, 10.0, 1.0, actuation=follower), free=[False, True])
    rest = js.equilibrium(pulled, js.State.from_points(pair, [[0.0], [2.0]]))
    np.testing.assert_allclose(rest.state.position.x[1], 1.1, rtol=1e-9)


def test_springs_that_nobody_drives_pay_nothing():
    """Without actuation springs neither act after a step nor remember; a state keeps no memory."""
    system = js.System(CHAIN, 1.0, js.Springs(CHAIN, 1.0, 1.0))
    state = js.State.from_points(CHAIN, CHAIN.grid())
    assert system.bind(float).followers == ()
    assert system.begin(state).memory is None
