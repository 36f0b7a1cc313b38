"""Hard cases K11, and nets in boxes and far from the origin: periods, nearest images, Delaunay and host geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests.particles import components


def free_net(n, box):
    """`n` nodes without springs in a box."""
    return js.Graph.from_edges(np.zeros((0, 2), int), n, box=box)


def joined(box):
    """Two nodes and a spring in a box."""
    return js.Graph.from_edges([(0, 1)], 2, box=box)


def images(points, box):
    """(N, N, D) nearest images of the differences, in NumPy."""
    d = points[:, None] - points[None]
    period = np.where(box > 0, box, np.inf)
    return d - np.where(box > 0, box, 0) * np.round(d / period)


def lennard_jones(points, box, reach=np.inf):
    """(N, D) forces and the energy of a Lennard-Jones fluid (1 J, 1 m), cut off plainly, pair by pair."""
    d = images(points, box)
    squared = np.sum(d * d, axis=-1) + np.eye(len(points))
    near = (squared < reach**2) & ~np.eye(len(points), dtype=bool)
    weight = np.where(near, 24 * (2 / squared**6 - 1 / squared**3) / squared, 0)
    end = 4 * (reach**-12 - reach**-6)
    return np.sum(weight[..., None] * d, axis=1), np.sum(np.where(near, 4 * (squared**-6 - squared**-3) - end, 0)) / 2


def scattered(rng, box, spacing=1.1):
    """Points no nearer than 0.8 m, on a jittered grid that fills the box (6 m where there is no period), some boxes away."""
    extent = np.where(box > 0, box, 6.0)
    counts = np.floor(extent / spacing).astype(int)
    grid = np.stack(np.meshgrid(*[np.arange(n) * e / n for n, e in zip(counts, extent, strict=True)], indexing="ij"), axis=-1)
    points = grid.reshape(-1, len(box)) + rng.uniform(-0.08, 0.08, (counts.prod(), len(box)))
    return points + box * rng.integers(-2, 3, points.shape)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.Graph.from_edges([(0, 1)], 2, box=[5.0, -10.0]), r"box\[1\] = -10\.0 along y"),
        (lambda: js.Graph.from_edges([(0, 1)], 2, box=[np.nan]), r"box\[0\] = nan along x"),
        (lambda: js.lattice(4, periodic=True, box=[np.inf]), r"box\[0\] = inf along x"),
        (lambda: js.lattice((4, 6), periodic=True, box=[6.0, 0.0]), r"axis 0 wraps, but box\[1\] = 0\.0 gives y no period"),
        (lambda: js.lattice((4, 6), periodic=True, box=[0.0, 4.0]), r"axis 1 wraps, but box\[0\] = 0\.0 gives x no period"),
        (lambda: js.lattice((4, 6), periodic=True, box=[6.0]), "box has 1 periods, but shape"),
        (lambda: js.lattice((4, 6), periodic=True, box=[5.0, 4.0]).grid(1.0), r"6 m, but box\[0\] = 5 m.*spacing = 0\.8333"),
        (lambda: js.State.from_points(free_net(2, [5.0]), np.zeros((2, 2))), "box has 1 periods, but positions have 2"),
        (lambda: js.Springs(js.lattice(5, periodic=True, box=[5.0]), 1.0, 2.6), r"rest_length = 2\.6 m.*more than 2\.5 m"),
        (lambda: js.Springs(js.Graph.from_edges([(0, 1)] * 2, 2, box=[3.0, 4.0]), 1.0, [1.0, 2.6]), r"rest_length\[1\] = 2\.6 m"),
        (lambda: fluid(free_net(2, [5.0, 0.0]), js.fluid.PlainCutoff(2.6)), r"cut-off = 2\.6 m is beyond half.*at most 2\.5 m"),
        (lambda: fluid(free_net(2, [6.0]), js.fluid.PlainCutoff(2.5), drag=js.fluid.PairDrag(1.0, 3.1)), r"drag\.radius = 3\.1"),
    ],
)
def test_a_wrong_box_is_refused_by_name(make, message):
    """A period that is negative, not finite, missing or too small is a ValueError that names the axis and the value."""
    with pytest.raises(ValueError, match=message):
        make()


def fluid(net, cutoff=None, **options):
    """A Lennard-Jones fluid of 1 J and 1 m."""
    return js.System(net, 1.0, js.Fluid(js.fluid.LennardJones(1.0, 1.0), cutoff=cutoff, **options))


@pytest.mark.parametrize("box", [[5.0, 0.0], [6.0, 7.0, 8.0]])
def test_what_a_box_allows(box):
    """A coordinate without period, rest lengths along a diagonal, cut-offs of exactly half a period, and rings that close in space."""
    net = free_net(2, box)
    fluid(net, js.fluid.PlainCutoff(min(b for b in box if b) / 2))
    js.Springs(js.Graph.from_edges([(0, 1)], 2, box=box), 1.0, 0.49 * np.linalg.norm(box))
    ring = js.lattice(6, periodic=True, box=[0.0] * len(box))
    angle = np.arange(6) * np.pi / 3
    points = np.zeros((6, len(box)))
    points[:, 0], points[:, 1] = np.cos(angle), np.sin(angle)
    np.testing.assert_allclose(ring.lengths(points), 1.0, rtol=1e-12)


def test_the_grid_of_a_lattice_closes():
    """Without a spacing every spring of a wrapped lattice has the same length, whatever the period."""
    net = js.lattice((4, 6), periodic=(False, True), box=[9.0, 0.0])
    lengths = np.asarray(net.lengths(net.grid()))
    np.testing.assert_allclose(np.sort(lengths), [1.0] * 18 + [1.5] * 24, rtol=1e-12)


@pytest.mark.parametrize("stepper", [js.VelocityVerlet(), js.BackwardEuler()], ids=["explicit", "implicit"])
@pytest.mark.parametrize("speed", [0.9, 1.5])
def test_a_spring_beyond_half_a_period_is_told(speed, stepper):
    """A spring that swings by v sqrt(m / 2k) about 4 m in a box of 10 m: right and quiet below 5 m, BOX (an error) beyond."""
    net = joined([10.0])
    system = js.System(net, 1.0, js.Springs(net, 1.0, 4.0))
    state = js.State.from_points(net, [[0.0], [4.0]], [[-speed / 2], [speed / 2]])
    result = js.rollout(system, state, stepper, 0.01, 400)
    if speed / np.sqrt(2) < 1:
        assert int(result.status.flags) == 0
        if isinstance(stepper, js.VelocityVerlet):
            expected = 4 + speed / np.sqrt(2) * np.sin(4 * np.sqrt(2))
            np.testing.assert_allclose(result.state.points[1, 0] - result.state.points[0, 0], expected, atol=1e-3)
        return
    assert bool(result.status.has(js.Flag.BOX))
    assert not bool(result.status.is_ok)
    # The spring turns when it is 5 m long; a block of 20 steps sees it.
    turns_at = np.arcsin(np.sqrt(2) / speed) / np.sqrt(2)
    assert 0 < int(result.status.step) * 0.01 - turns_at < 0.3


def test_a_spring_of_half_a_period_is_told_at_once_and_a_broken_one_is_not():
    """Nodes half a period apart have two nearest images: BOX before the first step, unless the spring is broken or short."""
    net = js.Graph.from_edges([(0, 1), (1, 2)], 3, box=[10.0])
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0))
    state = js.State.from_points(net, [[0.0], [5.0], [6.0]])
    result = js.rollout(system, state, js.VelocityVerlet(), 1e-3, 1)
    assert bool(result.status.has(js.Flag.BOX))
    assert (int(result.status.step), int(result.status.count)) == (0, 1)
    with pytest.raises(js.SimulationError, match=r"BOX: the box is too small.*step 0"):
        js.raise_for_status(result)
    alive = net.edge_field(np.array([0.0, 1.0])).map(lambda a: a > 0)
    broken = js.State(state.time, state.position, state.velocity, state.layout, alive=alive)
    assert int(js.rollout(system, broken, js.VelocityVerlet(), 1e-3, 1).status.flags) == 0


def test_travelling_through_the_box_is_no_fault():
    """A ring that moves through ten boxes keeps its springs at rest and its status OK, on a lattice and on a graph."""
    lattice = js.lattice(5, periodic=True, box=[5.0])
    for net in (lattice, js.Graph.from_edges(lattice.edges, 5, box=[5.0])):
        system = js.System(net, 1.0, js.Springs(net, 10.0, 1.0))
        state = js.State.from_points(net, lattice.grid(), np.full((5, 1), 5.0))
        result = js.rollout(system, state, js.VelocityVerlet(), 0.1, 100)
        assert int(result.status.flags) == 0
        np.testing.assert_allclose(result.state.points, lattice.grid() + 50.0, atol=1e-9)


def test_a_box_that_was_traced_is_told():
    """A period whose value is known only when the program runs is looked at there: too small, INVALID where negative, under vmap."""

    def flags(box):
        net = free_net(2, box[None])
        state = js.State.from_points(net, [[0.3], [4.0]])
        return js.rollout(fluid(net, js.fluid.PlainCutoff(2.5)), state, js.VelocityVerlet(), 1e-4, 1).status.flags

    found = jax.vmap(flags)(jnp.array([12.0, 4.5, -12.0]))
    assert [int(flag) & int(js.Flag.BOX) > 0 for flag in found] == [False, True, True]

    def is_invalid(box):
        return js.Springs(joined(box[None]), 1.0, 1.0).invalid()

    np.testing.assert_array_equal(jax.vmap(is_invalid)(jnp.array([12.0, -12.0, jnp.nan])), [False, True, True])


def test_springs_in_some_coordinates_keep_their_periods():
    """Springs of the projection on the plane take the periods of its coordinates, in space as in the plane."""
    plane = js.Graph.from_edges([(0, 1)], 2, box=[10.0, 8.0])
    space = js.Graph.from_edges([(0, 1)], 2, box=[10.0, 8.0, 0.0])
    points = np.array([[0.5, 0.5, 0.0], [9.5, 7.5, 3.0]])
    ours = js.System(space, 1.0, js.Springs(space, 2.0, 1.0, axes=(0, 1))).force(js.State.from_points(space, points))
    flat = js.System(plane, 1.0, js.Springs(plane, 2.0, 1.0)).force(js.State.from_points(plane, points[:, :2]))
    np.testing.assert_allclose(components(ours)[:, :2], components(flat), rtol=1e-12)
    np.testing.assert_allclose(space.flatten_nodes(ours.x), [-2 * (1 - 1 / np.sqrt(2)), 2 * (1 - 1 / np.sqrt(2))], rtol=1e-12)
    np.testing.assert_array_equal(ours.z, 0)


def test_a_pair_through_the_wall():
    """Lennard-Jones at 0.9 m through the wall of a box of 12 m: 24 (2 / .9^13 - 1 / .9^7) = 138.66 N, each way."""
    net = free_net(2, [12.0])
    force = fluid(net).force(js.State.from_points(net, [[0.3], [11.4]])).x
    np.testing.assert_allclose(force, [138.65962, -138.65962], rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("box", "n_gradients"), [([9.0], 2), ([5.2, 0.0], 0), ([5.5, 5.0, 8.4], 0)], ids=["chain", "strip", "block"])
def test_a_fluid_in_a_box_is_the_sum_over_nearest_images(box, n_gradients, rng):
    """Force, energy and its derivatives by positions and box are NumPy's, with all pairs and with a list, in 1, 2 and 3 dimensions."""
    box = np.array(box)
    points = scattered(rng, box)
    force, energy = lennard_jones(points, box, reach=2.5)
    for i, pairs in enumerate((js.fluid.AllPairs(), js.fluid.NeighbourList(40, 0.3))):

        def energy_of(points, periods, pairs=pairs):
            net = free_net(len(points), periods)
            system = fluid(net, js.fluid.PlainCutoff(2.5), pairs=pairs)
            state = js.State.from_points(net, points)
            return system.energy(state).potential[0], system.force(state)

        value, forces = jax.jit(energy_of)(jnp.asarray(points), jnp.asarray(box))
        np.testing.assert_allclose(value, energy, rtol=1e-11)
        np.testing.assert_allclose(components(forces), force, rtol=1e-9, atol=1e-9)
        if i < n_gradients:
            slopes = jax.jit(jax.grad(lambda *at: energy_of(*at)[0], argnums=(0, 1)))(jnp.asarray(points), jnp.asarray(box))
            np.testing.assert_allclose(slopes[0], -force, rtol=1e-9, atol=1e-9)
            step = 1e-6 * np.eye(len(box))
            expected = [(lennard_jones(points, box + e, 2.5)[1] - lennard_jones(points, box - e, 2.5)[1]) / 2e-6 for e in step]
            np.testing.assert_allclose(np.where(box > 0, slopes[1], 0), np.where(box > 0, expected, 0), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_a_hot_fluid_crosses_the_walls(rng):
    """Through 300 steps and many walls the list gives the path of all pairs, energy is kept, and momentum to rounding."""
    box = np.array([5.5, 5.0, 5.2])
    points = scattered(rng, box, spacing=1.2)
    speeds = rng.normal(0, 2.0, points.shape)
    speeds -= speeds.mean(axis=0)
    net = free_net(len(points), box)
    ends = []
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(64, 0.4)):
        system = fluid(net, js.fluid.ShiftedForce(2.5), pairs=pairs)
        state = js.State.from_points(net, points, speeds)
        result = js.rollout(system, state, js.VelocityVerlet(), 2e-3, 300)
        assert int(result.status.flags) == 0
        ends.append(result.state)
        start = system.energy(state)
        assert abs(system.energy(result.state).total - start.total) < 2e-3 * start.kinetic
        np.testing.assert_allclose(system.momentum(result.state), 0, atol=1e-10)
    assert np.sum(np.floor(np.asarray(ends[0].points) / box) != np.floor(points / box)) > 20
    np.testing.assert_allclose(ends[1].points, ends[0].points, atol=1e-8)
    assert 2 <= int(ends[1].memory[0].value.rebuilds) <= 150


