"""Fabrics in measured units: conversions, constants of springs, bending and masses, what nets realise; meshes of sheets."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.cloth import moduli
from jaxspring.topology.hinge_list import hinges_of
from jaxspring.topology.mesh_checks import cut

STRETCH, SHEAR, BEND = (400.0, 250.0), 60.0, (4e-5, 2e-5)
GF = 9.80665e-3  # [N]
HEXAGON = np.array([(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3])


def cotton():
    return js.cloth.Fabric(0.15, STRETCH, SHEAR, BEND, coupling=30.0)


@functools.cache
def hexagon(spacing=0.25):
    """Equilateral triangles alone: a hexagon of sides along the rows."""
    return js.cloth.outline(HEXAGON, spacing)


@functools.cache
def grid(shape=(9, 13), spacing=0.05):
    net = js.lattice(shape, js.STRUCTURAL + js.SHEAR)
    return net, net.grid(spacing)


@functools.cache
def of_cotton(make):
    """The cotton on a mesh, and the mesh."""
    net, points = make()
    return js.cloth.fabric(net, points, cotton()), net, points


def disc():
    return js.cloth.disc(0.15, 0.04)


def test_units_of_kes_and_fast():
    """By hand: gf cm^2/cm = 98.0665 uN m, gf/(cm degree) = 56.19 N/m, 500 gf/cm at EMT, 9.81e-6 W c^3 uN m, 123 / EB5."""
    f = js.cloth.KES(weight=20.0, extension=(5.0, 8.0), shear=0.5, bending=(0.2, 0.1)).fabric()
    np.testing.assert_allclose(f.density, 0.2, rtol=1e-15)
    np.testing.assert_allclose(f.stretch, [500 * GF / 0.01 / 0.05, 500 * GF / 0.01 / 0.08], rtol=1e-15)
    np.testing.assert_allclose(f.shear, 0.5 * 56.18796, rtol=1e-6)
    np.testing.assert_allclose(f.bending, [0.2 * 98.0665e-6, 0.1 * 98.0665e-6], rtol=1e-14)
    f = js.cloth.FAST(weight=150.0, extension=(2.0, 4.0), bias=3.0, bending_length=(20.0, 15.0)).fabric()
    np.testing.assert_allclose(f.density, 0.15, rtol=1e-15)
    np.testing.assert_allclose(f.stretch, [98.0665 / 0.02, 98.0665 / 0.04], rtol=1e-15)
    np.testing.assert_allclose(f.shear, 41.0, rtol=1e-15)
    np.testing.assert_allclose(f.bending, [9.81e-12 * 150 * 8000, 9.81e-12 * 150 * 3375], rtol=1e-14)
    # The bending length of the standard: B = w c^3 with w the weight per area.
    np.testing.assert_allclose(f.bending[0], 0.15 * 9.81 * 0.02**3, rtol=1e-14)


@pytest.mark.parametrize("system", [js.cloth.KES, js.cloth.FAST])
def test_units_there_and_back(system):
    """A fabric in other units and back is the same to rounding; derivatives go through."""
    f = cotton()
    again = system.of(f).fabric()
    for name in ("density", "stretch", "shear", "bending"):
        np.testing.assert_allclose(getattr(again, name), getattr(f, name), rtol=4e-15)
    slope = jax.grad(lambda b: system.of(js.cloth.Fabric(0.15, STRETCH, SHEAR, b)).fabric().bending[0])(4e-5)
    np.testing.assert_allclose(slope, 1.0, rtol=1e-13)


@eqx.filter_jit
def energy_of(part, net, points):
    return part.energy(js.State.from_points(net, points))


def strain_energy(springs, points, strain):
    """Energy of the springs under (e11, e22, g), to second order: the mean of both signs."""
    net, total = springs.net, 0.0
    tail, head = net.edges.T
    k, l = np.asarray(net.flatten(springs.stiffness)), np.asarray(net.flatten(springs.rest_length))
    e11, e22, g = strain
    for sign in (1e-5, -1e-5):
        deformed = points @ (np.eye(2) + sign * np.array([[e11, g / 2], [g / 2, e22]]))
        total += np.sum(0.5 * k * (np.linalg.norm(deformed[head] - deformed[tail], axis=1) - l) ** 2) / 2e-10
    return total


@pytest.mark.parametrize("make", [hexagon, grid, disc])
def test_realised_membrane_is_the_energy_of_homogeneous_strains(make):
    """e' C e / 2 times the area is the springs' energy, summed in NumPy, for every strain."""
    cloth, net, points = of_cotton(make)
    flat = np.asarray(points)[:, :2]
    area = float(np.sum(cloth.mass)) / 0.15
    for strain in np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0.5, -1, 0.7)]):
        found = 0.5 * strain @ np.asarray(cloth.realised.membrane) @ strain * area
        np.testing.assert_allclose(found, strain_energy(cloth.springs, flat, strain), rtol=2e-6)
    np.testing.assert_allclose(cloth.realised.density, 0.15, rtol=1e-13)
    along = flat[net.edges[:, 1]] - flat[net.edges[:, 0]]
    np.testing.assert_allclose(cloth.springs.rest_length, np.linalg.norm(along, axis=1), rtol=1e-14)
    # Warp and weft are as asked on every mesh, its border included.
    np.testing.assert_allclose(np.diag(cloth.realised.membrane)[:2], STRETCH, rtol=1e-9)
    np.testing.assert_allclose(np.diag(cloth.realised.bending)[:2], BEND, rtol=1e-9)


def test_masses_and_hinges_are_those_of_the_plate():
    """Masses are those of `lumped_mass`; hinges, of an isotropic fabric, those of `from_bending`."""
    cloth, net, points = of_cotton(disc)
    np.testing.assert_allclose(cloth.mass, jax.jit(lambda: js.lumped_mass(net, points, 0.15, net.triangles))(), rtol=1e-13)
    net, points = hexagon()
    cloth = js.cloth.fabric(net, points, js.cloth.Fabric(0.15, 300.0, 60.0, 3e-5))
    expected = jax.jit(lambda: js.cloth.Hinges.from_bending(net, points, 3e-5).stiffness)()
    np.testing.assert_allclose(cloth.bending.stiffness, expected, rtol=1e-12)


def test_a_grid_realises_stretch_shear_and_bending():
    """C11, C22, C33, B as asked, C12 = C33 since springs have no other; twist has no stiffness: said as numbers."""
    cloth = of_cotton(grid)[0]
    np.testing.assert_allclose(cloth.realised.membrane, [[400, 60, 0], [60, 250, 0], [0, 0, 60]], atol=1e-10)
    np.testing.assert_allclose(cloth.realised.bending, np.diag([4e-5, 2e-5, 0.0]), atol=1e-18)
    asked, found = cloth.compared()["C12"]
    assert (float(asked), round(float(found), 9)) == (30.0, 60.0)
    assert "C12              30         60" in str(cloth)
    # Half of everything at the border: of springs and joints as of the mass.
    inner = np.zeros((9, 13), bool)
    inner[1:-1, 1:-1] = True
    mass = np.asarray(cloth.mass).reshape(9, 13)
    np.testing.assert_allclose(mass[inner], 0.15 * 0.05**2, rtol=1e-12)
    np.testing.assert_allclose(mass[[0, 0, -1], [0, -1, 0]], 0.15 * 0.05**2 / 4, rtol=1e-12)
    np.testing.assert_allclose(mass[0, 1:-1], 0.15 * 0.05**2 / 2, rtol=1e-12)


def test_joints_of_a_grid_bend_as_the_fabric():
    """The joints' energy on a cylinder along x and along y, of small curvature c, is B c^2 / 2 for the area between joints."""
    cloth, net, points = of_cotton(grid)
    for axis, (b, inner) in enumerate(zip(BEND, ((13 - 2) * (9 - 1), (9 - 2) * (13 - 1)), strict=True)):
        turn = 1e-3 * points[:, axis]
        bent = np.stack([points[:, 0], points[:, 1], (1 - np.cos(turn)) / 1e-3], axis=-1)
        bent[:, axis] = np.sin(turn) / 1e-3
        energy = float(energy_of(cloth.bending, net, bent))
        np.testing.assert_allclose(energy, 0.5 * b * 1e-6 * inner * 0.05**2, rtol=1e-7)


