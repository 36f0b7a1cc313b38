"""Guarded conjugate gradients: right where they can be, and loud where they cannot."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxspring.linalg.cg import JaxCG
from jaxspring.status import Flag
from jaxspring.vector import Vector


@pytest.fixture
def spd(rng):
    q, _ = np.linalg.qr(rng.standard_normal((30, 30)))
    return (q * np.linspace(1, 100, 30)) @ q.T


def test_solution_is_numpys(spd, rng):
    """The solution equals numpy.linalg.solve to the tolerance, and the residual reported is the true one."""
    b = rng.standard_normal(30)
    x, info = JaxCG(tolerance=1e-12).solve(lambda v: jnp.asarray(spd) @ v, jnp.asarray(b))
    np.testing.assert_allclose(x, np.linalg.solve(spd, b), rtol=1e-10)
    assert float(info.residual) == pytest.approx(np.linalg.norm(b - spd @ np.asarray(x)) / np.linalg.norm(b), rel=1e-2, abs=1e-15)
    assert bool(info.status.is_ok)


def test_preconditioner_and_guess_change_the_work_only(spd, rng):
    """With Jacobi and a warm start the solution is the same."""
    b, inverse = jnp.asarray(rng.standard_normal(30)), jnp.asarray(1 / np.diag(spd))
    x, _ = JaxCG(tolerance=1e-12).solve(lambda v: jnp.asarray(spd) @ v, b, lambda r: inverse * r, jnp.asarray(rng.standard_normal(30)))
    np.testing.assert_allclose(x, np.linalg.solve(spd, b), rtol=1e-10)


def test_vectors_are_solved_as_they_are(rng):
    """A right-hand side in several arrays comes back in the same arrays."""
    b = Vector((jnp.asarray(rng.standard_normal((3, 4))), jnp.asarray(rng.standard_normal((3, 4)))))
    x, _ = JaxCG().solve(lambda v: 3.0 * v, b)
    np.testing.assert_allclose(x.y, b.y / 3, rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-30, 1e-200, 1e200])
def test_scale_of_the_right_hand_side_does_not_matter(spd, rng, scale):
    """The solution is linear in b over 400 decades: nothing underflows."""
    b = rng.standard_normal(30)
    x, info = JaxCG(tolerance=1e-12).solve(lambda v: jnp.asarray(spd) @ v, jnp.asarray(b * scale))
    np.testing.assert_allclose(np.asarray(x) / scale, np.linalg.solve(spd, b), rtol=1e-9)
    assert bool(info.status.is_ok)


def test_zero_right_hand_side_gives_zeros(spd):
    """0 in, exactly 0 out, status OK and gradient finite, even from a warm start."""

    def energy(b):
        x, info = JaxCG().solve(lambda v: jnp.asarray(spd) @ v, b, x0=jnp.ones(30))
        return jnp.sum(x * x), (x, info)

    gradient, (x, info) = jax.grad(energy, has_aux=True)(jnp.zeros(30))
    assert not np.any(x)
    assert not np.any(gradient)
    assert bool(info.status.is_ok)


def test_too_few_iterations_are_reported(spd, rng):
    """One iteration on a matrix of condition 100: CG_MAXITER, with the true residual."""
    _, info = JaxCG(max_iter=1).solve(lambda v: jnp.asarray(spd) @ v, jnp.asarray(rng.standard_normal(30)))
    assert bool(info.status.has(Flag.CG_MAXITER))
    assert 0.01 < float(info.residual) < 10


def test_tolerance_below_rounding_is_reported(spd, rng):
    """Float32 cannot reach 1e-10: the status says so, though the recursion believes it did."""
    a = jnp.asarray(spd, jnp.float32)
    _, info = JaxCG(tolerance=1e-10).solve(lambda v: a @ v, jnp.asarray(rng.standard_normal(30), jnp.float32))
    assert bool(info.status.has(Flag.CG_MAXITER))
    _, info = JaxCG().solve(lambda v: a @ v, jnp.asarray(rng.standard_normal(30), jnp.float32))
    assert bool(info.status.is_ok)
    assert info.residual.dtype == jnp.float32


@pytest.mark.parametrize("matrix", [np.diag([-1.0, -2.0, -3.0]), np.zeros((3, 3))], ids=["negative", "zero"])
def test_indefinite_matrix_is_reported(matrix):
    """Negative energy, or a breakdown to NaN: CG_INDEFINITE."""
    _, info = JaxCG().solve(lambda v: jnp.asarray(matrix) @ v, jnp.ones(3))
    assert bool(info.status.has(Flag.CG_INDEFINITE))


@pytest.mark.slow
def test_derivative_is_implicit_and_right(rng):
    """First and second derivatives in the matrix and in b agree with finite differences, forward and reverse."""
    b = jnp.asarray(rng.standard_normal(4))

    def energy(shift, b):
        x, _ = JaxCG(tolerance=1e-14).solve(lambda v: jnp.arange(1.0, 5.0) * v + shift * v, b)
        return jnp.sum(x**2)

    check_grads(energy, (jnp.asarray(0.3), b), order=2, modes=("fwd", "rev"), rtol=1e-5)


def test_failed_backward_solve_gives_nan(spd, rng):
    """Three iterations: the value comes with CG_MAXITER, its gradient is NaN and not some number."""

    def energy(b):
        x, info = JaxCG(max_iter=3).solve(lambda v: jnp.asarray(spd) @ v, b)
        return jnp.sum(x**2), info

    gradient, info = jax.grad(energy, has_aux=True)(jnp.asarray(rng.standard_normal(30)))
    assert bool(info.status.has(Flag.CG_MAXITER))
    assert np.all(np.isnan(gradient))


def test_batches_are_solved_lane_by_lane(spd, rng):
    """A vmap over right-hand sides of different difficulty equals the loop."""
    b = jnp.asarray(rng.standard_normal((3, 30)))
    x, info = jax.vmap(lambda b: JaxCG(tolerance=1e-12).solve(lambda v: jnp.asarray(spd) @ v, b))(b)
    np.testing.assert_allclose(x, np.linalg.solve(spd, b.T).T, rtol=1e-9)
    assert info.residual.shape == (3,)


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"tolerance": float("nan")}, {"max_iter": 0}])
def test_wrong_settings_are_refused(wrong):
    """A tolerance or a count that cannot work is a ValueError that names it."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        JaxCG(**wrong)
