"""Hard cases K of fitting and of adaptive steps: any optimiser, data that leave parameters open, NaN in the data, events."""

import inspect
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib
import optimistix
import pytest

import jaxspring as js
from jaxspring.archive import CheckpointError
from jaxspring.inverse.fingerprint import fingerprint
from jaxspring.inverse.optimisers import as_optimiser

START = {"a": jnp.array([0.5, 0.5]), "b": jnp.array([0.3])}
TIMES = jnp.linspace(0.0, 3.0, 30)


def bowl(p):
    """Zero at a = 3, b = 1."""
    return jnp.sum(jnp.array([1.0, 3.0]) * (p["a"] - 3.0) ** 2) + jnp.sum((p["b"] - 1.0) ** 2)


def swing(p, times):
    """Place of a mass on a spring, let go at 1: only k / m matters."""
    return jnp.cos(jnp.sqrt(p["k"] / p["m"]) * times)


# Optimisers


def optax_optimisers():
    """Every public optax function that makes a gradient transformation from nothing, a rate, or another one; and those that nest."""
    tries = ((), (0.1,), (optax.sgd(0.1),), (optax.sgd(0.1), optax.sgd(0.1)))
    for module in (optax, optax.contrib):
        for name, make in inspect.getmembers(module, inspect.isfunction):
            for arguments in tries if "Gradient" in str(inspect.signature(make).return_annotation) else ():
                try:
                    made = make(*arguments)
                except Exception:  # wants other arguments
                    continue
                if isinstance(made, optax.GradientTransformation):
                    yield name, made
    yield "lookahead", optax.lookahead(optax.sgd(0.1), 5, 0.5)
    yield "schedule_free", optax.contrib.schedule_free(optax.sgd(0.1), 0.1)
    yield "MultiSteps", optax.MultiSteps(optax.adam(0.1), 2)
    yield "multi_transform", optax.multi_transform({"x": optax.adam(0.1), "y": optax.set_to_zero()}, {"a": "x", "b": "y"})
    yield "apply_if_finite", optax.apply_if_finite(optax.lbfgs(), 3)
    yield "plateau", optax.chain(optax.adam(0.1), optax.contrib.reduce_on_plateau())
    yield "sam", optax.contrib.sam(optax.sgd(0.1), optax.chain(optax.contrib.normalize(), optax.sgd(0.01)), opaque_mode=True)


@pytest.mark.slow
def test_no_optax_optimiser_ends_in_another_librarys_error():
    """Each makes a step, or a TypeError says what fit gives to it; the common ones do make a step."""
    worked, refused = set(), {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, made in optax_optimisers():
            optimiser = as_optimiser(made)
            try:
                memory = jax.eval_shape(lambda o=optimiser: o.init(lambda p, c: (bowl(p), (c, None)), START, None))
                jax.eval_shape(lambda m, o=optimiser: o.step(lambda p, c: (bowl(p), (c, None)), START, m, None), memory)
                worked.add(name)
            except TypeError as error:
                refused[name] = str(error)
    assert [name for name, words in refused.items() if "fit gives it the parameters" not in words] == []
    assert "lookahead" in refused
    wanted = "adam adamw lbfgs lion lamb sgd polyak_sgd schedule_free sophia sam plateau MultiSteps multi_transform apply_if_finite"
    assert set(wanted.split()) <= worked
    assert len(worked) > 60


@pytest.mark.parametrize(
    "optimiser",
    [optax.lbfgs(), optax.chain(optax.sgd(1.0), optax.scale_by_backtracking_linesearch(20)), js.LBFGS()],
    ids=["lbfgs", "backtracking", "LBFGS"],
)
def test_line_searches_find_the_bottom_of_a_bowl(optimiser):
    """Forty iterations bring a quadratic below 1e-6 of its start, never rising, and the best is what the loss says of it."""
    found = js.fit(bowl, START, optimiser, n_iterations=40)
    assert found.value < 1e-6 * found.history.loss[0]
    assert np.all(np.diff(found.history.loss) <= 1e-12)
    assert found.value == float(bowl(found.parameters)) == found.history.loss[found.iteration]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (optax.adam, "optimiser is adam itself, which was not called"),
        (js.Adam, "optimiser is Adam itself, which was not called"),
        (0.1, "optimiser is a float"),
    ],
)
def test_what_is_no_optimiser_is_named(given, words):
    """A function or a class that was not called says so."""
    with pytest.raises(TypeError, match=words):
        js.fit(bowl, START, given)


