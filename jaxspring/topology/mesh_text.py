"""Surface meshes as files hold them: vertices, polygons and lines, read from OBJ, OFF and PLY.

Nothing is merged, cut or left out here, and a vertex that does not exist is an error that names the file, the face and the number that
stands there. OBJ counts vertices from 1, or back from the last one read; OFF and PLY from 0.
"""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class RawMesh:
    """What a file holds.

    Attributes:
        points: (N, 3) vertices.
        sizes: (F,) number of corners of each polygon.
        corners: vertices of all polygons, one after the other.
        lines: (L, 2) vertices that a line joins.
    """

    points: np.ndarray
    sizes: np.ndarray
    corners: np.ndarray
    lines: np.ndarray


def raw_mesh(path: pathlib.Path, points: Any, faces: Any, lines: Any = (), places: list[str] | None = None, first: int = 0) -> RawMesh:
    """The mesh, once its numbers are checked.

    Args:
        path: named in errors.
        points: (N, 3) vertices.
        faces: vertices of each polygon, or an (F, n) array of them, counted from 0.
        lines: (L, 2) vertices.
        places: where each face stands in the file.
        first: how the file numbers its first vertex.

    Raises:
        ValueError: a vertex that does not exist, a coordinate that is not finite, a face of fewer than three corners.
    """
    points = np.asarray(points, float).reshape(-1, 3)
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        vertex = int(np.argmax(bad))
        raise ValueError(f"{path}: vertex {vertex + first} = {tuple(points[vertex].tolist())} must be finite. Fix it in the file.")
    if isinstance(faces, np.ndarray):
        sizes, corners = np.full(len(faces), faces.shape[1], np.int64), faces.ravel().astype(np.int64)
    else:
        sizes = np.array([len(face) for face in faces], np.int64)
        corners = np.concatenate([np.asarray(face, np.int64) for face in faces]) if faces else np.zeros(0, np.int64)
    lines = np.asarray(lines, np.int64).reshape(-1, 2)
    last = len(points) - 1 + first
    for name, owner, numbers in (
        ("face", np.repeat(np.arange(len(sizes)), sizes), corners),
        ("line", np.repeat(np.arange(len(lines)), 2), lines.ravel()),
    ):
        wrong = (numbers < 0) | (numbers >= len(points))
        if wrong.any():
            i = int(np.argmax(wrong))
            place = f" ({places[owner[i]]})" if places and name == "face" else ""
            raise ValueError(
                f"{path}: {name} {owner[i]}{place} names vertex {numbers[i] + first}, but the file holds {len(points)} vertices, numbered "
                f"{first} to {last}. Unchecked, another vertex would be joined instead. Fix the file, or write it anew."
            )
    if (sizes < 3).any():
        face = int(np.argmax(sizes < 3))
        place = f" ({places[face]})" if places else ""
        raise ValueError(f"{path}: face {face}{place} has {sizes[face]} corners; a face needs at least 3.")
    return RawMesh(points, sizes, corners, lines)


def read_obj(path: pathlib.Path) -> RawMesh:
    """Vertices, faces and lines of a Wavefront OBJ; textures, normals, groups and materials are passed over."""
    points: list[list[float]] = []
    faces: list[list[int]] = []
    lines: list[tuple[int, int]] = []
    places: list[str] = []

    def vertex(text: str) -> int:
        number = int(text.split("/", 1)[0])
        if number == 0:
            raise ValueError("names vertex 0, but OBJ counts vertices from 1")
        if number < -len(points):
            raise ValueError(f"names vertex {number}, but only {len(points)} stand above it")
        return number - 1 if number > 0 else len(points) + number

    for number, words in _rows(path):
        try:
            if words[0] == "v":
                if len(words) < 4:
                    raise ValueError("a vertex has three coordinates")
                points.append([float(word) for word in words[1:4]])
            elif words[0] in ("f", "fo"):
                faces.append([vertex(word) for word in words[1:]])
                places.append(f"line {number}")
            elif words[0] == "l":
                chain = [vertex(word) for word in words[1:]]
                lines += itertools.pairwise(chain)
        except ValueError as error:
            what = f"face {len(faces)}, " if words[0] in ("f", "fo") else ""
            raise ValueError(f"{path}: {what}line {number}, {' '.join(words)!r:.60}: {error}.") from error
    return raw_mesh(path, points, faces, lines, places, first=1)


