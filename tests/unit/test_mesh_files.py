"""Mesh files: what each format says, polygons cut right, and every fault named."""

import warnings

import numpy as np
import pytest
import trimesh

from jaxspring.topology.mesh_files import from_mesh
from jaxspring.topology.polygons import triangulate

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
)
OFF = "OFF # a square\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


def read(folder, text, name="part.obj", merge=0.0):
    """(nodes, springs, triangles, area) of a file with this text. Merging by 0 says that loose pieces are meant."""
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    net, points = from_mesh(path, merge=merge)
    if net.triangles is None:
        return net.n_nodes, net.n_springs, 0, 0.0
    a, b, c = (points[net.triangles[:, i]] for i in range(3))
    return net.n_nodes, net.n_springs, len(net.triangles), float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def sheet(n, h):
    """An n x n sheet of spacing h, as an OBJ."""
    points = "".join(f"v {i * h:.17g} {j * h:.17g} 0\n" for j in range(n) for i in range(n))
    cells = [j * n + i + 1 for j in range(n - 1) for i in range(n - 1)]
    return points + "".join(f"f {a} {a + 1} {a + n}\nf {a + 1} {a + n + 1} {a + n}\n" for a in cells)


@pytest.mark.parametrize("h", [1.0, 1e-6, 1.2e-8, 5e-9, 1e-30, 1e30])
def test_the_unit_of_length_takes_no_node(h, tmp_path):
    """A sheet of any spacing keeps its nodes, springs and triangles."""
    assert read(tmp_path, sheet(8, h))[:3] == (64, 161, 98)
    assert read(tmp_path, sheet(8, h), merge=1e-6)[:3] == (64, 161, 98)


COMB = "v 0 0 1\nv 6 0 1\nv 6 3 1\nv 5 1 1\nv 4 3 1\nv 3 1 1\nv 2 3 1\nv 1 1 1\nv 0 3 1\n"
RING = "v 0 0 0\nv 3 0 0\nv 3 3 0\nv 0 3 0\nv 1 1 0\nv 1 2 0\nv 2 2 0\nv 2 1 0\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("v 0 0 0\nv 2 0 0\nv 2 2 0\nv 1 .5 0\nv 0 2 0\nf 1 2 3 4 5\n", (5, 7, 3, 2.5)),
        ("v 0 0 0\nv 2 -1 0\nv .5 0 0\nv 2 1 0\nf 2 3 4 1\n", (4, 5, 2, 0.5)),
        (COMB + "f 1 2 3 4 5 6 7 8 9\n", (9, 15, 7, 12.0)),
        (COMB + "f 3 2 1 9 8 7 6 5 4\n", (9, 15, 7, 12.0)),
        # A hole, by a cut that is walked there and back.
        (RING + "f 1 2 3 4 1 5 6 7 8 5\n", (8, 16, 8, 8.0)),
        # A corner in the middle of a side: no flat triangle.
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nf 1 2 3 4 5\n", (5, 7, 3, 4.0)),
        # A corner named twice in a row.
        (TRIANGLE + "f 1 1 2 3\nf 1 2 2\n", (3, 3, 1, 0.5)),
        # Relative numbers count back from where they stand.
        ("".join(f"v 0 0 {z}\nv 1 0 {z}\nv 0 1 {z}\nf -3 -2 -1\n" for z in (0, 5, 9)), (9, 9, 3, 1.5)),
        # A tab, comments, leading blanks, a broken line, normals and textures, unused vertices, lines.
        ("  v\t0 0 0 # c\nv 1 0 0\n\n v 0 1 0\nv 3 3 3\nv 9 9 9\nf 1/7 2//3 \\\n 3/1/2 # x\nl 3 4/1\n", (4, 4, 1, 0.5)),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nl 1 2 3\n", (3, 2, 0, 0.0)),
    ],
)
def test_what_an_obj_says(text, expected, tmp_path):
    """Nodes, springs, triangles and area of small files, counted by hand."""
    found = read(tmp_path, text)
    assert found[:3] == expected[:3]
    assert found[3] == pytest.approx(expected[3], rel=1e-12)


