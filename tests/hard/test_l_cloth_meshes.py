"""Hard cases L7 and L11: bad meshes, and pressure in what is not closed or inside out."""

import dataclasses
import itertools

import equinox as eqx
import jax
import numpy as np
import pytest

import jaxspring as js

CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
# Outward, counter-clockwise seen from outside.
FACES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6)]
CLOSED = np.array([t for a, b, c, d in FACES for t in ((a, b, c), (a, c, d))])


@eqx.filter_jit
def force_of(part, state):
    """Per coordinate, in the user's order."""
    return [state.layout.flatten(a) for a in part.force(state)]


def cube(triangles=CLOSED):
    return js.from_triangles(triangles, 8)


def moebius(n=10):
    """A strip of n squares whose ends are joined after half a turn."""
    turn = 2 * np.pi * np.arange(n) / n
    points = [
        ((1 + s * np.cos(a / 2)) * np.cos(a), (1 + s * np.cos(a / 2)) * np.sin(a), s * np.sin(a / 2)) for a in turn for s in (-0.3, 0.3)
    ]
    rows = [(2 * i, 2 * i + 1) for i in range(n)] + [(1, 0)]
    triangles = [t for (a, b), (c, d) in itertools.pairwise(rows) for t in ((a, b, d), (a, d, c))]
    return js.from_triangles(triangles, 2 * n), np.array(points)


def acts(part, net, points):
    """Its force, which must be finite."""
    force = np.stack([np.asarray(a) for a in force_of(part, js.State.from_points(net, points, 0.1 * np.asarray(points)))], axis=-1)
    assert np.isfinite(force).all()
    return force


def test_l7_quads_polygons_unused_and_doubled_vertices(tmp_path):
    """A file of quads and a pentagon, with a vertex that nothing uses and one that stands twice: cut, dropped and merged."""
    path = tmp_path / "mesh.obj"
    extra = [(9, 9, 9), (1, 0, 0)]  # unused; vertex 1 again
    vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in [*CUBE.tolist(), *extra])
    quads = [[{1: 9}.get(i, i) if k == 3 else i for i in face] for k, face in enumerate(FACES)]
    path.write_text(vertices + "".join("f " + " ".join(str(i + 1) for i in face) + "\n" for face in quads), encoding="utf-8")
    net, points = js.from_mesh(path)
    report = js.cloth.examine(net, points)
    assert (net.n_nodes, report.n_triangles, report.is_closed, report.is_wound) == (8, 12, True, True)
    np.testing.assert_allclose(report.volumes, [1.0], rtol=1e-14)
    acts(js.cloth.Pressure(net, points, 10.0), net, points)
    # As they stand, without a file: told by name, and everything but pressure works.
    raw = js.from_triangles(np.where(CLOSED == 1, np.where(np.arange(12)[:, None] == 6, 9, 1), CLOSED), 10)
    places = np.concatenate([CUBE, extra])
    report = js.cloth.examine(raw, places)
    np.testing.assert_array_equal(report.unused, [8])
    np.testing.assert_array_equal(report.doubled, [[1, 9]])
    assert (report.n_holes, report.is_closed) == (1, False)
    acts(js.Springs(raw, 1.0, 1.0), raw, places)
    acts(js.cloth.Air(raw), raw, places)
    with pytest.raises(ValueError, match=r"not closed: the side between nodes .* has no other triangle \(4 such sides\)"):
        js.cloth.Pressure(raw, places, 10.0)


def test_l7_a_side_of_three_triangles():
    """A fin on a cube: springs and air work; hinges, pressure and a common winding are refused, with the side and its triangles."""
    net = js.from_triangles([*CLOSED, (0, 1, 8)], 9)
    points = np.concatenate([CUBE, [(0.5, -1, 0)]])
    np.testing.assert_array_equal(js.cloth.examine(net, points).crowded, [[0, 1]])
    acts(js.Springs(net, 1.0, 1.0), net, points)
    acts(js.cloth.Air(net), net, points)
    with pytest.raises(ValueError, match=r"nodes 1 and 0 .*3 triangles, numbers \[1, 4, 12\]"):
        js.cloth.Hinges(net, 1.0)
    for refused in (lambda: js.cloth.Pressure(net, points, 1.0), lambda: js.cloth.rewound(net, points)):
        with pytest.raises(ValueError, match=r"nodes 0 and 1 \(triangles 1, 4, 12\) has 3 triangles"):
            refused()


