"""Transforms of whole runs: jit, vmap and derivatives agree with each other; programs are traced once; frames, resuming, callbacks."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests import reference

N_STEPS = 24
SLIDES = js.SymplecticEuler()


@pytest.fixture(scope="module")
def scene():
    """A pinned, damped sheet with a constant per spring; (loss, parameters): parameters -> loss after 24 steps."""
    rng = np.random.default_rng(7)
    net = js.lattice((2, 3))
    points = net.grid() + 0.1 * rng.normal(size=(6, 2))
    free = np.ones(6, bool)
    free[[0, 2]] = False
    target = rng.normal(size=(6, 2))

    def state(x):
        return js.State.from_points(net, x)

    def system(k, l, gamma):
        forces = (js.Springs(net, k, l), js.Drag(gamma), js.Gravity([0.0, -1.0]))
        return js.System(net, 1.0, forces, free=free)

    def loss(parameters, stepper=SLIDES):
        k, l, gamma, x = parameters
        end = js.rollout(system(k, l, gamma), state(x), stepper, dt=0.05, n_steps=N_STEPS).state
        return jnp.sum((end.points - target) ** 2)

    k, l = jnp.asarray(rng.uniform(5, 9, net.n_springs)), jnp.asarray(rng.uniform(0.7, 1, net.n_springs))
    return loss, (k, l, jnp.asarray(0.3), jnp.asarray(points))


def flat(tree):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


@pytest.fixture(scope="module")
def gradient(scene):
    """The compiled reverse-mode gradient, and its value."""
    loss, parameters = scene
    compiled = jax.jit(jax.grad(loss))
    return compiled, compiled(parameters)


@pytest.fixture(scope="module")
def direction(scene):
    rng = np.random.default_rng(8)
    return jax.tree.map(lambda p: jnp.asarray(rng.normal(size=p.shape)), scene[1])


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse_mode(scene, gradient, direction):
    """The directional derivative by jvp is the inner product with the gradient, to 1e-12."""
    loss, parameters = scene
    forward = jax.jit(lambda p, v: jax.jvp(loss, (p,), (v,))[1])(parameters, direction)
    assert float(forward) == pytest.approx(float(np.vdot(flat(gradient[1]), flat(direction))), rel=1e-12)


@pytest.mark.slow
def test_hessian_vector_products_agree(scene, direction):
    """Forward over reverse, reverse over reverse and reverse over forward give one Hessian-vector product, to 1e-12."""
    loss, parameters = scene
    g = jax.grad(loss)
    products = [
        jax.jit(lambda p, v: jax.jvp(g, (p,), (v,))[1]),
        jax.jit(lambda p, v: jax.grad(lambda q: jax.tree.reduce(jnp.add, jax.tree.map(jnp.vdot, g(q), v)))(p)),
        jax.jit(lambda p, v: jax.grad(lambda q: jax.jvp(loss, (q,), (v,))[1])(p)),
    ]
    first, *others = [flat(product(parameters, direction)) for product in products]
    for other in others:
        np.testing.assert_allclose(other, first, atol=1e-12 * np.abs(first).max())


@pytest.mark.slow
def test_batched_gradients_agree_with_single_ones(scene, gradient, direction):
    """vmap(grad) over three sets of parameters equals the loop, and so does the gradient of a batched sum, to 1e-12."""
    loss, parameters = scene
    lanes = [jax.tree.map(lambda p, v, s=s: p + 0.02 * s * v, parameters, direction) for s in range(3)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)
    expected = np.stack([flat(gradient[0](lane)) for lane in lanes])
    batched = jax.jit(jax.vmap(jax.grad(loss)))(stacked)
    summed = jax.jit(jax.grad(lambda p: jnp.sum(jax.vmap(loss)(p))))(stacked)
    for found in (batched, summed):
        rows = np.stack([flat(jax.tree.map(lambda leaf, i=i: leaf[i], found)) for i in range(3)])
        np.testing.assert_allclose(rows, expected, atol=1e-12 * np.abs(expected).max())


def test_gradient_is_the_gradient(scene, gradient, direction):
    """Central differences along a random direction agree to 1e-8."""
    loss, parameters = scene
    compiled = jax.jit(loss)
    along = reference.central_difference(lambda h: compiled(jax.tree.map(lambda p, v: p + h * v, parameters, direction)), 0.0, 2e-6)
    assert along == pytest.approx(float(np.vdot(flat(gradient[1]), flat(direction))), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.ForwardEuler(), js.VelocityVerlet(), js.RungeKutta4()], ids=lambda s: type(s).__name__)
def test_every_stepper_is_differentiable_both_ways(stepper):
    """For each other stepper, on a chain with drag, forward and reverse mode agree to 1e-12."""
    net, state, _ = small()

    def loss(k):
        system = js.System(net, 1.0, (js.Springs(net, k, 0.9), js.Drag(0.1)))
        return jnp.sum(js.rollout(system, state, stepper, dt=0.02, n_steps=10).state.points ** 2)

    k = jnp.asarray(2.0)
    forward, reverse = jax.jit(lambda k: (jax.jvp(loss, (k,), (jnp.ones(()),))[1], jax.grad(loss)(k)))(k)
    assert float(forward) != 0
    assert float(forward) == pytest.approx(float(reverse), rel=1e-12)


@pytest.mark.slow
def test_storing_all_and_block_sizes_change_nothing(scene):
    """StoreAll and other block sizes give the gradient of the default to 1e-13: they only trade memory for time."""
    net = js.lattice(4)
    state = js.State.from_points(net, [[0.0], [1.1], [2.3], [3.0]])

    def loss(k, adjoint):
        system = js.System(net, 1.0, (js.Springs(net, k, 0.9), js.Drag(0.1)))
        return jnp.sum(js.rollout(system, state, js.SymplecticEuler(), 0.05, 23, adjoint=adjoint).state.points ** 2)

    found = [float(jax.jit(jax.grad(lambda k, a=a: loss(k, a)))(jnp.asarray(5.0))) for a in (None, js.StoreAll(), js.Checkpointed(7))]
    np.testing.assert_allclose(found, found[0], rtol=1e-13)


class CountedDrag(js.Force):
    """Drag that tells when it is traced."""

    gamma: jax.Array
    traces: reference.Traces = eqx.field(static=True)

    def force(self, state):
        self.traces()
        return -(self.gamma * state.velocity)


def small(gamma=0.1, dtype="float64"):
    net = js.lattice(3)
    return net, js.State.from_points(net, np.array([[0.0], [1.2], [2.0]], dtype)), gamma


def test_new_values_never_trace_again():
    """New constants, a new state, and dt as float, np.float32, np.float64, int and 0-d array share one compiled program."""
    net, state, _ = small()
    traces = reference.Traces()

    def run(gamma, dt, state):
        system = js.System(net, 1.0, (js.Springs(net, 3.0 + gamma, 0.9), CountedDrag(jnp.asarray(gamma), traces)))
        return js.rollout(system, state, js.SymplecticEuler(), dt=dt, n_steps=6)

    run(0.1, 0.01, state)
    once = traces.count
    assert once > 0
    for dt in (0.02, np.float32(0.01), np.float64(0.03), jnp.asarray(0.01), jnp.asarray(0.01, "float32"), 0):
        run(0.2, dt, state)
    last = run(0.3, 0.01, js.State.from_points(net, [[0.0], [1.0], [2.5]]))
    run(0.3, 0.01, last.state)
    assert traces.count == once


def test_float32_in_float32_out(dtype):
    """A run keeps the dtype of its state, whatever the dtype of constants and dt; time too."""
    net, state, _ = small(dtype=dtype)
    system = js.System(net, np.float64(1.0), (js.Springs(net, np.ones(2), np.float32(0.9)), js.Drag(0.1)))
    result = js.rollout(system, state, js.VelocityVerlet(), dt=np.float64(0.01), n_steps=100, save_every=50)
    assert {leaf.dtype for leaf in jax.tree.leaves((result.state, result.saved))} == {np.dtype(dtype)}


def test_float32_is_near_float64():
    """The same run in both precisions differs by float32's rounding only."""
    ends = []
    for precision in ("float32", "float64"):
        net, state, _ = small(dtype=precision)
        system = js.System(net, 1.0, (js.Springs(net, 2.0, 0.9), js.Drag(0.1)))
        ends.append(np.asarray(js.rollout(system, state, js.VelocityVerlet(), dt=0.01, n_steps=100).state.points, "float64"))
    np.testing.assert_allclose(*ends, atol=2e-6)


