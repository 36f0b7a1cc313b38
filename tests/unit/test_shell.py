"""Closed shells fitted to range data, and contours that an image draws to its edges."""

import numpy as np
import pytest

import jaxspring as js
from jaxspring.scenes.reconstruction.shell import nearest_weights

AXES = np.array([1.5, 1.0, 0.7])


def distance(points):
    """From an ellipsoid, to first order."""
    return (np.sum((points / AXES) ** 2, axis=1) - 1) / np.linalg.norm(2 * points / AXES**2, axis=1)


@pytest.mark.slow
def test_error_of_an_ellipsoid_halves_with_each_level(rng):
    """Range data with 0.3 % of noise: error on the surface, away from the data; closed, wound outward, of the right volume."""
    directions = rng.normal(size=(8000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = (1 + 0.003 * rng.standard_normal(8000)) / np.linalg.norm(directions / AXES, axis=1)
    found = js.reconstruction.fit_shell(ranges[:, None] * directions, *js.reconstruction.icosahedron(), n_levels=3)
    assert found.n_nodes == (12, 42, 162, 642)
    errors = []
    for points, triangles in found.levels:
        inside = rng.dirichlet([1, 1, 1], size=(len(triangles), 20))
        errors.append(np.sqrt(np.mean(distance(np.einsum("tkc,tcd->tkd", inside, points[triangles]).reshape(-1, 3)) ** 2)))
    assert (np.array(errors[:-1]) / errors[1:] > 2).all()
    report = js.cloth.examine(found.net, found.points)
    assert report.is_closed
    assert report.is_wound
    assert report.volumes == pytest.approx([4 / 3 * np.pi * AXES.prod()], rel=1e-3)


def test_a_moved_shell_does_not_shrink(rng):
    """Springs resist a change of shape only: data on the mesh itself leave it where it is, whatever their stiffness."""
    points, triangles = js.reconstruction.icosahedron(2.0)
    weights = rng.dirichlet([1, 1, 1], size=(20, 10))
    data = np.einsum("tkc,tcd->tkd", weights, points[triangles]).reshape(-1, 3)
    found = js.reconstruction.fit_shell(data, points, triangles, n_levels=0, stiffness=100.0)
    np.testing.assert_allclose(found.points, points, atol=1e-8)
    assert found.rms[0] < 1e-8


def test_nearest_place_of_a_triangle(rng):
    """Against a search over a fine grid of barycentric weights."""
    corners, q = rng.random((3, 3)), 3 * rng.standard_normal((40, 3))
    i, j = np.mgrid[:201, :201]
    grid = np.stack([i, j, 200 - i - j], axis=-1)[(i + j) <= 200] / 200
    found = nearest_weights(q, np.broadcast_to(corners, (40, 3, 3)))
    assert found.min() >= 0
    np.testing.assert_allclose(found.sum(axis=1), 1)
    best = np.linalg.norm(grid @ corners - q[:, None], axis=-1).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(found @ corners - q, axis=1), best, atol=2e-2)
    assert (np.linalg.norm(found @ corners - q, axis=1) <= best + 1e-12).all()


@pytest.mark.parametrize(("wrong", "why"), [({"data": np.zeros((0, 3))}, "data has shape"), ({"stiffness": 0.0}, "positive")])
def test_wrong_range_data_are_refused(wrong, why):
    """By name."""
    points, triangles = js.reconstruction.icosahedron()
    with pytest.raises(ValueError, match=why):
        js.reconstruction.fit_shell(**({"data": points, "points": points, "triangles": triangles} | wrong))


@pytest.mark.slow
def test_a_closed_contour_finds_an_ellipse(rng):
    """From outside, in noise, to half a pixel of the edge."""
    y, x = np.mgrid[:60, :70]
    image = js.Image(1.0 * (np.hypot(x - 35, (y - 30) / 0.8) < 20) + 0.05 * rng.standard_normal(x.shape))
    angle = 2 * np.pi * np.arange(40) / 40
    start = np.stack([35 + 26 * np.cos(angle), 30 + 23 * np.sin(angle)], axis=-1)
    system, state = js.reconstruction.active_contour(image, start, sigma=2.5)
    end = js.rollout(system, state, js.SymplecticEuler(), dt=0.5, n_steps=1000)
    js.raise_for_status(end.status)
    px, py = np.asarray(end.state.points).T
    radius = np.hypot(px - 35, (py - 30) / 0.8)
    assert abs(radius.mean() - 20) < 0.7
    assert np.ptp(radius) < 1.2


@pytest.mark.slow
def test_an_open_contour_follows_an_edge_between_its_ends(rng):
    """Ends stay; between them it lies on the edge, from the reading of a user's own function of the image."""
    y, x = np.mgrid[:50, :60]
    edge = 25 + 6 * np.sin(x / 9)
    image = js.Image(1 / (1 + np.exp(-(y - edge))))
    start = np.stack([np.linspace(2, 57, 40), np.linspace(25 + 6 * np.sin(2 / 9), 25 + 6 * np.sin(57 / 9), 40)], axis=-1)
    system, state = js.reconstruction.active_contour(
        image, start, sigma=2.0, closed=False, observation=lambda image: image.values * (1 - image.values)
    )
    end = js.rollout(system, state, js.SymplecticEuler(), dt=0.5, n_steps=1500).state
    places = np.asarray(end.points)
    np.testing.assert_array_equal(places[[0, -1]], start[[0, -1]])
    assert np.abs(places[3:-3, 1] - (25 + 6 * np.sin(places[3:-3, 0] / 9))).max() < 1
    with pytest.raises(ValueError, match="at least 4"):
        js.reconstruction.active_contour(image, start[:3], sigma=2.0)
