"""Hard case C17: failures of the diffrax route are statuses."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.ode import diffeqsolve

pytestmark = pytest.mark.slow  # diffrax compiles for seconds


def scene(load=None):
    net = js.lattice(2)
    forces = (js.Springs(net, 9.0, 1.0),) if load is None else (js.Springs(net, 9.0, 1.0), js.Load(load))
    return js.System(net, 1.0, forces), js.State.from_points(net, [[0.0], [1.5]])


def blows_up(t):
    """A load that is NaN after t = 0.5."""
    return js.Vector((jnp.where(t > 0.5, jnp.nan, 0.0) * jnp.ones(2),))


def test_c17_nan_at_constant_step():
    """A right-hand side that turns NaN: diffrax says successful, our status says NONFINITE, and it raises outside."""
    system, state = scene(blows_up)
    result = diffeqsolve(system, state, t1=1.0, dt0=0.1)
    assert bool(result.info.solver_result == diffrax.RESULTS.successful)
    assert bool(result.status.has(js.Flag.NONFINITE))
    with pytest.raises(js.SimulationError, match="NONFINITE"):
        js.raise_for_status(result)


def test_c17_max_steps():
    """max_steps = 10 for 1,000 constant steps: MAX_STEPS, and the state and time reached after ten."""
    system, state = scene()
    result = diffeqsolve(system, state, t1=1.0, dt0=1e-3, max_steps=10)
    assert bool(result.status.has(js.Flag.MAX_STEPS))
    assert int(result.status.step) == 10
    assert float(result.state.time) == pytest.approx(0.01)
    assert np.isfinite(result.state.points).all()
    with pytest.raises(js.SimulationError, match="MAX_STEPS"):
        js.raise_for_status(result)


def test_c17_nan_with_adaptive_steps():
    """With adaptive steps the solver shrinks its step before the NaN until max_steps or the least step: not OK, and finite."""
    system, state = scene(blows_up)
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6, dtmin=1e-6)
    result = diffeqsolve(system, state, t1=1.0, stepsize_controller=controller, max_steps=200)
    assert not bool(result.status.is_ok)


def test_c17_bad_start_and_bad_constant():
    """A start that is not finite and a traced constant that is negative are seen at step 0."""
    system, state = scene()
    bad = js.State(state.time, state.position * jnp.nan, state.velocity, state.layout)
    status = diffeqsolve(system, bad, t1=0.1, dt0=0.1).status
    assert bool(status.has(js.Flag.NONFINITE))
    assert int(status.step) == 0
