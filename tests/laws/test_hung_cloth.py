"""Cloth and chains that hang: exact stretches of a sheet, the catenary to second order."""

import numpy as np
import pytest

import jaxspring as js

G = 9.81


def test_a_hung_sheet_stretches_by_what_it_carries():
    """Held by its upper row, columns alone (no shear): the j-th row from below is stretched by j m g / k, to rounding."""
    ny, nx, h, k, m = 6, 5, 0.1, 80.0, 0.02
    net, points, springs = js.cloth.provot((ny, nx), h, stretch=(30.0, k), shear=0.0)
    stretches = np.arange(1, ny) * m * G / k
    y = np.concatenate([[0.0], np.cumsum(h + stretches)]) - (ny - 1) * h - stretches.sum()
    hung = points.copy()
    hung[:, 1] = np.repeat(y, nx)
    free = np.repeat(np.arange(ny) < ny - 1, nx)
    system = js.System(net, m, (springs, js.Gravity((0.0, -G, 0.0))), free=free)
    acceleration = system.acceleration(js.State.from_points(net, hung))
    assert max(float(abs(a).max()) for a in acceleration) < 1e-12 * k * h / m
    reaction = system.reaction(js.State.from_points(net, hung))
    assert float(reaction.y[-1].sum()) == pytest.approx(ny * nx * m * G, rel=1e-13)


def sag(n_links, span=10.0, length=20.0, stiffness=1e7):
    """Depth of the middle of a chain of stiff links hung by both ends, each inner node of the weight 1 N, found as a shape at rest."""
    net = js.lattice(n_links + 1)
    link = length / n_links
    free = np.ones(n_links + 1, bool)
    free[[0, -1]] = False
    system = js.System(net, 1.0, (js.Springs(net, stiffness, link), js.Gravity((0.0, -1.0))), free=free)
    x = np.linspace(0, span, n_links + 1)
    start = np.stack([x, -8 * (1 - (2 * x / span - 1) ** 2)], axis=-1)
    found = js.equilibrium(system, js.State.from_points(net, start), tolerance=1e-8)
    js.raise_for_status(found)
    return -float(found.state.points[n_links // 2, 1])


def test_a_chain_hangs_in_a_catenary():
    """Span 10, length 20: sag 8.04371 of 10 links and 7.98273 of 20, by the law of stiff links; against 7.9638836 of second order."""
    coarse, fine = sag(10), sag(20)
    assert coarse == pytest.approx(8.04371, abs=1.5e-5)
    assert fine == pytest.approx(7.98273, abs=1.5e-5)
    continuum = 7.9638836
    assert np.log2((coarse - continuum) / (fine - continuum)) == pytest.approx(2, abs=0.1)
