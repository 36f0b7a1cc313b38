"""Obstacles: distances against formulas in NumPy at 10,000 places, gradients against central differences, and what is refused."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull, KDTree

import jaxspring as js
from jaxspring.contact.base import curvature, seen

N = 10_000
NOW = jnp.asarray(0.7)
c = js.contact


def vector(points):
    return js.Vector(tuple(jnp.asarray(points[:, i]) for i in range(points.shape[1])))


def rows(v):
    return np.stack([np.asarray(a) for a in v], axis=-1)


def places(dim, seed=0):
    return np.random.default_rng(seed).uniform(-2.0, 2.0, (N, dim))


@eqx.filter_jit
def looked_at(obstacle, points):
    """Distance, gradient, rate, second derivative and velocity at all places."""
    position = vector(points)
    return (*seen(obstacle, position, NOW), curvature(obstacle, position, NOW), obstacle.velocity(position, NOW))


def of_plane(x):
    n = np.array([1.0, -2.0, 2.0]) / 3
    return (x - np.array([0.1, 0.2, 0.3])) @ n


def of_corner(x):
    return np.minimum(x[:, 1], (x[:, 0] - 0.5) / np.sqrt(2) + x[:, 1] / np.sqrt(2))


def of_box(x):
    """By the nearest place of the box from outside, by the nearest face from inside."""
    centre, half = np.array([0.1, -0.2, 0.3]), np.array([1.0, 0.5, 0.25])
    nearest = np.clip(x, centre - half, centre + half)
    outside = np.linalg.norm(x - nearest, axis=1)
    return np.where(outside > 0, outside, -(half - np.abs(x - centre)).min(axis=1))


A, B, R = np.array([-0.5, 0.2, 0.1]), np.array([1.0, 0.8, -0.4]), 0.4


def of_capsule(x):
    """By the least over a fine division of the segment, refined to the exact foot."""
    share = np.clip((x - A) @ (B - A) / ((B - A) @ (B - A)), 0, 1)
    return np.linalg.norm(x - A - share[:, None] * (B - A), axis=1) - R


def of_cylinder(x):
    """By cases: beyond an end, beyond the side, beyond the rim, inside."""
    axis = (B - A) / np.linalg.norm(B - A)
    along = (x - A) @ axis
    radial = np.linalg.norm(np.cross(x - A, axis), axis=1)
    end = np.maximum(-along, along - np.linalg.norm(B - A))
    side = radial - R
    return np.select([(end > 0) & (side > 0), end > 0, side > 0], [np.hypot(end, side), end, side], np.maximum(end, side))


def pulse(t):
    return jnp.stack([jnp.sin(t), 0.5 * t, t * 0])


EXACT = {
    "plane": (c.Plane((0.1, 0.2, 0.3), (1, -2, 2)), of_plane),
    "corner": (c.HalfSpaces([(0.0, 0.0), (0.5, 0.0)], [(0.0, 3.0), (1.0, 1.0)]), of_corner),
    "sphere": (c.Sphere((0.3, -0.1, 0.2), 0.9), lambda x: np.linalg.norm(x - [0.3, -0.1, 0.2], axis=1) - 0.9),
    "disc": (c.Sphere((0.3, -0.1), 0.9), lambda x: np.linalg.norm(x - [0.3, -0.1], axis=1) - 0.9),
    "box": (c.Box((0.1, -0.2, 0.3), (1.0, 0.5, 0.25)), of_box),
    "interval": (c.Box((0.1,), (1.0,)), lambda x: np.abs(x[:, 0] - 0.1) - 1.0),
    "capsule": (c.Capsule(A, B, R), of_capsule),
    "cylinder": (c.Cylinder(A, B, R), of_cylinder),
    "bowl": (c.SignedDistance(lambda x, t: 1.5 + 0 * t - x.norm()), lambda x: 1.5 - np.linalg.norm(x, axis=1)),
    "moving": (
        c.Moving(c.Sphere((0.0, 0.0, 0.0), 0.9), pulse),
        lambda x: np.linalg.norm(x - [np.sin(0.7), 0.35, 0.0], axis=1) - 0.9,
    ),
}


@functools.cache
def seen_of(name):
    obstacle, _ = EXACT[name]
    points = places(obstacle_dim(name))
    return points, looked_at(obstacle, points)


def obstacle_dim(name):
    return {"corner": 2, "disc": 2, "interval": 1}.get(name, 3)


@pytest.mark.parametrize("name", EXACT)
def test_distance_against_numpy(name):
    """The signed distance is that of a formula written in NumPy, at 10,000 places inside and outside."""
    points, (d, *_) = seen_of(name)
    expected = EXACT[name][1](points)
    np.testing.assert_allclose(d, expected, atol=1e-13)
    assert min((expected < 0).sum(), (expected > 0).sum()) > 20


@pytest.mark.parametrize("name", EXACT)
def test_gradient_against_central_differences(name):
    """The gradient, of length one, is that of the NumPy formula by central differences, away from kinks; the second derivative is that of
    the gradient along a random direction.
    """
    points, (_, normal, _, hessian, _) = seen_of(name)
    dim, h = points.shape[1], 1e-6
    formula = EXACT[name][1]
    steps = h * np.eye(dim)
    central = np.stack([(formula(points + s) - formula(points - s)) / (2 * h) for s in steps], axis=-1)
    one_sided = np.stack([(formula(points + s) - formula(points)) / h for s in steps], axis=-1)
    is_smooth = np.abs(central - one_sided).max(axis=1) < 1e-3
    assert is_smooth.mean() > 0.97
    np.testing.assert_allclose(rows(normal)[is_smooth], central[is_smooth], atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(rows(normal), axis=1), 1, atol=1e-12)
    direction = np.random.default_rng(1).normal(size=dim)
    ahead, behind = (rows(looked_at(EXACT[name][0], points + side * h * direction)[1]) for side in (1, -1))
    slope = (ahead - behind) / (2 * h)
    found = np.stack([rows(row) @ direction for row in hessian], axis=-1)
    far = is_smooth & (np.abs(slope).max(axis=1) < 50)
    np.testing.assert_allclose(found[far], slope[far], atol=1e-6, rtol=1e-6)


def test_the_velocity_of_what_moves():
    """A moving sphere's surface has the motion's velocity, tangential part included; its rate at a fixed place is minus that along n."""
    _, (_, normal, rate, _, velocity) = seen_of("moving")
    u = np.array([np.cos(0.7), 0.5, 0.0])
    np.testing.assert_allclose(rows(velocity), np.broadcast_to(u, (N, 3)), atol=1e-14)
    np.testing.assert_allclose(rate, -rows(normal) @ u, atol=1e-13)
    # What says nothing of its motion is taken to move along its normal.
    growing = c.SignedDistance(lambda x, t: x.norm() - t * t)
    points = places(3)[:50]
    _, normal, _, _, velocity = looked_at(growing, points)
    np.testing.assert_allclose(rows(velocity), 2 * 0.7 * rows(normal), atol=1e-13)


AWKWARD = {
    "centre of a sphere": (c.Sphere((0.0, 0.0, 0.0), 1.0), [(0.0, 0.0, 0.0)]),
    "box: centre, faces, edges, corners": (
        c.Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
        [(0, 0, 0), (1, 0, 0), (1, 1, 0), (1, 1, 1), (2, 2, 2), (0.5, 0.5, 0), (2, 0, 0)],
    ),
    "axis and ends of a capsule": (c.Capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.5), [(0, 0, 0), (0.5, 0, 0), (1, 0, 0), (1, 0.5, 0)]),
    "a capsule without length": (c.Capsule((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.5), [(0, 0, 0), (1, 0, 0)]),
    "axis and rim of a cylinder": (c.Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.5), [(0, 0, 0), (0.5, 0, 0), (1, 0.5, 0), (2, 0, 0)]),
    "a corner": (c.HalfSpaces([(0.0, 0.0, 0.0)] * 2, [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]), [(0, 0, 0), (1, 1, 0), (-1, -1, 0)]),
}


@pytest.mark.parametrize("name", AWKWARD)
def test_derivatives_are_finite_where_the_distance_has_a_kink(name):
    """At centres, edges, corners and on axes distance, gradient and second derivative are finite, by place and by every constant; on a face
    the gradient is whole, so that a node that rests there is pushed with full strength.
    """
    obstacle, points = AWKWARD[name]
    points = np.array(points, float)
    assert all(np.isfinite(np.asarray(a)).all() for a in jax.tree.leaves(looked_at(obstacle, points)))
    by_constants = eqx.filter_jit(eqx.filter_grad(lambda o: jnp.sum(o.distance(vector(points), NOW))))(obstacle)
    assert all(np.isfinite(np.asarray(a)).all() for a in jax.tree.leaves(by_constants))
    if name.startswith("box"):
        assert rows(looked_at(obstacle, points)[1])[1].tolist() == [1, 0, 0]


def test_constants_may_be_fitted():
    """The derivative of a sphere's distance is -1 by the radius and -n by the centre; that of a plane by its point is -n."""
    points = places(3)[:20]
    sphere, plane = EXACT["sphere"][0], EXACT["plane"][0]
    by_sphere = jax.jacfwd(lambda o: o.distance(vector(points), NOW))(sphere)
    np.testing.assert_allclose(by_sphere.radius, -1)
    np.testing.assert_allclose(by_sphere.centre, -rows(seen(sphere, vector(points), NOW)[1]), atol=1e-14)
    np.testing.assert_allclose(
        jax.jacfwd(lambda o: o.distance(vector(points), NOW))(plane).point, -np.tile(plane.normal, (20, 1)), atol=1e-14
    )


