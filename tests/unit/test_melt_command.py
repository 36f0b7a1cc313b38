"""The command `jaxspring melt`."""

import json
import math
import signal
import sys

import jax
import numpy as np
import pytest

import jaxspring as js
from jaxspring import cli
from jaxspring.cli import main
from jaxspring.scenes import parts
from jaxspring.scenes.melting import job
from jaxspring.scenes.melting.scene import MeltSettings, melting_block


@pytest.mark.parametrize(
    "argument", ["--nodes=8x8", "--nodes=1x4x4", "--nodes=99x99x99", "--duration=0", "--duration=1e-6", "--duration=soon"]
)
def test_bad_arguments(argument, tmp_path, capsys):
    """What makes no sense ends with code 2 and one line, and writes nothing."""
    assert main(["melt", argument, "--out", str(tmp_path / "out")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("nodes", (6, 6)),
        ("nodes", (6, 1, 6)),
        ("spacing", 0.0),
        ("density", -900.0),
        ("stiffness", -1.0),
        ("conductivity", math.nan),
        ("dt", 0.0),
        ("duration", 1e-5),
        ("melting", 310.0),
        ("vanishing", 349.0),
        ("start", 360.0),
        ("plate", 300.0),
    ],
)
def test_bad_settings_are_named(field, value):
    """A number that the scene cannot have is refused when the settings are made, and the message names its field."""
    with pytest.raises(ValueError, match=rf"\b{field}\b"):
        MeltSettings(**{field: value})


@pytest.mark.slow
def test_a_small_block(tmp_path, capsys, monkeypatch):
    """A small block gives the whole folder; nothing is below the floor, the ledger closes, and the lowest layer melts. Interrupted runs
    leave it as it is, and go on.
    """
    out = tmp_path / "out"
    run = ["melt", "--nodes", "3x3x3", "--duration", "0.15", "--out", str(out)]
    assert main(run) == 0
    assert sorted(path.name for path in out.iterdir()) == ["melting.gif", "report.json", "strip.png"]
    report = json.loads((out / "report.json").read_text())
    assert report["lowest_particle_m"] >= 0
    assert abs(report["ledger_J"]["residual"]) < 1e-7  # of 1e4 J of heat, to rounding
    assert report["integration_over_exchanged"] < 0.02
    share = report["melted_fraction"]["share"]
    assert share[0] == 0
    assert report["melted_fraction"]["time_s"][-1] == pytest.approx(0.15, rel=1e-6)  # the duration asked for, not a step less
    assert share[-1] >= 1 / 3
    assert set(report["seconds"]) >= {"run", "Springs", "Fluid", "Heat", "Fusing", "Floor"}
    assert "melted" in capsys.readouterr().out
    check_interrupts(run, out, capsys, monkeypatch)


def check_interrupts(run, out, capsys, monkeypatch):
    """Ctrl-C in the middle of a run, or while pictures are drawn, ends with code 130 and one line; the older result stays as it was, a
    checkpoint is beside it, and --resume ends in the same numbers as the unbroken run.
    """
    older = {path: path.read_bytes() for path in out.iterdir()}
    checkpoint = out.with_name("out.checkpoint.npz")
    monkeypatch.setattr(job, "seconds_per_effect", lambda *_: {})  # compiles each effect anew

    def interrupted_in(module, name, is_time, frames):
        usual = getattr(module, name)

        def interrupt(*given, **named):
            if is_time(*given):
                signal.raise_signal(signal.SIGINT)
            return usual(*given, **named)

        monkeypatch.setattr(module, name, interrupt)
        assert main(run) == cli.INTERRUPTED
        monkeypatch.setattr(module, name, usual)
        line = f"jaxspring: interrupted after {frames} frames; the same command with --resume goes on."
        assert capsys.readouterr().err.splitlines()[-1] == line
        assert sorted(out.parent.iterdir()) == [out, checkpoint]
        assert {path: path.read_bytes() for path in out.iterdir()} == older

    def resumed():
        with monkeypatch.context() as patch:
            patch.setattr(job, "draw_animation", lambda path, *_: path.touch())  # the slowest part
            assert main([*run, "--resume"]) == 0
        assert not checkpoint.exists()
        reports = [json.loads(text) for text in (older[out / "report.json"], (out / "report.json").read_text())]
        for report in reports:
            del report["seconds"]
        assert reports[0] == reports[1]
        older.update({path: path.read_bytes() for path in out.iterdir()})
        capsys.readouterr()

    interrupted_in(js.progress, "draw_bar", lambda label, done, total: done >= total / 2, 30)
    assert main([*run, "--duration", "0.2", "--resume"]) == cli.UNUSABLE
    assert "its problem is" in capsys.readouterr().err
    resumed()
    interrupted_in(job, "draw_strip", lambda *_: True, 60)
    check_full_disk(run, out, capsys, monkeypatch)
    resumed()