# What the data leave open


@pytest.mark.parametrize("transforms", [None, js.Positive()], ids=["free", "positive"])
def test_k_and_m_whose_quotient_alone_matters(transforms, dtype):
    """UNDETERMINED: one direction, along (k, m) itself, named; the quotient is right to rounding, in either precision."""
    times = TIMES.astype(dtype)
    data = jnp.cos(jnp.sqrt(jnp.asarray(50.0, dtype)) * times)
    start = {"k": jnp.asarray(40.0, dtype), "m": jnp.asarray(1.0, dtype)}
    found = js.fit(lambda p: swing(p, times) - data, start, js.LeastSquares(), transforms=transforms)
    assert found.parameters["k"].dtype == dtype
    assert float(found.parameters["k"] / found.parameters["m"]) == pytest.approx(50.0, rel=100 * float(jnp.finfo(dtype).eps))
    assert bool(found.status.has(js.Flag.UNDETERMINED))
    assert bool(found.status.is_ok)
    assert found.undetermined.count == 1
    assert found.undetermined.names == ("k", "m")
    direction = found.undetermined.directions
    along = direction["k"][0] / direction["m"][0]
    assert along == pytest.approx(float(found.parameters["k"] / found.parameters["m"]), rel=1e-3)
    with pytest.warns(js.StabilityWarning, match="UNDETERMINED: the residuals leave one direction of the parameters open, in k, m"):
        js.raise_for_status(found)


def test_parameters_without_influence_and_too_few_residuals():
    """A zero column is its own direction, and the parameter stays where it was; three numbers for two residuals leave one open."""

    def residuals(p):
        a, b, c = p["abc"]
        return jnp.stack([a + b - 3.0, 2.0 * c - 1.0]) + 0.0 * p["idle"]

    with pytest.warns(js.inverse.GradientWarning, match="idle"):
        found = js.fit(residuals, {"abc": jnp.ones(3), "idle": jnp.asarray(7.0)}, js.LeastSquares(), 60)
    assert found.undetermined.count == 2
    assert found.undetermined.names == ("abc[0]", "abc[1]", "idle")
    assert float(found.parameters["idle"]) == 7.0
    np.testing.assert_allclose(found.parameters["abc"], [1.5, 1.5, 0.5], rtol=1e-6)  # nearest to the start
    np.testing.assert_array_equal(found.undetermined.entries["abc"], [True, True, False])
    both = np.concatenate([found.undetermined.directions["abc"], found.undetermined.directions["idle"][:, None]], axis=1)
    np.testing.assert_allclose(np.array([[1, 1, 0, 0], [0, 0, 2, 0]]) @ both.T, 0, atol=1e-12)


def test_a_direction_that_is_lost_in_noise():
    """Columns parallel to 1e-5 and noise of 0.1 give numbers a thousand times too large: NumPy's standard error says so, and the fit."""
    rng = np.random.default_rng(0)
    columns = rng.normal(size=(30, 3))
    columns[:, 2] = columns[:, 0] - columns[:, 1] + 1e-5 * rng.normal(size=30)
    data = columns @ np.ones(3) + 0.1 * rng.normal(size=30)
    a, b = jnp.asarray(columns), jnp.asarray(data)
    found = js.fit(lambda p: a @ p - b, jnp.ones(3), js.LeastSquares(), 100)
    best = np.linalg.lstsq(columns, data, rcond=None)[0]
    scatter = np.sum((columns @ best - data) ** 2) / 27
    assert np.max(np.abs(best)) > 300
    assert np.sqrt(scatter * np.linalg.inv(columns.T @ columns)[2, 2]) > 300
    np.testing.assert_allclose(found.parameters, best, rtol=1e-2)
    assert found.undetermined.count == 1


def test_no_alarm_where_the_data_determine_all():
    """A slope, an offset that started at zero and is nothing but noise, and a stiffness: known to their errors, and the status is OK."""
    data = 3.0 * TIMES + 0.1 * jnp.sin(9.0 * TIMES)

    def residuals(p):
        return p["slope"] * TIMES + p["offset"] + 1e-4 * (p["stiffness"] - 2e4) * TIMES**2 - data

    found = js.fit(residuals, {"slope": 1.0, "offset": 0.0, "stiffness": 1e4}, js.LeastSquares(), 100)
    assert found.undetermined is None
    assert found.explanation == "OK"
    assert int(found.status.flags) == 0


