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


@jax.jit
def of_air(x, v):
    """Force, both its derivatives and bounds, in the user's order; and what even motions meet by the blocks and by differentiation."""

    def force(x, v, air=AIR):
        return jnp.stack([NET.flatten_nodes(a) for a in air.force(state(x, v))], axis=-1)

    by_x, by_v = jax.jacfwd(force, (0, 1))(x, v)
    level = eqx.tree_at(lambda air: air.lift, AIR, jnp.zeros(()))
    even = []
    for axis in range(3):
        shift = jnp.zeros((5, 3)).at[:, axis].set(1.0)
        rows = AIR.damping_blocks(state(x, v)).product(NET.vector_field(shift))
        change = jax.jvp(lambda v: force(x, v, level), (v,), (shift,))[1]
        even.append((jnp.stack([NET.flatten_nodes(a) for a in rows], axis=-1), -change))
    bounds = AIR.stiffness_bound(state(x, v)), AIR.damping_bound(state(x, v))
    return force(x, v), (by_x, by_v), tuple(NET.flatten_nodes(bound) for bound in bounds), even


def test_air_is_the_sum_over_triangles():
    """Drag, friction, lift and the linear form as in NumPy; a triangle turned over changes nothing; lift does no work."""
    found = of_air(POINTS, SPEEDS)[0]
    np.testing.assert_allclose(found, air_in_numpy(POINTS, SPEEDS, 0.2), rtol=1e-12, atol=1e-13)
    over = js.cloth.Air(NET, *(AIR.drag, 0.1, 0.3, 0.5, 1.3), AIR.wind, triangles=np.asarray(NET.triangles)[:, ::-1])
    still = js.cloth.Air(NET, drag=0.0, lift=1.0)
    moving = state(speeds=np.tile([0.3, 1.0, -2.0], (5, 1)))
    turned, power = jax.jit(lambda: (over.force(state()), jnp.sum(still.force(moving).dot(moving.velocity))))()
    np.testing.assert_allclose(flat(NET, turned), found, rtol=1e-13, atol=1e-13)
    assert abs(float(power)) < 1e-14


def test_still_air_takes_energy_out(rng):
    """The power of drag, friction, lift and the linear form is never above zero, and below for what moves across."""
    still = js.cloth.Air(NET, drag=1.2, friction=0.2, lift=0.5, viscous=0.1)
    assert not still.can_feed
    power = jax.jit(lambda s: jnp.sum(still.force(s).dot(s.velocity)))
    for _ in range(20):
        assert float(power(state(rng.normal(size=(5, 3)), rng.normal(size=(5, 3))))) < 0


def test_jacobians_of_air():
    """dF/dx and dF/dv against central differences to 1e-6; bounds hold; blocks are the sums of the rows of -dF/dv, but for lift."""
    _, jacobians, bounds, even = of_air(POINTS, SPEEDS)
    for i, (by, bound) in enumerate(zip(jacobians, bounds, strict=True)):
        differences = np.empty((15, 15))
        for k in range(15):
            step = np.zeros((2, 15))
            step[i, k] = 1e-5
            along_x, along_v = step.reshape(2, 5, 3)
            up, down = (of_air(POINTS + sign * along_x, SPEEDS + sign * along_v)[0] for sign in (1, -1))
            differences[:, k] = np.ravel(up - down) / 2e-5
        assert reference.relative_error(by.reshape(15, 15), differences) < 1e-6
        blocks = differences.reshape(5, 3, 5, 3).transpose(0, 2, 1, 3)
        assert (np.linalg.norm(blocks, ord=2, axis=(2, 3)).sum(axis=1) <= np.asarray(bound) * 1.0001).all()
    for by_blocks, by_derivative in even:
        np.testing.assert_allclose(by_blocks, by_derivative, rtol=1e-10, atol=1e-12)


