"""The energy ledger closes through melting, and its own error falls with dt."""

import jax
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
GROUND, UP = (0.0, 0.0), (0.0, 1.0)


def melting_sheet(dt, duration=0.4):
    """A stretched sheet with weight and drag that is heated from below until its lower springs fuse, over a floor."""
    along = js.lattice((3, 4))
    forces = (js.Springs(NET, js.thermal.ThermalStiffness(40.0, 310.0, 350.0), 0.9), js.Gravity((0.0, -6.0)), js.Drag(0.3))
    heat = js.Heat(along, 1.0, 1.0, boundaries=js.thermal.HotPlane(GROUND, UP, 500.0, 6.0, 1.0, reach=0.5))
    system = js.System(NET, 1.0, forces, rules=(js.Ledger(), heat, js.Fusing(NET, 350.0), js.Floor(GROUND, UP, 0.2)))
    start = js.State.from_points(NET, NET.grid() + np.array([0.0, 0.02]), temperature=300.0)
    run = js.rollout(system, start, js.SymplecticEuler(), dt, round(duration / dt))
    js.raise_for_status(run)
    return system, run.state, js.energy_ledger(system, run.state)


@pytest.mark.slow
def test_the_ledger_closes():
    """All entries sum to the change of the energy; columns are the system's own energies; softening, fusing and heat are named."""
    system, end, book = melting_sheet(2e-3)
    assert abs(book["residual"]) < 1e-9
    energy = system.energy(end)
    assert book["end"]["kinetic"] == pytest.approx(float(energy.kinetic), rel=1e-12)
    assert book["end"]["Springs"] == pytest.approx(float(energy.potential[0]), rel=1e-12)
    rules = book["rules"]
    assert 0 < NET.flatten(end.alive).sum() < NET.n_springs
    assert rules["Heat"]["Springs"] < 0  # softened
    assert rules["Heat"]["heat"] > 0
    assert book["end"]["heat"] - book["start"]["heat"] == pytest.approx(rules["Heat"]["heat"], abs=1e-9)
    assert rules["Fusing"]["kinetic"] == rules["Fusing"]["heat"] == 0
    assert rules["Floor"]["kinetic"] < 0
    assert book["work"]["Drag"] < 0
    assert float(end.position.y.min()) >= 0
    total = sum(np.asarray(p) for p in book["impulses"].values())
    np.testing.assert_allclose(total, system.momentum(end), atol=1e-12)
    np.testing.assert_array_equal(book["impulses"]["Fusing"], 0)


@pytest.mark.slow
def test_the_error_of_the_steps_falls_with_dt():
    """What the ledger calls integration is of order one: an eighth of dt brings it to an eighth, within a third."""
    coarse, fine = (abs(melting_sheet(dt)[2]["integration"]) for dt in (4e-3, 5e-4))
    assert 5 < coarse / fine < 12


def test_drag_is_the_work_of_drag():
    """A free node slowed by drag loses what the ledger books, to rounding: a kick's work is dt F (v + v') / 2."""
    net = js.lattice(1)
    system = js.System(net, 2.0, js.Drag(0.5), rules=js.Ledger())
    run = js.rollout(system, js.State.from_points(net, [[0.0]], [[3.0]]), js.SymplecticEuler(), 0.1, 10)
    book = js.energy_ledger(system, run.state)
    assert book["work"]["Drag"] == pytest.approx(book["end"]["kinetic"] - 9.0, rel=1e-13)
    assert abs(book["integration"]) < 1e-13


def resting_on_a_floor(height, dt=0.01, n_steps=100):
    """The books of one node of 2 kg that starts this high [m] over a floor, under 10 m/s^2."""
    net = js.lattice(1)
    system = js.System(net, 2.0, js.Gravity((0.0, -10.0)), rules=(js.Floor(GROUND, UP), js.Ledger()))
    return js.energy_ledger(system, js.rollout(system, js.State.from_points(net, [[0.0, height]]), js.SymplecticEuler(), dt, n_steps).state)


