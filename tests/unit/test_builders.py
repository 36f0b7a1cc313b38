"""Builders of graphs against the packages they read from, and their errors."""

import networkx
import numpy as np
import pytest
import scipy.sparse
import scipy.spatial
import trimesh

from jaxspring.topology.builders import delaunay, from_networkx, from_scipy, from_triangles
from jaxspring.topology.mesh_files import from_mesh


def pairs(edges):
    return {tuple(sorted(pair)) for pair in np.asarray(edges).tolist()}


def test_sides_of_triangles_come_once():
    """Two triangles that share a side make five springs, and the triangles are kept."""
    net = from_triangles([(0, 1, 2), (3, 2, 1)], n_nodes=5)
    assert pairs(net.edges) == {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)}
    assert net.n_springs == 5
    assert net.n_nodes == 5
    assert net.triangles.tolist() == [[0, 1, 2], [3, 2, 1]]


@pytest.mark.parametrize("dim", [2, 3])
def test_delaunay_has_the_edges_of_scipy(dim, rng):
    """The springs are the neighbour pairs of SciPy's Delaunay triangulation, each once."""
    points = rng.uniform(size=(60, dim))
    net = delaunay(points)
    starts, neighbours = scipy.spatial.Delaunay(points).vertex_neighbor_vertices
    expected = {tuple(sorted((i, int(j)))) for i in range(60) for j in neighbours[starts[i] : starts[i + 1]]}
    assert pairs(net.edges) == expected
    assert len(net.edges) == len(expected)


def test_euler_characteristic_of_a_delaunay_sheet(rng):
    """A triangulated disc has nodes - springs + triangles = 1."""
    net = delaunay(rng.uniform(size=(200, 2)))
    assert net.n_nodes - net.n_springs + len(net.triangles) == 1


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off"])
def test_mesh_files(suffix, tmp_path):
    """A sphere written in each format comes back closed: N - E + T = 2, with the right area."""
    sphere = trimesh.creation.icosphere(subdivisions=2)
    path = tmp_path / f"part{suffix}"
    sphere.export(path)
    net, points = from_mesh(path)
    assert net.n_nodes - net.n_springs + len(net.triangles) == 2
    assert points.shape == (net.n_nodes, 3)
    a, b, c = (points[net.triangles[:, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area == pytest.approx(sphere.area, rel=1e-5)  # STL and PLY hold float32


def test_seams_of_an_obj_are_closed(tmp_path):
    """Vertices at one place with different texture coordinates become one node."""
    path = tmp_path / "seam.obj"
    path.write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
        "vt 0 0\nvt 1 0\nvt 0 1\nvt .2 0\nvt 0 .2\nvt .9 .9\nf 1/1 2/2 3/3\nf 4/4 6/6 5/5\n"
    )
    net, _ = from_mesh(path)
    assert (net.n_nodes, net.n_springs) == (4, 5)


@pytest.mark.parametrize("text", [b"", b"not a mesh", b"v 0 0 0\nv 1 0 0\n"])
def test_bad_mesh_files_are_value_errors(text, tmp_path):
    """A file without triangles is a ValueError that names the file."""
    path = tmp_path / "bad.obj"
    path.write_bytes(text)
    with pytest.raises(ValueError, match=r"bad\.obj"):
        from_mesh(path)


def test_missing_mesh_file(tmp_path):
    """A file that is not there is a FileNotFoundError."""
    with pytest.raises(FileNotFoundError, match=r"none\.obj"):
        from_mesh(tmp_path / "none.obj")


def test_scipy_matrix(rng):
    """Springs and weights are the upper entries of the matrix, for every sparse format and a dense array."""
    dense = np.triu(rng.uniform(1, 2, (9, 9)) * (rng.uniform(size=(9, 9)) < 0.4), 1)
    dense = dense + dense.T
    for matrix in (dense, scipy.sparse.csr_array(dense), scipy.sparse.coo_matrix(dense), scipy.sparse.csc_matrix(dense)):
        net, weights = from_scipy(matrix)
        assert net.n_springs == np.count_nonzero(dense) // 2
        for (i, j), weight in zip(net.edges, weights, strict=True):
            assert dense[i, j] == weight


def test_networkx_graph():
    """Labels, attributes and edges keep NetworkX's order; parallel edges are separate springs."""
    graph = networkx.MultiGraph()
    graph.add_nodes_from("abcd")
    graph.add_edge("c", "a", stiffness=2, rest_length=0.5)
    graph.add_edge("a", "c", stiffness=3, rest_length=0.25)
    graph.add_edge("b", "a", stiffness=4, rest_length=1)
    net, labels, (k, l) = from_networkx(graph, ("stiffness", "rest_length"))
    assert labels == ["a", "b", "c", "d"]
    named = [(labels[i], labels[j], stiffness, length) for (i, j), stiffness, length in zip(net.edges, k, l, strict=True)]
    assert sorted((min(e[:2]), max(e[:2]), *e[2:]) for e in named) == [("a", "b", 4.0, 1.0), ("a", "c", 2.0, 0.5), ("a", "c", 3.0, 0.25)]


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: from_triangles(np.zeros((0, 3), int), 3), ValueError, r"shape \(0, 3\)"),
        (lambda: from_triangles([(0, 1)], 3), ValueError, r"shape \(1, 2\)"),
        (lambda: from_triangles([(0.0, 1.0, 2.0)], 3), TypeError, "float64"),
        (lambda: from_triangles([(0, 1, 3)], 3), ValueError, r"triangles\[0\] = \(0, 1, 3\) names node 3"),
        (lambda: from_triangles([(0, 1, 2), (0, -1, 2)], 3), ValueError, r"triangles\[1\].*names node -1"),
        (lambda: from_triangles([(0, 1, 1)], 3), ValueError, "corner twice"),
        (lambda: delaunay(np.zeros((5, 1))), ValueError, r"\(N, 2\) or \(N, 3\)"),
        (lambda: delaunay([(0, 0), (1, 1)]), ValueError, "at least 3"),
        (lambda: delaunay([(0, 0), (1, 1), (2, 2)]), ValueError, "one line"),
        (lambda: delaunay([(0, 0), (1, 0), (0, np.nan)]), ValueError, r"points\[2, 1\] = nan"),
        (lambda: delaunay([(0, 0), (1, 0), (0, 1), (1, 0)]), ValueError, r"at the place of points\["),
        (lambda: from_scipy(np.zeros((2, 3))), ValueError, r"shape \(2, 3\)"),
        (lambda: from_scipy(np.array([[0, 1.0], [2.0, 0]])), ValueError, r"matrix\[0, 1\] = 1\.0, but"),
        (lambda: from_scipy(np.array([[1.0, 0], [0, 0]])), ValueError, "joins node 0 to itself"),
        (lambda: from_networkx(networkx.DiGraph([(0, 1)])), TypeError, "directed"),
        (lambda: from_networkx(networkx.Graph([(0, 1)]), ("stiffness",)), ValueError, "no attribute 'stiffness'"),
        (lambda: from_networkx(networkx.Graph([(0, 0)])), ValueError, "to itself"),
    ],
)
def test_errors(make, kind, message):
    """Each wrong input raises, naming what is wrong."""
    with pytest.raises(kind, match=message):
        make()
