"""Derivatives through the direct solver: implicit, by the factor that the forward solve used."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.operators import Blocks, SpringBlocks, SpringMatrix
from jaxspring.linalg.skyline import Skyline
from tests.step_matrices import near_grid, random_vector, stiff_step

NET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)


@pytest.fixture
def case(rng):
    """A stiff matrix, its parameters as flat arrays, and a right-hand side."""
    step = stiff_step(NET, near_grid(NET, rng), rng, dt_over_limit=10.0)
    springs = step.matrix.blocks.springs[0]
    parameters = {
        "weight": NET.flatten(springs.weight),
        "slope": NET.flatten(springs.slope),
        "mass": step.matrix.blocks.diagonal[0].x.ravel(),
        "b": jnp.stack([a.ravel() for a in random_vector(NET, rng)], axis=-1),
    }
    return step.matrix, parameters


def rebuilt(matrix, parameters):
    """The matrix with these parameters, two nodes held, and the right-hand side."""
    old = matrix.blocks.springs[0]
    springs = SpringBlocks(NET, NET.split(parameters["weight"]), NET.split(parameters["slope"]), old.direction)
    held = jnp.ones((4, 5), bool).at[0, 0].set(False).at[3, 4].set(False)
    blocks = Blocks((js.Vector((parameters["mass"].reshape(4, 5),) * 3),), (), (springs,))
    return SpringMatrix(blocks, (held,) * 3, matrix.like, matrix.layout), NET.vector_field(parameters["b"])


def direct(matrix, b):
    """By jnp.linalg.solve of the dense matrix."""
    flat = jnp.stack([a.ravel() for a in b], axis=-1).ravel()
    x = jnp.linalg.solve(matrix.to_dense(), flat).reshape(20, 3)
    return js.Vector(tuple(x[:, i].reshape(4, 5) for i in range(3)))


def by_skyline(matrix, b):
    """By the direct solver, anew."""
    return Skyline(NET).solve_in_step(matrix, b, None, None)[0]


def loss_of(solver, matrix):
    """A loss that weighs every coordinate of the solution differently, as a function of the parameters."""
    weights = np.random.default_rng(7).standard_normal((3, 4, 5))

    def loss(parameters):
        x = solver(*rebuilt(matrix, parameters))
        return sum(jnp.sum(w * jnp.sin(a)) for w, a in zip(weights, x, strict=True))

    return loss


@eqx.filter_jit
def gradient_of(matrix, parameters):
    """Of the loss by the direct solver, compiled once for all tests."""
    return jax.grad(loss_of(by_skyline, matrix))(parameters)


def test_gradient_is_that_of_a_dense_solve(case):
    """By weights, slopes, masses and the right-hand side, with held nodes: jnp.linalg.solve, differentiated by JAX."""
    matrix, parameters = case
    found = gradient_of(matrix, parameters)
    expected = jax.jit(jax.grad(loss_of(direct, matrix)))(parameters)
    for name, value in expected.items():
        assert np.max(np.abs(found[name] - value)) < 1e-10 * np.max(np.abs(value)), name


def test_gradient_is_that_of_central_differences(case, rng):
    """Along a random direction of all parameters, the derivative is the central difference to 1e-8; forward mode agrees to rounding."""
    matrix, parameters = case
    loss = jax.jit(loss_of(by_skyline, matrix))
    direction = {name: np.abs(np.asarray(a)) * rng.standard_normal(a.shape) for name, a in parameters.items()}

    def at(h):
        return loss({name: a + h * direction[name] for name, a in parameters.items()})

    h = 1e-5
    difference = (at(h) - at(-h)) / (2 * h)
    gradient = gradient_of(matrix, parameters)
    reverse = sum(float(np.sum(gradient[name] * direction[name])) for name in parameters)
    assert reverse == pytest.approx(float(difference), rel=1e-7)
    forward = jax.jit(lambda p, d: jax.jvp(loss, (p,), (d,))[1])(parameters, direction)
    assert float(forward) == pytest.approx(reverse, rel=1e-11)


@pytest.mark.slow
def test_gradient_through_steps_that_keep_the_factor(case):
    """Five steps in a scan with the factor in memory: the gradient by the constant matrix is that of five dense solves."""
    matrix, parameters = case

    def steps(solver):
        def run(matrix, b):
            begin = (b, Skyline(NET).init(matrix))
            return jax.lax.scan(lambda carry, _: (solver(matrix, *carry), None), begin, None, length=5)[0][0]

        return run

    def kept(matrix, x, memory):
        x, _, memory = Skyline(NET).solve_in_step(matrix, x, None, memory)
        return x, memory

    found = jax.jit(jax.grad(loss_of(steps(kept), matrix)))(parameters)
    expected = jax.jit(jax.grad(loss_of(steps(lambda matrix, x, memory: (direct(matrix, x), memory)), matrix)))(parameters)
    for name, value in expected.items():
        assert np.max(np.abs(found[name] - value)) < 1e-9 * np.max(np.abs(value)), name


def test_adjoint_reuses_the_factor(case):
    """Loss and gradient together hold as many Cholesky kernels as the loss alone: nothing is factored anew."""
    matrix, parameters = case
    loss = loss_of(by_skyline, matrix)
    forward, both = (str(jax.make_jaxpr(f)(parameters)).count("= cholesky") for f in (loss, jax.value_and_grad(loss)))
    assert forward == both == 1


def test_gradient_is_the_same_in_every_lane(case):
    """`vmap` of the gradient over three right-hand sides equals three gradients."""
    matrix, parameters = case
    scales = (1.0, -2.0, 0.5)
    lanes = {name: jnp.stack([a * (s if name == "b" else 1.0) for s in scales]) for name, a in parameters.items()}
    together = jax.jit(jax.vmap(jax.grad(loss_of(by_skyline, matrix))))(lanes)
    for i, s in enumerate(scales):
        one = gradient_of(matrix, {**parameters, "b": parameters["b"] * s})
        for name, value in one.items():
            np.testing.assert_allclose(together[name][i], value, rtol=1e-9, atol=1e-12 * float(jnp.max(jnp.abs(value))), err_msg=name)


def test_scale_of_the_cotangent_does_not_matter(case):
    """The gradient is linear in its cotangent over 60 decades, also in float32."""
    matrix, parameters = case
    narrow, b = jax.tree.map(lambda a: a.astype(np.float32) if eqx.is_inexact_array(a) else a, rebuilt(matrix, parameters))

    @jax.jit
    def pulled(scale):
        _, pull = jax.vjp(lambda b: by_skyline(narrow, b), b)
        return pull(js.Vector((scale * jnp.ones((4, 5), np.float32),) * 3))[0]

    one = pulled(np.float32(1.0))
    for scale in (1e-30, 1e30):
        for a, c in zip(one, pulled(np.float32(scale)), strict=True):
            assert c.dtype == np.float32
            np.testing.assert_allclose(np.asarray(c, float) / scale, np.asarray(a, float), rtol=1e-5)


def test_a_failed_factorisation_gives_a_nan_gradient(case):
    """With an indefinite matrix the gradient is NaN where it depends on the solve, never a plausible number."""
    matrix, parameters = case
    heavy = {**parameters, "mass": parameters["mass"].at[7].set(-1e3)}
    assert np.all(np.isnan(gradient_of(matrix, heavy)["weight"]))
