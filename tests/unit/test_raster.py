"""Which triangle holds each pixel, and the drawn surface, against brute force over all triangles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxspring.images.image import Image
from jaxspring.scenes.reconstruction.raster import PixelGrid, draw, locate, locate_uniform
from jaxspring.scenes.reconstruction.triangles import OUTSIDE, at_nodes, corners, count_folds, doubled_areas, neighbours

NODES = (6, 7)


def distorted(rng, grid, amount=0.35):
    """A mesh without folds, its border on the border of the image."""
    x, y = (np.array(a) for a in grid.uniform_nodes(NODES))
    x[:, 1:-1] += amount * (x[0, 1] - x[0, 0]) * rng.uniform(-1, 1, x[:, 1:-1].shape)
    y[1:-1] += amount * (y[1, 0] - y[0, 0]) * rng.uniform(-1, 1, y[1:-1].shape)
    return jnp.asarray(x), jnp.asarray(y)


@pytest.fixture
def scene(rng):
    grid = PixelGrid.of(Image(rng.random((41, 53)), spacing=(0.5, 2.0), origin=(-3.0, 10.0)))
    x, y = distorted(rng, grid)
    flip = jnp.asarray(rng.random((NODES[0] - 1, NODES[1] - 1)) < 0.5)
    return grid, x, y, flip


def triangles_of(flip):
    """(T, 3) node numbers, written out cell by cell."""
    ny, nx = (n + 1 for n in flip.shape)
    number = np.arange(ny * nx).reshape(ny, nx)
    upper, lower = [], []
    for i in range(ny - 1):
        for j in range(nx - 1):
            nw, ne, sw, se = number[i, j], number[i, j + 1], number[i + 1, j], number[i + 1, j + 1]
            upper.append((nw, ne, sw) if flip[i, j] else (nw, ne, se))
            lower.append((ne, se, sw) if flip[i, j] else (nw, se, sw))
    return np.array(upper + lower)


def barycentric(points, triangle):
    """(P, 3) weights of the points in one triangle, by solving for them."""
    system = np.vstack([triangle.T, np.ones(3)])
    return np.linalg.solve(system, np.vstack([points.T, np.ones(len(points))])).T


def test_corners_are_those_of_the_table(scene):
    """The shifted slices give the node numbers that are written out cell by cell."""
    _, _, _, flip = scene
    number = jnp.arange(NODES[0] * NODES[1]).reshape(NODES)
    found = np.stack([np.ravel(c) for c in corners(number, flip)], axis=1)
    np.testing.assert_array_equal(found, triangles_of(np.asarray(flip)))


def test_sums_at_nodes_are_the_transpose_of_corners(scene, rng):
    """<corners(a), b> = <a, at_nodes(b)>."""
    _, _, _, flip = scene
    a = jnp.asarray(rng.standard_normal(NODES))
    b = tuple(jnp.asarray(rng.standard_normal((2, *flip.shape))) for _ in range(3))
    forward = sum(jnp.sum(p * q) for p, q in zip(corners(a, flip), b, strict=True))
    np.testing.assert_allclose(forward, jnp.sum(a * at_nodes(b, flip)), rtol=1e-13)


def test_neighbours_share_the_edge(scene):
    """The triangle across an edge holds both its nodes; across the border there is none."""
    _, _, _, flip = scene
    nodes, across = triangles_of(np.asarray(flip)), np.asarray(neighbours(flip))
    n_border = 0
    for t, triangle in enumerate(nodes):
        for corner in range(3):
            edge = set(triangle) - {triangle[corner]}
            others = [s for s in range(len(nodes)) if s != t and edge <= set(nodes[s])]
            assert others == ([across[corner, t]] if across[corner, t] != OUTSIDE else [])
            n_border += not others
    assert n_border == 2 * (NODES[0] - 1 + NODES[1] - 1)


def test_every_pixel_is_in_its_triangle(scene):
    """Each pixel has weights of zero or more in the triangle it is given, and none is lost."""
    grid, x, y, flip = scene
    location = locate(x, y, flip, grid, locate_uniform(grid, flip.shape))
    points = np.stack([grid.x, grid.y], axis=1)
    nodes, triangle = triangles_of(np.asarray(flip)), np.asarray(location.triangle)
    vertices = np.stack([np.ravel(x), np.ravel(y)], axis=1)[nodes]
    for t in range(len(nodes)):
        inside = triangle == t
        assert np.all(barycentric(points[inside], vertices[t]) > -1e-3)
    assert int(location.n_lost) == 0


def test_uniform_cells_are_found_in_closed_form(scene):
    """On the regular lattice nothing has to walk more than across its own cell."""
    grid, _, _, flip = scene
    location = locate(*grid.uniform_nodes(NODES), flip, grid, locate_uniform(grid, flip.shape))
    assert int(location.n_steps) <= 3
    assert int(location.n_lost) == 0


def test_where_the_walk_starts_does_not_matter(scene, rng):
    """From random triangles the drawn surface is the same."""
    grid, x, y, flip = scene
    z = jnp.asarray(rng.random(NODES))
    far = jnp.asarray(rng.integers(0, 2 * flip.size, grid.n_pixels), jnp.int32)
    drawn = [draw(x, y, z, flip, grid, locate(x, y, flip, grid, start).triangle) for start in (far, locate_uniform(grid, flip.shape))]
    np.testing.assert_allclose(*drawn, atol=1e-2)
    assert np.mean(np.abs(drawn[0] - drawn[1]) > 1e-12) < 0.01


def test_surface_through_a_plane_is_the_plane(scene):
    """Linear heights are drawn exactly, whatever the mesh."""
    grid, x, y, flip = scene
    triangle = locate(x, y, flip, grid, locate_uniform(grid, flip.shape)).triangle
    drawn = draw(x, y, 2 * x - 3 * y + 500, flip, grid, triangle)
    np.testing.assert_allclose(drawn.ravel(), 2 * grid.x - 3 * grid.y + 500, rtol=1e-12)


def test_drawn_surface_is_scipys(scene, rng):
    """The surface equals SciPy's piecewise linear interpolation on each triangle by itself."""
    grid, x, y, flip = scene
    z = jnp.asarray(rng.random(NODES))
    triangle = np.asarray(locate(x, y, flip, grid, locate_uniform(grid, flip.shape)).triangle)
    drawn = np.ravel(draw(x, y, z, flip, grid, jnp.asarray(triangle)))
    points = np.stack([grid.x, grid.y], axis=1)
    vertices, heights = np.stack([np.ravel(x), np.ravel(y)], axis=1), np.ravel(z)
    for t, nodes in enumerate(triangles_of(np.asarray(flip))):
        inside = triangle == t
        np.testing.assert_allclose(drawn[inside], barycentric(points[inside], vertices[nodes]) @ heights[nodes], rtol=1e-10)


