"""Hard case D10: derivatives by the melting point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice(5)
HALF = np.array([300.0, 310.0, 340.0, 390.0, 395.0])


def tip(melting, sharpness, softening=330.0, temperature=HALF):
    """Place of a hanging chain's tip [m] after 60 steps."""
    springs = js.Springs(NET, js.thermal.ThermalStiffness(60.0, softening, melting, sharpness), 1.0)
    rules = js.Fusing(NET, melting) if sharpness is None else ()
    system = js.System(NET, 1.0, (springs, js.Gravity((2.0,)), js.Drag(0.4)), np.arange(5) > 0, rules=rules)
    state = js.State.from_points(NET, NET.grid(), temperature=temperature)
    return js.rollout(system, state, js.SymplecticEuler(), 0.02, 60).state.points[-1, 0]


def central(f, x, h):
    return (f(x + h) - f(x - h)) / (2 * h)


@pytest.mark.slow
@pytest.mark.parametrize("melting", [370.0, 400.0, 430.0])
def test_d10_smooth_melting_has_the_right_derivative(melting):
    """D10: automatic and central differences of the smooth model agree to 5 digits."""
    f = jax.jit(lambda m: tip(m, 10.0))
    slope = float(jax.jit(jax.grad(f))(melting))
    assert abs(slope) > 1e-5
    assert slope == pytest.approx(float(central(f, melting, 1e-2)), rel=1e-5)


@pytest.mark.slow
def test_d10_hard_melting_has_derivative_zero():
    """D10: where no spring is between softening and melting, the hard model's derivative and differences are 0."""
    step = np.array([300.0, 300.0, 300.0, 420.0, 420.0])

    def f(melting):
        return tip(melting, None, softening=melting - 1e-3, temperature=step)

    assert float(jax.grad(f)(jnp.asarray(390.0))) == 0
    assert float(central(f, 390.0, 1.0)) == 0
    assert abs(float(f(430.0) - f(390.0))) > 1e-3