def test_equilateral_triangles_realise_warp_and_weft():
    """C11, C22 and both B as asked to rounding; C12 = C33 = C22 / 3, whatever was asked."""
    cloth = of_cotton(hexagon)[0]
    np.testing.assert_allclose(cloth.realised.membrane, [[400, 250 / 3, 0], [250 / 3, 250, 0], [0, 0, 250 / 3]], atol=1e-9)
    np.testing.assert_allclose([cloth.realised.bending[0, 0], cloth.realised.bending[1, 1]], BEND, rtol=1e-12)


def test_an_isotropic_fabric_is_isotropic_on_equilateral_triangles():
    """k = sqrt(3)/2 E, nu = 1/3, no anisotropy; the plate has Poisson's ratio -1/3: cylinder 1, sphere 4/3, twist 8/3 of B/2."""
    net, points = hexagon()
    cloth = js.cloth.fabric(net, points, js.cloth.Fabric(0.15, 300.0, 60.0, 3e-5))
    counts = np.bincount(np.concatenate([net.edges[:, 0], net.edges[:, 1]]))
    inside = (counts[net.edges] == 6).all(axis=1)
    np.testing.assert_allclose(np.asarray(cloth.springs.stiffness)[inside], np.sqrt(3) / 2 * 300 * (1 - 1 / 9), rtol=1e-12)
    c, d = cloth.realised.membrane, cloth.realised.bending / 3e-5
    np.testing.assert_allclose(c, np.array([[300, 100, 0], [100, 300, 0], [0, 0, 100]]), atol=1e-9)
    assert float(cloth.realised.stretch_anisotropy()) == pytest.approx(1, abs=1e-12)
    assert float(cloth.realised.bending_anisotropy()) == pytest.approx(1, abs=1e-12)
    for curvature, expected in (((1, 0, 0), 1), ((0, 1, 0), 1), ((1, 1, 0), 4 / 3), ((0, 0, 2), 8 / 3)):
        v = np.array(curvature, float)
        np.testing.assert_allclose(v @ np.asarray(d) @ v, expected, rtol=1e-12)


