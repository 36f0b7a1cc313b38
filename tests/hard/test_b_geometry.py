"""Hard cases B: nodes that coincide, coordinates far from the origin, rotated nets. (Lines that need a solve are not here.)"""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.laws import EnergyLaw, Hooke, PullLaw, TensionOnly
from jaxspring.status import Flag, StabilityWarning
from tests.reference import relative_error, spring_forces


def pair(separation, stiffness=100.0, rest_length=1.0, law=None, dtype=np.float64):
    """Two nodes `separation` apart along x, near the origin."""
    net = js.lattice(2)
    points = np.array([[0.0, 0.0, 0.0], [separation, 0.0, 0.0]], dtype)
    return js.System(net, 1.0, js.Springs(net, stiffness, rest_length, law=law)), js.State.from_points(net, points)


def forces_of(system):
    @jax.jit
    def of_points(points):
        force = system.force(js.State.from_points(system.net, points))
        return jnp.stack([system.net.flatten_nodes(f) for f in force], axis=-1)

    return of_points


def status_of(system, state):
    return js.rollout(system, state, js.SymplecticEuler(), dt=0.0, n_steps=1).status


def test_b1_coincident_without_rest_length():
    """A spring of rest length 0 and length 0 pulls nothing, and its stiffness block is exactly k I (a naive norm gives NaN)."""
    system, state = pair(0.0, rest_length=0.0)
    forces = forces_of(system)
    np.testing.assert_array_equal(forces(state.points), 0)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_array_equal(jacobian(forces)(state.points)[0, :, 1, :], 100 * np.eye(3))
    assert Flag(int(status_of(system, state).flags)) == Flag.OK


LAWS = [Hooke(), TensionOnly(), EnergyLaw(lambda r, k, l: 0.5 * k * (r - l) ** 2), PullLaw(lambda r, k, l: k * (r - l))]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_b2_coincident_with_rest_length(law):
    """The pull has no direction and is taken as 0; first and second derivatives are finite; the status counts the spring."""
    system, state = pair(0.0, law=law)
    forces = forces_of(system)
    np.testing.assert_array_equal(forces(state.points), 0)
    assert np.isfinite(jax.jacrev(forces)(state.points)).all()
    energy = system.energy(state).potential[0]
    if energy is not None:
        assert np.isfinite(energy)

        def of_points(points):
            return system.energy(js.State.from_points(system.net, points)).total

        assert np.isfinite(jax.hessian(of_points)(state.points)).all()
    status = status_of(system, state)
    assert Flag(int(status.flags)) == Flag.COINCIDENT
    assert status.is_ok
    assert status.count == 1


@pytest.mark.parametrize("separation", [1e-10, 1e-15])
def test_b3_nearly_coincident(separation):
    """At 1e-10 and 1e-15 the spring still pushes with k l = 100 N to 1e-4, in float32."""
    system, state = pair(separation, dtype=np.float32)
    np.testing.assert_allclose(system.force(state).x, [-100, 100], atol=1e-4)
    assert Flag(int(status_of(system, state).flags)) == Flag.OK


@pytest.mark.parametrize(("separation", "dtype"), [(1e-20, np.float32), (1e-160, np.float64)])
def test_b3_the_square_underflows(separation, dtype):
    """Where the squared length underflows the spring counts as coincident: the force is finite and at most k l, never NaN."""
    # Not exactly 0: below sqrt(tiny) the push falls linearly with the distance, which costs nothing and needs no branch.
    system, state = pair(separation, dtype=dtype)
    force = system.force(state)
    assert np.isfinite(force.x).all()
    assert np.abs(force.x).max() <= 100
    assert np.isfinite(jax.jacrev(forces_of(system))(state.points)).all()
    status = status_of(system, state)
    assert Flag(int(status.flags)) == Flag.COINCIDENT
    assert status.count == 1


NET = js.lattice((24, 24), js.STRUCTURAL + js.SHEAR)


def moved_net(rng, offset, dtype):
    """A jittered 24 x 24 net of spacing 1, moved along the diagonal: system, state, true forces, shortest rest or present length."""
    points = np.c_[NET.grid(), np.zeros(576)] + 0.4 * rng.normal(size=(576, 3))
    ends = NET.grid()[NET.edges]
    rest = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    lengths = np.linalg.norm(points[NET.edges[:, 1]] - points[NET.edges[:, 0]], axis=1)
    system = js.System(NET, 1.0, js.Springs(NET, 100.0, rest))
    state = js.State.from_points(NET, (points + offset).astype(dtype))
    return system, state, spring_forces(points, NET.edges, 100.0, rest), min(rest.min(), lengths.min())


# Bounds: a trial implementation in NumPy and JAX on such a net.
@pytest.mark.parametrize(
    ("offset", "dtype", "bound"),
    [(0, "float32", 1.5e-6), (1e3, "float32", 5e-5), (1e6, "float32", 7e-2), (1e8, "float32", 8), (1e6, "float64", 1e-10)],
)
def test_b5_far_from_the_origin(rng, offset, dtype, bound):
    """Rounding of the coordinates grows with their size and spoils the forces; where three digits or fewer are left, a run warns."""
    system, state, expected, shortest = moved_net(rng, offset, dtype)
    error = relative_error(np.stack([np.ravel(a) for a in system.force(state)], axis=-1), expected)
    assert error <= bound
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        status = status_of(system, state)
    is_coarse = bool(np.abs(state.points).max() * np.finfo(dtype).eps > 1e-3 * shortest)
    assert bool(status.has(Flag.PRECISION)) == is_coarse
    assert [w.category for w in caught] == [StabilityWarning] * is_coarse
    assert status.is_ok
    assert is_coarse or error <= 1e-3


def test_b5_what_is_small_counts():
    """The warning looks at the shortest rest or present length; springs without rest length, whose pull is k d, at the longest."""
    net = js.lattice(3)
    far = 1e3 * np.ones((3, 1), np.float32) + np.array([[0], [1], [2]], np.float32)

    def warns(points, rest_length):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            state = js.State.from_points(net, np.asarray(points, np.float32))
            return bool(status_of(js.System(net, 1.0, js.Springs(net, 1.0, rest_length)), state).has(Flag.PRECISION))

    assert not warns(far, 1.0)
    assert warns(far, [1.0, 0.01])
    assert warns([[1e3], [1e3 + 0.01], [1e3 + 1]], 1.0)
    assert not warns([[1e3], [1e3 + 0.01], [1e3 + 1]], 0.0)
    assert not warns([[0], [0], [1]], 1.0)


@pytest.mark.parametrize("turn", ["90 degrees", "45 degrees", "reflected"])
def test_b9_turned_nets(rng, turn):
    """A net turned by 90 or 45 degrees or reflected has the same forces, turned, to 4e-15."""
    c = np.sqrt(0.5)
    matrix = {"90 degrees": [[0.0, -1.0], [1.0, 0.0]], "45 degrees": [[c, -c], [c, c]], "reflected": [[-1.0, 0.0], [0.0, 1.0]]}[turn]
    net = js.lattice((6, 7), js.STRUCTURAL + js.SHEAR + js.BEND)
    points = net.grid() + 0.1 * rng.normal(size=(42, 2))
    forces = forces_of(js.System(net, 1.0, js.Springs(net, 10.0, 1.0)))
    assert relative_error(forces(points @ np.transpose(matrix)), forces(points) @ np.transpose(matrix)) <= 4e-15
