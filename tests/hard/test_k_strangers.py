"""What strangers' first programs ran into, and public reports of like tools restated: each with its right value."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
import pytest

import jaxspring as js

FREE_FALL = js.Graph.from_edges(np.zeros((0, 2), int), 1)


class Pull:
    """A load with a field, as a controller or a table has."""

    def __init__(self, size):
        self.size = size

    def __call__(self, time):
        return js.Vector((jnp.full(1, self.size) + 0 * time,))


class Slotted:
    """The same in a slot."""

    __slots__ = ("size",)

    def __init__(self, size):
        self.size = size

    def __call__(self, time):
        return js.Vector((jnp.full(1, self.size) + 0 * time,))


def of_method(size):
    return Pull(size).__call__


def of_closure(size):
    pull = Pull(size)
    return lambda time: pull(time)


ONE = js.lattice(1)
AT_REST = js.State.from_points(ONE, [[0.0]])


@pytest.mark.parametrize("load", [Pull, Slotted, of_method, of_closure])
def test_k2_a_load_that_holds_another_number_is_another_load(load):
    """After a resume, Verlet's first kick is by the load that acts now: v = 1 + 0.1 * 101."""
    weak, strong = (js.System(ONE, 1.0, js.Load(load(size))) for size in (1.0, 101.0))
    first = js.rollout(weak, AT_REST, js.VelocityVerlet(), 0.1, 10)
    then = js.rollout(strong, first.state, js.VelocityVerlet(), 0.1, 1, resume=first.resume)
    assert float(then.state.velocities[0, 0]) == pytest.approx(11.1, rel=1e-12)


def test_k1_a_load_that_was_changed_in_place_acts_as_it_is():
    """A program that was compiled for a load does not serve the same object holding another number: v = 1 + 1 * 101."""
    load = Pull(1.0)
    first = js.rollout(js.System(ONE, 1.0, js.Load(load)), AT_REST, js.VelocityVerlet(), 0.1, 10)
    load.size = 101.0
    then = js.rollout(js.System(ONE, 1.0, js.Load(load)), first.state, js.VelocityVerlet(), 0.1, 10)
    assert float(then.state.velocities[0, 0]) == pytest.approx(102.0, rel=1e-12)


@pytest.mark.parametrize(("height", "speed", "end"), [(0.0, 0.0, 1.0), (0.0, 1.0, 2 / 9.81)])
def test_an_event_waits_for_a_number_that_leaves_zero_to_come_back(height, speed, end):
    """Let go at rest at the level, a ball never comes back to it; thrown up it does after 2 v / g."""
    level = diffrax.Event(lambda time, state: state.position.x[0], optimistix.Newton(1e-8, 1e-8))
    system = js.System(FREE_FALL, 1.0, js.Gravity([-9.81]))
    run = js.diffeqsolve(system, js.State.from_points(FREE_FALL, [[height]], [[speed]]), t1=1.0, event=level)
    assert float(run.state.time) == pytest.approx(end, abs=1e-6)
    assert bool(run.event) is (end < 1)


@pytest.mark.parametrize("size", [1e-6, 1e-3, 1.0, 1e6])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e6])
def test_least_squares_do_not_depend_on_units(size, unit, user_mode):
    """A swing a cos(sqrt(k) t) gives back k = 50 from 45, in float32, whatever the units of lengths and stiffnesses are."""
    t = jnp.linspace(0.0, 1.0, 12)
    data = size * jnp.cos(jnp.sqrt(50.0) * t)
    fit = js.fit(lambda p: size * jnp.cos(jnp.sqrt(p["k"] / unit) * t) - data, {"k": jnp.asarray(45.0 * unit)}, js.LeastSquares(), 60)
    assert float(fit.parameters["k"]) == pytest.approx(50.0 * unit, rel=1e-4)


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet()], ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("restitution", [0.0, 0.999, 1.0])
def test_l2_friction_holds_a_node_whatever_the_restitution(stepper, restitution):
    """On a slope of 0.4 with a friction of 0.6 > tan 0.4 a node at rest stays, also where a bounce would lose nothing."""
    normal = np.array([-np.sin(0.4), np.cos(0.4)])
    system = js.System(FREE_FALL, 1.0, js.Gravity([0.0, -9.81]), rules=js.Floor((0.0, 0.0), normal, 0.6, restitution))
    run = js.rollout(system, js.State.from_points(FREE_FALL, [[0.0, 0.0]]), stepper, 0.015, 100)
    js.raise_for_status(run)
    np.testing.assert_allclose(run.state.points, 0, atol=1e-9)


def test_k9_a_fluid_in_a_box_is_watched_inside_jit():
    """Energies and limits of a fluid in a box are the same under jit as outside, where the system is a constant of the program."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 2, box=(5.0, 5.0, 5.0))
    state = js.State.from_points(net, [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]])
    system = js.System(
        net, 1.0, js.Fluid(js.fluid.LennardJones(1.0, 1.0), cutoff=js.fluid.ShiftedForce(2.0), drag=js.fluid.PairDrag(0.1, 1.5))
    )
    expected = float(system.energy(state).total)
    assert float(jax.jit(lambda s: system.energy(s).total)(state)) == pytest.approx(expected, abs=1e-12)
    run = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 2, save_every=1, observe=lambda s: system.energy(s).total)
    assert float(run.saved[0]) == pytest.approx(expected, abs=1e-6)


def test_masses_of_triangles_go_through_the_walls_of_a_box():
    """A square of 1 m^2 across both walls of a box weighs what it weighs in the middle."""
    corners = np.array([[0.5, 0.5], [9.5, 0.5], [9.5, 9.5], [0.5, 9.5]])
    triangles = [[0, 1, 2], [0, 2, 3]]
    net = js.Graph.from_edges([[0, 1], [1, 2], [2, 3], [3, 0]], 4, box=(10.0, 10.0), triangles=triangles)
    assert float(js.lumped_mass(net, corners, 1.0, triangles).sum()) == pytest.approx(1.0, rel=1e-12)


def test_faces_that_stand_twice_weigh_once(tmp_path):
    """A triangle with either side up in a file is one piece of the surface: half a square metre."""
    path = tmp_path / "sides.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 3 2 1\n")
    net, points = js.from_mesh(path)
    assert net.triangles.shape == (1, 3)
    assert float(js.lumped_mass(net, points, 1.0, net.triangles).sum()) == pytest.approx(0.5, rel=1e-12)


def test_k11_equilibria_say_that_coordinates_are_too_large(user_mode):
    """At an offset of 1e6 m float32 cannot tell springs of 1.3 m from others: PRECISION, as a rollout says."""
    net = js.lattice(12)
    system = js.System(net, 0.3, js.Springs(net, 7.0, 1.0), free=np.arange(12) % 11 > 0)
    far = js.State.from_points(net, np.stack([np.arange(12) * 1.3 + 1e6, np.zeros(12)], axis=1))
    assert bool(js.equilibrium(system, far).status.has(js.Flag.PRECISION))


def test_k12_a_lane_whose_dt_is_no_number_says_so():
    """A dt of NaN in one lane is INVALID before the first step; the other lane is as alone."""
    system = js.System(ONE, 1.0, js.Drag(0.1))
    start = js.State.from_points(ONE, [[0.0]], [[1.0]])
    run = jax.vmap(lambda dt: js.rollout(system, start, js.SymplecticEuler(), dt, 3))(jnp.array([0.1, jnp.nan]))
    assert run.status.has(js.Flag.INVALID).tolist() == [False, True]
    assert int(run.status.step[1]) == 0
