"""Fitting: optimisers, transforms, stop rules, checkpoints, and the check of gradients."""

import signal
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxspring as js
from jaxspring.archive import CheckpointError
from jaxspring.inverse.check import check_gradient
from jaxspring.inverse.checkpoint import Checkpoint
from jaxspring.inverse.fit import fit
from jaxspring.inverse.iteration import GradientWarning
from jaxspring.inverse.losses import squared_distance
from jaxspring.inverse.optimisers import LBFGS, Adam, LeastSquares
from jaxspring.inverse.select import select
from jaxspring.inverse.stopping import Stop, StopReason
from jaxspring.inverse.transforms import Bounded, Identity, Positive, SoftPositive, to_constrained, to_free, transform_per_leaf
from jaxspring.progress import Progress
from jaxspring.status import Flag, SimulationError

ROSENBROCK_START = {"a": -1.2, "b": 1.0}


def rosenbrock(p):
    """Zero at a = b = 1, at the end of a curved valley."""
    return 100 * (p["b"] - p["a"] ** 2) ** 2 + (1 - p["a"]) ** 2


def rosenbrock_residuals(p):
    """Twice half their sum of squares is `rosenbrock`."""
    return {"valley": 10 * (p["b"] - p["a"] ** 2), "floor": 1 - p["a"]}


def bowl(p):
    """Zero at 3."""
    return jnp.sum((p - 3.0) ** 2)


def counting(p, carried):
    """A bowl that counts its evaluations in what it carries."""
    return (p - 3.0) ** 2, ({"n": carried["n"] + 1}, {"seen": carried["n"]})


class Chain(eqx.Module):
    """A hanging chain of four nodes: distance of its tip from where it hung with k = 80 and gamma = 2."""

    target: jax.Array

    def __call__(self, system):
        return squared_distance(hang(system), self.target)


def chain(stiffness, gamma):
    """The chain with these constants."""
    net = js.lattice(4)
    forces = (js.Springs(net, stiffness, 0.1), js.Drag(gamma), js.Gravity((0.0, -9.81)))
    return js.System(net, 0.1, forces, free=np.arange(4) > 0)


def hang(system):
    """(4, 2) points after one second."""
    start = js.State.from_points(system.net, np.stack([0.1 * np.arange(4.0), np.zeros(4)], axis=1))
    return js.rollout(system, start, js.SymplecticEuler(), dt=0.01, n_steps=100).state.points


# Optimisers


def test_adam_is_optax_adam():
    """Twenty iterations of `fit` are twenty hand-written updates of optax.adam(0.05), and the default."""
    optimiser = optax.adam(0.05)
    p = jnp.zeros(2)
    memory = optimiser.init(p)
    for _ in range(20):
        with jax.numpy_dtype_promotion("standard"):
            update, memory = optimiser.update(jax.grad(bowl)(p), memory)
        p = p + update
    for given in (optimiser, None):
        result = fit(bowl, jnp.zeros(2), given, n_iterations=20)
        np.testing.assert_allclose(result.parameters, p, rtol=1e-12)
    assert result.reason is StopReason.ITERATIONS
    assert len(result.history.loss) == 21


def test_adam_may_cool():
    """With a decay, the rate is optax's cosine: a fit equals one with that schedule, step for step."""
    cooled = fit(bowl, jnp.zeros(2), Adam(0.2, 0.8, decay_over=8, last_fraction=0.1), n_iterations=10)
    same = fit(bowl, jnp.zeros(2), optax.adam(optax.cosine_decay_schedule(0.2, 8, 0.1), b1=0.8), n_iterations=10)
    np.testing.assert_array_equal(cooled.history.loss, same.history.loss)
    assert cooled.history.loss[-1] != fit(bowl, jnp.zeros(2), Adam(0.2, 0.8), n_iterations=10).history.loss[-1]


def test_lbfgs_walks_the_valley():
    """L-BFGS reaches the minimum of Rosenbrock's function in fewer than 60 iterations."""
    result = fit(rosenbrock, ROSENBROCK_START, LBFGS(), n_iterations=60, stop=Stop(gradient_norm=1e-8))
    assert result.reason is StopReason.GRADIENT
    np.testing.assert_allclose([result.parameters["a"], result.parameters["b"]], 1.0, atol=1e-8)


