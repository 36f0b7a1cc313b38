"""What single effects remember: caches and histories, whose they are, and where they are kept."""

import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

PAIR = js.lattice(2)
START = js.State.from_points(PAIR, [[0.0], [2.0]], [[0.0], [-0.1]])


class Fading(js.Force):
    """A Maxwell element of rest length 1: the damper's stretch q follows, dq/dt = (r - 1 - q) / tau."""

    net: js.topology.Topology
    stiffness: jax.Array
    tau: jax.Array

    def remember(self, state):
        """The damper's stretch, zero."""
        return self.net.map_springs(lambda d: 0 * d.norm(), self.net.difference(state.position))

    def force(self, state):
        """The spring's pull."""

        def pull(d, q):
            return self.stiffness * (1 - (1.0 + q) / d.norm()) * d

        return self.net.accumulate(self.net.map_springs(pull, self.net.difference(state.position), self.recall(state)))

    def energy(self, state):
        """What the spring stores."""
        return self.net.sum(
            self.net.map_springs(
                lambda d, q: 0.5 * self.stiffness * (d.norm() - 1.0 - q) ** 2, self.net.difference(state.position), self.recall(state)
            )
        )

    def update(self, step, state):
        """The damper follows."""
        share = -jnp.expm1(-step.dt / self.tau)
        q = self.net.map_springs(lambda d, q: q + share * (d.norm() - 1.0 - q), self.net.difference(state.position), self.recall(state))
        return self.keep(state, q), js.Status.ok()


class Counting(js.Rule):
    """A cache: how often it was asked."""

    is_cache: ClassVar[bool] = True

    def remember(self, state):
        """Not asked yet."""
        return jnp.zeros((), jnp.int32)

    def update(self, step, state):
        """One more."""
        return self.keep(state, self.recall(state) + 1), js.Status.ok()


def fading(k=3.0, tau=0.5):
    return Fading(PAIR, jnp.asarray(k), jnp.asarray(tau))


def held(*parts, rules=()):
    return js.System(PAIR, 1.0, parts, free=np.zeros(2, bool), rules=rules)


def test_a_maxwell_element_relaxes():
    """Held at a stretch e, the pull falls as k e exp(-t / tau); the damper's stretch is the only entry of the memory."""
    end = js.rollout(held(fading()), START, js.SymplecticEuler(), 0.01, 100).state
    np.testing.assert_allclose(held(fading()).force(end).x[0], 3.0 * np.exp(-1.0 / 0.5), rtol=1e-12)
    assert [entry.owner.kind for entry in end.memory] == ["Fading"]


def test_a_state_without_memory_has_none():
    """A system in which nothing is remembered leaves None, never an empty tuple."""
    end = js.rollout(held(js.Springs(PAIR, 1.0, 1.0)), START, js.SymplecticEuler(), 0.01, 2).state
    assert end.memory is None


@pytest.mark.slow
def test_two_elements_are_two_memories():
    """Two of one kind relax each at its own rate, in any order of the parts, and go on bit for bit in two runs."""
    for first, second in ((0.5, 2.0), (2.0, 0.5)):
        system = held(fading(tau=first), js.Springs(PAIR, 0.0, 1.0), fading(tau=second))
        whole = js.rollout(system, START, js.SymplecticEuler(), 0.01, 60)
        half = js.rollout(system, START, js.SymplecticEuler(), 0.01, 30)
        on = js.rollout(system, half.state, js.SymplecticEuler(), 0.01, 30, resume=half.resume)
        assert jax.tree.structure(whole.state) == jax.tree.structure(on.state)
        for a, b in zip(jax.tree.leaves(whole.state), jax.tree.leaves(on.state), strict=True):
            np.testing.assert_array_equal(a, b)
        for place, tau in ((0, first), (2, second)):
            np.testing.assert_allclose(PAIR.flatten(whole.state.memory[place].value), [1 - np.exp(-0.6 / tau)], rtol=1e-12)
        assert whole.state.memory[1] is None


@pytest.mark.slow
def test_gradients_pass_through_a_memory():
    """The derivative by stiffness and time constant is that of finite differences, through a run whose force reads what it wrote."""

    def end(k, tau):
        system = js.System(PAIR, 1.0, Fading(PAIR, k, tau))
        return js.rollout(system, START, js.VelocityVerlet(), 0.01, 80).state.position.x[1]

    at, h = (jnp.asarray(3.0), jnp.asarray(0.5)), 1e-5
    found = jax.jit(jax.grad(end, argnums=(0, 1)))(*at)
    f = jax.jit(end)
    expected = ((f(3.0 + h, 0.5) - f(3.0 - h, 0.5)) / (2 * h), (f(3.0, 0.5 + h) - f(3.0, 0.5 - h)) / (2 * h))
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    lanes = jax.vmap(end)(jnp.asarray([3.0, 4.0]), jnp.asarray([0.5, 0.6]))
    np.testing.assert_allclose(lanes, [f(3.0, 0.5), f(4.0, 0.6)], rtol=1e-14)


