"""Surfaces of triangles: pixels in them, heights by least squares, errors, bounds, files; what the command makes of a fitted mesh."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

import jaxspring as js
from jaxspring.archive import read_archive
from jaxspring.scenes.reconstruction.extras import Extras
from jaxspring.scenes.reconstruction.tin import fitted_heights, locate_pixels, surface_matrix


@pytest.fixture
def hill(rng):
    """An image with spacing and origin, and a Delaunay mesh over it."""
    y, x = np.mgrid[:40, :50]
    values = np.sin(x / 9) * np.cos(y / 7) + 0.05 * rng.standard_normal((40, 50))
    image = js.Image(values, spacing=(2.0, 3.0), origin=(100.0, -50.0))
    inner = rng.random((40, 2)) * [49, 39]
    corners = np.array([[0, 0], [49, 0], [0, 39], [49, 39]])
    points = np.concatenate([corners, inner]) * [2.0, 3.0] + [100.0, -50.0]
    return image, points, js.delaunay(points).triangles


def test_every_pixel_is_in_its_triangle(hill):
    """Weights are not negative, add up to one, and give the pixel's place back."""
    image, points, triangles = hill
    located = locate_pixels(image, points, triangles)
    assert located.outside == 0
    assert located.weights.min() >= 0
    y, x = np.mgrid[:40, :50]
    for axis, place in enumerate((100 + 2.0 * x, -50 + 3.0 * y)):
        drawn = surface_matrix(located, triangles, len(points)) @ points[:, axis]
        np.testing.assert_allclose(drawn, place.ravel(), atol=1e-9)
    fewer = locate_pixels(image, points, triangles[:-3])
    assert 0 < fewer.outside < 2000
    np.testing.assert_array_equal(np.asarray(surface_matrix(fewer, triangles[:-3], len(points)).sum(axis=1)) == 0, fewer.triangle < 0)


def test_heights_are_numpys_least_squares(hill):
    """With next to no membrane; and errors are those of NumPy."""
    image, points, triangles = hill
    matrix = surface_matrix(locate_pixels(image, points, triangles), triangles, len(points))
    truth = np.asarray(image.values).ravel()
    expected, *_ = np.linalg.lstsq(matrix.toarray(), truth, rcond=None)
    net = js.from_triangles(triangles, len(points))
    np.testing.assert_allclose(fitted_heights(matrix, truth, net, np.ones(len(truth)), membrane=1e-12), expected, atol=1e-6)
    tin = js.reconstruction.fitted_tin(image, points, triangles)
    error = matrix @ tin.points[:, 2] - truth
    found = tin.errors(image)
    assert (found.rmse, found.greatest) == pytest.approx((np.sqrt(np.mean(error**2)), np.abs(error).max()))
    assert (found.folds, found.outside) == (0, 0)
    assert 0 < found.least_angle < 60
    flat = js.reconstruction.Tin(points[:, [0, 1, 1]], triangles[:, [0, 2, 1]]).errors(image)
    assert flat.folds == 0
    folded = np.concatenate([triangles[:-1], triangles[-1:, ::-1]])
    assert js.reconstruction.Tin(tin.points, folded).errors(image).folds == 1


def test_the_greatest_error_is_bounded(hill):
    """Split until the bound holds, within the number of pixels; else it is said which pixel is beyond it."""
    image, points, triangles = hill
    whole = js.reconstruction.fitted_tin(image, points, triangles).errors(image).greatest
    found = js.reconstruction.bound_error(image, points, triangles, bound=whole / 2)
    assert found.holds
    errors = found.tin.errors(image)
    assert errors.greatest == pytest.approx(found.greatest)
    assert errors.greatest <= whole / 2
    assert errors.rmse == pytest.approx(found.rmse)
    assert errors.folds == 0
    assert len(points) < len(found.tin.points) < 2000
    np.testing.assert_array_equal(found.tin.points[: len(points), :2], points)
    few = js.reconstruction.bound_error(image, points, triangles, bound=1e-6, most=60)
    assert not few.holds
    assert len(few.tin.points) <= 60
    error = np.abs(few.tin.drawn(image) - np.asarray(image.values))
    assert few.worst == np.unravel_index(error.argmax(), error.shape)
    assert js.reconstruction.bound_error(image, points, triangles, bound=2 * whole).n_splits == 0
    with pytest.raises(ValueError, match="positive"):
        js.reconstruction.bound_error(image, points, triangles, bound=0.0)


