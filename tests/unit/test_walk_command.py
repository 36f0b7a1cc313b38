"""The robot and the command `jaxspring walk`."""

import json
import math
import signal

import numpy as np
import pytest

import jaxspring as js
from jaxspring import cli
from jaxspring.cli import main
from jaxspring.scenes.robot import job


@pytest.mark.parametrize(
    "argument", ["--iterations=-1", "--depth=99", "--depth=x", "--body=##/#", "--body=....", "--duration=0", "--duration=99", "--seed=a"]
)
def test_bad_arguments(argument, tmp_path, capsys):
    """What makes no sense ends with code 2 and one line, and writes nothing."""
    assert main(["walk", argument, "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("body", ("##", "#")),
        ("body", ("ab",)),
        ("body", ("..",)),
        ("depth", -1),
        ("cell", 0.0),
        ("node_mass", -1.0),
        ("stiffness", math.nan),
        ("friction", -0.1),
        ("reach", 1.0),
        ("dt", 0.0),
        ("duration", 1e-4),
    ],
)
def test_bad_settings_are_named(field, value):
    """A number or a drawing that the scene cannot have is refused when the settings are made, by its name."""
    with pytest.raises(ValueError, match=rf"\b{field}\b"):
        js.robot.RobotSettings(**{field: value})


def test_a_body_is_what_is_drawn():
    """Nodes and springs of a cell and of a cube; sides are driven, diagonals not; cells share what they have in common."""
    square = js.robot.body_of_cells(("#",), 0.5)
    assert sorted(map(tuple, square.points)) == [(0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5)]
    lengths = np.asarray(square.net.lengths(square.points))
    np.testing.assert_allclose(lengths, np.where(square.groups >= 0, 0.5, 0.5 * math.sqrt(2)))
    assert sorted(square.groups) == [-1, -1, 0, 1, 2, 3]
    cube = js.robot.body_of_cells(("#",), 1.0, depth=1)
    assert (cube.points.shape, cube.net.n_springs, int((cube.groups >= 0).sum())) == ((8, 3), 28, 12)
    legs = js.robot.body_of_cells(("###", "#.#"), 1.0)
    assert (len(legs.points), int((legs.groups >= 0).sum()), int((legs.groups < 0).sum())) == (12, 16, 10)
    assert legs.points[:, 1].min() == 0
    assert sorted(legs.points[legs.points[:, 1] == 0][:, 0]) == [0, 1, 2, 3]


@pytest.mark.slow
def test_a_body_of_ones_own_and_three_dimensions():
    """A net with points makes a robot in which every spring is driven; `depth` makes one in three dimensions. Both stay on the ground."""
    net = js.from_triangles([[0, 1, 2], [1, 3, 2]], 4)
    points = np.array([[0.0, 0.0], [0.1, 0.0], [0.05, 0.1], [0.15, 0.1]])
    with pytest.raises(ValueError, match="points"):
        js.robot.walking_robot(net=net)
    settings = js.robot.RobotSettings(body=("#",), depth=1)
    for robot, n_commands, dim in (
        (js.robot.walking_robot(settings, net=net, points=points), 5, 2),
        (js.robot.walking_robot(settings), 12, 3),
    ):
        assert robot.controller.second.shape[0] == n_commands
        run = js.robot.walk(robot, n_steps=50)
        js.raise_for_status(run)
        assert run.state.dim == dim
        assert float(run.state.position[-1].min()) >= 0
        assert float(abs(robot.system.recall(run.state, 0) - 1).max()) > 0.01


@pytest.mark.slow
def test_a_small_robot(tmp_path, capsys, monkeypatch):
    """A small robot learns, and the whole folder is written; an interrupted training leaves an older folder as it is, and goes on to the
    same weights, distances and report.
    """
    out = tmp_path / "out"
    run = ["walk", "--body", "##", "--duration", "0.4", "--iterations", "12", "--out", str(out)]
    assert main(run) == 0
    assert sorted(path.name for path in out.iterdir()) == ["checkpoint.npz", "learning.png", "report.json", "walking.gif", "walks.png"]
    report = json.loads((out / "report.json").read_text())
    assert len(report["distance_m"]) == 13
    assert report["walked_m"]["before"] == pytest.approx(report["distance_m"][0], abs=1e-5)
    assert report["walked_m"]["after"] == pytest.approx(max(report["distance_m"]), abs=1e-5)
    assert report["walked_m"]["after"] > max(0.0, report["walked_m"]["before"])
    assert report["lowest_node_m"] >= 0
    assert "after" in capsys.readouterr().out
    weights = (out / "checkpoint.npz").read_bytes()
    older = {path: path.read_bytes() for path in out.iterdir()}

    usual = job.draw_bar

    def interrupt(label, done, total, note=""):
        if done == 11:
            signal.raise_signal(signal.SIGINT)
        usual(label, done, total, note=note)

    with monkeypatch.context() as patch:
        patch.setattr(job, "draw_bar", interrupt)
        assert main(run) == cli.INTERRUPTED
    assert capsys.readouterr().err.splitlines()[-1].endswith("iterations; the same command with --resume goes on.")
    assert {path: path.read_bytes() for path in out.iterdir()} == older
    assert main([*run, "--duration", "0.2", "--resume"]) == cli.UNUSABLE
    assert "problem" in capsys.readouterr().err
    monkeypatch.setattr(job, "draw_animation", lambda path, *_: path.touch())  # the slowest part
    assert main([*run, "--resume"]) == 0
    again = json.loads((out / "report.json").read_text())
    for one in (report, again):
        del one["seconds"]
    assert again == report
    assert len((out / "checkpoint.npz").read_bytes()) == len(weights)