def test_a_fabric_does_not_depend_on_where_its_pattern_lies():
    """Areas and angles a thousand kilometres away, in double precision: to the rounding of the places themselves."""
    net, points = js.cloth.rectangle(0.3, 0.3 * np.sqrt(3) / 2, 0.03)
    here, away = (js.cloth.fabric(net, points + np.array([off, off, 0.0]), ISOTROPIC_KNIT) for off in (0.0, 1e6))
    np.testing.assert_allclose(away.bending.stiffness, here.bending.stiffness, rtol=1e-6)
    np.testing.assert_allclose(away.springs.stiffness, here.springs.stiffness, rtol=1e-6)


@pytest.mark.parametrize(("warp", "weft"), [(1.0, 8.5), (40.0, 1.0)])
def test_triangles_bend_as_asked_along_warp_and_weft(warp, weft):
    """With rows along warp as far as the table says; with rows across warp the same turned."""
    net, points = js.cloth.rectangle(0.3, 0.3 * np.sqrt(3) / 2, 0.03)
    for places, asked in ((points, (warp, weft)), (points[:, [1, 0, 2]], (weft, warp))):
        cloth = js.cloth.fabric(net, places, js.cloth.Fabric(0.2, 100.0, 33.0, 1e-5 * np.array(asked)))
        np.testing.assert_allclose(np.diag(cloth.realised.bending)[:2], 1e-5 * np.array(asked), rtol=1e-9)