def test_lanes_of_a_batch_are_single_runs():
    """A vmap over start, stiffness and dt equals the loop, and a lane of NaN leaves its neighbours as they are."""
    net, state, _ = small()
    starts = jnp.stack([state.points, 1.1 * state.points, state.points * jnp.nan])
    k, dt = jnp.asarray([1.0, 2.0, 3.0]), jnp.asarray([0.01, 0.02, 0.03])

    def run(x, k, dt):
        return js.rollout(js.System(net, 1.0, js.Springs(net, k, 0.9)), js.State.from_points(net, x), js.SymplecticEuler(), dt, 20)

    batch = jax.jit(jax.vmap(run))(starts, k, dt)
    for lane in (0, 1):
        np.testing.assert_allclose(batch.state.points[lane], run(starts[lane], k[lane], dt[lane]).state.points, rtol=1e-13)
    assert np.asarray(batch.status.is_ok).tolist() == [True, True, False]


@pytest.mark.parametrize("save_every", [1, 5, 10, 30])
def test_frames_are_the_states_of_shorter_runs(save_every):
    """Frame i is the state after (i + 1) save_every steps, time included, however the run is cut into blocks."""
    net, state, _ = small()
    system = js.System(net, 1.0, (js.Springs(net, 2.0, 0.9), js.Drag(0.1)))
    every = js.rollout(system, state, js.SymplecticEuler(), 0.02, 30, save_every=1, adjoint=js.StoreAll()).saved
    saved = js.rollout(system, state, js.SymplecticEuler(), 0.02, 30, save_every=save_every).saved
    np.testing.assert_allclose(saved.points, every.points[save_every - 1 :: save_every], rtol=1e-14)
    np.testing.assert_array_equal(saved.time, np.arange(save_every, 31, save_every) * 0.02)


