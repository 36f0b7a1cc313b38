"""Hinges: the gradient of their energy, exact matrices, conserved momenta, the plate that they are, creases."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.topology.hinge_list import hinges_of

RNG = np.random.default_rng(31)
PLANE = RNG.random((12, 2))
NET = js.delaunay(PLANE)
SHEET = np.column_stack([PLANE, 0.3 * RNG.normal(size=12)])
FLAT = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.5, 1.0, 0.0), (0.5, -1.0, 0.0)]
PAIR = js.from_triangles([(0, 1, 2), (1, 0, 3)], 4)


def as_points(net, v):
    """(N, 3) values in the user's order."""
    return jnp.stack([net.flatten_nodes(a) for a in v], axis=-1)


@pytest.fixture(scope="module")
def looked_at():
    """Whatever the first laws speak of, from one program: of a crumpled mesh with rest angles of its own."""
    rest = np.linspace(-0.5, 0.5, len(hinges_of(NET.triangles)))
    hinges = js.cloth.Hinges(NET, np.linspace(1.0, 2.0, len(rest)), rest)

    def everything(x, v):
        state = js.State.from_points(NET, x)

        def force(x):
            return as_points(NET, hinges.force(js.State.from_points(NET, x)))

        def gradient(x):
            return jax.grad(lambda x: hinges.energy(js.State.from_points(NET, x)))(x)

        system = js.System(NET, 1.0, hinges)
        exact = system.matrix(hinges.stiffness_blocks(state, js.steppers.ExactTangent()), state)
        clamped = system.matrix(hinges.stiffness_blocks(state, js.steppers.Tangent()), state)
        bound = NET.flatten_nodes(hinges.stiffness_bound(state))
        return force(x), gradient(x), as_points(NET, exact(NET.vector_field(v))), exact, clamped.to_dense(), bound, hinges.angles(state)

    return hinges, jax.jit(everything)


def test_forces_are_the_gradient_and_matrices_its_derivative(looked_at):
    """F = -grad E; the exact blocks are the central differences of the forces; the clamped ones are k g g' and resist every motion."""
    hinges, everything = looked_at
    v, h = RNG.normal(size=(12, 3)), 1e-6
    force, gradient, product, exact, clamped, _, _ = everything(SHEET, v)
    np.testing.assert_allclose(force, -gradient, atol=1e-12 * float(jnp.abs(force).max()))
    ahead, behind = everything(SHEET + h * v, v), everything(SHEET - h * v, v)
    slope = -(ahead[0] - behind[0]) / (2 * h)
    np.testing.assert_allclose(product, slope, atol=1e-6 * float(jnp.abs(slope).max()))
    np.testing.assert_allclose(exact.to_scipy().toarray(), exact.to_dense(), atol=1e-11)
    angles = (ahead[6] - behind[6]) / (2 * h)
    along = v.ravel() @ clamped @ v.ravel()
    assert along == pytest.approx(float(jnp.sum(hinges.stiffness * angles**2)), rel=1e-6)
    assert np.linalg.eigvalsh(clamped)[0] > -1e-9 * np.abs(clamped).max()


def test_momenta_and_the_bound_of_the_stiffness(looked_at):
    """Forces add up to nothing and turn nothing; the bound that `stable_dt` takes is above the stiffest motion, in both precisions."""
    hinges, everything = looked_at
    force, _, _, exact, _, bound, _ = everything(SHEET, SHEET)
    size = float(jnp.abs(force).sum())
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-14 * size)
    np.testing.assert_allclose(np.cross(SHEET, force).sum(axis=0), 0.0, atol=1e-14 * size)
    stiffest = np.linalg.eigvalsh(exact.to_dense())[-1]
    assert stiffest <= float(bound.max()) <= 6 * stiffest
    dt = js.stable_dt(js.System(NET, 1.0, hinges), js.State.from_points(NET, SHEET))
    assert float(dt) == pytest.approx(2 / np.sqrt(float(bound.max())), rel=1e-12)


def test_a_direct_solver_takes_their_pairs():
    """Skyline of the net and of the hinges' pairs solves what the dense matrix solves, held nodes and all; without the pairs it refuses."""
    hinges = js.cloth.Hinges.from_bending(NET, PLANE, 0.3)
    system = js.System(NET, 1.0, (js.Springs(NET, 5.0, 0.2), hinges), free=np.arange(12) > 1)
    state = js.State.from_points(NET, SHEET, RNG.normal(size=(12, 3)))
    blocks = js.linalg.Blocks((state.position.map(jnp.ones_like),)) + system.stiffness_blocks(state, js.steppers.Tangent())
    matrix = system.matrix(blocks, state)
    found = js.Skyline(NET, hinges.pairs).factor(matrix).solve(state.velocity)
    right = np.linalg.solve(matrix.to_dense(), np.ravel(state.velocities))
    np.testing.assert_allclose(as_points(NET, found).ravel(), right, rtol=1e-10, atol=1e-12)
    with pytest.raises(ValueError, match="pairs"):
        js.Skyline(NET).factor(matrix)


