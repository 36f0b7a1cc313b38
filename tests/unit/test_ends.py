"""Springs seen from their ends give what springs seen from the side give: `difference` and `accumulate`, and NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.topology.end_tables import WIDEST, build

RNG = np.random.default_rng(17)


def radius(n, dim, reach):
    from scipy.spatial import KDTree

    return KDTree(RNG.random((n, dim))).query_pairs(reach, output_type="ndarray")


def power_law(n):
    """Each new node joins two older ones, well-joined ones more often."""
    ends = [0, 1, 1, 2, 2, 0]
    for i in range(3, n):
        for j in {ends[k] for k in RNG.integers(0, len(ends), 2)}:
            ends += [i, j]
    return np.reshape(ends, (-1, 2))


EDGES = {
    "delaunay 2": (js.delaunay(RNG.random((80, 2))).edges, 80),
    "delaunay 3": (js.delaunay(RNG.random((60, 3))).edges, 60),
    "radius": (radius(90, 2, 0.2), 91),  # and a node alone
    "power law": (power_law(300), 300),
    "star": (np.array([(0, i) for i in range(1, 1200)]), 1200),
    "two hubs": (np.array([(i % 2, i) for i in range(2, 190)] + [(0, 1)]), 195),
    "chain": (np.array([(i, i + 1) for i in range(19)]), 20),
    "tree": (np.array([((i - 1) // 3, i) for i in range(1, 60)]), 60),
    "double": (np.array([(0, 1), (0, 1), (1, 0), (1, 2)]), 3),
}
NETS = {name: js.Graph.from_edges(*given) for name, given in EDGES.items()}
each_net = pytest.mark.parametrize("net", NETS.values(), ids=NETS)


class Soft(js.Law):
    """Not zero where the stiffness is: what does not vanish must be masked."""

    floor: jax.Array = eqx.field(converter=jnp.asarray, default=0.3)

    def weight(self, squared_length, stiffness, rest_length):
        return (stiffness + self.floor) * (squared_length - rest_length)


LAWS = {"hooke": js.Hooke(), "tension": js.TensionOnly(), "own": Soft(), "pull": js.PullLaw(lambda r, k, l: k * jnp.tanh(r - l) + 0.2)}


def from_the_side(net, law, x, k, l):
    """The force by way of springs: one pull for each, which goes to both of its ends."""
    points = net.vector_field(x)
    pulls = net.map_springs(lambda d, k, l: law.weight(d.dot(d), k, l) * d, net.difference(points), net.split(k), net.split(l))
    return jnp.stack([net.flatten_nodes(f) for f in net.accumulate(pulls)], axis=1)


def from_the_ends(net, law, x, k, l):
    """The force as a system computes it."""
    system = js.System(net, 1.0, js.Springs(net, k, l, law=law)).bind(x.dtype)
    return jnp.stack([net.flatten_nodes(f) for f in system.force(js.State.from_points(net, x))], axis=1)


def inputs(net, dim=3):
    rng = np.random.default_rng(5)
    return rng.normal(size=(net.n_nodes, dim)), rng.uniform(1, 2, net.n_springs), rng.uniform(0.2, 0.8, net.n_springs)


CASES = [(name, "hooke") for name in NETS] + [("radius", "own"), ("two hubs", "own"), ("double", "tension"), ("power law", "pull")]


@pytest.mark.parametrize(("name", "law"), CASES)
def test_force_and_derivatives_are_those_from_the_side(name, law):
    """Force, gradient by places, constants and the law's own array, and the product with the Hessian: equal to rounding in float64."""
    net, law = NETS[name], LAWS[law]
    x, k, l = map(jnp.asarray, inputs(net))
    weights = jnp.asarray(np.random.default_rng(6).normal(size=x.shape))

    def loss(force):
        return lambda law, x, k, l: jnp.sum(weights * force(net, law, x, k, l) ** 2)

    def all_of(force):
        gradient = eqx.filter_grad(lambda given: loss(force)(*given))
        given = (law, x, k, l)
        along = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size)).reshape(a.shape) if eqx.is_inexact_array(a) else None, given)
        return force(net, *given), gradient(given), eqx.filter_jvp(gradient, (given,), (along,))[1]

    found, expected = (jax.tree.leaves(eqx.filter(eqx.filter_jit(all_of)(force), eqx.is_array)) for force in (from_the_ends, from_the_side))
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max())


