"""The command `jaxspring melt`."""

import json
import math

import pytest

from jaxspring.cli import main
from jaxspring.scenes.melting.scene import MeltSettings


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
def test_a_small_block(tmp_path, capsys):
    """A small block gives the whole folder; nothing is below the floor, the ledger closes, and the lowest layer melts."""
    out = tmp_path / "out"
    assert main(["melt", "--nodes", "3x3x3", "--duration", "0.15", "--out", str(out)]) == 0
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