# --- The plate ---


def patch(is_square):
    """A mesh of 7 x 7 nodes of spacing 1 about the origin."""
    i = np.arange(-3, 4)
    points = np.stack(np.meshgrid(i, i, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)
    a = (7 * np.arange(6)[:, None] + np.arange(6)).ravel()
    triangles = np.concatenate([np.stack([a, a + 7, a + 1], -1), np.stack([a + 7, a + 8, a + 1], -1)])
    shear = np.eye(2) if is_square else np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
    return js.from_triangles(triangles, len(points)), points @ shear


def cylinder(degrees):
    """A sheet rolled up along a direction, without stretch."""
    u = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    v = np.array([-u[1], u[0]])
    return lambda p: np.column_stack([np.outer(np.sin(p @ u), u) + np.outer(p @ v, v), np.cos(p @ u) - 1])


def bowl(xx, yy, xy):
    """A surface of these second derivatives at the origin."""
    return lambda p: np.column_stack([p, 0.5 * (xx * p[:, 0] ** 2 + yy * p[:, 1] ** 2) + xy * p[:, 0] * p[:, 1]])


SURFACES = {
    "along": cylinder(0.0),
    "across": cylinder(90.0),
    "at 15": cylinder(15.0),
    "at 45": cylinder(45.0),
    "at 135": cylinder(135.0),
    "sphere": bowl(1, 1, 0),
    "twist": bowl(0, 0, 1),
    "turned twist": bowl(1, -1, 0),
}
PLATES = {
    "equilateral": dict(zip(SURFACES, (1, 1, 1, 1, 1, 4 / 3, 8 / 3, 8 / 3), strict=True)),
    "square": dict(zip(SURFACES, (1, 1, 0.75, 1, 3, 2, 6, 2), strict=True)),
}


@pytest.mark.parametrize("kind", PLATES)
def test_energies_are_those_of_a_plate(kind):
    """Energy over B/2 curvature^2: on equilateral triangles 1, 4/3, 8/3 in every direction; on squares the anisotropy that is documented.
    Errors fall as h^2; at h = 1/200 they are below 1e-3.
    """
    net, points = patch(kind == "square")
    hinges = js.cloth.Hinges.from_bending(net, points, 1.0)  # B |e|^2 / A knows no h
    bent = jax.jit(lambda x: hinges.angles(js.State.from_points(net, x)))
    corners = points[hinges.nodes]
    e, f, g = (np.pad(corners[:, i] - corners[:, 0], ((0, 0), (0, 1))) for i in (1, 2, 3))
    area = 0.5 * (np.abs(np.cross(e, f)[:, 2]) + np.abs(np.cross(e, g)[:, 2]))
    direction = np.round(np.degrees(np.arctan2(e[:, 1], e[:, 0]))) % 180

    def density(surface, h):
        # A third of both triangles belongs to each hinge, and of the three directions the patch has not as many each.
        each = np.asarray(hinges.stiffness) * np.asarray(bent(surface(h * points))) ** 2 / (h * h * area / 3)
        return np.mean([each[direction == d].mean() for d in np.unique(direction)])

    for name, surface in SURFACES.items():
        wrong = [density(surface, h) - PLATES[kind][name] for h in (0.02, 0.01, 0.005)]
        assert abs(wrong[-1]) < 2e-3 * PLATES[kind][name], name
        assert abs(wrong[-1]) < 1e-12 or wrong[-2] / wrong[-1] == pytest.approx(4.0, abs=0.05), name


@pytest.mark.slow
def test_the_heavy_cantilever_as_a_strip():
    """20 rows of equilateral triangles, clamped horizontally and bent about the rows: within 1 % of the rod for loads from 1 to 20. Across
    the rows the strip is periodic: with free edges a narrow strip of Poisson's ratio -1/3 has 8/9 of the bending stiffness.
    """
    n, across, g = 20, 4, 9.81
    edge = 1 / n / np.sqrt(0.75)
    row, column = np.divmod(np.arange((n + 2) * across), across)
    flat = np.column_stack([(row - 1) / n, edge * (column + 0.5 * (row % 2)), 0.0 * row])
    a = np.arange((n + 1) * across)
    b, is_odd = a - a % across + (a + 1) % across, (row[: len(a)] % 2 == 1)[:, None]
    up, down = a + across, b + across
    triangles = np.concatenate(
        [
            np.where(is_odd, np.stack(odd, -1), np.stack(even, -1))
            for odd, even in (((a, down, up), (a, b, up)), ((a, b, down), (b, down, up)))
        ]
    )
    net = js.Graph.from_edges(js.from_triangles(triangles, len(flat)).edges, len(flat), triangles=triangles, box=[0.0, across * edge, 0.0])
    plate = js.cloth.Hinges.from_bending(net, flat, 1.0)
    # Half an element bends at the clamp.
    at_clamp = (row[plate.nodes[:, :2]] == 1).all(axis=1)
    hinges = js.cloth.Hinges(net, np.where(at_clamp, 2.0, 1.0) * plate.stiffness, triangles=plate.triangles)
    springs = js.Springs(net, 1e5, net.lengths(flat))
    for gamma, drop in ((1, 0.123471), (8, 0.640631), (20, 0.829881)):
        mass = np.where(row > n, 0.5, 1.0) * gamma * edge / n / g
        system = js.System(net, mass, (springs, hinges, js.Gravity((0.0, 0.0, -g))), free=row > 1)
        start = flat - np.outer(np.clip(flat[:, 0], 0.0, 1.0) ** 2, [0.3, 0.0, 0.6])
        found = js.equilibrium(system, js.State.from_points(net, start), tolerance=1e-6)
        js.raise_for_status(found)
        end = np.asarray(found.state.points)[row > n, 2]
        np.testing.assert_allclose(-end, drop, rtol=1e-2)
        np.testing.assert_allclose(end, end[0], rtol=1e-8)


# --- Meshes ---


def strip(n, is_turned):
    """A ring of n squares with a diagonal each, closed with half a turn or without."""
    squares = [(2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3) for i in range(n)]
    squares[-1] = (*squares[-1][:2], *((1, 0) if is_turned else (0, 1)))
    return np.array([t for a, b, c, d in squares for t in ((a, c, b), (c, d, b))])


def test_windings_and_a_moebius_strip():
    """Turning triangles over changes no energy; a strip with one side has a hinge at every inner edge, and F = -grad E."""
    x = RNG.normal(size=(16, 3))
    triangles = strip(8, is_turned=True)
    found = []
    for t in (triangles, np.where(RNG.random((16, 1)) < 0.5, triangles, triangles[:, ::-1])):
        net = js.from_triangles(t, 16)
        hinges = js.cloth.Hinges(net, 1.0, rest_points=np.roll(x, 1, axis=0))
        assert len(hinges.nodes) == 16
        state = js.State.from_points(net, x)
        found.append((hinges.energy(state), as_points(net, hinges.force(state))))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-13)
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-11)
    slope = jax.grad(lambda x: hinges.energy(js.State.from_points(net, x)))(x)
    np.testing.assert_allclose(found[1][1], -slope, atol=1e-11)


