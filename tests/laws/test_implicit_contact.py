"""What rests on an obstacle is held inside an implicit solve: columns stand at their static lengths, hold and slide by friction, lift off,
ride on what moves; with the derivatives of all that.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.operators import Blocks, NodeDyads

N, STEPS = 5, 240
COLUMN = js.lattice(N)
K, G, LENGTH, MASS = 200.0, 10.0, 1.0, 2.0
WEIGHT = N * MASS * G
STATIC = LENGTH - MASS * G * np.arange(N - 1, 0, -1) / K
TILT = 0.7


class Guide(js.Force):
    """A constant force on each node, and springs to the line through the origin, without which a column topples."""

    pull: js.Vector
    across: js.Vector
    stiffness: jax.Array

    def force(self, state):
        return self.pull - (self.stiffness * state.position.dot(self.across)) * self.across

    def energy(self, state):
        return jnp.sum(0.5 * self.stiffness * state.position.dot(self.across) ** 2 - state.position.dot(self.pull))

    def stiffness_blocks(self, state, linearisation):
        wide = self.across.map(lambda a: jnp.broadcast_to(a, state.position.shape))
        return Blocks(dyads=(NodeDyads(jnp.broadcast_to(self.stiffness, state.position.shape), wide),))


class Row(NamedTuple):
    """A scene: constants k, g, height of the floor, shift of the start; a direction of them; what else there is."""

    constants: np.ndarray
    direction: np.ndarray
    normal: np.ndarray
    down: np.ndarray
    points: np.ndarray
    guide: float
    load: float
    friction: float
    drag: float
    dt: float


def row(direction=(0.0, 0.0, 0.0, 0.0), tilt=0.0, slope=0.0, lies=False, load=0.0, friction=0.0, drag=6.0, dt=0.05, h=0.0):
    """A column on a floor that is tilted together with gravity; lying along the floor where gravity has a slope of its own; hanging from
    its load where that is more than the weight. `h` goes along the direction, for differences.
    """
    normal, along = np.array([-np.sin(tilt), np.cos(tilt)]), np.array([np.cos(tilt), np.sin(tilt)])
    direction = np.array(direction, float)
    down = np.sin(slope) * along - np.cos(slope) * normal
    carried = np.arange(N) * MASS * G * 1.2 / K if load > WEIGHT else np.zeros(N)
    points = np.cumsum(np.where(np.arange(N) > 0, LENGTH, 0) + carried)[:, None] * (along if lies else normal)
    constants = np.array([K, G, 0.0, 0.0]) + h * direction
    guide = 0.0 if lies else 1e3
    return Row(constants, direction, normal, down, points, *(np.array(a, float) for a in (guide, load, friction, drag, dt)))


def ended(constants, scene, stepper):
    """Places, the floor's impulses in the last step, and the status."""
    k, g, height, shift = constants
    floor = js.Floor(height * scene.normal, scene.normal, scene.friction)
    pull = jnp.zeros((N, 2)).at[-1].set(scene.load * scene.normal)
    across = js.Vector((scene.normal[1], -scene.normal[0]))
    guide = Guide(COLUMN.vector_field(pull, "pull"), across, scene.guide)
    forces = (js.Springs(COLUMN, k, LENGTH), js.Gravity(g * scene.down), js.Drag(scene.drag), guide)
    system = js.System(COLUMN, MASS, forces, rules=(floor, js.contact.Impulses()))
    run = js.rollout(system, js.State.from_points(COLUMN, scene.points + shift * scene.normal[None]), stepper, scene.dt, STEPS)
    (given,) = js.contact.impulses(system, run.state)
    return run.state.points, (jnp.stack(given.normal.components, -1), jnp.stack(given.friction.components, -1), run.status.flags)


