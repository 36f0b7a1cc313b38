"""Contact of nodes with nodes: forces in NumPy, momentum, exchange, what is left out, several lists."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

c = js.contact
SHEET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)
FLAT = np.c_[SHEET.grid(1.0), 0 * SHEET.grid()[:, :1]]
GRAPH = js.Graph.from_edges(SHEET.edges[::-1], 20)
K, ONSET, DAMPING, MU, CREEP = 100.0, 0.1, 2.0, 0.3, 0.5


def rows(net, v):
    return np.stack([np.asarray(net.flatten_nodes(a)) for a in v], axis=-1)


def crumpled(rng):
    """Places, velocities and radii of a sheet in a heap."""
    return rng.uniform(0, 1.7, (20, 3)), rng.normal(size=(20, 3)), rng.uniform(0.3, 0.7, 20)


def force_of_pairs(x, v, radius):
    """(N, 3) forces, pair by pair, as `law.py` has them in words."""
    force, joined = np.zeros_like(x), {tuple(sorted(e)) for e in SHEET.edges.tolist()}
    for i in range(len(x)):
        for j in range(len(x)):
            reach = radius[i] + radius[j]
            if i == j or tuple(sorted((i, j))) in joined or np.linalg.norm(FLAT[i] - FLAT[j]) < reach:
                continue
            d = x[i] - x[j]
            s, u = reach - np.linalg.norm(d), d / np.linalg.norm(d)
            if s <= 0:
                continue
            push, t = K * (s * s / (2 * ONSET) if s < ONSET else s - ONSET / 2), min(s / ONSET, 1)
            along = (v[i] - v[j]) @ u
            slip = v[i] - v[j] - along * u
            y = np.linalg.norm(slip) / CREEP
            grip = MU * push * (2 * y - y * y if y < 1 else 1)
            force[i] += (push - DAMPING * t * t * (3 - 2 * t) * along) * u - grip * slip / np.linalg.norm(slip)
    return force


PAIRS = {
    "all": None,
    "list": js.fluid.NeighbourList(24, 0.3),
    "too small a list": js.fluid.NeighbourList(4, 0.3),
}


@pytest.mark.parametrize(("net", "pairs"), [(SHEET, "all"), (SHEET, "list"), (GRAPH, "too small a list")], ids=["all", "list", "graph"])
def test_force_against_numpy(net, pairs, rng):
    """With radii per node, damper and friction the force is the sum over pairs that no spring joins and that did not touch at rest, on
    lattices and graphs, by all pairs, by a list, and by one that is too small; the forces add up to nothing.
    """
    x, v, radius = crumpled(rng)
    contact = c.NodeContact(net, radius, K, DAMPING, MU, ONSET, CREEP, rest=FLAT, pairs=PAIRS[pairs])
    system = js.System(net, 1.0, contact)

    @eqx.filter_jit
    def of(system, state):
        begun = system.begin(state)
        return system.force(begun), system.bind(state.dtype).forces[0].touching(begun)

    found, touching = of(system, js.State.from_points(net, x, v))
    expected = force_of_pairs(x, v, radius)
    np.testing.assert_allclose(rows(net, found), expected, atol=1e-11)
    assert np.asarray(touching).sum() > 20
    np.testing.assert_allclose(rows(net, found).sum(axis=0), 0, atol=1e-11)


@pytest.mark.slow
def test_force_is_the_derivative_of_the_energy(rng):
    """The elastic part is minus the gradient of the energy, by the radii too: its derivative by a radius is that of differences."""
    x, v, radius = crumpled(rng)
    state = js.State.from_points(SHEET, x, v)

    def energy(radius, points):
        contact = c.NodeContact(SHEET, radius, K, onset=ONSET, rest=FLAT, pairs=PAIRS["list"])
        return js.System(SHEET, 1.0, contact).energy(state.moved(points, state.velocity)).total

    @jax.jit
    def all_of(radius, points):
        contact = c.NodeContact(SHEET, radius, K, onset=ONSET, rest=FLAT, pairs=PAIRS["list"])
        system = js.System(SHEET, 1.0, contact)
        return jax.grad(energy, argnums=(0, 1))(radius, points), system.force(state.moved(points, state.velocity))

    (by_radius, by_place), force = all_of(jnp.asarray(radius), state.position)
    np.testing.assert_allclose(rows(SHEET, force), -rows(SHEET, by_place), atol=1e-11)
    h = 1e-6 * np.eye(20)[7]
    energies = jax.jit(energy)
    slope = (energies(jnp.asarray(radius + h), state.position) - energies(jnp.asarray(radius - h), state.position)) / 2e-6
    np.testing.assert_allclose(by_radius[7], slope, rtol=1e-6)


FREE = js.Graph.from_edges(np.zeros((0, 2), int), 2)


def met(start, velocity, angle):
    """Ends of two nodes of 1 kg that meet on a line turned by an angle, their velocities, energy and status."""
    along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    system = js.System(FREE, 1.0, c.NodeContact(FREE, 0.25, 2000.0, onset=0.1))
    state = js.State.from_points(FREE, start[:, None] * along[None], velocity[:, None] * along[None])
    run = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2000)
    return run.state.points @ along, (run.state.velocities @ along, run.state.velocities, system.energy(run.state).total, run.status)


def test_head_on_two_nodes_exchange_their_velocities():
    """Of equal masses, without damper, on a line and as discs in the plane: the velocities exchange, momentum stays to rounding and energy
    to the stepper's order, and the derivative of each end by the other's start is 1.
    """
    start, velocity = jnp.array([0.0, 2.0]), jnp.array([1.0, -0.5])
    slopes, (after, whole, energy, status) = jax.jit(jax.vmap(jax.jacrev(met, has_aux=True), in_axes=(None, None, 0)))(
        start, velocity, jnp.array([0.0, 0.7])
    )
    assert (np.asarray(status.flags) == 0).all()
    np.testing.assert_allclose(after, [[-0.5, 1.0]] * 2, atol=1e-4)
    np.testing.assert_allclose(np.asarray(whole).sum(axis=1), 0.5 * np.array([[1, 0], [np.cos(0.7), np.sin(0.7)]]), atol=1e-12)
    np.testing.assert_allclose(energy, 0.625, rtol=1e-4)
    np.testing.assert_allclose(slopes, np.tile([[0.0, 1.0], [1.0, 0.0]], (2, 1, 1)), atol=2e-3)


def test_a_glancing_blow():
    """Two discs of equal mass, one at rest: they part at right angles where no energy is lost; with friction and damper momentum is kept
    while energy falls.
    """
    start = js.State.from_points(FREE, [[0.0, 0.0], [1.0, 0.2]], [[1.0, 0.0], [0.0, 0.0]])
    for options in ({}, {"damping": 50.0, "friction": 0.5, "creep": 0.05}):
        system = js.System(FREE, 1.0, c.NodeContact(FREE, 0.25, 1e5, onset=4e-3, **options))
        run = js.rollout(system, start, js.VelocityVerlet(), 5e-4, 3000)
        v = np.asarray(run.state.velocities)
        np.testing.assert_allclose(v.sum(axis=0), [1.0, 0.0], atol=1e-12)
        if options:
            assert 0.25 < (v**2).sum() < 0.95
        else:
            np.testing.assert_allclose(v[0] @ v[1], 0, atol=1e-4)
            # The line of centres at the touch says where the second one goes.
            np.testing.assert_allclose(v[1, 1] / v[1, 0], 0.2 / np.sqrt(0.25 - 0.04), rtol=2e-2)


@pytest.mark.slow
def test_several_lists_and_a_long_run(rng):
    """A fluid with a list of its own beside the contact of nodes: each has its memory, and after a run in which both were remade the
    forces by them are those of all pairs.
    """
    n = 27
    cloud = js.Graph.from_edges(np.zeros((0, 2), int), n)
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), -1).reshape(-1, 3) * 1.05
    start = js.State.from_points(cloud, grid + rng.uniform(-0.02, 0.02, (n, 3)), rng.normal(0, 0.5, (n, 3)))
    systems = []
    for lists in ((None, None), (js.fluid.NeighbourList(24, 0.2), js.fluid.NeighbourList(26, 0.3))):
        contact = c.NodeContact(cloud, 0.5, 500.0, 0.5, 0.2, 0.05, 0.05, pairs=lists[0])
        fluid = js.Fluid(js.fluid.LennardJones(0.2, 0.9), js.fluid.ShiftedForce(1.8), pairs=lists[1])
        systems.append(js.System(cloud, 1.0, (contact, fluid)))
    plain, listed = systems
    run = js.rollout(listed, start, js.VelocityVerlet(), 2e-3, 250)
    assert int(run.status.flags) == 0
    assert all(int(listed.recall(run.state, i).rebuilds) >= 1 for i in (0, 1))
    force = eqx.filter_jit(lambda system, state: system.force(state))
    expected = rows(cloud, force(plain, dataclasses.replace(run.state, memory=None)))
    np.testing.assert_allclose(rows(cloud, force(listed, run.state)), expected, atol=1e-9)


def test_through_the_walls_of_a_box():
    """In a periodic box two nodes near opposite walls push each other through them; balls of half a period are refused."""
    ring = js.lattice(4, periodic=True, box=(4.0,))
    contact = c.NodeContact(ring.with_edges(np.zeros((0, 2), int)), 0.3, 100.0, onset=0.1)
    state = js.State.from_points(ring, [[0.1], [1.5], [2.5], [3.8]])
    np.testing.assert_allclose(js.System(ring, 1.0, contact).force(state).x, [25.0, 0.0, 0.0, -25.0], atol=1e-12)
    with pytest.raises(ValueError, match="beyond half a period"):
        js.System(ring, 1.0, c.NodeContact(ring, 1.1, 100.0))


@pytest.mark.parametrize(
    ("kind", "match", "build"),
    [
        (ValueError, r"radius\[1\] = -1.0, but must be zero or more", lambda: c.NodeContact(FREE, [1, -1], 1)),
        (ValueError, r"stiffness has shape \(2,\); expected one number", lambda: c.NodeContact(FREE, 1, [1, 1])),
        (ValueError, r"rest\[0, 1\] = nan", lambda: c.NodeContact(FREE, 1, 1, rest=[[0, np.nan], [1, 1]])),
        (TypeError, "net is 3, a int; expected a Topology", lambda: c.NodeContact(3, 1, 1)),
        (TypeError, "pairs is 3, a int; expected a Pairs", lambda: c.NodeContact(FREE, 1, 1, pairs=3)),
        (ValueError, "over other nodes than the system's", lambda: js.System(SHEET, 1.0, c.NodeContact(FREE, 1, 1))),
        (ValueError, "radius has shape", lambda: js.System(FREE, 1.0, c.NodeContact(FREE, [1, 1, 1], 1))),
        (ValueError, "over the same nodes", lambda: c.NodeContact([FREE, SHEET], 1, 1)),
        (ValueError, "has no nodes yet", lambda: c.NodeContact(FREE, 1, 1).force(js.State.from_points(FREE, [[0.0], [1.0]]))),
        (TypeError, "the net is traced", lambda: jax.jit(lambda net: c.NodeContact(net, 1, 1))(FREE)),
    ],
)
def test_bad_input_is_refused_by_name(kind, match, build):
    """Each says what is wrong, where, and what to do."""
    with pytest.raises(kind, match=match):
        build()


def test_a_step_longer_than_a_ball_is_told():
    """A node that goes farther than a radius in one step may have passed through another: DT_LIMIT, with the node."""
    part = js.System(FREE, 1.0, c.NodeContact(FREE, 0.1, 10.0)).bind(float).forces[0]
    before = js.State.from_points(FREE, [[0.0, 0.0], [9.0, 0.0]])
    for moved, flag in ((0.09, 0), (0.11, js.Flag.DT_LIMIT)):
        _, status = part.update(js.Step(before, before, jnp.asarray(0.1)), js.State.from_points(FREE, [[0.0, 0.0], [9.0, moved]]))
        assert int(status.flags) == int(flag)
        assert int(status.node) == (1 if flag else -1)
