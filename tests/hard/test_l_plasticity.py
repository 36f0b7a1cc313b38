"""Hard case L9: a plastic spring exactly at yield, under a cyclic load, and with dt halved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxspring as js
from jaxspring.plasticity import Yielding

PAIR = js.lattice(2)
K, YIELD, HARD, DRAG = 100.0, 2.0, 25.0, 0.5
LOAD, RATE, END = 12.0, 20.0, 0.8  # [N], [rad/s], [s]


def test_l9_exactly_at_yield():
    """At F_y to the last bit nothing is kept, and the derivative is that of the spring that yields: finite, as documented."""

    def end(y):
        # Of rest length zero the pull is k r without rounding: 64 x 0.25 = 16.
        system = js.System(PAIR, 1.0, js.Springs(PAIR, 64.0), free=np.zeros(2, bool), rules=Yielding(PAIR, y, hardening=16.0))
        state = js.rollout(system, js.State.from_points(PAIR, [[0.0], [0.25]]), js.Still(), 1.0, 2).state
        return PAIR.flatten(state.memory[1].value.stretch)[0], state

    stretch, state = end(16.0)
    assert float(stretch) == 0.0
    assert Yielding(PAIR, 16.0).onset(state).count == 0
    slope = jax.jit(jax.grad(lambda y: end(y)[0]))
    assert float(slope(16.0)) == pytest.approx(-1 / (64 + 16), rel=1e-14)
    assert float(slope(jnp.nextafter(jnp.asarray(16.0), 17.0))) == 0.0
    assert float(slope(15.0)) == pytest.approx(-1 / (64 + 16), rel=1e-14)


def reference():
    """Plastic stretch and slip at the end, by an integrator that stops where the spring begins to yield and where it turns.

    Elastic f = k (x - q); yielding q' = x' k / (k + H), so that |f| stays on F_y + H a.
    """

    def rates(t, y, sign):
        x, v, q, _ = y
        flow = v * K / (K + HARD) if sign else 0.0
        return [v, LOAD * np.sin(RATE * t) - DRAG * v - K * (x - q), flow, sign * flow]

    def over(t, y, sign):
        return abs(K * (y[0] - y[2])) - YIELD - HARD * y[3]

    def turns(t, y, sign):
        return y[1] * sign

    over.terminal, over.direction, turns.terminal, turns.direction = True, 1, True, -1
    t, y, sign, n_phases = 0.0, np.zeros(4), 0, 0
    while t < END:
        event = turns if sign else over
        found = solve_ivp(rates, (t, END), y, "DOP853", events=event, args=(sign,), rtol=1e-12, atol=1e-14)
        t, y, n_phases = found.t[-1], found.y[:, -1], n_phases + 1
        sign = 0 if sign else int(np.sign(K * (y[0] - y[2])))
    assert n_phases >= 5  # it yields in both directions
    return y[2:]


def swinging(stepper, dts, n_steps):
    """Plastic stretch and slip at the end with each dt, and the derivative of the stretch by the yield force, with that of differences."""

    def end(y, dt, frame):
        parts = (js.Springs(PAIR, K, 1.0), js.Drag(DRAG), js.Load(lambda t: js.Vector((jnp.stack([0 * t, LOAD * jnp.sin(RATE * t)]),))))
        system = js.System(PAIR, 1.0, parts, free=np.array([False, True]), rules=Yielding(PAIR, y, hardening=HARD))
        start = js.State.from_points(PAIR, [[0.0], [1.0]])
        saved = js.rollout(system, start, stepper, dt, n_steps, save_every=n_steps // 4).saved
        memory = jax.tree.map(lambda a: a[frame], saved).memory[3].value
        return PAIR.flatten(memory.stretch)[0], PAIR.flatten(memory.slip)[0]

    f = jax.jit(jax.value_and_grad(end, has_aux=True))
    at, h = [(dt, round(END / dt) * 4 // n_steps - 1) for dt in dts], 1e-6
    found = [f(YIELD, *frame) for frame in at]
    differences = (f(YIELD + h, *at[-1])[0][0] - f(YIELD - h, *at[-1])[0][0]) / (2 * h)
    return np.array([value for value, _ in found]), found[-1][1], differences


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet(), js.BackwardEuler()], ids=lambda s: type(s).__name__)
def test_l9_cyclic_load_with_dt_halved(stepper):
    """Plastic stretch and slip tend to those of an integrator that stops at events, with an error of order dt; derivatives are right."""
    values, slope, differences = swinging(stepper, (4e-3, 2e-3, 1e-3), 800)
    error = np.abs(values - np.array(reference()))
    assert np.all(error[-1] < 1.5e-3)  # of .08
    assert np.all(error[1:] < 0.75 * error[:-1])
    assert np.all(error[2] < 0.4 * error[0])
    assert float(slope) == pytest.approx(float(differences), rel=1e-5)
