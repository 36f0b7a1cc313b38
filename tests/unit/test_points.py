"""Scattered points: the cloud, its files, and the best heights over them, against dense algebra and a general minimiser."""

import dataclasses
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxspring as js
from jaxspring.images import PointCloud, load_points
from jaxspring.reconstruction import point_heights
from jaxspring.scenes.reconstruction.points import best_of_points, places_of
from jaxspring.scenes.reconstruction.raster import PixelGrid

NODES = (5, 6)
N = 160


class Problem:
    """Noisy points with outliers and weights over a wavy surface, on a mesh that is not even."""

    def __init__(self):
        rng = np.random.default_rng(3)
        self.xy = rng.uniform(0, [50, 40], (N, 2))
        self.z = np.sin(self.xy[:, 0] / 15) + 0.02 * self.xy[:, 1] + rng.normal(0, 0.05, N)
        self.z[rng.random(N) < 0.15] += 4
        self.weights = rng.uniform(0.5, 2, N)
        self.cloud = PointCloud(np.column_stack([self.xy, self.z]), self.weights)
        corner = np.array(self.cloud.corner)
        span = self.xy.max(axis=0) - corner
        x, y = np.meshgrid(np.linspace(0, span[0], NODES[1]), np.linspace(0, span[1], NODES[0]))
        x[:, 1:-1] += rng.uniform(-2, 2, x[:, 1:-1].shape)
        y[1:-1] += rng.uniform(-2, 2, y[1:-1].shape)
        self.x, self.y = x, y
        self.flip = rng.random((NODES[0] - 1, NODES[1] - 1)) < 0.5
        self.hats = self.barycentric(self.xy - corner)

    def barycentric(self, places):
        """(P, nodes) weights, triangle by triangle: a point is where all three are positive."""
        index = np.arange(NODES[0] * NODES[1]).reshape(NODES)
        hats = np.zeros((len(places), index.size))
        for j in range(NODES[0] - 1):
            for i in range(NODES[1] - 1):
                nw, ne, sw, se = index[j, i], index[j, i + 1], index[j + 1, i], index[j + 1, i + 1]
                for corners in ((nw, ne, sw), (ne, se, sw)) if self.flip[j, i] else ((nw, ne, se), (nw, se, sw)):
                    corners = list(corners)
                    matrix = np.stack([self.x.ravel()[corners], self.y.ravel()[corners], np.ones(3)])
                    weights = np.linalg.solve(matrix, np.column_stack([places, np.ones(len(places))]).T)
                    inside = (weights >= -1e-9).all(axis=0)
                    hats[inside] = 0
                    hats[np.ix_(inside, corners)] = weights[:, inside].T
        return hats

    def membrane(self, share):
        """r L, with r a share of the points' weight per node."""
        net = js.lattice(NODES)
        apart = np.zeros((net.n_springs, net.n_nodes))
        for row, (tail, head) in enumerate(np.asarray(net.edges)):
            apart[row, [tail, head]] = -1, 1
        return share * self.weights.sum() / net.n_nodes * apart.T @ apart


@pytest.fixture(scope="module")
def problem():
    return Problem()


def test_least_squares_are_those_of_dense_algebra(problem):
    """Heights, residuals and error bars of weighted points through barycentric weights, against NumPy."""
    found = point_heights(problem.cloud, problem.x, problem.y, problem.flip)
    matrix = (problem.hats.T * problem.weights) @ problem.hats + problem.membrane(1e-4)
    z = np.linalg.solve(matrix, problem.hats.T @ (problem.weights * problem.z))
    np.testing.assert_allclose(np.ravel(found.z), z, atol=1e-9)
    np.testing.assert_allclose(found.residual, problem.hats @ z - problem.z, atol=1e-9)
    np.testing.assert_allclose(np.ravel(found.error_bars(0.3)), 0.3 * np.sqrt(np.diag(np.linalg.inv(matrix))), rtol=1e-8)
    assert (found.n_outside, found.n_reweightings, found.is_settled, found.unreached.any()) == (0, 0, True, False)


