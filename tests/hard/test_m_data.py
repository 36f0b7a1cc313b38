"""Hard cases M1, M2, M6: data with holes, and points. A hole is never a height, and what cannot be used is named."""

import jax.numpy as jnp
import numpy as np
import pytest
import tifffile

import jaxspring as js
from jaxspring import cli
from jaxspring.images import Holes, image_from_array
from jaxspring.scenes.reconstruction import command
from jaxspring.scenes.reconstruction.loss import SurfaceError, begin
from jaxspring.scenes.reconstruction.report import measure

NODES = (8, 9)


def surface(image, nodes):
    """The regular mesh over the image, with its best heights."""
    scene = js.reconstruction.Reconstruction(image, nodes)
    return measure(SurfaceError(scene), begin(scene, jnp.ones(scene.net.n_springs)), diagonals=False)


def test_m1_ninety_percent_missing(rng):
    """A tenth of the pixels, none of them around one node: heights within a fraction of the noise-free plane, the node named."""
    y, x = np.mgrid[:40, :50].astype(np.float32)
    plane = 3 + x / 20 - y / 50
    weights = (rng.random(plane.shape) < 0.1).astype(float)
    weights[11:32, 16:38] = 0
    found = surface(js.Image(np.where(weights > 0, plane, np.nan), weights=weights), NODES)
    assert found.unreached.any()
    assert found.unreached[3, 4]
    np.testing.assert_allclose(found.z_best, 3 + found.x / 20 - found.y / 50, atol=0.05)
    with pytest.raises(ValueError, match="weights are zero everywhere"):
        js.Image(plane, weights=np.zeros_like(plane))


def test_m2_nodata_on_the_border_is_never_a_height(tmp_path, rng):
    """-9999 in float32, NaN and nodata together, up to the border: heights stay within those of the data, in files and arrays."""
    y, x = np.mgrid[:40, :50]
    heights = (500 + 300 * np.sin(x / 12) * np.cos(y / 9) + rng.normal(size=x.shape)).astype(np.float32)
    hole = np.zeros(heights.shape, bool)
    hole[:, :6] = hole[-4:, :] = hole[20:26, 20:30] = True
    stored = np.where(hole, np.float32(-9999), heights)
    stored[10, 10:14] = np.nan
    kept = ~hole & np.isfinite(stored)
    tifffile.imwrite(tmp_path / "dem.tif", stored, extratags=[(42113, "s", 0, "-9999", True)])
    np.save(tmp_path / "dem.npy", stored)
    images = [
        image_from_array(stored, holes=Holes(nodata=-9999, nan=True)),
        js.load_image(tmp_path / "dem.tif", holes=Holes(nan=True)),
        command.load(cli.parse(["fit", str(tmp_path / "dem.tif"), "--holes"])[1]),
        command.load(cli.parse(["fit", str(tmp_path / "dem.npy"), "--nodata", "-9999"])[1]),
    ]
    for image in images:
        np.testing.assert_array_equal(image.weights > 0, kept)
        np.testing.assert_array_equal(image.values, images[0].values)
        assert float(image.values.min()) >= heights[kept].min()
    found = surface(images[0], NODES)
    middle, reach = (heights[kept].max() + heights[kept].min()) / 2, np.ptp(heights[kept])
    for z in (found.z_best, found.z_sampled, found.image_best):
        assert np.abs(z - middle).max() < reach
    with pytest.raises(js.images.ImageError, match=r"no-data value -9999.*holes=Holes"):
        js.load_image(tmp_path / "dem.tif")
    # Where only the declared number is a hole, NaN is an error still.
    with pytest.raises(js.images.ImageError, match="is nan in float32"):
        js.load_image(tmp_path / "dem.tif", holes=Holes())


def test_m6_points_outside_repeated_collinear_and_far(rng):
    """Outside the outline: counted, not used. Repeated: counted. Collinear: refused. At 5e6 m as at the origin."""
    points = np.column_stack([rng.uniform(0, 10, (400, 2)), rng.normal(size=400)]).astype(np.float64)
    points[:4, :2] = [[0, 0], [10, 0], [0, 10], [10, 10]]
    x, y = np.meshgrid(np.linspace(0, 10, 4), np.linspace(0, 8, 4))
    near = js.images.PointCloud(points)
    far = js.images.PointCloud(points + np.array([5e6, 5e6, 0]))
    assert far.corner == (5e6, 5e6)
    surfaces = [js.reconstruction.point_heights(cloud, x, y) for cloud in (near, far)]
    np.testing.assert_allclose(surfaces[1].z, surfaces[0].z, atol=1e-7)
    assert surfaces[0].n_outside == (points[:, 1] > 8).sum()
    assert np.isnan(surfaces[0].residual).sum() == surfaces[0].n_outside
    assert near.n_repeated == 0
    assert js.images.PointCloud(np.concatenate([points, points])).n_repeated == 400
    line = np.column_stack([np.arange(9.0), 2 * np.arange(9.0) + 5e6, np.zeros(9)])
    for bad, message in [
        (line, "9 points lie in one place or on one line"),
        (points[:1], "lie in one place"),
        (np.zeros((0, 3)), "points is empty"),
        (np.where(np.arange(400)[:, None] == 7, np.nan, points), r"points\[7\] has x = nan \(1 of 400"),
        (points[:, :2], r"expected \(P, 3\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            js.images.PointCloud(bad)
    holed = np.where(np.arange(400)[:, None] % 50 == 7, np.nan, points)
    assert js.images.PointCloud(holed, skip_nan=True).n_skipped == 8
    with pytest.raises(ValueError, match="none of the 400 points is within the mesh"):
        js.reconstruction.point_heights(near, x + 5e6, y)
    with pytest.raises(ValueError, match=r"weights\[3\] = 0.0"):
        js.images.PointCloud(points, np.where(np.arange(400) == 3, 0.0, 1.0))