@pytest.mark.slow
def test_drag_and_overlap_through_the_wall():
    """Drag of a pair acts through the wall as inside the box, and two particles at one image are an OVERLAP."""
    drag = js.fluid.PairDrag(2.0, 1.5)
    forces = []
    for points, box in (([[0.1, 1.0], [9.9, 1.4]], [10.0, 10.0]), ([[0.1, 1.0], [-0.1, 1.4]], [0.0, 0.0])):
        net = free_net(2, box)
        state = js.State.from_points(net, points, [[1.0, 0.0], [-1.0, 2.0]])
        forces.append(components(fluid(net, js.fluid.PlainCutoff(2.5), drag=drag, pairs=js.fluid.NeighbourList(4, 0.3)).force(state)))
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-11)
    net = free_net(2, [10.0])
    result = js.rollout(fluid(net), js.State.from_points(net, [[1e-4], [10.0]]), js.VelocityVerlet(), 0.0, 1)
    assert bool(result.status.has(js.Flag.OVERLAP))


OFFSETS = [1e5, 5e6, 1e8]


def edge_set(net):
    """Springs without their direction."""
    return {tuple(sorted(pair)) for pair in net.edges.tolist()}


@pytest.mark.parametrize("offset", OFFSETS)
def test_delaunay_far_from_the_origin(offset, rng):
    """K11: points at map coordinates have the springs and triangles of the same points about the origin."""
    for points in (rng.random((300, 2)) * 20, rng.random((60, 3)) * 20):
        far = points + offset
        near = js.delaunay(far - offset)
        net = js.delaunay(far)
        assert edge_set(net) == edge_set(near)
        assert len(net.triangles) == len(near.triangles)


