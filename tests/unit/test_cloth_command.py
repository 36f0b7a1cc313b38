"""Scenes of cloth and the command `jaxspring cloth`."""

import json
import math
import signal
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring import cli
from jaxspring.cli import main
from jaxspring.scenes.cloth import command, job, scene

FEW = js.cloth.ClothSettings(size=0.2, spacing=0.05)


@pytest.mark.parametrize(
    "arguments",
    [
        ["nowhere"],
        ["missing.obj"],
        ["--fabric=wool"],
        ["--fabric=0.2,100,100"],
        ["--fabric=0.2,100,100,40,-1"],
        ["--size=0"],
        ["--size=0.02"],
        ["--spacing=1e-4"],
        ["--dt=-0.01"],
        ["--wind=nan"],
        ["--duration=soon"],
        ["--resume"],
    ],
    ids=" ".join,
)
def test_bad_arguments(arguments, tmp_path, capsys):
    """What makes no sense ends with code 2 and one line, and writes nothing."""
    assert main(["cloth", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def held_of(made):
    """(N,) which nodes are held, in the user's order."""
    net, free = made.cloth.net, made.system.free
    return np.zeros(net.n_nodes, bool) if free is None else ~np.asarray(net.flatten_nodes(free))


@pytest.mark.parametrize(("field", "value"), [("size", 0.0), ("spacing", -1.0), ("duration", math.nan), ("dt", math.inf), ("size", 0.03)])
def test_bad_settings_are_named(field, value):
    """A number that no scene can have is refused when the settings are made, by its name."""
    with pytest.raises(ValueError, match=rf"\b{field}\b"):
        js.cloth.ClothSettings(**{field: value})


def test_the_command_names_what_there_is():
    """The names that `--help` shows are those of the scenes, and each published fabric has one."""
    assert tuple(scene.SCENES) == command.NAMES
    for name in command.FABRICS:
        assert getattr(js.cloth, name.upper().replace("-", "_")).fabric().density > 0


@pytest.mark.parametrize(
    ("build", "n_held"),
    [("hanging", 2), ("on_ball", 0), ("on_table", 0), ("flag", 4), ("cantilever", None), ("cusick", None)],
)
def test_a_scene_is_what_it_says(build, n_held):
    """Masses add up to density times area; what is held, and that the sheet begins at rest, clear of what it will lie on."""
    made = getattr(js.cloth, build)(FEW)
    net, points = made.cloth.net, made.points
    corners = points[np.asarray(net.triangles)]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert float(made.cloth.mass.sum()) == pytest.approx(0.187 * area, rel=1e-12)
    held = held_of(made)
    if build == "cusick":
        np.testing.assert_array_equal(held, np.hypot(points[:, 0], points[:, 1]) < 0.09 + 1e-9)
    elif build == "cantilever":  # three rows across it, which lie half a row beyond the clamp, and two before it
        assert len(np.unique(points[held, 0].round(9))) == 3
        assert points[held, 0].max() < 0.05 < 0.06 < points[~held, 0].min()
        assert points[:, 0].max() == pytest.approx(0.2, rel=1e-9)
    else:
        assert held.sum() == n_held
    assert float(jnp.abs(made.state.velocities).max()) == 0
    if made.obstacle is not None:
        assert float(made.obstacle.distance(made.state.position, made.state.time).min()) > 0
    ends = np.concatenate([made.border, made.border[:1]])
    sides = {tuple(sorted(pair)) for pair in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)}
    assert len(sides) == len(made.border)
    assert sides <= {tuple(sorted(edge)) for edge in np.asarray(net.edges).tolist()}


def test_a_mesh_of_ones_own_hangs_from_its_top(tmp_path):
    """A mesh file is cut flat, in any of the fabrics, and held where it is highest; one that is not flat is refused."""
    net, points = js.cloth.rectangle(0.2, 0.2, 0.05)
    js.cloth.save_obj(tmp_path / "mine.obj", js.State.from_points(net, points), net)
    made = command._of_file(str(tmp_path / "mine.obj"), FEW)
    np.testing.assert_array_equal(held_of(made), made.points[:, 1] > 0.19)
    js.cloth.save_obj(tmp_path / "bent.obj", js.State.from_points(net, points + [[0, 0, 0.1]] * (points[:, :1] > 0.1)), net)
    with pytest.raises(ValueError, match="flat"):
        command._of_file(str(tmp_path / "bent.obj"), FEW)


def test_a_mesh_with_two_holes_and_a_turned_triangle_hangs(tmp_path):
    """What springs and hinges do not mind the command does not refuse; fine meshes are held by one row; the checkpoint knows the mesh."""
    net, points = js.cloth.rectangle(0.2, 0.2, 0.05)
    triangles = np.asarray(net.triangles).copy()
    triangles[0] = triangles[0][::-1]
    made = scene.with_mesh(FEW, js.from_triangles(triangles, len(points)), points)
    assert held_of(made).sum() == (points[:, 1] > 0.19).sum()
    assert len(made.border) == 0
    fine, places = js.cloth.rectangle(0.05, 0.4, 0.004)
    assert len(np.unique(places[held_of(scene.with_mesh(FEW, fine, places)), 1].round(6))) == 1
    one, other = (job.ClothRun("mine", scene.with_mesh(FEW, net, size * points)) for size in (1.0, 3.0))
    one._write(tmp_path / "run.npz")
    with pytest.raises(js.CheckpointError, match="mesh"):
        other.read(tmp_path / "run.npz")


@pytest.mark.parametrize("arguments", [("hanging", "--wind", "3"), ("drape", "--size", "0.3"), ("mine.obj", "--spacing", "0.1")])
def test_what_a_scene_does_not_read_is_refused(arguments, tmp_path, capsys):
    """An option that does nothing is an error that names it."""
    assert main(["cloth", *arguments, "--out", str(tmp_path / "out")]) != 0
    assert arguments[1] in capsys.readouterr().err


def test_the_drape_coefficient_of_shadows_known():
    """1 flat, and (s^2 R^2 - r^2) / (R^2 - r^2) of a disc shrunk by s, up to the polygon's area; its gradient is the differences'."""
    made = js.cloth.cusick(js.cloth.ClothSettings(spacing=0.01))
    net = made.cloth.net

    def coefficient(points):
        return js.cloth.drape_coefficient(made, js.State.from_points(net, points))

    assert float(coefficient(made.points)) == pytest.approx(1, abs=1e-14)
    for s in (0.9, 0.7):
        shrunk = float(coefficient(made.points * s))
        assert shrunk == pytest.approx((s**2 * 0.15**2 - 0.09**2) / (0.15**2 - 0.09**2), abs=2e-3)
    away = np.random.default_rng(0).normal(size=made.points.shape)
    slope = float(jnp.sum(jax.grad(coefficient)(jnp.asarray(made.points)) * away))
    h = 1e-6
    assert slope == pytest.approx(float(coefficient(made.points + h * away) - coefficient(made.points - h * away)) / (2 * h), rel=1e-8)


def test_the_chord_of_a_strip_turned_by_an_angle():
    """A strip turned about the edge of its clamp has that angle for its chord."""
    made = js.cloth.cantilever(FEW)
    x = made.points[:, 0]
    for degrees in (0.0, 41.5, 80.0):
        turned = made.points.copy()
        turned[:, 0], turned[:, 2] = x * math.cos(math.radians(degrees)), -x * math.sin(math.radians(degrees))
        found = scene.chord_angle(made, js.State.from_points(made.cloth.net, turned))
        assert float(found) == pytest.approx(degrees, abs=1e-9)


def test_a_scene_of_another_fabric():
    """It is what the settings make of that fabric, held and blown alike, and inside jit its numbers have derivatives."""
    settings = js.cloth.ClothSettings(size=0.2, spacing=0.05, wind=3.0)
    denim = replace(settings, material=js.cloth.DENIM)
    for build in (js.cloth.flag, js.cloth.on_ball):
        for a, b in zip(jax.tree.leaves(build(settings).made_of(js.cloth.DENIM)), jax.tree.leaves(build(denim)), strict=True):
            np.testing.assert_array_equal(a, b)
    made = js.cloth.cusick(settings)

    def moment(bending):
        return jnp.sum(made.made_of(js.cloth.Fabric(0.2, 100.0, 40.0, bending)).cloth.bending.stiffness)

    value, slope = jax.jit(jax.value_and_grad(moment))(4e-5)
    assert float(slope) == pytest.approx(float(value) / 4e-5, rel=1e-12)


@pytest.mark.slow
def test_a_small_cloth(tmp_path, capsys, monkeypatch):
    """A draped disc gives the whole folder, and its energy only falls; an interrupted run leaves an older folder as it is, and goes on to
    the same report and the same mesh.
    """
    out = tmp_path / "out"
    run = ["cloth", "drape", "--spacing", "0.05", "--duration", "0.2", "--dt", "0.02", "--out", str(out)]
    assert main(run) == 0
    names = ["cloth.gif", "cloth.obj", "energy.png", "frames", "last.png", "report.json", "strip.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    assert len(list((out / "frames").glob("*.vtu"))) == 11
    report = json.loads((out / "report.json").read_text())
    assert 0 < report["largest_strain"] < 0.1
    assert 0 < report["drape_coefficient"] < 1
    assert len(report["time_s"]) == 11
    assert report["time_s"][-1] == pytest.approx(0.2, rel=1e-6)
    total = np.sum(list(report["energy_J"].values()), axis=0)
    assert np.all(np.diff(total) < 1e-6 * np.ptp(report["energy_J"]["Gravity"]))
    assert "drape coefficient" in capsys.readouterr().out
    older = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}

    usual = js.progress.draw_bar

    def interrupt(label, done, total, *rest, **named):
        if done == 5:
            signal.raise_signal(signal.SIGINT)
        usual(label, done, total, *rest, **named)

    monkeypatch.setattr(job, "draw_animation", lambda path, *_: path.touch())  # the slowest parts
    monkeypatch.setattr(job, "draw_strip", lambda path, *_: path.touch())
    with monkeypatch.context() as patch:
        patch.setattr(js.progress, "draw_bar", interrupt)
        assert main(run) == cli.INTERRUPTED
    assert capsys.readouterr().err.splitlines()[-1].endswith("--resume goes on.")
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == older
    assert main([*run, "--fabric", "denim", "--resume"]) == cli.UNUSABLE
    assert "problem" in capsys.readouterr().err
    assert main([*run, "--resume"]) == 0
    again = json.loads((out / "report.json").read_text())
    for one in (report, again):
        del one["seconds"]
    assert again == report
    assert (out / "cloth.obj").read_bytes() == older[out / "cloth.obj"]
