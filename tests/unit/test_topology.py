"""Topologies: differences along springs and sums on nodes, against loops over `net.edges`, and all their derivatives."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

BOX = (4.0, 5.0)


def random_edges(n_nodes, n_springs, seed=3):
    ends = np.random.default_rng(seed).integers(0, n_nodes, size=(3 * n_springs, 2))
    return ends[ends[:, 0] != ends[:, 1]][:n_springs]


NETS = {
    "chain": lambda: js.lattice(7, springs=js.STRUCTURAL + js.BEND),
    "sheet": lambda: js.lattice((4, 5), springs=js.STRUCTURAL + js.SHEAR + js.BEND),
    "block": lambda: js.lattice((3, 4, 3), springs=js.STRUCTURAL + js.SHEAR + js.BODY + js.BEND),
    "torus": lambda: js.lattice((5, 4), springs=js.STRUCTURAL + js.SHEAR, periodic=True, box=BOX),
    "tube": lambda: js.lattice((5, 4), springs=js.STRUCTURAL + js.SHEAR, periodic=(True, False), box=(0.0, 5.0)),
    "graph": lambda: js.Graph.from_edges(random_edges(12, 30), 13),  # node 12 has no spring
    "hub": lambda: js.Graph.from_edges([*random_edges(30, 90), *[(i % 29, 29) for i in range(40)]], 31),  # node 30 has no spring
    "star": lambda: js.Graph.from_edges([(0, i) for i in range(1, 300)], 300),
    "double": lambda: js.Graph.from_edges([(0, 1), (0, 1), (1, 0), (1, 2)], 3),
    "single": lambda: js.lattice((1, 3)),
}
each_net = pytest.mark.parametrize("net", [make() for make in NETS.values()], ids=NETS.keys())


def incidence(net):
    """(E, N) matrix of `difference` in the user's order: -1 at the tail, +1 at the head."""
    matrix = np.zeros((net.n_springs, net.n_nodes))
    for spring, (tail, head) in enumerate(net.edges):
        matrix[spring, tail] -= 1
        matrix[spring, head] += 1
    return matrix


def difference(net, flat):
    """(N,) -> (E,) in the user's order."""
    d = net.difference(js.Vector((net.node_field(flat),)))
    return net.flatten(d.map(lambda v: v[0]))


def accumulate(net, flat):
    """(E,) -> (N,) in the user's order."""
    return net.flatten_nodes(net.accumulate(net.edge_field(flat).map(lambda a: js.Vector((a,))))[0])


def unboxed(net):
    """The same net, whose differences are not wrapped by a period."""
    return eqx.tree_at(lambda n: n.box, net, None, is_leaf=lambda leaf: leaf is None) if net.box is not None else net


@pytest.mark.parametrize(("shape", "springs", "reach"), [((5,), "bend", 2), ((3, 4), "all", 2), ((3, 2, 3), "all", 1)])
def test_lattice_edges_are_all_pairs_at_the_families_offsets(shape, springs, reach):
    """The set of edges is what loops over all pairs of nodes find; no pair is there twice."""
    if springs == "bend":
        net = js.lattice(shape, springs=js.STRUCTURAL + js.BEND)
    else:
        net = js.lattice(shape, springs=js.STRUCTURAL + js.SHEAR + (js.BODY if len(shape) == 3 else js.BEND))
    nodes = list(itertools.product(*map(range, shape)))
    expected = set()
    for (i, a), (j, b) in itertools.combinations(enumerate(nodes), 2):
        step = sorted(abs(p - q) for p, q in zip(a, b, strict=True))
        neighbours = max(step) == 1
        second = reach == 2 and step[-1] == 2 and sum(step) == 2
        if neighbours or second:
            expected.add((i, j))
    got = [tuple(sorted(pair)) for pair in net.edges.tolist()]
    assert set(got) == expected
    assert len(got) == len(set(got)) == net.n_springs


def test_periodic_lattice_joins_the_borders():
    """On a torus every node has 4 structural springs, and on a grid of spacing 1 all have length 1."""
    net = js.lattice((5, 4), periodic=True, box=BOX)
    assert np.bincount(net.edges.ravel()).tolist() == [4] * 20
    np.testing.assert_allclose(net.lengths(net.grid()), 1.0)