@pytest.mark.parametrize("offset", [0.0, *OFFSETS])
def test_delaunay_of_a_raster_far_from_the_origin(offset):
    """K11: a raster whose borders are straight only to rounding gets two triangles a cell, and no springs along its whole border."""
    grid = js.lattice((9, 8)).grid(0.1) + offset
    net = js.delaunay(grid)
    assert len(net.triangles) == 2 * 8 * 7
    assert net.n_nodes - net.n_springs + len(net.triangles) == 1
    assert net.lengths(grid).max() < 0.2
    block = js.lattice((3, 4, 3)).grid(0.1) + offset
    hull = block[js.delaunay(block).triangles] - offset
    area = np.linalg.norm(np.cross(hull[:, 1] - hull[:, 0], hull[:, 2] - hull[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(2 * (0.3 * 0.2 + 0.3 * 0.2 + 0.2 * 0.2), rel=1e-6)


@pytest.mark.parametrize("scale", [1e-150, 1e-9, 1e9, 1e150])
def test_delaunay_of_any_size(scale, rng):
    """The unit of length changes no spring, nor do points far longer than wide."""
    points = rng.random((100, 2))
    assert edge_set(js.delaunay(points * scale)) == edge_set(js.delaunay(points))
    thin = points * [1, 1e-9]
    assert len(edge_set(js.delaunay(thin * scale)) ^ edge_set(js.delaunay(thin))) == 0


def test_points_without_a_triangulation_are_named(rng):
    """Points twice at one place are named with both indices, also far away; points on one slanted line or plane are said to be."""
    points = rng.random((50, 2)) * 20
    for offset in (0.0, 5e6):
        with pytest.raises(ValueError, match=r"points\[50\] is at the place of points\[17\].*1 of 51"):
            js.delaunay(np.concatenate([points, points[[17]]]) + offset)
        line = np.linspace(0, 1, 30)[:, None] * [0.1, 0.3]
        with pytest.raises(ValueError, match="all 30 points lie on one line"):
            js.delaunay(line + offset)
        flat = rng.random((30, 2)) @ np.array([[0.1, 0.3, 0.7], [0.5, -0.2, 0.4]])
        with pytest.raises(ValueError, match="all 30 points lie on one plane"):
            js.delaunay(flat + offset)
    with pytest.raises(ValueError, match=r"too near to tell apart.*of 50 points"):
        js.delaunay((points + 5e6).astype(np.float32))


@pytest.mark.usefixtures("user_mode")
@pytest.mark.parametrize("offset", OFFSETS)
def test_lengths_and_masses_far_from_the_origin_in_32_bits(offset, rng):
    """K11: from float64 points JAX's 32 bits get lengths and masses as at the origin; a run of such a state says PRECISION."""
    points = rng.random((40, 2)) * 20
    net = js.delaunay(points)
    far = points + offset
    tail, head = net.edges.T
    np.testing.assert_allclose(net.lengths(far), np.linalg.norm(points[head] - points[tail], axis=1), rtol=1e-5, atol=1e-6)
    a, b, c = (points[net.triangles[:, i]] for i in range(3))
    u, v = b - a, c - a
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    mass = np.bincount(net.triangles.ravel(), np.repeat(area / 3, 3), 40)
    np.testing.assert_allclose(js.lumped_mass(net, far, 1.0, net.triangles), mass, rtol=1e-4, atol=1e-5)
    assert float(jnp.sum(js.lumped_mass(net, far, 2.0))) == pytest.approx(
        2 * np.linalg.norm(points[head] - points[tail], axis=1).sum(), rel=1e-5
    )
    system = js.System(net, 1.0, js.Springs(net, 1.0, net.lengths(far)))
    with pytest.warns(js.StabilityWarning, match="PRECISION"):
        js.rollout(system, js.State.from_points(net, far), js.VelocityVerlet(), 1e-3, 1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: js.Graph.from_edges([(0, 1)], 2, triangles=[(0, 1, 2)]), r"triangles\[0\] = \(0, 1, 2\) names node 2"),
        (lambda: js.lumped_mass(js.lattice((2, 2)), np.eye(4, 2), 1.0, [(0, 1, 3), (0, 1, 9)]), r"triangles\[1\] .* names node 9"),
        (lambda: js.lumped_mass(js.lattice((2, 2)), np.eye(3, 2), 1.0, [(0, 1, 3)]), r"points has shape \(3, 2\); expected \(4, D\)"),
        (lambda: js.System(joined([5.0]), 1.0, js.Springs(joined(None), 1.0)), r"box = None.*net has\s+\[5\.\]"),
        (lambda: js.Image(np.ones((4, 4), np.float32), 1.0, origin=(5e6 + 0.25, 0.0)), r"origin along x .* 0\.25 pixels off"),
        (lambda: js.delaunay(np.zeros((5, 1))), "A chain needs no triangulation"),
    ],
)
def test_geometry_that_does_not_belong_together_is_refused(make, message):
    """Triangles of nodes that do not exist, points of another net, two boxes, an image whose place is lost: named."""
    with pytest.raises(ValueError, match=message):
        make()