def test_l7_two_pieces():
    """Two cubes hold one constant pressure, each by itself; one gas for both is refused, one each is not."""
    net = js.from_triangles(np.concatenate([CLOSED, CLOSED + 8]), 16)
    points = np.concatenate([CUBE, CUBE + 5])
    report = js.cloth.examine(net, points)
    assert report.n_pieces == 2
    np.testing.assert_allclose(report.volumes, [1, 1], rtol=1e-12)
    whole = acts(js.cloth.Pressure(net, points, 10.0), net, points)
    alone = acts(js.cloth.Pressure(cube(), CUBE, 10.0), cube(), CUBE)
    np.testing.assert_allclose(whole, np.concatenate([alone, alone]), atol=1e-13)
    with pytest.raises(ValueError, match="2 closed pieces do not share one gas"):
        js.cloth.Pressure.of_gas(net, points, 10.0)
    both = [js.cloth.Pressure.of_gas(net, points, 10.0, triangles=CLOSED + i) for i in (0, 8)]
    np.testing.assert_allclose(sum(acts(one, net, points) for one in both), whole, atol=1e-10)


def test_l7_inconsistent_winding():
    """One triangle turned over: air does not mind; pressure names the side and what mends it; `rewound` mends it, outward."""
    turned = CLOSED.copy()
    turned[7] = turned[7, ::-1]
    net = cube(turned)
    assert not js.cloth.examine(net, CUBE).is_wound
    np.testing.assert_allclose(acts(js.cloth.Air(net), net, CUBE), acts(js.cloth.Air(cube()), cube(), CUBE), atol=1e-15)
    with pytest.raises(ValueError, match=r"triangles 4, 7\) is run along in one direction by both: .*js\.cloth\.rewound"):
        js.cloth.Pressure(net, CUBE, 10.0)
    for bad in (turned, turned[:, ::-1]):
        mended = js.cloth.rewound(cube(bad), CUBE)
        np.testing.assert_allclose(js.cloth.examine(mended, CUBE).volumes, [1.0], rtol=1e-14)
        np.testing.assert_allclose(
            acts(js.cloth.Pressure(mended, CUBE, 10.0), mended, CUBE), acts(js.cloth.Pressure(cube(), CUBE, 10.0), cube(), CUBE), atol=1e-13
        )


def test_l7_a_moebius_strip():
    """It has one side: springs, air and hinges work; no winding fits, and pressure has nothing to act in."""
    net, points = moebius()
    report = js.cloth.examine(net, points)
    assert (report.has_two_sides, report.n_holes, report.n_pieces) == (False, 1, 1)
    assert "one side" in str(report)
    for part in (js.Springs(net, 1.0, 0.3), js.cloth.Air(net, wind=(0.0, 0.0, 1.0)), js.cloth.Hinges(net, 1.0)):
        acts(part, net, points)
    with pytest.raises(ValueError, match="Moebius"):
        js.cloth.rewound(net, points)
    for cap in (False, True):
        with pytest.raises(ValueError, match="one of them is inside out"):
            js.cloth.Pressure(net, points, 1.0, cap_holes=cap)


def test_l11_a_hole():
    """Refused, with a side of it; capped, it holds what the closed one holds. Holes that meet at a node have no caps."""
    net = cube(CLOSED[2:])
    with pytest.raises(ValueError, match=r"not closed: .*\(4 such sides\).*cap_holes=True"):
        js.cloth.Pressure(net, CUBE, 10.0)
    pressure = js.cloth.Pressure(net, CUBE, 10.0, cap_holes=True)
    whole = js.cloth.Pressure(cube(), CUBE, 10.0)
    state = js.State.from_points(net, CUBE)
    np.testing.assert_allclose(pressure.enclosed(state), 1.0, rtol=1e-14)
    np.testing.assert_allclose(acts(pressure, net, CUBE).sum(axis=0), 0, atol=1e-14)
    # Across the hole the load is the same; the cap hands it to its corners alike.
    np.testing.assert_allclose(acts(pressure, net, CUBE)[:4, 2], -2.5 * np.ones(4), atol=1e-13)
    assert acts(whole, cube(), CUBE)[:4, 2].sum() == pytest.approx(-10)
    # Two triangles that touch at a corner alone are left out.
    with pytest.raises(ValueError, match="two holes meet at node"):
        js.cloth.Pressure(cube(np.delete(CLOSED, [0, 5], axis=0)), CUBE, 10.0, cap_holes=True)


