"""Which particles are fluid, what mixed pairs do, and that nothing is summed before something melts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxspring as js
from jaxspring.forces.cutoffs import Cutoff
from jaxspring.numerics import any_lane
from tests.particles import components

CALLS = []


class CountedLaw(js.fluid.SlideLaw):
    """The slides' law, telling the host each time a tile of pairs is evaluated."""

    def weight(self, squared):
        """As the slides' law."""
        jax.debug.callback(lambda: CALLS.append(1))
        return super().weight(squared)


def scene(law=None, **options):
    """A row of five particles, four springs; the state has all springs alive."""
    net = js.lattice(5)
    fluid = js.Fluid(js.fluid.gentle_fluid(1.0) if law is None else law, molten=js.fluid.Molten(net), **options)
    system = js.System(net, mass=1.0, forces=(js.Springs(net, 10.0, 1.0), fluid))
    return net, system, js.State.from_points(net, [[0.0, 0], [0.9, 0.1], [2.0, 0], [2.9, 0], [4.2, 0]])


def with_springs(net, state, alive):
    """The state in which these springs are alive."""
    return dataclasses.replace(state, alive=net.edge_field(jnp.asarray(alive, float)).map(lambda a: a > 0))


def force_of_fluid(system, state):
    """(N, D) forces of the fluid alone."""
    return components(system.bind(state.dtype).forces[1].force(state))


def test_a_particle_is_fluid_when_its_last_spring_has_broken():
    """Springs 0-1 and 1-2 broken: particles 0 and 1 are fluid, 2 still holds on; with no `alive` nothing is."""
    net, _, state = scene()
    molten = js.fluid.Molten(net)
    assert np.asarray(molten.is_fluid(with_springs(net, state, [0, 0, 1, 1]))).tolist() == [True, True, False, False, False]
    assert not np.asarray(molten.is_fluid(state)).any()
    lonely = js.Graph.from_edges(np.array([[0, 1]]), 3)
    at = js.State.from_points(lonely, np.zeros((3, 2)))
    assert np.asarray(lonely.flatten_nodes(js.fluid.Molten(lonely).is_fluid(at))).tolist() == [False, False, True]


def test_melted_fraction():
    """Two of five particles without a living spring: 0.4; none, and all of them, at the ends."""
    net, _, state = scene()
    for alive, share in (([0, 0, 1, 1], 0.4), ([1, 1, 1, 1], 0.0), ([0, 0, 0, 0], 1.0)):
        assert float(js.thermal.melted_fraction(net, with_springs(net, state, alive))) == share


def test_molten_of_another_net_than_the_springs():
    """A fluid, and a share that has melted, on a net whose springs are not those that break are refused with both nets."""
    bare, sheared = js.lattice((3, 3)), js.lattice((3, 3), js.STRUCTURAL + js.SHEAR)
    state = js.State.from_points(sheared, sheared.grid())
    fluid = js.Fluid(js.fluid.gentle_fluid(1.0), molten=js.fluid.Molten(bare))
    both = r"Molten has a Lattice of 12 springs .* Springs of this system have a Lattice of 20 springs"
    with pytest.raises(ValueError, match=both):
        js.System(sheared, 1.0, (js.Springs(sheared, 1.0, 1.0), fluid))
    whole = js.topology.EdgeField(tuple(jnp.ones(shape, bool) for shape in sheared.family_shapes))
    with pytest.raises(ValueError, match=r"state.alive tells about springs .* Lattice of 12 springs"):
        js.thermal.melted_fraction(bare, dataclasses.replace(state, alive=whole))


@pytest.mark.parametrize("pairs", [js.fluid.AllPairs(), js.fluid.AllPairs(2), js.fluid.NeighbourList(8, 0.5)], ids=["all", "tiles", "list"])
def test_mixed_pairs_repel_only(pairs):
    """Two fluid particles have the whole law, a fluid and a solid one its repulsion, two solid ones nothing; pair by pair in NumPy."""
    net, system, state = scene(cutoff=js.fluid.PlainCutoff(9.0), pairs=pairs)
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
    fluid = system.bind(state.dtype).forces[1]
    slope = jax.grad(lambda x: fluid.energy(state.moved(x, state.velocity)))(state.position)
    np.testing.assert_allclose(components(slope), -force_of_fluid(system, state), atol=1e-14)


