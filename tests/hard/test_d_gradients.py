"""Hard cases D: gradients. (Lines that need an implicit step, heat or melting are not here.)"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.images import CubicSpline, Image
from jaxspring.status import Flag
from tests.reference import central_difference, relative_error

SHEET = js.lattice((10, 10), js.STRUCTURAL + js.SHEAR)
REST = np.linalg.norm(np.diff(SHEET.grid()[SHEET.edges], axis=1)[:, 0], axis=1)


def cloth(k, damping=1.0):
    """A 10 x 10 cloth, pinned at two corners, hanging."""
    free = np.ones(100, bool)
    free[[0, 9]] = False
    effects = (js.Springs(SHEET, k, REST), js.Gravity((0.0, -9.81, 0.0)), *([js.Drag(damping)] if damping else []))
    return js.System(SHEET, 0.1, effects, free=free)


def start(rng):
    return js.State.from_points(SHEET, np.c_[SHEET.grid(), np.zeros(100)] + 0.02 * rng.normal(size=(100, 3)))


def fall(n_steps, state, adjoint=None):
    """Loss after `n_steps` of the cloth, as a function of its stiffness."""

    def loss(k):
        end = js.rollout(cloth(k), state, js.SymplecticEuler(), 2e-3, n_steps, adjoint=adjoint).state
        # Of the way gone, not of the place: a large loss would drown differences in rounding.
        moved = end.position - state.position
        return jnp.sum(moved.dot(moved))

    return loss


@pytest.mark.slow
def test_d1_long_gradients_in_little_memory(rng):
    """10^4 damped steps of a 10 x 10 cloth: dL/dk in at most 2 MiB, equal to the gradient that stores all and to forward mode to 1e-12."""
    state, k = start(rng), jnp.asarray(100.0)
    blocked = jax.jit(jax.grad(fall(10_000, state))).lower(k).compile()
    assert blocked.memory_analysis().temp_size_in_bytes <= 2 * 2**20
    reverse = float(blocked(k))
    stored = float(jax.jit(jax.grad(fall(10_000, state, js.StoreAll())))(k))
    forward = float(jax.jit(lambda k: jax.jvp(fall(10_000, state), (k,), (jnp.ones_like(k),))[1])(k))
    assert abs(reverse) > 1e-3
    assert reverse == pytest.approx(stored, rel=1e-12)
    assert reverse == pytest.approx(forward, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("n_steps", "step", "bound"), [(100, 1e-4, 1e-4), (100, 1e-2, 1e-7), (1_000, 1e-3, 1e-9), (10_000, 1e-4, 1e-8)])
def test_d2_against_central_differences(rng, n_steps, step, bound):
    """dL/dk after 100, 1,000 and 10,000 damped steps against central differences (bounds: of a trial implementation).

    After 1,000 steps h = 1e-3, not 1e-4: the rounding of a thousand steps over 2e-4 is 5e-9 of this gradient, measured.
    """
    loss = jax.jit(fall(n_steps, start(rng)))
    k = jnp.asarray(100.0)
    gradient = float(jax.grad(loss)(k))
    assert gradient == pytest.approx(central_difference(loss, k, step), rel=bound)


@pytest.mark.slow
def test_d5_chaos_has_large_gradients_never_zeros(rng):
    """Undamped and jittered, the gradient grows beyond bounds: in float64 finite, in float32 in the end NaN or infinite, never zero."""
    points = SHEET.grid() + 0.4 * rng.normal(size=(100, 2))

    def gradient(dtype, n_steps):
        def loss(points):
            system = js.System(SHEET, 1.0, js.Springs(SHEET, 100.0, REST))
            end = js.rollout(system, js.State.from_points(SHEET, points), js.SymplecticEuler(), 2e-2, n_steps).state
            return jnp.sum(end.position.dot(end.position))

        return np.asarray(jax.jit(jax.grad(loss))(jnp.asarray(points, dtype)), float)

    # One, ten and thirty seconds.
    norms = [np.linalg.norm(gradient("float64", n)) for n in (50, 500, 1500)]
    assert np.isfinite(norms).all()
    assert 10 < norms[0] < 1e-6 * norms[1]
    assert norms[2] > np.finfo(np.float32).max
    assert not np.isfinite(gradient("float32", 1500)).any()


def squeezed(n_steps):
    """Sum of the sideways positions of a chain squeezed to half its length, exactly on its axis: an equilibrium from which any push to
    the side grows by about e in each step. The sum stays zero, and its derivative by the start does not.
    """
    net = js.lattice(8)
    free = np.ones(8, bool)
    free[[0, 7]] = False
    k, l, dt = (np.float32(c) for c in (1.0, 1.0, 0.5))

    def loss(points):
        system = js.System(net, np.float32(1), js.Springs(net, k, l), free=free)
        start = js.State.from_points(net, points.astype(jnp.float32))
        return jnp.sum(js.rollout(system, start, js.SymplecticEuler(), dt, n_steps).state.position.y)

    return loss, jnp.asarray(np.c_[0.5 * np.arange(8), np.zeros(8)], jnp.float32)


@pytest.mark.slow
def test_d5_an_overflow_is_reported():
    """A gradient beyond the range of float32 makes `fit` and `check_gradient` say NONFINITE and train nothing; one within it does not."""
    loss, points = squeezed(20)
    assert js.check_gradient(loss, points).status.is_ok
    loss, points = squeezed(400)
    found = js.fit(loss, points, js.Adam(0.1), n_iterations=5)
    assert found.status.has(Flag.NONFINITE)
    assert found.reason is js.inverse.StopReason.FAILED
    assert found.history.loss.tolist() == [0]
    assert not np.isfinite(found.history.gradient_norm).any()
    np.testing.assert_array_equal(found.parameters, points)
    checked = js.check_gradient(loss, points)
    assert checked.status.has(Flag.NONFINITE)
    assert not np.isfinite(checked.leaves[0].gradient)
    assert not np.isfinite(checked.error)


def test_d7_at_rest():
    """At rest length the energy does not depend on k or l: exact zeros; with k = 0 there is no force and no NaN."""
    net = js.lattice((3, 4), js.STRUCTURAL)
    state = js.State.from_points(net, net.grid())

    def energy(k, l):
        return js.System(net, 1.0, js.Springs(net, k, l)).energy(state).total

    by_k, by_l = jax.grad(energy, argnums=(0, 1))(jnp.full(17, 7.0), jnp.ones(17))
    np.testing.assert_array_equal(by_k, 0)
    np.testing.assert_array_equal(by_l, 0)
    stretched = js.State.from_points(net, 1.5 * net.grid())

    def end(k):
        system = js.System(net, 1.0, js.Springs(net, k, 1.0))
        result = js.rollout(system, stretched, js.SymplecticEuler(), 0.1, 2)
        return jnp.sum(result.state.position.dot(result.state.position))

    gradient = jax.grad(end)(jnp.zeros(17))
    assert np.isfinite(gradient).all()
    # Two steps from rest: x moves by 3 dt^2 a, and d|x|^2/dk = 2 x . 3 dt^2 f/k; springs of length 1.5 pull 0.5 k, drawing x together.
    expected = [-0.5 * 1.5 * 2 * 3 * 0.1**2] * 17  # 2 x . (pull on tail + pull on head) = -2 * 1.5 * 0.5
    np.testing.assert_allclose(gradient, expected, rtol=1e-12)


STEPPERS = [js.ForwardEuler(), js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()]


# Every stepper on every topology in float64; float32 once on each topology.
CASES = [(stepper, kind, "float64") for stepper in STEPPERS for kind in ("lattice", "graph")]
CASES += [
    (js.SymplecticEuler(), "lattice", "float32"),
    (js.VelocityVerlet(), "graph", "float32"),
    (js.RungeKutta4(), "graph", "float32"),
]


@pytest.mark.parametrize(("stepper", "kind", "dtype"), CASES)
def test_d8_dot_test(rng, stepper, kind, dtype):
    """<J u, w> = <u, J' w> for a step of every stepper, with random u and w: 1e-12 in float64, 1e-4 in float32."""
    net = js.lattice((4, 5))
    if kind != "lattice":
        net = js.Graph.from_edges(net.edges, 20)

    def step(inputs):
        x, v, k, l, mass, gamma, dt = inputs
        system = js.System(net, mass, (js.Springs(net, k, l), js.Drag(gamma))).bind(x.dtype)
        state = js.State.from_points(net, x, v)
        end, memory = stepper.step(system, state, dt, stepper.init(system, state))
        return end.position, end.velocity, memory

    def random(*shape, low=-1.0, high=1.0):
        return jnp.asarray(rng.uniform(low, high, shape), dtype)

    points = random(20, 3, low=-0.2, high=0.2) + jnp.asarray(np.c_[js.lattice((4, 5)).grid(), np.zeros(20)], dtype)
    k, l = (random(net.n_springs, low=0.5, high=2.0) for _ in range(2))
    at = (points, random(20, 3), k, l, random(20, low=0.5, high=2.0), random(low=0.1, high=1.0), random(low=0.05, high=0.1))
    u = jax.tree.map(lambda a: random(*a.shape), at)

    @jax.jit
    def both(at, u):
        _, forward = jax.jvp(step, (at,), (u,))
        w = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), forward)
        _, pullback = jax.vjp(step, at)
        return forward, w, pullback(w)[0]

    def dot(a, b):
        return sum(float(np.sum(np.asarray(p, float) * np.asarray(q, float))) for p, q in zip(*map(jax.tree.leaves, (a, b)), strict=True))

    forward, w, backward = both(at, u)
    left, right = dot(forward, w), dot(u, backward)
    assert abs(left - right) <= (1e-4 if dtype == "float32" else 1e-12) * np.sqrt(dot(forward, forward) * dot(w, w))


