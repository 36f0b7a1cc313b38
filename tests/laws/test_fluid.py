"""The particle fluid: closed forms of its pair laws, what it keeps, and what happens as particles become many."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxspring as js
from tests.particles import blob, components, make, slide_force

LAWS = [js.fluid.SlideLaw(1.0, 1.3, 0.1), js.fluid.UnitVectorLaw(1.0, 1.3, 0.1), js.fluid.LennardJones(0.7, 0.9)]
CUTOFFS = [js.fluid.NoCutoff(), js.fluid.PlainCutoff(2.3), js.fluid.ShiftedForce(2.3), js.fluid.Switched(1.6, 2.3)]
by_name = {"ids": lambda option: type(option).__name__}


# zeta, r_0, k_0, frequency at alpha = beta = m = 1: the closed forms, to the digits shown.
@pytest.mark.parametrize(
    ("zeta", "distance", "stiffness", "frequency"),
    [
        (0.0, 1.0, 2.0, 2.0),
        (0.05, 1.047723, 1.73536, 1.86299),
        (0.1, 1.091608, 1.52672, 1.74741),
        (0.5, 1.366025, 0.72828, 1.20688),
        (1.0, 1.618034, 0.40325, 0.89806),
    ],
)
def test_rest_and_frequency_of_a_pair(zeta, distance, stiffness, frequency):
    """r_0 = (s + sqrt(s^2 + 4 s zeta)) / 2 and k_0 = r_0 (4 beta / r_0^5 - 2 alpha / (r_0 + zeta)^3), to the last digit."""
    law = js.fluid.SlideLaw(1.0, 1.0, zeta)
    assert float(law.equilibrium_distance) == pytest.approx(distance, abs=1e-6)
    assert float(law.contact_stiffness) == pytest.approx(stiffness, abs=6e-6)
    assert float(jnp.sqrt(2 * law.contact_stiffness)) == pytest.approx(frequency, abs=6e-6)


@pytest.mark.parametrize("exponents", [(1, 3), (1, 4), (2, 5), (3, 5)])
@pytest.mark.parametrize("kind", [js.fluid.SlideLaw, js.fluid.UnitVectorLaw])
def test_other_exponents(kind, exponents):
    """For all exponents the force is zero at the equilibrium distance and minus the derivative of the potential everywhere."""
    law = kind(1.0, 2.0, 0.3, *exponents)
    r = law.equilibrium_distance
    assert float(law.weight(r * r)) == pytest.approx(0, abs=1e-14)
    at = jnp.linspace(0.5, 3.0, 7)
    slope = jax.vmap(jax.grad(lambda r: law.potential(r * r)))(at)
    np.testing.assert_allclose(-slope, law.weight(at * at) * at, rtol=1e-12)


def test_the_equilibrium_distance_can_be_differentiated():
    """With zeta = 0, r_0 = (beta / alpha)^(1/(b-a)); else Newton's method finds r_0, and beta (r + zeta)^2 = alpha r^5 holds along it."""
    slope = jax.grad(lambda zeta, beta: js.fluid.SlideLaw(1.0, beta, zeta, a=2, b=5).equilibrium_distance, argnums=(0, 1))
    assert float(slope(0.0, 2.0)[1]) == pytest.approx(2.0 ** (1 / 3 - 1) / 3, rel=1e-12)
    r = float(js.fluid.SlideLaw(1.0, 2.0, 0.3, a=2, b=5).equilibrium_distance)
    assert 2 * (r + 0.3) ** 2 == pytest.approx(r**5, rel=1e-12)
    stiff = 5 * r**4 - 4 * (r + 0.3)
    np.testing.assert_allclose(slope(0.3, 2.0), [4 * (r + 0.3) / stiff, (r + 0.3) ** 2 / stiff], rtol=1e-12)


def test_gentle_fluid_rests_at_the_spacing():
    """beta = alpha h^4 / (h + zeta)^2 puts r_0 at h: a particle freed beside its neighbour feels nothing."""
    law = js.fluid.gentle_fluid(spacing=0.37, zeta=0.05, alpha=2.5)
    assert float(law.equilibrium_distance) == pytest.approx(0.37, rel=1e-14)
    assert float(law.alpha) == 2.5