def test_a_node_at_rest_on_a_floor_books_nothing():
    """It falls g dt in each step and is put back: neither the stepper nor the floor has done work."""
    book = resting_on_a_floor(0.0)
    assert abs(book["integration"]) < 1e-13
    assert all(abs(value) < 1e-13 for value in book["rules"]["Floor"].values())
    np.testing.assert_allclose(book["impulses"]["Floor"], [0, 20.0], rtol=1e-12)  # m g t


@pytest.mark.slow
def test_a_floor_takes_the_energy_of_the_fall():
    """A node that falls 1 m is stopped by the floor, which takes m g h; the error of one step at impact falls with dt."""
    errors = []
    for dt in (4e-3, 5e-4):
        book = resting_on_a_floor(1.0, dt, round(0.6 / dt))
        assert book["end"]["kinetic"] == pytest.approx(0, abs=1e-12)
        assert book["rules"]["Floor"]["kinetic"] == pytest.approx(-20.0, abs=100 * dt)
        errors.append(abs(book["integration"]))
        assert errors[-1] < 2 * 10 * 4.5 * dt  # m g v dt: how far gravity reaches in one step
    assert errors[-1] < errors[0]


def test_a_start_below_the_floor_stays():
    """A node that starts 1 m below counts from there: it rests, and nobody has done work."""
    book = resting_on_a_floor(-1.0)
    assert all(abs(value) < 1e-13 for value in book["rules"]["Floor"].values())
    assert abs(book["integration"]) < 1e-13


@pytest.mark.slow
def test_a_bounce_is_booked_as_what_it_takes():
    """Under Verlet a ball's bounces take m (e^2 - 1) w^2 / 2 each, nothing at e = 1, and the stepper adds nothing, to rounding."""
    net = js.lattice(1)
    for e in (1.0, 0.5):
        system = js.System(net, 2.0, js.Gravity((0.0, -10.0)), rules=(js.Floor(GROUND, UP, restitution=e), js.Ledger()))
        run = js.rollout(system, js.State.from_points(net, [[0.0, 1.0]]), js.VelocityVerlet(), 0.01, 120)
        book = js.energy_ledger(system, run.state)
        n_bounces = 1 if e == 1 else 3  # at 0.447 s and, of e = 0.5, at 0.894 and 1.118 s; of e = 1 the next is at 1.342 s
        assert book["rules"]["Floor"]["kinetic"] == pytest.approx(-20 * (1 - e ** (2 * n_bounces)), abs=1e-11)
        assert abs(book["integration"]) < 1e-11
        assert book["impulses"]["Floor"][1] == pytest.approx(2 * 20**0.5 * (1 + e) * sum(e**i for i in range(n_bounces)), rel=1e-12)


@pytest.mark.slow
def test_two_floors_have_their_own_entries():
    """Between a floor and a roof each takes what its own impacts take; without weight the one that is met later is met more slowly."""
    net = js.lattice(1)
    walls = (js.Floor(GROUND, UP, restitution=0.5), js.Floor((0.0, 1.0), (0.0, -1.0), restitution=0.9), js.Ledger())
    system = js.System(net, 1.0, rules=walls)
    run = js.rollout(system, js.State.from_points(net, [[0.0, 0.5]], [[0.3, -2.0]]), js.SymplecticEuler(), 0.1, 15)
    book = js.energy_ledger(system, run.state)
    assert book["rules"]["Floor 1"]["kinetic"] == pytest.approx(0.5 * (1 - 4), abs=1e-13)  # at 0.25 s, 2 m/s to 1
    assert book["rules"]["Floor 2"]["kinetic"] == pytest.approx(0.5 * (0.9**2 - 1), abs=1e-13)  # at 1.25 s, 1 m/s to 0.9
    np.testing.assert_allclose([book["impulses"][f"Floor {i}"][1] for i in (1, 2)], [3, -1.9], rtol=1e-13)
    assert abs(book["integration"]) < 1e-13