def test_gradients_that_are_always_zero_are_named():
    """Entries whose gradient is exactly zero throughout are UNDETERMINED, by index; a fit that starts at its minimum is not."""
    found = js.fit(lambda p: jnp.sum(p["k"][:2] ** 2), {"k": jnp.ones(4)}, js.Adam(0.1), 3)
    assert found.undetermined.names == ("k[2]", "k[3]")
    assert bool(found.status.has(js.Flag.UNDETERMINED))
    with pytest.warns(js.inverse.GradientWarning):
        assert js.fit(bowl, {"a": jnp.full(2, 3.0), "b": jnp.ones(1)}, js.Adam(0.1), 2).undetermined is None


# Failures in a fit's own words


def test_one_nan_observation_is_found():
    """The message names the loss, the iteration, the residual and the data, not positions and dt."""
    data = jnp.cos(TIMES).at[3].set(jnp.nan)

    def residuals(p):
        return jnp.cos(p["w"] * TIMES) - data

    def loss(p):
        return jnp.sum(residuals(p) ** 2)

    found = js.fit(residuals, {"w": 1.5}, js.LeastSquares())
    with pytest.raises(
        js.SimulationError, match=r"the loss is nan at iteration 0, where the parameters are finite. The residual\[3\] = nan"
    ):
        js.raise_for_status(found)
    found = js.fit(loss, {"w": 1.5})
    assert "data[3] = nan" in found.explanation
    assert "position" not in found.explanation
    assert "smaller dt" not in found.explanation


def test_a_loss_that_leaves_its_domain_says_which_step():
    """A logarithm that a step takes below zero: the iteration, and what to do about the step."""
    found = js.fit(lambda p: jnp.log(p["k"]), {"k": 0.1}, js.Adam(0.06))
    assert "the loss is nan at iteration 2" in found.explanation
    assert "smaller learning rate" in found.explanation
    found = js.fit(lambda p: jnp.sqrt(jnp.sum(p["k"] ** 2)), {"k": jnp.zeros(2)})
    assert "its gradient with respect to k is not" in found.explanation


@pytest.mark.parametrize(
    ("loss", "words"),
    [
        (lambda p: (bowl(p), 1), "loss returned a tuple; expected one real number"),
        (lambda p: None, r"loss returned nothing \(None\)"),
        (lambda p: bowl(p).astype(complex), r"loss returned \(\) of complex128"),
        (lambda p: jnp.round(bowl(p)).astype(int), r"loss returned \(\) of int64"),
        (3.0, "loss is a float; expected a function"),
    ],
)
def test_what_is_no_loss_is_named(loss, words):
    """In `fit` and in `check_gradient` alike."""
    for call in (js.fit, js.check_gradient):
        with pytest.raises(TypeError, match=words):
            call(loss, START)


def test_fit_is_not_traced():
    """Inside jit or grad a sentence says that fit decides on the host."""
    with pytest.raises(TypeError, match="fit was called inside jit, grad or vmap: parameters hold traced values"):
        jax.jit(lambda x: js.fit(bowl, {"a": x, "b": x}).value)(jnp.ones(2))
    with pytest.raises(TypeError, match="what the loss reads hold traced values"):
        jax.grad(lambda x: js.fit(lambda p: (p - x) ** 2, 1.0, n_iterations=1).parameters)(2.0)


# Checkpoints


def test_a_checkpoint_of_another_loss_or_optimiser_is_refused(tmp_path):
    """Another loss, learning rate or kind of optimiser is named; with the same ones the fit is bitwise the unbroken one."""
    place = js.Checkpoint(tmp_path / "fit.npz", every=3)
    whole = js.fit(bowl, START, js.Adam(0.1), 12)
    js.fit(bowl, START, js.Adam(0.1), 5, checkpoint=place)
    with pytest.raises(CheckpointError, match=r"optimiser's learning_rate is 0.1; expected 0.2"):
        js.fit(bowl, START, js.Adam(0.2), 12, checkpoint=place, resume=True)
    with pytest.raises(CheckpointError, match=r"optimiser's type is Adam; expected Optax"):
        js.fit(bowl, START, optax.adam(0.1), 12, checkpoint=place, resume=True)
    with pytest.raises(CheckpointError, match=r"the loss at its parameters is .*; expected .*, as when they were stored"):
        js.fit(lambda p: bowl(p) + 1.0, START, js.Adam(0.1), 12, checkpoint=place, resume=True)
    rest = js.fit(bowl, START, js.Adam(0.1), 12, checkpoint=place, resume=True)
    np.testing.assert_array_equal(rest.history.loss, whole.history.loss)