def test_a_history_of_another_part_is_refused():
    """A state that remembers what no part of the system wrote is refused, naming both; forgetting is what the message says."""
    end = js.rollout(held(fading()), START, js.SymplecticEuler(), 0.01, 2).state
    for system, now in (
        (held(js.Springs(PAIR, 1.0, 1.0), fading()), "part 0 of this system is Springs"),
        (held(), "part 0 of this system is missing"),
        (js.System(PAIR, 1.0, Fading(PAIR.named("other"), jnp.asarray(1.0), jnp.asarray(1.0))), "is Fading on 'other'"),
    ):
        for take in (
            lambda s=system: js.rollout(s, end, js.SymplecticEuler(), 0.01, 1),
            lambda s=system: s.force(end),
            lambda s=system: js.equilibrium(s, end),
        ):
            with pytest.raises(ValueError, match=rf"remembers something of Fading.*{now}"):
                take()
        assert js.rollout(system, dataclasses.replace(end, memory=None), js.SymplecticEuler(), 0.01, 1).state is not None


def test_a_cache_of_another_part_is_left_behind():
    """A cache that belongs to no part is dropped without a word; one that does is handed on."""
    counted = held(rules=Counting())
    end = js.rollout(counted, START, js.Still(), 0.01, 3).state
    assert int(end.memory[0].value) == 3
    assert int(js.rollout(counted, end, js.Still(), 0.01, 3).state.memory[0].value) == 6
    assert js.rollout(held(js.Springs(PAIR, 1.0, 1.0)), end, js.Still(), 0.01, 1).state.memory is None


def test_equilibrium_holds_a_history_and_diffeqsolve_refuses_it():
    """At rest the damper's stretch counts as it is; an adaptive solver, which would not move it, names the force."""
    system = js.System(PAIR, 1.0, (fading(tau=5.0), js.Drag(0.1)), free=np.array([False, True]))
    end = js.rollout(system, START, js.SymplecticEuler(), 0.01, 50).state
    found = js.equilibrium(system, end)
    js.raise_for_status(found)
    np.testing.assert_allclose(found.state.position.x[1], 1.0 + PAIR.flatten(end.memory[0].value)[0], rtol=1e-9)
    np.testing.assert_array_equal(found.state.memory[0].value[0], end.memory[0].value[0])
    with pytest.raises(ValueError, match="Fading: this acts after steps"):
        js.diffeqsolve(system, START, 1.0)


def test_a_history_is_saved_and_a_cache_is_not(tmp_path):
    """`save` keeps what cannot be made anew: a state comes back with its histories, and without its caches."""
    system = js.System(PAIR, 1.0, fading(), rules=Counting())
    end = js.rollout(system, START, js.SymplecticEuler(), 0.01, 5).state
    js.save(tmp_path / "end.npz", end)
    back = js.load(tmp_path / "end.npz", like=end)
    np.testing.assert_array_equal(back.memory[0].value[0], end.memory[0].value[0])
    assert back.memory[1] is None
    on = js.rollout(system, back, js.SymplecticEuler(), 0.01, 5).state
    np.testing.assert_array_equal(on.points, js.rollout(system, end, js.SymplecticEuler(), 0.01, 5).state.points)


def test_a_part_outside_a_system_has_no_place():
    """`recall` of a raw force gives its beginning, and `keep` says where to ask."""
    np.testing.assert_array_equal(PAIR.flatten(fading().recall(START)), [0.0])
    with pytest.raises(ValueError, match=r"Fading has no place .* system\.bind"):
        fading().keep(START, None)


def test_a_file_says_whose_memory_it_holds(tmp_path):
    """The history of one class is never loaded into that of another of the same shapes; a start without memory is told what to pass."""

    class Other(Fading):
        """The same fields, another law."""

    end = js.rollout(held(fading()), START, js.SymplecticEuler(), 0.01, 5).state
    js.save(tmp_path / "end.npz", end)
    other = held(Other(PAIR, jnp.asarray(3.0), jnp.asarray(0.5)))
    with pytest.raises(js.CheckpointError, match="what a Fading remembers; expected that of a Other"):
        js.load(tmp_path / "end.npz", like=other.begin(START))
    with pytest.raises(js.CheckpointError, match=r"like=system\.begin\(state\)"):
        js.load(tmp_path / "end.npz", like=START)
    back = js.load(tmp_path / "end.npz", like=held(fading()).begin(START))
    np.testing.assert_array_equal(back.memory[0].value[0], end.memory[0].value[0])


def test_a_part_as_the_user_holds_it_finds_its_memory():
    """A raw force of a state that came out of a run pulls as the bound one; where several may be meant it says where to ask."""
    force = fading()
    end = js.rollout(held(force), START, js.SymplecticEuler(), 0.01, 20).state
    np.testing.assert_array_equal(force.force(end).x, held(force).force(end).x)
    twice = js.rollout(held(force, force), START, js.SymplecticEuler(), 0.01, 2).state
    with pytest.raises(ValueError, match=r"2 parts that are Fading .*system\.bind"):
        force.force(twice)