ISOTROPIC_KNIT = js.cloth.Fabric(0.2, 100.0, 33.0, 5e-5)


def test_hinges_of_a_square_grid_are_not_isotropic():
    """With one diagonal: 1 along the axes, 3 along the diagonal, 1 across, least .75 at 15 degrees; twist 6, turned by 45 degrees 2."""
    net = js.lattice((12, 12))
    points, triangles = net.grid(0.1), np.concatenate(cut(net))
    stiffness = jax.jit(lambda: js.cloth.Hinges.from_bending(net, points, 1.0, triangles).stiffness)()
    realised = moduli.matrix(stiffness, moduli.turns(points, hinges_of(triangles), triangles))
    d = moduli.Moduli(jnp.eye(3), realised, jnp.ones(()))
    angles = np.radians([0, 90, 45, -45])
    found = np.asarray(d.bending_along(angles))
    assert sorted(found.round(9)) == [1.0, 1.0, 1.0, 3.0]
    every = np.asarray(d.bending_along(np.radians(np.arange(180.0))))
    assert every.min() == pytest.approx(0.75, abs=1e-9)
    assert np.argmin(every) in (15, 75, 105, 165)
    assert 4 * float(d.bending[2, 2]) == pytest.approx(6, abs=1e-9)
    assert float(jnp.array([1.0, -1.0, 0.0]) @ d.bending @ jnp.array([1.0, -1.0, 0.0])) == pytest.approx(2, abs=1e-9)


def test_turns_are_the_angles_of_hinges():
    """What `moduli` takes for a hinge's turn is its angle on a gently bent sheet."""
    net, points = disc()
    hinges = js.cloth.Hinges(net, 1.0)
    x, y = points[:, 0], points[:, 1]
    bent = points + 1e-4 * np.stack([0 * x, 0 * x, x * x / 2 - x * y + 0.3 * y * y], axis=-1)
    angles = np.asarray(jax.jit(lambda: hinges.angles(js.State.from_points(net, bent)))()) / 1e-4
    turns = sum(moduli._slope(points[:, :2], hinges.nodes[:, [0, 1, k]], (x * x / 2 - x * y + 0.3 * y * y)[:, None])[:, 0] for k in (2, 3))
    np.testing.assert_allclose(np.abs(angles), np.abs(turns), atol=1e-7)


def test_published_fabrics():
    """Within the ranges that are published; what springs cannot give is capped and told."""
    ranges = {"INTERLOCK": (0.187, 23e-6, 39.1e-6), "DENIM": (0.324, 19e-6, 65e-6), "SWIM_KNIT": (0.204, 34e-6, 70e-6)}
    for name, (density, low, high) in ranges.items():
        published = getattr(js.cloth, name)
        f = published.fabric()
        assert float(f.density) == density
        assert all(low <= b <= high for b in published.bending)
        assert float(f.shear) == published.c33 / 2
        # Springs that pull only: none is negative, whatever the fabric.
        for net, points in (grid(), hexagon()):
            cloth = js.cloth.fabric(net, points, published)
            assert float(jnp.min(cloth.springs.stiffness)) > 0
            np.testing.assert_allclose(np.diag(cloth.realised.membrane)[:2], f.stretch, rtol=1e-9)
    asked, found = js.cloth.fabric(*grid(), js.cloth.INTERLOCK).compared()["C33"]
    assert float(asked) == pytest.approx(18.43, abs=0.01)
    assert float(found) == pytest.approx(0.9 * 16.593832, rel=1e-9)


