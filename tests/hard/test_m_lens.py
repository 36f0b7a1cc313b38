"""Hard cases of the lens: at a corner, two that overlap, too large, shrinking, smaller than two cells; and the foci themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

LENS = js.lens.Lens((97, 97), nodes=25)


@jax.jit
def pair(a, b, factors):
    """Two discs of radius 16, one program for all cases."""
    warp = LENS.warp((js.lens.Disc(a, 16.0, factors[0]), js.lens.Disc(b, 16.0, factors[1])))
    return warp, warp.certificate()


@pytest.mark.parametrize(
    ("a", "b", "factors", "wanted"),
    [
        ((0.0, 0.0), (70.0, 70.0), (2.0, 1.0), (2.0, 1.0)),
        ((96.0, 0.0), (0.0, 96.0), (1.7, 1.7), (1.7, 1.7)),
        ((40.0, 48.0), (56.0, 48.0), (1.4, 1.3), None),
        ((48.0, 48.0), (48.0, 48.0), (2.0, 0.5), (1.0, 1.0)),
        ((30.0, 48.0), (70.0, 48.0), (0.5, 1.5), (0.5, 1.5)),
    ],
    ids=["corner", "two corners", "overlapping", "cancelling", "shrinking"],
)
def test_m5_certified(a, b, factors, wanted):
    """A lens at the image's corner, two that overlap or cancel, m < 1: no fold, and what was asked for."""
    warp, certificate = pair(jnp.array(a), jnp.array(b), jnp.array(factors))
    assert bool(warp.status.is_ok)
    assert bool(certificate.is_one_to_one)
    if wanted is not None:
        np.testing.assert_allclose(warp.delivered, wanted, rtol=0.03)
    else:
        # The overlap asks for the product, and the rest of each disc for less: no mesh has all these lengths side by side.
        assert 1.4 < float(jnp.max(warp.wanted)) < 1.83
        np.testing.assert_allclose(warp.delivered, warp.requested, rtol=0.12)
        assert np.all(np.asarray(warp.delivered) > [1.4, 1.3])


def refused(foci, match):
    with pytest.raises(ValueError, match=match) as caught:
        LENS.warp(foci)
    return str(caught.value)


def test_m5_what_cannot_be_is_refused_with_the_bound():
    """Too wide (m R >= 1), R below two cells, outside, too much together: the message names the focus and the largest feasible value."""
    assert "below 3" in refused(js.lens.Disc((48.0, 48.0), 16.0, 3.0), r"foci\[0\]\.magnification = 3")
    # Half of it is outside, so that along x it has twice the room, but along y no more.
    assert "below 3" in refused(js.lens.Disc((0.0, 48.0), 16.0, 3.1), "largest feasible")
    refused(js.lens.Disc((48.0, 48.0), 3.0, 2.0), "cells of the mesh")
    refused(js.lens.Disc((200.0, 48.0), 16.0, 2.0), "outside the image")
    square = js.lens.Polygon([[10.0, 10.0], [58.0, 10.0], [58.0, 58.0], [10.0, 58.0]], 2.0, 4.0)
    assert "below 2" in refused(square, r"foci\[0\]")
    two = tuple(js.lens.Disc((x, 48.0), 22.0, 2.1) for x in (24.0, 72.0))
    assert "times these" in refused(two, "area of the image")
    refused((), "empty")
    with pytest.raises(TypeError, match=r"foci\[1\]"):
        LENS.warp((js.lens.Disc((48.0, 48.0), 16.0, 1.5), 3.0))


def test_m5_traced_foci_say_it_by_status():
    """Inside jit the same is a flag, and the mesh is still certified or said not to be."""
    warp, certificate = pair(jnp.array([48.0, 48.0]), jnp.array([48.0, 48.0]), jnp.array([3.5, 1.0]))
    assert int(warp.status.flags) & js.Flag.INVALID
    assert bool(jnp.all(jnp.isfinite(warp.position.x)))
    assert certificate.n_folds.shape == ()


