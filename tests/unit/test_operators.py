"""Matrices of springs: what is applied spring by spring is the matrix that NumPy writes down."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.operators import Blocks, CellDyads, NodeDyads, SpringBlocks, SpringMatrix, isotropic
from jaxspring.topology.corners import Corners

N = 12


def net_of(kind):
    if kind == "lattice":
        return js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR)
    edges = js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR).edges
    return js.Graph.from_edges(edges[::-1], N)


@pytest.fixture(params=["lattice", "graph"])
def matrix(request, rng):
    """A matrix with every kind of block and held coordinates, and the same in NumPy."""
    net = net_of(request.param)
    state = js.State.from_points(net, rng.normal(size=(N, 3)))
    weight, slope, flat = rng.random(net.n_springs), rng.random(net.n_springs), rng.random(net.n_springs)
    free, dyad = rng.random((N, 3)) > 0.2, rng.random(N)
    d = net.difference(state.position)
    cells = np.array([rng.permutation(N)[:4] for _ in range(5)])
    slopes, directions = rng.normal(size=(2, 5)), rng.normal(size=(2, 4, 3, 5))
    vectors = tuple(tuple(js.Vector(tuple(map(jnp.asarray, g))) for g in dyad) for dyad in directions)
    bent = CellDyads(Corners(cells, net, with_pairs=True), tuple(map(jnp.asarray, slopes)), vectors)
    blocks = Blocks(
        (isotropic(2.0, state.position),),
        (NodeDyads(net.node_field(dyad), state.position),),
        (SpringBlocks(net, net.edge_field(weight), net.edge_field(slope), d), SpringBlocks(net, net.edge_field(flat), axes=(0, 2))),
        (bent,),
    )
    x = np.asarray(state.points)
    dense = np.zeros((N, 3, N, 3))
    for i in range(N):
        dense[i, :, i, :] += 2.0 * np.eye(3) + dyad[i] * np.outer(x[i], x[i])
    for e, (i, j) in enumerate(net.edges):
        u = x[j] - x[i]
        block = weight[e] * np.eye(3) + slope[e] * np.outer(u, u) + flat[e] * np.diag([1.0, 0.0, 1.0])
        for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            dense[a, :, b, :] += sign * block
    for c, corners in enumerate(cells):
        for s, g in zip(slopes[:, c], directions[..., c], strict=True):
            for k, l in np.ndindex(4, 4):
                dense[corners[k], :, corners[l], :] += s * np.outer(g[k], g[l])
    dense = dense.reshape(3 * N, 3 * N)
    held = ~free.ravel()
    dense[held], dense[:, held] = 0, 0
    dense[held, held] = 1
    masks = tuple(net.node_field(free[:, i]) for i in range(3))
    return SpringMatrix(blocks, masks, state.position, state.layout), dense, net


def test_product_and_exports_are_numpys(matrix):
    """`to_dense` (made of products) and `to_scipy` (made of entries) are both the matrix written down spring by spring."""
    made, dense, _ = matrix
    np.testing.assert_allclose(made.to_dense(), dense, atol=1e-14)
    np.testing.assert_allclose(made.to_scipy().toarray(), dense, atol=1e-14)


def test_diagonal_and_node_blocks_are_its_entries(matrix):
    """Every node's own block, in the user's order."""
    made, dense, net = matrix
    expected = dense.reshape(N, 3, N, 3)[np.arange(N), :, np.arange(N), :]
    rows = [[np.asarray(net.flatten_nodes(a)) for a in row] for row in made.node_blocks()]
    np.testing.assert_allclose(np.moveaxis(np.array(rows), -1, 0), expected, atol=1e-14)
    diagonal = np.stack([np.asarray(net.flatten_nodes(a)) for a in made.diagonal()], axis=-1)
    np.testing.assert_allclose(diagonal.ravel(), np.diag(dense), atol=1e-14)


def test_held_coordinates_pass_through(matrix, rng):
    """A product leaves a held coordinate alone, bit for bit, and no free one reads it."""
    made, _, net = matrix
    v = net.vector_field(rng.normal(size=(N, 3)))
    out = made(v)
    loud = made.pick(v, v.map(lambda a: jnp.full_like(a, jnp.nan)))
    for mask, a, b, c in zip(made.free, v, out, made(loud), strict=True):
        np.testing.assert_array_equal(np.where(mask, 0, b), np.where(mask, 0, a))
        np.testing.assert_array_equal(np.asarray(c)[np.asarray(mask)], np.asarray(b)[np.asarray(mask)])


def test_periods_do_not_wrap_a_velocity():
    """On a torus a product takes differences of velocities as they are, however large."""
    net = js.lattice((4,), periodic=True, box=[4.0])
    state = js.State.from_points(net, net.grid())
    ones = js.topology.EdgeField(tuple(jnp.ones(shape) for shape in net.family_shapes))
    made = SpringMatrix(Blocks(springs=(SpringBlocks(net, ones),)), (None,), state.position, state.layout)
    out = made(js.Vector((jnp.array([0.0, 100.0, 0.0, 0.0]),)))
    np.testing.assert_array_equal(out.x, [-100.0, 200.0, -100.0, 0.0])
