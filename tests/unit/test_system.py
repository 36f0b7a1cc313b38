"""Systems: masses, masks, schedules, reactions, energy and momentum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests import reference


@pytest.fixture
def scene(rng):
    """A triangle-ish graph in the plane with unequal masses, in motion; nodes are renumbered inside."""
    edges = [(4, 0), (0, 3), (3, 1), (1, 4), (2, 4), (0, 1)]
    net = js.Graph.from_edges(edges, 5)
    state = js.State.from_points(net, rng.normal(size=(5, 2)), rng.normal(size=(5, 2)))
    return net, state, rng.uniform(1, 2, 5)


def flat(net, vector):
    return np.stack([np.asarray(net.flatten_nodes(a)) for a in vector], axis=-1)


def test_acceleration_is_force_over_mass(scene):
    """f = m a for each node in the user's order, springs and drag together."""
    net, state, m = scene
    system = js.System(net, m, (js.Springs(net, 3.0, 0.5), js.Drag(0.2)))
    force = reference.spring_forces(state.points, net.edges, 3.0, 0.5) - 0.2 * np.asarray(state.velocities)
    np.testing.assert_allclose(flat(net, system.force(state)), force, atol=1e-13)
    np.testing.assert_allclose(flat(net, system.acceleration(state)), force / m[:, None], atol=1e-13)


def test_without_forces_nothing_accelerates(scene):
    """No force: acceleration and potential are zero."""
    net, state, m = scene
    system = js.System(net, m)
    np.testing.assert_array_equal(flat(net, system.acceleration(state)), 0)
    assert system.energy(state).potential == ()


def test_held_nodes_and_coordinates(scene):
    """Acceleration is zero exactly where free is False, per node or per coordinate; reactions balance the force there."""
    net, state, m = scene
    springs = js.Springs(net, 3.0, 0.5)
    free = np.ones((5, 2), bool)
    free[1, 0] = free[2] = False
    system = js.System(net, m, springs, free=free)
    whole = flat(net, js.System(net, m, springs).acceleration(state))
    force = flat(net, springs.force(state))
    np.testing.assert_array_equal(flat(net, system.acceleration(state)), np.where(free, whole, 0))
    np.testing.assert_array_equal(flat(net, system.reaction(state)), np.where(free, 0, -force))
    by_node = js.System(net, m, springs, free=np.array([True, True, False, True, True]))
    assert (flat(net, by_node.acceleration(state))[2] == 0).all()


def test_a_border_node_slides_along_its_border():
    """With free = (False, True) a node keeps its x exactly while its y moves."""
    net = js.lattice(2)
    free = np.array([[False, False], [False, True]])
    system = js.System(net, 1.0, js.Springs(net, 1.0, 0.3), free=free)
    state = js.State.from_points(net, [[0.0, 0.0], [0.7, 1.0]], [[5.0, 5.0], [1.0, 0.0]])
    points = js.rollout(system, state, js.SymplecticEuler(), dt=0.1, n_steps=10).state.points
    np.testing.assert_array_equal(points[0], [0.0, 0.0])
    assert points[1, 0] == 0.7
    assert points[1, 1] != 1.0


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()], ids=lambda s: type(s).__name__)
def test_moved_nodes_follow_their_schedule(stepper):
    """A node on a schedule has its position and velocity at every step; the rest is pulled along by the spring."""
    net = js.lattice(2)

    def path(t):
        return js.Vector((jnp.stack([jnp.sin(t), jnp.zeros_like(t)]),))

    motion = js.Motion(jnp.array([True, False]), path)
    system = js.System(net, 1.0, js.Springs(net, 4.0, 1.0), motion=motion)
    state = js.State.from_points(net, [[9.0], [1.0]])
    result = js.rollout(system, state, stepper, dt=0.01, n_steps=100, save_every=10)
    t = np.asarray(result.saved.time)
    np.testing.assert_allclose(t, np.arange(1, 11) * 0.1, rtol=1e-14)
    np.testing.assert_allclose(result.saved.points[:, 0, 0], np.sin(t), atol=1e-15)
    np.testing.assert_allclose(result.saved.velocities[:, 0, 0], np.cos(t), atol=1e-15)
    # x'' = 4 (sin t + 1 - x), x(0) = 1, x'(0) = 0:  x = 1 + (4 sin t - 2 sin 2t) / 3
    tolerance = 1e-2 if isinstance(stepper, js.SymplecticEuler) else 1e-4
    assert float(result.state.points[1, 0]) == pytest.approx(1 + (4 * np.sin(1) - 2 * np.sin(2)) / 3, abs=tolerance)


def test_energy_and_momentum_against_numpy(scene):
    """Kinetic and spring energy, momentum and angular momentum are the sums over nodes and springs."""
    net, state, m = scene
    system = js.System(net, m, (js.Springs(net, 3.0, 0.5), js.Drag(0.1)))
    x, v = np.asarray(state.points), np.asarray(state.velocities)
    stretch = np.linalg.norm(x[net.edges[:, 1]] - x[net.edges[:, 0]], axis=1) - 0.5
    energy = system.energy(state)
    assert float(energy.kinetic) == pytest.approx(0.5 * (m * (v**2).sum(axis=1)).sum())
    assert float(energy.potential[0]) == pytest.approx(1.5 * (stretch**2).sum())
    assert energy.potential[1] is None
    assert float(energy.total) == pytest.approx(float(energy.kinetic + energy.potential[0]))
    np.testing.assert_allclose(system.momentum(state), m @ v)
    np.testing.assert_allclose(system.angular_momentum(state), [(m * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])).sum()])


