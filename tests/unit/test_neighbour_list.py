"""Neighbour lists: what is in the table, when it is made anew, and how it behaves under transformations."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.cells import find_neighbours
from tests.particles import blob, components, free_net, make, slide_force

CAPACITY = 48
find = jax.jit(lambda position, edge: find_neighbours(position, edge, CAPACITY))


@pytest.mark.slow
@hypothesis.given(st.integers(0, 2**31), st.floats(0.3, 1.5), st.sampled_from([1.0, 4.0, 300.0]))
@hypothesis.settings(max_examples=25)
def test_the_table_holds_the_pairs_that_are_near(seed, edge, extent):
    """For particles anywhere, near or far apart: exactly those nearer than the edge, each once, or a larger capacity is asked for."""
    points = np.random.default_rng(seed).uniform(-extent, extent, (40, 3))
    near = find(tuple(jnp.asarray(points[:, i]) for i in range(3)), jnp.asarray(edge))
    expected = np.linalg.norm(points[:, None] - points[None], axis=-1) < edge
    np.fill_diagonal(expected, False)
    order, table = np.asarray(near.order), np.asarray(near.table)
    if int(near.needed) > CAPACITY:
        # 27 cells hold 6.45 times the ball: more than the room for candidates, though the table might do.
        assert expected.sum(axis=1).max() <= int(near.needed)
        return
    found = np.zeros((40, 40), int)
    for place in range(40):
        for other in table[:, place][table[:, place] < 40]:
            found[order[place], order[other]] += 1
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(order[np.asarray(near.place)], np.arange(40))


@pytest.mark.slow
def test_the_list_is_remade_when_it_must_and_no_pair_is_missed(rng):
    """A hot fluid run with a list ends where it ends with all pairs, to rounding; the list was remade, but not in every step."""
    points, speeds = blob(rng, 64, spacing=1.2), rng.normal(0, 1.5, (64, 3))
    ends = []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(64, 0.4)):
        system, state = make(points, velocities=speeds, cutoff=js.fluid.ShiftedForce(2.5), pairs=pairs)
        ends.append(js.rollout(system, state, js.VelocityVerlet(), 4e-3, 100))
    assert int(ends[1].status.flags) == 0
    np.testing.assert_allclose(ends[1].state.points, ends[0].state.points, atol=1e-9)
    assert 3 <= int(ends[1].state.memory[0].value.rebuilds) <= 50


@pytest.mark.slow
def test_a_step_beyond_the_skin_is_told(rng):
    """A particle that goes a little farther than half the skin in one step raises DT_LIMIT: the list could not have known."""
    system, state = make(
        blob(rng, 8, spacing=3.0), velocities=np.eye(8, 3) * 9.0, cutoff=js.fluid.ShiftedForce(2.5), pairs=js.fluid.NeighbourList(8, 0.1)
    )
    fluid = system.bind(state.dtype).forces[0]
    begun = system.begin(state)
    update = jax.jit(lambda a, b: fluid.update(js.Step(a, b, jnp.asarray(1e-6)), b)[1].flags)
    for share, flag in ((1.05, js.Flag.DT_LIMIT), (0.95, 0)):
        after = begun.moved(begun.position + share * 0.05 / 9.0 * begun.velocity, begun.velocity)
        assert int(update(begun, after)) == int(flag)


@pytest.mark.slow
def test_a_pair_that_meets_within_a_step_is_listed():
    """Two particles farther apart than reach and skin come within reach in the middle of the second step, whose force must know them."""
    points, skin = np.array([[0.0, 0.0], [2.5 + 1.05 * 0.4, 0.0]]), 0.4
    ends = []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(8, skin)):
        # 0.3 skins in each step; so heavy that no collision limits the step.
        speeds = np.array([[12.0, 0.0], [-12.0, 0.0]])
        system, state = make(points, 100.0, velocities=speeds, cutoff=js.fluid.PlainCutoff(2.5), pairs=pairs)
        ends.append(js.rollout(system, state, js.VelocityVerlet(), 0.01, 2))
    assert int(ends[1].status.flags) == 0
    assert float(ends[0].state.velocity.x[0]) > 12.1
    np.testing.assert_allclose(ends[1].state.velocities, ends[0].state.velocities, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [3.0, 5 * 3.0, 7 * 3.0, 64 * 3.0])
def test_forces_wherever_particles_are(gap):
    """Forty particles in a row, so far apart that only the last two meet: with a small list, too, their forces are those of all pairs."""
    points = np.stack([gap * np.arange(40), np.zeros(40)], axis=1)
    points[39] = points[38] + [1.2, 0.0]
    for dim in (1, 2):
        system, state = make(points[:, :dim], cutoff=js.fluid.PlainCutoff(2.5), pairs=js.fluid.NeighbourList(8, 0.5))
        force = components(system.force(state))
        np.testing.assert_allclose(force, slide_force(points[:, :dim], np.ones(40), reach=2.5), atol=1e-12)
        assert np.abs(force[38:]).max() > 0.1


@pytest.mark.slow
def test_every_step_tells_an_overflow(rng):
    """The step itself says NEIGHBOUR_OVERFLOW with the capacity that is needed, whatever the list holds when the run ends."""
    system, state = make(blob(rng, 60, spacing=0.8), cutoff=js.fluid.ShiftedForce(2.5), pairs=js.fluid.NeighbourList(8, 0.3))
    fluid = system.bind(state.dtype).forces[0]
    begun = system.begin(state)
    status = jax.jit(lambda state: fluid.update(js.Step(state, state, jnp.asarray(1e-6)), state)[1])(begun)
    assert int(status.flags) == int(js.Flag.NEIGHBOUR_OVERFLOW)
    (count,) = (int(found.count) for found in fluid.diagnose(begun) if found.flag == js.Flag.NEIGHBOUR_OVERFLOW)
    assert int(status.count) == count > 8


@pytest.mark.slow
def test_a_batch_of_fluids_is_each_alone(rng):
    """Vmap over positions and over a constant of the law gives each lane's own forces; one compile serves other values."""
    n_traces = 0
    points = np.stack([blob(rng, 30) for _ in range(3)])
    net = make(points[0])[0].net

    def force(points, alpha):
        nonlocal n_traces
        n_traces += 1
        fluid = js.Fluid(js.fluid.SlideLaw(alpha, 1.0, 0.1), cutoff=js.fluid.ShiftedForce(2.5), pairs=js.fluid.NeighbourList(64, 0.3))
        return js.System(net, 1.0, fluid).force(js.State.from_points(net, points))

    alpha = jnp.array([0.8, 1.0, 1.3])
    together = jax.jit(jax.vmap(force))
    lanes = together(jnp.asarray(points), alpha)
    together(jnp.asarray(points) + 0.1, alpha)
    assert n_traces == 1
    for lane in range(3):
        alone, state = make(points[lane], law=js.fluid.SlideLaw(alpha[lane], 1.0, 0.1), cutoff=js.fluid.ShiftedForce(2.5))
        ours = np.stack([a[lane] for a in lanes], axis=-1)
        np.testing.assert_allclose(ours, components(alone.force(state)), rtol=1e-11, atol=1e-11)


