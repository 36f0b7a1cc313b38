"""Maps and terrain tiles: values, holes, pixel size and place, against tags written by hand and heights known in advance."""

import numpy as np
import PIL.Image
import pytest
import tifffile

from jaxspring.images import Holes, ImageError, TerrainRGB, Terrarium, image_from_array, load_map
from jaxspring.images.files import load_image

# Bytes of a tile and the height [m], from the two formulas worked out by hand.
TERRAIN_RGB = [((1, 134, 160), 0.0), ((0, 0, 0), -10000.0), ((1, 252, 2), 3_005.0 + 0.0), ((255, 255, 255), 1667721.5)]
TERRARIUM = [((128, 0, 0), 0.0), ((127, 255, 128), -0.5), ((162, 144, 0), 8848.0), ((0, 0, 0), -32768.0)]


@pytest.mark.parametrize(("channel", "table"), [(TerrainRGB(), TERRAIN_RGB), (Terrarium(), TERRARIUM)])
def test_tiles_are_heights(tmp_path, channel, table):
    """Every height exactly, from a PNG with and without opacity; bytes that are none are refused."""
    colours = np.array([[colour for colour, _ in table]] * 2, np.uint8)
    heights = np.array([[height for _, height in table]] * 2)
    PIL.Image.fromarray(colours).save(tmp_path / "tile.png")
    np.testing.assert_allclose(load_image(tmp_path / "tile.png", channel).values, heights, rtol=1e-14, atol=1e-9)
    opacity = np.full((2, 4, 1), 255, np.uint8)
    opacity[1, 2] = 0
    PIL.Image.fromarray(np.concatenate([colours, opacity], axis=-1)).save(tmp_path / "cut.png")
    cut = load_image(tmp_path / "cut.png", channel, holes=Holes(nodata=float(heights[0, 3])))
    assert cut.weights.tolist() == [[1, 1, 1, 0], [1, 1, 0, 0]]
    with pytest.raises(ValueError, match="three channels of 8 bits"):
        image_from_array(colours.astype(np.uint16), channel)
    with pytest.raises(ValueError, match="three channels of 8 bits"):
        image_from_array(colours[..., :2], channel)


def tags(scale=(30.0, 20.0, 0.0), tie=(0.0, 0.0, 0.0, 500_000.0, 5_000_000.0, 0.0), raster=1, model=1, matrix=None):
    """GeoTIFF's tags by their numbers."""
    keys = (1, 1, 0, 3, 1024, 0, 1, model, 1025, 0, 1, raster, 3072 if model == 1 else 2048, 0, 1, 32633 if model == 1 else 4326)
    found = [(34735, "H", len(keys), keys, True)]
    if matrix is None:
        found += [(33550, "d", 3, scale, True), (33922, "d", len(tie), tie, True)]
    else:
        found += [(34264, "d", 16, matrix, True)]
    return found


@pytest.mark.parametrize("dtype", ["float32", "uint16", "int16"])
def test_a_map_has_its_place(tmp_path, dtype):
    """North is up, the origin is the south-western pixel's centre, its map coordinates are in double precision; nodata are holes."""
    values = np.arange(12).reshape(3, 4).astype(dtype)
    extra = (42113, "s", 0, "7", True)
    tifffile.imwrite(tmp_path / "dem.tif", values, extratags=[*tags(), extra])
    found = load_map(tmp_path / "dem.tif")
    assert found.corner == (500_015.0, 5_000_000.0 - 2.5 * 20)
    assert (found.epsg, found.is_in_degrees) == (32633, False)
    assert [float(a) for a in found.image.spacing] == [30.0, 20.0]
    assert found.image.sample(30.0, 40.0) == 1.0  # one pixel east, two north of the corner: the first row of the file
    assert found.image.weights.tolist() == [[1, 1, 1, 1], [1, 1, 1, 0], [1, 1, 1, 1]]
    assert load_map(tmp_path / "dem.tif", holes=None, fill=-1.0).image.values[1, 3] == -1
    tifffile.imwrite(tmp_path / "point.tif", values, extratags=tags(raster=2, tie=(1.0, 2.0, 0.0, 100.0, 50.0, 0.0)))
    assert load_map(tmp_path / "point.tif").corner == (70.0, 50.0)
    assert load_map(tmp_path / "point.tif").image.weights is None


def test_matrices_and_degrees(tmp_path):
    """A transformation along the axes gives the same; degrees are said."""
    values = np.ones((3, 4), np.float32)
    matrix = (30.0, 0, 0, 500_000.0, 0, -20.0, 0, 5_000_000.0, 0, 0, 0, 0, 0, 0, 0, 1)
    tifffile.imwrite(tmp_path / "a.tif", values, extratags=tags(matrix=matrix))
    assert load_map(tmp_path / "a.tif").corner == (500_015.0, 4_999_950.0)
    tifffile.imwrite(tmp_path / "b.tif", values, extratags=tags(model=2))
    found = load_map(tmp_path / "b.tif")
    assert (found.is_in_degrees, found.epsg) == (True, 4326)


@pytest.mark.parametrize(
    ("extratags", "message"),
    [
        ([], "no GeoTIFF tags"),
        (tags(matrix=(30.0, 1.0, 0, 0, -1.0, -20.0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1)), "do not run along the map's axes"),
        (tags(scale=(30.0, -20.0, 0.0)), "must be positive, with north up"),
        (tags(tie=(0.0,) * 12), "no pixel size with one tie point"),
        ([*tags(), (274, "H", 1, 6, True)], "turned by its orientation tag"),
    ],
)
def test_maps_without_a_usable_place_are_refused(tmp_path, extratags, message):
    """In one line that names the file and what to do."""
    tifffile.imwrite(tmp_path / "dem.tif", np.ones((3, 4), np.float32), extratags=extratags)
    with pytest.raises(ImageError, match=message) as raised:
        load_map(tmp_path / "dem.tif")
    assert "\n" not in str(raised.value)
