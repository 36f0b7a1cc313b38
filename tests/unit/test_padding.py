"""A batch of different nets computes what each net computes alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.topology import pad_nets

RNG = np.random.default_rng(11)
N_STEPS = 12


# Degrees of every kind, nodes alone, a spring twice; each a different number of nodes and springs.
NETS = [
    js.delaunay(RNG.random((40, 2))),
    js.Graph.from_edges([(0, i) for i in range(1, 40)], 42),
    js.Graph.from_edges([(5, 4), (4, 5), (4, 3)], 6),
]
POINTS = [RNG.normal(size=(net.n_nodes, 3)) for net in NETS]
STIFFNESS = [RNG.uniform(5, 10, net.n_springs) for net in NETS]
REST = [RNG.uniform(0.3, 0.6, net.n_springs) for net in NETS]
BATCH = pad_nets(NETS)


def fall(net, points, stiffness, rest_length, free):
    """Places, energy and the worst of the status after a fall of springs with dashpots and drag."""
    springs = js.Springs(net, stiffness, rest_length)
    system = js.System(net, 0.5, (springs, js.Dashpots(net, 0.1), js.Gravity([0.0, 0.0, -1.0])), free=free)
    result = js.rollout(system, js.State.from_points(net, points), js.VelocityVerlet(), 1e-2, N_STEPS)
    return result.state.points, system.energy(result.state).total, result.status


def loss(net, points, stiffness, rest_length, free):
    """Of the places of real nodes; and what the fall gave."""
    found = fall(net, points, stiffness, rest_length, free)
    return jnp.sum(jnp.where(free[:, None], jnp.sin(found[0]), 0.0)), found


derived = jax.value_and_grad(loss, argnums=(1, 2, 3), has_aux=True)


@pytest.fixture(scope="module")
def stacked():
    return BATCH.net, BATCH.points(POINTS), BATCH.at_springs(STIFFNESS), BATCH.at_springs(REST, 1.0), BATCH.free


@pytest.mark.slow
def test_runs_and_gradients_are_those_of_each_net_alone(stacked):
    """Equal to rounding, energy too; what fills up has derivative zero."""
    (_, (points, energy, status)), gradient = jax.jit(jax.vmap(derived))(*stacked)
    assert np.asarray(status.flags == 0).all()
    by_net = BATCH.of_nodes(points), BATCH.of_nodes(gradient[0]), BATCH.of_springs(gradient[1]), BATCH.of_springs(gradient[2])
    for b, net in enumerate(NETS):
        alone = jax.jit(lambda *given, net=net: derived(net, *given))
        (_, (x, e, _)), by = alone(POINTS[b], STIFFNESS[b], REST[b], np.ones(net.n_nodes, bool))
        for found, wanted in zip(by_net, (x, *by), strict=True):
            np.testing.assert_allclose(found[b], wanted, rtol=0, atol=1e-12)
        np.testing.assert_allclose(energy[b] - padded_height(points[b], b), e, rtol=1e-12)
        fills = BATCH.springs[b].inverse[net.n_springs :]
        assert not np.asarray(gradient[1][b])[fills].any()
        assert not np.asarray(gradient[2][b])[fills].any()


def padded_height(points, b):
    """Energy of the weight of the nodes that fill up, m g z."""
    return 0.5 * jnp.sum(jnp.where(BATCH.free[b], 0.0, points[:, 2]))


def test_linear_maps_are_each_others_transposes(stacked):
    """Differences and sums over springs, with copies of the first spring: <q, D'p> = -<D q, p>."""
    rng = np.random.default_rng(3)

    def both(net, x, p):
        v = net.vector_field(x)
        d = net.difference(v).families[0]
        f = net.accumulate(net.own((js.Vector((p, 2 * p, -p)),)))
        return sum(jnp.sum(a * w * p) for a, w in zip(d, (1, 2, -1), strict=True)), sum(jnp.sum(a * b) for a, b in zip(v, f, strict=True))

    p = rng.normal(size=stacked[2].shape)
    along, across = jax.vmap(both)(BATCH.net, rng.normal(size=stacked[1].shape), p)
    np.testing.assert_allclose(along, -across, rtol=1e-12)


def test_no_derivative_holds_a_scatter(stacked):
    assert "scatter" not in jax.jit(jax.vmap(derived)).lower(*stacked).as_text()


@pytest.mark.slow
def test_implicit_steps_and_chunks(stacked):
    """Backward Euler by conjugate gradients, two nets at a time."""

    def sink(net, points, stiffness, rest_length, free):
        system = js.System(net, 0.5, (js.Springs(net, stiffness, rest_length), js.Gravity([0.0, 0.0, -1.0])), free=free)
        result = js.rollout(system, js.State.from_points(net, points), js.BackwardEuler(), 0.05, 3)
        return result.state.points, result.status

    points, status = jax.jit(js.batch(sink, chunk=2))(*stacked)
    assert np.asarray(status.flags == 0).all()
    x, _ = sink(NETS[1], POINTS[1], STIFFNESS[1], REST[1], np.ones(NETS[1].n_nodes, bool))
    np.testing.assert_allclose(BATCH.of_nodes(points)[1], x, rtol=0, atol=1e-6)


def test_arrays_come_back_as_they_went():
    for back, given in zip(BATCH.of_springs(BATCH.at_springs(STIFFNESS)), STIFFNESS, strict=True):
        np.testing.assert_array_equal(back, given)
    for back, given in zip(BATCH.of_nodes(BATCH.points(POINTS)), POINTS, strict=True):
        np.testing.assert_array_equal(back, given)
    masses = [np.arange(1.0, net.n_nodes + 1) for net in NETS]
    for back, given in zip(BATCH.of_nodes(BATCH.at_nodes(masses, 1.0)), masses, strict=True):
        np.testing.assert_array_equal(back, given)


def test_what_cannot_be_batched_is_refused():
    net = NETS[2]
    with pytest.raises(ValueError, match="no net was given"):
        pad_nets([])
    with pytest.raises(TypeError, match=r"nets\[1\] is a Lattice"):
        pad_nets([net, js.lattice((3, 3))])
    with pytest.raises(ValueError, match=r"nets\[1\] has no spring"):
        pad_nets([net, js.Graph.from_edges(np.zeros((0, 2), int), 3)])
    with pytest.raises(ValueError, match=r"nets\[0\] has a node with 70 springs"):
        pad_nets([js.Graph.from_edges([(0, i) for i in range(1, 71)], 71)])
    with pytest.raises(ValueError, match=r"nets\[1\] and nets\[0\] have not the same periodic"):
        pad_nets([net, js.Graph.from_edges([(0, 1)], 2, box=(1.0, 1.0))])
    with pytest.raises(TypeError, match="no list of springs of its own"):
        _ = BATCH.net.edges
    with pytest.raises(ValueError, match=r"points\[1\] has shape"):
        BATCH.points([POINTS[0]] * 3)
    with pytest.raises(ValueError, match="2 arrays for 3 nets"):
        BATCH.at_springs(STIFFNESS[:2])
    with pytest.raises(ValueError, match=r"values has shape \(3, 2\)"):
        BATCH.of_springs(np.zeros((3, 2)))