IMAGE = np.add.outer(np.sin(np.arange(7.0)), np.cos(np.arange(8.0)))
SMALL = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)


def image_scene(p):
    """30 Verlet steps of a pinned, damped sheet over an image that pulls it along its gradient too; a smooth loss of positions."""
    free = np.ones(20, bool)
    free[0] = False
    data = js.DataSprings(Image(p["pixels"]), p["k_data"], sampling=CubicSpline(), conservative=True)
    system = js.System(SMALL, p["mass"], (js.Springs(SMALL, p["k"], p["l0"]), js.Drag(p["gamma"]), data), free=free)
    end = js.rollout(system, js.State.from_points(SMALL, p["x0"], p["v0"]), js.VelocityVerlet(), p["dt"], 30).state
    return jnp.sum(jnp.sin(end.points) ** 2) + 0.1 * jnp.sum(end.velocities**2)


def parameters(rng):
    return {
        "x0": np.c_[SMALL.grid() + 1.3, np.zeros(20)] + 0.1 * rng.normal(size=(20, 3)),
        "v0": rng.normal(size=(20, 3)),
        "mass": rng.uniform(0.5, 2.0, 20),
        "k": rng.uniform(10.0, 30.0, SMALL.n_springs),
        "l0": rng.uniform(0.5, 1.5, SMALL.n_springs),
        "gamma": np.asarray(0.7),
        "dt": np.asarray(0.02),
        "k_data": np.asarray(3.0),
        "pixels": IMAGE,
    }