def test_observe_keeps_what_it_returns():
    """With observe, each frame is the function of the state; its gradient works."""
    net, state, _ = small()

    def energies(k):
        system = js.System(net, 1.0, js.Springs(net, k, 0.9))
        run = js.rollout(system, state, js.SymplecticEuler(), 0.02, 20, save_every=5, observe=lambda s: (s.time, system.energy(s).total))
        return run.saved

    time, energy = energies(2.0)
    np.testing.assert_allclose(time, [0.1, 0.2, 0.3, 0.4])
    assert energy.shape == (4,)
    total = jax.jit(lambda k: jnp.sum(energies(k)[1]))
    expected = reference.central_difference(total, jnp.asarray(2.0), 1e-5)
    assert float(jax.grad(total)(jnp.asarray(2.0))) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=lambda s: type(s).__name__)
def test_a_resumed_run_is_the_unbroken_one_to_the_bit(stepper):
    """17 + 23 steps with resume are bitwise the 40 steps at once, stepper's memory and time included."""
    net, state, _ = small()
    system = js.System(net, 1.0, (js.Springs(net, 2.0, 0.9), js.Drag(0.1)))
    whole = js.rollout(system, state, stepper, 0.02, 40)
    first = js.rollout(system, state, stepper, 0.02, 17)
    second = js.rollout(system, first.state, stepper, 0.02, 23, resume=first.resume)
    for a, b in zip(jax.tree.leaves(second.state), jax.tree.leaves(whole.state), strict=True):
        np.testing.assert_array_equal(a, b)
    assert int(second.info.n_steps) == 40


def test_no_step_and_zero_dt():
    """n_steps = 0 and dt = 0 give the state back; frames of a run of no step have length 0."""
    net, state, _ = small()
    system = js.System(net, 1.0, js.Springs(net, 2.0, 0.9))
    for result in (js.rollout(system, state, js.SymplecticEuler(), 0.02, 0), js.rollout(system, state, js.SymplecticEuler(), 0.0, 3)):
        np.testing.assert_array_equal(result.state.points, state.points)
        assert bool(result.status.is_ok)