def test_constants_are_differentiable_and_do_not_recompile():
    """d(realised)/d(asked) is the identity where springs can follow; other constants are the same program."""
    net, points = hexagon()
    traced = []

    @jax.jit
    def realised(stretch, bend):
        traced.append(1)
        cloth = js.cloth.fabric(net, points, js.cloth.Fabric(0.15, stretch, SHEAR, bend))
        c, d = cloth.realised.membrane, cloth.realised.bending
        return jnp.stack([c[0, 0], c[1, 1], d[0, 0], d[1, 1]])

    for scale in (1.0, 1.1):
        stretch, bend = scale * np.array(STRETCH), scale * np.array(BEND)
        np.testing.assert_allclose(realised(stretch, bend), np.concatenate([stretch, bend]), rtol=1e-9)
    assert len(traced) == 1
    by_stretch, by_bend = jax.jacfwd(realised, (0, 1))(np.array(STRETCH), np.array(BEND))
    np.testing.assert_allclose(np.concatenate([by_stretch, by_bend], axis=1), np.eye(4), atol=1e-9)


def test_provot_has_its_springs():
    """Each family has its own constant; at rest no spring pulls; a flexion spring stores k h^2 phi^4 / 32."""
    net, points, springs = js.cloth.provot((3, 4), 0.1, stretch=(100.0, 60.0), shear=20.0, flexion=(2.0, 1.0))
    d = points[net.edges[:, 1]] - points[net.edges[:, 0]]
    expected = {(1, 0): 100.0, (0, 1): 60.0, (1, 1): 20.0, (-1, 1): 20.0, (2, 0): 2.0, (0, 2): 1.0}
    steps = [tuple(step) for step in np.rint(d[:, :2] / 0.1).astype(int).tolist()]
    np.testing.assert_array_equal(net.flatten(springs.stiffness), [expected[step] for step in steps])
    np.testing.assert_allclose(net.flatten(springs.rest_length), np.linalg.norm(d, axis=1), rtol=1e-15)
    only = js.cloth.provot((1, 3), 0.1, stretch=100.0, shear=0.0, flexion=2.0)
    for phi in (0.1, 0.2):
        bent = [(-0.1 * np.cos(phi / 2), 0, 0.1 * np.sin(phi / 2)), (0, 0, 0), (0.1 * np.cos(phi / 2), 0, 0.1 * np.sin(phi / 2))]
        energy = float(energy_of(only[2], only[0], np.array(bent)))
        assert energy == pytest.approx(2.0 * 0.1**2 * phi**4 / 32, rel=phi**2 / 24)


def least_angle(net, points):
    return js.cloth.examine(net, points).least_angle


@pytest.mark.parametrize(("width", "height", "spacing"), [(1.0, 1.0, 0.1), (0.3, 0.05, 0.0125), (0.15, 0.4, 0.02), (1.0, 0.9, 1.0)])
def test_rectangles_are_filled(width, height, spacing):
    """Sides met exactly, all triangles counter-clockwise, no angle below that of half an equilateral triangle by much."""
    net, points = js.cloth.rectangle(width, height, spacing)
    np.testing.assert_array_equal(points.min(axis=0), 0)
    np.testing.assert_allclose(points.max(axis=0)[:2], [width, height], rtol=1e-15)
    u, v = (points[net.triangles[:, k]] - points[net.triangles[:, 0]] for k in (1, 2))
    areas = 0.5 * np.cross(u, v)[:, 2]
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(width * height, rel=1e-13)
    assert least_angle(net, points) > 26
    report = js.cloth.examine(net, points)
    assert (report.n_pieces, report.n_holes, report.is_wound, len(report.unused), len(report.doubled)) == (1, 1, True, 0, 0)


@pytest.mark.parametrize("turned", [False, True])
def test_outlines_are_filled(turned):
    """An L, either way round: its area, its corners, angles of 30 degrees and more, equilateral triangles inside."""
    corners = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    net, points = js.cloth.outline(corners[::-1] if turned else corners, 0.1)
    u, v = (points[net.triangles[:, k]] - points[net.triangles[:, 0]] for k in (1, 2))
    areas = 0.5 * np.cross(u, v)[:, 2]
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(3, rel=1e-13)
    assert least_angle(net, points) > 30
    lengths = np.linalg.norm(points[net.edges[:, 1]] - points[net.edges[:, 0]], axis=1)
    assert np.isclose(lengths, 0.1, rtol=1e-9).mean() > 0.5
    assert all((np.linalg.norm(points[:, :2] - corner, axis=1) < 1e-12).any() for corner in corners)


