"""Networks from what people have: points, triangles, a SciPy matrix, a NetworkX graph; mesh files: see `mesh_files`.

Each builder makes a `Graph`. The package it needs is imported when it is called.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from .._arrays import Numbers, given, on_host
from .._checks import finite, triangle_indices
from .graph import Graph

# How many roundings of a coordinate may lie between a node and the line of its neighbours on a straight border.
ROUNDING = 8


def from_triangles(triangles: Numbers, n_nodes: int) -> Graph:
    """A spring along every side of every triangle, one per side; the triangles are kept as `net.triangles`.

    Args:
        triangles: (T, 3) integer node numbers.
        n_nodes: number of nodes N; a node in no triangle gets no spring.

    Returns:
        A `Graph` whose springs are sorted by their lower, then their higher node.

    Raises:
        ValueError: a shape other than (T, 3), a node that does not exist, a triangle with the same corner twice.
        TypeError: node numbers that are not integers.

    >>> net = from_triangles([(0, 1, 2), (2, 1, 3)], n_nodes=4)
    >>> net.n_springs, net.triangles.shape
    (5, (2, 3))
    """
    corners = triangle_indices("triangles", triangles, n_nodes)
    return Graph.from_edges(_sides(corners), n_nodes, triangles=corners)


def delaunay(points: Numbers) -> Graph:
    """Springs along the Delaunay triangulation of points in the plane, or tetrahedralisation of points in space.

    Args:
        points: (N, 2) or (N, 3) positions [m].

    Returns:
        A `Graph` on all N points. `net.triangles` holds the triangles; in space, those of the convex hull.

    Raises:
        ValueError: a wrong shape, NaN, too few points, all points on one line or plane, two points at one place, named with both indices.

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
    # Qhull squares coordinates: far from the origin no digit of a spacing would be left, and far from 1 it would overflow.
    local = points - points.mean(axis=0)
    local = local / (np.abs(local).max() or 1.0)
    rounding = ROUNDING * np.finfo(float).eps * max(np.abs(points).max() / (np.ptp(points, axis=0).max() or 1.0), 1.0)
    _refuse_doubled(local, *_doubled(points))
    flat = f"points has no triangulation: all {n_nodes} points lie on one {'line' if dim == 2 else 'plane'}. Use Graph.from_edges."
    if np.linalg.svd(local, compute_uv=False)[-1] <= rounding * np.sqrt(n_nodes):
        raise ValueError(flat)
    try:
        found = Delaunay(local)
    except QhullError as error:
        raise ValueError(flat) from error
    _refuse_doubled(local, found.coplanar[:, 0], found.coplanar[:, 2])
    simplices, surface = _without_slivers(local, found.simplices, found.neighbors, rounding)
    return Graph.from_edges(_sides(simplices), n_nodes, triangles=simplices if dim == 2 else surface)


def from_scipy(matrix: Any) -> tuple[Graph, np.ndarray]:
    """A network from a symmetric adjacency matrix: one spring per stored pair i < j.

    Args:
        matrix: (N, N) sparse or dense, symmetric, with an empty diagonal; an entry is a weight, e.g. a stiffness [N/m]. In a sparse matrix
            a zero that is stored is a spring of weight zero, on whichever side of the diagonal it is; entries stored twice are summed.

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
    return Graph.from_edges(edges, matrix.shape[0]), stored.data[keep][first]


def from_networkx(graph: Any, attributes: tuple[str, ...] = ()) -> tuple[Graph, list[Hashable], tuple[np.ndarray, ...]]:
    """A network from an undirected NetworkX graph: one spring per edge, parallel edges included.

    Args:
        graph: `networkx.Graph` or `MultiGraph`.
        attributes: names of edge attributes to read, e.g. `("stiffness", "rest_length")`; a single name is one attribute.

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
    return Graph.from_edges(pairs, len(labels)), labels, tuple(values)


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


def _doubled(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points at exactly the place of an earlier one, and that one."""
    _, first, inverse = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    first = first[inverse.ravel()]
    later = np.flatnonzero(first != np.arange(len(points)))
    return later, first[later]


def _refuse_doubled(local: np.ndarray, left_out: np.ndarray, nearest: np.ndarray) -> None:
    if not len(left_out):
        return
    first = int(np.argmin(left_out))
    one, other = int(left_out[first]), int(nearest[first])
    apart = float(np.linalg.norm(local[one] - local[other]))
    where = "at the place of" if apart == 0 else f"only {apart:.1g} of the points' extent away from"
    raise ValueError(
        f"points[{one}] is {where} points[{other}], too near to tell apart, so no triangle has it as a corner and it would hang free. "
        f"Remove points[{one}] ({len(left_out)} of {len(local)} points are such)."
    )


def _without_slivers(points: np.ndarray, simplices: np.ndarray, neighbours: np.ndarray, rounding: float) -> tuple[np.ndarray, np.ndarray]:
    """The simplices without those on the outside that are thinner than the coordinates' rounding, and the faces on the outside.

    Nodes on a straight border are never quite on one line far from the origin: without this, springs would run along all of it.
    """
    dim = points.shape[1]
    corners = points[simplices]
    # The face opposite to each corner, and the corner's height over it: the volume is the same for all.
    faces = np.stack([np.delete(simplices, i, axis=1) for i in range(dim + 1)], axis=1)
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    sides = points[faces[:, :, 1:]] - points[faces[:, :, :1]]
    gram = sides @ np.swapaxes(sides, -1, -2)
    height = volume[:, None] / np.sqrt(np.maximum(np.linalg.det(gram), np.finfo(float).tiny))
    kept, outside = np.ones(len(simplices), bool), neighbours == -1
    while True:
        thin = kept & (outside & (height <= rounding)).any(axis=1)
        if not thin.any():
            break
        kept &= ~thin
        outside |= (neighbours >= 0) & ~kept[neighbours]
    if len(np.unique(simplices[kept])) < len(points):
        kept, outside = np.ones(len(simplices), bool), neighbours == -1
    return simplices[kept], faces[kept][outside[kept]]


def _sides(simplices: np.ndarray) -> np.ndarray:
    """(E, 2) distinct sides of triangles or tetrahedra, lower node first, sorted."""
    n = simplices.shape[1]
    sides = np.concatenate([simplices[:, [i, j]] for i in range(n) for j in range(i + 1, n)])
    return np.unique(np.sort(sides, axis=1), axis=0)
