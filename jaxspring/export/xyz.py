"""Extended XYZ: nodes as particles, all frames in one text file. OVITO, ASE and VMD read it.

Numbers are written with as many digits as bring the same ones back.
Source: the extended XYZ specification, https://github.com/libAtoms/extxyz
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..archive import Path, atomic_file
from ..topology.base import Topology
from .frames import Frames, NodeFields, States, frames_of
from .places import file_place

SPECIES = "X"  # of no element: readers that know chemistry give it no mass and no bonds


def save_xyz(path: Path, states: States, net: Topology, node_fields: NodeFields = None) -> None:
    """Write a state, or the frames of a run, as extended XYZ for OVITO, ASE and other programs for particles.

    All frames are in one file. Columns: `species`, always X; `pos` [m]; `velo` [m/s]; `temperature` [K] where the state has one; then the
    user's. Before each frame stand `Time` [s] and, where the net is in a periodic box, `Lattice` with `pbc`. Springs have no place in this
    format: see `save_vtk`.

    Args:
        path: the file, which ends in `.xyz` or `.extxyz`.
        states: a `State`, a `State` with a leading axis of F frames, or what `rollout` returned with `save_every`.
        net: the topology.
        node_fields: name -> (N,) or node shape, or (N, D) of a vector, in the user's order; in a series each with F before it,
            or (N,) for all frames. A `Vector`, such as a force, brings its order along.

    Raises:
        TypeError: what is no state, traced, or holds no real numbers.
        ValueError: a wrong shape, a NaN, a name or an ending that readers would not take. Nothing has been written then.
        OSError: the file cannot be written.

    >>> import tempfile, pathlib
    >>> pair = js.Graph.from_edges([[0, 1]], 2)
    >>> state = js.State.from_points(pair, [[0.0, 0.0], [1.5, 0.0]])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     js.save_xyz(folder + "/pair.xyz", state, pair)
    ...     print(pathlib.Path(folder, "pair.xyz").read_text(), end="")
    2
    Properties=species:S:1:pos:R:3:velo:R:3 Time=0.0 pbc="F F F"
    X 0.0 0.0 0.0 0.0 0.0 0.0
    X 1.5 0.0 0.0 0.0 0.0 0.0
    """
    frames = frames_of(states, net, node_fields)
    with atomic_file(file_place(path, (".xyz", ".extxyz"), "a viewer")) as stream:
        for text in _texts(frames):
            stream.write(text.encode())


def _texts(frames: Frames) -> Iterator[str]:
    """Each frame's lines."""
    fields = {"pos": frames.points, **{"velo" if name == "velocity" else name: field for name, field in frames.node_fields.items()}}
    columns = [f"{name}:{'R' if field.dtype.kind == 'f' else 'I'}:{_width(field)}" for name, field in fields.items()]
    about = f"Properties=species:S:1:{':'.join(columns)}"
    box = _box(frames)
    for i in range(len(frames)):
        n = frames.points.shape[1]
        words = np.concatenate([_words(field[i].reshape(n, -1)) for field in fields.values()], axis=1).tolist()
        yield f"{n}\n{about} Time={frames.time[i]!s} {box}\n" + "".join(f"{SPECIES} {' '.join(row)}\n" for row in words)


def _width(field: np.ndarray) -> int:
    return field.shape[2] if field.ndim == 3 else 1


def _words(table: np.ndarray) -> np.ndarray:
    """Each number in as few digits as bring the same one back; booleans as 0 and 1."""
    return (table.astype(np.int32) if table.dtype == np.bool_ else table).astype(str)


def _box(frames: Frames) -> str:
    """Sides of the periodic box. A side that does not repeat is as long as what lies along it."""
    repeats = frames.box > 0
    pbc = 'pbc="{}"'.format(" ".join("T" if r else "F" for r in repeats))
    if not repeats.any():
        return pbc
    low, high = (limit(frames.points.astype(float), axis=(0, 1)) for limit in (np.min, np.max))
    extent = np.where(high > low, high - low, 1.0)
    sides, origin = np.where(repeats, frames.box, extent), np.where(repeats, 0.0, low)
    lattice = " ".join(f"{value:.17g}" for value in np.diag(sides).ravel())
    return f'Lattice="{lattice}" Origin="{" ".join(f"{value:.17g}" for value in origin)}" {pbc}'


__all__ = ["save_xyz"]
