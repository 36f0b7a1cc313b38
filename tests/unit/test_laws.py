"""Laws of one spring: closed forms, derivatives against differences, guards at length zero, outputs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests import reference

K, L = 3.0, 0.8
LAWS = {
    "hooke": (js.Hooke(), lambda r: K * (r - L)),
    "tension only": (js.TensionOnly(), lambda r: K * np.maximum(r - L, 0)),
    "power 3": (js.PowerLaw(), lambda r: K * L * np.sign(r - L) * (np.abs(r - L) / L) ** 3),
    "power 1.5": (js.PowerLaw(1.5), lambda r: K * L * np.sign(r - L) * (np.abs(r - L) / L) ** 1.5),
    "energy": (js.EnergyLaw(lambda r, k, l: k * (r - l) ** 4), lambda r: 4 * K * (r - L) ** 3),
    "pull": (js.PullLaw(lambda r, k, l: k * jnp.tanh(r - l)), lambda r: K * np.tanh(r - L)),
}
each_law = pytest.mark.parametrize(("law", "pull"), LAWS.values(), ids=LAWS.keys())


class Stiffening(js.Law):
    """A law with a trainable array of its own: pull k (e + b e^3), e = r - l."""

    b: jax.Array

    def weight(self, squared_length, stiffness, rest_length):
        length = jnp.sqrt(squared_length)
        stretch = length - rest_length
        return stiffness * (stretch + self.b * stretch**3) / length

    def energy(self, squared_length, stiffness, rest_length):
        stretch = jnp.sqrt(squared_length) - rest_length
        return stiffness * (0.5 * stretch**2 + 0.25 * self.b * stretch**4)


def pair(separation):
    """One spring along x between the origin and `separation`; 3 coordinates."""
    net = js.lattice(2)
    return net, js.State.from_points(net, [[0.0, 0.0, 0.0], [separation, 0.0, 0.0]])


def cloud(rng, dim=3):
    """A sheet of springs in general position, none near its rest length 0.8."""
    net = js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR)
    points = np.zeros((9, dim))
    points[:, :2] = net.grid()
    return net, js.State.from_points(net, points + 0.2 * rng.normal(size=points.shape))


def flat_force(springs, net, points):
    return jnp.stack([net.flatten_nodes(a) for a in springs.force(js.State.from_points(net, points))], axis=-1)


@each_law
@pytest.mark.parametrize("r", [0.3, 0.8, 1.0, 2.5])
def test_pull_is_the_closed_form(law, pull, r):
    """The tail is pulled along the spring by the law's pull, the head by its opposite; tension says the same number."""
    net, state = pair(r)
    springs = js.Springs(net, K, L, law=law)
    force = springs.force(state)
    np.testing.assert_allclose(force.x, [pull(r), -pull(r)], rtol=1e-13, atol=1e-14)
    np.testing.assert_array_equal(jnp.stack([force.y, force.z]), 0)
    np.testing.assert_allclose(net.flatten(springs.tension(state)), [pull(r)], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(net.flatten(springs.strain(state)), [r / L - 1], rtol=1e-13, atol=1e-15)


@each_law
def test_force_is_minus_the_gradient_of_the_energy(law, pull, rng):
    """The force equals minus the energy's gradient, by autodiff and by central differences; a PullLaw has no energy."""
    net, state = cloud(rng)
    springs = js.Springs(net, K, L, law=law)
    if isinstance(law, js.PullLaw):
        assert springs.energy(state) is None
        return

    @jax.jit
    def energy(points):
        return springs.energy(js.State.from_points(net, points))

    force = flat_force(springs, net, state.points)
    np.testing.assert_allclose(jax.grad(energy)(state.points), -force, atol=1e-13)
    for node, axis in ((0, 0), (4, 1), (8, 2)):
        # Of fourth order, so that h is large enough for the energy's rounding to be divided by little.
        f = [float(energy(state.points.at[node, axis].add(m * 1e-4))) for m in (-2, -1, 1, 2)]
        assert (8 * (f[2] - f[1]) - (f[3] - f[0])) / 12e-4 == pytest.approx(float(-force[node, axis]), abs=2e-9)


@each_law
def test_jacobian_and_constants_against_differences(law, pull, rng):
    """Derivatives of the force by position, k and l agree with central differences, in forward and in reverse mode."""
    net, state = cloud(rng)
    k, l = jnp.asarray(rng.uniform(1, 2, net.n_springs)), jnp.full(net.n_springs, L)
    seed = jnp.asarray(rng.normal(size=(9, 3)))

    @jax.jit
    def work(points, k, l):
        return jnp.sum(seed * flat_force(js.Springs(net, k, l, law=law), net, points))

    args = (state.points, k, l)
    directions = tuple(jnp.asarray(rng.normal(size=a.shape)) for a in args)
    gradient = jax.jit(jax.grad(work, argnums=(0, 1, 2)))(*args)
    forward = jax.jit(lambda args, along: jax.jvp(work, args, along)[1])
    h = 1e-6
    for i, direction in enumerate(directions):
        one = [jnp.zeros_like(d) if j != i else d for j, d in enumerate(directions)]
        plus, minus = (work(*(a + s * h * d for a, d in zip(args, one, strict=True))) for s in (1, -1))
        expected = (plus - minus) / (2 * h)
        assert float(jnp.vdot(gradient[i], direction)) == pytest.approx(float(expected), rel=2e-8)
        assert float(forward(args, tuple(one))) == pytest.approx(float(expected), rel=2e-8)


def test_hessian_is_the_block_of_baraff_and_witkin(rng):
    """One Hooke spring: K = k [u u' + (1 - l/r)(I - u u')] on the diagonal, -K off it."""
    net = js.lattice(2)
    points = jnp.asarray(rng.normal(size=(2, 3)))
    springs = js.Springs(net, K, L)
    hessian = jax.jit(jax.hessian(lambda x: springs.energy(js.State.from_points(net, x))))(points)
    d = np.asarray(points[1] - points[0])
    r = np.linalg.norm(d)
    uu = np.outer(d, d) / r**2
    block = K * (uu + (1 - L / r) * (np.eye(3) - uu))
    np.testing.assert_allclose(hessian[0, :, 0, :], block, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(hessian[0, :, 1, :], -block, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize(
    "net",
    [js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR), js.Graph.from_edges([(0, 1), (1, 2), (4, 8), (8, 0)], 9)],
    ids=["sheet", "graph"],
)
def test_hooke_against_numpy(net, rng):
    """The net's force is the slides' formula, one spring after the other, with constants per spring."""
    points = rng.normal(size=(9, 3))
    k, l = rng.uniform(1, 2, net.n_springs), rng.uniform(0, 1, net.n_springs)
    expected = reference.spring_forces(points, net.edges, k, l)
    np.testing.assert_allclose(flat_force(js.Springs(net, k, l), net, points), expected, atol=1e-13)


def test_coincident_without_rest_length():
    """Ends at one place, l = 0: force 0, and the stiffness is k I in both modes."""
    net, state = pair(0.0)
    springs = js.Springs(net, 100.0, 0.0)
    np.testing.assert_array_equal(flat_force(springs, net, state.points), 0)
    for jacobian in (jax.jacfwd, jax.jacrev):
        found = jacobian(lambda x: flat_force(springs, net, x))(state.points)
        np.testing.assert_array_equal(found[0, :, 1, :], 100 * np.eye(3))


@pytest.mark.parametrize("law", [js.Hooke(), js.TensionOnly(), js.PowerLaw(), js.PowerLaw(1.0)])
def test_coincident_with_rest_length(law):
    """Ends at one place, l > 0: force 0, and first and second derivatives are finite."""
    net, state = pair(0.0)

    def energy(points, k, l):
        return js.Springs(net, k, l, law=law).energy(js.State.from_points(net, points))

    k, l = jnp.asarray(100.0), jnp.asarray(1.0)
    np.testing.assert_array_equal(flat_force(js.Springs(net, k, l, law=law), net, state.points), 0)
    assert all(np.isfinite(g).all() for g in jax.grad(energy, argnums=(0, 1, 2))(state.points, k, l))
    assert np.isfinite(jax.hessian(energy)(state.points, k, l)).all()


@pytest.mark.parametrize(("dtype", "separation"), [("float32", 1e-10), ("float32", 1e-15), ("float64", 1e-100)])
def test_tiny_separations(dtype, separation):
    """Ends 1e-10 apart with l = 1, k = 100 push apart with 100 N along the spring."""
    net = js.lattice(2)
    state = js.State.from_points(net, np.array([[0, 0], [separation, 0]], dtype))
    force = js.Springs(net, 100.0, 1.0).force(state)
    assert force.x[0] == pytest.approx(-100, abs=1e-4)
    assert force.dtype == dtype


def test_at_rest_length_the_energy_has_zero_derivatives():
    """At rest dE/dk = dE/dl = 0 exactly, and with k = 0 nothing is NaN."""
    net, state = pair(1.0)
    for law in (js.Hooke(), js.TensionOnly(), js.PowerLaw()):
        for k in (0.0, 5.0):
            energy = jax.jit(jax.grad(lambda k, l, law=law: js.Springs(net, k, l, law=law).energy(state), argnums=(0, 1)))
            np.testing.assert_array_equal(energy(jnp.asarray(k), jnp.asarray(1.0)), 0)


def test_a_law_with_an_array_of_its_own(rng):
    """The gradient with respect to a user's law's own constant is that of central differences, in both modes, and batched."""
    net, state = cloud(rng)
    seed = jnp.asarray(rng.normal(size=(9, 3)))

    @jax.jit
    def work(b):
        return jnp.sum(seed * flat_force(js.Springs(net, K, L, law=Stiffening(b)), net, state.points))

    b = jnp.asarray(0.7)
    expected = reference.central_difference(work, b, 1e-4)
    assert float(jax.grad(work)(b)) == pytest.approx(expected, rel=1e-9)
    assert float(jax.jvp(work, (b,), (jnp.ones(()),))[1]) == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(jax.vmap(jax.grad(work))(jnp.stack([b, 2 * b]))[0], jax.grad(work)(b), rtol=1e-13)


def test_a_law_that_is_infinite_at_length_zero(rng):
    """A Lennard-Jones energy on a lattice: force and gradient by l are finite and those of NumPy and of differences."""
    net, state = cloud(rng)
    law = js.EnergyLaw(lambda r, k, l: k * ((l / r) ** 12 - 2 * (l / r) ** 6))

    @jax.jit
    def energy(points, l):
        return js.Springs(net, K, l, law=law).energy(js.State.from_points(net, points))

    def in_numpy(l):
        ratio = l / np.linalg.norm(np.diff(np.asarray(state.points)[net.edges], axis=1)[:, 0], axis=-1)
        return (K * (ratio**12 - 2 * ratio**6)).sum()

    l = jnp.asarray(0.8)
    assert float(energy(state.points, l)) == pytest.approx(in_numpy(0.8), rel=1e-12)
    by_points, by_length = jax.jit(jax.grad(energy, argnums=(0, 1)))(state.points, l)
    assert float(by_length) == pytest.approx(reference.central_difference(in_numpy, 0.8, 1e-6), rel=1e-7)
    np.testing.assert_allclose(flat_force(js.Springs(net, K, l, law=law), net, state.points), -by_points, rtol=1e-10)


def test_gradient_of_a_whole_system_reaches_the_law(rng):
    """eqx.filter_grad with respect to a system gives the law's array its gradient, k sum (r - l)^4 / 4."""
    net, state = cloud(rng)
    system = js.System(net, 1.0, js.Springs(net, K, L, law=Stiffening(jnp.asarray(0.7))))
    found = eqx.filter_grad(lambda s: s.energy(state).total)(system)
    stretch = np.asarray(net.lengths(state.points)) - L
    assert float(found.forces[0].law.b) == pytest.approx(K * (stretch**4).sum() / 4, rel=1e-12)


def test_springs_in_the_plane(rng):
    """Springs with axes=(0, 1) are those of the projection, and pull nothing along z."""
    net, state = cloud(rng)
    flat = js.State.from_points(net, state.points[:, :2])
    force = js.Springs(net, K, L, axes=(0, 1)).force(state)
    for got, expected in zip((force.x, force.y), js.Springs(net, K, L).force(flat), strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(force.z, 0)


@pytest.mark.parametrize("turn", [np.pi / 2, np.pi / 4, None])
def test_forces_turn_with_the_net(turn, rng):
    """Rotating (90, 45 degrees) or reflecting the net turns the forces with it."""
    net, state = cloud(rng, dim=2)
    q = np.diag([1.0, -1.0]) if turn is None else np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    springs = js.Springs(net, K, L)
    straight = np.asarray(flat_force(springs, net, state.points))
    np.testing.assert_allclose(flat_force(springs, net, np.asarray(state.points) @ q.T), straight @ q.T, atol=4e-15 * K * 8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda net: js.Springs(net, [1.0, -2.0]), r"stiffness\[1\] = -2.0"),
        (lambda net: js.Springs(net, 1.0, [0.0, np.nan]), r"rest_length\[1\] = nan"),
        (lambda net: js.Springs(net, 1.0, -1.0), "rest_length = -1.0"),
        (lambda net: js.Springs(net, np.ones(5)), "one per spring"),
        (lambda net: js.PowerLaw(0.5), "exponent = 0.5"),
    ],
)
def test_wrong_constants_are_refused(make, message):
    """Each wrong constant is a ValueError naming field and index."""
    with pytest.raises(ValueError, match=message):
        make(js.lattice(3))


def test_a_power_law_without_rest_length_is_refused():
    """The power law divides by the rest length: zero is refused when the springs are made."""
    with pytest.raises(ValueError, match="rest_length"):
        js.Springs(js.lattice(3), 1.0, 0.0, law=js.PowerLaw())