def test_a_triangle_without_area_feels_nothing():
    """Its force is finite, and so are all derivatives: no NaN."""
    points = POINTS.copy()
    points[1] = points[0]
    for found in jax.tree.leaves(of_air(points, SPEEDS)):
        assert np.isfinite(found).all()
    np.testing.assert_array_equal(of_air(points, SPEEDS)[0][0], 0)


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
    """From rest v = v_t tanh(g t / v_t); derivatives of the speed by rho, C_d and an even upward wind in closed form and by differences."""
    time, n = 0.6, 120

    @jax.jit
    @jax.value_and_grad
    def speed(p):
        rho, drag, up = p
        wind = jnp.stack([jnp.zeros(()), jnp.zeros(()), up])
        system = js.System(SHEET, MASS, (js.Gravity((0, 0, -G)), js.cloth.Air(SHEET, drag=drag, density=rho, wind=wind)))

        def rate(v):
            fall = js.Vector(tuple(jnp.full(len(PLACES), a) for a in (0.0, 0.0, -v)))
            return -system.acceleration(eqx.tree_at(lambda s: s.velocity, falling(0.0), fall)).z[3]

        def step(v, _):
            h = time / n
            a = rate(v)
            b = rate(v + h / 2 * a)
            c = rate(v + h / 2 * b)
            return v + h / 6 * (a + 2 * b + 2 * c + rate(v + h * c)), None

        return jax.lax.scan(step, jnp.zeros(()), None, length=n)[0]

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


@pytest.mark.slow
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


@eqx.filter_jit
def forces_of(parts, state):
    return [part.force(state) for part in parts]


def forces_inside():
    """A constant pressure, and a gas in a ball with a hole that is capped."""
    opened = js.from_triangles(BALL.triangles[np.abs(ROUND[BALL.triangles].mean(axis=1) - ROUND[0]).max(axis=1) > 0.45], len(ROUND))
    return (
        (BALL, js.cloth.Pressure(BALL, ROUND, 50.0)),
        (opened, js.cloth.Pressure.of_gas(opened, ROUND, 50.0, ambient=200.0, cap_holes=True)),
    )


@pytest.mark.parametrize("case", range(2))
def test_pressure_is_the_gradient_of_its_energy(case, rng):
    """F = -dE/dx by JAX and by differences; no net force, no net moment; dF/dx against differences to 1e-6; the bound holds."""
    net, pressure = forces_inside()[case]
    points = 1.2 * ROUND + 0.05 * rng.normal(size=ROUND.shape)

    @jax.jit
    def of_pressure(x):
        def force(x):
            return jnp.stack([net.flatten_nodes(a) for a in pressure.force(js.State.from_points(net, x))], axis=-1)

        energy, slope = jax.value_and_grad(lambda x: pressure.energy(js.State.from_points(net, x)))(x)
        bound = net.flatten_nodes(pressure.stiffness_bound(js.State.from_points(net, x)))
        return force(x), energy, slope, jax.jacfwd(force)(x), bound

    found, _, slope, jacobian, bound = map(np.asarray, of_pressure(points))
    scale = np.abs(found).max()
    np.testing.assert_allclose(found, -slope, atol=1e-12 * scale)
    np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-11 * scale)
    np.testing.assert_allclose(np.cross(points, found).sum(axis=0), 0, atol=1e-11 * scale)
    for node, axis in ((3, 0), (7, 2), (20, 1)):
        step = np.zeros_like(points)
        step[node, axis] = 1e-5
        up, down = of_pressure(points + step), of_pressure(points - step)
        assert float(up[1] - down[1]) / 2e-5 == pytest.approx(-found[node, axis], rel=1e-6, abs=1e-7 * scale)
        assert reference.relative_error(jacobian[:, :, node, axis], np.asarray(up[0] - down[0]) / 2e-5) < 1e-6
    rows = np.linalg.norm(jacobian.transpose(0, 2, 1, 3), ord=2, axis=(2, 3)).sum(axis=1)
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