CONE = np.arctan(0.5)
BY = {"k": (100.0, 0.0, 0.0, 0.0), "g": (0.0, 1.0, 0.0, 0.0), "floor": (0.0, 0.0, 1.0, 0.0), "all": (0.0, 0.0, 1.0, 1.0)}
H = 1e-4
ROWS = {
    "upright": row(BY["k"]),
    "tilted": row(BY["g"], TILT),
    "tilted by floor": row(BY["floor"], TILT),
    "relieved": row(load=0.6 * WEIGHT),
    "lifted": row(load=1.2 * WEIGHT, drag=0.0, dt=0.005, tilt=TILT),
    "sticks": row(lies=True, friction=0.5, slope=0.99 * CONE, tilt=TILT),
    "slides": row(lies=True, friction=0.5, slope=1.02 * CONE, drag=0.0, dt=0.005),
}
# On the floor, pressed all the time, it swings.
SWINGS = {f"{by} {h:+.0f}": row(BY[by], TILT, drag=0.0, dt=0.02, h=h * H) for by in ("k", "g", "all") for h in (-1, 0, 1)}
STEPPERS = {
    "BackwardEuler": js.BackwardEuler(js.JaxCG(tolerance=1e-12)),
    "ImplicitMidpoint": js.ImplicitMidpoint(),
    "BDF2 in one solve": js.BDF2(js.Skyline(COLUMN), newton=False),
}


def followed(rows, stepper, has_derivative):
    """Of every row by its name: places, their derivatives, impulses along the normal and along the floor; all went well."""

    def both(scene):
        if not has_derivative:
            return ended(scene.constants, scene, stepper)
        points, slopes, rest = jax.jvp(lambda c: ended(c, scene, stepper), (scene.constants,), (scene.direction,), has_aux=True)
        return (points, slopes), rest

    stacked = Row(*(np.stack(a) for a in zip(*rows.values(), strict=True)))
    places, (normal, friction, flags) = jax.tree.map(np.asarray, jax.jit(jax.vmap(both))(stacked))
    np.testing.assert_array_equal(flags, 0)
    points, slopes = places if has_derivative else (places, [None] * len(rows))
    return {name: (points[i], slopes[i], normal[i], friction[i]) for i, name in enumerate(rows)}


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPPERS)
def test_a_column_on_a_floor(name):
    """Static lengths l - (weight above) / k, though N g dt^2 is 12 cm, and the weight as reaction; it takes off where it is pulled, holds
    below the cone of friction, slides beyond. For one stepper the derivatives: of closed forms, and of differences while it swings.
    """
    has_derivative = name == "BackwardEuler"
    found = followed(ROWS | SWINGS if has_derivative else ROWS, STEPPERS[name], has_derivative)
    for still in ("upright", "tilted", "tilted by floor"):
        (places, _, pushed, _), up = found[still], ROWS[still].normal
        np.testing.assert_allclose(np.diff(places @ up), STATIC, atol=1e-6)
        np.testing.assert_allclose(places[0], 0, atol=1e-14)
        np.testing.assert_allclose(pushed[0] / 0.05, WEIGHT * up, atol=1e-4)
        np.testing.assert_array_equal(pushed[1:], 0)
    np.testing.assert_allclose(found["relieved"][2][0] / 0.05, 0.4 * WEIGHT * ROWS["relieved"].normal, atol=1e-4)
    time, near = STEPS * 0.005, 0.01 if name == "BackwardEuler" else 1e-4
    places, _, pushed, _ = found["lifted"]
    way = (places - ROWS["lifted"].points) @ ROWS["lifted"].normal
    np.testing.assert_allclose(way, 0.5 * 0.2 * G * time**2, rtol=near)
    np.testing.assert_array_equal(pushed, 0)
    np.testing.assert_allclose(found["sticks"][0], ROWS["sticks"].points, atol=1e-15)
    places, _, pushed, rubbed = found["slides"]
    rate = G * (np.sin(1.02 * CONE) - 0.5 * np.cos(1.02 * CONE))
    # Of order 1, backward Euler is off by a share of the way of half a step's velocity.
    off = 0.5 * 0.005 * time * 0.5 * G if name == "BackwardEuler" else 0.0
    np.testing.assert_allclose((places - ROWS["slides"].points)[:, 0], 0.5 * rate * time**2, rtol=near, atol=off)
    np.testing.assert_allclose(np.linalg.norm(rubbed, axis=-1), 0.5 * pushed[:, 1], rtol=1e-9)
    if has_derivative:
        by_k, by_g, by_floor = (found[row_name][1] @ ROWS[row_name].normal for row_name in ("upright", "tilted", "tilted by floor"))
        np.testing.assert_allclose(by_k, 100.0 * np.cumsum([0, *(LENGTH - STATIC)]) / K, atol=1e-7)
        np.testing.assert_allclose(by_g, np.cumsum([0, *(STATIC - LENGTH)]) / G, atol=1e-7)
        np.testing.assert_allclose(by_floor, 1.0, atol=1e-6)
        for by in ("k", "g", "all"):
            difference = (found[f"{by} +1"][0] - found[f"{by} -1"][0]) / (2 * H)
            np.testing.assert_allclose(found[f"{by} +0"][1], difference, atol=1e-8, err_msg=by)


