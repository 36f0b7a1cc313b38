"""Normal modes and frequency response: against closed forms, SciPy, finite differences, and a rollout."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

import jaxspring as js
from jaxspring import modes
from tests.step_matrices import in_numpy

BODY = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.2, 1.1, 0.0], [0.4, 0.3, 0.9], [1.1, 1.2, 0.8]])
ISOSTATIC = [(i, j) for i in range(5) for j in range(i) if (i, j) != (4, 0)]  # nine springs hold five nodes


def chain(stiffness=5.0, mass=2.0, damping=()):
    """Five masses between two pins, at rest length."""
    net = js.lattice(7)
    system = js.System(net, mass, (js.Springs(net, stiffness, 1.0), *damping), free=np.array([False] + [True] * 5 + [False]))
    return system, js.State.from_points(net, net.grid())


def square(stiffness=1.0, squeeze=1.0, mass=1.0):
    """A 3 x 3 sheet in the plane without pins, whose symmetry makes eigenvalues coincide."""
    net = js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR)
    system = js.System(net, mass, js.Springs(net, stiffness, net.lengths(net.grid())))
    return system, js.State.from_points(net, squeeze * net.grid())


def sine(n=5):
    return np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1)))


def test_frequencies_of_a_chain():
    """Those of a chain between pins are 2 sqrt(k/m) sin(p pi / (2 (n + 1))); the shapes are sines, sum m phi^2 = 1, zero at the pins."""
    found = js.normal_modes(*chain())
    np.testing.assert_allclose(found.frequencies, 2 * np.sqrt(2.5) * sine(), rtol=1e-13)
    shapes = np.asarray(found.shapes[:, 1:-1, 0])
    np.testing.assert_allclose(2.0 * shapes @ shapes.T, np.eye(5), atol=1e-14)
    np.testing.assert_allclose(np.abs(shapes[0]), np.sin(np.arange(1, 6) * np.pi / 6) / np.sqrt(6), rtol=1e-12)
    np.testing.assert_array_equal(found.shapes[:, [0, -1]], 0)


def test_a_stretched_body_against_scipy():
    """Stretched, with a node and two coordinates held, and dampers: the modes of SciPy's eigh of K and M, written from the springs."""
    rng = np.random.default_rng(1)
    net, mass, k, l = js.Graph.from_edges(ISOSTATIC, 5), 1 + rng.random(5), 10 + rng.random(9), 0.8 * rng.random(9)
    free = np.ones((5, 3), bool)
    free[0], free[1, 1:] = False, False
    r = np.asarray(net.lengths(BODY))
    matrix = in_numpy(net, BODY, k * (1 - l / r), k * l / r, np.zeros(5)).toarray()[free.ravel()][:, free.ravel()]
    expected = scipy.linalg.eigh(matrix, np.diag(np.repeat(mass, 3)[free.ravel()]), eigvals_only=True)
    # Dampers on moving nodes depend on the position; velocities are left out, and so are they.
    moving = js.State.from_points(net, BODY, rng.normal(size=(5, 3)))
    found = js.normal_modes(js.System(net, mass, (js.Springs(net, k, l), js.Dashpots(net, 3.0)), free=free), moving)
    np.testing.assert_allclose(found.squared_frequencies, expected, rtol=1e-12)
    shapes = np.asarray(found.shapes).reshape(10, 15)[:, free.ravel()]
    np.testing.assert_allclose(shapes @ matrix @ shapes.T, np.diag(expected), atol=1e-11)
    np.testing.assert_array_equal(found.shapes[:, ~free], 0)


@pytest.mark.slow
def test_a_free_body_has_its_rigid_motions():
    """A free net has 3 zero modes in the plane and 6 in space, and the others are above; no NaN among the frequencies."""
    net = js.Graph.from_edges(ISOSTATIC, 5)
    body = js.System(net, 1.0, js.Springs(net, 10.0, net.lengths(BODY))), js.State.from_points(net, BODY)
    for scene, n_rigid in ((square(), 3), (body, 6)):
        found = js.normal_modes(*scene)
        np.testing.assert_allclose(found.squared_frequencies[:n_rigid], 0, atol=1e-13)
        assert found.squared_frequencies[n_rigid] > 0.1
        assert np.all(np.isfinite(found.frequencies))


def test_a_squeezed_spring_buckles():
    """A node between two squeezed springs has w^2 = 2 k (1 - l / r) / m < 0 sideways: reported as negative, never NaN."""
    net = js.lattice(3)
    system = js.System(net, 2.0, js.Springs(net, 5.0, 1.0), free=np.array([False, True, False]))
    found = js.normal_modes(system, js.State.from_points(net, [[0.0, 0.0], [0.8, 0.0], [1.6, 0.0]]))
    np.testing.assert_allclose(found.squared_frequencies, [-1.25, 5.0], rtol=1e-13)
    np.testing.assert_allclose(found.frequencies, [-np.sqrt(1.25), np.sqrt(5.0)], rtol=1e-13)
    np.testing.assert_allclose(np.abs(found.shapes[0, 1]), [0, 1 / np.sqrt(2)], atol=1e-14)


