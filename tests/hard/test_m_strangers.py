"""What strangers ran into with surfaces and lenses: each with the value that was expected."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image as Picture
from scipy.ndimage import map_coordinates

import jaxspring as js

R = js.reconstruction
YY, XX = np.mgrid[:40, :60]
WAVES = 10 * np.sin(XX / 6) * np.cos(YY / 7)
NODES = np.stack(np.meshgrid(np.linspace(0, 59, 9), np.linspace(0, 39, 7)), -1).reshape(-1, 2)
TRIANGLES = np.asarray(js.delaunay(NODES * [1, 1.0001]).triangles)


def test_m2_a_slope_does_not_break_in_a_hole():
    """Without data a break would cost nothing: it has the price that it has beside the hole."""
    net = js.lattice((21, 21))
    x, y = np.asarray(net.grid()).T
    hole = (abs(x - 10) < 4) & (abs(y - 10) < 4)
    for step in (1.0, 1e4):
        found = R.find_breaks(net, net.grid(), 0.1 * x, 1.0, np.where(hole, 0.0, 0.3), step)
        whole = R.find_breaks(net, net.grid(), 0.1 * x, 1.0, 0.3, step)
        assert found.n_broken == 0
        assert found.steepest == pytest.approx(whole.steepest, rel=1e-12)


@pytest.mark.parametrize("scale", [1e3, 1e-4, 1e-8])
def test_m1_weights_count_against_each_other_alone(scale):
    """One over the variance of the noise, in whatever unit: the surface and its bound are the same."""
    weighted = js.Image(WAVES, weights=np.full(WAVES.shape, scale))
    plain, scaled = (R.bound_error(image, NODES, TRIANGLES, 2.0) for image in (js.Image(WAVES), weighted))
    np.testing.assert_allclose(scaled.tin.points, plain.tin.points, atol=1e-9)
    assert scaled.holds


@pytest.mark.parametrize(("spacing", "origin"), [((5.0, 0.2), (0.0, 0.0)), ((0.7, 0.1), (0.0, 0.0)), ((1.0, 1.0), (1000.1, 500.3))])
def test_no_border_pixel_is_lost_by_rounding(spacing, origin, user_mode):
    """A spacing that single precision rounds: nodes given on the border in double precision hold the border's pixels all the same."""
    image = js.Image(WAVES, spacing=spacing, origin=origin)
    tin = R.fitted_tin(image, NODES * spacing + origin, TRIANGLES)
    assert tin.errors(image).outside == 0
    np.testing.assert_allclose(tin.points[:, 2], R.fitted_tin(js.Image(WAVES), NODES, TRIANGLES).points[:, 2], atol=1e-3)


def test_a_bound_tells_of_pixels_under_no_triangle():
    """A mesh over half of the image: how many pixels nothing was bounded of."""
    found = R.bound_error(js.Image(WAVES), [(0, 0), (25, 0), (0, 39), (25, 39)], [(0, 1, 2), (2, 1, 3)], 0.5)
    assert found.outside == 40 * 34
    assert R.bound_error(js.Image(WAVES), NODES, TRIANGLES, 2.0).outside == 0


@pytest.mark.parametrize("ending", [".obj", ".ply"])
def test_a_tin_keeps_map_coordinates(ending, tmp_path, user_mode):
    """Twenty centimetres apart at five million metres, where single precision has steps of half a metre."""
    x, y = np.meshgrid(500000 + 0.2 * np.arange(6), 5400000 + 0.2 * np.arange(6))
    points = np.column_stack([x.ravel(), y.ravel(), np.linspace(310.05, 311.1, 36)])
    corner = (6 * np.arange(5)[:, None] + np.arange(5)).ravel()
    triangles = np.concatenate([np.stack([corner, corner + 1, corner + 6], -1), np.stack([corner + 1, corner + 7, corner + 6], -1)])
    path = tmp_path / f"hill{ending}"
    R.save_tin(path, R.Tin(points, triangles))
    with jax.enable_x64(True):
        _, found = js.from_mesh(path)
    np.testing.assert_allclose(np.asarray(found), points, rtol=0, atol=1e-6)


def test_pixels_of_an_image_of_points_go_by_the_points_within():
    """Two points a pixel on average, whatever share of the cloud the outline cuts out."""
    cloud = js.images.PointCloud(np.column_stack([np.random.default_rng(0).uniform(0, 100, (4000, 2)), np.zeros(4000)]))
    for outline in (None, (0, 0, 25, 25)):
        assert 1.5 < float(cloud.image(outline=outline).weights.mean()) < 2.5


