"""Files hold nodes and springs in the user's order; older files are read, or refused with what to do."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.archive import CheckpointError, read_archive, write_archive
from jaxspring.files import edge_fields, topologies

NET = js.Graph.from_edges([(0, 5), (5, 2), (2, 1), (1, 4), (4, 3), (0, 2)], 6)
POINTS = np.random.default_rng(3).normal(size=(6, 2))


def state_of(net):
    """A state whose every field tells its place in the user's order."""
    start = js.State.from_points(net, POINTS, 2 * POINTS, temperature=np.arange(6.0))
    alive = np.arange(net.n_springs) % 2 == 0
    return start.with_alive(net, net.split(jnp.asarray(alive)))


@pytest.mark.parametrize("net", [NET, NET.with_edges([(3, 0), (4, 2)]), js.lattice((2, 3))], ids=["graph", "overlay", "lattice"])
def test_a_file_holds_the_users_order(net, tmp_path):
    """What stands in the file is what the user passed, node by node and spring by spring; it comes back bit for bit."""
    state = state_of(net)
    js.save(tmp_path / "s.npz", state)
    held = js.load(tmp_path / "s.npz")
    np.testing.assert_array_equal(np.stack([held[f"position/components/{i}"].ravel() for i in range(2)], axis=1), POINTS)
    np.testing.assert_array_equal(held["temperature"].ravel(), np.arange(6.0))
    if net.node_permutation is not None:
        np.testing.assert_array_equal(held["alive/families/0"], np.arange(net.n_springs) % 2 == 0)
    back = js.load(tmp_path / "s.npz", like=state)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_system_comes_back(tmp_path):
    """Masses, held nodes and fields of springs of a renumbered graph come back, and stand in the file as they were given."""
    mass, k, free = np.arange(1.0, 7.0), np.arange(1.0, 7.0), np.arange(6) > 1
    system = js.System(NET, mass, js.Springs(NET, NET.edge_field(k), 1.0), free=free)
    js.save(tmp_path / "s.npz", system)
    held = js.load(tmp_path / "s.npz")
    np.testing.assert_array_equal(held["mass"], mass)
    np.testing.assert_array_equal(held["free"], free)
    np.testing.assert_array_equal(held["forces/0/stiffness/families/0"], k)
    other = js.System(NET, 2.0 * mass, js.Springs(NET, NET.edge_field(2 * k), 2.0), free=~free)
    back = js.load(tmp_path / "s.npz", like=other)
    for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(system), strict=True):
        np.testing.assert_array_equal(a, b)


def test_stacked_systems_come_back(tmp_path):
    """A batch of systems of one renumbered graph, and of a net over it: counts, edges and every array."""
    for net in (NET, NET.with_edges([(3, 0), (4, 2)])):
        systems = [js.System(net, k * np.arange(1.0, 7.0), js.Springs(net, k, 1.0), free=np.arange(6) > 1) for k in (1.0, 2.0, 3.0)]
        batch = jax.tree.map(lambda *a: jnp.stack(a), *systems)
        assert f" {net.n_springs} springs" in str(batch)
        np.testing.assert_array_equal(batch.net.edges, net.edges)
        js.save(tmp_path / "s.npz", batch)
        np.testing.assert_array_equal(js.load(tmp_path / "s.npz")["mass"], np.outer([1, 2, 3], np.arange(1.0, 7.0)))
        back = js.load(tmp_path / "s.npz", like=batch)
        for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(batch), strict=True):
            np.testing.assert_array_equal(a, b)


def old_file(path, tree, more=()):
    """As the form before wrote it: arrays as the library keeps them, and no form."""
    arrays = {}
    for place, leaf in jax.tree_util.tree_leaves_with_path(tree):
        arrays[jax.tree_util.keystr(place, simple=True, separator="/")] = np.asarray(leaf)
    write_archive(path, arrays | dict(more), {"kind": "tree", "topologies": topologies(tree), "edge_fields": edge_fields(tree)})


def test_an_older_file_is_read(tmp_path):
    """A state of the form before, in the graph's own order and with a list of neighbours, is read; the list is left out."""
    state = state_of(NET)
    old_file(tmp_path / "old.npz", state, {"neighbours/edge": np.asarray(2.5)})
    assert "form" not in read_archive(tmp_path / "old.npz").about
    back = js.load(tmp_path / "old.npz", like=dataclasses.replace(state, time=jnp.asarray(9.0)))
    np.testing.assert_array_equal(back.points, POINTS)
    np.testing.assert_array_equal(NET.flatten(back.alive), NET.flatten(state.alive))


def test_what_an_older_file_kept_otherwise_is_refused(tmp_path):
    """Books of a ledger, and a heat on a graph, of the form before: refused with the form and what to do."""
    state = state_of(NET)
    old_file(tmp_path / "books.npz", state, {"ledger/start": np.zeros(3)})
    with pytest.raises(CheckpointError, match=r"form 1 and holds a ledger's books.*state\.memory.*jaxspring that wrote it"):
        js.load(tmp_path / "books.npz", like=state)
    system = js.System(NET, 1.0, rules=js.Heat(NET, np.arange(1.0, 7.0), 1.0))
    old_file(tmp_path / "heat.npz", system)
    with pytest.raises(CheckpointError, match=r"form 1 and holds a Heat on a graph.*or run again"):
        js.load(tmp_path / "heat.npz", like=system)
