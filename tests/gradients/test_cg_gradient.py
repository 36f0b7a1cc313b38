"""Derivatives through guarded conjugate gradients: implicit, right at every size of the cotangent, and NaN where a solve fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxspring as js
from jaxspring.linalg.cg import CG, JaxCG
from jaxspring.linalg.multigrid import Multigrid
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix
from jaxspring.vector import Vector
from tests.step_matrices import near_grid, random_vector, stiff_step

each_solver = pytest.mark.parametrize("solver", [JaxCG, CG])
NET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)
QUICK = {"xla_backend_optimization_level": 0}  # programs that run once, for milliseconds


@pytest.fixture
def spd(rng):
    q, _ = np.linalg.qr(rng.standard_normal((30, 30)))
    return jnp.asarray((q * np.linspace(1, 100, 30)) @ q.T)


@pytest.mark.slow
@each_solver
def test_derivative_is_implicit_and_right(rng, solver):
    """First and second derivatives in the matrix and in b agree with finite differences, forward and reverse."""
    b = jnp.asarray(rng.standard_normal(4))

    def energy(shift, b):
        x, _ = solver(tolerance=1e-14).solve(lambda v: jnp.arange(1.0, 5.0) * v + shift * v, b)
        return jnp.sum(x**2)

    check_grads(energy, (jnp.asarray(0.3), b), order=2, modes=("fwd", "rev"), rtol=1e-5)


@each_solver
@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_cotangents_of_any_size(spd, rng, dtype, solver, size):
    """The gradient is linear in the cotangent over 60 decades, in float32 too: A^-1 w and -(A^-1 w) x'."""
    a, b, w = spd.astype(dtype), rng.standard_normal(30).astype(dtype), rng.standard_normal(30)

    def solution(a, b):
        return solver().solve(lambda v: 0.5 * (a + a.T) @ v, b)[0]

    x, pull_back = jax.vjp(solution, a, jnp.asarray(b))
    by_matrix, by_b = pull_back(jnp.asarray(size * w, dtype))
    expected = np.linalg.solve(np.asarray(spd), w)
    outer = -0.5 * (np.outer(expected, x) + np.outer(x, expected))
    accuracy = 1e-6 if dtype == np.float64 else 1e-3
    np.testing.assert_allclose(np.asarray(by_b, float) / size, expected, atol=accuracy * np.abs(expected).max())
    np.testing.assert_allclose(np.asarray(by_matrix, float) / size, outer, atol=accuracy * np.abs(outer).max())


@each_solver
def test_tangents_start_from_zero_where_the_guess_is_far(spd, rng, solver):
    """A tangent of 1e-20 beside a warm start of size 1 keeps all its digits."""
    b, small = jnp.asarray(rng.standard_normal(30)), rng.standard_normal(30) * 1e-20
    guess = jnp.linalg.solve(spd, b)
    _, tangent = jax.jvp(lambda b: solver(tolerance=1e-12).solve(lambda v: spd @ v, b, x0=guess)[0], (b,), (jnp.asarray(small),))
    np.testing.assert_allclose(tangent, np.linalg.solve(np.asarray(spd), small), rtol=1e-8)


@each_solver
def test_failed_backward_solve_gives_nan(spd, rng, solver):
    """Three iterations: the value comes with CG_MAXITER, its gradient is NaN and not some number."""

    def energy(b):
        x, info = solver(max_iter=3).solve(lambda v: spd @ v, b)
        return jnp.sum(x**2), info

    gradient, info = jax.grad(energy, has_aux=True)(jnp.asarray(rng.standard_normal(30)))
    assert not bool(info.status.is_ok)
    assert np.all(np.isnan(gradient))