def test_callback_between_chunks_of_an_eager_run(capsys):
    """The callback sees a growing number of steps that ends at n_steps; the bar ends in one line; results stay the same."""
    net, state, _ = small()
    system = js.System(net, 1.0, js.Springs(net, 2.0, 0.9))
    seen = []
    progress = js.Progress(callback=lambda done, total: seen.append((done, total)))
    watched = js.rollout(system, state, js.SymplecticEuler(), 0.02, 100, save_every=10, progress=progress)
    quiet = js.rollout(system, state, js.SymplecticEuler(), 0.02, 100, save_every=10)
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    assert len(seen) > 2
    assert seen[-1] == (100, 100)
    assert "100 %" in capsys.readouterr().err
    for a, b in zip(jax.tree.leaves((watched.state, watched.saved)), jax.tree.leaves((quiet.state, quiet.saved)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_callback_under_grad():
    """Under jit and grad the callback is called from the device, and the gradient is that without it."""
    net, state, _ = small()
    seen = []
    progress = js.Progress(callback=lambda done, total: seen.append(done), bar=False)

    def loss(k, progress):
        system = js.System(net, 1.0, js.Springs(net, k, 0.9))
        return jnp.sum(js.rollout(system, state, js.SymplecticEuler(), 0.02, 25, progress=progress).state.points ** 2)

    k = jnp.asarray(2.0)
    watched = jax.jit(jax.grad(lambda k: loss(k, progress)))(k)
    jax.effects_barrier()
    assert 25 in seen
    assert float(watched) == pytest.approx(float(jax.jit(jax.grad(lambda k: loss(k, None)))(k)), rel=1e-14)


def test_an_interrupted_run_keeps_what_was_done():
    """Ctrl-C between chunks returns the state and frames until then, with INTERRUPTED; resuming gives the unbroken run."""
    net, state, _ = small()
    system = js.System(net, 1.0, js.Springs(net, 2.0, 0.9))

    def stop(done, total):
        if done >= 40:
            raise KeyboardInterrupt

    progress = js.Progress(callback=stop, bar=False)
    result = js.rollout(system, state, js.SymplecticEuler(), 0.02, 100, save_every=5, progress=progress)
    assert bool(result.status.has(js.Flag.INTERRUPTED))
    done = int(result.info.n_steps)
    assert 40 <= done < 100
    assert result.saved.points.shape[0] == done // 5
    with pytest.raises(js.SimulationError, match="INTERRUPTED"):
        js.raise_for_status(result)
    rest = js.rollout(system, result.state, js.SymplecticEuler(), 0.02, 100 - done, resume=result.resume)
    whole = js.rollout(system, state, js.SymplecticEuler(), 0.02, 100)
    np.testing.assert_array_equal(rest.state.points, whole.state.points)


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd, jax.hessian], ids=["grad", "jacfwd", "hessian"])
def test_functions_of_a_system_have_derivatives(transform):
    """Derivatives by grad, jacfwd and hessian of energy, stable_dt's inverse square, momentum and reaction are those of differences."""
    net, state, _ = small()
    v = jnp.asarray([[0.5], [-0.2], [0.1]])

    def probe(k):
        system = js.System(net, 2.0, (js.Springs(net, k, 0.9), js.Drag(0.1)), free=np.array([False, True, True]))
        moving = js.State.from_points(net, state.points, v)
        energy = system.energy(moving).total
        return energy**2 + jnp.sum(system.reaction(moving).x) + jnp.sum(system.momentum(moving)) + js.stable_dt(system, moving) ** -2

    k = jnp.asarray(2.0)
    if transform is jax.hessian:
        expected = reference.central_difference(jax.jit(jax.grad(probe)), k, 1e-5)
    else:
        expected = reference.central_difference(jax.jit(probe), k, 1e-5)
    assert float(jax.jit(transform(probe))(k)) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"n_steps": 10, "save_every": 3}, ValueError, "not a multiple"),
        ({"n_steps": -1}, ValueError, "n_steps = -1"),
        ({"n_steps": 2.0}, TypeError, "n_steps = 2.0"),
        ({"dt": np.nan}, ValueError, "dt = nan"),
        ({"observe": lambda s: s.time}, ValueError, "save_every is None"),
        ({"check_every": 0}, ValueError, "check_every = 0"),
    ],
)
def test_wrong_arguments_of_rollout(changes, kind, message):
    """Each wrong argument raises, naming it."""
    net, state, _ = small()
    with pytest.raises(kind, match=message):
        js.rollout(js.System(net, 1.0), state, js.SymplecticEuler(), **{"dt": 0.1, "n_steps": 2, **changes})