def test_optax_settings_are_told_apart():
    """Rates, schedules and nested choices that optax hides in closures differ in the fingerprint; equal settings do not."""
    makers = [
        lambda: optax.adam(0.05),
        lambda: optax.adam(0.06),
        lambda: optax.adam(0.05, b1=0.8),
        lambda: optax.adam(optax.cosine_decay_schedule(0.05, 10)),
        lambda: optax.adam(optax.cosine_decay_schedule(0.05, 20)),
        lambda: optax.MultiSteps(optax.adam(0.05), 2),
        lambda: optax.MultiSteps(optax.adam(0.05), 3),
        lambda: optax.inject_hyperparams(optax.adam)(learning_rate=0.05),
        lambda: optax.lbfgs(),
        lambda: optax.lbfgs(memory_size=4),
    ]
    found = [fingerprint(as_optimiser(make())) for make in makers]
    assert found == [fingerprint(as_optimiser(make())) for make in makers]
    assert all(a != b for i, a in enumerate(found) for b in found[:i])


# Events


def fall(height, gravity, speed=0.0, direction=None, **options):
    """A ball let go (or thrown up) at `height`, until its height is zero."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    zero = jnp.zeros_like(height)
    state = js.State.from_points(net, jnp.stack([zero, height])[None], velocities=jnp.stack([zero, speed + zero])[None])
    system = js.System(net, 1.0, js.Gravity(jnp.stack([zero, -gravity])))
    ground = diffrax.Event({"ground": height_of_the_ball, "far": is_far}, optimistix.Newton(1e-6, 1e-6), direction)
    return js.diffeqsolve(system, state, jnp.inf, diffrax.Bosh3(), 0.1, max_steps=64, event=ground, **options)


def height_of_the_ball(time, state):
    """A condition of two arguments."""
    return state.position.y[0]


def is_far(time, state, system):
    """A boolean condition that never holds here."""
    return state.position.x[0] > 1.0


@pytest.mark.slow
def test_a_ball_hits_the_ground():
    """Time sqrt(2 h / g), speed sqrt(2 g h), the right event named, and dt/dh = 1 / sqrt(2 g h), dt/dg = -sqrt(h / 2) g^-1.5."""
    h, g = jnp.asarray(10.0), jnp.asarray(9.81)

    def time_and_result(h, g):
        found = fall(h, g, adjoint=diffrax.ForwardMode())
        return found.state.time, found

    slopes, found = jax.jacfwd(time_and_result, (0, 1), has_aux=True)(h, g)
    assert float(found.state.time) == pytest.approx(np.sqrt(20 / 9.81), rel=1e-12)
    assert float(found.state.velocity.y[0]) == pytest.approx(-np.sqrt(2 * 9.81 * 10), rel=1e-12)
    assert {name: bool(hit) for name, hit in found.event.items()} == {"ground": True, "far": False}
    assert int(found.status.flags) == 0
    np.testing.assert_allclose(slopes, [1 / np.sqrt(2 * 9.81 * 10), -np.sqrt(10 / 2) * 9.81**-1.5], rtol=1e-9)


@pytest.mark.slow
def test_a_ball_thrown_from_the_ground_comes_back():
    """A height that is zero at the start is no event there: it comes back after 2 v / g."""
    assert float(fall(jnp.asarray(0.0), jnp.asarray(9.81), 7.0).state.time) == pytest.approx(14 / 9.81, rel=1e-9)


def test_booleans_and_root_finders_in_float32():
    """Where x64 is on, diffrax cannot mix a boolean with a root finder in float32: a sentence, not a mismatch of branches."""
    with pytest.raises(ValueError, match="With a root finder and a boolean condition, diffrax needs the run in float64"):
        fall(jnp.float32(1.0), jnp.float32(9.81))


@pytest.mark.parametrize(
    ("condition", "kind", "words"),
    [
        (lambda t: t, TypeError, r"takes 1 arguments; expected cond_fn\(time, state, system\)"),
        (lambda t, state: state.position.y, TypeError, r"returned a Vector|returned \(1,\) of float64"),
        (lambda t, state: 3, TypeError, r"returned \(\) of int64"),
    ],
)
def test_wrong_conditions_are_named(condition, kind, words):
    """Arguments, shape and type of a condition."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    state = js.State.from_points(net, [[0.0, 1.0]])
    with pytest.raises(kind, match=words):
        js.diffeqsolve(js.System(net, 1.0), state, 1.0, event=diffrax.Event(condition))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("adjoint", "mode", "words"),
    [
        (None, jax.jacfwd, r"RecursiveCheckpointAdjoint takes derivatives in reverse mode only.*adjoint=diffrax.ForwardMode\(\)"),
        (diffrax.BacksolveAdjoint(), jax.jacfwd, "BacksolveAdjoint takes derivatives in reverse mode only"),
        (diffrax.ForwardMode(), jax.grad, "ForwardMode takes derivatives in forward mode only"),
        (diffrax.DirectAdjoint(), jax.hessian, None),
    ],
    ids=["default jacfwd", "backsolve jacfwd", "forward grad", "direct hessian"],
)
def test_the_mode_that_an_adjoint_lacks_is_named(adjoint, mode, words):
    """Each adjoint in the mode that it has not: a sentence with the one to take; DirectAdjoint has both."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)

    def end(speed):
        state = js.State.from_points(net, [[0.0]], velocities=speed[None, None])
        found = js.diffeqsolve(js.System(net, 1.0), state, 0.5, diffrax.Euler(), 0.25, adjoint=adjoint, max_steps=4)
        return found.state.position.x[0] ** 2

    if words is None:
        assert float(mode(end)(jnp.asarray(2.0))) == pytest.approx(0.5)
    else:
        with pytest.raises(TypeError, match=words):
            mode(end)(jnp.asarray(2.0))


def test_what_an_adaptive_solver_cannot_honour_is_named():
    """Every public rule, and a force of one's own that acts after steps, is refused by its name."""
    net = js.lattice(2)
    state = js.State.from_points(net, net.grid())

    class Worn(js.Force):
        """Acts after steps."""

        def force(self, state):
            """No pull on any node."""
            return js.Vector.zeros_like(state.position)

        def update(self, step, state):
            """The state as it is."""
            return state, js.Status.ok()

    for system in (
        js.System(net, 1.0, Worn()),
        js.System(net, 1.0, js.Springs(net, 1.0), rules=js.Floor([0.0], [1.0])),
    ):
        name = "Worn" if isinstance(system.forces[0], Worn) else "Floor"
        with pytest.raises(ValueError, match=f"{name}: this acts after steps"):
            js.diffeqsolve(system, state, 1.0)