def test_derivative_of_the_surface(scene, rng):
    """With the triangles held fixed, the derivative in x, y and z is that of central differences."""
    grid, x, y, flip = scene
    z = jnp.asarray(rng.random(NODES))
    triangle = locate(x, y, flip, grid, locate_uniform(grid, flip.shape)).triangle
    step = tuple(jnp.asarray(rng.standard_normal(NODES)) for _ in range(3))

    def moved(h):
        return draw(*(a + h * s for a, s in zip((x, y, z), step, strict=True)), flip, grid, triangle)

    _, tangent = jax.jvp(moved, (0.0,), (1.0,))
    np.testing.assert_allclose(tangent, (moved(1e-6) - moved(-1e-6)) / 2e-6, atol=1e-6)


def test_fold_is_counted_and_the_walk_ends(scene):
    """A node thrown over its neighbours gives negative areas; the walk stops, and says how many pixels it could not place."""
    grid, x, y, flip = scene
    x = x.at[2, 3].add(5 * float(x[2, 4] - x[2, 3]))
    location = locate(x, y, flip, grid, locate_uniform(grid, flip.shape))
    assert int(count_folds(x, y, flip)) > 0
    assert int(location.n_steps) <= 4 * sum(NODES)
    assert float(jnp.sum(doubled_areas(x, y, flip))) == pytest.approx(2 * float((grid.x[-1] - grid.x[0]) * (grid.y[-1] - grid.y[0])))


def test_walk_that_goes_round_in_circles_is_stopped(scene, rng):
    """In a mesh folded in many places some pixels walk for ever: after four times both sides of the mesh they are given up, and counted."""
    grid, _, _, flip = scene
    location = locate(*distorted(rng, grid, 1.5), flip, grid, locate_uniform(grid, flip.shape))
    assert int(location.n_steps) == 4 * sum(NODES)
    assert int(location.n_lost) > 0


def test_triangle_without_area(scene):
    """Two nodes in one place: their triangles count as folded; a pixel that one of them holds has a node's height, and a finite slope."""
    grid, x, y, flip = scene
    x, y = x.at[2, 3].set(x[2, 4]), y.at[2, 3].set(y[2, 4])
    area = np.ravel(doubled_areas(x, y, flip))
    n_flat = int(np.sum(area == 0))
    assert n_flat > 0
    assert int(count_folds(x, y, flip)) == np.sum(area < 0) + n_flat
    held = jnp.full(grid.n_pixels, int(np.argmax(area == 0)), jnp.int32)
    z = jnp.asarray(np.arange(x.size, dtype=float)).reshape(x.shape)
    heights, slopes = jax.value_and_grad(lambda z: jnp.sum(draw(x, y, z, flip, grid, held)))(z)
    assert float(heights) / grid.n_pixels in triangles_of(np.asarray(flip))[int(held[0])]
    assert float(jnp.sum(slopes)) == grid.n_pixels


def test_mesh_that_misses_the_image_is_reported(scene):
    """Pixels outside the mesh are counted, not invented; they stay in a triangle on the border, and the walk ends."""
    grid, x, y, flip = scene
    location = locate(x + 3.2, y, flip, grid, locate_uniform(grid, flip.shape))
    assert int(location.n_lost) >= 6 * grid.shape[0]
    assert int(location.n_steps) <= sum(NODES)
    lost = np.asarray(location.triangle)[np.asarray(grid.x) < float(x[0, 0]) + 3.2 - 1e-9]
    assert len(lost) == int(location.n_lost)
    assert np.all(np.any(np.asarray(neighbours(flip))[:, lost] == OUTSIDE, axis=0))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_type_follows_the_image(rng, dtype):
    """Float32 pixels are placed by float32 nodes, and none is lost though nodes and edges pass through pixels, up to rounding."""
    grid = PixelGrid.of(Image(rng.random((41, 61)).astype(dtype), spacing=0.1, origin=0.3))
    x, y = grid.uniform_nodes((11, 16))
    flip = jnp.zeros((10, 15), bool)
    location = locate(x, y, flip, grid, locate_uniform(grid, flip.shape))
    assert x.dtype == dtype
    assert int(location.n_lost) == 0
    assert int(location.n_steps) <= 3