def test_a_balloon_of_twelve_nodes_is_at_rest():
    """An icosahedron of equal springs: 30 k (a - l) = p dV/da, V = 5 (3 + sqrt 5) a^3 / 12; there no node feels a force, to rounding."""
    net, points = sphere(0)
    side = float(np.asarray(net.lengths(points)).mean())
    k, l, p = 50.0, 0.9 * side, 20.0
    a = np.roots([p * 5 / 4 * (3 + 5**0.5), -30 * k, 30 * k * l]).min()
    springs, pressure = js.Springs(net, k, l), js.cloth.Pressure(net, points, p)
    blown = js.State.from_points(net, a / side * points)
    assert float(pressure.enclosed(blown)) == pytest.approx(5 * (3 + 5**0.5) * a**3 / 12, rel=1e-13)
    pulled, pushed = (flat(net, force) for force in forces_of((springs, pressure), blown))
    assert np.abs(pulled + pushed).max() < 1e-12 * np.abs(pushed).max()


def test_a_sphere_under_pressure_has_the_tension_of_laplace():
    """p R / 2 = T: on meshes of a sphere of springs of the tension T per length, the balance is met to second order in the spacing.

    Springs of stiffness E S / l^2, stretched by the share e, pull T = 3/2 E e / (1 + e) per length of the stretched sheet, whichever way.
    """
    modulus, e = 100.0, 0.05
    pressure_of_laplace = 2 / (1 + e) * 1.5 * modulus * e / (1 + e)
    lacking = []
    for level in (1, 2):
        net, points = sphere(level)
        a, b, c = (points[net.triangles[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        rest = net.lengths(points)
        # Of the area at a side only its sum matters here.
        springs = js.Springs(net, 3 * modulus * area / net.n_springs / rest**2, rest)
        pressure = js.cloth.Pressure(net, points, pressure_of_laplace)
        state = js.State.from_points(net, (1 + e) * points)
        pulled, pushed = (flat(net, force) for force in forces_of((springs, pressure), state))
        # The work of a growth by its own radius.
        lacking.append(1 + np.sum(pulled * points) / np.sum(pushed * points))
    assert abs(lacking[1]) < 0.03
    assert np.log2(lacking[0] / lacking[1]) == pytest.approx(2, abs=0.15)


def test_transforms_and_single_precision():
    """Batches of winds and pressures give what each gives; the Hessian of the energy is minus the Jacobian of the force; float32 agrees."""
    tetrahedron = js.from_triangles([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], 4)
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.1, 0.2, 1.0)])

    def force(p, x):
        air = js.cloth.Air(tetrahedron, drag=1.2, friction=0.1, lift=0.2, viscous=p, wind=jnp.stack([p, 2 * p, -p]))
        gas = js.cloth.Pressure.of_gas(tetrahedron, corners, 10 * p)
        state = js.State.from_points(tetrahedron, x, -x)
        parts = js.System(tetrahedron, jnp.ones(4, x.dtype), (gas, air)).bind(x.dtype).forces
        return jnp.stack([sum(tetrahedron.flatten_nodes(part.force(state)[i]) for part in parts) for i in range(3)], axis=-1)

    def derivatives(x):
        gas = js.cloth.Pressure.of_gas(tetrahedron, corners, 10.0)

        def inside(x):
            return jnp.stack([tetrahedron.flatten_nodes(a) for a in gas.force(js.State.from_points(tetrahedron, x))], axis=-1)

        hessian = jax.hessian(lambda x: gas.energy(js.State.from_points(tetrahedron, x)))(x)
        return hessian, jax.jacfwd(inside)(x)

    ps, x = jnp.array([0.5, 1.0, 2.0]), jnp.asarray(1.1 * corners)
    hessian, jacobian = jax.jit(derivatives)(x)
    batch = jax.jit(jax.vmap(force, (0, None)))(ps, x)
    single = jax.jit(force)
    for p, found in zip(ps, batch, strict=True):
        np.testing.assert_allclose(found, single(p, x), rtol=1e-11, atol=1e-12 * 101325)
    np.testing.assert_allclose(hessian, -jacobian, rtol=1e-10, atol=1e-6)
    low = single(np.float32(1.0), np.asarray(x, np.float32))
    assert low.dtype == np.float32
    np.testing.assert_allclose(low, batch[1], rtol=3e-5, atol=0.05)