def test_minimum_image_of_a_graph():
    """Across a period the shorter way is taken; a period of zero leaves a coordinate alone."""
    net = js.Graph.from_edges([(0, 1)], 2, box=(10.0, 0.0))
    assert net.lengths(np.array([[0.5, 0.0], [9.5, 0.0]])) == pytest.approx([1.0])
    assert net.lengths(np.array([[0.0, 0.5], [0.0, 9.5]])) == pytest.approx([9.0])


@each_net
def test_the_four_operators_are_loops_over_the_edges(net, rng):
    """The difference is D, accumulate -D', average |D|/2 and incident_sum |D|', with the incidence matrix D made by a loop."""
    net, matrix = unboxed(net), incidence(net)
    a, p = rng.normal(size=net.n_nodes), rng.normal(size=net.n_springs)

    @jax.jit
    def operators(a, p):
        average = net.flatten(net.average(net.node_field(a)))
        total = net.flatten_nodes(net.incident_sum(net.edge_field(p)))
        return difference(net, a), accumulate(net, p), average, total

    expected = matrix @ a, -matrix.T @ p, 0.5 * np.abs(matrix) @ a, np.abs(matrix).T @ p
    for got, wanted in zip(operators(a, p), expected, strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-13)


@each_net
def test_flat_fields_come_back_as_they_went_in(net, rng):
    """edge_field then flatten, and node_field then flatten_nodes, are the identity; so are points of a state."""
    k, a = rng.normal(size=net.n_springs), rng.normal(size=net.n_nodes)
    points = rng.normal(size=(net.n_nodes, 3 if net.box is None else len(net.box)))
    np.testing.assert_array_equal(net.flatten(net.edge_field(k)), k)
    np.testing.assert_array_equal(net.flatten_nodes(net.node_field(a)), a)
    np.testing.assert_array_equal(js.State.from_points(net, points).points, points)


@each_net
def test_both_modes_give_the_incidence_matrix(net):
    """Both jacfwd and jacrev (so jvp, transpose, vmap) of difference are D, of accumulate -D', of a round trip the identity."""
    if net.n_nodes > 100:
        pytest.skip("a dense Jacobian of the star says nothing that its Hessian below does not")
    net, matrix = unboxed(net), incidence(net)

    def all_three(jacobian):
        def compute(x, p):
            d = jacobian(lambda x: difference(net, x))(x)
            return d, jacobian(lambda p: accumulate(net, p))(p), jacobian(lambda p: net.flatten(net.edge_field(p)))(p)

        return jax.jit(compute)(jnp.zeros(net.n_nodes), jnp.zeros(net.n_springs))

    for jacobian in (jax.jacfwd, jax.jacrev):
        for got, expected in zip(all_three(jacobian), (matrix, -matrix.T, np.eye(net.n_springs)), strict=True):
            np.testing.assert_array_equal(got, expected)


@each_net
def test_second_derivatives_and_batches(net, rng):
    """Of sum |Dx|^2 / 2: forward over reverse, reverse over reverse and vmap(grad) give the Laplacian D'D times a vector."""
    net, matrix = unboxed(net), incidence(net)
    laplacian = matrix.T @ matrix

    def energy(x):
        return 0.5 * jnp.sum(difference(net, x) ** 2)

    @jax.jit
    def products(x, v):
        forward_over_reverse = jax.jvp(jax.grad(energy), (x,), (v,))[1]
        reverse_over_reverse = jax.grad(lambda x: jnp.vdot(jax.grad(energy)(x), v))(x)
        return forward_over_reverse, reverse_over_reverse, jax.vmap(jax.grad(energy))(jnp.stack([x, v]))[1]

    x, v = rng.normal(size=(2, net.n_nodes))
    for got in products(x, v):
        np.testing.assert_allclose(got, laplacian @ v, atol=1e-12)


@each_net
def test_gradients_of_averages(net, rng):
    """The gradients of average and incident_sum are each other's transposes."""
    ends = np.abs(incidence(net))

    @jax.jit
    def gradients(a, w):
        by_nodes = jax.grad(lambda a: jnp.sum(w * net.flatten(net.average(net.node_field(a)))))(a)
        return by_nodes, jax.grad(lambda w: jnp.sum(a * net.flatten_nodes(net.incident_sum(net.edge_field(w)))))(w)

    a, w = rng.normal(size=net.n_nodes), rng.normal(size=net.n_springs)
    by_nodes, by_springs = gradients(a, w)
    np.testing.assert_allclose(by_nodes, 0.5 * ends.T @ w, atol=1e-13)
    np.testing.assert_allclose(by_springs, ends @ a, atol=1e-13)