@pytest.mark.parametrize(
    ("triangles", "message"),
    [
        ([(0, 1, 2), (1, 0, 3), (0, 1, 3)], "triangles, numbers"),
        ([(0, 1, 2), (2, 1, 0)], "same three corners"),
        ([(0, 1, 2)], "no hinge"),
        (None, "has no triangles"),
    ],
    ids=["three at an edge", "twice", "alone", "none"],
)
def test_meshes_that_have_no_hinges_are_refused(triangles, message):
    """By name, with what to do."""
    with pytest.raises(ValueError, match=message):
        js.cloth.Hinges(js.lattice((2, 2)), 1.0, triangles=triangles)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stiffness": -1.0}, "stiffness"),
        ({"stiffness": [1.0, 2.0]}, "one per hinge"),
        ({"stiffness": 1.0, "rest_angle": np.nan}, "rest_angle"),
        ({"stiffness": 1.0, "rest_angle": 0.5, "rest_points": FLAT}, "both given"),
    ],
)
def test_bad_constants_are_refused(arguments, message):
    """Sign, shape, NaN, and two rest shapes."""
    with pytest.raises(ValueError, match=message):
        js.cloth.Hinges(PAIR, **arguments)
    with pytest.raises(ValueError, match="3 coordinates"):
        js.cloth.Hinges(PAIR, 1.0).force(js.State.from_points(PAIR, np.array(FLAT)[:, :2]))


