"""Saving and loading: systems, states, plain trees and trajectories."""

import json
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.archive import CheckpointError, atomic_folder, read_archive, remove_leftovers, write_archive
from jaxspring.files import load, save, save_trajectory


def swing(shape=(3, 4), stiffness=None):
    """A small system on a lattice, with a stiffness per spring."""
    net = js.lattice(shape, springs=js.STRUCTURAL + js.SHEAR)
    k = np.linspace(1.0, 2.0, net.n_springs) if stiffness is None else stiffness
    return js.System(net, 0.5, (js.Springs(net, k, 0.9), js.Drag(0.1), js.Gravity((0.0, -9.81))), free=np.arange(net.n_nodes) > 0)


def test_a_system_comes_back_bitwise(tmp_path):
    """Every constant and mask of a loaded system is the saved one, in a system built with other numbers."""
    save(tmp_path / "a.npz", swing())
    back = load(tmp_path / "a.npz", like=swing(stiffness=np.ones(swing().net.n_springs)))
    assert eqx.tree_equal(back, swing())


def test_a_state_comes_back_bitwise(tmp_path, rng):
    """Time, positions and velocities of a graph's state."""
    net = js.Graph.from_edges([[0, 1], [1, 2], [2, 3], [3, 0]], 4)
    state = js.State.from_points(net, rng.normal(size=(4, 2)), rng.normal(size=(4, 2)), time=3.5)
    save(tmp_path / "s.npz", state)
    assert eqx.tree_equal(load(tmp_path / "s.npz", like=js.State.from_points(net, np.zeros((4, 2)))), state)


def test_numbers_and_functions(tmp_path):
    """Python numbers come back as their own type; functions are those of `like`."""
    tree = {"count": 3, "on": True, "k": 2.5, "law": np.sin, "array": jnp.arange(3)}
    save(tmp_path / "t.npz", tree)
    back = load(tmp_path / "t.npz", like={"count": 0, "on": False, "k": 0.0, "law": np.cos, "array": jnp.zeros(3, int)})
    assert (back["count"], back["on"], back["k"], back["law"]) == (3, True, 2.5, np.cos)
    assert type(back["count"]) is int
    assert type(back["on"]) is bool
    assert isinstance(back["array"], jax.Array)


def test_names_are_paths_and_numpy_reads_them(tmp_path):
    """The file is an `.npz` that NumPy opens without pickles, with a name per leaf."""
    save(tmp_path / "a.npz", swing())
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["forces/0/stiffness"], np.linspace(1.0, 2.0, swing().net.n_springs))
        assert json.loads(file["header.json"].item())["version"] == 1
    assert set(load(tmp_path / "a.npz")) == {"mass", "forces/0/stiffness", "forces/0/rest_length", "forces/1/gamma"} | {
        "forces/2/acceleration",
        "free",
    }


def test_the_same_tree_gives_the_same_bytes(tmp_path):
    """No time stamps: equal trees are equal files."""
    save(tmp_path / "a.npz", swing())
    save(tmp_path / "b.npz", swing())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(
    ("like", "words"),
    [
        (lambda: swing().forces, r"its topology is .*'net'.*; expected .*'0/net'"),
        (lambda: swing((4, 3)), r"its topology is .*\[3, 4\].*; expected .*\[4, 3\]"),
        (lambda: swing(stiffness=1.0), r"'forces/0/stiffness' has shape \(29,\) and dtype float64; expected shape \(\)"),
    ],
    ids=["structure", "topology", "shape"],
)
def test_a_file_that_does_not_fit_is_refused(like, words, tmp_path):
    """Both sides are named, with the file."""
    save(tmp_path / "a.npz", swing())
    with pytest.raises(CheckpointError, match=rf"a\.npz: {words}"):
        load(tmp_path / "a.npz", like=like())


def test_missing_and_unknown_names_are_listed(tmp_path):
    """What the file lacks, and what it has too much."""
    save(tmp_path / "a.npz", {"k": 1.0, "old": 2.0})
    with pytest.raises(CheckpointError, match=r"a\.npz: it lacks \['new'\] and has \['old'\] that `like` does not know"):
        load(tmp_path / "a.npz", like={"k": 0.0, "new": 0.0})