def test_tables_of_a_large_graph(rng):
    """With several classes and hubs, sums are those of bincount; an end of a spring stands in one place; only hubs have several columns."""
    edges = np.concatenate([random_edges(4000, 14_000), [(0, i) for i in range(1, 1500)], [(1, i) for i in range(2, 90)]])
    net = js.Graph.from_edges(edges, 4000)
    tail, head = net.edges.T
    degree, ends = np.bincount(net.edges.ravel(), minlength=4000), net.ends
    assert [one.is_hubs for one in ends.classes] == [False] * (len(ends.classes) - 1) + [True]
    assert len(ends.classes) > 3
    assert sum(one.count for one in ends.classes[:-1]) == np.sum((degree > 0) & (degree <= 64))
    assert len(np.unique(ends.owners)) == np.sum(degree > 64)
    np.testing.assert_array_equal(np.sort(np.asarray(ends.entries)[np.asarray(ends.real)]), np.arange(2 * len(edges)))
    p = rng.normal(size=net.n_springs)
    got = jax.jit(lambda p: accumulate(net, p))(p)
    np.testing.assert_allclose(got, np.bincount(tail, p, 4000) - np.bincount(head, p, 4000), atol=1e-12)


def test_two_springs_on_a_pair_add_up():
    """Two springs of 50 N/m between the same nodes pull as one of 100 N/m, to the bit; opposite directions to round-off."""
    points = np.array([[0.1, 0.2, 0.3], [1.3, 0.9, 0.2]])

    def force(edges, k):
        net = js.Graph.from_edges(edges, 2)
        state = js.State.from_points(net, points)
        f = js.Springs(net, k, 0.5).force(state)
        return np.stack([net.flatten_nodes(a) for a in f])

    one = force([(0, 1)], 100.0)
    np.testing.assert_array_equal(force([(0, 1), (0, 1)], 50.0), one)
    np.testing.assert_allclose(force([(0, 1), (1, 0)], 50.0), one, rtol=1e-15)


def test_a_graph_is_static_under_jit():
    """Two graphs from the same edges share one compiled program."""
    traces = []

    @jax.jit
    def lengths(net, points):
        traces.append(1)
        return net.lengths(points)

    for _ in range(2):
        lengths(js.Graph.from_edges([(0, 1), (1, 2)], 3), jnp.ones((3, 2)))
    assert len(traces) == 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.lattice(()), "0 axes"),
        (lambda: js.lattice((2, 2, 2, 2)), "4 axes"),
        (lambda: js.lattice((3, 0)), "holds no node"),
        (lambda: js.lattice(5, springs=js.SHEAR), "SHEAR springs need a lattice of 2"),
        (lambda: js.lattice((4, 4), periodic=True), "needs box"),
        (lambda: js.lattice((2, 4), periodic=True, box=(1.0, 1.0)), "axis 0 wraps with 2 nodes"),
        (lambda: js.lattice((4, 4), periodic=(True,), box=(1.0, 1.0)), "periodic has 1"),
        (lambda: js.Graph.from_edges([(0, 1)], 2, box=[[1.0]]), "box has shape"),
        (lambda: js.Graph.from_edges([], 0), "at least 1 node"),
        (lambda: js.lattice(3).edge_field(np.ones(3)), "one per spring"),
        (lambda: js.lattice(3).node_field(np.ones(2)), "one per node"),
        (lambda: js.lattice(3).vector_field(np.ones((3, 4))), r"expected \(3, D\)"),
    ],
)
def test_wrong_topologies_are_refused(make, message):
    """Each wrong input is a ValueError that names what is wrong."""
    with pytest.raises(ValueError, match=message):
        make()


def test_edge_field_arithmetic():
    """Edge fields add and scale like their flat arrays; a flat array must be converted first."""
    net = js.lattice((2, 3), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.arange(1.0, 1 + net.n_springs)
    a = net.edge_field(flat)
    for got, expected in ((a + a, 2 * flat), (3 * a - a / 2, 2.5 * flat), (1 - a, 1 - flat), (-a * a, -flat * flat)):
        np.testing.assert_allclose(net.flatten(got), expected)
    with pytest.raises(TypeError, match="edge_field"):
        a + flat