def test_shifted_force_moves_the_pair_apart():
    """At c = 2.5 and alpha = beta = 1, zeta = 0 the pair rests at 1.35486 in a well of 0.03544 J; at c = 1.5 nothing attracts."""
    law, cut = js.fluid.SlideLaw(1.0, 1.0), js.fluid.ShiftedForce(2.5)
    r = jnp.linspace(1.0, 2.5, 150_001)
    potential = cut.potential(law, r * r)
    assert float(r[jnp.argmin(potential)]) == pytest.approx(1.35486, abs=1e-5)
    assert float(-jnp.min(potential)) == pytest.approx(0.03544, abs=1e-5)
    near = jnp.linspace(0.5, 1.49, 100)
    assert bool(jnp.all(js.fluid.ShiftedForce(1.5).weight(law, near * near) > 0))


def test_forces_as_printed(rng):
    """The sum over tiles equals the slides' formula, pair by pair in NumPy, masses and all."""
    points, mass = blob(rng, 40), rng.uniform(0.5, 2, 40)
    for tile in (None, 7):
        system, state = make(points, mass, pairs=js.fluid.AllPairs(tile))
        np.testing.assert_allclose(components(system.force(state)), slide_force(points, mass), rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    ("law", "printed"),
    [
        (js.fluid.UnitVectorLaw(1.0, 1.3, 0.1), lambda r, m: m * (-1 / (r + 0.1) ** 2 + 1.3 / r**4)),
        (js.fluid.LennardJones(0.7, 0.9), lambda r, m: 24 * 0.7 / r * (2 * (0.9 / r) ** 12 - (0.9 / r) ** 6)),
    ],
    **by_name,
)
def test_other_laws_as_printed(law, printed, rng):
    """The push between two particles of 2 kg and 3 kg: both masses enter the unit-vector law, neither enters Lennard-Jones."""
    for r in (0.8, 1.7):
        system, state = make(np.array([[0.0, 0.0], [r, 0.0]]), np.array([2.0, 3.0]), law)
        push = printed(r, 6.0)
        np.testing.assert_allclose(components(system.force(state)), [[-push, 0], [push, 0]], rtol=1e-13)


@pytest.mark.parametrize(
    ("law", "repulsion"),
    [
        (js.fluid.SlideLaw(1.0, 1.3, 0.1), lambda r: 1.3 / (2 * r**2)),
        (js.fluid.UnitVectorLaw(1.0, 1.3, 0.1), lambda r: 1.3 / (3 * r**3)),
        (js.fluid.LennardJones(0.7, 0.9), lambda r: 4 * 0.7 * (0.9 / r) ** 12),
    ],
    **by_name,
)
def test_stiffness_where_two_particles_turn(law, repulsion):
    """The curvature of the repulsion's potential where that is the energy, or at the core where they would come closer than it."""
    r = scipy.optimize.brentq(lambda r: repulsion(r) - 5.0, 0.1, 10.0, xtol=1e-14)
    curvature = jax.grad(jax.grad(repulsion))
    for core, at in ((0.01, r), (2 * r, 2 * r)):
        stiffness = law.turning_stiffness(jnp.asarray(5.0), jnp.asarray(core))
        assert float(stiffness) == pytest.approx(float(curvature(at)), rel=1e-11)


@pytest.mark.parametrize("law", [js.fluid.SlideLaw(1.0, 1.3, 0.1), js.fluid.LennardJones(0.7, 0.9)], **by_name)
def test_step_for_a_collision(law):
    """Two of mass m at speed v turn where the pair has taken up m v^2; there they swing at sqrt(2 k / m). The worst particle is named."""
    mass, speed = np.array([1.0, 3.0, 0.5]), np.array([2.0, 4.0, 1.0])
    velocities = np.c_[np.zeros(3), speed]
    system, state = make(np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 3.0]]), mass, law, velocities)
    charge = mass**2 if isinstance(law, js.fluid.SlideLaw) else np.ones(3)
    energy = mass * speed**2 / charge
    # Per q_i q_j: 3 beta / r^4 where beta / (2 r^2) is the energy; 624 epsilon sigma^12 / r^14 where 4 epsilon (sigma / r)^12 is.
    k = 12 * energy**2 / 1.3 if isinstance(law, js.fluid.SlideLaw) else 624 * 0.7 / 0.9**2 * (energy / 2.8) ** (14 / 12)
    expected = 2 / np.sqrt(2 * charge * k / mass)
    limit, node = system.bind(state.dtype).forces[0].collision_dt(state)
    assert float(limit) == pytest.approx(expected.min(), rel=1e-12)
    assert int(node) == expected.argmin() == 1