@pytest.mark.parametrize("by_reverse_mode", [False, True])
def test_least_squares_walks_the_valley(by_reverse_mode):
    """Levenberg-Marquardt reaches the minimum, its loss is half the sum of squares, and it never rises."""
    result = fit(rosenbrock_residuals, ROSENBROCK_START, LeastSquares(by_reverse_mode=by_reverse_mode), n_iterations=100)
    assert result.reason is StopReason.CONVERGED
    np.testing.assert_allclose([result.parameters["a"], result.parameters["b"]], 1.0, atol=1e-7)
    assert result.history.loss[0] == pytest.approx(0.5 * rosenbrock(ROSENBROCK_START))
    assert np.all(np.diff(result.history.loss) <= 0)


def test_wrong_optimisers_and_losses_are_named():
    """A string is no optimiser; a loss that is no number says to use least squares."""
    with pytest.raises(TypeError, match=r"optimiser is a str; expected an optax transformation"):
        fit(bowl, jnp.zeros(2), "adam")
    with pytest.raises(TypeError, match=r"loss returned \(2,\) of float64; expected one real number"):
        fit(lambda p: p, jnp.zeros(2))


# The loop


def test_the_history_is_of_the_parameters():
    """Entry i is the loss after i updates, the gradient norm is NumPy's, and the best is the lowest, also when the loss rises again."""
    seen = []
    result = fit(bowl, jnp.zeros(2), optax.sgd(1.05), n_iterations=5, on_iteration=lambda it: seen.append(np.asarray(it.parameters)))
    losses = [np.sum((p - 3) ** 2) for p in seen]
    np.testing.assert_allclose(result.history.loss, losses, rtol=1e-12)
    np.testing.assert_allclose(result.history.gradient_norm, [np.linalg.norm(2 * (p - 3)) for p in seen], rtol=1e-12)
    assert losses[1] > losses[0]  # a step of 1.05 overshoots: it diverges
    assert result.iteration == 0
    assert result.value == losses[0]
    np.testing.assert_array_equal(result.parameters, seen[0])
    np.testing.assert_array_equal(result.last, seen[-1])


@pytest.mark.parametrize(
    ("stop", "reason"),
    [
        (Stop(target=1.0), StopReason.TARGET),
        (Stop(gradient_norm=1.0), StopReason.GRADIENT),
        (Stop(relative_decrease=1e-3, window=5), StopReason.DECREASE),
        (Stop(seconds=0.0), StopReason.SECONDS),
    ],
)
def test_stop_rules(stop, reason):
    """Each rule ends the fit before its last iteration, and says which it was."""
    result = fit(bowl, jnp.zeros(2), optax.sgd(0.1) if reason is not StopReason.DECREASE else optax.sgd(1e-5), n_iterations=100, stop=stop)
    assert result.reason is reason
    assert len(result.history.loss) < 101
    if reason is StopReason.TARGET:
        assert result.history.loss[-1] <= 1.0 < result.history.loss[-2]
    if reason is StopReason.GRADIENT:
        assert result.history.gradient_norm[-1] <= 1.0 < result.history.gradient_norm[-2]
    if reason is StopReason.DECREASE:
        assert len(result.history.loss) == 6  # a window of 5 updates


def test_on_iteration_can_stop():
    """Returning True ends the fit there."""
    result = fit(bowl, jnp.zeros(2), n_iterations=50, on_iteration=lambda it: it.index == 7)
    assert result.reason is StopReason.CALLBACK
    assert len(result.history.loss) == 8


def test_traced_once():
    """A second call with the same loss, other start values and other bounds of iteration does not trace again."""
    traces = []

    def loss(p, carried):
        traces.append(None)
        return jnp.sum(p**2), (carried + 1, None)

    fit(loss, jnp.ones(3), n_iterations=3, carried=0.0)
    n_first = len(traces)
    fit(loss, jnp.zeros(3) + 5.0, n_iterations=9, carried=3.0, stop=Stop(seconds=100.0))
    assert n_first == 1
    assert len(traces) == n_first


