"""What must not change, and closed forms of chains, falls and elastic lattices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js


def oscillator(omega=1.0, drag=0.0):
    """One free mass of 1 kg on a spring without rest length to the origin: x'' = -omega^2 x - drag x'."""
    net = js.lattice(2)
    forces = (js.Springs(net, omega**2), js.Drag(drag)) if drag else js.Springs(net, omega**2)
    return net, js.System(net, 1.0, forces, free=np.array([False, True]))


def step_matrix(system, net, stepper, dt, n_nodes):
    """The linear map of one step on (x, v) of a chain in 1-D; `free` nodes only matter where the caller cuts them out."""

    def step(flat, dt):
        state = js.State.from_points(net, flat[:n_nodes, None], flat[n_nodes:, None])
        after, _ = stepper.step(system, state, dt, stepper.init(system, state))
        return jnp.concatenate([after.points[:, 0], after.velocities[:, 0]])

    return np.asarray(jax.jit(jax.jacfwd(step))(jnp.zeros(2 * n_nodes), jnp.asarray(dt)))


def test_symplectic_euler_keeps_its_own_energy():
    """Kick and drift keep (v^2 + w^2 x^2 - w^2 dt v x) / 2 to round-off at w dt = 1.5, while the true energy swings by 7."""
    net, system = oscillator()
    state = js.State.from_points(net, [[0.0], [1.0]], [[0.0], [2.0]])
    # Compiled by hand, so that nothing warns: the limit is 2, but the bound that stable_dt takes says 1.41.
    saved = jax.jit(lambda dt: js.rollout(system, state, js.SymplecticEuler(), dt, n_steps=2000, save_every=1).saved)(1.5)
    x, v = np.asarray(saved.points)[:, 1, 0], np.asarray(saved.velocities)[:, 1, 0]
    shadow = 0.5 * (v**2 + x**2 - 1.5 * v * x)
    true = 0.5 * (v**2 + x**2)
    assert np.ptp(shadow) / abs(shadow.mean()) < 1e-13  # 9e-15 in another implementation
    assert true.max() / true.min() > 5


def test_frequency_of_symplectic_euler():
    """The numerical frequency obeys sin(w' dt / 2) = w dt / 2 exactly."""
    net, system = oscillator()
    matrix = step_matrix(system, net, js.SymplecticEuler(), 0.5, 2)[np.ix_([1, 3], [1, 3])]
    angle = np.abs(np.angle(np.linalg.eigvals(matrix)[0]))
    assert np.sin(angle / 2) == pytest.approx(0.25, rel=1e-12)


@pytest.mark.parametrize(("c", "omega", "dt"), [(0.5, 1.0, 0.3), (0.5, 3.0, 0.3), (2.0, 2.0, 0.1)])
def test_lagged_drag_shrinks_by_an_exact_factor(c, omega, dt):
    """With lagged drag both eigenvalues of a step have modulus sqrt(1 - c dt), whatever the frequency."""
    net, system = oscillator(omega, c)
    matrix = step_matrix(system, net, js.SymplecticEuler(), dt, 2)[np.ix_([1, 3], [1, 3])]
    np.testing.assert_allclose(np.abs(np.linalg.eigvals(matrix)), np.sqrt(1 - c * dt), rtol=1e-13)


@pytest.mark.parametrize(("c", "dt_max"), [(0.0, 2.0), (0.5, 1.56155), (2.0, 0.82843)])
def test_explicit_drag_lowers_the_stable_step(c, dt_max):
    """At 0.999 of dt = (-c + sqrt(c^2 + 4 w^2)) / w^2 a run stays bounded, at 1.001 it blows up; stable_dt is not above."""
    net, system = oscillator(1.0, c)
    state = js.State.from_points(net, [[0.0], [1.0]])

    @jax.jit
    def largest(dt):
        return jnp.max(jnp.abs(js.rollout(system, state, js.SymplecticEuler(), dt, n_steps=20_000).state.points))

    assert largest(0.999 * dt_max) < 100
    assert not largest(1.001 * dt_max) < 1e3
    assert js.stable_dt(system, state) <= dt_max * 1.0001


