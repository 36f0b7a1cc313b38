"""Angular joints: the gradient of their energy, exact matrices where straight, conserved momenta, and the heavy cantilever's table."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_bvp

import jaxspring as js

RNG = np.random.default_rng(37)
GRID = js.lattice((3, 4))
G = 9.81
# Drop over length of a heavy rod that is clamped horizontally, for w L^3 / EI; by a boundary value problem to eight digits.
TABLE = {1: 0.123471, 2: 0.238507, 5: 0.495905, 8: 0.640631, 10: 0.700200, 20: 0.829881}
# For w L^3 / EI = 8 of rods of 10, 20, 40, 80 elements that do not stretch, by a shooting method.
CHAINS = {10: 0.645471, 20: 0.641842, 40: 0.640933, 80: 0.640706}


def flat(v):
    """(N, D) values in the user's order."""
    return jnp.stack([GRID.flatten_nodes(a) for a in v], axis=-1)


@pytest.mark.parametrize("dim", [2, 3])
def test_forces_matrices_and_momenta(dim):
    """F = -grad E; blocks are the derivative where rows are straight, and resist every motion where not; momenta; the bound."""
    points = np.pad(GRID.grid(0.5), ((0, 0), (0, dim - 2)))
    bent = points + 0.15 * RNG.normal(size=points.shape)
    joints = js.cloth.AngularJoints(GRID, np.linspace(1.0, 2.0, 10))
    system = js.System(GRID, 1.0, joints)

    @jax.jit
    def everything(x):
        state = js.State.from_points(GRID, x)

        def force(x):
            return flat(joints.force(js.State.from_points(GRID, x)))

        gradient = jax.grad(lambda x: joints.energy(js.State.from_points(GRID, x)))(x)
        matrix = system.matrix(joints.stiffness_blocks(state, js.steppers.Tangent()), state).to_dense()
        return force(x), gradient, jax.jacfwd(force)(x).reshape(matrix.shape), matrix, joints.stiffness_bound(state)

    force, gradient, jacobian, matrix, bound = everything(bent)
    size = float(jnp.abs(force).sum())
    np.testing.assert_allclose(force, -gradient, atol=1e-13 * size)
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-14 * size)
    turning = np.cross(np.pad(bent, ((0, 0), (0, 3 - dim))), np.pad(force, ((0, 0), (0, 3 - dim))))
    np.testing.assert_allclose(turning.sum(axis=0), 0.0, atol=1e-14 * size)
    assert np.linalg.eigvalsh(matrix)[0] > -1e-12 * np.abs(matrix).max()
    assert np.linalg.eigvalsh(-jacobian)[-1] <= float(bound.max())
    _, _, jacobian, matrix, bound = everything(points)
    np.testing.assert_allclose(matrix, -jacobian, atol=1e-12 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(matrix)[-1] <= float(bound.max())
    # Nearly straight, where a series takes over, against differences of forces.
    h = 1e-6
    near = points + 1e-3 * RNG.normal(size=points.shape)
    v = RNG.normal(size=points.shape)
    slope = (everything(near + h * v)[0] - everything(near - h * v)[0]) / (2 * h)
    np.testing.assert_allclose((everything(near)[2] @ v.ravel()).reshape(slope.shape), slope, atol=1e-6 * np.abs(slope).max())


def test_a_flexion_spring_has_no_bending_stiffness():
    """Of a chain that turns by phi a spring of length 2 h stores k h^2 phi^4 / 32, a joint k phi^2 / 2."""
    chain, h, k = js.lattice(3, js.BEND), 0.5, 7.0
    for phi in (0.02, 0.04):
        x = h * np.array([(-np.cos(phi / 2), -np.sin(phi / 2)), (0.0, 0.0), (np.cos(phi / 2), -np.sin(phi / 2))])
        state = js.State.from_points(chain, x)
        assert float(js.Springs(chain, k, 2 * h).energy(state)) == pytest.approx(k * h**2 * phi**4 / 32, rel=1e-3)
        assert float(js.cloth.AngularJoints(chain, k).energy(state)) == pytest.approx(k * phi**2 / 2, rel=1e-12)


def rod(gamma):
    """Places of a heavy rod of length 1 that is clamped horizontally: a function of the arc length, (S, 2)."""

    def slopes(s, y):
        return [y[1], -gamma * (1 - s) * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])]

    def ends(a, b):
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0, 1, 101)
    guess = np.array([1.2 * s, 0 * s, s, 0 * s])
    found = solve_bvp(slopes, ends, s, guess, tol=1e-9, max_nodes=20000)
    assert found.success
    return lambda s: found.sol(s)[2:].T


def test_the_table_is_right():
    """The drops that the chains are held against, by an integrator of their own."""
    for gamma, drop in TABLE.items():
        assert -rod(gamma)(1.0)[1] == pytest.approx(drop, abs=1e-6)