@pytest.mark.parametrize("cap", [False, True])
def test_l11_inside_out(cap):
    """A surface wound inward is refused, and its volume is told with its sign; so is one piece of two."""
    triangles = CLOSED[2:] if cap else CLOSED
    with pytest.raises(ValueError, match=r"inside out: piece 0, of triangle 0, encloses -1 m\^3"):
        js.cloth.Pressure(cube(triangles[:, ::-1]), CUBE, 10.0, cap_holes=cap)
    both = js.from_triangles(np.concatenate([triangles, triangles[:, ::-1] + 8]), 16)
    with pytest.raises(ValueError, match=rf"inside out: piece 1, of triangle {len(triangles)}, encloses -1 m\^3"):
        js.cloth.Pressure(both, np.concatenate([CUBE, CUBE + 3]), 10.0, cap_holes=cap)


BAD = {
    "no triangles": (lambda: js.cloth.Air(js.Graph.from_edges([(0, 1)], 2)), "triangles is None, and the net has none"),
    "places of another number": (lambda: js.cloth.Pressure(cube(), CUBE[:4], 1.0), r"points has shape \(4, 3\)"),
    "a negative drag": (lambda: js.cloth.Air(cube(), drag=-1.0), "drag = -1.0, but must be zero or more"),
    "a coefficient too many": (lambda: js.cloth.Air(cube(), lift=[1.0, 2.0]), r"lift has shape \(2,\); expected \(\) .*\(12,\)"),
    "wind in the plane": (lambda: js.cloth.Air(cube(), wind=(1.0, 0.0)), r"wind has shape \(2,\); expected \(3,\)"),
    "wind of one number": (
        lambda: js.cloth.Air(cube(), wind=lambda x, t: x.x).force(js.State.from_points(cube(), CUBE)),
        "wind must give a Vector of three arrays",
    ),
    "a gas that pulls": (lambda: js.cloth.Pressure.of_gas(cube(), CUBE, -2.0, ambient=1.0), "A gas does not pull"),
    "a flat space": (
        lambda: js.cloth.Air(cube()).force(js.State.from_points(cube(), CUBE[:, :2])),
        "Air acts on triangles in space, but positions have 2",
    ),
    "another net": (
        lambda: js.System(js.lattice(8), 1.0, js.cloth.Pressure(cube(), CUBE, 1.0)),
        "forces.0. .Pressure. was built on another topology",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_l7_mistakes_are_refused_by_name(case):
    """Each is an error that says what was expected."""
    build, message = BAD[case]
    with pytest.raises((ValueError, TypeError), match=message):
        build()


def test_surfaces_are_read_back(tmp_path):
    """OBJ brings back nodes, triangles and lines to the bit; STL the shape; a run becomes a folder of files."""
    net, points = js.cloth.disc(0.15, 0.05)
    state = js.State.from_points(net, points + 1 / 3)
    for save, suffix in ((js.cloth.save_obj, ".obj"), (js.cloth.save_stl, ".stl")):
        save(tmp_path / f"disc{suffix}", state, net)
        again, places = js.from_mesh(tmp_path / f"disc{suffix}")
        if suffix == ".obj":
            np.testing.assert_array_equal(again.triangles, net.triangles)
            np.testing.assert_array_equal(places, state.points)
        assert (again.n_nodes, len(again.triangles), again.n_springs) == (net.n_nodes, len(net.triangles), net.n_springs)
        report = js.cloth.examine(again, places)
        assert (report.is_wound, report.n_holes) == (True, 1)
    with_line = js.Graph.from_edges([(0, 1), (1, 2), (2, 0), (0, 3)], 4, triangles=[(0, 1, 2)])
    js.cloth.save_obj(tmp_path / "line.obj", js.State.from_points(with_line, CUBE[:4]), with_line)
    assert js.from_mesh(tmp_path / "line.obj")[0].n_springs == 4
    frames = jax.tree.map(lambda *a: np.stack(a), state, dataclasses.replace(state, time=state.time + 1))
    js.cloth.save_stl(tmp_path / "run", frames, net)
    assert sorted(path.name for path in (tmp_path / "run").iterdir())[0] == "run_0000.stl"
    with pytest.raises(ValueError, match=r"end in \.obj"):
        js.cloth.save_obj(tmp_path / "disc.ply", state, net)