def test_angular_momentum_in_space(rng):
    """Sum of m x cross v."""
    net = js.lattice(4)
    x, v, m = rng.normal(size=(4, 3)), rng.normal(size=(4, 3)), rng.uniform(1, 2, 4)
    got = js.System(net, m).angular_momentum(js.State.from_points(net, x, v))
    np.testing.assert_allclose(got, (m[:, None] * np.cross(x, v)).sum(axis=0), rtol=1e-13)


def test_mass_from_density(rng):
    """Along springs each end gets half of density times length; on triangles each corner a third of density times area."""
    points = rng.normal(size=(4, 3))
    net = js.Graph.from_edges([(0, 1), (1, 2), (2, 0), (2, 3)], 4)
    length = np.asarray(net.lengths(points))
    mass = js.lumped_mass(net, points, 2.0)
    assert float(mass.sum()) == pytest.approx(2 * length.sum())
    assert float(mass[3]) == pytest.approx(length[3])
    triangles = np.array([(0, 1, 2), (1, 2, 3)])
    area = [0.5 * np.linalg.norm(np.cross(points[b] - points[a], points[c] - points[a])) for a, b, c in triangles]
    on_faces = js.lumped_mass(net, points, 2.0, triangles)
    np.testing.assert_allclose(on_faces, np.array([area[0], sum(area), sum(area), area[1]]) * 2 / 3, rtol=1e-13)


def test_gradient_with_respect_to_a_system(scene):
    """eqx.filter_grad of the energy by the system: dE/dk = stretch^2 / 2 per spring, dE/dm = v^2 / 2; masks and tables get none."""
    net, state, m = scene
    k, l = np.full(net.n_springs, 3.0), np.full(net.n_springs, 0.5)
    system = js.System(net, m, js.Springs(net, k, l), free=np.ones(5, bool))
    gradient = eqx.filter_grad(lambda s: s.energy(state).total)(system)
    stretch = np.asarray(net.lengths(state.points)) - 0.5
    np.testing.assert_allclose(gradient.forces[0].stiffness, 0.5 * stretch**2, rtol=1e-12)
    np.testing.assert_allclose(gradient.forces[0].rest_length, -3.0 * stretch, rtol=1e-12)
    np.testing.assert_allclose(net.flatten_nodes(gradient.mass), 0.5 * (np.asarray(state.velocities) ** 2).sum(axis=1), rtol=1e-12)
    assert gradient.free is None
    assert gradient.net.ends.tails is None


def test_one_parameter_may_serve_two_forces(scene):
    """A tied stiffness gets the sum of both gradients."""
    net, state, m = scene

    def energy(k):
        return js.System(net, m, (js.Springs(net, k, 0.5), js.Springs(net, 2 * k, 0.1))).energy(state).total

    r = np.asarray(net.lengths(state.points))
    expected = (0.5 * (r - 0.5) ** 2 + (r - 0.1) ** 2).sum()
    assert float(jax.grad(energy)(jnp.asarray(3.0))) == pytest.approx(expected, rel=1e-12)


def test_float32_state_with_float64_constants(scene):
    """Forces, energy and acceleration of a float32 state are float32, whatever the constants were."""
    net, state, m = scene
    system = js.System(net, m, (js.Springs(net, 3.0, 0.5), js.Drag(0.1), js.Gravity([0.0, -9.81])), free=np.ones(5, bool))
    single = js.State.from_points(net, np.asarray(state.points, "float32"), np.asarray(state.velocities, "float32"))
    assert system.acceleration(single).dtype == jnp.float32
    assert system.energy(single).total.dtype == jnp.float32
    np.testing.assert_allclose(flat(net, system.force(single)), flat(net, system.force(state)), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ({"mass": [1.0, 1.0, 0.0, 1.0, 1.0]}, ValueError, r"mass\[2\] = 0.0"),
        ({"mass": np.ones(4)}, ValueError, "one per node"),
        ({"free": [1, 0, 1, 1, 1]}, TypeError, "expected booleans"),
        ({"free": np.ones((5, 4), bool)}, ValueError, "free has shape"),
        ({"free": np.ones(4, bool)}, ValueError, "free has shape"),
        ({"forces": (js.Drag(0.1), 3.0)}, TypeError, r"forces\[1\] is a float"),
        ({"forces": js.Springs(js.lattice(5), 1.0)}, ValueError, "another topology"),
    ],
)
def test_wrong_systems_are_refused(scene, arguments, kind, message):
    """Each wrong argument raises, naming it."""
    with pytest.raises(kind, match=message):
        js.System(scene[0], **{"mass": 1.0, **arguments})


def test_mask_and_state_of_different_dimension(scene):
    """A mask for 3 coordinates on a state of 2 is an error that says so."""
    net, state, m = scene
    with pytest.raises(ValueError, match="free has 3 coordinates"):
        js.System(net, m, js.Drag(0.1), free=np.ones((5, 3), bool)).acceleration(state)


def test_every_question_refuses_stacked_systems():
    """What needs no forces refuses many systems stacked, too: their masses would be stretched over the nodes without a word."""
    net = js.lattice(2)
    systems = jax.tree.map(lambda *a: jnp.stack(a), *(js.System(net, np.array([1.0, m])) for m in (2.0, 3.0)))
    state = js.State.from_points(net, net.grid())
    for ask in (systems.constrain, systems.momentum, systems.force, systems.energy):
        with pytest.raises(ValueError, match="these are many systems"):
            ask(state)
