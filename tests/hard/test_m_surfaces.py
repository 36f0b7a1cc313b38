"""Hard cases of surfaces: steps in every position, and refinement that is undone."""

import numpy as np
import pytest

import jaxspring as js
from jaxspring.scenes.reconstruction.break_lines import Faces

SIDE, NOISE = 25, 0.03


def broken(truth, step=0.5):
    """Breaks of a lattice over noisy data, and which springs straddle a step of more than half a unit."""
    net = js.lattice((SIDE, SIDE))
    p = np.asarray(net.grid())
    data = truth(*p.T) + NOISE * np.random.default_rng(5).standard_normal(len(p))
    found = js.reconstruction.find_breaks(net, p, data, 1.0, 0.3, step)
    ends, ring = np.asarray(net.edges), Faces.of(net).ring
    straddling = (np.abs(np.diff(truth(*p.T)[ends], axis=1)[:, 0]) > 0.5) & ~ring
    return found, straddling, ring


@pytest.mark.parametrize(
    "truth",
    [
        lambda x, y: np.where(x > y + 0.5, 1.0, 0.0),
        lambda x, y: np.where(x > 0.5, 1.0, 0.0),
        lambda x, y: np.where(x > 11.5, 1.0, 0.0) + np.where(y > 13.5, 0.9, 0.0),
    ],
    ids=["along a diagonal", "at the border", "two that cross"],
)
def test_m3_steps_break_and_the_ring_holds(truth):
    """All springs across a step are broken, a few others beside the ring at most; the ring is kept, and pieces have their heights."""
    found, straddling, ring = broken(truth)
    assert not found.broken[ring].any()
    assert found.broken[straddling].mean() > 0.95
    extra = found.broken & ~straddling
    assert extra.sum() <= 8
    x, y = found.points.T
    inner = (np.abs(found.points - (SIDE - 1) / 2) < (SIDE - 1) / 2 - 1.5).all(axis=1)
    assert np.abs(found.heights - truth(x, y))[inner].max() < 0.15


def test_m3_a_step_lower_than_the_noise_stays_whole():
    """With a price of three times the noise."""
    found, _, _ = broken(lambda x, y: np.where(x > 11.5, 0.5 * NOISE, 0.0), step=3 * NOISE)
    assert found.n_broken == 0


def test_m4_refine_twice_coarsen_twice():
    """The same mesh, node by node and spring by spring; the surface unmoved to rounding at every stage."""
    net = js.delaunay(np.random.default_rng(2).random((40, 2)))
    points = np.random.default_rng(2).random((40, 2))
    heights = np.sin(9 * points[:, :1]) + points[:, 1:] ** 2
    first = js.reconstruction.Subdivision.of(net.triangles, 40, 1 + np.arange(net.n_springs) / 10)
    surface = np.hstack([points, heights])
    second = first.refined(np.ones(len(first.triangles), bool))
    third = second.refined(np.ones(len(second.triangles), bool))
    on_third = third.carried(second.carried(surface, first), second)
    # Every new node lies on the first surface: the mean of the corners of its side.
    np.testing.assert_allclose(on_third, third.carried(surface, first), atol=1e-15)
    back = third.coarsened(np.ones(len(third.triangles), bool))
    again = back.coarsened(np.ones(len(back.triangles), bool))
    for now, before in ((back, second), (again, first)):
        np.testing.assert_array_equal(now.triangles, before.triangles)
        np.testing.assert_array_equal(now.net.edges, before.net.edges)
        for one, other in zip(now.stiffness(), before.stiffness(), strict=True):
            np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(again.carried(back.carried(on_third, third), back), surface)