def crystal(rng, cutoff=2.5, capacity=60):
    """A Lennard-Jones system with a list, and points on a lattice."""
    grid = np.stack(np.meshgrid(*[np.arange(4) * 1.2] * 3), axis=-1).reshape(-1, 3) + rng.normal(0, 0.03, (64, 3))
    law, reach = js.fluid.LennardJones(1.0, 1.0), js.fluid.PlainCutoff(cutoff)
    return make(grid, law=law, cutoff=reach, pairs=js.fluid.NeighbourList(capacity, 0.3))


def moved_points(state, points):
    """The state with other positions, its list as it was."""
    return state.moved(js.State.from_points(free_net(len(points)), points).position, state.velocity)


@pytest.mark.slow
def test_a_list_of_other_positions_is_not_used(rng):
    """Forces and energy of a state moved by hand are those of a fresh one; a run from there makes a new list."""
    system, state = crystal(rng)
    begun = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2).state
    fresh = js.State.from_points(free_net(64), rng.permutation(state.points), state.velocities)
    moved = moved_points(begun, fresh.points)
    np.testing.assert_allclose(components(system.force(moved)), components(system.force(fresh)), atol=1e-11)
    np.testing.assert_allclose(system.energy(moved).potential[0], system.energy(fresh).potential[0], rtol=1e-12)
    fresh = fresh.moved(fresh.position, moved.velocity)
    ends = [js.rollout(system, start, js.VelocityVerlet(), 1e-3, 5) for start in (moved, fresh)]
    np.testing.assert_allclose(ends[0].state.points, ends[1].state.points, atol=1e-12)
    assert int(ends[0].state.memory[0].value.rebuilds) == int(ends[1].state.memory[0].value.rebuilds)