def test_polygon_against_distances_to_a_box(rng):
    """The share of a rectangle, by the closed form of its distance; either sense of the corners is the same."""
    corners = np.array([[20.0, 30.0], [60.0, 30.0], [60.0, 70.0], [20.0, 70.0]])
    x, y = (jnp.asarray(a) for a in rng.uniform(0, 96, (2, 40, 25)))
    out = np.stack([np.abs(np.asarray(x) - 40) - 20, np.abs(np.asarray(y) - 50) - 20])
    distance = np.hypot(*np.maximum(out, 0)) + np.minimum(out.max(axis=0), 0)
    t = np.clip(distance / 8.0, 0, 1)
    for sense in (corners, corners[::-1]):
        share = js.lens.Polygon(sense, 2.0, rim=8.0).share(x, y)
        np.testing.assert_allclose(share, 1 - t * t * (3 - 2 * t), atol=1e-12)


def test_importance_is_the_mean_around_a_node():
    """Constants stay, a ramp stays away from the border, and every pixel has a say."""
    mesh = LENS.mesh
    flat = js.lens.Importance(js.Image(np.full((97, 97), 0.25)), 2.0).share(mesh.x, mesh.y)
    np.testing.assert_allclose(flat, 0.25, rtol=1e-12)
    ramp = js.lens.Importance(js.Image(np.arange(97.0)[None, :] / 96 * np.ones((97, 1))), 2.0).share(mesh.x, mesh.y)
    np.testing.assert_allclose(ramp[:, 1:-1], np.asarray(mesh.x)[:, 1:-1] / 96, atol=1e-12)
    slope = jax.grad(lambda v: jnp.sum(js.lens.Importance(js.Image(v), 2.0).share(mesh.x, mesh.y)))(jnp.zeros((97, 97)))
    assert float(jnp.min(slope)) > 0
    coarse = js.lens.Importance(js.Image(np.array([[0.0, 1.0], [0.0, 1.0]]), spacing=96.0), 2.0).share(mesh.x, mesh.y)
    np.testing.assert_allclose(coarse, np.asarray(mesh.x) / 96, atol=1e-12)
    with pytest.raises(ValueError, match=r"0 .context. to 1"):
        js.lens.Importance(js.Image(np.arange(9.0).reshape(3, 3)), 2.0)


def test_at_the_very_centre_the_derivative_is_a_number():
    """A node exactly at the centre of a disc spoils no gradient."""
    slope = jax.grad(lambda c: jnp.sum(js.lens.Disc(c, 10.0, 2.0).share(LENS.mesh.x, LENS.mesh.y)))(jnp.array([48.0, 48.0]))
    np.testing.assert_allclose(slope, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"shape": (3, 50)}, "shape"),
        ({"shape": (50, 50), "nodes": 3}, "nodes"),
        ({"shape": (50, 50), "nodes": 60}, "nodes"),
        ({"shape": (50, 50), "n_passes": 0}, "n_passes"),
        ({"shape": (50, 50), "gain": -1.0}, "gain"),
    ],
)
def test_a_lens_that_cannot_be_is_refused(arguments, match):
    """By the name of what is wrong."""
    with pytest.raises(ValueError, match=match):
        js.lens.Lens(**arguments)


def test_images_with_holes_are_refused():
    """What lies under a hole would be shown as data elsewhere."""
    holed = js.Image(jnp.ones((97, 97)), weights=jnp.ones((97, 97)).at[3, 4].set(0))
    warp, _ = pair(jnp.array([30.0, 30.0]), jnp.array([70.0, 70.0]), jnp.array([1.5, 1.5]))
    for refused in (warp.apply, warp.undo, lambda image: js.lens.Importance(image, 2.0)):
        with pytest.raises(ValueError, match=r"image has weights or holes.*image\.filled\(\)"):
            refused(holed)
    assert warp.apply(holed.filled()).shape == (97, 97)