@pytest.mark.slow
def test_a_ledger_changes_nothing():
    """The rules beside a ledger act in their order, to the last bit as without it: heat first, then what it melts, contact last."""
    start = js.State.from_points(NET, NET.grid() + np.array([0.0, 0.02]), temperature=300.0)
    frames = {}
    for has_books in (True, False):
        heat = js.Heat(js.lattice((3, 4)), 1.0, 1.0, boundaries=js.thermal.HotPlane(GROUND, UP, 500.0, 6.0, 1.0, reach=0.5))
        rules = (heat, js.Fusing(NET, 350.0), js.Floor(GROUND, UP, 0.2))
        forces = (js.Springs(NET, js.thermal.ThermalStiffness(40.0, 310.0, 350.0), 0.9), js.Gravity((0.0, -6.0)))
        system = js.System(NET, 1.0, forces, rules=(js.Ledger(), *rules) if has_books else rules)
        # Every step: in another order springs would fuse one step later.
        frames[has_books] = js.rollout(system, start, js.SymplecticEuler(), 2e-3, 200, save_every=1, observe=seen).saved
    for a, b in zip(frames[True], frames[False], strict=True):
        np.testing.assert_array_equal(a, b)


def seen(state):
    """What a rule may change: places, velocities, temperatures, and which springs are alive."""
    return (*state.position, *state.velocity, state.temperature, *state.alive.families)


FRAME = 100  # steps


def molten_pair(rule, drag=None, dt=1e-3, n_steps=1, longest=None):
    """Two free particles and one on a spring that is heated above 350 K at once; the books, the system and the end. With `longest` that is
    the frame after n_steps of so many: runs of one length and one distance of frames share a program.
    """
    net = js.Graph.from_edges(np.array([[2, 3]]), 4)
    fluid = js.Fluid(js.fluid.SlideLaw(1.0, 1.0), drag=drag, molten=js.fluid.Molten(net))
    system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), fluid), rules=(rule(net), js.Ledger()))
    points = [[0.0, 0.0], [1.3, 0.0], [0.0, 0.8], [1.3, 0.9]]
    start = js.State.from_points(net, points, [[0.5, 0], [-0.5, 0], [0, 0.3], [0, 0]], temperature=400.0)
    run = js.rollout(system, start, js.SymplecticEuler(), dt, longest or n_steps, save_every=longest and FRAME)
    end = run.state if longest is None else jax.tree.map(lambda a: a[n_steps // FRAME - 1], run.saved)
    return js.energy_ledger(system, end), system, end


@pytest.mark.slow
def test_what_fusing_does_to_the_fluid_is_fusings():
    """A spring that fuses lets its particles attract: the change of the fluid's potential is booked by that rule, in that step."""
    book, system, end = molten_pair(lambda net: js.Fusing(net, 350.0))
    potential = float(system.energy(end).potential[1])
    assert book["end"]["Fluid"] == pytest.approx(potential, rel=1e-12)
    whole, _, _ = molten_pair(lambda net: js.Fusing(net, 450.0))
    assert abs(potential - whole["end"]["Fluid"]) > 0.1
    assert book["rules"]["Fusing"]["Fluid"] == pytest.approx(potential - whole["end"]["Fluid"], rel=1e-12)
    assert abs(book["residual"]) < 1e-12


@pytest.mark.slow
def test_work_of_drag_between_particles():
    """Of a fluid with drag, only the drag is work; the rest is its potential. What is left is the error of the steps, of order one."""
    error = []
    for n_steps in (100, 800):
        book, system, end = molten_pair(lambda net: js.Fusing(net, 350.0), js.fluid.PairDrag(0.5, 2.0), 0.4 / n_steps, n_steps, longest=800)
        assert book["work"]["Fluid"] < -0.05
        error.append(abs(book["integration"]))
    assert 6 < error[0] / error[1] < 10
    assert book["end"]["Fluid"] == pytest.approx(float(system.energy(end).potential[1]), rel=1e-12)