def check_full_disk(run, out, capsys, monkeypatch):
    """Where the results cannot be written, the code is 1, the line says so, and the run is kept."""

    def full(*_):
        raise OSError("No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(job, "draw_strip", full)
        assert main([*run, "--resume"]) == cli.FAILED
    assert "could not be written (No space left on device); --resume" in capsys.readouterr().err
    assert out.with_name("out.checkpoint.npz").exists()
    assert main([*run[:-1], str(out.with_name("never")), "--resume"]) == cli.UNUSABLE
    assert "there is no checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize("command", [["melt"], ["fit", "--nodes", "3x3"], ["cloth"]])
@pytest.mark.parametrize("missing", ["matplotlib.figure", "PIL.Image"])
def test_what_draws_is_asked_for_before_the_work(command, missing, tmp_path, capsys, monkeypatch):
    """Without matplotlib or Pillow the commands end at once, with code 2 and the name of the extra; nothing is computed or written."""
    np.save(tmp_path / "hill.npy", np.arange(30.0).reshape(5, 6))
    monkeypatch.setitem(sys.modules, missing, None)
    monkeypatch.setattr(parts, "rollout", None)
    image = [str(tmp_path / "hill.npy")] if command[0] == "fit" else []
    assert main([*command, *image, "--out", str(tmp_path / "out")]) == cli.UNUSABLE
    assert "pip install jaxspring[viz]" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["hill.npy"]


@pytest.mark.slow
def test_an_interrupted_block_goes_on():
    """A run that Ctrl-C ended while the block was melting goes on to the state of the unbroken run, its book of energy included."""
    settings = MeltSettings(nodes=(3, 3, 3))
    scene = melting_block(settings)

    def run(state, n_steps, callback=None, resume=None):
        # Blocks of one length, so that all of these runs are pieces of one program.
        block, progress = js.Checkpointed(block=24), js.Progress(callback=callback, bar=False)
        return js.rollout(scene.system, state, js.SymplecticEuler(), 4e-4, n_steps, adjoint=block, progress=progress, resume=resume)

    def stop(done, total):
        if done >= total / 2:
            signal.raise_signal(signal.SIGINT)

    whole, broken = run(scene.state, 600), run(scene.state, 600, stop)
    assert bool(broken.status.has(js.Flag.INTERRUPTED))
    done = int(broken.info.n_steps)
    assert 300 <= done < 350
    assert 0 < js.thermal.melted_fraction(scene.net, broken.state) < js.thermal.melted_fraction(scene.net, whole.state)
    rest = run(broken.state, 600 - done, resume=broken.resume)
    js.raise_for_status(rest)
    for a, b in zip(jax.tree.leaves(rest.state), jax.tree.leaves(whole.state), strict=True):
        np.testing.assert_array_equal(a, b)
    assert js.energy_ledger(scene.system, rest.state) == js.energy_ledger(scene.system, whole.state)