def test_derivatives_of_frequencies_that_stand_alone():
    """By the stiffness dw/dk = w / (2 k) and d2w/dk2 = -w / (4 k^2); by the mass dw/dm = -w / (2 m); the shape's is the difference."""
    w = 2 * np.sqrt(2.5) * sine()

    def of(k, m):
        return js.normal_modes(*chain(k, m), n_modes=5).frequencies

    by_k, by_m = jax.jit(jax.jacrev(of, argnums=(0, 1)))(5.0, 2.0)
    np.testing.assert_allclose(by_k, w / 10, rtol=1e-12)
    np.testing.assert_allclose(by_m, -w / 4, rtol=1e-12)
    np.testing.assert_allclose(jax.jit(jax.hessian(lambda k: of(k, 2.0)[1]))(5.0), -w[1] / 100, rtol=1e-10)

    def middle(k):
        return jnp.abs(js.normal_modes(*chain(jnp.full(6, 5.0).at[0].set(k))).shapes[1, 3, 0])

    slope = jax.jit(jax.vmap(jax.value_and_grad(middle)))(6.0 + 1e-4 * jnp.array([-1.0, 0.0, 1.0]))
    assert float(slope[1][1]) == pytest.approx(float(slope[0][2] - slope[0][0]) / 2e-4, rel=1e-6)


@pytest.mark.slow
def test_derivatives_where_eigenvalues_coincide():
    """On a symmetric sheet derivatives are finite, those of a pair add up to the difference of its sum, and only its shapes have NaN."""

    def squared(k):
        return js.normal_modes(*square(jnp.ones(20).at[0].set(k))).squared_frequencies

    values = np.asarray(squared(1.0))
    pair = np.flatnonzero((np.diff(values) < 1e-9) & (values[:-1] > 1e-9))[0]
    slopes = jax.jit(jax.jacrev(squared))(1.0)
    assert np.all(np.isfinite(slopes))
    near = jax.jit(jax.vmap(squared))(1.0 + 1e-5 * jnp.array([-1.0, 1.0]))
    sums = near[:, pair] + near[:, pair + 1]
    assert float(slopes[pair] + slopes[pair + 1]) == pytest.approx(float(sums[1] - sums[0]) / 2e-5, rel=1e-7)
    which = np.array([pair, 15])
    of_shapes = jax.jit(jax.jacrev(lambda k: jnp.sum(js.normal_modes(*square(k)).shapes[which] ** 4, axis=(1, 2))))(1.0)
    assert np.isnan(of_shapes[0])
    assert abs(of_shapes[1]) < 1e-12  # this one stands alone, and all stiffnesses together do not change its shape


def test_a_mode_returns_after_its_period():
    """A rollout from rest, displaced a little by the second shape, is back after 2 pi / w, and turned round after half of that."""
    system, start = chain()
    found = js.normal_modes(system, start, n_modes=2)
    moved = js.State.from_points(system.net, start.points + 1e-3 * found.shapes[1])
    period = 2 * np.pi / found.frequencies[1]
    run = js.rollout(system, moved, js.VelocityVerlet(), period / 400, 400, save_every=200)
    np.testing.assert_allclose(run.saved.points - start.points[None], 1e-3 * np.stack([-found.shapes[1], found.shapes[1]]), atol=1e-7)


def test_batches_and_masks_that_are_not_known():
    """`vmap` over stiffnesses scales the frequencies; with the system an argument of `jit`, modes beyond the free ones are infinite."""
    batch = jax.vmap(lambda k: js.normal_modes(*chain(k), n_modes=2).frequencies)(jnp.array([5.0, 20.0]))
    np.testing.assert_allclose(batch[1], 2 * batch[0], rtol=1e-13)
    found = eqx.filter_jit(js.normal_modes)(*chain())
    np.testing.assert_allclose(found.frequencies[:5], 2 * np.sqrt(2.5) * sine(), rtol=1e-13)
    np.testing.assert_array_equal(found.frequencies[5:], np.inf)
    np.testing.assert_array_equal(found.shapes[5:], 0)


