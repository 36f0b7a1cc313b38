"""Static shapes against closed forms, SciPy and equidistribution; statuses where there is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxspring as js
from jaxspring.status import Flag


def pinned(n, *nodes):
    """All free but these nodes."""
    free = np.ones(n, bool)
    free[list(nodes)] = False
    return free


def hanging(dtype=np.float64, stiffness=50.0):
    """A vertical chain of 6 under its weight, pinned at the top, let go from where its springs have no tension."""
    net = js.lattice(6)
    points = np.stack([0.1 * np.arange(6.0) % 0.2, -np.arange(6.0)], axis=1).astype(dtype)
    system = js.System(net, 0.5, (js.Springs(net, stiffness, 1.0), js.Gravity([0.0, -9.81]), js.Drag(0.1)), free=pinned(6, 0))
    return system, js.State.from_points(net, points)


def test_a_hanging_chain(dtype):
    """Every spring carries the weight below it; the state is at rest; float32 stays float32."""
    system, start = hanging(dtype)
    found = js.equilibrium(system, start)
    weight_below = 0.5 * 9.81 * np.arange(5, 0, -1)
    assert bool(found.status.is_ok)
    assert found.state.dtype == dtype
    lengths = np.linalg.norm(np.diff(found.state.points, axis=0), axis=1)
    np.testing.assert_allclose(lengths, 1 + weight_below / 50.0, rtol=1e-9 if dtype == np.float64 else 5e-5)
    np.testing.assert_allclose(found.state.points[:, 0], 0.0, atol=1e-9 if dtype == np.float64 else 1e-3)
    assert not np.any(found.state.velocities)
    assert float(found.info.residual) <= (1e-10 if dtype == np.float64 else 1e-5)


def test_b8_a_flat_chain_under_a_side_load():
    """B8: no stiffness against the load at first: the sag is the root of 2 k (r - l) y / r = P; one linear solve there says it failed."""
    net = js.lattice(3)
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    load = js.Load(js.Vector((jnp.zeros(3), jnp.asarray([0.0, 5.0, 0.0]), jnp.zeros(3))))
    system = js.System(net, 1.0, (js.Springs(net, 100.0, 1.0), load), free=pinned(3, 0, 2))
    start = js.State.from_points(net, points)
    found = js.equilibrium(system, start)
    sag = scipy.optimize.brentq(lambda y: 200 * (np.hypot(1, y) - 1) * y / np.hypot(1, y) - 5, 0.1, 1)
    assert float(found.state.points[1, 1]) == pytest.approx(sag, rel=1e-9)
    # Across the plane of chain and load the sagged springs are taut, so this is a minimum.
    assert bool(found.status.is_ok)
    matrix = system.matrix(system.stiffness_blocks(start, js.steppers.ExactTangent()), start)
    _, info = js.CG().solve(matrix, system.force(start))
    assert not bool(info.status.is_ok)


@pytest.mark.parametrize("pull", [0.0, 1.0])
def test_b8_nothing_holds_it(pull):
    """B8: a free net, at rest or pulled away, is a MECHANISM; its message says what to do."""
    net = js.lattice(3)
    system = js.System(net, 1.0, (js.Springs(net, 100.0, 1.0), js.Gravity([pull, 0.0])))
    found = js.equilibrium(system, js.State.from_points(net, [[0.0, 0.0], [1.0, 0.0], [1.5, 0.8]]))
    assert bool(found.status.has(Flag.MECHANISM))
    with pytest.raises(js.SimulationError, match="pin more nodes"):
        js.raise_for_status(found)


def squeezed(bend):
    """A straight chain of 9 in the plane, squeezed by a tenth, with bend springs that unfold it."""
    net = js.lattice(9, js.STRUCTURAL + js.BEND)
    points = np.stack([0.9 * np.arange(9.0), bend * np.sin(np.pi * np.arange(9) / 8)], axis=1)
    rest = net.lengths(np.stack([np.arange(9.0), np.zeros(9)], axis=1))
    return js.System(net, 1.0, js.Springs(net, 100.0, rest), free=pinned(9, 0, 8)), js.State.from_points(net, points)


def test_b7_a_squeezed_chain_buckles():
    """B7: exactly straight it balances and is reported UNSTABLE; pushed by 1e-6 it buckles to less energy, by 0.3 of its length or more."""
    system, straight = squeezed(0.0)
    found = js.equilibrium(system, straight)
    assert int(found.status.flags) == Flag.UNSTABLE
    np.testing.assert_allclose(found.state.points[:, 1], 0.0, atol=1e-12)
    _, pushed = squeezed(1e-6)
    buckled = js.equilibrium(system, pushed)
    assert bool(buckled.status.is_ok)
    assert float(system.energy(buckled.state).total) < 0.5 * float(system.energy(straight).total)
    assert np.max(buckled.state.points[:, 1]) > 0.3
    assert np.max(np.abs(system.acceleration(buckled.state).y)) < 1e-8


def test_the_minimum_is_scipys(rng):
    """A crumpled sheet of 4 x 4 under gravity, energy minimised by BFGS from the shape found: nothing is gained."""
    net = js.lattice((4, 4), js.STRUCTURAL + js.SHEAR)
    rest = np.asarray(net.grid())
    points = np.c_[rest, np.zeros(16)] + 0.2 * rng.normal(size=(16, 3))
    free = pinned(16, 0, 3)
    system = js.System(net, 0.1, (js.Springs(net, 30.0, net.lengths(rest)), js.Gravity([0.0, 0.0, -9.81])), free=free)
    found = js.equilibrium(system, js.State.from_points(net, points))
    assert bool(found.status.is_ok)

    @jax.jit
    @jax.value_and_grad
    def energy(x):
        moved = found.state.points.at[free].set(x.reshape(-1, 3))
        return system.energy(js.State.from_points(net, moved)).total

    start = np.asarray(found.state.points)[free].ravel()
    better = scipy.optimize.minimize(energy, start, jac=True, method="BFGS", options={"gtol": 1e-9})
    assert float(energy(start)[0]) - better.fun <= 1e-12 * abs(better.fun)
    np.testing.assert_allclose(better.x, start, atol=1e-7)


def test_springs_without_rest_length_share_the_tension():
    """On a line k_i L_i is the same for all springs: the equidistribution that adaptive meshes rest on; no Newton step is wasted."""
    net = js.lattice(6)
    k = np.array([1.0, 2.0, 10.0, 4.0, 1.0])
    system = js.System(net, 1.0, js.Springs(net, k, 0.0), free=pinned(6, 0, 5))
    found = js.equilibrium(system, js.State.from_points(net, np.linspace(0, 1, 6)[:, None] ** 2))
    tension = k * np.diff(found.state.points[:, 0])
    np.testing.assert_allclose(tension, tension[0], rtol=1e-9)


def test_without_a_potential_the_forces_still_balance():
    """Stiffness that follows an image has no energy: the net force falls below the tolerance, and z is the image's value."""
    net = js.lattice((6, 6))
    image = js.Image(np.add.outer(np.sin(np.arange(6.0)), np.cos(np.arange(6.0))), spacing=1.0)
    rule = js.ImageStiffness(image, k_min=1.0, k_max=5.0, sigma=1.0)
    edge = np.any((net.grid() == 0) | (net.grid() == 5), axis=1)
    free = np.stack([~edge, ~edge, np.ones(36, bool)], axis=1)
    start = js.State.from_points(net, np.c_[np.asarray(net.grid()), np.zeros(36)])
    system = js.System(net, 1.0, (js.Springs(net, rule, 0.0, axes=(0, 1)), js.DataSprings(image, 3.0)), free=free)
    found = js.equilibrium(system, start)
    assert bool(found.status.is_ok)
    assert np.max(np.abs(jnp.stack(system.acceleration(found.state).components))) < 1e-8
    x, y, z = np.asarray(found.state.points).T
    assert np.ptp(np.diff(x.reshape(6, 6), axis=1)) > 0.05
    np.testing.assert_allclose(z, jax.vmap(image.sample)(x, y), atol=1e-8)


