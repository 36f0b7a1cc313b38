"""Air on triangles and pressure inside closed surfaces: closed forms, references in NumPy, derivatives against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests import reference

G = 9.81


class Gust(eqx.Module):
    """A wind that grows with the height and swings in time."""

    speed: jax.Array

    def __call__(self, places, time):
        push = self.speed * (1 + places.z) * jnp.cos(3 * time)
        return js.Vector((push, 0.5 * push * places.x, jnp.zeros_like(push)))


NET = js.from_triangles([(0, 1, 2), (2, 1, 3), (2, 3, 4)], 5)
POINTS = np.array([(0, 0, 0), (1, 0.1, 0.2), (0.2, 1, -0.1), (1.1, 0.9, 0.3), (0.3, 2, 0.4)])
SPEEDS = np.array([(0.3, -1, 2), (1, 0.5, -1), (-0.4, 2, 0.1), (0.2, 0.2, 1), (-1, 0.3, 0.6)])
AIR = js.cloth.Air(NET, drag=[1.2, 0.9, 1.1], friction=0.1, lift=0.3, viscous=0.5, density=1.3, wind=Gust(jnp.array(4.0)))


def state(points=POINTS, speeds=SPEEDS, time=0.2):
    return js.State.from_points(NET, points, speeds, time=time)


def flat(net, vector):
    return np.stack([np.asarray(net.flatten_nodes(a)) for a in vector], axis=-1)


def air_in_numpy(points, speeds, time, wind=4.0):
    """Triangle by triangle, with the wind at its middle."""
    force = np.zeros_like(points)
    for (a, b, c), drag in zip(NET.triangles, (1.2, 0.9, 1.1), strict=True):
        area_vector = 0.5 * np.cross(points[b] - points[a], points[c] - points[a])
        area = np.linalg.norm(area_vector)
        n = area_vector / area
        x, _, z = (points[a] + points[b] + points[c]) / 3
        push = wind * (1 + z) * np.cos(3 * time)
        w = np.array([push, 0.5 * push * x, 0.0]) - (speeds[a] + speeds[b] + speeds[c]) / 3
        across, speed = w @ n, np.linalg.norm(w)
        along = w - across * n
        pressure = 0.5 * 1.3 * drag * abs(across) * across * n + 0.5 * 1.3 * 0.1 * np.linalg.norm(along) * along
        lift = 0.5 * 1.3 * 0.3 * speed**2 * (w / speed @ n) * (n - (w / speed @ n) * w / speed)
        force[[a, b, c]] += area * (pressure + lift + 0.5 * across * n) / 3
    return force


def test_air_is_the_sum_over_triangles():
    """Drag, friction, lift and the linear form as in NumPy; a triangle turned over changes nothing; lift does no work."""
    np.testing.assert_allclose(flat(NET, AIR.force(state())), air_in_numpy(POINTS, SPEEDS, 0.2), rtol=1e-12, atol=1e-13)
    over = js.cloth.Air(NET, *(AIR.drag, 0.1, 0.3, 0.5, 1.3), AIR.wind, triangles=np.asarray(NET.triangles)[:, ::-1])
    np.testing.assert_allclose(flat(NET, over.force(state())), flat(NET, AIR.force(state())), rtol=1e-13)
    still = js.cloth.Air(NET, drag=0.0, lift=1.0)
    moving = state(speeds=np.tile([0.3, 1.0, -2.0], (5, 1)))
    assert abs(float(jnp.sum(still.force(moving).dot(moving.velocity)))) < 1e-14


def test_still_air_takes_energy_out(rng):
    """The power of drag, friction, lift and the linear form is never above zero, and below for what moves across."""
    still = js.cloth.Air(NET, drag=1.2, friction=0.2, lift=0.5, viscous=0.1)
    assert not still.can_feed
    power = jax.jit(lambda s: jnp.sum(still.force(s).dot(s.velocity)))
    for _ in range(20):
        assert float(power(state(rng.normal(size=(5, 3)), rng.normal(size=(5, 3))))) < 0


def test_jacobians_of_air():
    """dF/dx and dF/dv against central differences to 1e-6; bounds hold; blocks are the sums of the rows of -dF/dv, but for lift."""
    points, speeds = jnp.asarray(POINTS), jnp.asarray(SPEEDS)

    @jax.jit
    def force(x, v):
        return jnp.stack([NET.flatten_nodes(a) for a in AIR.force(state(x, v))], axis=-1).ravel()

    for i, by in enumerate(jax.jit(jax.jacfwd(force, (0, 1)))(points, speeds)):
        differences = np.empty((15, 15))
        for k in range(15):
            step = np.zeros(15)
            step[k] = 1e-5
            step = step.reshape(5, 3)
            up, down = ((points, speeds + sign * step) if i else (points + sign * step, speeds) for sign in (1, -1))
            differences[:, k] = (force(*up) - force(*down)) / 2e-5
        assert reference.relative_error(by.reshape(15, 15), differences) < 1e-6
        bound = NET.flatten_nodes((AIR.damping_bound if i else AIR.stiffness_bound)(state()))
        blocks = differences.reshape(5, 3, 5, 3).transpose(0, 2, 1, 3)
        assert (np.linalg.norm(blocks, ord=2, axis=(2, 3)).sum(axis=1) <= np.asarray(bound) * 1.0001).all()
    level = js.cloth.Air(NET, *(AIR.drag, 0.1, None, 0.5, 1.3), AIR.wind)
    for axis in range(3):
        shift = js.Vector(tuple(jnp.full(5, float(k == axis)) for k in range(3)))
        _, change = jax.jvp(lambda v: level.force(eqx.tree_at(lambda s: s.velocity, state(), v)), (state().velocity,), (shift,))
        np.testing.assert_allclose(flat(NET, level.damping_blocks(state()).product(shift)), -flat(NET, change), rtol=1e-10, atol=1e-12)


def test_a_triangle_without_area_feels_nothing():
    """Its force is zero, and so are all derivatives: no NaN."""
    points = POINTS.copy()
    points[1] = points[0]

    def total(x):
        return jnp.sum(AIR.force(state(x)).dot(js.Vector(tuple(jnp.arange(5.0) for _ in range(3)))))

    assert np.isfinite(jax.grad(total)(jnp.asarray(points))).all()
    assert np.isfinite(flat(NET, AIR.force(state(points)))).all()


SHEET, PLACES = js.cloth.rectangle(1.0, 0.8, 0.25)
DENSITY = 0.2  # of the sheet [kg/m^2]
MASS = js.lumped_mass(SHEET, PLACES, DENSITY, SHEET.triangles)


def falling(speed):
    return js.State.from_points(SHEET, PLACES, np.tile([0.0, 0.0, -speed], (len(PLACES), 1)))


def test_a_level_sheet_falls_at_its_terminal_speed():
    """Weight and air balance at every node: at m g / (C_dis + C_vi), and at sqrt(2 g density / (rho C_d)) where drag is quadratic."""
    viscous, drag = 3.0, 0.7
    linear = js.System(SHEET, MASS, (js.Gravity((0, 0, -G)), js.Drag(drag * MASS), js.cloth.Air(SHEET, drag=0.0, viscous=viscous)))
    # C_vi of a node is c times its own area: its mass over the density.
    end = falling(G / (drag + viscous / DENSITY))
    np.testing.assert_allclose(linear.acceleration(end).z, 0, atol=1e-12)
    quadratic = js.System(SHEET, MASS, (js.Gravity((0, 0, -G)), js.cloth.Air(SHEET, drag=1.2, density=1.25)))
    end = falling(np.sqrt(2 * G * DENSITY / (1.25 * 1.2)))
    np.testing.assert_allclose(quadratic.acceleration(end).z, 0, atol=1e-12)


def test_a_fall_in_air_and_its_derivatives():
    """v = v_t tanh(g t / v_t) from rest; derivatives of the speed by rho, C_d and an even upward wind in closed form and by differences."""
    time, n = 0.6, 60

    @jax.jit
    @jax.value_and_grad
    def speed(p):
        rho, drag, up = p
        wind = jnp.stack([jnp.zeros(()), jnp.zeros(()), up])
        air = js.cloth.Air(SHEET, drag=drag, density=rho, wind=wind)
        system = js.System(SHEET, MASS, (js.Gravity((0, 0, -G)), air))
        return -js.rollout(system, falling(0.0), js.RungeKutta4(), time / n, n).state.velocity.z[3]

    rho, drag = 1.25, 1.2
    terminal = np.sqrt(2 * G * DENSITY / (rho * drag))
    value, slope = speed(jnp.array([rho, drag, 0.0]))
    phase = G * time / terminal
    assert float(value) == pytest.approx(terminal * np.tanh(phase), rel=1e-8)
    by_terminal = np.tanh(phase) - phase / np.cosh(phase) ** 2
    np.testing.assert_allclose(slope[:2], [-terminal / (2 * rho) * by_terminal, -terminal / (2 * drag) * by_terminal], rtol=1e-7)
    # Seen from the rising air the sheet starts at the speed of the wind: d/du of v_t tanh(g t / v_t + atanh(u / v_t)) - u at u = 0.
    np.testing.assert_allclose(slope[2], np.cosh(phase) ** -2 - 1, rtol=1e-7)
    for k, at in enumerate((rho, drag)):

        def along(x, k=k):
            return speed(jnp.array([rho, drag, 0.0]).at[k].set(x))[0]

        assert float(slope[k]) == pytest.approx(reference.central_difference(along, at, 1e-4), rel=1e-6)


def test_implicit_steps_know_the_air():
    """One linear step far above the explicit limit comes to rest against the wind, and does not overshoot it."""
    air = js.cloth.Air(SHEET, drag=1.2, wind=(0.0, 0.0, 40.0))
    system = js.System(SHEET, MASS, air)
    # rho C_d |w_n| dt / (2 * density) = 58: an explicit step would go 29 times too far.
    end = js.rollout(system, falling(0.0), js.BackwardEuler(), dt=0.2, n_steps=3).state
    assert 0 < float(end.velocity.z.min()) <= float(end.velocity.z.max()) < 40


def sphere(level):
    """An icosahedron with each triangle cut in four `level` times, on the unit sphere."""
    phi = (1 + 5**0.5) / 2
    points = np.array([(s, t * phi, 0) for s in (-1, 1) for t in (-1, 1)], float)
    points = np.concatenate([np.roll(points, k, axis=1) for k in range(3)]) / np.hypot(1, phi)
    from scipy.spatial import ConvexHull

    for _ in range(level):
        triangles = ConvexHull(points).simplices
        sides = np.unique(np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1), axis=0)
        middle = points[sides].mean(axis=1)
        points = np.concatenate([points, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
    net = js.from_triangles(ConvexHull(points).simplices, len(points))
    return js.cloth.rewound(net, points), points


BALL, ROUND = sphere(1)


def of_ball(points):
    return js.State.from_points(BALL, points)


def forces_inside():
    """A constant pressure, a gas, and a gas in a ball with a hole that is capped."""
    opened = js.from_triangles(BALL.triangles[np.abs(ROUND[BALL.triangles].mean(axis=1) - ROUND[0]).max(axis=1) > 0.45], len(ROUND))
    return (
        (BALL, js.cloth.Pressure(BALL, ROUND, 50.0)),
        (BALL, js.cloth.Pressure.of_gas(BALL, ROUND, 50.0, ambient=200.0)),
        (opened, js.cloth.Pressure.of_gas(opened, ROUND, 50.0, ambient=200.0, cap_holes=True)),
    )


@pytest.mark.parametrize("case", range(3))
def test_pressure_is_the_gradient_of_its_energy(case, rng):
    """F = -dE/dx by JAX and by differences; no net force, no net moment; dF/dx against differences to 1e-6; the bound holds."""
    net, pressure = forces_inside()[case]
    points = 1.2 * ROUND + 0.05 * rng.normal(size=ROUND.shape)

    def energy(x):
        return pressure.energy(js.State.from_points(net, x))

    @jax.jit
    def force(x):
        return jnp.stack([net.flatten_nodes(a) for a in pressure.force(js.State.from_points(net, x))], axis=-1)

    found = np.asarray(force(points))
    scale = np.abs(found).max()
    np.testing.assert_allclose(found, -jax.jit(jax.grad(energy))(jnp.asarray(points)), atol=1e-12 * scale)
    np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-11 * scale)
    np.testing.assert_allclose(np.cross(points, found).sum(axis=0), 0, atol=1e-11 * scale)
    jacobian = np.asarray(jax.jit(jax.jacfwd(force))(jnp.asarray(points)))
    for node, axis in ((0, 0), (7, 2), (20, 1)):
        step = np.zeros_like(points)
        step[node, axis] = 1e-5
        differences = np.asarray(force(points + step) - force(points - step)) / 2e-5
        assert reference.relative_error(jacobian[:, :, node, axis], differences) < 1e-6
    rows = np.linalg.norm(jacobian.transpose(0, 2, 1, 3), ord=2, axis=(2, 3)).sum(axis=1)
    bound = np.asarray(net.flatten_nodes(pressure.stiffness_bound(js.State.from_points(net, points))))
    assert (rows <= bound * (1 + 1e-9)).all()


def test_a_gas_follows_boyle():
    """(p + pa) V stays; the energy is the work done on gas and surroundings; no volume gives NaN, not another sign."""
    gas = js.cloth.Pressure.of_gas(BALL, ROUND, 50.0, ambient=200.0)
    enclosed = js.cloth.Pressure(BALL, ROUND, 1.0).enclosed
    for scale in (0.7, 1.0, 1.4):
        now = of_ball(scale * ROUND)
        assert float((gas.overpressure(now) + 200) * enclosed(now)) == pytest.approx(250 * float(gas.volume), rel=1e-13)
        ratio = scale**3
        work = 250 * float(gas.volume) * np.log(ratio) - 200 * float(gas.volume) * (ratio - 1)
        assert float(gas.energy(now)) == pytest.approx(-work, rel=1e-10, abs=1e-10)
    assert np.isnan(gas.energy(of_ball(-ROUND)))
    assert np.isnan(gas.force(of_ball(-ROUND)).x).all()


def test_a_balloon_stands_by_laplace():
    """At rest each half is held by its cut springs, exactly; tension p R / 2 gives the radius of the closed form within a percent.

    Springs of stiffness E S / l^2 (nu = 1/3) under an even strain e have the energy 4/3 C e^2 per area, C = 9/8 E: p R (1 + e)^2 = 8/3 C e.
    """
    net, points = sphere(2)
    edges = net.edges
    rest = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    a, b, c = (points[net.triangles[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    at_side = {}
    for triangle, area in zip(net.triangles.tolist(), areas, strict=True):
        for i, j in ((0, 1), (1, 2), (0, 2)):
            key = tuple(sorted((triangle[i], triangle[j])))
            at_side[key] = at_side.get(key, 0) + area
    modulus, p = 100.0, 25.0
    stiffness = modulus * np.array([at_side[tuple(sorted(edge))] for edge in edges.tolist()]) / rest**2
    springs, pressure = js.Springs(net, stiffness, rest), js.cloth.Pressure(net, points, p)
    system = js.System(net, 1.0, (springs, pressure))
    found = js.equilibrium(system, js.State.from_points(net, points), tolerance=1e-11)
    js.raise_for_status(found)
    x = np.asarray(found.state.points)
    mean = np.linalg.norm(x, axis=1).mean()
    strain = mean - 1
    closed = np.roots([p, 2 * p - 8 / 3 * 9 / 8 * modulus, p]).min()
    assert strain == pytest.approx(closed, rel=0.02)
    # The springs that leave the upper nodes, against the area vectors of the triangles, summed to the upper nodes by thirds.
    d = x[edges[:, 1]] - x[edges[:, 0]]
    length = np.linalg.norm(d, axis=1)
    pull = (stiffness * (length - rest) / length)[:, None] * d
    up = x[:, 2] > 0.05
    leaving = up[edges[:, 0]] & ~up[edges[:, 1]]
    entering = ~up[edges[:, 0]] & up[edges[:, 1]]
    held = pull[leaving].sum(axis=0) - pull[entering].sum(axis=0)
    vectors = np.cross(x[net.triangles[:, 1]] - x[net.triangles[:, 0]], x[net.triangles[:, 2]] - x[net.triangles[:, 0]]) / 2
    pushed = p * (up[net.triangles].sum(axis=1) / 3) @ vectors
    np.testing.assert_allclose(held + pushed, 0, atol=1e-8 * np.abs(pushed).max())


def test_transforms_and_single_precision():
    """Batches of winds and pressures give what each gives; the Hessian of the energy is minus the Jacobian of the force; float32 agrees."""
    tetrahedron = js.from_triangles([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], 4)
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.1, 0.2, 1.0)])

    def both(p, x, dtype=np.float64):
        air = js.cloth.Air(tetrahedron, drag=1.2, friction=0.1, lift=0.2, viscous=p, wind=jnp.stack([p, 2 * p, -p]))
        parts = js.cloth.Pressure.of_gas(tetrahedron, corners, 10.0 * p), air
        system = js.System(tetrahedron, np.ones(4, dtype), parts)
        state = js.State.from_points(tetrahedron, jnp.asarray(x, dtype), jnp.asarray(-x, dtype))
        return jnp.stack([tetrahedron.flatten_nodes(a) for a in system.force(state)], axis=-1), parts[0]

    ps, x = jnp.array([0.5, 1.0, 2.0]), jnp.asarray(1.1 * corners)
    batch = jax.jit(jax.vmap(lambda p: both(p, x)[0]))(ps)
    single = jax.jit(lambda p: both(p, x)[0])
    for p, found in zip(ps, batch, strict=True):
        np.testing.assert_allclose(found, single(p), rtol=1e-11, atol=1e-12 * 101325)
    gas = both(1.0, x)[1]

    def of(method):
        return lambda x: method(js.State.from_points(tetrahedron, x))

    hessian = jax.jit(jax.hessian(of(gas.energy)))(x)
    jacobian = jax.jit(jax.jacfwd(lambda x: jnp.stack([tetrahedron.flatten_nodes(a) for a in of(gas.force)(x)], axis=-1)))(x)
    np.testing.assert_allclose(hessian, -jacobian, rtol=1e-10, atol=1e-6)
    low = both(np.float32(1.0), np.asarray(x, np.float32), np.float32)[0]
    assert low.dtype == np.float32
    np.testing.assert_allclose(low, both(1.0, x)[0], rtol=3e-5, atol=0.05)