@pytest.mark.parametrize("ending", ["obj", "ply"])
def test_programs_for_meshes_read_the_surface(hill, tmp_path, ending):
    """Nodes and triangles come back."""
    image, points, triangles = hill
    tin = js.reconstruction.fitted_tin(image, points, triangles)
    js.reconstruction.save_tin(tmp_path / f"tin.{ending}", tin)
    net, places = js.from_mesh(tmp_path / f"tin.{ending}")
    np.testing.assert_allclose(places, tin.points, rtol=1e-6)
    assert sorted(map(sorted, net.triangles.tolist())) == sorted(map(sorted, triangles.tolist()))


def test_geojson_holds_triangles_and_lines(hill, tmp_path):
    """A FeatureCollection of closed rings in three coordinates, and of lines."""
    image, points, triangles = hill
    tin = js.reconstruction.fitted_tin(image, points, triangles)
    js.reconstruction.save_tin(tmp_path / "tin.geojson", tin, lines=[np.array([[0.0, 1.0], [2.0, 3.0]])])
    found = json.loads((tmp_path / "tin.geojson").read_text())
    assert found["type"] == "FeatureCollection"
    rings = np.array([f["geometry"]["coordinates"][0] for f in found["features"] if f["geometry"]["type"] == "Polygon"])
    np.testing.assert_array_equal(rings, tin.points[triangles[:, [0, 1, 2, 0]]])
    (line,) = [f for f in found["features"] if f["properties"]["kind"] == "break"]
    assert line["geometry"] == {"type": "LineString", "coordinates": [[0.0, 1.0], [2.0, 3.0]]}
    with pytest.raises(ValueError, match="ending"):
        js.reconstruction.save_tin(tmp_path / "tin.txt", tin)


@pytest.fixture
def fitted():
    """What a fit hands on: a lattice over a fault."""
    y, x = np.mgrid[:40, :50]
    image = js.Image(np.where(x > 0.4 * y + 15, 30.0, 0.0) + 3 * np.sin(x / 12))
    ny, nx = 9, 11
    px, py = np.meshgrid(np.linspace(0, 49, nx), np.linspace(0, 39, ny))
    mesh = SimpleNamespace(x=px, y=py, z_best=np.asarray(image.sample(px, py)), flip=np.zeros((ny - 1, nx - 1), bool))
    return image, SimpleNamespace(fitted=mesh)


def test_extras_of_a_fit(fitted, tmp_path):
    """Broken and bounded: entries of the report, files, a picture."""
    image, found = fitted
    done = Extras(step=10.0, max_error=5.0, export=("obj", "geojson")).make(image, found)
    done.write(tmp_path, image)
    report = json.loads(json.dumps(done.report(), allow_nan=False))
    assert report["breaks"]["springs"] > 8
    assert 30 < report["breaks"]["length"] < 60
    # Beside the ring, which holds, nothing is gained; these rows are two of eight here.
    assert report["breaks"]["rmse"] < 0.8 * done.broken.unbroken.errors(image).rmse
    assert report["max_error"]["holds"]
    assert report["max_error"]["greatest_error"] <= 5
    assert {path.name for path in tmp_path.iterdir()} == {"breaks.npz", "breaks.png", "tin.obj", "tin.geojson"}
    arrays = read_archive(tmp_path / "breaks.npz").arrays
    assert len(arrays["broken"]) == report["breaks"]["springs"]
    assert arrays["line_ends"][-1] == len(arrays["line_points"])
    assert done.complaint() is None
    assert "springs broken along" in done.table()
    assert "hold the greatest error" in done.table()


def test_nothing_extra_writes_nothing(fitted, tmp_path):
    """As it was before."""
    image, found = fitted
    done = Extras().make(image, found)
    done.write(tmp_path, image)
    assert (done.report(), done.table(), done.complaint(), list(tmp_path.iterdir())) == ({}, "", None, [])


