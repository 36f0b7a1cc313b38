"""Hard case L8: the strain limit under renumbering and reflection, and where both ends are held too far apart."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.cloth import StrainLimit

SIDE = 8
SHEET = js.lattice((SIDE, SIDE), js.STRUCTURAL + js.SHEAR)


def corners_held(n=SIDE * SIDE):
    """All but the two corners of the first row."""
    free = np.ones(n, bool)
    free[[0, SIDE - 1]] = False
    return free


def flat(net):
    """The lattice's grid in space, 1 m wide, a little disturbed."""
    grid = np.asarray(net.grid(), float) / (SIDE - 1)
    rng = np.random.default_rng(1)
    return np.c_[grid, np.zeros(len(grid))] + 1e-3 * rng.standard_normal((len(grid), 3))


def hang(net, points, free, mass=1 / SIDE**2, n_steps=100, sweeps=30, rest=None, strain=0.1):
    """A run under gravity of springs far too soft to keep the limit, and the largest strain."""
    rest = net.lengths(points) if rest is None else rest
    rule = StrainLimit(net, strain, sweeps=sweeps)
    system = js.System(net, mass, (js.Springs(net, 5.0, rest), js.Gravity((0.0, 0.0, -9.81))), free=free, rules=rule)
    run = js.rollout(system, js.State.from_points(net, points), js.SymplecticEuler(), 5e-3, n_steps)
    return run, float(jnp.max(net.flatten(system.forces[0].strain(run.state))))


def test_l8_renumbering_and_reflection():
    """A graph with its nodes and springs in another order, and a reflected lattice, come out the same to rounding."""
    rng = np.random.default_rng(0)
    points, free = flat(SHEET), corners_held()
    edges = np.asarray(SHEET.edges)
    run, _ = hang(SHEET, points, free, n_steps=40)
    wanted = np.asarray(run.state.points)
    assert np.ptp(wanted[:, 2]) > 0.05
    graph, _ = hang(js.Graph.from_edges(edges, len(points)), points, free, n_steps=40)
    np.testing.assert_allclose(graph.state.points, wanted, atol=1e-9)
    order, springs = rng.permutation(len(points)), rng.permutation(len(edges))
    number = np.argsort(order)
    other, _ = hang(js.Graph.from_edges(number[edges[springs]], len(points)), points[order], free[order], n_steps=40)
    np.testing.assert_allclose(np.asarray(other.state.points)[number], wanted, atol=1e-9)
    mirror = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)[:, ::-1].ravel()
    reflected, _ = hang(SHEET, points[mirror] * [-1, 1, 1], free[mirror], n_steps=40)
    np.testing.assert_allclose(np.asarray(reflected.state.points)[mirror] * [-1, 1, 1], wanted, atol=1e-9)


def test_l8_the_limit_is_kept():
    """No spring is beyond the limit and its tolerance after a run; without the rule they are, many times over."""
    points = flat(SHEET)
    run, worst = hang(SHEET, points, corners_held(), sweeps=300, n_steps=40)
    assert js.raise_for_status(run.status) is None
    assert 0.09 < worst < 0.1 + 1e-3
    _, free_of_it = hang(SHEET, points, corners_held(), strain=1e6, n_steps=40)
    assert free_of_it > 0.3


def test_l8_held_too_far_apart():
    """Reported with how many springs, and nothing moves without end: the run stays finite and where it is held."""
    net = js.lattice(3)
    rule = StrainLimit(net, 0.1)
    system = js.System(net, 1.0, js.Springs(net, 10.0, 1.0), free=[False, True, False], rules=rule)
    start = js.State.from_points(net, [[0.0], [1.1], [3.0]])
    run = js.rollout(system, start, js.SymplecticEuler(), 1e-2, 50)
    assert run.status.has(js.Flag.STRAIN)
    assert int(run.status.count) == 2
    assert int(run.status.step) == 1
    with pytest.warns(js.StabilityWarning, match="held too far apart"):
        js.raise_for_status(run.status)
    np.testing.assert_allclose(run.state.points[[0, 2], 0], [0.0, 3.0])
    assert 1.1 < float(run.state.points[1, 0]) < 1.9


