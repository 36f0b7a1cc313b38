"""The command `jaxspring lens`."""

import json

import numpy as np
import PIL.Image
import pytest

from jaxspring.cli import main
from jaxspring.scenes.command import UnusableError
from jaxspring.scenes.lens import command


@pytest.fixture
def picture(tmp_path):
    """A small colour picture and a mask beside it."""
    y, x = np.indices((60, 80))
    pixels = np.stack([3 * x, 4 * y, 40 * ((x // 8 + y // 8) % 2)], axis=-1).astype(np.uint8)
    PIL.Image.fromarray(pixels).save(tmp_path / "picture.png")
    mask = np.zeros((60, 80), np.uint8)
    mask[35:50, 45:65] = 255
    PIL.Image.fromarray(mask).save(tmp_path / "mask.png")
    PIL.Image.fromarray(mask[:50]).save(tmp_path / "small.png")
    return tmp_path / "picture.png"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--at=30"],
        ["--at=30,20"],
        ["--at=30,20", "--radius=ten"],
        ["--at=30,20", "--radius=-3"],
        ["--at=30,20", "--radius=12", "--magnify=0"],
        ["--at=30,20", "--radius=12", "--magnify=9"],
        ["--at=30,20", "--at=50,30", "--radius=6", "--radius=7", "--radius=8"],
        ["--at=30,20", "--radius=2"],
        ["--at=30,20", "--radius=12", "--nodes=3"],
        ["--at=30,20", "--radius=12", "--nodes=999"],
        ["--importance=nowhere.png"],
        ["--importance=small.png"],
    ],
    ids=" ".join,
)
def test_bad_arguments(arguments, picture, tmp_path, monkeypatch, capsys):
    """What makes no lens ends with code 2 and one line, and writes nothing."""
    monkeypatch.chdir(tmp_path)
    assert main(["lens", str(picture), *arguments, "--out", "out"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_values_for_each_place():
    """One value serves all places; as many as places, each has its own."""
    assert command._each("--radius", [3.0], 2) == [3.0, 3.0]
    assert command._each("--radius", [3.0, 4.0], 2) == [3.0, 4.0]
    with pytest.raises(UnusableError, match="--radius"):
        command._each("--radius", [], 1)


def test_a_folder(picture, tmp_path, capsys):
    """Pictures of the image's own size and colours, a mesh, and a report whose numbers agree with them."""
    out = tmp_path / "out"
    given = ["--at=25,25", "--radius=12", "--magnify=1.6", "--importance", str(tmp_path / "mask.png"), "--nodes=17"]
    assert main(["lens", str(picture), *given, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert "one-to-one: 0 folds" in said
    assert [focus["kind"] for focus in report["foci"]] == ["disc", "importance"]
    assert report["foci"][0]["delivered"] == pytest.approx(report["foci"][0]["wanted"], rel=0.03)
    assert report["inverse_error_pixels"] < 0.01
    assert report["ramp"][0]["delivered"] == pytest.approx([1.0, 1.0], abs=1e-6)
    assert all(step["folds"] == 0 for step in report["ramp"])
    before, after = (np.asarray(PIL.Image.open(out / f"{name}.png")) for name in ("before", "after"))
    np.testing.assert_array_equal(before, np.asarray(PIL.Image.open(picture)))
    assert after.shape == before.shape
    assert np.abs(after.astype(int) - before.astype(int)).max() > 30
    with np.load(out / "warp.npz") as mesh:
        assert mesh["shown_x"].shape == mesh["x"].shape == (13, 17)
    assert {"mesh.png", "magnification.png", "lens.gif"} <= set(report["files"])