@pytest.mark.parametrize("c", [0.0, 0.3, 3.0])
@pytest.mark.parametrize(
    "stepper", [js.ForwardEuler(), js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()], ids=lambda s: type(s).__name__
)
def test_stable_dt_is_stable(stepper, c, rng):
    """At stable_dt no eigenvalue of a step of a chain with random stiffness lies outside the unit circle."""
    n = 6
    net = js.lattice(n)
    system = js.System(net, rng.uniform(1, 3, n), (js.Springs(net, rng.uniform(1, 9, n - 1)), js.Drag(c)), free=np.arange(n) > 0)
    state = js.State.from_points(net, np.zeros((n, 1)))
    dt = float(js.stable_dt(system, state, stepper))
    if isinstance(stepper, js.ForwardEuler) and c == 0:
        assert dt == 0
        return
    assert 0 < dt < 10
    free = [*range(1, n), *range(n + 1, 2 * n)]
    # Verlet carries the acceleration of its predictor: from a fresh start one step is the same map, as forces are linear in v.
    radius = np.abs(np.linalg.eigvals(step_matrix(system, net, stepper, dt, n)[np.ix_(free, free)])).max()
    assert radius <= 1 + 1e-9


def test_frequencies_of_a_chain():
    """N free masses between fixed ends, springs at rest: w_p = 2 sqrt(k/m) sin(p pi / (2 (N + 1)))."""
    n, k, m = 12, 7.0, 0.3
    net = js.lattice(n + 2)
    springs = js.Springs(net, k, 1.0)
    points = jnp.arange(n + 2.0)
    hessian = jax.jit(jax.hessian(lambda x: springs.energy(js.State.from_points(net, x[:, None]))))(points)
    found = np.sqrt(np.linalg.eigvalsh(np.asarray(hessian)[1:-1, 1:-1] / m))
    np.testing.assert_allclose(found, 2 * np.sqrt(k / m) * np.sin(np.arange(1, n + 1) * np.pi / (2 * (n + 1))), rtol=1e-12)


def test_free_fall_with_drag():
    """Speed (m g / gamma) (1 - exp(-gamma t / m)); RK4 at dt = 0.01 s."""
    net = js.lattice(1)
    system = js.System(net, 2.0, (js.Gravity([0.0, -9.81]), js.Drag(0.5)))
    state = js.rollout(system, js.State.from_points(net, [[0.0, 0.0]]), js.RungeKutta4(), dt=0.01, n_steps=300).state
    assert float(state.velocities[0, 1]) == pytest.approx(-2 * 9.81 / 0.5 * (1 - np.exp(-0.25 * 3)), rel=1e-9)


def test_hanging_chain():
    """N = 10, m = 0.1 kg, k = 100 N/m: in balance where the spring that carries n masses is n m g / k longer, 0.53955 m in all."""
    n, m, k, g, l = 10, 0.1, 100.0, 9.81, 0.2
    stretch = np.arange(n, 0, -1) * m * g / k
    assert stretch.sum() == pytest.approx(0.53955, abs=1e-5)
    net = js.lattice(n + 1)
    y = -np.concatenate([[0.0], np.cumsum(l + stretch)])
    system = js.System(net, m, (js.Springs(net, k, l), js.Gravity([0.0, -g])), free=np.arange(n + 1) > 0)
    state = js.State.from_points(net, np.stack([np.zeros(n + 1), y], axis=-1))
    np.testing.assert_allclose(np.stack(list(system.acceleration(state))), 0, atol=1e-12)
    assert float(system.reaction(state).y[0]) == pytest.approx((n + 1) * m * g, rel=1e-12)


def moduli(net, points, stiffness, volume):
    """Elastic constants: second differences of the energy per volume in the strains (xx, yy, xy engineering) or (xx, yy, zz, yz)."""
    dim = points.shape[1]
    lengths = np.asarray(net.lengths(points))
    springs = js.Springs(net, stiffness, lengths)
    places = [(0, 0), (1, 1), (0, 1)] if dim == 2 else [(0, 0), (1, 1), (2, 2), (1, 2)]

    @jax.jit
    def energy(strain):
        f = jnp.eye(dim)
        for e, (i, j) in zip(strain, places, strict=True):
            f = f.at[i, j].add(e)
        return springs.energy(js.State.from_points(net, jnp.asarray(points) @ f.T))

    h, axes = 1e-3, np.eye(len(places))
    signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
    second = [[sum(s * t * float(energy(h * (s * a + t * b))) for s, t in signs) / (4 * h**2) for b in axes] for a in axes]
    return np.array(second) / volume