@pytest.mark.parametrize("outlier", [-9999.0, -1e6])
def test_m1_one_far_outlier_moves_a_robust_surface_little(outlier, user_mode):
    """Its pull is bounded: the heights change by centimetres, however far it lies, in single precision too."""
    rng = np.random.default_rng(0)
    places = rng.uniform(0, 80, (3000, 2))
    heights = 5 * np.sin(places[:, 0] / 12) + rng.normal(0, 0.1, 3000)
    heights[::7] += 15.0
    cloud = np.vstack([np.column_stack([places, heights]), [[0.0, 0.0, 0.0], [80.0, 80.0, 0.0]]])
    x, y = np.meshgrid(np.linspace(0, 80, 17), np.linspace(0, 80, 17))
    clean, spoilt = (
        R.point_heights(js.images.PointCloud(points), x, y, huber=0.2).z for points in (cloud, np.vstack([cloud, [[41.0, 37.0, outlier]]]))
    )
    assert np.abs(spoilt - clean).max() < 0.05


def test_grey_stored_as_colour_has_its_number():
    """Every grey level n of (n, n, n) is n: so its no-data number is found. Rounded weights made 70 of 256 levels n - 1e-14."""
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(js.images.Luminance()(np.repeat(levels[:, None, None], 3, axis=2))[:, 0], levels)


@pytest.mark.parametrize("ending", [".png", ".npy", None])
def test_a_transparent_pixel_has_no_value_wherever_it_comes_from(ending, tmp_path):
    """Bytes of red, green, blue and opacity, from a picture, a file of NumPy's or an array: six holes."""
    pixels = np.full((6, 7, 4), 100, np.uint8)
    pixels[..., 3], pixels[2:4, 2:5] = 255, 0
    how = {"channel": js.images.Luminance(), "holes": js.images.Holes()}
    path = tmp_path / f"a{ending}"
    if ending is None:
        image = js.images.image_from_array(pixels, **how)
    else:
        Picture.fromarray(pixels).save(path) if ending == ".png" else np.save(path, pixels)
        image = js.load_image(path, **how)
    assert int(image.n_holes) == 6


@pytest.fixture(scope="module")
def small():
    return js.lens.Lens((48, 72), nodes=10, n_passes=4)


def test_whole_pixels_are_rounded(small):
    """Bytes through a lens: the nearest level to what SciPy reads there, a constant stays, a mask keeps its area."""
    rows, columns = np.mgrid[:48, :72]
    grey = (128 + 100 * np.sin(columns / 4) * np.cos(rows / 5)).astype(np.uint8)
    warp = small.warp(js.lens.Disc((30.0, 22.0), 10.0, 1.7))
    u, v = (np.asarray(a, float) for a in warp.inverse(jnp.asarray(columns, float), jnp.asarray(rows, float)))
    expected = map_coordinates(grey.astype(float), [v, u], order=1, mode="nearest")
    shown = warp.apply(jnp.asarray(grey))
    assert shown.dtype == jnp.uint8
    assert np.abs(np.asarray(shown, float) - expected).max() < 0.5 + 1e-6
    np.testing.assert_array_equal(warp.apply(jnp.full((48, 72), 200, jnp.uint8)), 200)
    mask = np.hypot(columns - 30, rows - 22) < 6
    expected = map_coordinates(mask.astype(float), [v, u], order=1, mode="nearest") > 0.5
    assert np.sum(np.asarray(warp.apply(jnp.asarray(mask))) != expected) < 5


def test_where_nothing_is_important_nothing_moves(small):
    """An importance of 0 everywhere: the image as it is, and finite derivatives; one of 0.02 has numbers to report."""
    rows, columns = np.mgrid[:48, :72]
    pixels = jnp.asarray(np.random.default_rng(0).random((48, 72)))

    def places(mask, magnification):
        return small.warp(js.lens.Importance(js.Image(mask), magnification))

    warp = places(jnp.zeros((48, 72)), 2.0)
    np.testing.assert_allclose(warp.apply(pixels), pixels, atol=1e-5)
    slopes = jax.grad(lambda mask, m: jnp.sum(places(mask, m).position.x ** 2), argnums=(0, 1))(jnp.zeros((48, 72)), 2.0)
    assert all(bool(jnp.all(jnp.isfinite(slope))) for slope in slopes)
    faint = 0.02 * np.exp(-((columns - 36) ** 2 + (rows - 24) ** 2) / 60)
    found = places(jnp.asarray(faint), 2.0)
    assert 1.0 < float(found.delivered[0]) < float(found.requested[0]) < 2.0**0.02
    edge = small.warp(js.lens.Disc((-7.5, 16.0), 8.0, 1.6))
    assert bool(jnp.isfinite(edge.delivered[0]))
    assert bool(jnp.isfinite(edge.requested[0]))
