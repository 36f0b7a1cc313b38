"""Hard cases L1 to L4 on obstacles of any form: bounces, slides and corners are right in value and derivative, and nothing goes through."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxspring as js

PAIR = js.lattice(2)


class Body(js.contact.Obstacle):
    """A disc, or a plane, that swings along y; which of them, by `is_disc`. Its surface runs along itself, to the right above."""

    centre: jax.Array
    normal: jax.Array
    radius: jax.Array
    swing: jax.Array
    is_disc: jax.Array
    runs: jax.Array

    def from_centre(self, position, time):
        return position - js.Vector((self.centre[0], self.centre[1] + self.swing[0] * jnp.sin(self.swing[1] * time)))

    def velocity(self, position, time):
        here = self.from_centre(position, time)
        n = js.Vector(tuple(jnp.where(self.is_disc > 0, a / here.norm(), b) for a, b in zip(here, self.normal, strict=True)))
        return self.runs * js.Vector((n.y, -n.x))

    def distance(self, position, time):
        here = self.from_centre(position, time)
        plane = here.dot(js.Vector((self.normal[0], self.normal[1])))
        return jnp.where(self.is_disc > 0, here.norm() - self.radius, plane)

    @property
    def moves(self):
        return True


class Well(js.Force):
    """A spring of length zero to height 1, vertical."""

    stiffness: jax.Array

    def force(self, state):
        return js.Vector((jnp.zeros_like(state.position.x), -self.stiffness * (state.position.y - 1)))

    def energy(self, state):
        return 0.5 * jnp.sum(self.stiffness * (state.position.y - 1) ** 2)


# x, y, vx, vy of two nodes; e, g, R, amplitude, frequency, stiffness of the well, drag, dashpot, T; is_disc, slope of the second plane
FAR = (1.0, 60.0, 0.0, 0.0)
CASES = {
    #            node 0               node 1                 e    g     R    A    w    k     c    cd   T     disc  corner
    "plane": (0.2, 1.0, 0.5, 0.3, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.75, 0, 0),
    "moving plane": (0.2, 1.0, 0.5, 0.3, *FAR, 0.8, 10.0, 1.0, 0.1, 5.0, 0.0, 0.0, 0.0, 0.75, 0, 0),
    "disc": (-0.4, 1.6, 1.0, -1.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.6, 1, 0),
    "moving disc": (-0.4, 1.6, 1.0, -1.0, *FAR, 1.0, 10.0, 1.0, 0.05, 7.0, 0.0, 0.0, 0.0, 0.6, 1, 0),
    "corner": (0.9, 1.3, 0.5, 0.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0, 1),
    "spring": (0.0, 1.0, 0.0, -8.0, 9.0, 1.0, 0.0, 0.0, 0.7, 5.0, 1.0, 0.0, 1.0, 30.0, 0.0, 0.0, 0.7, 0, 0),
    "drag": (0.0, 1.0, 0.0, -1.0, *FAR, 0.8, 10.0, 1.0, 0.0, 1.0, 0.0, 1.5, 0.0, 0.75, 0, 0),
    "dashpot": (0.0, 0.6, 0.0, -2.0, 0.0, 1.5, 0.0, -0.5, 0.7, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.9, 1.0, 0, 0),
}
N_STEPS = 400


def obstacles(p, disc, corner):
    """A body, and a second plane: far below, or with the first a corner that opens upward."""
    nought, one = jnp.zeros(()), jnp.ones(())
    tilt = jnp.where(corner > 0, np.pi / 4, 0.0)
    first = Body(jnp.zeros(2), jnp.stack([jnp.sin(tilt), jnp.cos(tilt)]), p[10], p[11:13], disc, nought)
    normal = jnp.stack([-jnp.sin(tilt), jnp.cos(tilt)])
    second = Body(jnp.stack([nought, jnp.where(corner > 0, 0.0, -1e3)]), normal, one, jnp.stack([nought, one]), nought, nought)
    return first, second


def ended(p, flags, stepper):
    """Where both nodes are at T, and the status: the steps of a rollout, one copy of them."""
    start = js.State.from_points(PAIR, jnp.stack([p[0:2], p[4:6]]), jnp.stack([p[2:4], p[6:8]]))
    nought = jnp.zeros(())
    forces = (js.Gravity(jnp.stack([nought, -p[9]])), Well(p[13]), js.Drag(p[14]), js.Dashpots(PAIR, p[15]))
    rules = tuple(js.contact.Contact(body, 0.0, p[8]) for body in obstacles(p, *flags))
    system, dt = js.System(PAIR, 1.0, forces, rules=rules).bind(start.dtype), p[16] / N_STEPS

    def step(carry, _):
        before, memory, status = carry
        moved, memory = stepper.step(system, before, dt, memory)
        moved = eqx.tree_at(lambda s: s.time, moved, before.time + dt)
        after, found = system.follow(before, moved, dt)
        return (after, stepper.after_rules(system, before, moved, after, dt, memory), status.then(found)), None

    begun = (start, stepper.init(system, start), js.Status.ok())
    (state, _, status), _ = jax.lax.scan(step, begun, None, length=N_STEPS)
    return state.points.ravel(), status.flags


def true_end(p, disc, corner):
    """The same by an integrator that stops at events, in NumPy."""
    x, v, e, g, radius, swing, k, c, cd = p[[0, 1, 4, 5]], p[[2, 3, 6, 7]], p[8], p[9], p[10], p[11:13], p[13], p[14], p[15]
    tilt = np.pi / 4 if corner else 0.0
    normals = [np.array([np.sin(tilt), np.cos(tilt)])] + [np.array([-np.sin(tilt), np.cos(tilt)])] * corner

    def height(i, x, t):
        here = x - np.array([0.0, swing[0] * np.sin(swing[1] * t) * (i == 0)])
        return (np.linalg.norm(here) - radius, here / np.linalg.norm(here)) if disc else (here @ normals[i], normals[i])

    def rate(t, y):
        x, v = y[:4].reshape(2, 2), y[4:].reshape(2, 2)
        a = np.array([0.0, -g]) - k * np.array([[0.0, 1.0]]) * (x[:, 1:] - 1) - c * v
        u = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
        pull = cd * ((v[1] - v[0]) @ u) * u
        return np.concatenate([v.ravel(), (a + np.stack([pull, -pull])).ravel()])

    events = [lambda t, y, i=i: height(i, y[:2], t)[0] for i in range(len(normals))]
    for event in events:
        event.terminal, event.direction = True, -1
    t, y = 0.0, np.concatenate([x, v])
    while True:
        found = solve_ivp(rate, (t, p[16]), y, method="DOP853", rtol=1e-12, atol=1e-13, events=events)
        t, y = found.t[-1], found.y[:, -1].copy()
        if found.status != 1:
            return y[:4]
        i = int(np.argmax([len(times) for times in found.t_events]))
        n = height(i, y[:2], t)[1]
        moves = swing[0] * swing[1] * np.cos(swing[1] * t) * (i == 0)
        y[4:6] -= (1 + e) * (y[4:6] @ n - n[1] * moves) * n


# Highly accurate numbers by an integrator with events: derivative of a coordinate at T by a parameter, by its place in the row.
KNOWN = {
    "plane": (1, {1: 0.291446, 3: -0.078050, 8: 1.218175, 9: 0.033718}),  # of y, by y0, vy0, e, g
    "disc": (0, {1: 0.637557, 10: -0.328117}),  # of x, by y0, R
    "spring": (1, {1: 0.517733, 3: 0.078249, 8: 0.028879, 9: -0.071796, 13: -0.030487}),  # of y, by y0, vy0, e, g, k
    "drag": (1, {1: 0.527925}),
}
EXACT = ("plane", "moving plane", "disc", "moving disc", "corner")  # without forces that change in a step


@pytest.mark.slow
def test_l1_bounces_on_any_obstacle():
    """L1: places and derivatives after bounces on a plane, a moving one, a disc, a moving one and in a corner, in 400 steps: exact; with a
    spring, drag and a dashpot between two nodes of order 2 and 1: against an integrator with events, and known numbers.
    """
    rng = np.random.default_rng(5)
    # Each case along a direction of all parameters that are not zero in it, and along single ones.
    wanted = [(name, None, np.where(np.array(row[:17]) != 0, rng.normal(size=17), 0)) for name, row in CASES.items()]
    wanted += [(name, known, np.eye(17)[i]) for name, (_, by) in KNOWN.items() for i, known in by.items()]
    rows = np.array([CASES[name] for name, _, _ in wanted])

    def both(row, direction):
        return jax.jvp(lambda p: ended(p, (row[17], row[18]), js.VelocityVerlet()), (row[:17],), (direction,), has_aux=True)

    values, slopes, flags = (np.asarray(a) for a in jax.jit(jax.vmap(both))(rows, np.array([d for _, _, d in wanted])))
    np.testing.assert_array_equal(flags, 0)
    for (name, known, direction), row, value, slope in zip(wanted, rows, values, slopes, strict=True):
        p, body = row[:17], (int(row[17]), int(row[18]))
        if known is not None:
            assert slope[KNOWN[name][0]] == pytest.approx(known, abs=1e-6 if name in EXACT else 2e-3), name
            continue
        np.testing.assert_allclose(value, true_end(p, *body), atol=1e-9 if name in EXACT else 5e-5, err_msg=name)
        near, wide = ((true_end(p + h * direction, *body) - true_end(p - h * direction, *body)) / (2 * h) for h in (5e-5, 1e-4))
        np.testing.assert_allclose(slope, (4 * near - wide) / 3, atol=1e-6 if name in EXACT else 2e-2, err_msg=name)
    assert values[list(CASES).index("plane"), 1] == pytest.approx(0.605214, abs=1e-6)
    assert values[list(CASES).index("spring"), 1] == pytest.approx(1.686645, abs=2e-5)


class Scene(eqx.Module):
    """One row of `flown`: two bodies, what they do, where six nodes begin."""

    first: Body
    second: Body
    friction: np.ndarray
    restitution: np.ndarray
    g: float
    dt: float
    points: np.ndarray
    velocities: np.ndarray


SIX, STEPS = js.lattice(6), 200


def body(centre=(0.0, -1e3), normal=(0.0, 1.0), radius=1.0, is_disc=0.0, runs=0.0):
    """A body that stands still; far away unless said."""
    return Body(np.array(centre), np.array(normal), np.array(radius), np.array([0.0, 1.0]), np.array(is_disc), np.array(runs))


def scene(first, points, velocities=0.0, friction=0.0, restitution=0.0, g=10.0, dt=0.01, second=None):
    """A row; coefficients of one obstacle or of both."""
    velocities = np.broadcast_to(velocities, (6, 2)).astype(float)
    both = (np.broadcast_to(np.array(c, float), 2) for c in (friction, restitution))
    return Scene(first, second or body(), *both, np.array(g), np.array(dt), np.array(points, float), velocities)


def run_scene(row):
    """Places, velocities and impulses after each step, and the status."""
    coefficients = zip((row.first, row.second), row.friction, row.restitution, strict=True)
    rules = (*(js.contact.Contact(*c) for c in coefficients), js.contact.Impulses())
    system = js.System(SIX, 2.0, js.Gravity(jnp.stack([jnp.zeros(()), -row.g])), rules=rules)

    def look(state):
        given = js.contact.impulses(system, state)
        return state.points, state.velocities, *(jnp.stack([jnp.stack(v.components, -1) for v in (i.normal, i.friction)]) for i in given)

    start = js.State.from_points(SIX, row.points, row.velocities)
    run = js.rollout(system, start, js.VelocityVerlet(), row.dt, STEPS, save_every=1, observe=look)
    return run.saved, run.status.flags


ANGLE = np.radians(20.0)
SLOPE = np.array([np.sin(ANGLE), np.cos(ANGLE)])
DOWN = np.array([np.cos(ANGLE), -np.sin(ANGLE)])
ON_SLOPE = np.arange(6)[:, None] * 3.0 * DOWN
LEAN = np.arctan(0.5 * np.array([0.0, 0.5, 0.99, -0.99, 1.01, -1.01]))  # on a disc of friction 0.5, from its top
MISSES = np.array([0.0, 0.002, -0.005, 0.009, 0.0099, 0.0101])  # by how much six nodes fly past the centre of a disc of 0.01
RNG = np.random.default_rng(11)
THROWN = {"points": RNG.uniform(-1, 1, (6, 2)) + np.array([0.0, 3.0]), "velocities": RNG.normal(size=(6, 2))}
WALLS = body((0.0, 0.0), (0.6, 0.8)), body((0.8, 0.5), radius=0.7, is_disc=1.0)
ROWS = {
    "holds": scene(body((0.0, 0.0), SLOPE), ON_SLOPE, np.arange(6)[:, None] * -0.2 * DOWN, 1.01 * np.tan(ANGLE)),
    "slides": scene(body((0.0, 0.0), SLOPE), ON_SLOPE, 0.0, 0.99 * np.tan(ANGLE)),
    "disc": scene(body((0.0, 0.0), is_disc=1.0), np.c_[np.sin(LEAN), np.cos(LEAN)], 0.0, 0.5),
    "smooth": scene(body((0.0, 0.0), is_disc=1.0), np.c_[np.zeros(6), np.ones(6)], np.c_[0.4 + 0.1 * np.arange(6), np.zeros(6)], dt=0.005),
    "thrown": scene(WALLS[0], **THROWN, friction=(0.3, 0.2), restitution=(0.6, 0.8), second=WALLS[1]),
    "swapped": scene(WALLS[1], **THROWN, friction=(0.2, 0.3), restitution=(0.8, 0.6), second=WALLS[0]),
    "elastic": scene(WALLS[0], **THROWN, restitution=1.0, second=WALLS[1]),
    "belt": scene(body((0.0, 0.0), runs=1.0), np.c_[np.arange(6), np.zeros(6)], np.c_[0.4 * np.arange(6) - 1, np.zeros(6)], 0.2),
    "fast": scene(
        body((0.0, 0.0), radius=0.01, is_disc=1.0), np.c_[np.full(6, -0.07), MISSES], (10.0, 0.0), restitution=1.0, g=0.0, dt=0.02
    ),
}


@pytest.fixture(scope="module")
def flown():
    """All rows through one program."""
    rows = jax.tree.map(lambda *a: np.stack(a), *ROWS.values())
    saved, flags = jax.jit(jax.vmap(run_scene))(rows)
    assert np.all(np.asarray(flags) == 0)
    return {name: [np.asarray(a)[i] for a in saved] for i, name in enumerate(ROWS)}


@pytest.mark.slow
def test_l2_a_node_at_the_cone_of_friction(flown):
    """L2: at 1 % above the angle's tangent what rests holds, bit by bit, and what is pushed up stops; at 1 % below it slides as Coulomb
    says, on a plane; on a disc what leans less holds, bit by bit, and what leans more slides.
    """
    x, v, _, _ = flown["holds"]
    mu, up = 1.01 * np.tan(ANGLE), 0.2 * np.arange(6)
    way = up**2 / (2 * 10 * (np.sin(ANGLE) + mu * np.cos(ANGLE)))
    np.testing.assert_allclose((x[-1] - ON_SLOPE) @ DOWN, -way, atol=2e-3)  # the step in which it stops
    np.testing.assert_array_equal(x[-1], x[60])
    np.testing.assert_allclose(v[60:], 0, atol=1e-16)
    x, v, _, _ = flown["slides"]
    rate = 10 * (np.sin(ANGLE) - 0.99 * np.tan(ANGLE) * np.cos(ANGLE))
    np.testing.assert_allclose((x[-1] - ON_SLOPE) @ DOWN, 0.5 * rate * 2.0**2, atol=1e-9)
    np.testing.assert_allclose((x @ SLOPE), 0, atol=1e-12)
    x, v, _, _ = flown["disc"]
    np.testing.assert_array_equal(x[-1, :4], x[0, :4])
    np.testing.assert_allclose(x[-1, :4], np.c_[np.sin(LEAN), np.cos(LEAN)][:4], atol=1e-15)
    assert np.all(np.abs(x[-1, 4:, 0]) > np.abs(x[0, 4:, 0]) + 0.01)


@pytest.mark.slow
def test_a_belt_that_runs_carries_what_lies_on_it(flown):
    """Friction brings every node to the speed of the belt, at mu g, and holds it there."""
    x, v, _, _ = flown["belt"]
    begun, t = ROWS["belt"].velocities[:, 0], 0.01 * np.arange(1, STEPS + 1)[:, None]
    until = np.abs(1 - begun) / 2.0
    np.testing.assert_allclose(v[..., 0], np.where(t < until, begun + 2.0 * np.sign(1 - begun) * t, 1.0), atol=1e-9)
    gap = 0.5 * 2.0 * np.sign(1 - begun) * until**2
    np.testing.assert_allclose(x[-1, :, 0], np.arange(6) + t[-1] - gap, atol=2e-3)  # the step in which it takes hold
    np.testing.assert_allclose(x[..., 1], 0, atol=1e-12)


@pytest.mark.slow
def test_a_bead_slides_off_a_disc(flown):
    """Without friction it keeps its energy to the order of the stepper, and takes off where cos = (2 + v0^2 / (g R)) / 3."""
    x, v, given, _ = flown["smooth"]
    energy = 0.5 * np.sum(v**2, axis=-1) + 10 * x[..., 1]
    np.testing.assert_allclose(energy, energy[0] * np.ones_like(energy), rtol=2e-5)
    pushed = np.linalg.norm(given[:, 0], axis=-1) > 0
    last = STEPS - 1 - np.argmax(pushed[::-1], axis=0)
    assert np.all(last < STEPS - 1)
    cosine = x[last, np.arange(6), 1]
    np.testing.assert_allclose(cosine, (2 + ROWS["smooth"].velocities[:, 0] ** 2 / 10) / 3, atol=0.015)


@pytest.mark.slow
def test_l3_any_obstacles_in_any_order(flown):
    """L3: a slope and a disc, with other coefficients each, in both orders: the same states to the last bit."""
    for a, b in zip(flown["thrown"][:2], flown["swapped"][:2], strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(flown["thrown"][2], flown["swapped"][3])


@pytest.mark.slow
def test_energy_never_rises_and_friction_stays_in_the_cone(flown):
    """With restitution up to 1 the energy never rises, and with 1 it stays; friction is at most mu times the normal impulse of the step."""
    for name in ("thrown", "elastic", "slides", "holds", "disc"):
        x, v, *given = flown[name]
        row = ROWS[name]
        energy = 0.5 * np.sum(v**2, axis=-1) + 10 * x[..., 1]
        # On a curve the stepper's own energy swings by a share of dt^2.
        assert np.max(np.diff(energy, axis=0)) < (1e-12 if name in ("slides", "holds") else 5e-5)
        for impulse, mu in zip(given, row.friction, strict=True):
            normal, friction = (np.linalg.norm(impulse[:, i], axis=-1) for i in (0, 1))
            # Of the weight's impulse, 0.2 N s.
            assert np.max(friction - mu * normal) < (1e-6 if name == "disc" else 1e-12)
        assert max(np.abs(i).max() for i in given) > 0.01
    x, v = flown["elastic"][:2]
    energy = 0.5 * np.sum(v**2, axis=-1) + 10 * x[..., 1]
    np.testing.assert_allclose(energy, energy[0] * np.ones_like(energy), rtol=1e-4)


@pytest.mark.slow
def test_impulses_are_the_change_of_momentum(flown):
    """m (v' - v) is gravity's impulse and those of the obstacles, in every step; a node at rest on a slope gets its weight."""
    for name in ("thrown", "elastic", "holds", "disc", "smooth"):
        _, v, *given = flown[name]
        gained = 2.0 * np.diff(v, axis=0) - 2.0 * ROWS[name].dt * np.array([0.0, -10.0])
        np.testing.assert_allclose(sum(i.sum(axis=1) for i in given)[1:], gained, atol=1e-10)
    np.testing.assert_allclose(flown["holds"][2][-1].sum(axis=0), np.broadcast_to([0.0, 2.0 * 10 * 0.01], (6, 2)), atol=1e-12)
    np.testing.assert_allclose(flown["holds"][2][-1, 0] @ SLOPE, 2.0 * 10 * 0.01 * np.cos(ANGLE), atol=1e-12)


@pytest.mark.slow
def test_l4_nothing_goes_through(flown):
    """L4: 10 m/s at a disc of 1 cm in steps of ten diameters: every node that hits is thrown back as a mirror does, the other flies on."""
    x, v, _, _ = flown["fast"]
    assert np.min(np.linalg.norm(x, axis=-1)) > 0.01 - 1e-12
    sine = np.minimum(np.abs(MISSES) / 0.01, 1.0)
    normal = np.c_[-np.sqrt(1 - sine**2), sine * np.sign(MISSES)]
    mirrored = np.array([10.0, 0.0]) - 2 * (normal @ np.array([10.0, 0.0]))[:, None] * normal
    np.testing.assert_allclose(v[-1], mirrored, atol=1e-9)
    np.testing.assert_array_equal(v[-1, 5], [10.0, 0.0])


class Guide(js.contact.Obstacle):
    """A disc of radius 1, or a table whose edge is rounded: its top is y = 0, its end x = 0."""

    is_disc: jax.Array
    rounding: jax.Array

    def distance(self, position, time):
        x, y = position.x + self.rounding, position.y + self.rounding
        zero = jnp.zeros_like(x)
        outside = js.Vector((jnp.maximum(x, zero), jnp.maximum(y, zero))).norm()
        table = outside + jnp.minimum(jnp.maximum(x, y), zero) - self.rounding
        return jnp.where(self.is_disc > 0, position.norm() - 1, table)


class Pull(js.Force):
    """A constant force on each node."""

    pull: js.Vector

    def force(self, state):
        return self.pull


N, STIFFNESS = 64, 5e4
ROPE = js.lattice(N)


def belt(ratio, mu=0.3, tension=1.0):
    """Half round a disc, pulled down at both ends, with tensions that rise evenly to the ratio."""
    angle = np.pi * (1 - np.arange(N) / (N - 1))
    points = np.c_[np.cos(angle), np.sin(angle)]
    tensions = tension * ratio ** ((np.arange(N - 1) + 0.5) / (N - 1))
    pull = np.zeros((N, 2))
    pull[0, 1], pull[-1, 1] = -tension, -tension * ratio
    rest = np.linalg.norm(np.diff(points, axis=0), axis=1) - tensions / STIFFNESS
    return points, rest, pull, np.array(1.0), np.array(mu), np.array(2e-4), np.array(0.01)


def chain(hanging=0.3, length=1.0, rounding=0.05):
    """On a table, its end over the edge; each node stands for as much length as lies about it."""
    spacing = length / N
    s = hanging + (np.pi / 2 - 1) * rounding - spacing / 2 - np.arange(N) * spacing  # along the way, from where the edge begins to bend
    turn = np.clip(s / rounding, 0, np.pi / 2)
    x = np.where(s < 0, s, rounding * np.sin(turn)) - rounding
    y = -np.where(s < 0, 0, rounding * (1 - np.cos(turn)) + np.maximum(s - rounding * np.pi / 2, 0))
    points = np.c_[x, y]
    rest = np.linalg.norm(np.diff(points, axis=0), axis=1)
    pull = np.tile([0.0, -10.0 / N], (N, 1))
    return points, rest, pull, np.array(0.0), np.array(0.0), np.array(3e-4), np.array(1.0 / N)


@pytest.mark.slow
def test_a_belt_on_a_disc_and_a_chain_off_a_table():
    """With friction 0.3 half round a disc, 64 nodes hold a ratio of tensions 2 % below exp(0.3 pi), and slide at 2 % above; a chain without
    friction slides off a table as x0 cosh(sqrt(g / L) t), to 1 %.
    """

    def end(points, rest, pull, is_disc, mu, dt, mass):
        guide = Guide(is_disc, jnp.asarray(0.05))
        forces = (js.Springs(ROPE, STIFFNESS, rest), Pull(ROPE.vector_field(pull, "pull")))
        system = js.System(ROPE, mass, forces, rules=js.contact.Contact(guide, mu))
        run = js.rollout(system, js.State.from_points(ROPE, points), js.VelocityVerlet(), dt, 1000)
        return run.state.points, run.state.velocities, run.status.flags

    ratio = np.exp(0.3 * np.pi)
    rows = [belt(0.98 * ratio), belt(1.02 * ratio), chain()]
    points, velocities, flags = jax.jit(jax.vmap(end))(*(np.stack(a) for a in zip(*rows, strict=True)))
    np.testing.assert_array_equal(flags, 0)
    speed = np.linalg.norm(velocities, axis=-1)
    assert speed[0].max() < 1e-6
    # What pulls too much pulls all nodes along, for 0.2 s.
    surplus = (1.02 - 1) * ratio / (64 * 0.01) * 0.2
    assert 0.3 * surplus < speed[1].min()
    assert speed[1].max() < 2 * surplus
    hanging = -points[2][0, 1] + 0.5 / N
    assert hanging == pytest.approx(0.3 * np.cosh(np.sqrt(10.0) * 0.3), rel=0.01)


def test_nodes_inside_are_counted_and_can_be_moved_out():
    """INSIDE counts the nodes and names the deepest; `push_out` puts them on the surface, and leaves those outside where they are."""
    ball = js.contact.Contact(js.contact.Sphere((0.0, 0.0), 1.0))
    start = js.State.from_points(SIX, [[0.9, 0.0], [0.0, 0.5], [2.0, 0.0], [0.0, 1.0], [-0.7, 0.0], [3.0, 3.0]])
    (found,) = ball.diagnose(start)
    assert (found.flag, int(found.count), int(found.node)) == (js.Flag.INSIDE, 3, 1)
    rules = (ball, js.Floor((0.0, 2.5), (0.0, -1.0)))
    out = js.contact.push_out(js.System(SIX, 1.0, rules=rules), start)
    np.testing.assert_allclose(out.points, [[1.0, 0.0], [0.0, 1.0], [2.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [3.0, 2.5]], atol=1e-15)
    assert int(ball.diagnose(out)[0].count) == 0


def test_a_flat_obstacle_that_stands_still_is_a_floor():
    """Its plane is the floor's, so that it is met in closed form; one that moves is none."""
    state = js.State.from_points(SIX, np.random.default_rng(2).normal(size=(6, 2)))
    flat, floor = js.contact.Contact(js.contact.Plane((1.0, 2.0), (3.0, 4.0)), 0.25, 0.5), js.Floor((1.0, 2.0), (3.0, 4.0), 0.25, 0.5)
    a, b = flat.plane(state), floor.plane(state)
    np.testing.assert_allclose(a.height(state.position), b.height(state.position), atol=1e-15)
    np.testing.assert_allclose([*a.normal, a.friction, a.restitution], [*b.normal, b.friction, b.restitution], atol=1e-15)
    assert js.contact.Contact(js.contact.Moving(flat.obstacle, lambda t: jnp.stack([t, t]))).plane(state) is None
    assert js.contact.Contact(js.contact.Sphere((0.0, 0.0), 1.0)).plane(state) is None


def test_what_a_contact_refuses():
    """What is no obstacle, coefficients that feed energy in, another space: each by name."""
    ball = js.contact.Sphere((0.0, 0.0, 0.0), 1.0)
    with pytest.raises(TypeError, match="obstacle"):
        js.contact.Contact(1.0)
    with pytest.raises(ValueError, match="friction"):
        js.contact.Contact(ball, -0.1)
    with pytest.raises(ValueError, match="restitution"):
        js.contact.Contact(ball, 0.1, 1.1)
    with pytest.raises(ValueError, match="3 coordinates"):
        js.contact.Contact(ball).distance(js.State.from_points(SIX, np.zeros((6, 2))))
    with pytest.raises(ValueError, match="Impulses"):
        js.contact.impulses(js.System(SIX, 1.0), js.State.from_points(SIX, np.zeros((6, 2))))