def read_off(path: pathlib.Path) -> RawMesh:
    """Vertices and faces of a text file in the Object File Format; colours and normals are passed over."""
    rows = _rows(path)
    number, words = next(rows, (0, [""]))
    if not words[0].endswith("OFF"):
        raise ValueError(f"{path} does not begin with OFF.")
    if "BINARY" in words or words[0].startswith(("4", "n")) or words[0].endswith("nOFF"):
        raise ValueError(f"{path} is {' '.join(words)}; only text files with three coordinates are read. Write it as OFF, PLY or OBJ.")
    try:
        counts = words[1:] or next(rows)[1]
        n_points, n_faces = int(counts[0]), int(counts[1])
        points, faces, places = [], [], []
        for _ in range(n_points):
            number, words = next(rows)
            points.append([float(words[i]) for i in range(3)])
        for _ in range(n_faces):
            number, words = next(rows)
            faces.append([int(words[1 + i]) for i in range(int(words[0]))])
            places.append(f"line {number}")
    except StopIteration as error:
        raise ValueError(f"{path} ends after line {number}, before all that its header promises.") from error
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path}: line {number}, {' '.join(words)!r:.60}, cannot be read: {error}.") from error
    return raw_mesh(path, points, faces, (), places)


def ply_elements(path: pathlib.Path) -> dict[str, dict[str, Any]]:
    """The properties of every element of a Stanford PLY, text or binary."""
    data = path.read_bytes()
    order, elements, at = _ply_header(path, data)
    words = data[at:].split() if not order else []
    found: dict[str, dict[str, Any]] = {}
    try:
        for name, count, properties in elements:
            if order:
                found[name], at = _binary_rows(data, at, order, count, properties)
            else:
                found[name], words = _text_rows(words, count, properties)
    except (ValueError, IndexError) as error:
        raise ValueError(f"{path} cannot be read, or ends before all that its header promises: {error}.") from error
    return found


def read_ply(path: pathlib.Path) -> RawMesh:
    """Vertices, faces and edges of a Stanford PLY, text or binary; all else is passed over."""
    found = ply_elements(path)
    vertex, face, edge = (found.get(name, {}) for name in ("vertex", "face", "edge"))
    if not {"x", "y", "z"} <= set(vertex):
        raise ValueError(f"{path} has no x, y and z of vertices.")
    faces = next((face[name] for name in ("vertex_indices", "vertex_index") if name in face), [])
    if not len(faces) and "tristrips" in found:
        raise ValueError(f"{path} holds strips of triangles. Write its faces one by one.")
    lines = np.stack([edge["vertex1"], edge["vertex2"]], axis=-1) if {"vertex1", "vertex2"} <= set(edge) else ()
    return raw_mesh(path, np.stack([vertex[name] for name in "xyz"], axis=-1), faces, lines)


READERS = {".obj": read_obj, ".off": read_off, ".ply": read_ply}


def _rows(path: pathlib.Path) -> Iterator[tuple[int, list[str]]]:
    """(number, words) of the lines that hold any: without comments, continued where one ends in a backslash."""
    pending: list[str] = []
    number = 0
    # Latin-1 knows every byte; names and comments in other alphabets are not read anyway.
    for number, line in enumerate(path.read_text(encoding="latin-1").removeprefix("\xef\xbb\xbf").splitlines(), 1):
        line = line.split("#", 1)[0].rstrip()
        pending += line.removesuffix("\\").split()
        if pending and not line.endswith("\\"):
            yield number, pending
            pending = []
    if pending:
        yield number, pending