@each_solver
def test_adjoint_has_a_tolerance_of_its_own(spd, rng, solver):
    """A loose one changes the gradient by no more than ten times itself and the solution by nothing; one beyond rounding gives NaN."""
    b, w = jnp.asarray(rng.standard_normal(30)), jnp.asarray(rng.standard_normal(30))
    expected = np.linalg.solve(np.asarray(spd), w)
    condition = 100.0

    def along(chosen):
        return jax.value_and_grad(lambda b: w @ chosen.solve(lambda v: spd @ v, b)[0])(b)

    tight, _ = along(solver(tolerance=1e-12))
    for adjoint in (1e-3, 1e-6):
        value, gradient = along(solver(tolerance=1e-12, adjoint_tolerance=adjoint))
        assert float(value) == float(tight)
        error = np.linalg.norm(gradient - expected) / np.linalg.norm(expected)
        assert 1e-3 * adjoint < error < 10 * adjoint * condition
        assert np.linalg.norm(np.asarray(spd) @ np.asarray(gradient) - w) < 10 * adjoint * np.linalg.norm(w)
    value, gradient = along(solver(tolerance=1e-12, adjoint_tolerance=1e-30))
    assert np.isfinite(value)
    assert np.all(np.isnan(gradient))


@pytest.fixture(scope="module")
def dense():
    """A step with held nodes: its solve by a matrix made anew of four parameters, and value and gradient by a dense solve."""
    rng = np.random.default_rng(20260101)
    step, b = stiff_step(NET, near_grid(NET, rng), rng, dt_over_limit=10.0), random_vector(NET, rng)
    old = step.matrix.blocks.springs[0]
    held = jnp.ones((4, 5), bool).at[0, 0].set(False).at[3, 4].set(False)
    weights = rng.standard_normal((3, 4, 5))

    def rebuilt(p):
        springs = SpringBlocks(NET, NET.split(p["weight"]), NET.split(p["slope"]), old.direction)
        blocks = Blocks((js.Vector((p["mass"],) * 3),), (), (springs,))
        return SpringMatrix(blocks, (held,) * 3, step.matrix.like, step.matrix.layout)

    def direct(p):
        flat = jnp.stack([a.ravel() for a in p["b"]], axis=-1).ravel()
        x = jnp.linalg.solve(rebuilt(p).to_dense(), flat).reshape(4, 5, 3)
        return sum(jnp.sum(weights[i] * jnp.sin(x[..., i])) for i in range(3))

    parameters = {
        "weight": NET.flatten(old.weight),
        "slope": NET.flatten(old.slope),
        "mass": step.matrix.blocks.diagonal[0].x,
        "b": b,
    }
    return rebuilt, weights, parameters, jax.jit(jax.value_and_grad(direct), compiler_options=QUICK)(parameters)


@pytest.mark.slow
@each_solver
@pytest.mark.parametrize("kind", ["blocks", "multigrid"])
def test_gradient_by_springs_masses_and_forces(dense, solver, kind):
    """With held nodes, any preconditioner, and a guess: the derivatives of a dense solve, which the preconditioner does not enter."""
    rebuilt, weights, parameters, (expected_value, expected) = dense
    options = {"tolerance": 1e-13} if kind == "blocks" else {"tolerance": 1e-13, "preconditioner": Multigrid(NET)}
    guess = parameters["b"]

    def iterated(p):
        x, _, _ = solver(**options).solve_in_step(rebuilt(p), p["b"], guess, None)
        return sum(jnp.sum(w * jnp.sin(a)) for w, a in zip(weights, x, strict=True))

    value, gradient = jax.jit(jax.value_and_grad(iterated), compiler_options=QUICK)(parameters)
    assert float(value) == pytest.approx(float(expected_value), rel=1e-10)
    for got, known in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(got, known, atol=1e-8 * np.abs(known).max())


def test_a_right_side_that_varies_in_one_coordinate():
    """Reverse mode by one coordinate of b, the other constant: half of 2 x / 2, where JAX's own solve stops with an assertion."""

    def energy(y):
        x, _ = JaxCG().solve(lambda v: 2.0 * v, Vector((jnp.ones(3), y)))
        return jnp.sum(x.dot(x))

    np.testing.assert_allclose(jax.grad(energy)(jnp.arange(3.0)), 0.5 * np.arange(3.0), rtol=1e-12)