def test_polygons_of_any_place_and_size(rng):
    """Random star-shaped polygons, turned in space, tiny, huge and far away: n - 2 triangles each, of the polygon's area (the shoelace)."""
    for scale, offset in ((1.0, 0.0), (1e-9, 0.0), (1e9, 0.0), (1.0, 1e6)):
        sizes = rng.integers(3, 12, 30)
        flat = []
        for n in sizes:
            angle = 2 * np.pi * (np.arange(n) + 0.8 * rng.random(n)) / n
            flat.append(rng.uniform(0.2, 1, n)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        points = np.concatenate(flat) @ turned[:2] * scale + offset
        triangles = triangulate(points, sizes, np.arange(sizes.sum()))
        assert len(triangles) == np.sum(sizes - 2)
        a, b, c = (points[triangles[:, i]] for i in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        owner = np.repeat(np.arange(len(sizes)), sizes - 2)
        shoelace = [abs(np.sum(p[:, 0] * np.roll(p[:, 1], -1) - p[:, 1] * np.roll(p[:, 0], -1))) / 2 for p in flat]
        np.testing.assert_allclose(np.bincount(owner, areas) / scale**2, shoelace, rtol=1e-8 if offset else 1e-11)


def binary_ply(order, last=4):
    """Five vertices, a square and a triangle, and an edge, as a binary PLY."""
    name = {"<": "little", ">": "big"}[order]
    header = (
        f"ply\nformat binary_{name}_endian 1.0\nelement vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
        "property uchar red\nelement face 2\nproperty list uchar uint vertex_indices\nproperty uchar flags\n"
        "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    vertex = np.dtype([("p", order + "f8", 3), ("red", "u1")])
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 2, 0)]
    body = np.array([(corner, 7) for corner in corners], vertex).tobytes()
    for face in ([0, 1, 2, 3], [3, 2, last]):
        body += bytes([len(face)]) + np.array(face, order + "u4").tobytes() + b"\x01"
    return header.encode() + body + np.array([0, 4], order + "i4").tobytes()


def test_what_ply_and_off_say(tmp_path):
    """Squares and edges of text and of binary files in both orders of bytes, with colours beside them."""
    assert read(tmp_path, PLY + "4 0 1 2 3\n", "part.ply") == (4, 5, 2, 1.0)
    for order in "<>":
        assert read(tmp_path, binary_ply(order), "part.ply") == (5, 8, 3, 1.5)
    assert read(tmp_path, OFF + "4 0 1 2 3 255 0 0\n", "part.off") == (4, 5, 2, 1.0)
    coloured = "COFF 3 1 0\n0 0 0 1 0 0 1\n1 0 0 1 0 0 1\n0 1 0 1 0 0 1\n3 0 1 2\n"
    assert read(tmp_path, coloured, "part.off") == (3, 3, 1, 0.5)


def test_a_gltf_scene(tmp_path):
    """Both bodies of a scene come, each where the scene puts it."""
    ball, box = trimesh.creation.icosphere(subdivisions=1), trimesh.creation.box()
    trimesh.Scene([ball, box.apply_translation([5, 0, 0])]).export(tmp_path / "part.glb")
    with pytest.warns(UserWarning, match=r"part\.glb makes a net of 2 loose pieces\. No spring joins them"):
        net, points = from_mesh(tmp_path / "part.glb")
    assert net.n_nodes == len(ball.vertices) + 8
    np.testing.assert_allclose(points.max(axis=0), [5.5, 1, 1], atol=1e-6)


def rounded_stl(rng):
    """A sheet of 32 triangles of 0.1 m whose corners differ in the 7th digit, each triangle with its own."""
    cells = [5 * j + i for j in range(4) for i in range(4)]
    triangles = [(a, a + 1, a + 5) for a in cells] + [(a + 1, a + 6, a + 5) for a in cells]
    text = "solid sheet\n"
    for corners in triangles:
        text += "facet normal 0 0 1\nouter loop\n"
        for corner in corners:
            x, y = 0.1 * (corner % 5), 0.1 * (corner // 5)
            text += f"vertex {x + rng.uniform(-3e-8, 3e-8):.9f} {y + rng.uniform(-3e-8, 3e-8):.9f} 0\n"
        text += "endloop\nendfacet\n"
    return text + "endsolid sheet\n"


def test_corners_that_were_rounded(rng, tmp_path):
    """Triangles that a file's rounding tore apart are counted in a warning that tells the `merge` which joins them, and that one does."""
    text = rounded_stl(rng)
    for merge in (None, 0.0, 1e-9):
        with pytest.warns(UserWarning, match=r"32 loose pieces\..*hold 1 together: pass merge=1e-07"):
            assert read(tmp_path, text, "part.stl", merge)[:3] == (96, 96, 32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read(tmp_path, text, "part.stl", 1e-7)[:3] == (25, 56, 32)
    with pytest.raises(ValueError, match=r"merge = 0\.3.*two corners of face 0, whose side is 0\.1"):
        read(tmp_path, text, "part.stl", 0.3)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("part.obj", TRIANGLE + "f 0 2 4\n", r"part\.obj: face 0, line 4, 'f 0 2 4': names vertex 0, but OBJ counts vertices from 1"),
        ("part.obj", TRIANGLE + "f 1 2 3\nf 1 2 4\n", r"face 1 \(line 5\) names vertex 4, but the file holds 3 vertices, numbered 1 to 3"),
        ("part.obj", TRIANGLE + "f -4 -2 -1\n", r"face 0, line 4, .* names vertex -4, but only 3 stand above it"),
        ("part.obj", TRIANGLE + "f 1 2\n", r"face 0 \(line 4\) has 2 corners"),
        ("part.obj", TRIANGLE + "f 1 2 x\n", r"line 4, 'f 1 2 x'"),
        ("part.obj", TRIANGLE + "l 1 9\n", "line 0 names vertex 9"),
        ("part.obj", "v 0 0\n" + TRIANGLE + "f 1 2 3\n", "line 1, 'v 0 0': a vertex has three coordinates"),
        ("part.obj", "v 0 0 nan\n" + TRIANGLE + "f 2 3 4\n", r"vertex 1 = \(0\.0, 0\.0, nan\) must be finite"),
        ("part.obj", "v 0 0 0\nv 2 0 0\nv 0 2 0\nv 2 2 0\nf 1 2 3 4\n", "face 0 crosses itself"),
        ("part.obj", TRIANGLE, "neither a face nor a line"),
        ("part.obj", TRIANGLE + "f 1 1 2\n", "no face with three different corners"),
        ("part.ply", PLY + "4 0 1 2 -1\n", r"part\.ply: face 0 names vertex -1, but the file holds 4 vertices, numbered 0 to 3"),
        ("part.ply", PLY + "4 0 1 2 9\n", "face 0 names vertex 9"),
        ("part.ply", PLY.replace("1 1 0", "nan 1 0") + "4 0 1 2 3\n", r"vertex 2 = \(nan"),
        ("part.ply", PLY + "4 0 1 2\n", "ends before all that its header promises"),
        ("part.ply", PLY.replace("float x", "foo x"), "'property foo x' in its header"),
        ("part.ply", PLY.replace("float x", "float a") + "4 0 1 2 3\n", "no x, y and z"),
        ("part.ply", b"", "does not begin with ply"),
        ("part.ply", binary_ply("<")[:-9], "ends before all that its header promises"),
        ("part.ply", binary_ply(">", 2**32 - 1), "face 1 names vertex 4294967295"),
        ("part.off", OFF + "4 0 1 2 7\n", r"part\.off: face 0 \(line 7\) names vertex 7"),
        ("part.off", OFF, "ends after line 6"),
        ("part.off", OFF.replace("1 1 0", "1 x 0"), r"line 5, '1 x 0', cannot be read"),
        ("part.off", b"", "does not begin with OFF"),
        ("part.stl", b"\0" * 90, r"part\.stl"),
        ("part.xyzw", b"", "of no format that is read here"),
    ],
)
def test_faults_are_named(name, text, message, tmp_path):
    """A vertex that is not there, a number that is none, a file cut off: one ValueError with the file, the face or line, and the number."""
    with pytest.raises(ValueError, match=message):
        read(tmp_path, text, name)


def test_a_missing_package_is_named_first(tmp_path, monkeypatch):
    """A format whose package is not installed says so before it looks for the file; OBJ, OFF and PLY need none."""
    monkeypatch.setattr(trimesh, "available_formats", lambda: {"stl"})
    with pytest.raises(ImportError, match=r"trimesh reads \.3mf files with lxml, which is not installed"):
        from_mesh(tmp_path / "none.3mf")
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    with pytest.raises(ImportError, match=r"reads \.stl files with trimesh.*jaxspring\[mesh\]"):
        from_mesh(tmp_path / "none.stl")
    assert read(tmp_path, TRIANGLE + "f 1 2 3\n") == (3, 3, 1, 0.5)


@pytest.mark.parametrize("merge", [-1e-6, np.nan, 1.0, True])
def test_a_merge_that_is_no_share(merge, tmp_path):
    """A `merge` below zero, of 1 or more, or no number is refused."""
    with pytest.raises((ValueError, TypeError), match="merge"):
        read(tmp_path, TRIANGLE + "f 1 2 3\n", merge=merge)