@pytest.mark.slow
@pytest.mark.parametrize(("cutoff", "capacity"), [(3.0, 60), (2.0, 60), (2.5, 64)])
def test_going_on_with_another_cut_off_or_capacity(cutoff, capacity, rng):
    """A state with a list goes on under another reach or capacity as one without."""
    system, state = crystal(rng)
    begun = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2).state
    other, _ = crystal(rng, cutoff, capacity)
    fresh = js.State.from_points(free_net(64), begun.points, begun.velocities)
    np.testing.assert_allclose(components(other.force(begun)), components(other.force(fresh)), atol=1e-11)
    ends = [js.rollout(other, start, js.VelocityVerlet(), 1e-3, 5) for start in (begun, fresh)]
    np.testing.assert_allclose(ends[0].state.points, ends[1].state.points, atol=1e-12)


def test_a_list_that_serves_is_kept(rng):
    """Two runs in a row make no list between them."""
    system, state = crystal(rng)
    first = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2).state
    second = js.rollout(system, first, js.VelocityVerlet(), 1e-3, 2).state
    np.testing.assert_array_equal(second.memory[0].value.reference, state.position.components)


@pytest.mark.slow
def test_a_pair_pushed_together_within_a_step(rng):
    """Two particles that a load brings within reach in one step: as with all pairs, though the step before was too short to tell."""
    ends = []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(4, 0.3)):
        points = np.array([[0.0, 0.0], [2.8001, 0.0]])
        system, state = make(points, law=js.fluid.LennardJones(1.0, 1.0), cutoff=js.fluid.PlainCutoff(2.5), pairs=pairs)
        push = js.Load.from_points(system.net, [[0.04, 0.0], [-0.04, 0.0]])
        system = js.System(system.net, 1.0, (*system.forces, push))
        ends.append(js.rollout(system, state, js.VelocityVerlet(), 1.0, 3).state.velocities)
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-12)
    assert abs(ends[0][0, 0]) > 0.13  # 0.12 without the attraction


@pytest.mark.slow
@pytest.mark.parametrize("n_steps", [0, 1])
def test_solvers_of_diffrax_with_a_list(n_steps):
    """Two particles that meet: as with all pairs, from a state with a list and from one without."""
    ends = []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(4, 0.3)):
        system, state = make(
            np.array([[-3.0, 0.0], [3.0, 0.2]]),
            law=js.fluid.LennardJones(1.0, 1.0),
            velocities=np.array([[1.0, 0.0], [-1.0, 0.0]]),
            cutoff=js.fluid.PlainCutoff(2.5),
            pairs=pairs,
        )
        start = state if n_steps == 0 else js.rollout(system, state, js.VelocityVerlet(), 0.005, n_steps).state
        ends.append(js.diffeqsolve(system, start, t1=6.0).state.points)
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9)
    assert abs(ends[0][0, 1]) > 0.1  # they turned each other


@pytest.mark.slow
def test_equilibrium_with_a_list(rng):
    """A drop at rest feels no force, whether or not the state had a list."""
    system, state = crystal(rng, cutoff=2.5)
    begun = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2).state
    rest = js.equilibrium(system, moved_points(begun, 1.1 * begun.points))
    fresh = js.State.from_points(free_net(64), rest.state.points)
    assert np.abs(components(system.force(fresh))).max() < 1e-6