def test_one_step_in_closed_form():
    """Two nodes part by their masses; the velocity is what led there; momentum and centre of mass stay. One held: the other moves alone."""
    net, dt = js.lattice(2), 0.01
    rule = StrainLimit(net, 0.1, tolerance=0.0)

    def step(free, rules):
        system = js.System(net, np.array([1.0, 3.0]), js.Springs(net, 0.0, 1.0), free=free, rules=rules)
        start = js.State.from_points(net, [[0.0, 0.0], [1.5, 0.0]], [[-1.0, 0.5], [0.2, 0.0]])
        return js.rollout(system, start, js.SymplecticEuler(), dt, 1).state

    plain, limited = step(None, ()), step(None, rule)
    gap = np.asarray(plain.points[1] - plain.points[0])
    over = np.linalg.norm(gap) - 1.1
    unit, weights = gap / np.linalg.norm(gap), np.array([1.0, 1 / 3]) / (1 + 1 / 3)
    moved = np.array([weights[0] * over * unit, -weights[1] * over * unit])
    np.testing.assert_allclose(limited.points, plain.points + moved, atol=1e-13)
    np.testing.assert_allclose(limited.velocities, plain.velocities + moved / dt, atol=1e-11)
    np.testing.assert_allclose(np.array([1.0, 3.0]) @ limited.points, np.array([1.0, 3.0]) @ plain.points, atol=1e-13)
    held = step([False, True], rule)
    np.testing.assert_allclose(held.points[0], [0.0, 0.0])
    assert float(jnp.linalg.norm(held.points[1])) == pytest.approx(1.1, abs=1e-12)


def test_some_springs_alone():
    """By family, and a large number for none; a broken spring has no limit; gradients stay finite."""
    net = js.lattice((4, 4), js.STRUCTURAL + js.SHEAR + js.BEND)
    families = {js.STRUCTURAL: 0.1, js.SHEAR: 0.1, js.BEND: 1e6}
    rule = StrainLimit(net, families, sweeps=100)
    grid = np.asarray(net.grid(), float)
    start = js.State.from_points(net, 1.3 * grid)
    rest = net.lengths(grid)

    def width(rest, alive=None):
        system = js.System(net, 1.0, js.Springs(net, 1.0, rest), rules=rule)
        state = start if alive is None else dataclasses.replace(start, alive=alive)
        end = js.rollout(system, state, js.SymplecticEuler(), 1e-3, 1).state
        return jnp.ptp(end.points[:, 0])

    assert float(width(rest)) == pytest.approx(3.3, rel=2e-3)
    assert np.isfinite(jax.jit(jax.grad(width))(rest)).all()
    broken = net.split(jnp.zeros(net.n_springs, bool))
    assert float(width(rest, broken)) == pytest.approx(3.9, rel=1e-6)
    batch = jax.vmap(width)(jnp.stack([rest, 2 * rest]))
    np.testing.assert_allclose(batch, [float(width(rest)), 3.9], rtol=1e-3)


def test_what_cannot_be_is_refused():
    """By name: a negative strain, a NaN, no sweeps, no springs, springs of a projection, no rest length."""
    net = js.lattice(3)
    for wrong, word in (
        ({"strain": -0.1}, "strain"),
        ({"strain": np.array([0.1, np.nan])}, "strain"),
        ({"sweeps": 0}, "sweeps"),
        ({"tolerance": -1.0}, "tolerance"),
    ):
        with pytest.raises(ValueError, match=word):
            StrainLimit(net, **wrong)
    with pytest.raises(ValueError, match="Springs"):
        js.System(net, 1.0, js.Gravity((0.0,)), rules=StrainLimit(net))
    with pytest.raises(ValueError, match="axes"):
        js.System(net, 1.0, js.Springs(net, 1.0, 1.0, axes=(0,)), rules=StrainLimit(net))
    with pytest.raises(ValueError, match="rest length"):
        js.System(net, 1.0, js.Springs(net, 1.0), rules=StrainLimit(net))