def test_hubers_loss_is_minimised_and_bears_outliers(problem):
    """The heights minimise Huber's energy, as BFGS finds its minimum; a sixth of outliers leaves half of them within 0.1 of the surface."""
    delta = 0.07
    found = point_heights(problem.cloud, problem.x, problem.y, problem.flip, huber=delta)
    stiff = problem.membrane(1e-4)

    def energy(z):
        e = problem.hats @ z - problem.z
        rho = np.where(np.abs(e) <= delta, e**2 / 2, delta * (np.abs(e) - delta / 2))
        slope = problem.hats.T @ (problem.weights * np.clip(e, -delta, delta)) + stiff @ z
        return problem.weights @ rho + z @ stiff @ z / 2, slope

    least = scipy.optimize.minimize(energy, np.zeros(found.z.size), jac=True, method="BFGS", options={"gtol": 1e-9, "maxiter": 2000})
    np.testing.assert_allclose(np.ravel(found.z), least.x, atol=1e-7)
    corner = problem.cloud.corner
    truth = np.sin((problem.x + corner[0]) / 15) + 0.02 * (problem.y + corner[1])
    assert np.median(np.abs(found.z - truth)) < 0.1
    assert np.median(np.abs(point_heights(problem.cloud, problem.x, problem.y, problem.flip).z - truth)) > 0.4
    assert found.is_settled
    np.testing.assert_allclose(found.share, np.minimum(1, delta / np.abs(found.residual)), rtol=1e-6)


@pytest.mark.slow
def test_heights_have_the_derivatives_of_the_minimum(problem):
    """By points, weights and nodes, with Huber's loss, against central differences."""
    cloud, flip = problem.cloud, jnp.asarray(problem.flip)
    extent = float(jnp.ptp(cloud.z))
    values = (cloud.z - jnp.min(cloud.z)) / extent
    start = places_of(cloud, jnp.asarray(problem.x), jnp.asarray(problem.y))[2]
    rng = np.random.default_rng(8)
    turns = [jnp.asarray(rng.normal(size=a.shape)) for a in (values, values, problem.x, problem.z[: NODES[0] * NODES[1]].reshape(NODES))]

    @jax.jit
    @jax.value_and_grad
    def looked_at(t):
        grid = PixelGrid(cloud.x, cloud.y, (1, N), cloud.weights + t * 0.1 * turns[1])
        x = jnp.asarray(problem.x).at[1:-1, 1:-1].add(t * turns[2][1:-1, 1:-1])
        found = best_of_points(grid, values + t * turns[0], start, x, jnp.asarray(problem.y), flip, jnp.asarray(1e-3), jnp.asarray(0.02))
        return jnp.sum(found.z * turns[3])

    h, (_, slope) = 1e-6, looked_at(0.0)
    difference = (looked_at(h)[0] - looked_at(-h)[0]) / (2 * h)
    assert float(slope) == pytest.approx(float(difference), rel=1e-5)


def test_points_become_an_image_with_holes():
    """Weighted means or medians in the pixel around, weights added up, holes where no point is."""
    points = np.array([[0, 0, 1], [0.2, 0.1, 3], [2, 0, 5], [2, 1, 7], [0, 1, 2], [0.1, 1.2, 2], [0.1, 1.1, 50]], float)
    image = PointCloud(points, np.array([1, 3, 1, 1, 1, 1, 1.0])).image((2, 3), outline=(0, 0, 2, 1))
    np.testing.assert_allclose(image.weights, [[4, 0, 1], [3, 0, 1]])
    np.testing.assert_allclose(np.asarray(image.values)[:, [0, 2]], [[2.5, 5], [18, 7]])
    assert PointCloud(points).image((2, 3), (0, 0, 2, 1), median=True).values[1, 0] == 2
    assert PointCloud(points).image().shape[0] >= 2