def test_float32_stays_float32():
    """Single precision in, single precision out, also under strict promotion."""
    result = fit(bowl, jnp.zeros(2, jnp.float32), n_iterations=3, transforms=Bounded(-1.0, 5.0))
    assert result.parameters.dtype == np.float32
    assert fit(bowl, jnp.zeros(2, jnp.float32), LBFGS(), n_iterations=3).last.dtype == np.float32


def test_carried_goes_from_iteration_to_iteration():
    """What the loss hands on comes back to it, one evaluation later; it may not change its type."""
    result = fit(counting, 0.0, n_iterations=4, carried={"n": jnp.asarray(10)})
    assert int(result.carried["n"]) == 15
    assert int(result.info["seen"]) == 14
    with pytest.raises(TypeError, match=r"loss was given carried value of shape \(\) and int64, and returned \(\) of float64"):
        fit(lambda p, c: (p**2, (c.astype(float), None)), 1.0, carried=jnp.asarray(1))
    with pytest.raises(TypeError, match=r"must return \(value, \(carried, info\)\)"):
        fit(lambda p, c: p**2, 1.0, carried=1.0)


def test_a_gradient_that_is_zero_is_named():
    """A leaf that the loss ignores is named in a warning; the others are not."""
    with pytest.warns(GradientWarning, match=r"respect to idle, stopped/0 is exactly zero"):
        fit(
            lambda p: p["used"] ** 2 + jax.lax.stop_gradient(p["stopped"][0]) * p["used"],
            {"used": 1.0, "idle": jnp.ones(2), "stopped": [2.0]},
            n_iterations=1,
        )


def test_a_loss_that_is_not_finite_ends_the_fit():
    """NONFINITE with its iteration, the best until then kept; also where only the gradient is NaN."""
    result = fit(lambda p: jnp.log(p), 0.1, optax.sgd(1e-3), n_iterations=50)
    assert bool(result.status.has(Flag.NONFINITE))
    assert result.reason is StopReason.FAILED
    assert int(result.status.step) == len(result.history.loss) - 1
    assert np.isnan(result.history.loss[-1])
    assert float(result.parameters) > 0
    with pytest.raises(SimulationError, match="NONFINITE"):
        js.raise_for_status(result)
    result = fit(lambda p: jnp.sqrt(p**2), 0.0, n_iterations=5)
    assert result.history.loss.tolist() == [0.0]
    assert bool(result.status.has(Flag.NONFINITE))


def test_ctrl_c_keeps_what_was_done():
    """An interrupt between two iterations ends the fit with INTERRUPTED and the best so far."""

    def interrupt(it):
        if it.index == 3:
            signal.raise_signal(signal.SIGINT)

    result = fit(bowl, jnp.zeros(2), n_iterations=50, on_iteration=interrupt)
    assert result.reason is StopReason.INTERRUPTED
    assert bool(result.status.has(Flag.INTERRUPTED))
    assert len(result.history.loss) == 4
    assert result.iteration == 3


def test_progress_is_told():
    """The callback hears of each evaluation, up to the number asked for."""
    heard = []
    fit(bowl, jnp.zeros(2), n_iterations=3, progress=Progress(bar=False, callback=lambda done, total: heard.append((done, total))))
    assert heard == [(0, 3), (1, 3), (2, 3), (3, 3)]


def test_bad_arguments_are_refused():
    """Each says what was expected."""
    with pytest.raises(ValueError, match=r"nothing to train"):
        fit(bowl, jnp.arange(3))
    with pytest.raises(ValueError, match=r"n_iterations = -1"):
        fit(bowl, jnp.zeros(2), n_iterations=-1)
    with pytest.raises(TypeError, match=r"n_iterations = 1.5"):
        fit(bowl, jnp.zeros(2), n_iterations=1.5)
    with pytest.raises(ValueError, match=r"resume=True needs to know from where"):
        fit(bowl, jnp.zeros(2), resume=True)
    with pytest.raises(ValueError, match=r"every = 0"):
        Checkpoint("x", every=0)
    with pytest.raises(ValueError, match=r"window = 0"):
        Stop(window=0)


