"""Files of a TIN: OBJ and PLY for programs for meshes, GeoJSON for maps.

In GeoJSON each triangle is a Feature with a Polygon of four positions [x, y, z], the last the first again; each break line is a LineString.
Coordinates are those of the image, by its spacing and origin: a reader that follows the standard takes them for degrees of longitude and
latitude, so set the coordinate system there.

Source: RFC 7946, The GeoJSON Format.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import jax
import numpy as np

from ...archive import Path, atomic_file
from ...export.places import file_place
from ...export.ply import save_ply
from ...export.surfaces import save_obj
from ...state import State
from .tin import Tin

ENDINGS = (".obj", ".ply", ".geojson")


def save_tin(path: Path, tin: Tin, lines: Sequence[np.ndarray] = ()) -> None:
    """Write a TIN; the ending of the path says in which format.

    Args:
        path: the file: `.obj`, `.ply`, or `.geojson`.
        tin: nodes, triangles, heights.
        lines: break lines, (M, 2) points each; written in GeoJSON alone.

    Raises:
        ValueError: another ending.
        OSError: the file cannot be written.

    >>> import tempfile, pathlib
    >>> tin = Tin(np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [0.0, 1.0, 7.5]]), np.array([[0, 1, 2]]))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_tin(folder + "/hill.geojson", tin)
    ...     json.loads(pathlib.Path(folder, "hill.geojson").read_text())["features"][0]["geometry"]["coordinates"][0][2]
    [0.0, 1.0, 7.5]
    """
    place = file_place(path, ENDINGS, "a program for meshes or maps")
    if place.suffix.lower() == ".geojson":
        with atomic_file(place) as stream:
            stream.write(_geojson(tin, lines))
        return
    net = tin.net
    with jax.enable_x64(True):  # single precision would round map coordinates to half a metre
        state = State.from_points(net, tin.points)
        if place.suffix.lower() == ".obj":
            save_obj(place, state, net)
        else:
            save_ply(place, state, net, triangles=net.triangles)


def _geojson(tin: Tin, lines: Sequence[np.ndarray]) -> bytes:
    rings = tin.points[tin.triangles[:, [0, 1, 2, 0]]].tolist()
    shapes = [{"type": "Polygon", "coordinates": [ring]} for ring in rings]
    shapes += [{"type": "LineString", "coordinates": np.asarray(line, float).tolist()} for line in lines]
    kinds = ["triangle"] * len(rings) + ["break"] * len(lines)
    features = [{"type": "Feature", "properties": {"kind": kind}, "geometry": s} for kind, s in zip(kinds, shapes, strict=True)]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False).encode()


__all__ = ["ENDINGS", "save_tin"]
