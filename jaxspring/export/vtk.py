"""VTK's XML files of unstructured grids (`.vtu`), and a collection (`.pvd`) for a run. ParaView, VisIt and PyVista read them.

Arrays are written as they are, little-endian, in base64: well-formed XML, and no digit is lost.
Source: VTK file formats, https://docs.vtk.org/en/latest/vtk_file_formats/index.html
"""

from __future__ import annotations

import base64
from xml.sax.saxutils import quoteattr

import numpy as np

from .._arrays import Numbers
from ..archive import Path
from ..topology.base import Topology
from .frames import Frames, NodeFields, SpringFields, States, frames_of
from .places import write_frames

VERTEX, LINE, TRIANGLE = 1, 3, 5  # VTK's numbers of these cells
TYPES = {"f4": "Float32", "f8": "Float64", "i4": "Int32", "i8": "Int64", "u1": "UInt8", "b1": "UInt8"}


def save_vtk(
    path: Path,
    states: States,
    net: Topology,
    node_fields: NodeFields = None,
    spring_fields: SpringFields = None,
    triangles: Numbers | None = None,
) -> None:
    """Write a state, or the frames of a run, for ParaView and other programs that read VTK's files.

    One state becomes the file `path`, which ends in `.vtu`. Frames become the folder `path`: `run/run.pvd`, to be opened, lists
    `run/run_0000.vtu` and so on with their times. An older series in that folder is replaced.

    Points are the nodes, in the user's order. Cells are all E springs in the user's order, then a vertex for every node that no whole
    spring holds, then the triangles. Fields of springs are NaN (whole numbers: 0) on cells that are no springs. Coordinates and vectors
    that have no z have z = 0.

    Args:
        path: the file, or for frames the folder.
        states: a `State`, a `State` with a leading axis of F frames, or what `rollout` returned with `save_every`.
        net: the topology.
        node_fields: name -> (N,) or node shape, or (N, D) of a vector, in the user's order; in a series each with F before it,
            or (N,) for all frames. A `Vector`, such as a force, brings its order along. Beside them
            stand `velocity` [m/s] and, where the state has one, `temperature` [K].
        spring_fields: name -> (E,) or an edge field; in a series one per frame, or one for all. Beside them stand `alive`, 0 where a
            spring has broken, where springs break, and `wraps`, 1 where a spring passes through a side of a periodic box.
        triangles: (T, 3) node numbers of a surface, e.g. `net.triangles`; None writes none.

    Raises:
        TypeError: what is no state, traced, or holds no real numbers.
        ValueError: a wrong shape, a NaN, a name or an ending that readers would not take. Nothing has been written then.
        OSError: the folder cannot be written, or holds other files.

    >>> import tempfile, pathlib
    >>> net = js.lattice(3)
    >>> state = js.State.from_points(net, net.grid())
    >>> springs = js.Springs(net, 10.0, 0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     js.save_vtk(folder + "/chain.vtu", state, net, spring_fields={"tension": springs.tension(state)})
    ...     print(pathlib.Path(folder, "chain.vtu").read_text()[:60])
    <?xml version="1.0"?>
    <VTKFile type="UnstructuredGrid" versi
    """
    frames = frames_of(states, net, node_fields, spring_fields, triangles)
    write_frames(path, ".vtu", "ParaView", frames, _grid, (".pvd", _collection))


def _collection(names: list[str], time: np.ndarray) -> bytes:
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">',
        "<Collection>",
        *(f'<DataSet timestep="{t!s}" part="0" file={quoteattr(name)}/>' for t, name in zip(time, names, strict=True)),
        "</Collection>",
        "</VTKFile>",
    ]
    return ("\n".join(lines) + "\n").encode()


def _grid(frames: Frames, i: int) -> bytes:
    """The `.vtu` of frame i."""
    whole = np.ones(len(frames.edges), bool) if frames.alive is None else frames.alive[i]
    loose = np.flatnonzero(np.bincount(frames.edges[whole].ravel(), minlength=frames.points.shape[1]) == 0)
    cells = ((LINE, frames.edges), (VERTEX, loose[:, None]), (TRIANGLE, frames.triangles))
    n_others = len(loose) + len(frames.triangles)
    sizes = np.concatenate([np.full(len(nodes), nodes.shape[1], np.int64) for _, nodes in cells])
    types = np.concatenate([np.full(len(nodes), kind, np.uint8) for kind, nodes in cells])
    corners = np.concatenate([np.ravel(nodes).astype(np.int64) for _, nodes in cells])
    of_cells = {name: _extended(field[i], n_others) for name, field in frames.spring_fields.items()}
    if frames.alive is not None:
        of_cells = {"alive": np.pad(whole, (0, n_others), constant_values=True), **of_cells}
    if frames.box.any():
        of_cells["wraps"] = np.pad(_wraps(frames, i), (0, n_others))
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="UnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<UnstructuredGrid>",
        f'<FieldData><DataArray type="Float64" Name="TimeValue" NumberOfTuples="1" format="ascii">{frames.time[i]!s}</DataArray>',
        "</FieldData>",
        f'<Piece NumberOfPoints="{frames.points.shape[1]}" NumberOfCells="{len(types)}">',
        "<Points>" + _array("Points", frames.points[i]) + "</Points>",
        "<Cells>" + _array("connectivity", corners) + _array("offsets", np.cumsum(sizes)) + _array("types", types) + "</Cells>",
        "<PointData>" + "".join(_array(name, field[i]) for name, field in frames.node_fields.items()) + "</PointData>",
        "<CellData>" + "".join(_array(name, field) for name, field in of_cells.items()) + "</CellData>",
        "</Piece>",
        "</UnstructuredGrid>",
        "</VTKFile>",
    ]
    return ("\n".join(lines) + "\n").encode()


def _array(name: str, array: np.ndarray) -> str:
    """One array: the number of its bytes and its bytes, in base64."""
    little = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
    data = np.uint64(little.nbytes).astype("<u8").tobytes() + little.tobytes()
    components = f' NumberOfComponents="{array.shape[1]}"' if array.ndim == 2 else ""
    kind = TYPES[array.dtype.str[1:]]
    return f'<DataArray type="{kind}" Name="{name}"{components} format="binary">{base64.b64encode(data).decode()}</DataArray>\n'


def _extended(field: np.ndarray, n_others: int) -> np.ndarray:
    """(E,) values of springs, and as many that mean nothing as there are other cells."""
    return np.pad(field, (0, n_others), constant_values=np.nan if field.dtype.kind == "f" else 0)


def _wraps(frames: Frames, i: int) -> np.ndarray:
    """(E,) which springs join a node to another image than the one that is drawn."""
    tails, heads = frames.points[i][frames.edges.T]
    repeats = frames.box > 0
    return (np.abs(heads - tails) > frames.box / 2)[:, repeats].any(axis=1)


__all__ = ["save_vtk"]