def _ply_header(path: pathlib.Path, data: bytes) -> tuple[str, list[tuple[str, int, list[tuple[str, str, str]]]], int]:
    """The order of the bytes ("" in a text), (name, count, properties) of each element, and where the header ends.

    A property is (name, type, type of the count of a list or "").
    """
    end = data.find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise ValueError(f"{path} does not begin with ply, or its header does not end.")
    order, elements = None, []
    for line in data[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        try:
            if words[:1] == ["format"]:
                order = PLY_ORDERS[words[1]]
            elif words[:1] == ["element"]:
                elements.append((words[1], int(words[2]), []))
            elif words[:2] == ["property", "list"]:
                elements[-1][2].append((words[4], PLY_TYPES[words[3]], PLY_TYPES[words[2]]))
            elif words[:1] == ["property"]:
                elements[-1][2].append((words[2], PLY_TYPES[words[1]], ""))
        except (KeyError, IndexError, ValueError) as error:
            raise ValueError(f"{path}: {line!r:.60} in its header cannot be read.") from error
    if order is None:
        raise ValueError(f"{path} does not say its format in its header.")
    return order, elements, data.index(b"\n", end) + 1


def _text_rows(words: list[bytes], count: int, properties: list[tuple[str, str, str]]) -> tuple[dict[str, Any], list[bytes]]:
    """The properties of `count` rows by name, and what follows them."""
    width = len(properties)
    if not any(of_count for _, _, of_count in properties):
        table = np.array(words[: count * width], np.float64).reshape(count, width)
        return {name: table[:, i] for i, (name, _, _) in enumerate(properties)}, words[count * width :]
    found: dict[str, list[Any]] = {name: [] for name, _, _ in properties}
    at = 0
    for _ in range(count):
        for name, _, of_count in properties:
            n = int(words[at]) if of_count else 1
            at += bool(of_count)
            if at + n > len(words):
                raise IndexError("there are too few numbers")
            found[name].append([float(word) for word in words[at : at + n]] if of_count else float(words[at]))
            at += n
    return found, words[at:]


def _binary_rows(data: bytes, at: int, order: str, count: int, properties: list[tuple[str, str, str]]) -> tuple[dict[str, Any], int]:
    """The properties of `count` rows by name, and where they end."""
    columns: list[Any] = []
    lengths, start = {}, at
    for name, of_item, of_count in properties:
        n = 1
        if of_count and count:
            # Most often all rows are as long as the first.
            n = lengths[name] = int(np.frombuffer(data, order + of_count, 1, at)[0])
            columns.append((f"number of {name}", order + of_count))
            at += np.dtype(of_count).itemsize
        columns.append((name, order + of_item, (n,)) if of_count else (name, order + of_item))
        at += n * np.dtype(of_item).itemsize
    row = np.dtype(columns)
    if len(data) >= start + count * row.itemsize:
        table = np.frombuffer(data, row, count, start)
        if all((table[f"number of {name}"] == n).all() for name, n in lengths.items()):
            return {name: table[name] for name, _, _ in properties}, start + count * row.itemsize
    if not lengths:
        raise IndexError("there are too few bytes")
    found: dict[str, list[Any]] = {name: [] for name, _, _ in properties}
    at = start
    for _ in range(count):
        for name, of_item, of_count in properties:
            n = 1
            if of_count:
                n = int(np.frombuffer(data, order + of_count, 1, at)[0])
                at += np.dtype(of_count).itemsize
            values = np.frombuffer(data, order + of_item, n, at)
            found[name].append(values if of_count else values[0])
            at += n * np.dtype(of_item).itemsize
    return found, at


__all__ = ["READERS", "RawMesh", "raw_mesh", "read_obj", "read_off", "read_ply"]
