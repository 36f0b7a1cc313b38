"""Networks from surface mesh files.

OBJ, OFF and PLY are read here; STL, glTF and others by trimesh, which the extra `mesh` brings. Vertices at one place become one node, since
files repeat them along seams of texture and, in STL, for every triangle. Nothing else is put right: where a file's pieces do not hang
together, a warning says so.
"""

from __future__ import annotations

import pathlib
import warnings
from typing import Any

import numpy as np

from .._checks import constant, is_concrete
from .graph import Graph
from .mesh_text import READERS, RawMesh, raw_mesh
from .polygons import CrossedPolygonError, triangulate

# Shares of a mesh's size within which corners of different pieces may be one that was rounded: the 7th digit, and the 6th.
ROUNDED = (1e-7, 1e-6, 1e-5)
# Formats that trimesh reads only with another package.
NEEDED = {".3mf": "lxml", ".dae": "pycollada", ".ctm": "python-openctm", ".step": "cascadio", ".stp": "cascadio", ".xaml": "lxml"}


def from_mesh(path: str | pathlib.Path, *, merge: float | None = None) -> tuple[Graph, np.ndarray]:
    """A network from a surface mesh file: OBJ, OFF and PLY; STL, GLB and what else trimesh reads with the extra `mesh`.

    A spring joins the ends of every side of every triangle, and of every line (OBJ) or edge (PLY), once. Faces of more corners are cut into
    triangles. Vertices at one place are merged. Vertices that nothing uses are dropped, and so are faces that merging left fewer than three
    corners; a triangle that stands twice, with either side up, counts once.

    Args:
        path: the file.
        merge: vertices nearer than this share of the mesh's size (the diagonal of its box) become one node. None and 0 merge those at
            exactly one place.

    Returns:
        `(net, points)`: a `Graph` with the file's triangles, and the (N, 3) positions of its nodes in the file's unit of length. Nodes and
        triangles are in the file's order.

    Raises:
        ImportError: a package that this format needs is not installed.
        FileNotFoundError: no such file.
        ValueError: a file that cannot be read, that names a vertex it does not have, that holds neither a face nor a line, a vertex that is
            not finite, a face that crosses itself, a `merge` so wide that it takes faces away.

    Warns:
        UserWarning: the net is in several pieces; with a `merge` that would join them, if there is one. A `merge` that was given, and that
            no wider one would better, silences it.
    """
    path = pathlib.Path(path)
    reader = READERS.get(path.suffix.lower()) or _by_trimesh(path)
    if merge is not None:
        constant("merge", merge, "Vertices have a distance of zero or more.", may_be_zero=True)
        if not is_concrete(merge) or not merge < 1:
            raise ValueError(f"merge = {merge}; expected a share of the mesh's size, below 1, e.g. 1e-6.")
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    raw = reader(path)
    if not len(raw.sizes) and not len(raw.lines):
        raise ValueError(f"{path} holds neither a face nor a line, so there is nothing to make springs of.")
    points, triangles, lines = _merged(path, raw, 0.0 if merge is None else float(merge))
    edges = np.concatenate([lines, triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [0, 2]]])
    net = Graph.from_edges(np.unique(np.sort(edges, axis=1), axis=0), len(points), triangles=triangles if len(triangles) else None)
    _tell_pieces(path, net.edges, points, merge)
    return net, points


def _by_trimesh(path: pathlib.Path) -> Any:
    """A reader of another format, once the packages that it needs are there."""
    try:
        import trimesh
    except ImportError as error:
        raise ImportError(
            f"from_mesh reads {path.suffix or 'such'} files with trimesh, which is not installed. Run: pip install 'jaxspring[mesh]'"
        ) from error
    known, suffix = {f".{name}" for name in trimesh.available_formats()}, path.suffix.lower()
    if suffix not in known:
        if suffix in NEEDED:
            package = NEEDED[suffix]
            raise ImportError(f"{path}: trimesh reads {suffix} files with {package}, which is not installed. Run: pip install {package}")
        raise ValueError(f"{path} is of no format that is read here: {', '.join(sorted(known | set(READERS)))}.")

    def read(path: pathlib.Path) -> RawMesh:
        try:
            mesh = trimesh.load_mesh(path, process=False)
        except ImportError as error:
            raise ImportError(f"{path} needs a package that is missing: {error}") from error
        except Exception as error:  # each format fails in its own way
            raise ValueError(f"{path} cannot be read as a mesh: {error}") from error
        return raw_mesh(path, getattr(mesh, "vertices", ()), np.asarray(getattr(mesh, "faces", ()), np.int64).reshape(-1, 3))

    return read