def test_a_disc_is_round():
    """Nodes of the border on the circle, its area below that of the circle by the polygon's share, angles of 30 degrees and more."""
    net, points = js.cloth.disc(0.15, 0.01)
    radius = np.linalg.norm(points, axis=1)
    n = int((radius > 0.15 - 1e-12).sum())
    assert n == round(2 * np.pi * 15)
    assert radius.max() == pytest.approx(0.15, rel=1e-15)
    u, v = (points[net.triangles[:, k]] - points[net.triangles[:, 0]] for k in (1, 2))
    assert np.cross(u, v)[:, 2].sum() / 2 == pytest.approx(0.5 * n * 0.15**2 * np.sin(2 * np.pi / n), rel=1e-12)
    assert least_angle(net, points) > 30


BAD = {
    "a spacing wider than the sheet": (lambda: js.cloth.rectangle(1.0, 1.0, 2.0), "wider than the rectangle"),
    "no size": (lambda: js.cloth.disc(0.0, 0.1), "radius = 0.0, but must be positive"),
    "two corners": (lambda: js.cloth.outline([(0, 0), (1, 0)], 0.1), r"shape \(2, 2\); expected \(P, 2\)"),
    "a bow tie": (lambda: js.cloth.outline([(0, 0), (1, 1), (1, 0), (0, 1)], 0.1), "corners 0 and 2 cross"),
    "a corner twice": (lambda: js.cloth.outline([(0, 0), (1, 0), (1, 0), (0, 1)], 0.1), r"polygon\[1\] and polygon\[2\] are at one place"),
    "too narrow": (lambda: js.cloth.outline([(0, 0), (3, 0), (3, 0.4), (2, 0.01), (1, 0.01), (0, 0.4)], 0.5), "too narrow"),
    "three axes": (lambda: js.cloth.provot((2, 2, 2), 0.1, 1.0, 1.0), r"expected \(ny, nx\)"),
    "three stretches": (lambda: js.cloth.provot((3, 3), 0.1, (1.0, 2.0, 3.0), 1.0), r"expected \(\) \(one number\), or \(2,\)"),
    "a negative shear": (lambda: js.cloth.provot((3, 3), 0.1, 1.0, -1.0), "must be zero or more"),
    "no density": (lambda: js.cloth.Fabric(0.0, 1.0, 1.0, 1.0), "density = 0.0, but must be positive"),
    "a fabric that stretches itself": (lambda: js.cloth.Fabric(0.1, 1.0, 1.0, 1.0, coupling=2.0), "Some stretch would set energy free"),
    "a shape in space": (
        lambda: js.cloth.fabric(js.from_triangles([(0, 1, 2)], 3), [(0, 0, 0), (1, 0, 0), (0, 1, 1)], cotton()),
        r"points\[2\] has z = 1 .*cut flat",
    ),
    "a stretched grid": (lambda: js.cloth.fabric(grid()[0], grid()[0].grid((0.1, 0.2)), cotton()), "no square grid"),
    "a grid with flexion": (lambda: js.cloth.fabric(*js.cloth.provot((4, 4), 0.1, 1.0, 1.0, 1.0)[:2], cotton()), "fabric adds joints"),
    "a spring along no triangle": (
        lambda: js.cloth.fabric(
            js.Graph.from_edges([(0, 1), (1, 2), (2, 0), (0, 3)], 4, triangles=[(0, 1, 2)]), [(0, 0), (1, 0), (0, 1), (2, 2)], cotton()
        ),
        r"spring 3, between nodes \(0, 3\), runs along no triangle",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_by_name(case):
    """Each mistake is an error that says what was expected."""
    build, message = BAD[case]
    with pytest.raises((ValueError, TypeError), match=message):
        build()
