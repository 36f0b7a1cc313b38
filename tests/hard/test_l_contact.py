"""Hard case L10: sheets that touch at rest stay at rest, a folded sheet keeps its thickness, and a list serves many nodes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

c = js.contact


def two_sheets(gap):
    """Two square sheets of one net, one above the other, and their places."""
    n = 4
    sheet = js.lattice((n, n), js.STRUCTURAL + js.SHEAR)
    edges = np.concatenate([sheet.edges, sheet.edges + n * n])
    flat = np.c_[sheet.grid(1.0), np.zeros(n * n)]
    return js.Graph.from_edges(edges, 2 * n * n), np.concatenate([flat, flat + np.array([0.1, 0.05, gap])])


@pytest.mark.slow
def test_l10_sheets_closer_than_their_radius_do_not_explode():
    """Two sheets at rest a fifth of a contact distance apart have no force on them, to the bit, and stay; pressed together by a load they
    are pushed apart by the pairs that did not touch at rest alone.
    """
    net, points = two_sheets(0.2)
    rest = net.lengths(points)
    contact = c.NodeContact(net, 0.5, 1e4, 1.0, 0.3, rest=points)
    system = js.System(net, 1.0, (js.Springs(net, 100.0, rest), contact))
    state = js.State.from_points(net, points)
    run = js.rollout(system, state, js.VelocityVerlet(), 2e-3, 300)
    js.raise_for_status(run)
    np.testing.assert_allclose(run.state.points, points, atol=1e-12)
    # Without places at rest the same scene flies apart.
    wild = js.System(net, 1.0, (js.Springs(net, 100.0, rest), c.NodeContact(net, 0.5, 1e4)))
    assert max(float(jnp.max(jnp.abs(a))) for a in wild.force(state)) > 1e3


@pytest.mark.slow
def test_l10_a_folded_sheet_keeps_its_thickness():
    """A strip folded on itself and pressed flat keeps its two layers a ball's diameter apart, less the depth that the load asks; without
    contact they fall through each other.
    """
    n, h, radius, k, load = 10, 0.5, 0.3, 2000.0, 5.0
    net = js.lattice((2, 2 * n))
    flat = np.c_[net.grid(h), np.zeros(4 * n)]
    column = np.tile(np.arange(2 * n), 2)
    is_upper = column >= n
    folded = np.c_[np.where(is_upper, 2 * n - 1 - column, column) * h, flat[:, 1], np.where(is_upper, 0.7, 0.0)]
    # The lower layer is held, the upper one is loaded; the two columns at the fold are left to the springs.
    force = np.where(is_upper[:, None], [0.0, 0.0, -load], 0.0)

    def thickness(*contact):
        forces = (js.Springs(net, 50.0, h), js.Drag(2.0), js.Load.from_points(net, force), *contact)
        free = np.repeat(is_upper[:, None], 3, axis=1) & np.array([False, False, True])
        run = js.rollout(js.System(net, 0.5, forces, free=free), js.State.from_points(net, folded), js.VelocityVerlet(), 4e-3, 1500)
        js.raise_for_status(run)
        return np.asarray(run.state.points)[is_upper & (column > n + 1), 2]

    contact = c.NodeContact(net, radius, k, onset=0.01, rest=flat)
    # Nodes lie on nodes: the two balls under a load stand as deep as it asks. The springs of the fold pull at the columns beside it.
    np.testing.assert_allclose(thickness(contact)[2:], 2 * radius - load / k - 0.005, rtol=5e-3)
    assert thickness().max() < -1.0


@pytest.mark.slow
@pytest.mark.parametrize(("capacity", "serves"), [(128, True), (16, False)])
def test_l10_a_sheet_of_1e4_nodes(capacity, serves):
    """A list with room enough serves a large sheet, so that each node looks at so many others at most; one that is too small says what it
    needs, which is more than the four that are near: the cells of a list fill space, and those of a sheet are few.
    """
    net = js.lattice((100, 100))
    points = np.c_[net.grid(1.0), np.zeros(net.n_nodes)].astype(np.float32)
    contact = c.NodeContact(net, 0.45, 100.0, rest=points, pairs=js.fluid.NeighbourList(capacity, 0.2))
    system = js.System(net, 1.0, contact).bind(jnp.float32)
    begun = jax.jit(lambda system, state: system.begin(state))(system, js.State.from_points(net, points))
    (found,) = system.forces[0].diagnose(begun)
    assert found.flag == js.Flag.NEIGHBOUR_OVERFLOW
    assert (int(found.count) == 0) == serves
    assert serves or 16 < int(found.count) <= 128