def test_a_step_too_long_for_a_collision_is_told_in_both_directions():
    """DT_LIMIT above the limit of the speeds after the step, for dt above zero and below; nothing a hair below it."""
    system, state = make(np.array([[-2.0, 0.0], [2.0, 0.0]]), velocities=np.array([[1.0, 0.0], [-5.0, 0.0]]))
    fluid = system.bind(state.dtype).forces[0]
    limit = float(fluid.collision_dt(state)[0])
    slow = state.moved(state.position, 0.1 * state.velocity)
    for before, after, share, is_told in ((slow, state, 1.01, True), (slow, state, 0.99, False), (state, slow, 1.01, False)):
        for sign in (1, -1):
            status = fluid.update(js.Step(before, after, jnp.asarray(sign * share * limit)), after)[1]
            assert bool(status.has(js.Flag.DT_LIMIT)) == is_told


def test_drag_as_printed(rng):
    """-eta (1 - r/R)^2 ((v_i - v_j) . u) u for every pair nearer than R, nothing beyond; pair by pair in NumPy, beside the law's force."""
    points, velocities = blob(rng, 20), rng.normal(size=(20, 3))
    system, state = make(points, velocities=velocities, drag=js.fluid.PairDrag(0.7, 1.6))
    expected = slide_force(points, np.ones(20))
    n_near = 0
    for i in range(20):
        for j in range(20):
            r = np.linalg.norm(points[i] - points[j])
            if i != j and r < 1.6:
                u = (points[i] - points[j]) / r
                expected[i] -= 0.7 * (1 - r / 1.6) ** 2 * np.dot(velocities[i] - velocities[j], u) * u
                n_near += 1
    assert 0 < n_near < 380
    np.testing.assert_allclose(components(system.force(state)), expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("cutoff", CUTOFFS[1:], **by_name)
@pytest.mark.parametrize("law", LAWS, **by_name)
def test_a_cut_off_ends_without_a_step_in_energy(law, cutoff):
    """The potential is zero at the radius and beyond, and continuous; switched, the law is untouched up to where it starts to fade."""
    hair, c = 1e-9, 2.3
    assert abs(float(cutoff.potential(law, jnp.asarray((c - hair) ** 2)))) < 1e-8
    for r in (c, 5.0):
        assert float(cutoff.potential(law, jnp.asarray(r * r))) == float(cutoff.weight(law, jnp.asarray(r * r))) == 0
    if isinstance(cutoff, js.fluid.Switched):
        at = jnp.linspace(0.6, 1.6, 6) ** 2
        np.testing.assert_allclose(cutoff.weight(law, at), law.weight(at), rtol=1e-13)
        np.testing.assert_allclose(cutoff.potential(law, at), law.potential(at) - law.potential(jnp.asarray(c * c)), rtol=1e-12)


@pytest.mark.parametrize("cutoff", CUTOFFS, **by_name)
@pytest.mark.parametrize("law", LAWS, **by_name)
def test_force_is_minus_the_gradient_of_energy(law, cutoff, rng):
    """Also below the core, where two of the particles are put, and beyond the cut-off."""
    points = blob(rng, 24)
    points[1] = points[0] + [0.1, 0.05, 0.0]
    system, state = make(points, rng.uniform(0.5, 2, 24), law, cutoff=cutoff, core=0.3)

    @jax.jit
    def both(position):
        moved = state.moved(position, state.velocity)
        return system.force(moved), jax.grad(lambda x: system.energy(state.moved(x, state.velocity)).total)(position)

    force, gradient = both(state.position)
    scale = np.abs(components(force)).max()
    assert np.abs(components(force + gradient)).max() < 1e-12 * scale
    step = 1e-5

    @jax.jit
    def energy(h):
        return system.energy(state.moved(state.position + h / scale * force, state.velocity)).total

    expected = float(sum(jnp.sum(a * a) for a in force)) / scale
    assert float(energy(-step) - energy(step)) / (2 * step) == pytest.approx(expected, rel=1e-4)


TRIANGLE = [[0, 0], [1, 0], [0.4, 0.9]]
TETRAHEDRON = [[0, 0, 0], [1, 0, 0.1], [0.4, 0.9, 0], [0.5, 0.3, 0.8]]


@pytest.mark.slow
@pytest.mark.parametrize("corners", [TRIANGLE, TETRAHEDRON], ids=["triangle", "tetrahedron"])
def test_triangle_and_tetrahedron_rest_at_r0(corners):
    """Three particles in the plane and four in space settle with every edge exactly r_0."""
    system, state = make(np.array(corners, float))
    drag = js.Drag(1.5)
    system = js.System(system.net, mass=1.0, forces=(*system.forces, drag))
    end = js.rollout(system, state, js.SymplecticEuler(), 0.05, 1600).state.points
    edges = [float(jnp.linalg.norm(end[i] - end[j])) for i in range(len(end)) for j in range(i)]
    np.testing.assert_allclose(edges, float(system.forces[0].law.equilibrium_distance), rtol=1e-12)


def test_two_particles_swing_at_the_frequency():
    """A small oscillation crosses zero after a quarter of 2 pi / omega, omega = sqrt(k_0 (1/m_1 + 1/m_2) m_1 m_2)."""
    law = js.fluid.SlideLaw(1.0, 1.0, 0.1)
    omega = float(jnp.sqrt(law.contact_stiffness * 2))
    r = float(law.equilibrium_distance)
    system, state = make(np.array([[0.0, 0.0], [r + 1e-6, 0.0]]))
    n = 400
    end = js.rollout(system, state, js.VelocityVerlet(), 2 * np.pi / omega / n, n // 4).state
    assert abs(float(end.position.x[1] - end.position.x[0]) - r) < 2e-10
    assert float(end.velocity.x[1] - end.velocity.x[0]) == pytest.approx(-1e-6 * omega, rel=1e-4)


# Smallest spacing of low-energy clusters, alpha = beta = m = 1, zeta = 0: the most compact known for these numbers.
CONTRACTION = {2: 1.0, 3: 1.0, 4: 1.0, 7: 0.852, 13: 0.8086}


@pytest.mark.slow
def test_clusters_contract_as_they_grow():
    """Attraction without an end squeezes larger clusters: 0.852 of r_0 at 7 particles, 0.8086 at 13 (to 2e-3)."""
    golden = (1 + np.sqrt(5)) / 2
    ring = [[np.cos(t), np.sin(t), 0] for t in 2 * np.pi * np.arange(5) / 5]
    icosahedron = [[0, a, b * golden] for a in (-1, 1) for b in (-1, 1)]
    shapes = {
        2: [[0, 0, 0], [1, 0, 0]],
        3: [[0, 0, 0], [1, 0, 0], [0.5, 0.8, 0]],
        4: [[0, 0, 0], [1, 0, 0], [0.5, 0.8, 0], [0.5, 0.3, 0.8]],
        7: [*ring, [0, 0, 0.5], [0, 0, -0.5]],
        13: [[0, 0, 0], *(np.roll(p, k) / 2 for p in np.array(icosahedron) for k in range(3))],
    }
    for n, shape in shapes.items():
        system, state = make(np.array(shape, float), law=js.fluid.SlideLaw(1.0, 1.0))
        damped = js.System(system.net, mass=1.0, forces=(*system.forces, js.Drag(2.0)))
        end = np.asarray(js.rollout(damped, state, js.SymplecticEuler(), 0.03, 1500).state.points)
        distances = np.linalg.norm(end[:, None] - end[None], axis=-1) + 9 * np.eye(n)
        assert distances.min() == pytest.approx(CONTRACTION[n], abs=2e-3), n


@pytest.mark.slow
@pytest.mark.parametrize("pairs", [js.fluid.AllPairs(), js.fluid.NeighbourList(40, 0.4)], **by_name)
def test_momentum_and_angular_momentum_stay(pairs, rng):
    """Both, with drag between the pairs and unequal masses, over 60 steps to rounding, while the drag takes energy."""
    options = {"cutoff": js.fluid.ShiftedForce(2.5), "pairs": pairs, "drag": js.fluid.PairDrag(0.5, 2.0)}
    system, state = make(blob(rng, 30), rng.uniform(0.5, 2, 30), velocities=rng.normal(0, 0.3, (30, 3)), **options)
    result = js.rollout(system, state, js.SymplecticEuler(), 5e-3, 60)
    js.raise_for_status(result)
    np.testing.assert_allclose(system.momentum(result.state), system.momentum(state), atol=1e-12)
    np.testing.assert_allclose(system.angular_momentum(result.state), system.angular_momentum(state), atol=1e-11)
    assert system.energy(result.state).total < system.energy(state).total - 0.1


@pytest.mark.slow
@hypothesis.given(st.integers(0, 2**31), st.sampled_from(range(3)), st.booleans())
@hypothesis.settings(max_examples=12)
def test_forces_add_up_to_nothing(seed, which, has_drag):
    """Total force and total torque are zero to rounding for any law, masses, positions and velocities."""
    rng = np.random.default_rng(seed)
    drag = js.fluid.PairDrag(rng.uniform(0, 2), 1.5) if has_drag else None
    points = rng.uniform(0, 3, (16, 3))
    system, state = make(points, rng.uniform(0.1, 3, 16), LAWS[which], core=0.2, drag=drag, velocities=rng.normal(size=(16, 3)))
    force = components(system.force(state))
    scale = np.abs(force).max() * 16
    assert np.abs(force.sum(axis=0)).max() < 1e-14 * scale
    assert np.abs(np.cross(points, force).sum(axis=0)).max() < 1e-13 * scale


@pytest.mark.parametrize(("r", "stiffness"), [(0.8, 3 / 0.8**4 - 1 / 0.8**2), (3.0, 1 / 3**2 - 1 / 3**4)])
def test_bound_of_stiffness_of_a_pair(r, stiffness):
    """Two particles: the bound is exact, 2 / sqrt(2 k), k along the pair where near, and across it where they attract from afar."""
    system, state = make(np.array([[0.0, 0.0], [r, 0.0]]), law=js.fluid.SlideLaw(1.0, 1.0))
    assert float(js.stable_dt(system, state)) == pytest.approx(2 / np.sqrt(2 * stiffness), rel=1e-12)


def test_bound_of_stiffness_holds(rng):
    """The stable step from the pairs' stiffness lies below 2 / omega of the exact Hessian, and within a factor 3 of it."""
    points = blob(rng, 27, spacing=1.1)
    system, state = make(points)
    limit = float(js.stable_dt(system, state))

    @jax.jit
    def top_eigenvalue(flat):
        hessian = jax.hessian(lambda flat: system.energy(js.State.from_points(system.net, flat.reshape(-1, 3))).total)
        return jnp.linalg.eigvalsh(hessian(flat))[-1]

    top = float(top_eigenvalue(jnp.ravel(points)))
    assert limit <= 2 / np.sqrt(top) <= 3 * limit


def test_damping_bound_holds(rng):
    """Twice the sum of the drag coefficients is at least the largest eigenvalue of -dF/dv."""
    points = blob(rng, 12, spacing=0.8)
    system, state = make(points, drag=js.fluid.PairDrag(0.7, 1.5))

    @jax.jit
    def top_eigenvalue(flat):
        def force(flat):
            return jnp.ravel(jnp.stack(system.force(js.State.from_points(system.net, points, flat.reshape(-1, 3))).components, axis=-1))

        return jnp.linalg.eigvalsh(-jax.jacfwd(force)(flat))[-1]

    top = float(top_eigenvalue(jnp.zeros(36)))
    fluid = system.bind(state.dtype).forces[0]
    bound = float(jnp.max(fluid.damping_bound(state)))
    assert top <= bound <= 3 * top
    assert not fluid.is_symmetric
    assert not fluid.can_feed
