"""The whole way from holes and from points to a fitted mesh: the command's folder, and `fit_points`."""

import json

import numpy as np
import pytest

import jaxspring as js
from jaxspring import cli

SHAPE, NODES = (25, 30), (9, 10)


@pytest.mark.slow
def test_a_holed_image_and_points_are_fitted(tmp_path, monkeypatch):
    """The command tells holes and unreached nodes, and draws; points at its pixels give the same mesh, and heights from the points."""
    monkeypatch.chdir(tmp_path)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    heights = (50 + 10 * np.sin(x / 6) * np.cos(y / 7)).astype(np.float32)
    hole = np.zeros(SHAPE, bool)
    hole[10:22, 12:26] = True
    np.save("dem.npy", np.where(hole, np.float32(-9999), heights))
    assert cli.main(["fit", "dem.npy", "--nodata", "-9999", "--nodes", "9x10", "--iterations", "2", "--out", "out"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    mesh = np.load(tmp_path / "out" / "mesh.npz")
    assert report["image"]["holes"] == hole.sum()
    assert report["unreached"] == mesh["unreached"].sum() > 0
    assert mesh["points"][:, 2].min() > 30
    assert mesh["points"][:, 2].max() < 70
    assert report["rmse"]["fitted"]["best"] < 0.6
    assert {"meshes.png", "errors.png"} <= set(report["files"])

    with monkeypatch.context() as single:  # as the file is, so that both take one program
        single.setattr("jaxspring.images.points.jnp.result_type", lambda *_: np.dtype(np.float32))
        cloud = js.images.PointCloud(np.column_stack([x[~hole], y[~hole], heights[~hole]]))
    settings = js.reconstruction.PointSettings(js.reconstruction.SpringSettings(nodes=NODES, n_iterations=2), pixels=SHAPE)
    found = js.reconstruction.fit_points(cloud, settings)
    np.testing.assert_allclose(found.x.ravel(), mesh["points"][:, 0], atol=1e-3)
    reached = ~found.unreached.ravel()
    np.testing.assert_allclose(found.z.ravel()[reached], mesh["points"][reached, 2], atol=0.02)
    assert found.rmse == pytest.approx(report["rmse"]["fitted"]["best"], rel=1e-3)
    assert found.mesh is not None
    np.testing.assert_array_equal(found.unreached, found.mesh.fitted.unreached)