def _merged(path: pathlib.Path, raw: RawMesh, merge: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the nodes, triangles (T, 3) and lines (L, 2) between them: vertices at one place as one, without those not used."""
    used = np.zeros(len(raw.points), bool)
    used[raw.corners] = used[raw.lines] = True
    # Adding zero makes one of the two zeros.
    _, representative, inverse = np.unique(raw.points + 0.0, axis=0, return_index=True, return_inverse=True)
    node = representative[inverse.ravel()]
    if merge > 0:
        exact = node
        node = node[_near(raw.points, used, merge * _size(raw.points[used]))]
        _refuse_wide(path, raw, exact, node, merge)
    sizes, corners = _without_repeats(raw.sizes, node[raw.corners])
    try:
        triangles = triangulate(raw.points, sizes, corners)
    except CrossedPolygonError as error:
        raise ValueError(f"{path}: {error}, so no triangles cover it. Cut it into triangles in the program that wrote it.") from error
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    # A face that stands twice, as where both of its sides were written, is one piece of the surface: it weighs once.
    _, first = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
    triangles = triangles[np.sort(first)]
    lines = node[raw.lines]
    lines = lines[lines[:, 0] != lines[:, 1]]
    kept = np.unique(np.concatenate([triangles.ravel(), lines.ravel()]))
    if not len(kept):
        raise ValueError(f"{path} holds no face with three different corners, so there is nothing to make springs of.")
    number = np.zeros(len(raw.points), np.int64)
    number[kept] = np.arange(len(kept))
    return raw.points[kept].copy(), number[triangles], number[lines]


def _without_repeats(sizes: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polygons without corners that equal the one before; those left with fewer than three are dropped."""
    owner, start = np.repeat(np.arange(len(sizes)), sizes), np.cumsum(sizes) - sizes
    before = np.roll(corners, 1)
    before[start] = corners[start + sizes - 1]
    keep = corners != before
    owner, corners = owner[keep], corners[keep]
    sizes = np.bincount(owner, minlength=len(sizes))
    return sizes[sizes > 2], corners[sizes[owner] > 2]


def _near(points: np.ndarray, used: np.ndarray, distance: float) -> np.ndarray:
    """For each vertex the first of those that it hangs together with by steps of at most `distance`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    numbers = np.flatnonzero(used)
    pairs = numbers[KDTree(points[numbers]).query_pairs(distance, output_type="ndarray")]
    matrix = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(points),) * 2)
    label = connected_components(matrix, directed=False)[1]
    return np.unique(label, return_index=True)[1][label]


def _refuse_wide(path: pathlib.Path, raw: RawMesh, exact: np.ndarray, node: np.ndarray, merge: float) -> None:
    """Raise ValueError where merging leaves a face fewer corners than the file gives it."""
    owner = np.repeat(np.arange(len(raw.sizes)), raw.sizes)
    start = np.cumsum(raw.sizes) - raw.sizes
    following = np.arange(len(owner)) + 1
    following[start + raw.sizes - 1] = start
    lost = (node[raw.corners] == node[raw.corners[following]]) & (exact[raw.corners] != exact[raw.corners[following]])
    if lost.any():
        i = int(np.argmax(lost))
        side = float(np.linalg.norm(raw.points[raw.corners[i]] - raw.points[raw.corners[following[i]]]))
        size = _size(raw.points)
        raise ValueError(
            f"{path}: merge = {merge} of the mesh's size, {merge * size:.3g}, would make one node of two corners of face {owner[i]}, whose "
            f"side is {side:.3g} long. Pass a smaller merge."
        )


def _tell_pieces(path: pathlib.Path, edges: np.ndarray, points: np.ndarray, merge: float | None) -> None:
    """Warn where the net is in several pieces, with the `merge` that would join some."""
    label = _pieces(edges, len(points))
    n_pieces = int(label.max()) + 1
    if n_pieces == 1:
        return
    for share in ROUNDED if merge is None else tuple(share for share in ROUNDED if share > merge):
        near = _near(points, np.ones(len(points), bool), share * _size(points))
        joined = _pieces(np.concatenate([edges, np.stack([np.arange(len(points)), near], axis=-1)]), len(points))
        if joined.max() + 1 < n_pieces:
            hint = f"Corners nearer than {share:g} of its size hold {joined.max() + 1} together: pass merge={share:g} to make them one."
            break
    else:
        if merge is not None:
            return
        hint = "No spring joins them. Pass merge=0 if that is meant."
    warnings.warn(f"{path} makes a net of {n_pieces} loose pieces. {hint}", UserWarning, stacklevel=3)


def _pieces(edges: np.ndarray, n_nodes: int) -> np.ndarray:
    """(N,) number of the piece that each node belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    matrix = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(n_nodes, n_nodes))
    return connected_components(matrix, directed=False)[1]


def _size(points: np.ndarray) -> float:
    """Diagonal of the box around the points."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))


__all__ = ["from_mesh"]
