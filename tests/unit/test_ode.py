"""The diffrax bridge against closed forms and `rollout`."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.ode import diffeqsolve
from tests import reference

pytestmark = pytest.mark.slow  # diffrax compiles for seconds

OMEGA = 3.0
TIGHT = diffrax.PIDController(rtol=1e-9, atol=1e-9)


def oscillator(drag=0.0, dtype="float64", **options):
    """The motion x'' = -9 x - drag x', x(0) = 1 at rest, beside a held node at 0."""
    net = js.lattice(2)
    forces = (js.Springs(net, OMEGA**2), js.Drag(drag)) if drag else js.Springs(net, OMEGA**2)
    state = js.State.from_points(net, np.array([[0.25], [1.25]], dtype))
    return js.System(net, 1.0, forces, free=np.array([False, True]), **options), state


def exact(t, drag=0.0):
    w = np.sqrt(OMEGA**2 - drag**2 / 4)
    return 0.25 + np.exp(-drag * t / 2) * (np.cos(w * t) + drag / (2 * w) * np.sin(w * t))


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Dopri8(), diffrax.Kvaerno5()], ids=["Tsit5", "Dopri8", "Kvaerno5 (implicit)"])
def test_adaptive_solvers_against_the_closed_form(solver):
    """Explicit and implicit solvers follow the damped oscillator, and the held node stays exactly."""
    system, state = oscillator(0.8)
    result = diffeqsolve(system, state, t1=2.0, solver=solver, stepsize_controller=TIGHT)
    assert bool(result.status.is_ok)
    assert float(result.state.points[1, 0]) == pytest.approx(exact(2.0, 0.8), abs=2e-7)
    assert float(result.state.points[0, 0]) == 0.25
    assert float(result.state.time) == 2.0
    assert int(result.info.n_steps) == int(result.info.n_accepted + result.info.n_rejected)


def test_default_against_rollout(rng):
    """On a sheet with drag, gravity and a pinned corner, the default solver meets rollout by RungeKutta4 to 1e-7."""
    net = js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR)
    points = np.concatenate([net.grid(), np.zeros((9, 1))], axis=1) + 0.05 * rng.normal(size=(9, 3))
    forces = (js.Springs(net, 10.0, 0.9), js.Drag(0.2), js.Gravity([0.0, 0.0, -1.0]))
    system = js.System(net, 1.0, forces, free=np.arange(9) > 0)
    state = js.State.from_points(net, points)
    expected = js.rollout(system, state, js.RungeKutta4(), dt=2e-3, n_steps=500).state
    found = diffeqsolve(system, state, t1=1.0)
    np.testing.assert_allclose(found.state.points, expected.points, atol=1e-7)
    np.testing.assert_allclose(found.state.velocities, expected.velocities, atol=1e-6)
    assert bool(found.status.is_ok)


def test_frames_and_interpolation():
    """SaveAt(ts) gives states at those times; dense=True gives the state at any time."""
    system, state = oscillator()
    times = np.linspace(0, 1, 5)
    result = diffeqsolve(system, state, t1=1.0, saveat=diffrax.SaveAt(ts=times, dense=True), stepsize_controller=TIGHT)
    np.testing.assert_allclose(result.saved.points[:, 1, 0], exact(times), atol=1e-7)
    np.testing.assert_allclose(result.saved.time, times)
    np.testing.assert_array_equal(result.times, times)
    assert float(result.at(0.3).points[1, 0]) == pytest.approx(exact(0.3), abs=1e-6)


def test_a_function_of_the_state_is_saved():
    """SaveAt's own fn is called as fn(time, state, system): here the energy, which is kept."""
    system, state = oscillator()
    saveat = diffrax.SaveAt(ts=[0.5, 1.0], t0=True, fn=lambda t, state, system: system.energy(state).total)
    result = diffeqsolve(system, state, t1=1.0, saveat=saveat, stepsize_controller=TIGHT)
    np.testing.assert_allclose(result.saved, OMEGA**2 / 2, rtol=1e-7)


def test_constant_steps_and_semi_implicit_euler():
    """With dt0 alone the steps are constant; diffrax's drift-then-kick Euler is that map step by step."""
    system, state = oscillator()
    result = diffeqsolve(system, state, t1=1.0, solver=diffrax.SemiImplicitEuler(), dt0=0.1)
    x, v = 1.0, 0.0
    for _ in range(10):
        x = x + 0.1 * v
        v = v - 0.1 * OMEGA**2 * x
    assert int(result.info.n_steps) == 10
    np.testing.assert_allclose([result.state.points[1, 0] - 0.25, result.state.velocities[1, 0]], [x, v], rtol=1e-12)


def test_semi_implicit_euler_refuses_drag():
    """A solver that splits position from velocity cannot see drag: an error, never an option ignored."""
    system, state = oscillator(0.8)
    with pytest.raises(ValueError, match="depend on velocity"):
        diffeqsolve(system, state, t1=1.0, solver=diffrax.SemiImplicitEuler(), dt0=0.1)


def test_backward_in_time():
    """From t = 1 back to 0 the start is found again."""
    system, state = oscillator()
    there = diffeqsolve(system, state, t1=1.0, stepsize_controller=TIGHT).state
    back = diffeqsolve(system, there, t1=0.0, stepsize_controller=TIGHT).state
    np.testing.assert_allclose(back.points, state.points, atol=1e-7)