def test_in_float32_far_and_near():
    """Places of 1e-30 to 1e30 m in float32 have the right distance or an infinite one outside, and a gradient that is never NaN near."""
    x = np.float32([[1e-30, 0], [1e-10, 1e-10], [3.0, 4.0], [1e15, 0.0], [1e30, 1e30]])
    for obstacle in (c.Sphere(np.float32([0, 0]), np.float32(1)), c.Box(np.float32([0, 0]), np.float32([1, 1]))):
        d, normal, *_ = looked_at(obstacle, x)
        assert d.dtype == np.float32
        assert (np.asarray(d[:2]) == -1).all()
        assert (np.asarray(d[3:]) >= 1e15 * (1 - 1e-6)).all()
        assert np.isfinite(rows(normal)[:4]).all()


# A cube, a ball of triangles, and a cube out of which a corner is cut: edges and corners that bend inward.
def hull(points):
    found = ConvexHull(points)
    outward = [
        np.dot(np.cross(points[b] - points[a], points[d] - points[a]), e[:3]) > 0
        for (a, b, d), e in zip(found.simplices, found.equations, strict=True)
    ]
    return points, np.where(np.array(outward)[:, None], found.simplices, found.simplices[:, ::-1])


CUBE = hull(np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)], float))


def test_a_mesh_that_is_a_box():
    """Within a spacing of a cube the sampled distance is right to a fiftieth of a spacing, at edges to a fifth; the sign is right; far
    outside it is a lower bound that is no less than the distance to the grid.
    """
    points = places(3)
    exact = EXACT["box"][0].__class__((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).distance(vector(points), NOW)
    for faces in (CUBE[1], CUBE[1][:, ::-1]):  # turned inward: the same mesh
        mesh = c.MeshField(CUBE[0], faces, 0.2)
        d, normal, *_ = looked_at(mesh, points)
        is_near = np.abs(np.asarray(exact)) < 0.2
        error = np.abs(np.asarray(d) - np.asarray(exact))[is_near]
        assert error.max() < 0.22 * 0.2
        assert np.median(error) < 0.02 * 0.2
        assert ((np.asarray(d) < 0) == (np.asarray(exact) < 0))[np.abs(exact) > 0.04].all()
        # A spline overshoots beside kinks: edges outside, and inside the ridge that is as far from two faces.
        steepness, is_outside = np.linalg.norm(rows(normal), axis=1), np.asarray(exact) > 0
        assert steepness[is_near & is_outside].max() < 1.3
        assert steepness[is_near].max() < 1.5
        # A spacing before the middle of a face the distance is straight, up to the end of the samples.
        before_a_face = (np.asarray(exact) > 0.2) & (np.asarray(exact) < 0.6) & (np.sort(np.abs(points), axis=1)[:, 1] < 0.5)
        assert before_a_face.sum() > 50
        np.testing.assert_allclose(steepness[before_a_face], 1, atol=0.01)
    d, *_ = looked_at(mesh, 20 * points)
    true = np.asarray(EXACT["box"][0].__class__((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).distance(vector(20 * points), NOW))
    assert (np.asarray(d) <= true + 0.02).all()
    assert (np.asarray(d) >= true / np.sqrt(3) - 0.1)[true > 3].all()
    with pytest.raises(ValueError, match="the mesh has 3 coordinates, the positions have 2"):
        mesh.check(2)


def test_a_mesh_that_bends_inward_against_all_triangles():
    """At random places the samples of a body with a notch are the least distance to any of its triangles, negative inside."""
    from jaxspring.contact.mesh_distance import pseudonormals, signed_distance

    # An L of three cubes, extruded: its cross-section by corners, its inside known by coordinates.
    section = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
    flat = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    vertices = np.concatenate([np.c_[section, np.zeros(6)], np.c_[section, np.ones(6)]])
    sides = [f for i in range(6) for f in ((i, (i + 1) % 6, 6 + (i + 1) % 6), (i, 6 + (i + 1) % 6, 6 + i))]
    faces = np.concatenate([flat[:, ::-1], flat + 6, np.array(sides)])
    assert c.MeshField(vertices, faces, 0.25).invalid() == False  # noqa: E712 (closed, and turning one way)
    x = np.random.default_rng(3).uniform([-0.5, -0.5, -0.5], [2.5, 2.5, 1.5], (2000, 3))
    d = np.concatenate([signed_distance(part, vertices[faces], pseudonormals(vertices, faces)) for part in np.array_split(x, 40)])
    inside = (x > 0).all(axis=1) & (x[:, 2] < 1) & (x[:, :2] < 2).all(axis=1) & ~((x[:, 0] > 1) & (x[:, 1] > 1))
    np.testing.assert_array_equal(d < 0, inside)
    # The distance, by a cloud of points on the surface.
    share = np.random.default_rng(4).dirichlet(np.ones(3), (len(faces), 4000))
    cloud = np.einsum("fsk,fkd->fsd", share, vertices[faces]).reshape(-1, 3)
    nearest = KDTree(cloud).query(x)[0]
    assert (nearest - np.abs(d) > -1e-12).all()
    assert (nearest - np.abs(d)).max() < 0.05


def test_a_height_field():
    """Over a slope the distance is exact; over a hill zero on the surface, with a gradient of length one there, and wrong by the second
    order beside it; outside the image the ground goes on level.
    """
    x, y = np.meshgrid(np.arange(9.0), np.arange(7.0))
    points = np.random.default_rng(0).uniform([1.5, 1.5, -3], [6.5, 4.5, 6], (N, 3))
    slope = c.HeightField(js.Image(0.3 * x - 0.2 * y), js.images.Bilinear())
    normal = np.array([-0.3, 0.2, 1.0]) / np.sqrt(1.13)
    d, n, *_ = looked_at(slope, points)
    np.testing.assert_allclose(d, points @ normal, atol=1e-13)
    np.testing.assert_allclose(rows(n), np.tile(normal, (N, 1)), atol=1e-13)
    np.testing.assert_allclose(looked_at(slope, np.array([[-5.0, -3.0, 2.0]]))[0], 2.0)

    # The upper part of a ball of radius 5 about (4, 3, -4).
    hill = c.HeightField(js.Image(np.sqrt(25 - (x - 4) ** 2 / 2 - (y - 3) ** 2 / 2) - 4))
    x, y = points[:400, 0], points[:400, 1]
    on = np.stack([x, y, np.asarray(hill.image.sample(x, y, js.images.CubicSpline()))], axis=-1)
    d, n, *_ = looked_at(hill, on)
    np.testing.assert_allclose(d, 0, atol=1e-14)
    n = rows(n)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1, atol=1e-13)
    errors = [np.abs(np.asarray(looked_at(hill, on + s * n)[0]) - s).max() for s in (0.1, 0.05)]
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.3)
    # In the plane: one row.
    ground = c.HeightField(js.Image(np.array([[0.0, 1.0, 2.0, 3.0]]), origin=(0.0, 7.0)), js.images.Bilinear())
    np.testing.assert_allclose(looked_at(ground, np.array([[1.25, 2.25]]))[0], 1 / np.sqrt(2))
    ground.check(2)
    # A ground that rises comes nearer by as much.
    at = vector(np.array([[1.5, 5.0]]))
    by_height = jax.grad(lambda v: c.HeightField(js.Image(v), js.images.Bilinear()).distance(at, NOW)[0])(jnp.ones((1, 4)))
    np.testing.assert_allclose(by_height, [[0, -0.5, -0.5, 0]], atol=1e-14)