def per_cell(net, points, constants):
    """Stiffness per spring so that each direction weighs as its springs per cell: (direction's k) / (its number of springs)."""
    d = np.round(points[net.edges[:, 1]] - points[net.edges[:, 0]], 9)
    _, kind, count = np.unique(d, axis=0, return_inverse=True, return_counts=True)
    length = np.linalg.norm(d, axis=1)
    return np.array([constants[round(float(r), 3)] for r in length]) / count[kind.ravel()]


def test_moduli_of_a_square_lattice():
    """Structural k1 and both diagonals k2: C11 = k1 + k2, C12 = C44 = k2; the spacing does not matter."""
    h, k1, k2 = 0.5, 3.0, 1.25
    net = js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR)
    points = net.grid(h)
    c = moduli(net, points, per_cell(net, points, {h: k1, round(h * 2**0.5, 3): k2}), h**2)
    np.testing.assert_allclose([c[0, 0], c[1, 1], c[0, 1], c[2, 2]], [k1 + k2, k1 + k2, k2, k2], rtol=1e-5)


def test_moduli_of_a_triangular_lattice():
    """K = sqrt(3)/2 k and G = sqrt(3)/4 k, so C11 = K + G and C12 = K - G."""
    points = np.array([(i + 0.5 * (j % 2), j * 3**0.5 / 2) for j in range(3) for i in range(3)])
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    edges = np.argwhere(np.triu(np.abs(distance - 1) < 1e-9))
    d = points[edges[:, 1]] - points[edges[:, 0]]
    edges = np.where((d[:, 1] < -1e-9)[:, None], edges[:, ::-1], edges)
    net = js.Graph.from_edges(edges, len(points))
    c = moduli(net, points, per_cell(net, points, {1.0: 2.0}), 3**0.5 / 2)
    bulk, shear = 3**0.5 / 2 * 2, 3**0.5 / 4 * 2
    np.testing.assert_allclose([c[0, 0], c[0, 1], c[2, 2]], [bulk + shear, bulk - shear, shear], rtol=1e-5)


def test_moduli_of_a_cubic_lattice():
    """Structural k1 and face diagonals k2: C11 = (k1 + 2 k2) / h, C12 = C44 = k2 / h."""
    h, k1, k2 = 0.5, 3.0, 1.25
    net = js.lattice((2, 2, 2), springs=js.STRUCTURAL + js.SHEAR)
    points = net.grid(h)
    c = moduli(net, points, per_cell(net, points, {h: k1, round(h * 2**0.5, 3): k2}), h**3)
    expected = np.array([k1 + 2 * k2, k2, k2]) / h
    np.testing.assert_allclose([c[0, 0], c[0, 1], c[3, 3]], expected, rtol=1e-5)


@pytest.fixture(scope="module")
def free_run():
    """A free net with dashpots for 500 Verlet steps, and the same without."""
    rng = np.random.default_rng(1)
    net = js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR)
    state = js.State.from_points(net, net.grid() + 0.1 * rng.normal(size=(12, 2)), rng.normal(size=(12, 2)))
    mass = rng.uniform(1, 2, 12)
    undamped = js.System(net, mass, js.Springs(net, 20.0, 0.9))
    damped = js.System(net, mass, (js.Springs(net, 20.0, 0.9), js.Dashpots(net, 0.5)))
    return [(s, state, js.rollout(s, state, js.VelocityVerlet(), dt=5e-3, n_steps=500, save_every=50).saved) for s in (undamped, damped)]


def test_momentum_is_kept(free_run):
    """Momentum drifts by round-off only, with and without dashpots; angular momentum too where nothing depends on velocity."""
    for system, state, saved in free_run:
        p = np.asarray(jax.vmap(system.momentum)(saved))
        np.testing.assert_allclose(p, np.broadcast_to(system.momentum(state), p.shape), atol=2e-13)
    system, state, saved = free_run[0]
    spin = np.asarray(jax.vmap(system.angular_momentum)(saved))
    np.testing.assert_allclose(spin, np.broadcast_to(system.angular_momentum(state), spin.shape), atol=1e-12)


def test_energy_is_kept_without_damping_and_lost_with_it(free_run):
    """Verlet keeps the energy within 1e-3 of it; with dashpots it falls from frame to frame."""
    for is_damped, (system, state, saved) in enumerate(free_run):
        energy = np.asarray(jax.vmap(lambda s, system=system: system.energy(s).total)(saved))
        start = float(system.energy(state).total)
        if is_damped:
            assert (np.diff(np.concatenate([[start], energy])) < 0).all()
        else:
            np.testing.assert_allclose(energy, start, rtol=1e-3)
