"""Derivatives of static shapes: implicit, against central differences and forward mode, where springs are squeezed too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

EXACT = js.linalg.ExactSolver(js.CG(tolerance=1e-13))


def arch():
    """An arch of 9 nodes, clamped at both feet and pressed down: squeezed springs, an indefinite part in every block, a stable whole.

    Clamped, because an arch on two pins ends standing or hanging as rounding decides.
    """
    net = js.lattice(9, js.STRUCTURAL + js.BEND)
    x = np.linspace(-1, 1, 9)
    points = np.stack([x, 1 - x * x], axis=1)
    rest = net.lengths(points)
    free = np.ones(9, bool)
    free[[0, 1, -2, -1]] = False
    system = js.System(net, 0.3, (js.Springs(net, 60.0, rest), js.Gravity([0.981, -9.81])), free=free)
    return system, net, points, rest


def height(parameters):
    """Mean height and a lean of the arch, as a function of stiffness, rest lengths, gravity, and the places of the pins."""
    system, net, points, rest = arch()
    k, stretch, g, pin = parameters
    changed = js.replace(system, stiffness=k, rest_length=rest * stretch, acceleration=jnp.stack([0.1 * g, -g]))
    start = js.State.from_points(net, jnp.asarray(points).at[0, 0].add(pin))
    found = js.equilibrium(changed, start, tolerance=1e-14, adjoint=EXACT)
    return jnp.mean(found.state.position.y) + 0.3 * found.state.position.x[3]


AT = jnp.asarray([60.0, 1.0, 9.81, 0.02])


@pytest.fixture(scope="module")
def value():
    """The function and its reverse-mode gradient, compiled once."""
    return jax.jit(jax.value_and_grad(height))


@pytest.mark.slow
def test_springs_are_squeezed():
    """The case is the hard one: with the clamped tangent in the derivative it would be wrong."""
    system, net, points, _ = arch()
    found = js.equilibrium(system, js.State.from_points(net, points))
    assert bool(found.status.is_ok)
    assert np.min(net.flatten(system.forces[0].strain(found.state))) < -0.1


@pytest.mark.slow
def test_reverse_forward_and_differences_agree(value):
    """By stiffness, rest length, gravity and the place of a pin: central differences to 1e-8, forward mode to 1e-10."""
    _, reverse = value(AT)
    forward = jax.jit(lambda at, along: jax.jvp(height, (at,), (along,))[1])
    for i, h in enumerate([1e-2, 1e-4, 1e-3, 1e-4]):
        along = jnp.zeros(4).at[i].set(1.0)
        f = [float(value(AT + m * h * along)[0]) for m in (-2, -1, 1, 2)]
        differences = (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * h)
        assert float(reverse[i]) == pytest.approx(differences, rel=1e-8)
        assert float(forward(AT, along)) == pytest.approx(float(reverse[i]), rel=1e-10)


@pytest.mark.slow
def test_hessian_vector_products(value):
    """Forward over reverse agrees with differences of the gradient to 1e-7."""
    along = jnp.asarray([3.0, 0.02, 0.5, 0.01])
    product = jax.jit(lambda at: jax.jvp(jax.grad(height), (at,), (along,))[1])(AT)
    h = 1e-3
    g = [np.asarray(value(AT + m * h * along)[1]) for m in (-2, -1, 1, 2)]
    np.testing.assert_allclose(product, (8 * (g[2] - g[1]) - (g[3] - g[0])) / (12 * h), rtol=1e-7, atol=1e-7 * np.max(np.abs(product)))


@pytest.mark.slow
def test_where_free_nodes_start_does_not_matter():
    """The derivative by the starting points is exactly zero where free; by a held coordinate it is not."""
    system, net, points, _ = arch()

    def mean(points):
        return jnp.mean(js.equilibrium(system, js.State.from_points(net, points)).state.position.y)

    gradient = np.asarray(jax.jit(jax.grad(mean))(jnp.asarray(points)))
    assert not np.any(gradient[2:-2])
    assert np.all(np.abs(gradient[[0, 1, -2, -1]]) > 1e-3)


@pytest.mark.slow
def test_a_shape_that_was_not_found_has_no_gradient():
    """Stopped after one step, or a mechanism: NaN, not some number."""
    system, net, points, _ = arch()
    start = js.State.from_points(net, points)

    def stopped(k):
        found = js.equilibrium(js.replace(system, stiffness=k), start, max_iter=1)
        return jnp.sum(found.state.position.y)

    assert np.isnan(jax.grad(stopped)(60.0))


@pytest.mark.slow
def test_forces_that_are_not_symmetric():
    """A node on springs, pulled in z alone toward an image: dz/dk = 0, and dx by the load is the spring's, by BiCGStab."""
    net = js.lattice(2)
    image = js.Image(np.add.outer(np.arange(4.0) ** 2, 2.0 * np.arange(4.0)), spacing=1.0)
    start = js.State.from_points(net, [[0.5, 1.0, 0.0], [1.2, 1.4, 0.0]])

    def place(k, pull):
        load = js.Load(js.Vector((jnp.stack([jnp.zeros_like(pull), pull]), jnp.zeros(2), jnp.zeros(2))))
        forces = (js.Springs(net, k, 0.0, axes=(0, 1)), js.DataSprings(image, 3.0), load)
        found = js.equilibrium(js.System(net, 1.0, forces, free=np.array([[0, 0, 1], [1, 1, 1]], bool)), start, adjoint=EXACT)
        return found.state.position.x[1], found.state.position.z[1]

    (x, z), derivative = jax.jit(lambda k, p: (place(k, p), jax.jacrev(place, argnums=(0, 1))(k, p)))(2.0, 1.0)
    assert float(x) == pytest.approx(0.5 + 1 / 2)
    assert float(derivative[0][0]) == pytest.approx(-1 / 4, rel=1e-8)
    assert float(derivative[0][1]) == pytest.approx(1 / 2, rel=1e-8)
    slope = float(jax.grad(image.sample)(x, 1.0))
    assert float(z) == pytest.approx(float(image.sample(x, 1.0)), rel=1e-9)
    assert float(derivative[1][1]) == pytest.approx(slope / 2, rel=1e-8)