def acting(update=None, force=None, remember=None):
    """A force of these methods, as a user may write it wrongly."""

    def still(self, state):
        return js.Vector.zeros_like(state.position)

    methods = {"force": force or still, "update": update, "remember": remember}
    kind = type("Mine", (js.Force,), {name: method for name, method in methods.items() if method is not None})
    return js.System(PAIR, 1.0, kind())


def counted(self, state):
    return jnp.zeros((), jnp.int32)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (lambda: acting(lambda self, step, state: None), "Mine.update gives NoneType; expected a state and a status"),
        (lambda: acting(lambda self, step, state: state), "Mine.update gives State; expected a state and a status"),
        (lambda: acting(lambda self, step, state: (state, None)), "Mine.update gives State, NoneType; expected"),
        (lambda: acting(lambda self, step, state: (self.recall(state), js.Status.ok()), remember=counted), "Mine.update gives .*, Status"),
        (lambda: acting(lambda self, step, state: (self.keep(state, 1.0), js.Status.ok()), remember=counted), "keeps? another structure"),
        (lambda: acting(lambda self, step, state: (self.keep(state, jnp.ones(3)), js.Status.ok())), "keeps? another structure"),
        (lambda: acting(force=lambda self, state: jnp.zeros((2, 1))), "Mine.force gives a .*; expected a Vector of 1 arrays"),
        (lambda: acting(force=lambda self, state: js.Vector((jnp.ones(()),))), r"a Vector of 1 arrays of shape \(\); expected"),
    ],
)
def test_what_a_users_part_gives_is_looked_at(system, message):
    """A method that forgets its result, or gives it in another form, is named with its class before it is used."""
    with pytest.raises(TypeError, match=message):
        js.rollout(system(), START, js.SymplecticEuler(), 0.01, 2)


def test_recalling_what_was_never_remembered_is_named():
    """A misspelt `remember` leaves nothing to recall: said by its class."""
    with pytest.raises(ValueError, match=r"Mine recalls what it never remembered.*remember\(state\)"):
        js.rollout(acting(force=lambda self, state: self.recall(state)), START, js.SymplecticEuler(), 0.01, 2)


def test_arrays_of_a_users_part_are_copied():
    """A NumPy array in a force of one's own that is changed after it was passed no longer changes the system."""

    class Push(js.Force):
        """A given push."""

        push: np.ndarray

        def force(self, state):
            """The push."""
            return js.Vector((jnp.asarray(self.push),))

    given = np.ones(2)
    system = js.System(PAIR, 1.0, Push(given))
    given[:] = 9.0
    np.testing.assert_array_equal(system.force(START).x, [1.0, 1.0])


def test_one_node_without_springs():
    """A force along the springs of a net that has none is no force, on one node too."""
    net = js.lattice(1)
    system = js.System(net, 1.0, Fading(net, jnp.asarray(1.0), jnp.asarray(1.0)))
    end = js.rollout(system, js.State.from_points(net, [[0.0]], [[1.0]]), js.VelocityVerlet(), 0.1, 10).state
    np.testing.assert_allclose(end.points, [[1.0]], rtol=1e-12)


class Sorted(js.Force):
    """A method where a property belongs."""

    def force(self, state):
        """No pull on any node."""
        return js.Vector.zeros_like(state.position)

    def is_symmetric(self, state):
        """Whether the Jacobian is symmetric."""
        return False


class Shadowed(js.Rule):
    """A field in the place of a method."""

    limit: jax.Array


class Placed(js.Rule):
    """A field of the name that the library keeps for itself."""

    place: jax.Array


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.System(PAIR, 1.0, rules=Placed(jnp.ones(()))), "Placed has a field place, which is the part's number"),
        (lambda: js.System(PAIR, 1.0, Sorted()), r"Sorted.is_symmetric is a \w+; expected a bool: make it a @property"),
        (lambda: js.System(PAIR, 1.0, rules=Shadowed(jnp.ones(()))), "has a field limit, but Rule.limit is a method"),
        (lambda: js.rollout(held().bind(float), START, js.Still(), 0.1, 1), "system is a BoundSystem, which a run makes for itself"),
        (lambda: js.equilibrium(START, START), "system is a State; expected a System"),
    ],
)
def test_classes_and_objects_that_do_not_fit(make, message):
    """What would be silently wrong is refused by its name."""
    with pytest.raises(TypeError, match=message):
        make()


def test_bound_parts_know_their_places_and_share_their_leaves():
    """Binding numbers the parts as statuses do, casts every constant once, and a force that reads the others holds no copies of them."""
    system = js.System(PAIR, 2.0, (js.Springs(PAIR, 3.0, 1.0), js.Rayleigh(0.1, 0.2)), rules=(js.Floor((0.0,), (1.0,)), js.Ledger()))
    bound = system.bind(jnp.float32)
    assert [part.place for part in bound.parts] == [0, 1, 2, 3]
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(eqx.filter(bound, eqx.is_inexact_array)))
    assert jax.tree.leaves(bound.forces[1].forces[0])[0] is jax.tree.leaves(bound.forces[0])[0]
    assert jax.tree.leaves(bound.parts[3].rules[0])[0] is jax.tree.leaves(bound.parts[2])[0]
    assert system.forces[0].place is None