# --- Implicit steps ---


@pytest.mark.slow
def test_a_gradient_through_implicit_steps(sooner):
    """By B and by places, through 20 implicit steps of a strip that hangs over, against central differences."""
    lattice = js.lattice((2, 5))
    a = np.array([0, 1, 2, 3])
    triangles = np.concatenate([np.stack([a, a + 1, a + 5], -1), np.stack([a + 1, a + 6, a + 5], -1)])
    net = js.from_triangles(triangles, 10)
    points = np.pad(lattice.grid(0.02), ((0, 0), (0, 1)))
    rest, plate = net.lengths(points), js.cloth.Hinges.from_bending(net, points, 1.0)
    solver = js.CG(tolerance=1e-13)

    def end(bending, points):
        hinges = js.cloth.Hinges(net, bending * plate.stiffness, triangles=plate.triangles)
        forces = (js.Springs(net, 20.0, rest), hinges, js.Gravity((0.0, 0.0, -9.81)))
        system = js.System(net, 2e-4, forces, free=np.arange(10) % 5 > 1)
        run = js.rollout(system, js.State.from_points(net, points), js.BackwardEuler(solver), 4e-3, 20)
        return jnp.sum(run.state.points[4] * jnp.array([1.0, 0.5, 3.0])), run.status

    # Springs at their rest length are where their clamped blocks have a kink: none is.
    start = points + 1e-3 * RNG.normal(size=points.shape)
    value = jax.jit(jax.value_and_grad(end, argnums=(0, 1), has_aux=True))
    (_, status), (by_b, by_x) = value(4e-5, start)
    js.raise_for_status(status)
    h, way = 1e-9, RNG.normal(size=(10, 3))
    difference = value(4e-5 + h, start)[0][0] - value(4e-5 - h, start)[0][0]
    assert float(by_b) == pytest.approx(float(difference) / (2 * h), rel=1e-5)
    h = 1e-8
    difference = value(4e-5, start + h * way)[0][0] - value(4e-5, start - h * way)[0][0]
    assert float(jnp.sum(by_x * way)) == pytest.approx(float(difference) / (2 * h), rel=1e-5)


# --- Creases ---


def test_a_crease():
    """Bent to d: kept (d - y) / (1 + H), moment k (y + H a); brought back to flat: reverse yield; books, derivative and first time."""
    k, y, hard, d = 2.0, 0.4, 0.25, 1.2
    net = PAIR

    def bent(theta):
        return [*FLAT[:3], (0.5, -np.cos(theta), -np.sin(theta))]

    @jax.jit
    def kept(k, y, hard, first, second):
        rule = js.cloth.PlasticHinges(net, y, hard)
        system = js.System(net, 1.0, js.cloth.Hinges(net, k), free=np.zeros(4, bool), rules=(rule, js.Ledger()))
        state = js.rollout(system, js.State.from_points(net, first), js.Still(), 0.5, 1).state
        away = dataclasses.replace(state, position=net.vector_field(second))
        back = js.rollout(system, away, js.Still(), 0.5, 1).state
        crease = back.memory[1].value
        return state.memory[1].value.angle[0], system.forces[0].moments(state)[0], crease, state, back

    first, second = jnp.asarray(bent(d)), jnp.asarray(bent(0.0))
    angle, moment, crease, state, _ = kept(k, y, hard, first, second)
    a = (d - y) / (1 + hard)
    assert float(angle) == pytest.approx(a, rel=1e-12)
    assert float(moment) == pytest.approx(k * (y + hard * a), rel=1e-12)
    b = (a - y - hard * a) / (1 + hard)
    assert float(crease.angle[0]) == pytest.approx(a - max(b, 0.0), rel=1e-12)
    assert float(crease.since[0]) == 0.5
    system = js.System(net, 1.0, js.cloth.Hinges(net, k), free=np.zeros(4, bool), rules=(js.cloth.PlasticHinges(net, y, hard), js.Ledger()))
    book = js.energy_ledger(system, state)
    assert book["rules"]["PlasticHinges"]["Hinges"] == pytest.approx(-k * (y * a + hard * a * a / 2), rel=1e-12)
    assert system.rules[0].onset(state).count == 1
    slope = jax.grad(lambda y: kept(k, y, hard, first, second)[0])(y)
    assert float(slope) == pytest.approx(-1 / (1 + hard), rel=1e-12)
    with pytest.raises(ValueError, match="needs one Hinges"):
        js.System(net, 1.0, rules=js.cloth.PlasticHinges(net, y))