@pytest.fixture(scope="module")
def scene():
    """The loss, its parameters and its gradient with respect to all of them at once."""
    p = parameters(np.random.default_rng(9))
    return jax.jit(image_scene), p, jax.jit(jax.grad(image_scene))(jax.tree.map(jnp.asarray, p))


@pytest.mark.parametrize("name", ["x0", "v0", "mass", "k", "l0", "gamma", "dt", "k_data", "pixels"])
def test_d9_every_parameter(scene, name):
    """The gradient through 30 steps with respect to initial state, constants, dt and pixels is the central difference, to 1e-6."""
    loss, p, gradient = scene
    # The entry with the largest derivative: it is compared relative to itself.
    at = np.unravel_index(np.argmax(np.abs(gradient[name])), np.shape(p[name]))

    def along(value):
        moved = np.array(p[name], float)
        moved[at] = value
        return loss({**p, name: moved})

    value = float(np.asarray(p[name])[at])
    step = 1e-4 * abs(value)
    # Fourth order, so that the difference is good to 1e-9 with steps large enough for rounding.
    expected = (4 * central_difference(along, value, step) - central_difference(along, value, 2 * step)) / 3
    assert abs(expected) > 1e-4
    assert float(gradient[name][at]) == pytest.approx(expected, rel=1e-6)


def test_d11_models_with_whole_numbers():
    """eqx.filter_grad differentiates a system that holds integer tables; plain jax.grad refuses it with an error that names the dtype."""
    net = js.Graph.from_edges([(0, 1), (1, 2)], 3)
    system = js.System(net, 1.0, js.Springs(net, [1.0, 2.0], 1.0))
    state = js.State.from_points(net, [[0.0], [2.0], [5.0]])

    def energy(system):
        return system.energy(state).total

    gradient = eqx.filter_grad(energy)(system)
    np.testing.assert_allclose(gradient.forces[0].stiffness, [0.5, 2.0])  # (r - l)^2 / 2
    with pytest.raises(TypeError, match=r"grad requires real- or complex-valued inputs.*int32"):
        jax.grad(energy)(system)


def test_d12_batches_of_gradients(rng):
    """vmap(grad) over three stiffnesses, grad of a sum over vmap, and a loop agree to 1e-12."""
    loss = fall(50, start(rng))
    ks = jnp.array([50.0, 100.0, 200.0])
    one = jax.jit(jax.grad(loss))
    loop = np.array([one(k) for k in ks])
    assert relative_error(jax.jit(jax.vmap(jax.grad(loss)))(ks), loop) <= 1e-12
    assert relative_error(jax.jit(jax.grad(lambda ks: jnp.sum(jax.vmap(loss)(ks))))(ks), loop) <= 1e-12