# Transforms


@pytest.mark.parametrize("transform", [Identity(), Positive(), SoftPositive(), SoftPositive(30.0), Bounded(-2.0, 700.0)], ids=str)
def test_transforms_go_there_and_back(transform, dtype):
    """Free and constrain undo each other, and keep the precision they are given, over six decades."""
    values = jnp.asarray(np.logspace(-3, 2.8, 200), dtype)
    back = transform.constrain(transform.free(values))
    assert back.dtype == dtype
    # Bounded loses digits near its bounds in proportion to its width; SoftPositive by the ratio to its scale.
    np.testing.assert_allclose(back, values, rtol=40 * np.finfo(dtype).eps, atol=1400 * np.finfo(dtype).eps)
    anything = transform.constrain(jnp.linspace(-30.0, 30.0, 61).astype(dtype))
    assert np.all(np.diff(anything) >= 0)
    assert np.all(np.isfinite(anything))


@pytest.mark.parametrize(
    ("transform", "value", "words"),
    [(Positive(), 0.0, "positive"), (SoftPositive(), -1.0, "positive"), (Bounded(0.0, 1.0), 1.0, "strictly between 0.0 and 1.0")],
)
def test_a_start_outside_the_domain_is_refused(transform, value, words):
    """The message names leaf, index, value and domain."""
    with pytest.raises(ValueError, match=rf"k\[1\] = {value}, but .* {words} \(1 of 2 are not\)"):
        fit(lambda p: jnp.sum(p["k"]), {"k": jnp.asarray([0.5, value])}, transforms={"k": transform})


def test_transforms_find_their_leaves():
    """One for all, by mapping, by prefix, by path; the longest path wins; a name that is not there is an error."""
    system = chain(80.0, 2.0)
    names = ["mass", "forces/0/stiffness", "forces/0/rest_length", "forces/1/gamma", "forces/2/acceleration"]
    assert transform_per_leaf(Positive(), {"a": 1.0, "b": 2.0}) == (Positive(), Positive())
    assert transform_per_leaf({"b": Positive()}, {"a": 1.0, "b": (2.0, 3.0)}) == (Identity(), Positive(), Positive())
    assert transform_per_leaf((Positive(), None), (1.0, 2.0)) == (Positive(), Identity())
    trained = eqx.filter(system, eqx.is_inexact_array)
    chosen = transform_per_leaf({"forces": Positive(), "forces/2": Identity(), "forces/0/stiffness": Bounded(1.0, 1e3)}, trained)
    assert dict(zip(names, chosen, strict=True)) == {
        "mass": Identity(),
        "forces/0/stiffness": Bounded(1.0, 1e3),
        "forces/0/rest_length": Positive(),
        "forces/1/gamma": Positive(),
        "forces/2/acceleration": Identity(),
    }
    with pytest.raises(ValueError, match=r"transforms name stifness, but what is trained is stiffness"):
        transform_per_leaf({"stifness": Positive()}, {"stiffness": 1.0})
    with pytest.raises(TypeError, match=r"a is a str; expected a Transform"):
        transform_per_leaf({"a": "positive"}, {"a": 1.0})
    tree = {"a": jnp.asarray(2.0), "b": jnp.asarray([3.0])}
    both = (Positive(), Identity())
    assert eqx.tree_equal(to_constrained(both, to_free(both, tree)), tree, rtol=1e-12)


@pytest.mark.parametrize("build", [lambda: Bounded(1.0, 1.0), lambda: Bounded(0.0, np.inf), lambda: SoftPositive(0.0)])
def test_transforms_without_sense_are_refused(build):
    """Empty intervals and scales that are not positive."""
    with pytest.raises(ValueError, match="expected"):
        build()


# Systems


