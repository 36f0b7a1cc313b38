"""Stanford PLY, binary: points, springs as edges, triangles as faces. MeshLab, Blender and `from_mesh` read it.

Source: G. Turk, The PLY Polygon File Format (1994); types as in http://paulbourke.net/dataformats/ply/
"""

from __future__ import annotations

import numpy as np

from .._arrays import Numbers
from ..archive import Path
from ..topology.base import Topology
from .frames import Frames, NodeFields, States, frames_of
from .places import write_frames

TYPES = {"f4": "float", "f8": "double", "i4": "int", "u1": "uchar"}


def save_ply(
    path: Path,
    states: States,
    net: Topology,
    node_fields: NodeFields = None,
    triangles: Numbers | None = None,
) -> None:
    """Write a state, or the frames of a run, as PLY for MeshLab, Blender and other programs for meshes.

    One state becomes the file `path`, which ends in `.ply`. Frames become the folder `path` with `run/run_0000.ply` and so on; an older
    series there is replaced. Vertices are the nodes and edges the springs, both in the user's order; broken springs are left out, since
    these programs would draw them. A vector v is written as `v_x`, `v_y` and `v_z`. What has no z has z = 0. Values of springs have no
    place here: see `save_vtk`.

    Args:
        path: the file, or for frames the folder.
        states: a `State`, a `State` with a leading axis of F frames, or what `rollout` returned with `save_every`.
        net: the topology.
        node_fields: name -> (N,) or node shape, or (N, D) of a vector, in the user's order; in a series each with F before it,
            or (N,) for all frames. A `Vector`, such as a force, brings its order along. Beside them
            stand the velocity [m/s] and, where the state has one, `temperature` [K].
        triangles: (T, 3) node numbers of a surface, e.g. `net.triangles`; None writes none.

    Raises:
        TypeError: what is no state, traced, or holds no real numbers.
        ValueError: a wrong shape, a NaN, a name or an ending that readers would not take. Nothing has been written then.
        OSError: the folder cannot be written, or holds other files.

    >>> import tempfile
    >>> net = js.from_triangles([[0, 1, 2]], 3)
    >>> state = js.State.from_points(net, [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     js.save_ply(folder + "/part.ply", state, net, triangles=net.triangles)
    ...     again, points = js.from_mesh(folder + "/part.ply")
    >>> (again.n_springs, points.tolist()[1])
    (3, [1.0, 0.0, 0.0])
    """
    frames = frames_of(states, net, node_fields, triangles=triangles)
    write_frames(path, ".ply", "a viewer", frames, _mesh)


def _mesh(frames: Frames, i: int) -> bytes:
    """The bytes of frame i."""
    whole = slice(None) if frames.alive is None else frames.alive[i]
    edges = frames.edges[whole].astype(np.int32)
    vertex = dict(zip("xyz", frames.points[i].T, strict=True))
    for name, field in frames.node_fields.items():
        parts = {name: field[i]} if field.ndim == 2 else {f"{name}_{axis}": part for axis, part in zip("xyz", field[i].T, strict=True)}
        if set(parts) & set(vertex):
            raise ValueError(f"node_fields: two columns would be called {sorted(set(parts) & set(vertex))[0]!r}; rename one.")
        vertex |= parts
    # No other property: some readers take every column of an edge for a vertex.
    edge = {"vertex1": edges[:, 0], "vertex2": edges[:, 1]}
    faces = np.zeros(len(frames.triangles), [("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, frames.triangles
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment time {frames.time[i]!s} s",
        *_element("vertex", vertex),
        # Some readers want faces, though there may be none.
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        *_element("edge", edge),
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + _rows(vertex) + faces.tobytes() + _rows(edge)


def _element(name: str, columns: dict[str, np.ndarray]) -> list[str]:
    count = len(next(iter(columns.values())))
    return [f"element {name} {count}", *(f"property {TYPES[_little(column)[1:]]} {name}" for name, column in columns.items())]


def _rows(columns: dict[str, np.ndarray]) -> bytes:
    """Row by row, the columns of an element."""
    table = np.zeros(len(next(iter(columns.values()))), [(name, _little(column)) for name, column in columns.items()])
    for name, column in columns.items():
        table[name] = column
    return table.tobytes()


def _little(column: np.ndarray) -> str:
    """How a column is stored: little-endian, booleans as bytes."""
    return "|u1" if column.dtype == np.bool_ else column.dtype.newbyteorder("<").str


__all__ = ["save_ply"]