@pytest.mark.parametrize("r", [0.05, 0.3, 0.8, 0.999, 1.001, 2.0])
def test_energy_of_a_mixed_pair_is_the_work_of_its_repulsion(r):
    """From r out to r_0, below the core too; nothing beyond r_0, without a step there."""
    core = 0.2
    net = js.Graph.from_edges(np.array([[1, 2]]), 3)
    # The solid particle's partner is far away, but no pair: both hang on one spring.
    fluid = js.System(net, 1.0, js.Fluid(js.fluid.SlideLaw(1.0, 1.0), core=core, molten=js.fluid.Molten(net))).bind(float).forces[0]
    state = js.State.from_points(net, [[0.0, 0.0], [r, 0.0], [99.0, 0.0]])

    def push(s):
        return max(1 / max(s, core) ** 4 - 1 / max(s, core) ** 2, 0) * s

    work = scipy.integrate.quad(push, r, 1.0, points=[core], epsabs=1e-12)[0] if r < 1 else 0.0
    assert float(fluid.energy(state)) == pytest.approx(work, abs=1e-9)


def test_what_is_solid_drags_counts_and_limits_nothing():
    """Drag, its bound, overlaps and the step for collisions look at what is fluid; a fluid one and a solid one drag."""
    net, system, state = scene(drag=js.fluid.PairDrag(0.5, 2.0), core=0.95)
    speeds = np.array([[0.0, 0], [0, 0], [0, 0], [1, 0], [-9, 0]])
    state = dataclasses.replace(state, velocity=js.State.from_points(net, state.points, speeds).velocity)
    # Only particle 0 is fluid: beside it 1 stands still, and 2 and 3 are nearer to each other than the core.
    at = with_springs(net, state, [0, 1, 1, 1])
    fluid = system.bind(state.dtype).forces[1]
    still = at.moved(at.position, js.Vector.zeros_like(at.velocity))
    np.testing.assert_allclose(force_of_fluid(system, at), force_of_fluid(system, still), atol=1e-15)
    pulled = at.moved(at.position, js.State.from_points(net, state.points, speeds[[3, 0, 0, 0, 0]]).velocity)
    r = np.hypot(0.9, 0.1)
    # The distance of a pair nearer than the core is taken as the core's.
    u, rate = np.array([-0.9, -0.1]) / 0.95, 0.5 * (1 - 0.95 / 2.0) ** 2
    assert r < 0.95
    drag = force_of_fluid(system, pulled) - force_of_fluid(system, still)
    np.testing.assert_allclose(drag[1], rate * u[0] * u, rtol=1e-12)
    np.testing.assert_allclose(drag[[0, 1]].sum(axis=0), 0, atol=1e-15)
    np.testing.assert_array_equal(drag[2:], 0)
    bound = np.asarray(fluid.damping_bound(at))
    np.testing.assert_allclose(bound, [2 * rate, 2 * rate, 0, 0, 0], rtol=1e-12)
    (overlaps,) = fluid.diagnose(at)
    assert (overlaps.flag, int(overlaps.count), int(overlaps.node)) == (js.Flag.OVERLAP, 1, 0)
    assert float(fluid.collision_dt(at)[0]) == np.inf
    assert int(fluid.update(js.Step(at, at, jnp.asarray(1.0)), at)[1].flags) == 0


