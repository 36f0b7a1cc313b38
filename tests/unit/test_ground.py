"""Ground from points: exact labels of made terrain, an independent implementation, and what the cloth does over pits and planes."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.images import PointCloud
from jaxspring.reconstruction import GroundSettings, Reconstruction, Relaxation, ground_of_points
from jaxspring.scenes.reconstruction.ground import PULLS, fall

SIDE = 50.0


def hills(x, y):
    """A rolling terrain [m]."""
    return 200 + 4 * np.sin(x / 14) + 3 * np.cos(y / 17) + 0.05 * x


def terrain():
    """(P, 3) points of hills with three flat-roofed boxes and shrubs, and which of them are ground."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(0, SIDE, (12_000, 2))
    x, y = xy.T
    z, is_ground = hills(x, y) + rng.normal(0, 0.05, len(xy)), np.ones(len(xy), bool)
    for cx, cy, wide, deep, high in [(13, 15, 9, 6, 5), (36, 12, 10, 10, 8), (28, 36, 7, 14, 4)]:
        box = (np.abs(x - cx) < wide / 2) & (np.abs(y - cy) < deep / 2)
        z[box], is_ground[box] = hills(cx, cy) + high + rng.normal(0, 0.05, box.sum()), False
    shrub = is_ground & (rng.random(len(xy)) < 0.05)
    z[shrub] += rng.uniform(0.8, 6, shrub.sum())
    return np.column_stack([xy, z]), is_ground & ~shrub


@pytest.fixture(scope="module")
def case():
    points, is_ground = terrain()
    cloud = PointCloud(points)
    return points, is_ground, cloud, ground_of_points(cloud)


def test_labels_of_made_terrain_on_an_even_cloth(case):
    """At least 98 % right; the cloth is the terrain within 0.2 m where it lies; far from the origin nothing changes."""
    points, is_ground, _, found = case
    assert (found.is_ground == is_ground).mean() > 0.98
    assert found.is_settled
    inner = found.is_held[2:-2, 2:-2]
    away = found.z - hills(found.x + found.corner[0], found.y + found.corner[1])
    assert np.percentile(np.abs(away[2:-2, 2:-2][inner]), 95) < 0.3
    assert 0.6 < inner.mean() < 1
    far = ground_of_points(PointCloud(points + np.array([5e6, 5e6, 0])))
    assert (far.is_ground == found.is_ground).mean() > 0.9999
    np.testing.assert_allclose(far.z, found.z, atol=1e-4)


def test_agrees_with_the_authors_implementation(case, capfd):
    """At least 97 % of the labels are those of the wheel `cloth-simulation-filter` with the same settings."""
    points, _, _, found = case
    CSF = pytest.importorskip("CSF")
    other = CSF.CSF()
    other.params.bSloopSmooth, other.params.cloth_resolution, other.params.rigidness = True, 0.5, 3
    other.setPointCloud(points)
    ground, rest = CSF.VecInt(), CSF.VecInt()
    other.do_filtering(ground, rest, False)
    labels = np.zeros(len(points), bool)
    labels[np.array(ground)] = True
    assert (labels == found.is_ground).mean() > 0.97


@pytest.mark.slow
def test_labels_on_a_net_that_adapted(case):
    """A net that gathers where the ground bends, of 40 x 40 nodes instead of 105 x 105: at least 98 % right."""
    points, is_ground, cloud, found = case
    ground = PointCloud(points[found.is_ground]).image((51, 51), (0.0, 0.0, SIDE, SIDE))
    scene = Reconstruction(ground, (40, 40))
    _, net = scene.adapt(scene.law(1.0, 10.0, scene.spacing), Relaxation(n_steps=10, dt=1.0, damping=0.15), 30)
    x, y = (np.asarray(a) for a in net.position)
    again = ground_of_points(cloud, GroundSettings(), (x + 1e-9, y))
    assert np.ptp(np.diff(x, axis=1)) > 0.3  # it did adapt
    assert (again.is_ground == is_ground).mean() > 0.98


def test_a_cloth_over_a_pit_hangs_as_deep_as_is_said():
    """g dt^2 n^2 / (23 rigidness) within a third; on a slope it lies everywhere, and a net of uneven spacing hangs evenly."""
    n, drop = 20, 0.0845
    x, y = np.meshgrid(np.arange(n + 21.0), np.arange(n + 21.0))
    floor = np.zeros_like(x)
    floor[10 : 11 + n, 10 : 11 + n] = -100
    numbers = [jnp.asarray(a) for a in (drop, 5e-4, 0.0)]
    depth = [-float(fall(*map(jnp.asarray, (x, y, floor)), *numbers, PULLS * rigidness, 2000).height.min()) for rigidness in (1, 3)]
    np.testing.assert_allclose(depth, [drop * n**2 / 23, drop * n**2 / 69], rtol=1 / 3)
    slope = fall(*map(jnp.asarray, (x, y, 0.3 * x - 0.2 * y)), *numbers, PULLS, 2000)
    assert bool(slope.is_held[2:-2, 2:-2].all())


def test_steep_slopes_are_laid_down_from_held_neighbours():
    """A pit whose sides go down in steps below `step` is held all the way; a higher step ends it."""
    x, y = np.meshgrid(np.arange(41.0), np.arange(41.0))
    depth = 0.25 * np.maximum(0, 12 - np.abs(x - 20))
    floor = -depth - np.where(np.abs(x - 20) < 3, 1.0, 0.0)
    arrays = [jnp.asarray(a) for a in (x, y, floor, 0.0845, 5e-4)]
    free, laid = (fall(*arrays, jnp.asarray(step), 3 * PULLS, 2000) for step in (0.0, 0.3))
    assert not bool(free.is_held[20, 13:18].any())
    assert bool(laid.is_held[:, :18].all())
    assert not bool(laid.is_held[20, 18:23].any())
    np.testing.assert_allclose(laid.height[:, :18], floor[:, :18])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda c: GroundSettings(threshold=0.0), "threshold = 0.0"),
        (lambda c: GroundSettings(step=-1.0), "step = -1.0"),
        (lambda c: ground_of_points(c, mesh=(np.zeros((2, 4)), np.zeros((2, 4)))), "3 x 3 at least"),
        (lambda c: ground_of_points(c, mesh=(np.zeros((4, 4)), np.zeros((4, 4)))), "no area"),
        (lambda c: ground_of_points(c, mesh=tuple(a + 1e4 for a in np.meshgrid(np.arange(4.0), np.arange(4.0)))), "within the mesh"),
    ],
)
def test_what_is_no_cloth_is_refused(case, build, message):
    """By name."""
    with pytest.raises(ValueError, match=message):
        build(case[2])
