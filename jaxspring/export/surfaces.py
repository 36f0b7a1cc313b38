"""Surfaces for programs for meshes and printers: Wavefront OBJ, as text, and STL, binary.

OBJ keeps the nodes and their order, and springs along no triangle as lines. STL has no nodes: each triangle has corners of its own, in
single precision, which `from_mesh` merges again.

Source: the formats as in http://paulbourke.net/dataformats/
"""

from __future__ import annotations

import numpy as np

from .._arrays import Numbers
from ..archive import Path
from ..topology.base import Topology
from ..topology.mesh_checks import runs, triangles_of
from .frames import Frames, States, frames_of
from .places import write_frames


def save_obj(path: Path, states: States, net: Topology, triangles: Numbers | None = None) -> None:
    """Write a state, or the frames of a run, as OBJ: nodes in the user's order, triangles, and springs along no triangle as lines.

    One state becomes the file `path`, which ends in `.obj`. Frames become the folder `path` with `run/run_0000.obj` and so on; an older
    series there is replaced. Numbers are written with as many digits as bring the same ones back. Velocities have no place here.

    Args:
        path: the file, or for frames the folder.
        states: a `State`, a `State` with a leading axis of F frames, or what `rollout` returned with `save_every`.
        net: the topology.
        triangles: (T, 3) node numbers; None: those of the net, or the halves of a lattice's squares.

    Raises:
        TypeError: what is no state, or traced.
        ValueError: a net without triangles, a NaN, a wrong ending. Nothing has been written then.
        OSError: the folder cannot be written, or holds other files.

    >>> import tempfile
    >>> net, points = js.cloth.disc(0.15, 0.03)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     js.cloth.save_obj(folder + "/disc.obj", js.State.from_points(net, points), net)
    ...     again, places = js.from_mesh(folder + "/disc.obj")
    >>> bool((again.triangles == net.triangles).all()), bool(np.allclose(places, points, atol=1e-8))
    (True, True)
    """
    write_frames(path, ".obj", "a program for meshes", frames_of(states, net, triangles=triangles_of(net, triangles)), _obj)


def save_stl(path: Path, states: States, net: Topology, triangles: Numbers | None = None) -> None:
    """Write a state, or the frames of a run, as binary STL: triangles alone, each with its normal by the right-hand rule.

    Args:
        path: the file, which ends in `.stl`, or for frames the folder.
        states: as `save_obj` takes them.
        net: the topology.
        triangles: (T, 3) node numbers; None: those of the net, or the halves of a lattice's squares.

    Raises:
        TypeError: what is no state, or traced.
        ValueError: a net without triangles, a NaN, a wrong ending, coordinates beyond the range of single precision.
        OSError: the folder cannot be written, or holds other files.
    """
    frames = frames_of(states, net, triangles=triangles_of(net, triangles))
    if np.abs(frames.points).max() > np.finfo(np.float32).max:
        raise ValueError("a coordinate is beyond the range of single precision, in which STL is written. Use save_obj.")
    write_frames(path, ".stl", "a program for meshes", frames, _stl)


def _obj(frames: Frames, i: int) -> bytes:
    """The text of frame i."""
    triangles = frames.triangles
    sides = runs(triangles)
    n = frames.points.shape[1]
    edges = frames.edges if frames.alive is None else frames.edges[frames.alive[i]]
    keys, own = (np.sort(pairs.astype(np.int64), axis=1) @ [n, 1] for pairs in (sides, edges))
    lines = edges[~np.isin(own, keys)]
    text = [f"# time {frames.time[i]!s} s"]
    text += ["v " + " ".join(row) for row in frames.points[i].astype(str).tolist()]
    text += ["f " + " ".join(row) for row in (triangles + 1).astype(str).tolist()]
    text += ["l " + " ".join(row) for row in (lines + 1).astype(str).tolist()]
    return ("\n".join(text) + "\n").encode()


def _stl(frames: Frames, i: int) -> bytes:
    """The bytes of frame i."""
    corners = frames.points[i].astype(np.float64)[frames.triangles]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    table = np.zeros(len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    table["normal"], table["corners"] = normal / np.where(size > 0, size, 1.0), corners
    # A header that begins with "solid" would be taken for text.
    header = f"binary, time {frames.time[i]!s} s".encode()[:80].ljust(80)
    return header + np.array(len(table), "<u4").tobytes() + table.tobytes()


__all__ = ["save_obj", "save_stl"]
