"""A hot obstacle of any form heats what touches it: a plane as `HotPlane` does, a ball by its distance, a stamp where it has gone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice(6)
SURFACE = {"temperature": 400.0, "coefficient": 3.0, "reach": 0.1, "fade": 0.4}


def heat_into(boundary, points, time=0.0):
    """Heat into each node at 300 K [W]."""
    state = js.State.from_points(NET, points, time=time, temperature=300.0)
    return np.asarray(boundary.on(NET, "boundary").power(state, state.temperature))


def test_a_plane_is_a_hot_plane(rng):
    """A `HotSurface` of a plane is the `HotPlane` of the same numbers, to the bit of rounding, with an area per node."""
    points, area = rng.uniform(-1, 1, (6, 2)), rng.uniform(1, 2, 6)
    surface = js.thermal.HotSurface(js.contact.Plane((0.1, 0.2), (1.0, 2.0)), area=area, **SURFACE)
    plane = js.thermal.HotPlane((0.1, 0.2), (1.0, 2.0), area=area, **SURFACE)
    np.testing.assert_allclose(heat_into(surface, points), heat_into(plane, points), rtol=1e-13)
    assert 0 < np.count_nonzero(heat_into(plane, points)) < 6


def test_a_ball_that_moves(rng):
    """Newton's term of a hot ball, w h A (400 - 300), with w by the distance to where the ball has moved at that time."""
    points = rng.uniform(-1.5, 1.5, (6, 3))
    ball = js.contact.Moving(js.contact.Sphere((0.0, 0.0, 0.0), 1.0), lambda t: jnp.stack([0.5 * t, 0 * t, 0 * t]))
    s = np.linalg.norm(points - [1.0, 0, 0], axis=1) - 1.0
    expected = np.clip(1 - (s - 0.1) / 0.4, 0, 1) * 3.0 * 0.2 * 100
    np.testing.assert_allclose(heat_into(js.thermal.HotSurface(ball, area=0.2, **SURFACE), points, 2.0), expected, atol=1e-12)


@pytest.mark.slow
def test_a_run_is_differentiable_by_the_obstacle():
    """Heat from a ball through a rollout: the derivative of the mean temperature by the radius is that of central differences."""

    def mean(radius):
        surface = js.thermal.HotSurface(js.contact.Sphere((0.0, 0.0), radius), area=0.2, **SURFACE)
        points = np.c_[1.0 + 0.1 * np.arange(6), np.zeros(6)]
        state = js.State.from_points(NET, points, temperature=300.0)
        run = js.rollout(js.System(NET, 1.0, rules=js.Heat(NET, 1.0, 0.5, boundaries=surface)), state, js.Still(), 0.05, 40)
        return jnp.mean(run.state.temperature)

    value = jax.jit(jax.value_and_grad(mean))
    h = 1e-5
    (_, slope), (high, _), (low, _) = (value(jnp.asarray(r)) for r in (0.987, 0.987 + h, 0.987 - h))
    np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-6)
    assert slope > 1


def test_bad_input():
    """What is no obstacle, one of another space, a radius that turned negative."""
    with pytest.raises(TypeError, match="obstacle is 3, a int"):
        js.thermal.HotSurface(3, area=1.0, **SURFACE)
    flat = js.thermal.HotSurface(js.contact.Sphere((0.0, 0.0), 1.0), area=1.0, **SURFACE)
    with pytest.raises(ValueError, match="the sphere has 2 coordinates, the positions have 3"):
        heat_into(flat, np.zeros((6, 3)))
    bad = jax.tree.map(lambda a: -a, flat)
    assert bool(bad.invalid())
    assert not bool(flat.invalid())