TETRAHEDRON = (np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


@pytest.mark.parametrize(
    ("kind", "match", "build"),
    [
        (ValueError, "normal has no length", lambda: c.Plane((0, 0), (0, 0))),
        (ValueError, r"normals\[1\] has no length", lambda: c.HalfSpaces([(0, 0), (1, 0)], [(0, 1), (0, 0)])),
        (ValueError, r"normals has shape \(2,\); expected \(M, D\)", lambda: c.HalfSpaces([(0, 0)], (0, 1))),
        (ValueError, "radius = -1.0, but must be positive", lambda: c.Sphere((0, 0), -1)),
        (ValueError, r"centre\[1\] = nan", lambda: c.Sphere((0, np.nan), 1)),
        (ValueError, r"centre has shape \(4,\)", lambda: c.Sphere((0, 0, 0, 0), 1)),
        (ValueError, r"half_sizes\[1\] = 0.0, but must be positive", lambda: c.Box((0, 0), (1, 0))),
        (ValueError, "half_sizes has shape", lambda: c.Box((0, 0), (1, 1, 1))),
        (ValueError, "a has 2 coordinates and b has 3", lambda: c.Capsule((0, 0), (0, 0, 1), 1)),
        (ValueError, "A cylinder without length has no direction", lambda: c.Cylinder((1, 0), (1, 0), 1)),
        (TypeError, "image is .* expected a Image", lambda: c.HeightField(np.zeros((3, 3)))),
        (ValueError, "is nan", lambda: c.HeightField(js.Image([[0.0, np.nan]]))),
        (ValueError, "must be finite", lambda: c.HeightField(js.Image([[0.0, 1.0]]).with_values(jnp.array([[0.0, jnp.nan]])))),
        (ValueError, "the mesh is not closed: no other triangle meets", lambda: c.MeshField(TETRAHEDRON[0], TETRAHEDRON[1][:3], 0.2)),
        (ValueError, "along the edge .* in this direction", lambda: c.MeshField(TETRAHEDRON[0], [*TETRAHEDRON[1][:3], (1, 3, 2)], 0.2)),
        (ValueError, "names node 7", lambda: c.MeshField(TETRAHEDRON[0], [(0, 1, 7)], 0.2)),
        (ValueError, r"faces\[0\] has no area", lambda: c.MeshField(np.zeros((4, 3)), TETRAHEDRON[1], 0.2)),
        (ValueError, "asks for .* Pass a larger spacing", lambda: c.MeshField(*TETRAHEDRON, 1e-3)),
        (TypeError, "vertices is traced", lambda: jax.jit(lambda v: c.MeshField(v, TETRAHEDRON[1], 0.2))(TETRAHEDRON[0])),
        (TypeError, "function is a float", lambda: c.SignedDistance(1.0)),
        (TypeError, "motion is a float", lambda: c.Moving(c.Sphere((0, 0), 1), 1.0)),
        (TypeError, "obstacle is 1.0, a float; expected a Obstacle", lambda: c.Moving(1.0, pulse)),
        (ValueError, "what a motion returned", lambda: c.Moving(c.Sphere((0, 0), 1), lambda t: t).distance(vector(np.ones((2, 2))), NOW)),
        (
            ValueError,
            "what the distance function returned",
            lambda: c.SignedDistance(lambda x, t: t).distance(vector(np.ones((2, 2))), NOW),
        ),
        (ValueError, "the sphere has 2 coordinates, the positions have 3", lambda: c.Moving(c.Sphere((0, 0), 1), pulse).check(3)),
        (ValueError, "image of 3 rows, the positions have 2", lambda: c.HeightField(js.Image(np.zeros((3, 3)))).check(2)),
    ],
)
def test_bad_obstacles_are_refused_by_name(kind, match, build):
    """Each says what is wrong, where, and what to do."""
    with pytest.raises(kind, match=match):
        build()


@pytest.mark.parametrize(
    "bad",
    [
        eqx.tree_at(lambda o: o.radius, c.Sphere((0, 0), 1), jnp.asarray(-1.0)),
        eqx.tree_at(lambda o: o.half_sizes, c.Box((0, 0), (1, 1)), jnp.array([1.0, jnp.inf])),
        eqx.tree_at(lambda o: o.b, c.Cylinder((0, 0), (1, 1), 1), jnp.zeros(2)),
        eqx.tree_at(lambda o: o.point, c.Plane((0, 0), (1, 1)), jnp.array([0.0, jnp.nan])),
        c.Moving(eqx.tree_at(lambda o: o.radius, c.Capsule((0, 0), (1, 1), 1), jnp.asarray(0.0)), pulse),
    ],
    ids=lambda o: type(o).__name__,
)
def test_constants_that_went_bad_later_are_invalid(bad):
    """What the constructor would have refused is told by `invalid` of an obstacle whose constants were traced, or changed since."""
    assert bool(bad.invalid())
    assert not bool(EXACT["box"][0].invalid() | EXACT["moving"][0].invalid() | EXACT["cylinder"][0].invalid())
