"""`LineSolver`: tridiagonal systems along an axis against dense ones, and without loss of digits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.lines import LineSolver, solve_lines
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix
from jaxspring.topology.lattice import Lattice

SHAPE = (3, 4, 5)


def matrix_along(axis, weight, held=()):
    """A random diagonal and springs along one axis, some nodes held."""
    offset = tuple(int(a == axis) for a in range(3))
    net = Lattice(SHAPE, (offset,), (False,) * 3, None)
    diagonal = jnp.asarray(1 + np.random.default_rng(1).random(SHAPE))
    free = np.ones(60, bool)
    free[list(held)] = False
    v = js.Vector((diagonal,))
    return SpringMatrix(Blocks((v,), (), (SpringBlocks(net, net.split(weight)),)), (jnp.asarray(free.reshape(SHAPE)),), v, net.layout)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_solution_is_the_dense_one(axis, rng):
    """Along each axis, with held nodes inside: NumPy's solution to 1e-13, and its derivative by the weights."""
    n = [40, 45, 48][axis]
    weight, b = jnp.asarray(rng.uniform(0, 9, n)), jnp.asarray(rng.normal(size=SHAPE))
    held = (0, 17, 18, 59)

    def solve(weight):
        return LineSolver(axis).solve_in_step(matrix_along(axis, weight, held), js.Vector((b,)), None, None)[0][0]

    def dense(weight):
        return jnp.linalg.solve(matrix_along(axis, weight, held).to_dense(), b.ravel()).reshape(SHAPE)

    np.testing.assert_allclose(solve(weight), dense(weight), atol=1e-13)
    probe = jnp.asarray(rng.normal(size=SHAPE))
    by_lines, by_dense = (jax.grad(lambda w, f=f: jnp.sum(probe * f(w)))(weight) for f in (solve, dense))
    np.testing.assert_allclose(by_lines, by_dense, atol=1e-12)


def test_no_digit_is_lost_to_strong_links():
    """With links 1e15 times the excess, the solution is the mean of b over e, to rounding; a pivot by difference would keep one digit."""
    e, w = jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([1e15, 1e15, 1e15, 0.0])
    x = solve_lines(e, w, jnp.array([3.0, 1.0, 4.0, 1.0]), 0)
    np.testing.assert_allclose(x, 0.9, rtol=1e-14)


def test_only_its_axis():
    """Springs along another axis are refused."""
    with pytest.raises(ValueError, match="along axis 0"):
        LineSolver(0).solve_in_step(matrix_along(1, jnp.ones(45)), js.Vector((jnp.ones(SHAPE),)), None, None)
