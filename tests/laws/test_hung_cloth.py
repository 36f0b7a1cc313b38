"""Cloth and chains that hang: exact stretches of a sheet, the catenary to second order."""

import jax
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
    acceleration, reaction = jax.jit(lambda s: (system.acceleration(s), system.reaction(s)))(js.State.from_points(net, hung))
    assert max(float(abs(a).max()) for a in acceleration) < 1e-12 * k * h / m
    assert float(reaction.y[-1].sum()) == pytest.approx(ny * nx * m * G, rel=1e-13)


def sags(numbers, span=10.0, length=20.0, stiffness=1e7):
    """Depth of the middle of chains of stiff links hung by both ends, each inner node of the weight 1 N, found as one shape at rest."""
    edges, rest, start, free = [], [], [], []
    for n in numbers:
        first = len(free)
        edges += [(first + i, first + i + 1) for i in range(n)]
        rest += n * [length / n]
        start += [(span * i / n, -8 * (1 - (2 * i / n - 1) ** 2)) for i in range(n + 1)]
        free += [0 < i < n for i in range(n + 1)]
    net = js.Graph.from_edges(edges, len(free))
    system = js.System(net, 1.0, (js.Springs(net, stiffness, rest), js.Gravity((0.0, -1.0))), free=np.array(free))
    found = js.equilibrium(system, js.State.from_points(net, start), tolerance=1e-8)
    js.raise_for_status(found)
    ends = np.cumsum(np.array(numbers) + 1)
    return [-float(found.state.points[end - 1 - n // 2, 1]) for end, n in zip(ends, numbers, strict=True)]


def test_a_chain_hangs_in_a_catenary():
    """Span 10, length 20: sag 8.04371 of 10 links and 7.98273 of 20, by the law of stiff links; against 7.9638836 of second order."""
    coarse, fine = sags([10, 20])
    assert coarse == pytest.approx(8.04371, abs=1.5e-5)
    assert fine == pytest.approx(7.98273, abs=1.5e-5)
    continuum = 7.9638836
    # log2(8.04371 - continuum) - log2(7.98273 - continuum) = 2.08, and 2.003 from 100 links to 200.
    assert np.log2((coarse - continuum) / (fine - continuum)) == pytest.approx(2, abs=0.1)