class Pretension(js.Hooke):
    """A weight of its own, of which the parent's promise that it vanishes with the stiffness is not true."""

    def weight(self, squared_length, stiffness, rest_length):
        return super().weight(squared_length, stiffness, rest_length) + 2.0 / jnp.sqrt(squared_length)


class Given(js.StiffnessRule):
    """As many numbers as there are springs, in the user's order."""

    values: jax.Array

    def stiffness(self, net, state):
        return self.values

    def upper_bound(self):
        return jnp.max(self.values)


class Grown(js.thermal.ExpansionRule):
    """A factor for each spring, in the user's order."""

    values: jax.Array

    def factor(self, net, state):
        return self.values


@pytest.mark.parametrize("name", ["radius", "two hubs", "lattice"])
def test_what_users_write_is_in_their_order_and_masked(name):
    """A subclass of a law of the library with another weight; rules that answer with (E,) arrays; as NumPy has it."""
    net = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR) if name == "lattice" else NETS[name]
    x, k, l = inputs(net)
    state = js.State.from_points(net, x)
    tail, head = net.edges.T
    d = x[head] - x[tail]
    r = np.linalg.norm(d, axis=1)
    cases = {
        "law": (js.Springs(net, k, l, law=Pretension()), k * (r - l) + 2.0),
        "stiffness": (js.Springs(net, Given(jnp.asarray(k)), l), k * (r - l)),
        "expansion": (js.Springs(net, k, l, expansion=Grown(jnp.asarray(k))), k * (r - k * l)),
    }
    for springs, tension in cases.values():
        pull = (tension / r)[:, None] * d
        expected = np.zeros_like(x)
        np.add.at(expected, tail, pull)
        np.add.at(expected, head, -pull)
        for force in (springs, js.System(net, 1.0, springs).bind("float64").forces[0]):
            found = np.stack([net.flatten_nodes(a) for a in force.force(state)], axis=1)
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())
            np.testing.assert_allclose(net.flatten(force.tension(state)), tension, rtol=1e-10, atol=1e-12)


@each_net
def test_dashpots_are_those_of_numpy(net):
    """Both differences at once: c (v_j - v_i) . u u, summed on the nodes; and nothing of it is left of momentum."""
    x, c, _ = inputs(net)
    v = np.random.default_rng(9).normal(size=x.shape)
    force = js.System(net, 1.0, js.Dashpots(net, c)).bind("float64").force(js.State.from_points(net, x, v))
    tail, head = net.edges.T
    d, w = x[head] - x[tail], v[head] - v[tail]
    pull = (c * np.sum(d * w, axis=1) / np.sum(d * d, axis=1))[:, None] * d
    expected = np.zeros_like(x)
    np.add.at(expected, tail, pull)
    np.add.at(expected, head, -pull)
    np.testing.assert_allclose(np.stack([net.flatten_nodes(a) for a in force], axis=1), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ["two hubs", "power law", "radius"])
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_box_and_its_derivative(name, dim):
    """Nearest images at both ends; the derivative by the periods too."""
    edges, n = EDGES[name]
    x, k, l = inputs(NETS[name], dim)
    x = 4 * x

    def loss(force, box):
        net = js.Graph.from_edges(edges, n, box=box)
        return jnp.sum(jnp.sin(jnp.arange(x.size)).reshape(x.shape) * force(net, js.Hooke(), jnp.asarray(x), k, l))

    box = jnp.full(dim, 5.0)
    for transform in (lambda f: f, jax.grad):
        found, expected = (jax.jit(transform(lambda box, f=force: loss(f, box)))(box) for force in (from_the_ends, from_the_side))
        np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("name", ["two hubs", "power law"])