def test_bound_of_stiffness_of_a_mixed_pair():
    """Two particles, one fluid: twice the stiffness of the repulsion where it acts, zero beyond r_0."""
    net = js.Graph.from_edges(np.array([[1, 2]]), 3)
    fluid = js.System(net, 1.0, js.Fluid(js.fluid.SlideLaw(1.0, 1.0), molten=js.fluid.Molten(net))).bind(float).forces[0]
    for r, k in ((0.8, 3 / 0.8**4 - 1 / 0.8**2), (1.5, 0.0)):
        bound = fluid.stiffness_bound(js.State.from_points(net, [[0.0, 0.0], [r, 0.0], [99.0, 0.0]]))
        np.testing.assert_allclose(net.flatten_nodes(bound), [2 * k, 2 * k, 0], rtol=1e-12)


def test_no_pair_is_evaluated_before_something_melts():
    """The law is called for no tile while every spring is alive, and for each once one particle is free; so in a batch of scenes."""
    net, system, state = scene(CountedLaw(1.0, 1.0), pairs=js.fluid.AllPairs(tile=2))
    fluid = system.bind(state.dtype).forces[1]
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


class CountedPairs(js.fluid.AllPairs):
    """Every pair, telling the host each time they are gone through, for whatever term."""

    def visit(self, *arguments):
        """As every pair."""
        jax.debug.callback(lambda: CALLS.append(1))
        return super().visit(*arguments)


@pytest.mark.slow
def test_a_run_goes_through_no_pairs_before_something_melts():
    """A whole run with its limits, statuses and book of energy: no pass while every spring holds, also in a batch of runs; at least one
    pass a step from when one particle of one run is free.
    """
    net = js.lattice(5)
    fluid = js.Fluid(js.fluid.gentle_fluid(1.0), pairs=CountedPairs(), molten=js.fluid.Molten(net))
    rules = (js.Heat(net, 1.0, 1.0), js.Fusing(net, 350.0), js.Ledger())
    system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), fluid), rules=rules)

    def run(temperature):
        start = js.State.from_points(net, 1.02 * net.grid(), temperature=temperature)
        result = js.rollout(system, start, js.SymplecticEuler(), 0.01, 12)
        return js.thermal.melted_fraction(net, result.state), result.status.flags

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
        """No distance, as of a law without an end."""
        return None

    def weight(self, law, squared):
        """The law's."""
        return law.weight(squared)

    def potential(self, law, squared):
        """The law's."""
        return law.potential(squared)