class Carrier(js.contact.Obstacle):
    """A floor that rises with an acceleration and runs to the right, or a disc below the origin."""

    acceleration: jax.Array
    runs: jax.Array
    is_disc: jax.Array

    def distance(self, position, time):
        plane = position.y - 0.5 * self.acceleration * time * time
        disc = js.Vector((position.x, position.y + 3.0)).norm() - 3.0
        return jnp.where(self.is_disc > 0, disc, plane)

    def velocity(self, position, time):
        zero = jnp.zeros_like(position.x)
        return js.Vector((zero + self.runs, jnp.where(self.is_disc > 0, zero, zero + self.acceleration * time)))

    @property
    def moves(self):
        return True


@pytest.mark.slow
def test_a_column_on_what_moves():
    """It rides on a floor that rises, heavier by its acceleration; a floor that falls faster than it leaves it; a belt takes it along; on a
    disc it stands as on a floor.
    """

    def end(acceleration, runs, is_disc, points):
        ground = js.contact.Contact(Carrier(acceleration, runs, is_disc), friction=0.5)
        forces = (js.Springs(COLUMN, K, LENGTH), js.Gravity((0.0, -G)), js.Dashpots(COLUMN, 80.0))
        system = js.System(COLUMN, MASS, forces, rules=(ground, js.contact.Impulses()))
        run = js.rollout(system, js.State.from_points(COLUMN, points), js.BackwardEuler(js.JaxCG(tolerance=1e-12)), 0.05, 160)
        return run.state.points, js.contact.impulses(system, run.state)[0].normal.y[0], run.status.flags

    stands, lies = (np.outer(LENGTH * np.arange(N), axis) for axis in ((0.0, 1.0), (1.0, 0.0)))
    numbers = np.array([[3.0, 0.0, 0.0], [-12.0, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
    starts = np.stack([stands, stands, lies, stands])
    points, pushed, flags = (np.asarray(a) for a in jax.jit(jax.vmap(lambda p, x: end(*p, x)))(numbers, starts))
    np.testing.assert_array_equal(flags, 0)
    rises, falls, belt, disc = points
    time = 160 * 0.05
    np.testing.assert_allclose(rises[0], [0.0, 0.5 * 3.0 * time**2], atol=1e-12)
    np.testing.assert_allclose(np.diff(rises[:, 1]), LENGTH - (LENGTH - STATIC) * (G + 3.0) / G, atol=1e-5)
    assert falls[:, 1].min() > 0.5 * -12.0 * time**2 + 10.0
    np.testing.assert_allclose(disc[:, 1], np.cumsum([0, *STATIC]), atol=1e-6)
    # It takes hold after a slip of v^2 / (2 mu g), to a step's way.
    np.testing.assert_allclose(belt - lies, np.broadcast_to([0.5 * time - 0.5**2 / (2 * 0.5 * G), 0.0], (N, 2)), atol=0.02)
    np.testing.assert_array_equal(belt[:, 1], 0)
    np.testing.assert_allclose(pushed[[0, 3]] / 0.05, [WEIGHT * (G + 3.0) / G, WEIGHT], atol=1e-4)
    assert pushed[1] == 0


@pytest.mark.slow
def test_a_block_that_sticks_on_a_slope():
    """Its lowest nodes stay where they are, bit by bit; above them the block takes the shape of one whose lowest nodes are held: it neither
    shears down nor creeps in steps of 0.05 s, and friction carries its weight.
    """
    block = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
    points, slope = block.grid(1.0), 0.4
    low = points[:, 1] == 0
    gravity = js.Gravity(G * np.array([np.sin(slope), -np.cos(slope)]))
    springs = js.Springs(block, 4e3, block.lengths(points))
    start = js.State.from_points(block, points)
    held = js.equilibrium(js.System(block, MASS, (springs, gravity), ~low), start).state.points
    rules = (js.Floor((0.0, 0.0), (0.0, 1.0), friction=2.0), js.contact.Impulses())
    system = js.System(block, MASS, (springs, gravity, js.Drag(8.0)), rules=rules)
    run = js.rollout(system, start, js.BackwardEuler(js.JaxCG(tolerance=1e-12)), 0.05, 240)
    js.raise_for_status(run)
    np.testing.assert_array_equal(run.state.points[low], points[low])
    np.testing.assert_allclose(run.state.points, held, atol=1e-6)
    (given,) = js.contact.impulses(system, run.state)
    weight = len(points) * MASS * G * np.array([np.sin(slope), -np.cos(slope)])
    total = np.array([float(jnp.sum(a + b)) for a, b in zip(given.normal, given.friction, strict=True)]) / 0.05
    np.testing.assert_allclose(total, -weight, atol=1e-4)
    pushed = np.asarray(block.flatten_nodes(given.normal.y))
    assert pushed[low].min() > 0
    np.testing.assert_array_equal(pushed[~low], 0)


def test_a_scene_without_obstacles_holds_none_of_it():
    """Its program is that of a scene whose stepper knows of no obstacles: no direction is taken, and nothing is carried."""
    system = js.System(COLUMN, MASS, (js.Springs(COLUMN, K, LENGTH), js.Gravity((0.0, -G)))).bind(jnp.float64)
    start = js.State.from_points(COLUMN, np.c_[np.zeros(N), np.arange(N)])
    memory = js.BackwardEuler().init(system, start)
    assert memory.pushed is None
    assert system.resting(start, start.position, jnp.asarray(0.1), jnp.asarray(0.1)) is None
    program = str(jax.make_jaxpr(lambda s: js.BackwardEuler().step(system, s, jnp.asarray(0.1), memory)[0].position)(start))
    floor = eqx.tree_at(lambda s: s.rules, system, (js.Floor((0.0, -1e3), (0.0, 1.0)),), is_leaf=lambda leaf: leaf is None)
    memory = js.BackwardEuler().init(floor, start)
    other = str(jax.make_jaxpr(lambda s: js.BackwardEuler().step(floor, s, jnp.asarray(0.1), memory)[0].position)(start))
    assert len(program) < 0.8 * len(other)


@pytest.mark.slow
def test_reverse_mode_in_float32():
    """The gradient by the stiffness of a column that sinks onto its floor is that of central differences in float64, and the tangent's."""
    chain, number = js.lattice(4), np.float32
    start = js.State.from_points(chain, jnp.arange(4, dtype=number)[:, None])

    @jax.jit
    def top(k):
        forces = (js.Springs(chain, k, number(1)), js.Gravity(jnp.full(1, -10, number)), js.Drag(number(2)))
        system = js.System(chain, number(1), forces, rules=js.Floor(jnp.zeros(1, number), jnp.ones(1, number)))
        return js.rollout(system, start, js.BackwardEuler(), number(0.05), 20).state.points[-1, 0]

    k = number(100)
    slope = jax.grad(top)(k)
    assert slope.dtype == number
    assert float(slope) == pytest.approx(0.00996215018, rel=1e-3)
    assert float(jax.jvp(top, (k,), (number(1),))[1]) == pytest.approx(float(slope), rel=1e-4)
