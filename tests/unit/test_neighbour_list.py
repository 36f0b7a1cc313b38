"""Neighbour lists: what is in the table, when it is made anew, and how it behaves under transformations."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.cells import find_neighbours
from tests.particles import blob, components, make

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
    for pairs in (js.AllPairs(), js.NeighbourList(64, 0.4)):
        system, state = make(points, velocities=speeds, cutoff=js.ShiftedForce(2.5), pairs=pairs)
        ends.append(js.rollout(system, state, js.VelocityVerlet(), 4e-3, 100))
    assert int(ends[1].status.flags) == 0
    np.testing.assert_allclose(ends[1].state.points, ends[0].state.points, atol=1e-9)
    assert 3 <= int(ends[1].state.neighbours.rebuilds) <= 50


@pytest.mark.slow
def test_a_step_beyond_the_skin_is_told(rng):
    """A particle that goes farther than half the skin in one step raises DT_LIMIT: the list could not have known."""
    system, state = make(
        blob(rng, 8, spacing=3.0), velocities=np.full((8, 3), 9.0), cutoff=js.ShiftedForce(2.5), pairs=js.NeighbourList(8, 0.1)
    )
    fluid = system.prepare(state.dtype).forces[0]
    begun = fluid.begin(state)
    after = begun.moved(begun.position + 0.01 * begun.velocity, begun.velocity)
    update = jax.jit(lambda a, b: fluid.update(a, b, jnp.asarray(1e-6))[1].flags)
    assert int(update(begun, after)) == int(js.Flag.DT_LIMIT)
    assert int(update(begun, begun)) == 0


@pytest.mark.slow
def test_a_batch_of_fluids_is_each_alone(rng):
    """Vmap over positions and over a constant of the law gives each lane's own forces; one compile serves other values."""
    n_traces = 0
    points = np.stack([blob(rng, 30) for _ in range(3)])
    net = make(points[0])[0].net

    def force(points, alpha):
        nonlocal n_traces
        n_traces += 1
        fluid = js.Fluid(js.SlideLaw(alpha, 1.0, 0.1), cutoff=js.ShiftedForce(2.5), pairs=js.NeighbourList(64, 0.3))
        return js.System(net, 1.0, fluid).force(js.State.from_points(net, points))

    alpha = jnp.array([0.8, 1.0, 1.3])
    together = jax.jit(jax.vmap(force))
    lanes = together(jnp.asarray(points), alpha)
    together(jnp.asarray(points) + 0.1, alpha)
    assert n_traces == 1
    for lane in range(3):
        alone, state = make(points[lane], law=js.SlideLaw(alpha[lane], 1.0, 0.1), cutoff=js.ShiftedForce(2.5))
        ours = np.stack([a[lane] for a in lanes], axis=-1)
        np.testing.assert_allclose(ours, components(alone.force(state)), rtol=1e-11, atol=1e-11)