def cantilevers(chains, dim):
    """Places of chains that hardly stretch, each of a number of elements and a load, all in one net, from one equilibrium."""
    first = np.cumsum([0, *(n + 1 for n, _ in chains)])
    joints = np.concatenate([a + np.arange(n - 1)[:, None] + np.arange(3) for a, (n, _) in zip(first[:-1], chains, strict=True)])
    edges = np.concatenate([a + np.arange(n)[:, None] + np.arange(2) for a, (n, _) in zip(first[:-1], chains, strict=True)])
    ends = first[:-1, None] + np.arange(2)
    h = np.concatenate([np.full(n + 1, 1 / n) for n, _ in chains])
    mass = np.concatenate([np.append(np.full(n, 1.0), 0.5) * gamma / n / G for n, gamma in chains])
    start = np.concatenate([rod(gamma)(np.linspace(0, 1, n + 1)) for n, gamma in chains])
    net, axes = js.Graph.from_edges(edges, first[-1]), np.eye(dim)
    springs = js.Springs(net, 1e5 / h[edges[:, 0]], h[edges[:, 0]])
    stiffness = {"stiffness": 1 / h[joints[:, 1]], "clamp_stiffness": 2 / h[ends[:, 0]]}
    bending = js.cloth.AngularJoints(net, joints=joints, clamp=axes[0], ends=ends, **stiffness)
    system = js.System(net, mass, (springs, bending, js.Gravity(-G * axes[1])), free=~np.isin(np.arange(first[-1]), first))
    found = js.equilibrium(system, js.State.from_points(net, np.pad(start, ((0, 0), (0, dim - 2)))), tolerance=1e-7)
    js.raise_for_status(found)
    return [np.asarray(found.state.points[a:b]) for a, b in itertools.pairwise(first)]


def test_the_heavy_cantilever():
    """80 elements are within 0.1 % of the rod, all are those of a shooting method but for the stretch; the error falls as h^2. At a chord
    of 41.5 degrees B is w (L / 2)^3.
    """
    found = cantilevers([(n, 8) for n in CHAINS], dim=2)
    drops = np.array([-points[-1, 1] for points in found])
    assert drops[-1] == pytest.approx(TABLE[8], rel=1e-3)
    np.testing.assert_allclose(drops, list(CHAINS.values()), atol=3e-5)
    apart = -np.diff(drops)
    np.testing.assert_allclose(np.log2(apart[:-1] / apart[1:]), 2.0, atol=0.03)
    x, y = found[-1][-1]
    assert np.degrees(np.arctan2(-y, x)) == pytest.approx(41.5, abs=0.03)


@pytest.mark.slow
def test_the_cantilevers_table():
    """80 elements in space, for loads from 1 to 20: within 0.1 %, and in their plane."""
    for points, drop in zip(cantilevers([(80, gamma) for gamma in TABLE], dim=3), TABLE.values(), strict=True):
        assert -points[-1, 1] == pytest.approx(drop, rel=1e-3)
        np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-9)


def test_clamps():
    """A clamp is a joint of twice the stiffness with a direction that does not move; both ends of a ring's rows have none."""
    chain = js.lattice(4)
    x = np.array([(0.0, 0.0), (1.0, 0.2), (2.0, 0.1), (2.5, 0.9)])
    state = js.State.from_points(chain, x)
    free = js.cloth.AngularJoints(chain, 3.0)
    both = js.cloth.AngularJoints(chain, 3.0, clamp=[(2.0, 0.0), (-1.0, 0.0)], ends=[(0, 1), (3, 2)])
    turned = [np.arctan2(0.2, 1.0), np.arctan2(0.8, 0.5)]  # the second from (-1, 0) to (-0.5, -0.8)
    np.testing.assert_allclose(both.angles(state)[2:], turned, rtol=1e-12)
    assert float(both.energy(state) - free.energy(state)) == pytest.approx(0.5 * 6.0 * np.sum(np.square(turned)), rel=1e-12)
    rows = js.cloth.AngularJoints(GRID, 1.0, clamp=(1.0, 0.0), axis=1)
    assert (rows.n_joints, rows.clamp.shape) == (6, (3, 2))
    np.testing.assert_array_equal(rows.nodes[:2], [[0, 1, 2], [1, 2, 3]])
    ring = js.lattice(5, periodic=True, box=[5.0, 0.0])
    assert float(js.cloth.AngularJoints(ring, 1.0).energy(js.State.from_points(ring, np.pad(ring.grid(), ((0, 0), (0, 1)))))) < 1e-20


@pytest.mark.parametrize(
    ("net", "arguments", "message"),
    [
        (js.Graph.from_edges([(0, 1)], 3), {}, "has no rows"),
        (js.lattice(2), {}, "no three nodes in a row"),
        (GRID, {"axis": 2}, "axis = 2"),
        (GRID, {"clamp": (1.0, 0.0)}, "which nodes are clamped"),
        (GRID, {"ends": [(0, 1)]}, "no direction"),
        (GRID, {"clamp": (0.0, 0.0), "axis": 0}, "without length"),
        (GRID, {"clamp": (1.0, 0.0), "axis": 1, "stiffness": np.ones(6)}, "clamp_stiffness"),
        (GRID, {"stiffness": -1.0}, "negative stiffness"),
        (GRID, {"joints": [(0, 1)]}, r"\(J, 3\)"),
    ],
)
def test_what_makes_no_joints_is_refused(net, arguments, message):
    """By name, with what to do."""
    with pytest.raises(ValueError, match=message):
        js.cloth.AngularJoints(net, **{"stiffness": 1.0, **arguments})