@pytest.mark.parametrize("ending", ["ply", "npy", "las", "laz"])
def test_files_of_points(tmp_path, ending, rng):
    """Read as they were written, in double precision; LAS to its scale."""
    points = rng.uniform(0, 100, (50, 3)) + np.array([5e6, 4e5, 0])
    path = tmp_path / f"cloud.{ending}"
    if ending == "npy":
        np.save(path, np.column_stack([points, np.full(50, 2.0)]))
    elif ending == "ply":
        names = "".join(f"property double {a}\n" for a in "xyz")
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex 50\n{names}end_header\n"
        path.write_bytes(head.encode() + points.astype("<f8").tobytes())
    else:
        laspy = pytest.importorskip("laspy")
        pytest.importorskip("lazrs")
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = np.full(3, 0.001), np.array([5e6, 4e5, 0])
        file = laspy.LasData(header)
        file.x, file.y, file.z = points.T
        file.withheld = np.arange(50) == 7
        file.write(path)
    cloud = load_points(path)
    right = points if ending in ("ply", "npy") else np.delete(points, 7, axis=0)
    assert cloud.n_points == len(right)
    np.testing.assert_allclose(cloud.z, right[:, 2], atol=6e-4)
    np.testing.assert_allclose(np.asarray(cloud.x) + cloud.corner[0], right[:, 0], rtol=0, atol=6e-4)
    assert (cloud.weights is not None) == (ending == "npy")


def test_files_that_are_none_are_refused(tmp_path, monkeypatch):
    """Each in a message that names the file, or the package to install."""
    (tmp_path / "a.txt").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"a\.txt: points are read from"):
        load_points(tmp_path / "a.txt")
    with pytest.raises(FileNotFoundError, match=r"b\.ply"):
        load_points(tmp_path / "b.ply")
    np.save(tmp_path / "c.npy", np.ones((4, 2)))
    with pytest.raises(ValueError, match=r"c\.npy holds an array of shape \(4, 2\)"):
        load_points(tmp_path / "c.npy")
    np.save(tmp_path / "d.npy", np.array([[0, 0, 1], [1, 0, np.nan], [0, 1, 2], [2, 2, 1]]))
    with pytest.raises(ValueError, match=r"d\.npy: points\[1\] has z = nan"):
        load_points(tmp_path / "d.npy")
    assert load_points(tmp_path / "d.npy", skip_nan=True).n_skipped == 1
    with pytest.raises(ValueError, match="max_points"):
        load_points(tmp_path / "d.npy", max_points=2)
    (tmp_path / "e.las").write_bytes(b"LASF but no more")
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ImportError, match=r"jaxspring\[points\]"):
        load_points(tmp_path / "e.las")


def test_a_damaged_las_file_is_refused(tmp_path):
    """In a ValueError that names it."""
    pytest.importorskip("laspy")
    (tmp_path / "e.las").write_bytes(b"LASF but no more")
    with pytest.raises(ValueError, match=r"e\.las cannot be read"):
        load_points(tmp_path / "e.las")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"huber": 0.0}, "huber = 0.0"),
        ({"membrane": -1.0}, "membrane = -1.0"),
        ({"x": np.zeros(NODES)}, "folded over or have no area"),
        ({"y": np.zeros((3, 3))}, r"y has shape \(3, 3\)"),
        ({"flip": np.zeros(NODES, bool)}, "one per cell"),
    ],
)
def test_meshes_that_hold_no_points_are_refused(problem, change, message):
    """By name."""
    with pytest.raises(ValueError, match=message):
        point_heights(**{"cloud": problem.cloud, "x": problem.x, "y": problem.y, **change})


def test_the_cloud_is_a_tree(problem):
    """Heights may be replaced, traced or not; what is counted stays."""
    cloud = problem.cloud
    assert jax.jit(lambda z: cloud.with_heights(z).z.sum())(cloud.z) == pytest.approx(float(cloud.z.sum()))
    assert eqx.tree_equal(cloud, PointCloud(np.column_stack([problem.xy, problem.z]), problem.weights))
    assert not dataclasses.is_dataclass(PointCloud) or cloud.n_points == N
