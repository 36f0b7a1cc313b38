"""Values at corners of cells, and sums of them, against NumPy's indexing and `np.add.at`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.topology.corners import Corners
from jaxspring.topology.end_tables import WIDEST

RNG = np.random.default_rng(23)
MESH = js.delaunay(RNG.random((40, 2)))
FAN = js.from_triangles(np.array([(0, i, i + 1) for i in range(1, 2 * WIDEST)]), 2 * WIDEST + 2)  # a hub, and a node at no corner
CASES = {
    "triangles": (MESH, MESH.triangles),
    "hub": (FAN, FAN.triangles),
    "lattice": (js.lattice((3, 4)), RNG.integers(0, 12, (30, 4))),  # a node may be at several corners of one cell
    "overlay": (js.lattice((3, 4)).with_edges([(0, 5)]), np.array([[0, 1, 2]])),
}
each_case = pytest.mark.parametrize(("net", "cells"), CASES.values(), ids=CASES)


def bent(corners, x):
    """A value in which all corners and coordinates meet, and its terms by node."""
    at = corners.at(x)
    total = at[0]
    for i, v in enumerate(at[1:]):
        total = total * (2.0 + i) + v.map(jnp.sin)
    return jnp.sum(corners.sum(tuple((total.x * v.y) ** 2 for v in at)) * x.y)


@each_case
def test_against_numpy(net, cells):
    """Values at corners and sums at nodes are those of plain indexing, in the user's order; each is the other's transpose."""
    corners, x = Corners(cells, net), RNG.normal(size=(net.n_nodes, 2))
    values = RNG.normal(size=(cells.shape[1], len(cells)))
    field = net.vector_field(jnp.asarray(x))
    for k, found in enumerate(corners.at(field)):
        np.testing.assert_array_equal(np.stack(found.components, axis=-1), x[cells[:, k]])
    expected = np.zeros(net.n_nodes)
    np.add.at(expected, cells.T.ravel(), values.ravel())
    total = corners.sum(tuple(jnp.asarray(values)))
    assert total.shape == net.node_shape
    np.testing.assert_allclose(net.flatten_nodes(total), expected, atol=1e-13)
    (back,) = jax.linear_transpose(corners.at, field.x)(tuple(jnp.asarray(values)))
    np.testing.assert_array_equal(back, total)
    (forth,) = jax.linear_transpose(corners.sum, tuple(jnp.asarray(values)))(field.x)
    np.testing.assert_array_equal(np.stack(forth), np.stack(corners.at(field.x)))
    np.testing.assert_array_equal(corners.at(net.node_field(jnp.arange(net.n_nodes)))[0], cells[:, 0])


@pytest.mark.parametrize("case", ["hub", "lattice"])
def test_transforms_and_no_scatter(case):
    """Batches are loops, the Hessian's product is a difference of gradients, and no program holds a scatter."""
    net, cells = CASES[case]
    corners, x = Corners(cells, net), jnp.asarray(RNG.normal(size=(3, net.n_nodes, 2)))
    v = jnp.asarray(RNG.normal(size=x.shape[1:]))

    def value(x):
        return bent(corners, net.vector_field(x))

    def product(x):
        return jax.jvp(jax.grad(value), (x,), (v,))[1]

    batched = jax.jit(jax.vmap(lambda x: (value(x), jax.grad(value)(x), product(x))))
    assert "scatter" not in batched.lower(x).as_text()
    assert "scatter" not in jax.jit(jax.grad(lambda x: jnp.sum(product(x) ** 2))).lower(x[0]).as_text()
    values, gradients, products = batched(x)
    h = 1e-6
    ahead, behind = batched(x + h * v[None]), batched(x - h * v[None])
    np.testing.assert_allclose(values[1], value(x[1]), rtol=1e-12)
    np.testing.assert_allclose(np.sum(gradients * v[None], axis=(1, 2)), (ahead[0] - behind[0]) / (2 * h), rtol=1e-6)
    np.testing.assert_allclose(products, (ahead[1] - behind[1]) / (2 * h), rtol=1e-5, atol=1e-5)


def test_periodic_nets_take_nearest_images():
    """Other corners less the first, through the wall of the box."""
    net = js.lattice(4, periodic=True, box=[4.0, 0.0])
    x = net.vector_field(jnp.asarray([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    (d, e) = Corners([(3, 0, 1)], net).apart(x)
    np.testing.assert_array_equal([d.x[0], e.x[0]], [1.0, -2.0])


@pytest.mark.parametrize("cells", [np.zeros((0, 3), int), [[0, 1, 40]], [[0, -1, 2]], [1, 2, 3]], ids=["none", "beyond", "below", "flat"])
def test_bad_cells_are_refused_by_name(cells):
    """What is no cell of the net's nodes is an error, not another node."""
    with pytest.raises(ValueError, match="cells"):
        Corners(cells, MESH)
