"""Which particles are fluid, what mixed pairs do, and that nothing is summed before something melts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.cutoffs import Cutoff
from jaxspring.numerics import any_lane
from tests.particles import components

CALLS = []


class CountedLaw(js.SlideLaw):
    """The slides' law, telling the host each time a tile of pairs is evaluated."""

    def weight(self, squared):
        """As the slides' law."""
        jax.debug.callback(lambda: CALLS.append(1))
        return super().weight(squared)


def scene(law=None, **options):
    """A row of five particles, four springs; the state has all springs alive."""
    net = js.lattice(5)
    fluid = js.Fluid(js.gentle_fluid(1.0) if law is None else law, molten=js.Molten(net), **options)
    system = js.System(net, mass=1.0, forces=(js.Springs(net, 10.0, 1.0), fluid))
    return net, system, js.State.from_points(net, [[0.0, 0], [0.9, 0.1], [2.0, 0], [2.9, 0], [4.2, 0]])


def with_springs(net, state, alive):
    """The state in which these springs are alive."""
    return dataclasses.replace(state, alive=net.edge_field(jnp.asarray(alive, float)).map(lambda a: a > 0))


def force_of_fluid(system, state):
    """(N, D) forces of the fluid alone."""
    return components(system.prepare(state.dtype).forces[1].force(state))


def test_a_particle_is_fluid_when_its_last_spring_has_broken():
    """Springs 0-1 and 1-2 broken: particles 0 and 1 are fluid, 2 still holds on; with no `alive` nothing is."""
    net, _, state = scene()
    molten = js.Molten(net)
    assert np.asarray(molten.is_fluid(with_springs(net, state, [0, 0, 1, 1]))).tolist() == [True, True, False, False, False]
    assert not np.asarray(molten.is_fluid(state)).any()
    lonely = js.Graph.from_edges(np.array([[0, 1]]), 3)
    at = js.State.from_points(lonely, np.zeros((3, 2)))
    assert np.asarray(lonely.flatten_nodes(js.Molten(lonely).is_fluid(at))).tolist() == [False, False, True]


@pytest.mark.parametrize("pairs", [js.AllPairs(), js.AllPairs(2), js.NeighbourList(8, 0.5)], ids=["all", "tiles", "list"])
def test_mixed_pairs_repel_only(pairs):
    """Two fluid particles have the whole law, a fluid and a solid one its repulsion, two solid ones nothing; pair by pair in NumPy."""
    net, system, state = scene(cutoff=js.PlainCutoff(9.0), pairs=pairs)
    state = with_springs(net, state, [0, 0, 1, 1])
    points, fluid = np.asarray(state.points), [True, True, False, False, False]
    expected = np.zeros_like(points)
    for i in range(5):
        for j in range(5):
            if i != j:
                d = points[i] - points[j]
                r = np.linalg.norm(d)
                weight = -1 / r**2 + 1 / r**4
                kind = fluid[i] + fluid[j]
                expected[i] += (weight if kind == 2 else max(weight, 0) if kind == 1 else 0) * d
    np.testing.assert_allclose(force_of_fluid(system, state), expected, atol=1e-14)


def test_energy_of_mixed_pairs_gives_their_force():
    """The gradient of the energy is minus the force, fluid and solid mixed, one of the pairs nearer than r_0."""
    net, system, state = scene()
    state = with_springs(net, state, [0, 0, 1, 1])
    fluid = system.prepare(state.dtype).forces[1]
    slope = jax.grad(lambda x: fluid.energy(state.moved(x, state.velocity)))(state.position)
    np.testing.assert_allclose(components(slope), -force_of_fluid(system, state), atol=1e-14)


def test_no_pair_is_evaluated_before_something_melts():
    """The law is called for no tile while every spring is alive, and for each once one particle is free; so in a batch of scenes."""
    net, system, state = scene(CountedLaw(1.0, 1.0), pairs=js.AllPairs(tile=2))
    fluid = system.prepare(state.dtype).forces[1]
    force = jax.jit(lambda state: fluid.force(state))

    def count(function, *arguments):
        CALLS.clear()
        jax.block_until_ready(function(*arguments))
        jax.effects_barrier()
        return len(CALLS)

    solid, melted = (with_springs(net, state, alive) for alive in ([1, 1, 1, 1], [0, 1, 1, 1]))
    assert count(force, solid) == 0
    assert count(force, melted) > 0
    batch = jax.jit(jax.vmap(lambda state: fluid.force(state)))
    stack = lambda *states: jax.tree.map(lambda *a: jnp.stack(a), *states)  # noqa: E731
    assert count(batch, stack(solid, solid)) == 0
    assert count(batch, stack(solid, melted)) > 0
    lanes = batch(stack(solid, melted))
    np.testing.assert_array_equal(lanes.x[0], 0)
    np.testing.assert_allclose(lanes.x[1], force(melted).x, rtol=1e-14)