def test_a_bound_that_cannot_be_held_is_named(fitted):
    """With the bound, the pixel and what to do."""
    image, found = fitted
    done = Extras(max_error=1e-13).make(image, found)
    assert not done.report()["max_error"]["holds"]
    assert "--max-error 1e-13 cannot be held" in done.complaint()
    assert "at pixel (" in done.complaint()


def test_swapped_sides_follow_a_ridge(hill):
    """The squared error falls, nodes stay, nothing folds; a diagonal across a ridge is turned along it."""
    image, points, triangles = hill
    before = js.reconstruction.fitted_tin(image, points, triangles)
    after = js.reconstruction.swap_sides(image, before)
    np.testing.assert_array_equal(after.points[:, :2], before.points[:, :2])
    assert after.errors(image).rmse < before.errors(image).rmse
    assert (after.errors(image).folds, after.errors(image).outside) == (0, 0)
    assert len(after.triangles) == len(before.triangles)
    y, x = np.mgrid[:20, :20]
    ridge = js.Image(np.abs(1.0 * x - y))
    across = js.reconstruction.Tin(np.array([[0.0, 0, 0], [19, 0, 0], [0, 19, 0], [19, 19, 0]]), np.array([[0, 1, 2], [2, 1, 3]]))
    turned = js.reconstruction.swap_sides(ridge, across)
    assert {tuple(sorted(t)) for t in turned.triangles.tolist()} == {(0, 1, 3), (0, 2, 3)}
    assert turned.errors(ridge).rmse < 0.05


def test_holes_and_weights_of_an_image_are_honoured():
    """Heights, errors, splits, swaps and breaks: what lies under a hole counts nowhere, a weight of two counts as two pixels do."""
    y, x = np.mgrid[:24, :24]
    values, weights = np.where(x > 11, 1.0, 0.0) + 0.01 * y, np.where((np.hypot(x - 16, y - 8) < 4), 0.0, 1.0 + (y > 12))
    image = js.Image(np.where(weights > 0, values, np.nan), weights=weights)
    places = np.stack(np.meshgrid(np.linspace(0, 23, 7), np.linspace(0, 23, 7)), axis=-1).reshape(-1, 2)
    corners = js.delaunay(places).triangles
    located = locate_pixels(image, places, corners)
    w, flat = surface_matrix(located, corners, 49).toarray(), weights.ravel()
    reached = (w * flat[:, None]).sum(axis=0) > 0.5
    z = np.linalg.lstsq(w[:, reached] * np.sqrt(flat)[:, None], np.sqrt(flat) * values.ravel(), rcond=None)[0]
    found = js.reconstruction.fitted_tin(image, places, corners)
    drawn, known = w @ found.points[:, 2], flat > 0
    rms = np.sqrt(np.average((drawn - values.ravel())[known] ** 2, weights=flat[known]))
    assert rms <= np.sqrt(np.average((w[:, reached] @ z - values.ravel())[known] ** 2, weights=flat[known])) * (1 + 1e-4)
    errors = found.errors(image)
    assert errors.rmse == pytest.approx(rms, rel=1e-12)
    assert errors.greatest == pytest.approx(np.abs(drawn - values.ravel())[known].max(), rel=1e-12)
    assert errors.outside == 0
    # A tower stands in the hole: whoever read it would split, swap or break there.
    lied = js.Image(np.where(weights > 0, 0.01 * y, 0.0), weights=weights)
    lied = lied.with_values(lied.values.at[8, 16].set(50.0))
    assert js.reconstruction.bound_error(lied, places, corners, 1e-3).n_splits == 0
    assert js.reconstruction.break_surface(lied, places, corners, 0.5).breaks.n_broken == 0
    assert js.reconstruction.swap_sides(image, found).errors(image).rmse <= errors.rmse
    refined = js.reconstruction.refine_by_error(image, places, corners, 90)
    assert np.ptp(refined.points[49:, 0]) < 12  # along the step, not around the hole
