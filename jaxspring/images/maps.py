"""Maps: an image with its place, from a GeoTIFF file.

A raster of m rows is stored from the north down. Its tags tie the raster point (i, j) to the map point (X, Y) and give the pixel size:

    X = X0 + (i - i0) sx        Y = Y0 - (j - j0) sy

where a raster point is the corner of a pixel (RasterPixelIsArea, the default, so that its centre is at i + 1/2) or its centre
(RasterPixelIsPoint). Here the rows are turned, so that y grows to the north, and positions are counted from the south-western pixel:
map coordinates of millions of metres would leave float32 half a metre.

Source: OGC GeoTIFF Standard 1.1 (19-008r4), sections 7.1.2 and B.6.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from .channels import OneChannel
from .files import MAX_PIXELS, image_of, usable
from .holes import Holes
from .image import Image
from .tiff_files import read_place, read_tiff

_GEOGRAPHIC, _POINT = 2, 2


@dataclass(frozen=True)
class Map:
    """An image and where it lies.

    Attributes:
        image: values, x to the east and y to the north from the south-western pixel, spacing in the unit of the map.
        corner: map coordinates (X, Y) of that pixel's centre, in double precision: a node at (x, y) is at (X + x, Y + y).
        is_in_degrees: whether the map's unit is the degree, so that x and y are no lengths.
        epsg: number of the coordinate system, where the file names one.
    """

    image: Image
    corner: tuple[float, float]
    is_in_degrees: bool
    epsg: int | None


def load_map(
    path: str | os.PathLike[str],
    channel: OneChannel | None = None,
    *,
    page: int | None = None,
    fill: float | None = None,
    holes: Holes | None = Holes(),  # noqa: B008 (frozen)
    max_pixels: int = MAX_PIXELS,
) -> Map:
    """A GeoTIFF file with its pixel size and place (needs the extra `viz`: tifffile reads the tags, GDAL is not needed).

    Args:
        path: the file.
        channel: as in `load_image`.
        page: as in `load_image`.
        fill: as in `load_image`; pass `holes=None` with it.
        holes: what has no value; what the file declares so is a hole unless this is None.
        max_pixels: larger maps are refused before they are decoded.

    Returns:
        The image and its place.

    Raises:
        ImageError: the file cannot be used: as in `load_image`, or it has no place, or a rotated one.
        ImportError: tifffile is not installed.
    """

    def read() -> Map:
        with open(path, "rb") as stream:
            pixels = read_tiff(stream, page, max_pixels)
            stream.seek(0)
            place = _place(read_place(stream, page), pixels.values.shape[0])
        # A view turned upside down; masks turn with it.
        turned = replace(pixels, values=pixels.values[::-1], mask=None if pixels.mask is None else pixels.mask[::-1])
        image = image_of(turned, channel, place.spacing, 0.0, fill, holes)
        return Map(image, place.corner, place.is_in_degrees, place.epsg)

    return usable(path, read)


class _Place(NamedTuple):
    spacing: tuple[float, float]
    corner: tuple[float, float]
    is_in_degrees: bool
    epsg: int | None


def _place(tags: dict[str, Any] | None, n_rows: int) -> _Place:
    """Pixel size and south-western pixel from the tags. ValueError where they give none."""
    if tags is None:
        raise ValueError("it has no GeoTIFF tags, so no place on a map; use load_image and pass spacing and origin.")
    scale, tie, matrix = (tags.get(name) for name in ("ModelPixelScale", "ModelTiepoint", "ModelTransformation"))
    if matrix is not None:
        rows = np.asarray(matrix, np.float64)
        if rows[0, 1] != 0 or rows[1, 0] != 0:
            raise ValueError("its rows do not run along the map's axes (a rotated ModelTransformation); warp it to north-up first.")
        sx, sy, west, north, i0, j0 = rows[0, 0], -rows[1, 1], rows[0, 3], rows[1, 3], 0.0, 0.0
    elif scale is not None and tie is not None and np.size(tie) == 6:
        sx, sy = scale[:2]
        i0, j0, _, west, north, _ = tie
    else:
        raise ValueError("its tags give no pixel size with one tie point; warp it to a north-up grid first.")
    if not (np.isfinite([sx, sy, west, north]).all() and sx > 0 and sy > 0):
        raise ValueError(f"its pixel size is ({sx}, {sy}), but must be positive, with north up; warp it to a north-up grid first.")
    half = 0.0 if int(tags.get("GTRasterTypeGeoKey", 1)) == _POINT else 0.5
    corner = float(west + (half - i0) * sx), float(north - (n_rows - 1 + half - j0) * sy)
    is_in_degrees = int(tags.get("GTModelTypeGeoKey", 0)) == _GEOGRAPHIC
    code = int(tags.get("GeographicTypeGeoKey" if is_in_degrees else "ProjectedCSTypeGeoKey", 0))
    return _Place((float(sx), float(sy)), corner, is_in_degrees, code if 0 < code < 32767 else None)