@pytest.mark.parametrize("squeeze", [1.0, 0.8])
def test_large_systems_on_the_host(monkeypatch, squeeze):
    """The lowest modes by SciPy are those of the dense matrix, rigid and buckling ones too, and satisfy their equation."""
    mass = np.linspace(1.0, 3.0, 9)
    scene = square(np.linspace(1.0, 2.0, 20), squeeze, mass)
    dense = js.normal_modes(*scene)
    monkeypatch.setattr(modes, "LARGEST_DENSE", 10)
    found = js.normal_modes(*scene, n_modes=6)
    np.testing.assert_allclose(found.squared_frequencies, dense.squared_frequencies[:6], atol=1e-12)
    overlap = jnp.einsum("n,inj,knj->ik", mass, found.shapes, dense.shapes[:6])
    np.testing.assert_allclose(overlap @ overlap.T, np.eye(6), atol=1e-7)
    assert (squeeze == 1) == (float(found.squared_frequencies[0]) > -1e-9)


def test_large_systems_refuse(monkeypatch):
    """Without a number of modes, under a transformation, with a force that names no blocks, or for a response: an error that says why."""

    class Anchor(js.Force):
        def force(self, state):
            return -1.0 * state.position

    system, state = square()
    monkeypatch.setattr(modes, "LARGEST_DENSE", 10)
    with pytest.raises(ValueError, match="Pass n_modes"):
        js.normal_modes(system, state)
    with pytest.raises(ValueError, match="outside jit"):
        jax.grad(lambda k: js.normal_modes(*square(k), n_modes=2).frequencies[1])(jnp.ones(20))
    with pytest.raises(ValueError, match="stiffness blocks"):
        js.normal_modes(js.System(system.net, 1.0, (*system.forces, Anchor())), state, n_modes=2)
    with pytest.raises(ValueError, match="18 unknowns"):
        js.frequency_response(system, state, 1.0, np.zeros((9, 2)))


def test_wrong_arguments():
    """Too many modes, a dF/dx that is not symmetric, a load of another shape: each is refused by name; under jit there is NaN."""

    class Sideways(js.Force):
        def force(self, state):
            return js.Vector((state.position.y, 0.0 * state.position.x))

    system, state = chain()
    with pytest.raises(ValueError, match="n_modes = 6, but the system has 5 free"):
        js.normal_modes(system, state, n_modes=6)
    with pytest.raises(ValueError, match=r"force has shape \(5, 1\)"):
        js.frequency_response(system, state, 1.0, np.zeros((5, 1)))
    lone = js.lattice(1)
    strange, at = js.System(lone, 1.0, Sideways()), js.State.from_points(lone, [[0.0, 0.0]])
    with pytest.raises(ValueError, match="not symmetric"):
        js.normal_modes(strange, at)
    assert np.all(np.isnan(jax.jit(lambda: js.normal_modes(strange, at).frequencies)()))


def test_response_of_an_oscillator():
    """U = F / (k - m w^2 + i c w), so |U| = F / sqrt((k - m w^2)^2 + (c w)^2); its gradient by c and k is the closed form's."""
    net, w, load = js.lattice(2), np.array([0.5, 2.0, 7.0]), np.array([[0.0], [3.0 + 1.0j]])

    def amplitude(k, c):
        system = js.System(net, 2.0, (js.Springs(net, k, 1.0), js.Drag(c)), free=np.array([False, True]))
        return js.frequency_response(system, js.State.from_points(net, net.grid()), w, load)

    u = amplitude(8.0, 0.3)
    np.testing.assert_allclose(u[:, 1, 0], (3 + 1j) / (8 - 2 * w**2 + 0.3j * w), rtol=1e-13)
    np.testing.assert_array_equal(u[:, 0], 0)
    by_k, by_c = jax.jit(jax.jacrev(lambda k, c: jnp.abs(amplitude(k, c)[:, 1, 0]), argnums=(0, 1)))(8.0, 0.3)
    stiff = 8 - 2 * w**2
    size = np.sqrt(10.0) / (stiff**2 + (0.3 * w) ** 2) ** 1.5
    np.testing.assert_allclose(by_k, -size * stiff, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(by_c, -size * 0.3 * w**2, rtol=1e-11)


def test_response_is_a_sum_over_modes():
    """With Rayleigh damping U = sum of phi (phi . F) / (w_i^2 - w^2 + 2 i zeta_i w_i w), from the system's modes."""
    damping = js.Rayleigh(0.2, 0.05)
    system, state = chain(damping=(damping,))
    load = np.random.default_rng(2).normal(size=(7, 1))
    found = js.normal_modes(system, state)
    w0, phi = np.asarray(found.frequencies), np.asarray(found.shapes[:, :, 0])
    zeta = np.asarray(damping.damping_ratio(w0))
    expected = (phi @ load[:, 0] / (w0**2 - 1.3**2 + 2j * zeta * w0 * 1.3)) @ phi
    np.testing.assert_allclose(js.frequency_response(system, state, 1.3, load)[:, 0], expected, atol=1e-13)
