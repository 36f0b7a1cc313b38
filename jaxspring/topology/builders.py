"""Networks from what people have: points, triangles, a mesh file, a SciPy matrix, a NetworkX graph.

Each builder makes a `Graph`. The package it needs is imported when it is called.
"""

from __future__ import annotations

import pathlib
from collections.abc import Hashable
from typing import Any

import numpy as np

from .._arrays import as_indices, given, on_host
from .._checks import finite
from .graph import Graph
from .reduction import Gather, Scatter

Reductions = type[Gather] | type[Scatter] | None


def from_triangles(triangles: Any, n_nodes: int, *, reduction: Reductions = None) -> Graph:
    """A spring along every side of every triangle, one per side; the triangles are kept as `net.triangles`.

    Args:
        triangles: (T, 3) integer node numbers.
        n_nodes: number of nodes N; a node in no triangle gets no spring.
        reduction: see `Graph.from_edges`.

    Returns:
        A `Graph` whose springs are sorted by their lower, then their higher node.

    Raises:
        ValueError: a shape other than (T, 3), a node that does not exist, a triangle with the same corner twice.
        TypeError: node numbers that are not integers.

    >>> net = from_triangles([(0, 1, 2), (2, 1, 3)], n_nodes=4)
    >>> net.n_springs, net.triangles.shape
    (5, (2, 3))
    """
    corners = as_indices("triangles", triangles)
    if corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        raise ValueError(f"triangles has shape {corners.shape}; expected (T, 3): three node numbers for each of T >= 1 triangles.")
    _check_corners(corners, n_nodes)
    return Graph.from_edges(_sides(corners), n_nodes, triangles=corners, reduction=reduction)


def delaunay(points: Any, *, reduction: Reductions = None) -> Graph:
    """Springs along the Delaunay triangulation of points in the plane, or tetrahedralisation of points in space.

    Args:
        points: (N, 2) or (N, 3) positions [m].
        reduction: see `Graph.from_edges`.

    Returns:
        A `Graph` on all N points. `net.triangles` holds the triangles; in space, those of the convex hull.

    Raises:
        ValueError: a wrong shape, NaN, too few points, all points on one line or plane, two points at one place.

    >>> net = delaunay([(0, 0), (1, 0), (0, 1), (1, 1.1)])
    >>> net.n_springs, net.triangles.shape
    (5, (2, 3))
    """
    from scipy.spatial import Delaunay, QhullError

    points = on_host("points", points)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points has shape {points.shape}; expected (N, 2) or (N, 3). A chain needs no triangulation: use lattice(N).")
    finite("points", points)
    n_nodes, dim = points.shape
    if n_nodes <= dim:
        raise ValueError(f"points holds {n_nodes} points; a triangulation in {dim} coordinates needs at least {dim + 1}.")
    try:
        found = Delaunay(points)
    except QhullError as error:
        flat = "line" if dim == 2 else "plane"
        raise ValueError(f"points has no triangulation: all {n_nodes} points may lie on one {flat}. Use Graph.from_edges.") from error
    if len(found.coplanar):
        left_out, _, nearest = (int(i) for i in found.coplanar[0])
        raise ValueError(
            f"points[{left_out}] is at the place of points[{nearest}] (or too near to tell apart), so no triangle has it as a corner "
            f"and it would hang free. Remove points[{left_out}] ({len(found.coplanar)} of {n_nodes} points are such)."
        )
    surface = found.simplices if dim == 2 else found.convex_hull
    return Graph.from_edges(_sides(found.simplices), n_nodes, triangles=surface, reduction=reduction)


def from_mesh(path: str | pathlib.Path, *, reduction: Reductions = None) -> tuple[Graph, np.ndarray]:
    """A network from a surface mesh file: OBJ, STL, PLY, OFF and what else trimesh reads. Needs the extra `mesh`.

    Vertices at one place are merged, so that seams of texture or normals do not tear the net. Unused vertices are dropped.

    Args:
        path: the file.
        reduction: see `Graph.from_edges`.

    Returns:
        `(net, points)`: a `Graph` with the file's triangles, and the (N, 3) positions of its nodes in the file's unit of length.

    Raises:
        ImportError: trimesh is not installed.
        FileNotFoundError: no such file.
        ValueError: a file that cannot be read, or that holds no triangle.
    """
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("from_mesh reads files with trimesh, which is not installed. Run: pip install 'jaxspring[mesh]'") from error
    path = pathlib.Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except Exception as error:  # each format fails in its own way
        raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
    faces = np.asarray(getattr(mesh, "faces", ()))
    if not len(faces):
        raise ValueError(f"{path} holds no triangle, so there is nothing to make springs of.")
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.remove_unreferenced_vertices()
    points = np.array(mesh.vertices, float)
    finite("points", points)
    return from_triangles(np.asarray(mesh.faces, np.int64), len(points), reduction=reduction), points