@pytest.mark.slow
def test_a_system_is_fitted_through_the_rollout():
    """Stiffness and drag of a chain are recovered from where its nodes are after one second."""
    loss = Chain(hang(chain(80.0, 2.0)))
    part, build = select(chain(50.0, 1.0), lambda s: (s.forces[0].stiffness, s.forces[1].gamma))
    result = fit(lambda p: loss(build(p)), part, LBFGS(), n_iterations=40, transforms=Positive(), stop=Stop(target=1e-18))
    np.testing.assert_allclose(result.parameters, (80.0, 2.0), rtol=1e-5)
    assert float(build(result.parameters).forces[1].gamma) == pytest.approx(2.0, rel=1e-5)


@pytest.mark.slow
def test_a_whole_system_is_a_parameter():
    """All of a system's constants are trained at once, and those of other kinds stay as they are."""
    result = fit(Chain(hang(chain(80.0, 2.0))), chain(70.0, 2.0), Adam(1e-4), n_iterations=10, transforms={"forces/0": Positive()})
    assert result.value < result.history.loss[0]
    assert result.parameters.net == chain(70.0, 2.0).net
    np.testing.assert_array_equal(result.parameters.free, np.arange(4) > 0)


@pytest.mark.slow
def test_tied_parameters_are_one_value():
    """A value used in two places gets the sum of both gradients, and both places stay equal."""
    loss = Chain(hang(chain(3.0, 3.0)))

    def tied(p):
        return loss(chain(p, p))

    result = fit(tied, 4.0, LBFGS(), n_iterations=30, transforms=Positive())
    assert float(result.parameters) == pytest.approx(3.0, rel=1e-4)
    separate = jax.grad(lambda k, g: loss(chain(k, g)), (0, 1))(4.0, 4.0)
    assert float(jax.grad(tied)(4.0)) == pytest.approx(float(sum(separate)), rel=1e-12)


def test_signs_are_checked_again():
    """A step to a negative drag ends the fit with INVALID, and is never the best; a negative start is an error."""
    system = chain(80.0, 0.01)

    def loss(s):
        return jnp.sum(s.forces[1].gamma) + 0 * jnp.sum(s.mass)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GradientWarning)
        result = fit(loss, system, optax.sgd(0.1), n_iterations=5)
    assert bool(result.status.has(Flag.INVALID))
    assert int(result.status.step) == 1
    assert float(result.parameters.forces[1].gamma) == 0.01
    assert float(result.last.forces[1].gamma) < 0
    with pytest.raises(ValueError, match=r"forces\[1\] \(Drag\) has a constant that is NaN or of the wrong sign"):
        fit(loss, eqx.tree_at(lambda s: s.forces[1].gamma, system, jnp.asarray(-1.0)))
    with pytest.raises(ValueError, match=r"mass has a constant"):
        fit(loss, eqx.tree_at(lambda s: s.mass, system, jnp.asarray(0.0)))


# Checkpoints


@pytest.mark.parametrize("optimiser", [optax.adam(0.03), LBFGS(), LeastSquares()], ids=["adam", "lbfgs", "least squares"])
def test_resume_is_bitwise(optimiser, tmp_path):
    """Ten iterations and ten more from the file are bit for bit twenty at once, in parameters, history and what is carried."""
    is_least_squares = isinstance(optimiser, LeastSquares)

    def loss(p, n):
        value = jax.tree.leaves(rosenbrock_residuals(p)) if is_least_squares else rosenbrock(p)
        return value, (n + 1, None)

    given = {"optimiser": optimiser, "carried": jnp.asarray(0), "transforms": {"b": Bounded(-5.0, 5.0)}}
    place = Checkpoint(tmp_path / "fit.npz", every=4)
    whole = fit(loss, ROSENBROCK_START, n_iterations=20, **given)
    fit(loss, ROSENBROCK_START, n_iterations=10, checkpoint=place, **given)
    resumed = fit(loss, ROSENBROCK_START, n_iterations=20, checkpoint=place, resume=True, **given)
    np.testing.assert_array_equal(resumed.history.loss, whole.history.loss)
    np.testing.assert_array_equal(resumed.history.gradient_norm, whole.history.gradient_norm)
    for name in ("parameters", "last", "carried"):
        assert eqx.tree_equal(getattr(resumed, name), getattr(whole, name)), name
    assert resumed.iteration == whole.iteration
    assert len(resumed.history.seconds) == 21