def test_moved_nodes():
    """A node on a schedule pulls the free one: x = 1 + (4 sin t - 2 sin 2t) / 3; its own place and velocity are exact."""
    net = js.lattice(2)
    motion = js.Motion(jnp.array([True, False]), lambda t: js.Vector((jnp.stack([jnp.sin(t), jnp.zeros_like(t)]),)))
    system = js.System(net, 1.0, js.Springs(net, 4.0, 1.0), motion=motion)
    state = diffeqsolve(system, js.State.from_points(net, [[0.0], [1.0]]), t1=1.0).state
    assert float(state.points[1, 0]) == pytest.approx(1 + (4 * np.sin(1) - 2 * np.sin(2)) / 3, abs=1e-6)
    assert float(state.points[0, 0]) == pytest.approx(np.sin(1), abs=1e-15)
    assert float(state.velocities[0, 0]) == pytest.approx(np.cos(1), abs=1e-15)


def test_float32_stays_float32():
    """A float32 state gives a float32 result, near the closed form."""
    system, state = oscillator(dtype="float32")
    result = diffeqsolve(system, state, t1=1.0)
    assert {leaf.dtype for leaf in jax.tree.leaves(result.state)} == {np.dtype("float32")}
    assert float(result.state.points[1, 0]) == pytest.approx(exact(1.0), abs=3e-3)


@pytest.mark.parametrize(
    ("adjoint", "mode"),
    [
        (None, jax.grad),
        (diffrax.DirectAdjoint(), jax.jacfwd),
        (diffrax.ForwardMode(), jax.jacfwd),
        (diffrax.BacksolveAdjoint(), jax.grad),
    ],
    ids=["recursive checkpoints", "direct", "forward mode", "backsolve"],
)
def test_gradients_of_every_adjoint(adjoint, mode):
    """The derivative d x(1) / d k agrees with the closed form of the undamped oscillator, -sin(w) / (2 w)."""
    net = js.lattice(2)
    state = js.State.from_points(net, [[0.0], [1.0]])

    def end(k):
        system = js.System(net, 1.0, js.Springs(net, k), free=np.array([False, True]))
        return diffeqsolve(system, state, t1=1.0, adjoint=adjoint, stepsize_controller=TIGHT).state.points[1, 0]

    assert float(jax.jit(mode(end))(jnp.asarray(OMEGA**2))) == pytest.approx(-np.sin(OMEGA) / (2 * OMEGA), abs=1e-6)


def test_gradient_against_differences(rng):
    """With constant steps the gradient by stiffness, start and drag is that of central differences to 1e-8."""
    net = js.lattice(3)
    start = jnp.asarray(rng.normal(size=(3, 2)))
    direction = rng.normal(size=3)

    def loss(h):
        k, gamma, x = 2.0 + h * direction[0], 0.3 + h * direction[1], start + h * direction[2]
        system = js.System(net, 1.0, (js.Springs(net, k, 0.5), js.Drag(gamma)))
        return jnp.sum(diffeqsolve(system, js.State.from_points(net, x), t1=1.0, dt0=0.05).state.points ** 2)

    compiled = jax.jit(jax.value_and_grad(loss))
    zero = jnp.zeros(())
    expected = reference.central_difference(lambda h: compiled(h)[0], zero, 1e-5)
    assert float(compiled(zero)[1]) == pytest.approx(expected, rel=1e-8)


def test_traced_once():
    """New constants, times and states share one compiled program."""
    net = js.lattice(2)
    traces = reference.Traces()

    class Counted(js.Force):
        gamma: jax.Array

        def force(self, state):
            traces()
            return -(self.gamma * state.velocity)

    def run(gamma, t1, x):
        system = js.System(net, 1.0, (js.Springs(net, 1.0), Counted(jnp.asarray(gamma))))
        return diffeqsolve(system, js.State.from_points(net, [[0.0], [x]]), t1=t1)

    run(0.1, 1.0, 1.0)
    once = traces.count
    run(0.2, np.float32(2.0), 1.5)
    run(0.2, 1, 1.5)
    assert traces.count == once


def test_progress_meter(capsys):
    """A diffrax progress meter reports."""
    system, state = oscillator()
    diffeqsolve(system, state, t1=1.0, progress_meter=diffrax.TextProgressMeter())
    jax.effects_barrier()
    assert "100.00%" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"t1": np.nan}, ValueError, "t1 = nan"),
        ({"dt0": -0.1}, ValueError, "Change the sign"),
        ({"dt0": 0.0}, ValueError, "dt0 = 0.0"),
        ({"adjoint": diffrax.BacksolveAdjoint(), "saveat": diffrax.SaveAt(ts=[0.5])}, ValueError, "BacksolveAdjoint"),
        ({"solver": diffrax.StratonovichMilstein(), "dt0": 0.1}, TypeError, "StratonovichMilstein wants .* split"),
        ({"solver": diffrax.KenCarp4()}, TypeError, "KenCarp4 wants .*Kvaerno5"),
    ],
)
def test_wrong_arguments(options, kind, message):
    """Each wrong argument raises, naming it."""
    system, state = oscillator()
    with pytest.raises(kind, match=message):
        diffeqsolve(system, state, **{"t1": 1.0, **options})


def test_no_interpolation_without_dense():
    """Asking for a state between frames without dense=True is an error that says what to pass."""
    system, state = oscillator()
    with pytest.raises(ValueError, match="dense=True"):
        diffeqsolve(system, state, t1=1.0).at(0.5)