def test_products_with_a_stiffness_matrix(name):
    """Blocks w I + s u u' against the dense matrix of NumPy, of two nets over the same nodes."""
    net = NETS[name]
    x, k, l = inputs(net)
    over = net.with_edges([(0, net.n_nodes - 1), (3, 4)])
    system = js.System(net, 1.0, (js.Springs(net, k, l), js.Springs(over, 7.0, 0.5)))
    state = js.State.from_points(net, x)
    v = np.random.default_rng(2).normal(size=x.shape)

    def force(x):
        moved = js.State.from_points(net, x)
        return jnp.stack([net.flatten_nodes(a) for a in system.bind("float64").force(moved)], axis=1)

    blocks = [f.stiffness_blocks(state, js.steppers.ExactTangent()) for f in system.bind("float64").forces]
    product = sum((b.product(net.vector_field(v)) for b in blocks[1:]), start=blocks[0].product(net.vector_field(v)))
    expected = -jax.jvp(force, (x,), (v,))[1]
    np.testing.assert_allclose(np.stack([net.flatten_nodes(a) for a in product], axis=1), expected, rtol=1e-9, atol=1e-9)


@each_net
def test_batches_and_no_scatter(net):
    """A batch of states and of constants gives each lane's own; its gradient's and its Hessian's programs hold no scatter."""
    x, k, l = map(jnp.asarray, inputs(net, 2))

    def loss(x, k):
        return jnp.sum(from_the_ends(net, js.Hooke(), x, k, l)[:, 0] ** 3)

    gradient = jax.grad(loss, argnums=(0, 1))
    both = jnp.stack([x, 2 * x]), jnp.stack([k, k + 1])
    found = jax.jit(jax.vmap(gradient))(*both)
    for lane in (0, 1):
        expected = jax.jit(gradient)(both[0][lane], both[1][lane])
        jax.tree.map(lambda a, b, i=lane: np.testing.assert_allclose(a[i], b, rtol=1e-12, atol=1e-9), found, expected)
    curvature = jax.jit(lambda x, k: jax.jvp(gradient, (x, k), (x, k)))
    for program in (
        jax.jit(jax.vmap(gradient)).lower(*both),
        curvature.lower(x, k),
        jax.jit(jax.grad(lambda x: gradient(x, k)[1].sum())).lower(x),
    ):
        assert "scatter" not in program.as_text()


def test_classes_are_those_of_the_degrees():
    """A node's springs are read in one class of at most `WIDEST`, without a place that holds none where many nodes have as many."""
    n = 4000
    pairs = np.concatenate([[(i, i + 1) for i in range(n - 1)], [(i, i + 2) for i in range(n - 2)]])
    ends, order = build(pairs, n)
    assert [(one.width, one.count) for one in ends.classes] == [(4, n)]  # two nodes with 2 and two with 3 share it
    assert int(np.sum(~np.asarray(ends.real))) == 2 * (1 + 2)
    assert sorted(order) == list(range(n))
    hub, _ = build(np.array([(0, i) for i in range(1, 2 * WIDEST + 2)]), 2 * WIDEST + 2)
    assert [(one.width, one.count, one.is_hubs) for one in hub.classes] == [(1, 2 * WIDEST + 1, False), (WIDEST, 3, True)]
    assert [table.shape for table in hub.rounds] == [(3, 1)]


def test_forces_are_bitwise_the_same_again():
    """The same net built twice, the same force twice: not a bit differs."""
    x, k, l = inputs(NETS["power law"])

    def force():
        net = js.Graph.from_edges(*EDGES["power law"])
        return np.asarray(jax.jit(lambda x: from_the_ends(net, js.Hooke(), x, k, l))(jnp.asarray(x)))

    np.testing.assert_array_equal(force(), force())