def test_an_interrupted_fit_is_resumed_bitwise(tmp_path):
    """Ctrl-C writes a checkpoint too, from which the fit goes on as if unbroken."""
    place = Checkpoint(tmp_path / "fit.npz", every=1000)
    optimiser = optax.adam(0.05)

    def interrupt(it):
        if it.index == 5:
            raise KeyboardInterrupt

    fit(bowl, jnp.zeros(2), optimiser, 12, on_iteration=interrupt, checkpoint=place)
    resumed = fit(bowl, jnp.zeros(2), optimiser, 12, checkpoint=place, resume=True)
    np.testing.assert_array_equal(resumed.history.loss, fit(bowl, jnp.zeros(2), optimiser, 12).history.loss)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    """Other transforms, optimiser, shapes or topology: the error names both sides; a missing file is a missing file."""
    place = Checkpoint(tmp_path / "fit.npz")
    with pytest.raises(FileNotFoundError):
        fit(bowl, jnp.zeros(2), checkpoint=place, resume=True)
    fit(bowl, jnp.ones(2), n_iterations=2, checkpoint=place)
    with pytest.raises(CheckpointError, match=r"fit.npz: its transforms is Identity\(\); expected Positive\(\)"):
        fit(bowl, jnp.ones(2), transforms=Positive(), checkpoint=place, resume=True)
    with pytest.raises(CheckpointError, match=r"has shape \(2,\) and dtype float64; expected shape \(3,\) and dtype float64"):
        fit(bowl, jnp.ones(3), checkpoint=place, resume=True)
    with pytest.raises(CheckpointError, match=r"dtype float64; expected shape \(2,\) and dtype float32"):
        fit(bowl, jnp.ones(2, jnp.float32), checkpoint=place, resume=True)
    with pytest.raises(CheckpointError, match=r"its optimiser's type is Adam; expected LBFGS"):
        fit(bowl, jnp.ones(2), LBFGS(), checkpoint=place, resume=True)


# The check of gradients


@pytest.mark.slow
def test_check_gradient_agrees_on_a_rollout(user_mode):
    """Every constant of a chain, in float64 though the system is float32, to 1e-9; the Taylor remainder falls as h^2."""
    target = np.zeros((4, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check = check_gradient(lambda s: squared_distance(hang(s), target), chain(80.0, 2.0))
    assert [leaf.name for leaf in check.leaves][:2] == ["mass", "forces/0/stiffness"]
    assert check.error < 1e-9
    assert all(leaf.taylor_order == pytest.approx(2, abs=0.1) for leaf in check.leaves)
    assert "forces/1/gamma" in str(check)
    assert not jax.config.jax_enable_x64


def test_check_gradient_finds_a_wrong_gradient():
    """A gradient that is 5 % off shows as 5 %, and its remainder falls only as h."""

    @jax.custom_vjp
    def cube(x):
        return x**3

    cube.defvjp(lambda x: (x**3, x), lambda x, ct: (0.95 * 3 * x**2 * ct,))
    (leaf,) = check_gradient(lambda p: cube(p), 1.5).leaves
    assert leaf.error == pytest.approx(0.05 / 0.95, rel=1e-6)
    assert leaf.taylor_order == pytest.approx(1, abs=0.05)


def test_check_gradient_reports_nan():
    """NONFINITE where the loss or only its gradient is not finite."""
    assert bool(check_gradient(lambda p: jnp.log(p), -1.0).status.has(Flag.NONFINITE))
    assert bool(check_gradient(lambda p: jnp.sqrt(p**2), 0.0).status.has(Flag.NONFINITE))
    assert not bool(check_gradient(lambda p: p**2, 1.0).status.has(Flag.NONFINITE))


def test_squared_distance_refuses_other_shapes():
    """Shapes must agree: broadcasting one point against many would fit their mean."""
    with pytest.raises(ValueError, match=r"points have shape \(3, 2\), target has \(1, 2\)"):
        squared_distance(jnp.zeros((3, 2)), jnp.zeros((1, 2)))
    assert float(squared_distance(jnp.ones((2, 2)), np.zeros((2, 2)))) == 2.0
