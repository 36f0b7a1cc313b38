"""The gradient through a rollout, with respect to everything a scene is made of."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.images import CubicSpline, Image
from tests.reference import central_difference

SHEET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)
KINDS = pytest.mark.parametrize("kind", ["lattice", "graph"])
NODE = 7  # moves in every direction
PIXEL = (4, 5)


def topology(kind):
    if kind == "lattice":
        return SHEET
    return js.Graph.from_edges(SHEET.edges, 20)


def parameters():
    """A bumpy image, a sheet over it, and constants of order one."""
    rng = np.random.default_rng(5)
    y, x = np.indices((9, 10))
    return {
        "k": rng.uniform(5, 15, SHEET.n_springs),
        "l": rng.uniform(0.6, 1.4, SHEET.n_springs),
        "mass": rng.uniform(0.5, 2, 20),
        "gamma": np.asarray(0.7),
        "x0": np.c_[SHEET.grid(1.4) + 1.2, np.zeros(20)] + 0.1 * rng.normal(size=(20, 3)),
        "v0": rng.normal(size=(20, 3)),
        "dt": np.asarray(0.02),
        "k_data": np.asarray(3.0),
        "pixels": np.sin(0.8 * x) * np.cos(0.6 * y) + 0.1 * rng.normal(size=(9, 10)),
        "k_min": np.asarray(1.0),
        "k_max": np.asarray(20.0),
        "sigma": np.asarray(1.1),
    }


def scene(net, n_steps=30):
    """Loss after 30 steps: data springs, springs whose stiffness follows the image in the plane, springs of their own, pins and drag."""
    free = np.ones((20, 3), bool)
    free[0] = False
    free[4, 0] = False

    def loss(p):
        image = Image(p["pixels"])
        rule = js.ImageStiffness(image, p["k_min"], p["k_max"], p["sigma"], sampling=CubicSpline(), radius=5)
        effects = (
            js.Springs(net, p["k"], p["l"]),
            js.Springs(net, rule, axes=(0, 1)),
            js.DataSprings(image, p["k_data"], sampling=CubicSpline()),
            js.Drag(p["gamma"]),
        )
        system = js.System(net, p["mass"], effects, free=free)
        state = js.State.from_points(net, p["x0"], p["v0"])
        end = js.rollout(system, state, js.SymplecticEuler(), p["dt"], n_steps).state
        return jnp.sum(jnp.sin(end.points) ** 2) + 0.1 * jnp.sum(end.velocities**2)

    return loss


@pytest.fixture(scope="module")
def compiled():
    """For each topology: the compiled loss and its gradient with respect to all parameters, made once."""
    made = {}

    def get(kind):
        if kind not in made:
            loss = scene(topology(kind))
            made[kind] = jax.jit(loss), jax.jit(jax.grad(loss))(jax.tree.map(jnp.asarray, parameters()))
        return made[kind]

    return get


def entry(name, gradient):
    """Which entry of a parameter to look at: named ones, else where the gradient is largest."""
    fixed = {"x0": (NODE, 0), "v0": (NODE, 2), "pixels": PIXEL}
    return fixed.get(name) or np.unravel_index(np.argmax(np.abs(gradient)), np.shape(gradient))


@KINDS
@pytest.mark.parametrize("name", sorted(parameters()))
def test_every_parameter_against_central_differences(compiled, kind, name):
    """After 30 steps dL/dp is the central difference, to 1e-6 of the larger of |g| and 1e-6 |L|/|p|."""
    loss, gradient = compiled(kind)
    p = parameters()
    at = entry(name, gradient[name])
    value = float(p[name][at])

    def along(x):
        moved = p[name].copy()
        moved[at] = x
        return loss({**p, name: moved})

    step = 3e-4 * (value if name == "dt" else max(abs(value), 0.1))
    # Two central differences joined to fourth order, so that neither rounding nor curvature shows at 1e-6.
    expected = (4 * central_difference(along, value, step) - central_difference(along, value, 2 * step)) / 3
    scale = max(abs(expected), 1e-6 * float(loss(p)) / abs(value))
    assert abs(float(gradient[name][at]) - expected) <= 1e-6 * scale


def test_topologies_agree(compiled):
    """The lattice and the graph give one gradient: they are one net."""
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11), compiled("graph")[1], compiled("lattice")[1])


@KINDS
def test_taylor_remainder_falls_as_the_square(compiled, kind):
    """Along a random direction in all parameters the remainder falls as h^2; with a wrong gradient it falls only as h."""
    loss, gradient = compiled(kind)
    p = parameters()
    rng = np.random.default_rng(6)
    direction = {name: rng.normal(size=np.shape(a)) * 0.1 * (1 + np.abs(a)) for name, a in p.items()}
    direction["dt"] = direction["dt"] * 0.02
    slope = sum(float(np.sum(np.asarray(gradient[name]) * direction[name])) for name in p)
    sizes = 1e-3 * 0.5 ** np.arange(4)
    remainders = [abs(float(loss({n: p[n] + h * direction[n] for n in p})) - float(loss(p)) - h * slope) for h in sizes]
    assert np.polyfit(np.log(sizes), np.log(remainders), 1)[0] == pytest.approx(2, abs=0.1)


HUNDRED = js.lattice((10, 10), js.STRUCTURAL + js.SHEAR)


def kinetic(state):
    return jnp.sum(state.velocity.dot(state.velocity))


def long_loss(net, n_steps, save_every=None, observe=None):
    """A loss of the last state, and of all frames where there are any."""
    state = js.State.from_points(net, np.c_[1.1 * HUNDRED.grid(), np.zeros(100)])

    def loss(k, l):
        system = js.System(net, 1.0, (js.Springs(net, k, l), js.Drag(0.5)))
        result = js.rollout(system, state, js.SymplecticEuler(), 1e-2, n_steps, save_every=save_every, observe=observe)
        frames = 0.0 if result.saved is None else jnp.sum(result.saved)
        return jnp.sum(result.state.position.dot(result.state.position)) + frames

    return loss


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "n_steps", "save_every"),
    [
        ("lattice", 10_000, None),
        ("lattice", 10_007, None),
        ("lattice", 10_000, 10),
        ("lattice", 10_007, 1),
        ("graph", 10_000, None),
    ],
)
def test_memory_of_a_long_gradient(kind, n_steps, save_every):
    """By the program's own analysis 10,000 steps of 100 nodes need at most 2 MiB of temporaries for the gradient by every k and l."""
    net = HUNDRED if kind == "lattice" else js.Graph.from_edges(HUNDRED.edges, 100)
    loss = long_loss(net, n_steps, save_every, kinetic if save_every else None)
    k = jnp.full(net.n_springs, 20.0)
    program = jax.jit(jax.grad(loss, argnums=(0, 1))).lower(k, jnp.ones_like(k)).compile()
    assert program.memory_analysis().temp_size_in_bytes <= 2 * 2**20


