"""Gradients through implicit steps: implicit against central differences and forward mode, on a squeezed net too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

TIGHT = js.JaxCG(tolerance=1e-12)
EXACT = js.linalg.ExactSolver(js.CG(tolerance=1e-12))
FINE = js.Newton(tolerance=1e-13, max_iter=300)

STEPPERS = [
    js.BackwardEuler(TIGHT),
    js.BackwardEuler(TIGHT, newton=FINE, adjoint=EXACT),
    js.ImplicitMidpoint(TIGHT, newton=FINE, adjoint=EXACT),
    js.BDF2(TIGHT, newton=FINE, adjoint=EXACT),
]
NAMES = ["BackwardEuler", "BackwardEuler, Newton", "ImplicitMidpoint", "BDF2"]


def chain(squeeze):
    """A jittered chain in space, pinned at both ends, its springs squeezed (or stretched) by that factor, with drag and gravity."""
    rng = np.random.default_rng(7)
    net = js.lattice(6)
    points = 0.05 * rng.normal(size=(6, 3))
    points[:, 0] += np.arange(6) * squeeze
    free = np.ones(6, bool)
    free[[0, -1]] = False
    system = js.System(net, 1.0, (js.Springs(net, 40.0, 1.0), js.Drag(0.3), js.Gravity([0.0, 0.0, -1.0])), free=free)
    return system, js.State.from_points(net, points)


def loss(stepper, squeeze, n_steps=4, dt=0.2):
    system, start = chain(squeeze)

    def of(k):
        run = js.rollout(js.replace(system, stiffness=k), start, stepper, dt, n_steps)
        return jnp.sum(run.state.position.z**2) + jnp.sum(run.state.position.x**2)

    return of


@pytest.mark.slow
@pytest.mark.parametrize("squeeze", [0.8, 1.2])
@pytest.mark.parametrize("stepper", STEPPERS, ids=NAMES)
def test_reverse_forward_and_differences_agree(stepper, squeeze):
    """Reverse mode is forward mode to 1e-9, and central differences to 1e-7 of it, squeezed (an indefinite Hessian) and stretched."""
    f = jax.jit(loss(stepper, squeeze))
    k, h = 40.0, 1e-3
    reverse = float(jax.jit(jax.grad(f))(k))
    forward = float(jax.jit(lambda k: jax.jvp(f, (k,), (1.0,))[1])(k))
    differences = (8 * (f(k + h) - f(k - h)) - (f(k + 2 * h) - f(k - 2 * h))) / (12 * h)
    assert forward == pytest.approx(reverse, rel=1e-9)
    assert float(differences) == pytest.approx(reverse, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", STEPPERS[:2], ids=NAMES[:2])
def test_hessian_vector_products(stepper):
    """Reverse over reverse and forward over reverse are the central difference of the gradient, through the scan of steps."""
    f = loss(stepper, 1.2)
    gradient = jax.jit(jax.grad(f))
    k, h = 40.0, 1e-3
    differences = float((gradient(k + h) - gradient(k - h)) / (2 * h))
    assert float(jax.jit(jax.grad(jax.grad(f)))(k)) == pytest.approx(differences, rel=1e-5)
    assert float(jax.jit(lambda k: jax.jvp(jax.grad(f), (k,), (1.0,))[1])(k)) == pytest.approx(differences, rel=1e-5)


def test_a_step_that_did_not_converge_has_no_gradient():
    """Newton's method stopped too early: the status says so, and the gradient is NaN, never that of a half-found state."""
    system, start = chain(0.8)

    def of(k):
        run = js.rollout(js.replace(system, stiffness=k), start, js.BackwardEuler(newton=js.Newton(max_iter=2)), 0.2, 1)
        return jnp.sum(run.state.position.z), run.status

    gradient, status = jax.grad(of, has_aux=True)(40.0)
    assert bool(status.has(js.Flag.SOLVER))
    assert np.isnan(float(gradient))


@pytest.mark.slow
def test_ways_to_remember_give_one_gradient():
    """Blocks, stored states and everything stored: the same gradient to round-off, whichever is kept."""
    system, start = chain(1.2)

    def gradient(adjoint):
        def of(k):
            run = js.rollout(js.replace(system, stiffness=k), start, js.BackwardEuler(TIGHT), 0.2, 6, adjoint=adjoint)
            return jnp.sum(run.state.position.z**2)

        return float(jax.jit(jax.grad(of))(40.0))

    expected = gradient(js.StoreAll())
    assert gradient(js.StoreStates()) == pytest.approx(expected, rel=1e-11)
    assert gradient(js.Checkpointed()) == pytest.approx(expected, rel=1e-11)


@pytest.mark.slow
def test_a_batch_of_gradients_is_the_gradients():
    """`vmap(grad)` over three stiffnesses equals three gradients."""
    f = jax.grad(loss(js.BackwardEuler(TIGHT), 1.2, n_steps=2))
    values = jnp.array([20.0, 40.0, 80.0])
    batch = jax.jit(jax.vmap(f))(values)
    single = jax.jit(f)
    np.testing.assert_allclose(batch, [single(k) for k in values], rtol=1e-9)