def test_a_bad_start_is_reported():
    """A force that is NaN: NONFINITE at once; too few steps: SOLVER, with the residual it has."""
    system, start = hanging()
    nan = js.System(system.net, 0.5, js.Load(lambda t: js.Vector((jnp.full(6, jnp.nan), jnp.zeros(6)))), free=pinned(6, 0))
    assert bool(js.equilibrium(nan, start).status.has(Flag.NONFINITE))
    short = js.equilibrium(system, start, max_iter=1)
    assert int(short.status.flags) == Flag.SOLVER
    assert float(short.info.residual) > 1e-10
    assert int(short.newton_iterations) == 1


def test_everything_held(dtype):
    """With every node held the shape is the one given, bitwise, and OK."""
    system, start = hanging(dtype)
    held = js.System(system.net, 0.5, system.forces, free=np.zeros(6, bool))
    found = js.equilibrium(held, start)
    np.testing.assert_array_equal(found.state.points, start.points)
    assert bool(found.status.is_ok)


def test_lanes_are_loops():
    """A vmap over stiffnesses is the loop over them."""
    system, start = hanging()
    stiffness = jnp.asarray([20.0, 50.0, 200.0])

    def tip(k):
        return js.equilibrium(js.replace(system, stiffness=k), start).state.position.y[-1]

    lanes = jax.vmap(tip)(stiffness)
    np.testing.assert_allclose(lanes, -5 - 0.5 * 9.81 * 15 / stiffness, rtol=1e-9)


@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"tolerance": float("nan")}, {"max_iter": 0}])
def test_wrong_settings_are_refused(wrong):
    """A tolerance or a count that cannot work is a ValueError that names it."""
    system, start = hanging()
    with pytest.raises(ValueError, match=next(iter(wrong))):
        js.equilibrium(system, start, **wrong)
