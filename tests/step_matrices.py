"""Matrices of stiff implicit steps with random springs, and the same in NumPy, for the tests of linear solvers."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.sparse

import jaxspring as js
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix


class Step(NamedTuple):
    """A `SpringMatrix`, and the same as a SciPy matrix made by NumPy from the list of springs, rows as in `to_dense`."""

    matrix: SpringMatrix
    sparse: scipy.sparse.csr_array

    @property
    def dense(self):
        """(N D, N D) NumPy array."""
        return self.sparse.toarray()

    def holding(self, net, *masks):
        """The same with coordinates held where the masks, (N,) in the user's order or None, are False; one mask for all may be repeated."""
        fields = {id(m): net.node_field(m) for m in masks if m is not None}
        matrix = SpringMatrix(
            self.matrix.blocks, tuple(None if m is None else fields[id(m)] for m in masks), self.matrix.like, self.matrix.layout
        )
        free = np.stack([np.ones(net.n_nodes, bool) if m is None else m for m in masks], axis=-1).ravel()
        keep = scipy.sparse.diags_array(free.astype(self.sparse.dtype))
        return Step(matrix, (keep @ self.sparse @ keep + scipy.sparse.diags_array((~free).astype(self.sparse.dtype))).tocsr())

    def plus(self, net, extra):
        """The same with (N, D) numbers more on the diagonal."""
        more = Blocks((js.Vector(tuple(net.node_field(extra[:, i]) for i in range(extra.shape[1]))),))
        matrix = SpringMatrix(self.matrix.blocks + more, self.matrix.free, self.matrix.like, self.matrix.layout)
        return Step(matrix, (self.sparse + scipy.sparse.diags_array(extra.ravel())).tocsr())


def stiff_step(net, points, rng, *, scalar=False, dt_over_limit=100.0, dtype=np.float64):
    """M/dt + dt K of random masses near 1 kg and springs w I + s u u' with w >= 0 and s > 0, dt times its explicit limit.

    `scalar` leaves out the slopes: the coordinates decouple. The masses are one array for all coordinates.
    """
    points = points.astype(dtype)
    weight, slope = rng.random(net.n_springs), np.zeros(net.n_springs) if scalar else 0.5 + rng.random(net.n_springs)
    mass = 0.5 + rng.random(net.n_nodes)
    at_node = np.bincount(net.edges.ravel(), np.repeat(weight + slope, 2), net.n_nodes)
    dt = dt_over_limit * 2 / np.sqrt(2 * (at_node / mass).max()) if net.n_springs else 1.0
    weight, slope, diagonal = ((dt * weight).astype(dtype), (dt * slope).astype(dtype), (mass / dt).astype(dtype))
    blocks, like = spring_blocks(net, points, weight, None if scalar else slope)
    diagonal = net.node_field(diagonal)
    dim = points.shape[1]
    matrix = SpringMatrix(Blocks((js.Vector((diagonal,) * dim),), (), (blocks,)), (None,) * dim, like, net.layout)
    return Step(matrix, in_numpy(net, points, weight, slope, np.asarray(net.flatten_nodes(diagonal))))


@eqx.filter_jit
def spring_blocks(net, points, weight, slope=None, axes=None):
    """The blocks of springs between (N, D) points, and the points as a `Vector`."""
    like = net.vector_field(points)
    if slope is None:
        return SpringBlocks(net, net.edge_field(weight), None, None, axes), like
    moving = like if axes is None else js.Vector(tuple(like[i] for i in axes))
    direction = net.map_springs(lambda d: d / jnp.where(d.norm() > 0, d.norm(), 1), net.unboxed().difference(moving))
    return SpringBlocks(net, net.edge_field(weight), net.edge_field(slope), direction, axes), like


def in_numpy(net, points, weight, slope, diagonal):
    """The matrix from the list of springs, 2 D x 2 D entries for each."""
    (tail, head), (n_nodes, dim) = net.edges.T, points.shape
    d = points[head] - points[tail]
    length = np.linalg.norm(d, axis=1, keepdims=True)
    u = d / np.where(length > 0, length, 1)
    block = weight[:, None, None] * np.eye(dim, dtype=points.dtype) + slope[:, None, None] * u[:, :, None] * u[:, None, :]
    node, i = np.arange(n_nodes), np.arange(dim)
    rows, columns, values = [(node[:, None] * dim + i).ravel()], [(node[:, None] * dim + i).ravel()], [np.repeat(diagonal, dim)]
    for one, other, sign in ((tail, tail, 1), (head, head, 1), (tail, head, -1), (head, tail, -1)):
        shape = block.shape
        rows.append(np.broadcast_to(one[:, None, None] * dim + i[None, :, None], shape).ravel())
        columns.append(np.broadcast_to(other[:, None, None] * dim + i[None, None, :], shape).ravel())
        values.append(sign * block.ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.coo_array(entries, shape=(n_nodes * dim,) * 2).tocsr()


def near_grid(net, rng, dim=3, noise=0.2):
    """(N, dim) points near the lattice's grid."""
    grid = net.grid()
    flat = np.concatenate([grid, np.zeros((len(grid), max(dim - grid.shape[1], 0)))], axis=1)[:, :dim]
    return flat + noise * rng.standard_normal(flat.shape)


def random_vector(net, rng, dim=3, dtype=np.float64):
    """A `Vector` of normal numbers in node shape."""
    return net.vector_field(rng.standard_normal((net.n_nodes, dim)).astype(dtype))


def flat(net, v):
    """(N D,) in the order of `to_dense`."""
    return np.stack([np.asarray(net.flatten_nodes(a)) for a in v], axis=-1).ravel()