LISTED = js.Fluid(js.fluid.SlideLaw(1.0, 1.0), js.fluid.PlainCutoff(2.0), js.fluid.NeighbourList(8, 0.1))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: js.fluid.SlideLaw(-1.0, 1.0), "alpha = -1.0, but must be positive"),
        (lambda: js.fluid.SlideLaw(1.0, np.nan), "beta = nan, but must be finite"),
        (lambda: js.fluid.SlideLaw(1.0, 1.0, -0.1), "zeta = -0.1, but must be zero or more"),
        (lambda: js.fluid.SlideLaw(1.0, 1.0, a=4, b=4), "a = 4, b = 4"),
        (lambda: js.fluid.SlideLaw(1.0, np.ones(3)), "beta has shape"),
        (lambda: js.fluid.Switched(2.0, 1.5), "on = 2.0 is not below off = 1.5"),
        (lambda: js.fluid.AllPairs(0), "tile = 0"),
        (lambda: js.fluid.NeighbourList(0, 0.1), "capacity = 0"),
        (lambda: js.fluid.NeighbourList(8, 0.0), "skin = 0.0, but must be positive"),
        (lambda: js.fluid.NeighbourList(8, -1.0), "skin = -1.0, but must be positive. The list would be out of date"),
        (lambda: js.fluid.PairDrag(-1.0, 1.0), "damping = -1.0"),
        (lambda: js.fluid.PairDrag(1.0, 0.0), "radius = 0.0, but must be positive. No pair would be within it"),
        (lambda: js.fluid.PlainCutoff(0.0), "radius = 0.0, but must be positive. No pair would be within it"),
        (lambda: js.fluid.Switched(-1.0, 2.0), "on = -1.0, but must be positive. A switch fades"),
        (lambda: js.fluid.gentle_fluid(-1.0), "spacing = -1.0, but must be positive. Particles of a lattice"),
        (lambda: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), core=0.0), "core = 0.0, but must be positive. Two particles at one place"),
        (lambda: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), pairs=js.fluid.NeighbourList(8, 0.1)), "a neighbour list needs a law that ends"),
        (
            lambda: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), Endless(), js.fluid.NeighbourList(8, 0.1)),
            "a neighbour list needs a law that ends",
        ),
        (
            lambda: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), js.fluid.PlainCutoff(0.9)),
            "the equilibrium distance = 1.0 m is beyond the cut-off",
        ),
        (lambda: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), js.fluid.PlainCutoff(2.0), core=3.0), "core = 3.0 m is beyond the cut-off"),
        (
            lambda: js.Fluid(
                js.fluid.SlideLaw(1.0, 1.0), js.fluid.PlainCutoff(2.0), js.fluid.NeighbourList(8, 0.1), js.fluid.PairDrag(1.0, 2.5)
            ),
            "drag.radius = 2.5 m is beyond the cut-off",
        ),
    ],
)
def test_refusals(build, message):
    """What cannot be is refused when it is built, by name."""
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.slow
def test_a_list_rests_until_something_melts():
    """A flying chain that is cut on its way: its list is not remade before the cut, and the ends are those of all pairs."""
    net, found = js.lattice(5), []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(8, 0.2)):
        fluid = js.Fluid(js.fluid.gentle_fluid(1.0), js.fluid.ShiftedForce(2.5), pairs, molten=js.fluid.Molten(net))
        fusing = js.Fusing(net, 350.0)
        system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), fluid), rules=fusing)
        points = 1.02 * np.arange(5.0)[:, None] * [[1.0, 0.0]]
        start = js.State.from_points(net, points, np.full((5, 2), 2.0), temperature=300.0)
        cold = js.rollout(system, start, js.SymplecticEuler(), 0.01, 40).state
        hot = dataclasses.replace(cold, temperature=jnp.asarray([400.0, 400.0, 400.0, 300.0, 300.0]))
        found.append((cold, js.rollout(system, hot, js.SymplecticEuler(), 0.01, 40).state))
    (_, everyone), (cold, listed) = found
    assert int(cold.memory[1].value.rebuilds) == 0
    assert int(listed.memory[1].value.rebuilds) > 0
    np.testing.assert_allclose(listed.points, everyone.points, rtol=1e-13)


LJ = js.fluid.LennardJones(1.0, 1.0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: js.Fluid(LJ, 2.5), r"cutoff is 2.5, a float; expected a Cutoff, e.g. ShiftedForce\(2.5\)"),
        (lambda: js.Fluid("lj"), "law is 'lj', a str; expected a PairLaw"),
        (lambda: js.Fluid(js.fluid.LennardJones), "law is the class LennardJones; expected a PairLaw. Make one"),
        (lambda: js.Fluid(LJ, js.fluid.PlainCutoff(2.5), "list"), "pairs is 'list', a str; expected a Pairs"),
        (lambda: js.Fluid(LJ, drag=0.5), "drag is 0.5, a float; expected a PairDrag"),
        (lambda: js.Fluid(LJ, molten=js.lattice(2)), r"molten is .*, a Lattice; expected a Molten, e.g. Molten\(net\)"),
    ],
)
def test_parts_of_another_kind(build, message):
    """A part of a fluid of another kind is refused when it is built, with an example of the right one."""
    with pytest.raises(TypeError, match=message):
        build()


def test_whole_numbers_of_numpy():
    """Sizes may come from NumPy, and are kept as Python's."""
    assert js.fluid.NeighbourList(np.int64(18), 0.3).capacity == js.fluid.NeighbourList(18, 0.3).capacity == 20
    tile = js.fluid.AllPairs(np.int32(20)).tile
    assert (tile, type(tile)) == (20, int)