class CountedPairs(js.AllPairs):
    """Every pair, telling the host each time they are gone through, for whatever term."""

    def sum(self, *arguments):
        """As every pair."""
        jax.debug.callback(lambda: CALLS.append(1))
        return super().sum(*arguments)


@pytest.mark.slow
def test_a_run_goes_through_no_pairs_before_something_melts():
    """A whole run with its limits, statuses and book of energy: no pass while every spring holds, also in a batch of runs; at least one
    pass a step from when one particle of one run is free.
    """
    net = js.lattice(5)
    fluid = js.Fluid(js.gentle_fluid(1.0), pairs=CountedPairs(), molten=js.Molten(net))
    rules = js.Ledger((js.Heat(net, 1.0, 1.0), js.Fusing(net, 350.0)))
    system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), fluid), rules=rules)

    def run(temperature):
        start = js.State.from_points(net, 1.02 * net.grid(), temperature=temperature)
        result = js.rollout(system, start, js.SymplecticEuler(), 0.01, 12)
        return js.melted_fraction(net, result.state), result.status.flags

    def passes(function, temperature):
        CALLS.clear()
        melted, flags = jax.block_until_ready(function(jnp.asarray(temperature)))
        jax.effects_barrier()
        assert not np.any(flags)
        return len(CALLS), np.asarray(melted).tolist()

    single, batch = jax.jit(run), jax.jit(jax.vmap(run))
    cold, hot = np.full(5, 300.0), np.array([900.0, 300.0, 300.0, 300.0, 300.0])
    assert passes(single, cold) == (0, 0)
    assert passes(batch, [cold, cold]) == (0, [0, 0])
    assert passes(single, hot)[0] >= 12
    count, melted = passes(batch, [cold, hot])
    assert count >= 12
    assert melted[0] == 0 < melted[1]


def test_any_lane_is_one_value_for_all_lanes():
    """Under vmap, and vmap of vmap, the flag is true where any lane's is, and has no batch axis; without vmap it is itself."""
    flags = jnp.array([[False, False], [False, True]])
    assert bool(jax.jit(any_lane)(jnp.asarray(True)))
    assert jax.vmap(any_lane, out_axes=None)(flags[1])
    assert not jax.vmap(any_lane, out_axes=None)(flags[0])
    assert jax.vmap(jax.vmap(any_lane, out_axes=None), out_axes=None)(flags)


class Endless(Cutoff):
    """A cut-off of one's own, beyond which nothing changes."""

    @property
    def reach(self):
        """None."""
        return None

    def weight(self, law, squared):
        """The law's."""
        return law.weight(squared)

    def potential(self, law, squared):
        """The law's."""
        return law.potential(squared)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: js.SlideLaw(-1.0, 1.0), "alpha = -1.0, but must be positive"),
        (lambda: js.SlideLaw(1.0, np.nan), "beta = nan, but must be finite"),
        (lambda: js.SlideLaw(1.0, 1.0, -0.1), "zeta = -0.1, but must be zero or more"),
        (lambda: js.SlideLaw(1.0, 1.0, a=4, b=4), "a = 4, b = 4"),
        (lambda: js.SlideLaw(1.0, np.ones(3)), "beta has shape"),
        (lambda: js.Switched(2.0, 1.5), "on = 2.0 is not below off = 1.5"),
        (lambda: js.AllPairs(0), "tile = 0"),
        (lambda: js.NeighbourList(0, 0.1), "capacity = 0"),
        (lambda: js.NeighbourList(8, 0.0), "skin = 0.0, but must be positive"),
        (lambda: js.PairDrag(-1.0, 1.0), "damping = -1.0"),
        (lambda: js.Fluid(js.SlideLaw(1.0, 1.0), pairs=js.NeighbourList(8, 0.1)), "a neighbour list needs a law that ends"),
        (lambda: js.Fluid(js.SlideLaw(1.0, 1.0), Endless(), js.NeighbourList(8, 0.1)), "a neighbour list needs a law that ends"),
        (lambda: js.Fluid(js.SlideLaw(1.0, 1.0), js.PlainCutoff(0.9)), "the equilibrium distance = 1.0 m is beyond the cut-off"),
        (lambda: js.Fluid(js.SlideLaw(1.0, 1.0), js.PlainCutoff(2.0), core=3.0), "core = 3.0 m is beyond the cut-off"),
    ],
)
def test_refusals(build, message):
    """What cannot be is refused when it is built, by name."""
    with pytest.raises(ValueError, match=message):
        build()
