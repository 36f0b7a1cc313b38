"""Red-green subdivision: conforming meshes, the same surface and the same energy, and back to the node."""

import itertools

import jax
import numpy as np
import pytest

import jaxspring as js
from jaxspring.topology.padding import pad_nets

Subdivision = js.reconstruction.Subdivision
N = 60


@pytest.fixture
def family(rng):
    """A Delaunay mesh and three random refinements of it, with its points."""
    points = rng.random((N, 2))
    net = js.delaunay(points)
    meshes = [Subdivision.of(net.triangles, N, rng.uniform(1, 3, net.n_springs))]
    for share in (0.3, 0.2, 0.1):
        meshes.append(meshes[-1].refined(rng.random(len(meshes[-1].triangles)) < share))
    return points, net, meshes


def areas(points, triangles):
    """Signed, doubled."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]


def test_meshes_are_conforming(family):
    """The same area, no fold, every side of one or two triangles, one piece without a hole, and neighbours of like levels."""
    points, _, meshes = family
    whole = areas(points, meshes[0].triangles)
    for mesh in meshes:
        now = areas(mesh.carried(points, meshes[0]), mesh.triangles)
        assert np.abs(now).sum() == pytest.approx(np.abs(whole).sum())
        assert (np.sign(now) == np.sign(whole[0])).all()
        report = js.cloth.examine(mesh.net, np.column_stack([mesh.carried(points, meshes[0]), np.zeros(mesh.n_nodes)]))
        assert len(report.crowded) == len(report.unused) == len(report.doubled) == 0
        assert report.is_wound
        assert mesh.n_nodes - mesh.net.n_springs + len(mesh.triangles) == 1


def test_linear_fields_keep_their_energy(family, rng):
    """For all s, also of a mesh that was refined thrice."""
    points, net, meshes = family
    field = rng.standard_normal((2, 3))
    k = np.add(*meshes[0].stiffness()) / 2
    expected = 0.5 * k @ np.sum(((points @ field)[net.edges[:, 1]] - (points @ field)[net.edges[:, 0]]) ** 2, axis=1)
    for mesh, since in ((meshes[1], meshes[0]), (meshes[3], meshes[2]), (meshes[3], meshes[0])):
        z = mesh.carried(points @ field, meshes[0])
        slack, full = mesh.stiffness(since)
        for s in (0.0, 0.3, 1.0):
            edges = mesh.net.edges
            energy = 0.5 * ((1 - s) * slack + s * full) @ np.sum((z[edges[:, 1]] - z[edges[:, 0]]) ** 2, axis=1)
            assert energy == pytest.approx(expected, rel=1e-12)
        assert min(slack.min(), full.min()) >= 0


def rest(edges, k, held, values):
    """Zero-rest-length springs in balance, by dense algebra."""
    n = len(values)
    b = np.zeros((len(edges), n))
    b[np.arange(len(edges)), edges[:, 0]], b[np.arange(len(edges)), edges[:, 1]] = -1, 1
    a = b.T * k @ b
    x = np.where(held[:, None], values, 0.0)
    x[~held] = np.linalg.solve(a[np.ix_(~held, ~held)], -a[np.ix_(~held, held)] @ values[held])
    return x


def test_equilibrium_does_not_move_at_s_zero(family):
    """Old nodes stay to rounding, new ones rest at the midpoints; at s = 1 they move."""
    points, _, meshes = family
    held = np.arange(N) % 7 == 0
    for coarse, fine in ((meshes[0], meshes[1]), (meshes[1], meshes[2])):
        start, after = (mesh.carried(points, meshes[0]) for mesh in (coarse, fine))
        fixed = [(p[:, None] == points[held]).all(axis=2).any(axis=1) for p in (start, after)]
        before = fine.carried(rest(coarse.net.edges, coarse.stiffness()[1], fixed[0], start), coarse)
        slack, full = fine.stiffness(coarse)
        np.testing.assert_allclose(rest(fine.net.edges, slack, fixed[1], after), before, atol=1e-12)
        assert np.abs(rest(fine.net.edges, full, fixed[1], after) - before).max() > 1e-4


def test_cotangent_springs_stay_cotangent_springs(rng):
    """At s = 1 stands the finite element mesh of the finer triangles, for any first mesh."""
    points = rng.random((20, 2))
    net = js.delaunay(points)

    def cotangents(p, mesh_net):
        total = np.zeros(mesh_net.n_springs)
        where = {tuple(e): i for i, e in enumerate(np.sort(mesh_net.edges, axis=1).tolist())}
        for t in mesh_net.triangles.tolist():
            for i in range(3):
                a, b, c = t[i], t[i - 1], t[i - 2]
                u, v = p[b] - p[a], p[c] - p[a]
                total[where[tuple(sorted((b, c)))]] += 0.5 * (u @ v) / abs(u[0] * v[1] - u[1] * v[0])
        return total

    half = cotangents(points, net)
    base = Subdivision.of(net.triangles, 20, np.abs(half))
    # Half-weights of each triangle's own cotangents, which may be negative.
    own = np.zeros((len(net.triangles), 3))
    for row, t in enumerate(net.triangles.tolist()):
        for i, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
            c = 3 - a - b
            u, v = points[t[a]] - points[t[c]], points[t[b]] - points[t[c]]
            own[row, i] = 0.5 * (u @ v) / abs(u[0] * v[1] - u[1] * v[0])
    base = Subdivision(base.roots, 20, own)
    np.testing.assert_allclose(base.stiffness()[1], half, atol=1e-12)
    finer = base.refined(np.ones(len(base.triangles), bool))
    np.testing.assert_allclose(finer.stiffness()[1], cotangents(finer.carried(points, base), finer.net), atol=1e-9)


def test_coarsening_undoes_refining(family):
    """Level by level, with any marks, to the same mesh, springs and places."""
    points, _, meshes = family
    for coarse, fine in itertools.pairwise(meshes):
        again = fine.coarsened(fine.added(coarse))
        np.testing.assert_array_equal(again.triangles, coarse.triangles)
        np.testing.assert_array_equal(again.stiffness()[1], coarse.stiffness()[1])
        np.testing.assert_array_equal(again.carried(fine.carried(points, meshes[0]), fine), coarse.carried(points, meshes[0]))
    assert len(meshes[3].coarsened(np.zeros(len(meshes[3].triangles), bool)).triangles) == len(meshes[3].triangles)


def stepped(edges, k, x, free):
    """20 symplectic steps of 0.5 s in NumPy: mass 8, drag 1."""
    v = np.zeros_like(x)
    for _ in range(20):
        pull, force = k[:, None] * (x[edges[:, 1]] - x[edges[:, 0]]), -v
        np.add.at(force, edges[:, 0], pull)
        np.add.at(force, edges[:, 1], -pull)
        v = v + 0.5 * force / 8 * free[:, None]
        x = x + 0.5 * v
    return x


def test_levels_share_one_program():
    """Three levels in one capacity: compiled once, and each comes to rest where it does alone."""
    net = js.lattice((3, 3))
    corners = js.delaunay(net.grid() * [1.0, 1.01])
    mesh = Subdivision.of(corners.triangles, 9)
    levels = [mesh, mesh.refined(np.arange(8) < 3)]
    levels.append(levels[1].refined(levels[1].level == 1))
    traced = []

    def run(padded, points, k, free):
        traced.append(1)
        forces = (js.Springs(padded, k, 0.0), js.Drag(1.0))
        system = js.System(padded, 8.0, forces, free=free)
        return js.rollout(system, js.State.from_points(padded, points), js.SymplecticEuler(), dt=0.5, n_steps=20).state.points

    shared = jax.jit(jax.vmap(run))
    for level in levels:
        points = level.carried(np.asarray(net.grid()) ** 1.3, mesh)
        free = ~np.isin(points, (points.min(), points.max())).any(axis=1)
        batch = pad_nets([level.net], capacity=(60, 150, 12))
        held = batch.free & (batch.at_nodes([free.astype(float)]) > 0)
        k = level.stiffness(mesh)[1]
        found = batch.of_nodes(shared(batch.net, batch.points([points]), batch.at_springs([k]), held))[0]
        np.testing.assert_allclose(found, stepped(level.net.edges, k, points, free), atol=1e-12)
    assert len(traced) == 1
    with pytest.raises(ValueError, match=r"nets\[0\] has \d+ nodes, but the capacity has room for 10"):
        pad_nets([levels[-1].net], capacity=(10, 150, 12))
    with pytest.raises(ValueError, match="springs at a node"):
        pad_nets([levels[-1].net], capacity=(60, 150, 3))


def test_the_stable_step_falls_with_the_mesh():
    """The mass of a triangle is shared by its parts: half the step for each level, and `stable_dt` says so."""
    mesh, points = Subdivision.of([(0, 1, 2), (2, 1, 3)], 4), np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    limits = []
    for level in (mesh, mesh.refined([True, True]).refined(np.ones(8, bool))):
        places = level.carried(points, mesh)
        mass = js.lumped_mass(level.net, places, 1.0, triangles=level.triangles)
        system = js.System(level.net, mass, js.Springs(level.net, level.stiffness(mesh)[1], 0.0))
        limits.append(float(jax.jit(js.stable_dt)(system, js.State.from_points(level.net, places))))
    assert limits[1] == pytest.approx(limits[0] / 4, rel=0.35)


def test_wrong_marks_are_refused(family):
    """By name."""
    _, _, meshes = family
    with pytest.raises(ValueError, match="marked has shape"):
        meshes[0].refined([True])
    with pytest.raises(ValueError, match="values has shape"):
        meshes[1].carried(np.zeros(3), meshes[0])
    with pytest.raises(ValueError, match="another mesh"):
        meshes[1].carried(np.zeros(3), Subdivision.of([(0, 1, 2)], 3))
    with pytest.raises(ValueError, match="zero or more"):
        Subdivision.of([(0, 1, 2)], 3, -1.0)
