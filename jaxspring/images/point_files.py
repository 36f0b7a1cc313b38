"""Point clouds from files: LAS and LAZ by laspy (the extra `points`), PLY, `.npy`."""

from __future__ import annotations

import os
import pathlib
from typing import Any

import numpy as np

from ..topology.mesh_text import ply_elements
from .numpy_files import read_npy
from .points import PointCloud

MAX_POINTS = 200_000_000
"""Most points that are read unless told otherwise: 5 GB in float64."""


def load_points(path: str | os.PathLike[str], *, skip_nan: bool = False, max_points: int = MAX_POINTS) -> PointCloud:
    """Points from a LAS or LAZ file (needs the extra `points`), the vertices of a PLY file, or an `.npy` array (P, 3) or (P, 4).

    Coordinates are those of the file, LAS's scale and offset applied. Points that LAS marks as withheld are left out. A fourth column of an
    array, or a PLY property `weight`, is taken as weights.

    Args:
        path: the file; its kind is told by the suffix.
        skip_nan: as in `PointCloud`.
        max_points: larger files are refused.

    Returns:
        The points.

    Raises:
        ImportError: laspy or lazrs is not installed: pip install 'jaxspring[points]'.
        FileNotFoundError: no such file.
        ValueError: a file of another kind, damaged or too large; as `PointCloud`.
    """
    path = pathlib.Path(path)
    reader = {".las": _read_las, ".laz": _read_las, ".ply": _read_ply, ".npy": _read_npy}.get(path.suffix.lower())
    if reader is None:
        raise ValueError(f"{path}: points are read from .las, .laz, .ply and .npy. Read others yourself, and pass PointCloud(points).")
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    points, weights = reader(path, max_points)
    try:
        return PointCloud(points, weights, skip_nan)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _read_las(path: pathlib.Path, max_points: int) -> tuple[np.ndarray, None]:
    try:
        import laspy
    except ImportError as error:
        raise ImportError("load_points reads LAS and LAZ with laspy, which is missing. Run: pip install 'jaxspring[points]'") from error
    if path.suffix.lower() == ".laz" and not laspy.LazBackend.detect_available():
        raise ImportError("LAZ needs lazrs beside laspy, which is not installed. Run: pip install 'jaxspring[points]'")
    try:
        with laspy.open(path) as file:
            if file.header.point_count > max_points:
                raise ValueError(f"it holds {file.header.point_count} points, more than max_points = {max_points}")
            found = file.read()
        points = np.stack([np.asarray(found[name], np.float64) for name in "xyz"], axis=-1)
        names = set(found.point_format.dimension_names)
        is_kept = ~np.asarray(found["withheld"], bool) if "withheld" in names else np.ones(len(points), bool)
    except Exception as error:  # decoders of damaged files raise almost anything
        raise ValueError(f"{path} cannot be read: {error}.") from error
    return points[is_kept], None


def _read_ply(path: pathlib.Path, max_points: int) -> tuple[np.ndarray, Any]:
    vertex = ply_elements(path).get("vertex", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise ValueError(f"{path} has no x, y and z of vertices.")
    if len(vertex["x"]) > max_points:
        raise ValueError(f"{path} holds {len(vertex['x'])} points, more than max_points = {max_points}.")
    return np.stack([np.asarray(vertex[name], np.float64) for name in "xyz"], axis=-1), vertex.get("weight")


def _read_npy(path: pathlib.Path, max_points: int) -> tuple[np.ndarray, Any]:
    with open(path, "rb") as stream:
        try:
            # The reader holds the header against the size of the file; more numbers than bytes are in none.
            size = path.stat().st_size
            table = np.asarray(read_npy(stream, size, size))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    if table.ndim != 2 or table.shape[1] not in (3, 4):
        raise ValueError(f"{path} holds an array of shape {table.shape}; expected (P, 3), or (P, 4) with weights.")
    if len(table) > max_points:
        raise ValueError(f"{path} holds {len(table)} points, more than max_points = {max_points}.")
    return table[:, :3], table[:, 3] if table.shape[1] == 4 else None
