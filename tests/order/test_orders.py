"""Observed orders of the explicit steppers, with damping too."""

import jax
import numpy as np
import pytest

import jaxspring as js

OMEGA, END = 3.0, 1.0


def exact(drag):
    """Position and velocity at t = 1 of x'' + drag x' + 9 x = 0 with x(0) = 1, x'(0) = 0."""
    w = np.sqrt(OMEGA**2 - drag**2 / 4)
    decay = np.exp(-drag * END / 2)
    return decay * (np.cos(w * END) + drag / (2 * w) * np.sin(w * END)), -decay * OMEGA**2 / w * np.sin(w * END)


def error(stepper, drag, n_steps):
    """Distance from the closed form in the plane of x and v / omega."""
    net = js.lattice(2)
    system = js.System(net, 1.0, (js.Springs(net, OMEGA**2), js.Drag(drag)), free=np.array([False, True]))
    start = js.State.from_points(net, [[0.0], [1.0]])
    # Under jit, for forward Euler warns at every dt: without damping it has no stable one.
    end = jax.jit(lambda dt: js.rollout(system, start, stepper, dt, n_steps).state)(END / n_steps)
    x, v = exact(drag)
    return np.hypot(float(end.points[1, 0]) - x, (float(end.velocities[1, 0]) - v) / OMEGA)


@pytest.mark.parametrize("drag", [0.0, 0.8])
@pytest.mark.parametrize(
    ("stepper", "order"),
    [(js.ForwardEuler(), 1), (js.SymplecticEuler(), 1), (js.VelocityVerlet(), 2), (js.RungeKutta4(), 4), (js.SemiImplicit(), 1)],
    ids=lambda value: type(value).__name__ if isinstance(value, js.Stepper) else None,
)
def test_error_falls_as_dt_to_the_order(stepper, order, drag):
    """Against the closed-form oscillator, halving dt divides the error by 2**order, with drag and without."""
    n = 400 if order == 1 else 100
    ratio = error(stepper, drag, n) / error(stepper, drag, 2 * n)
    assert np.log2(ratio) == pytest.approx(order, abs=0.1)