CHAIN = js.lattice(5)


def short_run(n_steps, save_every, adjoint, check_every=None):
    state = js.State.from_points(CHAIN, np.c_[1.2 * np.arange(5.0)], np.sin(np.arange(5.0))[:, None])

    def loss(k):
        system = js.System(CHAIN, 1.0, (js.Springs(CHAIN, k, 1.0), js.Drag(0.2)), free=[False, True, True, True, True])
        options = {"save_every": save_every, "adjoint": adjoint, "check_every": check_every}
        result = js.rollout(system, state, js.VelocityVerlet(), 0.05, n_steps, **options)
        frames = 0.0 if result.saved is None else jnp.sum(result.saved.position.x**2)
        return jnp.sum(result.state.position.x**2) + frames, result

    return jax.jit(jax.value_and_grad(loss, has_aux=True))(jnp.linspace(8.0, 12.0, 4))


@pytest.mark.parametrize(
    ("n_steps", "save_every", "block", "check_every"),
    [
        (97, None, None, None),
        (97, 1, None, None),
        (60, 20, 7, None),
        (60, 2, 8, None),
        (66, 6, 24, 5),
        (97, None, 200, 10),
    ],
)
def test_every_way_to_cut_a_run_is_the_same_run(n_steps, save_every, block, check_every):
    """However the steps are cut into blocks (prime lengths, frames longer or shorter than a block), results and gradients are those
    of the run that stores everything, to 1e-12, and so are the frames' times.
    """
    (value, result), gradient = short_run(n_steps, save_every, js.Checkpointed(block), check_every)
    (expected, plain), stored = short_run(n_steps, save_every, js.StoreAll())
    assert float(value) == pytest.approx(float(expected), rel=1e-12)
    np.testing.assert_allclose(gradient, stored, rtol=1e-12)
    for got, wanted in zip(*(jax.tree.leaves((r.state, r.saved)) for r in (result, plain)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-12, atol=1e-13)
    assert float(result.state.time) == pytest.approx(0.05 * n_steps, rel=1e-14)
    if save_every:
        np.testing.assert_allclose(result.saved.time, 0.05 * save_every * np.arange(1, n_steps // save_every + 1), rtol=1e-14)
        np.testing.assert_array_equal(result.saved.position.x[-1], result.state.position.x)
    assert int(result.info.n_steps) == n_steps
    assert result.status.flags == 0
