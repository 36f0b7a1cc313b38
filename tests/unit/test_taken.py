"""A matrix with directions taken from nodes, and every solver of it, against dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.cg import CG, JaxCG
from jaxspring.linalg.multigrid import Multigrid
from jaxspring.linalg.operators import Blocks, NodeDyads, SpringMatrix
from jaxspring.linalg.preconditioners import BlockJacobi

NET = js.lattice((2, 4), js.STRUCTURAL + js.SHEAR)
POINTS = np.c_[NET.grid(1.0), np.sin(NET.grid(1.0)[:, 0])]


def scene(rng, dtype):
    """A matrix of a system, three of whose nodes are held in a coordinate, with directions taken at the five others."""
    n = NET.n_nodes
    free = np.ones((n, 3), bool)
    free[:3, 0] = False
    state = js.State.from_points(NET, jnp.asarray(POINTS + 0.1 * rng.normal(size=POINTS.shape), dtype))
    system = js.System(NET, 1.0, js.Springs(NET, 300.0, NET.lengths(POINTS)), free=free).bind(state.dtype)
    blocks = system.stiffness_blocks(state, js.steppers.Tangent())
    matrix = system.matrix(blocks + Blocks((state.position.map(jnp.ones_like),)), state)
    e = np.zeros((2, n, 3))
    for i in range(3, 8):
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        e[:, i] = q[:2] if i % 2 else [q[0], 0 * q[1]]
    directions = tuple(NET.vector_field(jnp.asarray(d, dtype), "direction") for d in e)
    projection = np.eye(3 * n) - sum(np.einsum("ni,nj,nm->nimj", d, d, np.eye(n)).reshape(3 * n, 3 * n) for d in e)
    projection = projection @ np.diag(free.ravel().astype(float))
    return matrix, matrix.taking(directions), projection


def flat(v):
    return np.stack([np.asarray(NET.flatten_nodes(a)) for a in v], axis=-1).ravel()


def test_the_matrix_is_projected(rng):
    """P A P + I - P, dense, in SciPy's form and as a product."""
    matrix, taken, p = scene(rng, np.float64)
    dense = p @ np.asarray(matrix.to_dense()) @ p + np.eye(len(p)) - p
    np.testing.assert_allclose(taken.to_dense(), dense, atol=1e-12)
    np.testing.assert_allclose(taken.to_scipy().toarray(), dense, atol=1e-12)


SOLVERS = {
    "JaxCG": JaxCG(tolerance=1e-12),
    "multigrid": CG(tolerance=1e-12, preconditioner=Multigrid(NET)),
    "Skyline": js.Skyline(NET),
}


@pytest.mark.slow
def test_every_solver_solves_with_it(rng):
    """The dense solution, b kept exactly along what is taken, and derivatives by b and by the matrix."""
    matrix, taken, p = scene(rng, np.float64)
    dense = p @ np.asarray(matrix.to_dense()) @ p + np.eye(len(p)) - p
    b = rng.normal(size=(NET.n_nodes, 3))
    right = NET.vector_field(b, "b")
    # The right-hand side of what is held is the solution there.
    expected = np.linalg.solve(dense, b.ravel())
    for name, solver in SOLVERS.items():
        x, info, _ = jax.jit(lambda solver=solver: solver.find_in_step(taken, right, None, solver.init(taken)))()
        assert bool(info.status.is_ok), name
        np.testing.assert_allclose(flat(x), expected, atol=1e-9, err_msg=name)
        np.testing.assert_allclose((np.eye(len(p)) - p) @ flat(x), (np.eye(len(p)) - p) @ b.ravel(), atol=1e-13)
        if name in ("JaxCG", "Skyline"):

            def total(s, solver=solver):
                scaled = SpringMatrix(taken.blocks.scaled(s), taken.free, taken.like, taken.layout, taken.taken)
                x = solver.solve_in_step(scaled, s * right, None, solver.init(scaled))[0]
                return sum(jnp.sum(a * jnp.cos(jnp.arange(a.size, dtype=a.dtype).reshape(a.shape))) for a in x)

            compiled = jax.jit(jax.value_and_grad(total))
            (above, _), (below, _) = compiled(1.5 + 1e-5), compiled(1.5 - 1e-5)
            assert float(compiled(1.5)[1]) == pytest.approx(float(above - below) / 2e-5, rel=1e-6), name


@pytest.mark.slow
def test_a_factor_in_float32_is_corrected(rng):
    """The factor knows what is taken but for a share; corrections take the rest, to single precision."""
    _, taken, _ = scene(rng, np.float32)
    b = rng.normal(size=(NET.n_nodes, 3)).astype(np.float32)
    skyline = js.Skyline(NET)
    x, info, _ = skyline.find_in_step(taken, NET.vector_field(b, "b"), None, None)
    assert bool(info.status.is_ok)
    np.testing.assert_allclose(flat(x), np.linalg.solve(np.asarray(taken.to_dense(), np.float64), b.ravel()), atol=2e-4)


def test_slopes_are_firm(rng):
    """What stands for firmness in a factor is far above what a node has, and within the digits."""
    _, taken, _ = scene(rng, np.float64)
    assert all(isinstance(d, NodeDyads) for d in taken.taken)
    ratio = np.asarray(taken.taken[0].slope) / np.asarray(sum(taken.diagonal()) - taken.taken[0].slope)
    assert ratio.max() < 1e8
    assert BlockJacobi().build(taken) is not None
