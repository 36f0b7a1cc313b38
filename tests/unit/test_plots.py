"""Pictures: what is drawn is where the springs are."""

import dataclasses
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from PIL import Image

import jaxspring as js
from jaxspring.plots import animate, plot


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


def sheet(dim, rng):
    net = js.lattice((3, 4), springs=js.STRUCTURAL + js.SHEAR)
    points = np.zeros((12, dim))
    points[:, :2] = net.grid()
    return net, js.State.from_points(net, points + 0.1 * rng.normal(size=points.shape))


@pytest.mark.parametrize("dim", [2, 3])
def test_each_spring_is_a_line_between_its_nodes(dim, rng):
    """One segment per spring, from its tail to its head, axes labelled with their unit."""
    net, state = sheet(dim, rng)
    axes = plot(net, state, length_unit="mm")
    (lines,) = axes.collections
    segments = np.asarray(lines._segments3d) if dim == 3 else np.asarray(lines.get_segments())
    np.testing.assert_allclose(segments, np.asarray(state.points)[net.edges], atol=1e-12)
    assert axes.get_xlabel() == "x (mm)"
    assert axes.get_ylabel() == "y (mm)"


def test_colour_follows_the_tension(rng):
    """The colours are the tensions in the user's order, with a bar that names them; an edge field and a flat array agree."""
    net, state = sheet(2, rng)
    tension = js.Springs(net, 2.0, 0.9).tension(state)
    for color in (tension, np.asarray(net.flatten(tension))):
        axes = plot(net, state, color=color)
        np.testing.assert_array_equal(axes.collections[0].get_array(), net.flatten(tension))
        assert axes.figure.axes[1].get_ylabel() == "tension (N)"
    with pytest.raises(ValueError, match="one per spring"):
        plot(net, state, color=np.ones(3))


def test_a_spring_across_a_period_is_short():
    """On a ring the last spring is drawn to the nearest image, not across the picture."""
    net = js.lattice(5, periodic=True, box=(5.0,))
    lines = plot(net, js.State.from_points(net, net.grid())).collections[0]
    lengths = [np.linalg.norm(b - a) for a, b in lines.get_segments()]
    np.testing.assert_allclose(lengths, 1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_broken_springs_are_not_drawn(dim, rng):
    """Only whole springs are lines, with their own colours; a node that no spring holds is a dot, a held one a square."""
    net, state = sheet(dim, rng)
    alive = ~(net.edges == 0).any(axis=1)
    alive[3] = False
    state = dataclasses.replace(state, alive=net.split(jnp.asarray(alive)))
    free = np.ones((12, dim), bool)
    free[5, 0] = free[7, 1] = False
    axes = plot(net, state, color=np.arange(net.n_springs), system=js.System(net, 1.0, free=free))
    lines, dots, squares = axes.collections
    segments = np.asarray(lines._segments3d) if dim == 3 else np.asarray(lines.get_segments())
    np.testing.assert_allclose(segments, np.asarray(state.points)[net.edges[alive]], atol=1e-12)
    np.testing.assert_array_equal(lines.get_array(), np.arange(net.n_springs)[alive])
    for marks, nodes in ((dots, [0]), (squares, [5, 7])):
        shown = np.stack(marks._offsets3d, -1) if dim == 3 else marks.get_offsets()
        np.testing.assert_allclose(shown, np.asarray(state.points)[nodes], atol=1e-12)
    other = js.lattice((3, 4))
    assert len(plot(other, state).collections[0].get_segments() if dim == 2 else plot(other, state).collections[0]._segments3d) == 17


def test_axes_of_the_user_are_drawn_on(rng):
    """Given axes are used and returned."""
    net, state = sheet(2, rng)
    _, mine = pyplot.subplots()
    assert plot(net, state, axes=mine) is mine


@pytest.mark.parametrize("dim", [2, 3])
def test_animation_has_one_picture_per_frame(dim, rng, tmp_path):
    """A run with 3 saved frames gives a GIF of 3 pictures, and no figure is left open."""
    net, state = sheet(dim, rng)
    result = js.rollout(js.System(net, 1.0, js.Springs(net, 2.0, 0.9)), state, js.SymplecticEuler(), 0.1, 30, save_every=10)
    path = animate(result, net, tmp_path / "run.gif")
    with Image.open(path) as picture:
        assert picture.format == "GIF"
        assert picture.n_frames == 3
    assert pyplot.get_fignums() == []


def test_what_cannot_be_drawn(rng, tmp_path):
    """No saved states, a frame that is not finite, and several states at once are errors that say what to do."""
    net, state = sheet(2, rng)
    system = js.System(net, 1.0, js.Springs(net, 2.0, 0.9))
    result = js.rollout(system, state, js.SymplecticEuler(), 0.1, 2)
    with pytest.raises(ValueError, match="save_every"):
        animate(result, net, tmp_path / "run.gif")
    bad = js.State(state.time, state.position * np.nan, state.velocity, state.layout)
    with pytest.raises(ValueError, match="NaN"):
        plot(net, bad)
    many = js.rollout(system, state, js.SymplecticEuler(), 0.1, 2, save_every=1).saved
    with pytest.raises(ValueError, match="one state"):
        plot(net, many)
    with pytest.raises(ValueError, match=r"end in \.gif"):
        animate(dataclasses.replace(result, saved=many), net, tmp_path / "run.mp4")
    with pytest.raises(FileNotFoundError, match="no folder"):
        animate(dataclasses.replace(result, saved=many), net, tmp_path / "none" / "run.gif")
    (tmp_path / "run.gif").write_bytes(b"older")
    broken = dataclasses.replace(many, position=many.position * np.array([1.0, np.nan])[:, None, None])
    with pytest.raises(ValueError, match="NaN"):
        animate(dataclasses.replace(result, saved=broken), net, tmp_path / "run.gif")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("run.gif", b"older")]


def test_without_matplotlib_the_error_names_the_extra(rng, monkeypatch):
    """Where matplotlib is missing, the ImportError tells what to install."""
    net, state = sheet(2, rng)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"jaxspring\[viz\]"):
        plot(net, state)