def from_scipy(matrix: Any, *, reduction: Reductions = None) -> tuple[Graph, np.ndarray]:
    """A network from a symmetric adjacency matrix: one spring per stored pair i < j.

    Args:
        matrix: (N, N) sparse or dense, symmetric, with an empty diagonal; an entry is a weight, e.g. a stiffness [N/m]. In a sparse matrix
            a zero that is stored is a spring of weight zero, on whichever side of the diagonal it is; entries stored twice are summed.
        reduction: see `Graph.from_edges`.

    Returns:
        `(net, weights)`: a `Graph` and the (E,) weight of each spring in float64, in the order of `net.edges`.

    Raises:
        ValueError: a matrix that is not square or not symmetric, an entry on its diagonal, or one that is not finite.
        TypeError: entries that are not real numbers.

    >>> net, weights = from_scipy(np.array([[0, 2.0, 0], [2.0, 0, 5.0], [0, 5.0, 0]]))
    >>> net.edges.tolist(), weights.tolist()
    ([[0, 1], [1, 2]], [2.0, 5.0])
    """
    from scipy.sparse import coo_array, issparse

    matrix = coo_array(matrix if issparse(matrix) else on_host("matrix", matrix, may_be_boolean=True))
    if matrix.dtype.kind not in "biuf":
        raise TypeError(f"matrix has dtype {matrix.dtype}; expected real numbers.")
    matrix = matrix.astype(np.float64)  # before what is stored twice is summed: small types wrap round
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"matrix has shape {matrix.shape}; expected (N, N), one row and one column per node.")
    finite("the entries of matrix", matrix.data)
    matrix = matrix.tocsr()  # sums what is stored twice
    unequal = (matrix - matrix.T).tocoo()
    wrong = np.flatnonzero(unequal.data)
    if len(wrong):
        i, j = int(unequal.row[wrong[0]]), int(unequal.col[wrong[0]])
        raise ValueError(
            f"matrix[{i}, {j}] = {matrix[i, j]}, but matrix[{j}, {i}] = {matrix[j, i]}. A spring pulls both its ends alike. "
            f"Pass a symmetric matrix, e.g. (matrix + matrix.T) / 2."
        )
    loops = np.flatnonzero(matrix.diagonal())
    if len(loops):
        raise ValueError(f"matrix[{loops[0]}, {loops[0]}] joins node {loops[0]} to itself. Set the diagonal to zero.")
    stored = matrix.tocoo()
    both = np.stack([np.minimum(stored.row, stored.col), np.maximum(stored.row, stored.col)], axis=-1).astype(np.int64)
    keep = both[:, 0] < both[:, 1]
    # Where both sides are stored they are equal: the first will do.
    edges, first = np.unique(both[keep], axis=0, return_index=True)
    return Graph.from_edges(edges, matrix.shape[0], reduction=reduction), stored.data[keep][first]


def from_networkx(
    graph: Any, attributes: tuple[str, ...] = (), *, reduction: Reductions = None
) -> tuple[Graph, list[Hashable], tuple[np.ndarray, ...]]:
    """A network from an undirected NetworkX graph: one spring per edge, parallel edges included.

    Args:
        graph: `networkx.Graph` or `MultiGraph`.
        attributes: names of edge attributes to read, e.g. `("stiffness", "rest_length")`; a single name is one attribute.
        reduction: see `Graph.from_edges`.

    Returns:
        `(net, labels, values)`: a `Graph`, the label of each node in the order of the net's nodes, and one (E,) array per attribute
        in the order of `net.edges`.

    Raises:
        TypeError: a directed graph, or what is no graph; an attribute that is not a number.
        ValueError: an edge that lacks an attribute, has one that is not finite, or joins a node to itself.

    >>> import networkx
    >>> graph = networkx.Graph()
    >>> graph.add_edge("a", "b", stiffness=3.0)
    >>> net, labels, (stiffness,) = from_networkx(graph, ("stiffness",))
    >>> net.n_springs, labels, stiffness.tolist()
    (1, ['a', 'b'], [3.0])
    """
    if not hasattr(graph, "is_directed"):
        raise TypeError(f"graph is a {type(graph).__name__}; expected a networkx.Graph.")
    if graph.is_directed():
        raise TypeError("graph is directed, but a spring pulls both its ends alike. Pass graph.to_undirected().")
    labels = list(graph.nodes)
    number = {label: i for i, label in enumerate(labels)}
    edges = list(graph.edges(data=True))
    values = []
    for name in (attributes,) if isinstance(attributes, str) else tuple(attributes):
        values.append(np.array([_attribute(name, *edge) for edge in edges], float))
    pairs = [(number[tail], number[head]) for tail, head, _ in edges]
    return Graph.from_edges(pairs, len(labels), reduction=reduction), labels, tuple(values)


def _attribute(name: str, tail: Hashable, head: Hashable, data: dict[Any, Any]) -> float:
    """One attribute of an edge, which must be a finite number."""
    where = f"edge ({tail!r}, {head!r})"
    if name not in data:
        raise ValueError(f"{where} has no attribute {name!r}; it has {', '.join(map(repr, data)) or 'none'}.")
    value = data[name]
    if isinstance(value, bool | str | bytes) or value is None:
        raise TypeError(f"{where} has {name} = {value!r}; expected a number.")
    array = np.asarray(given(f"{name} of {where}", value))
    if array.ndim or array.dtype.kind not in "iuf":
        raise TypeError(f"{where} has {name} = {value!r:.60}; expected one real number.")
    finite(f"{name} of {where}", array)
    return float(array)


def _sides(simplices: np.ndarray) -> np.ndarray:
    """(E, 2) distinct sides of triangles or tetrahedra, lower node first, sorted."""
    n = simplices.shape[1]
    sides = np.concatenate([simplices[:, [i, j]] for i in range(n) for j in range(i + 1, n)])
    return np.unique(np.sort(sides, axis=1), axis=0)


def _check_corners(corners: np.ndarray, n_nodes: int) -> None:
    bad = (corners < 0) | (corners >= n_nodes)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"triangles[{row}] = {tuple(corners[row].tolist())} names node {corners[row, column]}, but there are n_nodes = {n_nodes} "
            f"(nodes are 0 to {n_nodes - 1}).\nUnchecked, JAX would read another node instead. Fix triangles[{row}]."
        )
    a, b, c = corners.T
    same = (a == b) | (b == c) | (c == a)
    if same.any():
        row = int(np.argmax(same))
        raise ValueError(f"triangles[{row}] = {tuple(corners[row].tolist())} has a corner twice: it is no triangle. Remove it.")