@pytest.mark.parametrize(
    ("options", "kind", "words"),
    [
        ({"solver": diffrax.Tsit5}, TypeError, "solver is the class Tsit5, not called"),
        ({"event": lambda t, s: s.position.x[0]}, TypeError, "event is a function; expected a diffrax object such as diffrax.Event"),
        ({"stepsize_controller": 1e-3}, TypeError, "stepsize_controller is a float"),
        ({"max_steps": 0}, ValueError, "max_steps = 0"),
        ({"adjoint": diffrax.BacksolveAdjoint(), "event": diffrax.Event(lambda t, s: t > 1)}, ValueError, "cannot go back over an event"),
        ({"t1": np.inf}, ValueError, "t1 = inf"),
    ],
)
def test_options_of_another_kind_are_named(options, kind, words):
    """Classes that were not called, functions for events, an endless run without an event."""
    net = js.lattice(2)
    with pytest.raises(kind, match=words):
        js.diffeqsolve(js.System(net, 1.0), js.State.from_points(net, net.grid()), **({"t1": 1.0} | options))


# Modes


def test_numbers_of_modes():
    """One free node has modes of frequency zero; a number that is no whole one is named; no frequencies, no responses."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    state, system = js.State.from_points(net, [[0.0, 0.0]]), js.System(net, 1.0)
    np.testing.assert_array_equal(js.normal_modes(system, state, np.int64(1)).frequencies, [0.0])
    with pytest.raises(TypeError, match=r"n_modes = 1\.5"):
        js.normal_modes(system, state, 1.5)
    with pytest.raises(ValueError, match="n_modes = 3, but the system has 2 free coordinates"):
        js.normal_modes(system, state, 3)
    assert js.frequency_response(system, state, [], [[1.0, 0.0]]).shape == (0, 1, 2)