@pytest.mark.parametrize(
    ("tree", "error", "words"),
    [
        ({"x": np.array([None])}, TypeError, "x has dtype object"),
        ({"x": np.array(["word"])}, TypeError, "x has dtype <U4"),
        ({"x": jnp.zeros(2, jnp.bfloat16)}, TypeError, "x has dtype bfloat16"),
        ({"x": jax.random.key(0)}, TypeError, "x is a random key"),
        ({"../../x": 1.0}, ValueError, r"'../../x' is not a name"),
        ({"a/b": 1.0, "a": {"b": 2.0}}, ValueError, "Two leaves are called 'a/b'"),
        ({"a": {"": 1.0}}, ValueError, r"'a/' is not a name"),
    ],
    ids=str,
)
def test_what_cannot_be_saved_is_refused(tree, error, words, tmp_path):
    """The leaf is named, and neither the file nor a temporary one is left."""
    with pytest.raises(error, match=words):
        save(tmp_path / "a.npz", tree)
    assert os.listdir(tmp_path) == []


def test_a_missing_file_or_folder_is_a_missing_file(tmp_path):
    """FileNotFoundError, as from `open`."""
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nothing.npz")
    with pytest.raises(FileNotFoundError, match="nowhere is no folder"):
        save(tmp_path / "nowhere" / "a.npz", {"a": 1.0})


def test_leftovers_are_removed(tmp_path):
    """Temporary files of killed writers of this path go, those of others stay."""
    (tmp_path / ".a.npz.12345678.tmp").touch()
    (tmp_path / ".b.npz.12345678.tmp").touch()
    remove_leftovers(tmp_path / "a.npz")
    assert os.listdir(tmp_path) == [".b.npz.12345678.tmp"]


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    """New and replaced folders hold all that was written; after an error the old one is as it was, and nothing else is left."""
    target = tmp_path / "out"
    for text in ("first", "second"):
        with atomic_folder(target) as folder:
            assert not (target / text).exists()
            (folder / text).touch()
    assert os.listdir(target) == ["second"]

    def interrupted():
        with atomic_folder(target) as folder:
            (folder / "third").touch()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.listdir(tmp_path) == ["out"]
    assert os.listdir(target) == ["second"]


def test_an_archive_keeps_its_note(tmp_path):
    """What the writer noted beside the arrays comes back, and so do no arrays at all."""
    write_archive(tmp_path / "a.npz", {}, {"why": "a test", "n": 3})
    archive = read_archive(tmp_path / "a.npz")
    assert (archive.arrays, archive.about) == ({}, {"why": "a test", "n": 3})


@pytest.mark.slow
def test_a_trajectory_opens_in_numpy(tmp_path):
    """Frames, times and edges of a rollout, in the user's order."""
    net = js.Graph.from_edges([[3, 1], [1, 0], [0, 2]], 4)
    system = js.System(net, 1.0, (js.Springs(net, 1.0, 1.0), js.Drag(0.1)))
    start = js.State.from_points(net, np.arange(8.0).reshape(4, 2) ** 1.1)
    result = js.rollout(system, start, js.SymplecticEuler(), dt=0.1, n_steps=6, save_every=2)
    save_trajectory(tmp_path / "run.npz", result, net)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:
        np.testing.assert_allclose(file["time"], [0.2, 0.4, 0.6])
        assert file["points"].shape == file["velocities"].shape == (3, 4, 2)
        np.testing.assert_array_equal(file["points"][-1], result.state.points)
        np.testing.assert_array_equal(file["edges"], [[3, 1], [1, 0], [0, 2]])
    with pytest.raises(ValueError, match=r"no frames of whole states"):
        save_trajectory(tmp_path / "no.npz", js.rollout(system, start, js.SymplecticEuler(), dt=0.1, n_steps=2))
    with pytest.raises(ValueError, match=r"no frames of whole states"):
        save_trajectory(tmp_path / "no.npz", start)
