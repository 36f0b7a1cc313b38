"""The command: arguments, images that cannot be used, and a whole run from an image to a folder."""

import json
import os
import pathlib
import signal
import subprocess
import sys

import numpy as np
import PIL.Image
import pytest

from jaxspring import cli
from jaxspring.archive import read_archive
from jaxspring.scenes.command import Command, FailedError, UnusableError, Written, check_folder
from jaxspring.scenes.folder import ResultFolder
from jaxspring.scenes.reconstruction import command
from tests import source

RUN = ["--nodes", "5x6", "--iterations", "4"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty working folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def hill(folder):
    """A small image with an edge, as an `.npy` file."""
    y, x = np.mgrid[:24, :30]
    np.save("hill.npy", 100 * np.tanh((x - y) / 3.0) + 0.1 * x * y)
    return "hill.npy"


def complaint(arguments, capsys):
    """The one line on the error stream of a command that ends with code 2."""
    assert cli.main(arguments) == cli.UNUSABLE
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    return err


# Arguments


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "the following arguments are required: command"),
        (["fot"], "invalid choice: 'fot'"),
        (["fit", "--nodes", "41"], "'41' is not a number of rows and columns such as 41x41"),
        (["fit", "--nodes", "-3x4"], "expected one argument|is not a number of rows"),
        (["fit", "--nodes", "2x9"], "a mesh needs at least 3x3 nodes"),
        (["fit", "--nodes", "99999x99999"], "more than 4000000 nodes"),
        (["fit", "--nodes", "٣x٣"], "is not a number of rows"),
        (["fit", "--iterations", "1.5"], "'1.5' is not a whole number"),
        (["fit", "--iterations", "-1"], "'-1' is not a whole number"),
        (["fit", "--parameters", "stifness"], "stifness is not among stiffness"),
        (["fit", "--parameters", ""], "is not among"),
        (["fit", "--fill", "nan"], "'nan' is not a finite number"),
        (["fit", "--break", "0"], "'0' is not above zero"),
        (["fit", "--max-error", "-1"], "expected one argument|is not above zero"),
        (["fit", "--export", "obj,stl"], "stl is not among obj, ply, geojson"),
        (["fit", "--page", "-1"], "expected one argument|is not a whole number"),
        (["fit", "--iteration", "3"], "unrecognized arguments: --iteration"),
        (["fit", "a.png", "b.png"], "unrecognized arguments: b.png"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_arguments_get_one_line_and_code_2(arguments, words, folder, capsys):
    """The line says what is wrong and where the help is; nothing is written."""
    line = complaint(arguments, capsys)
    assert any(part in line for part in words.split("|")), line
    assert "--help" in line
    assert os.listdir() == []


def test_defaults():
    """The mesh is 41 x 41, one stiffness per spring is fitted, and the folder is named by the image."""
    chosen, given = cli.parse(["fit", "some/photo.png"])
    assert chosen is command.COMMAND
    assert (given.nodes, given.parameters, str(command.folder(given))) == ((41, 41), ("stiffness",), "jaxspring-photo")
    assert str(command.folder(cli.parse(["fit"])[1])) == "jaxspring-elevation"
    assert cli.parse(["fit", "--nodes", "9X12"])[1].nodes == (9, 12)


def test_help_is_fast():
    """`--help` and mistakes load neither jax nor numpy."""
    code = "import sys; from jaxspring.cli import main; main(['--help']); main(['fit', '--nodes', 'x']); main(['melt', '--help']); "
    code += "sys.exit(sum(m in sys.modules for m in ('jax', 'numpy', 'matplotlib')))"
    assert subprocess.run([sys.executable, "-c", code], cwd=source.ROOT, capture_output=True).returncode == 0


def test_the_module_is_the_command():
    """`python -m jaxspring` passes its exit code on."""
    done = subprocess.run([sys.executable, "-m", "jaxspring", "--version"], cwd=source.ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()[0]) == (0, "jaxspring")
    assert subprocess.run([sys.executable, "-m", "jaxspring", "fit", "--nodes", "1"], cwd=source.ROOT, capture_output=True).returncode == 2


# Images and folders that cannot be used


def broken_images(folder):
    """File name -> words of the complaint."""
    np.save("line.npy", np.zeros(9))
    np.save("cube.npy", np.zeros((4, 4, 7)))
    np.save("dot.npy", np.zeros((1, 1)))
    np.save("empty.npy", np.zeros((0, 4)))
    np.save("nan.npy", np.where(np.eye(8) > 0, np.nan, 1.0))
    np.save("text.npy", np.array([["a", "b"]]))
    np.savez("two.npz", a=np.zeros((3, 3)), b=np.zeros((3, 3)))
    (folder / "corrupt.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    (folder / "notes.txt").write_text("no image")
    (folder / "nothing.jpg").touch()
    (folder / "folder.png").mkdir()
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (3000000, 3000000), }"
    (folder / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    return {
        "missing.png": "No such file",
        "corrupt.png": "damaged",
        "notes.txt": "not an image",
        "nothing.jpg": "empty",
        "folder.png": "not a file",
        "line.npy": "(9,)",
        "cube.npy": "channel",
        "empty.npy": "(0, 4)",
        "dot.npy": "1 x 1 pixels hold no surface",
        "nan.npy": "nan",
        "text.npy": "dtype",
        "two.npz": "a, b",
        "huge.npy": "3000000",
    }


def test_images_that_cannot_be_used_get_one_line_and_code_2(folder, capsys):
    """Missing, corrupt, wrong-shaped, NaN-bearing and huge images: the line names the file and what is wrong, nothing is written."""
    images = broken_images(folder)
    before = set(os.listdir())
    for name, words in images.items():
        line = complaint(["fit", name], capsys)
        assert name in line
        assert words in line, line
    assert set(os.listdir()) == before


def test_folders_that_cannot_be_used_get_one_line_and_code_2(hill, capsys):
    """A folder whose parent is missing, a file, a folder with other files, and nothing to resume."""
    os.mkdir("other")
    pathlib.Path("other/thesis.tex").touch()
    assert "does not exist" in complaint(["fit", hill, "--out", "no/where"], capsys)
    assert "this is a file" in complaint(["fit", hill, "--out", hill], capsys)
    assert "other files (thesis.tex), which would be lost" in complaint(["fit", hill, "--out", "other"], capsys)
    assert "there is no checkpoint" in complaint(["fit", hill, "--resume"], capsys)
    assert sorted(os.listdir()) == [hill, "other"]


def test_nothing_but_an_earlier_result_is_replaced(folder):
    """A report beside files of somebody else's, a report that names no files, the folder in which one is, and one that grew meanwhile."""
    place, out = ResultFolder(pathlib.Path("out")), pathlib.Path("out")

    def fill():
        with place.filling({"lowest": 1.0}) as inside:
            (inside / "pictures").mkdir()
            (inside / "pictures" / "a.png").touch()
            (inside / "b.txt").touch()

    fill()
    assert json.loads((out / "report.json").read_text()) == {"lowest": 1.0, "files": ["b.txt", "pictures/a.png", "report.json"]}
    check_folder(out)
    fill()
    (out / "pictures" / "thesis.tex").touch()
    with pytest.raises(FileExistsError, match=r"holds other files \(pictures/thesis\.tex\), which would be lost"):
        check_folder(out)
    with pytest.raises(FailedError, match="thesis"):
        fill()
    assert (out / "pictures" / "thesis.tex").exists()
    for text in ("{}", "not JSON", '{"files": "report.json"}', "[]", '{"files": null}'):
        mine = pathlib.Path("mine")
        mine.mkdir(exist_ok=True)
        (mine / "report.json").write_text(text)
        with pytest.raises(FileExistsError, match=r"other files \(report\.json\)"):
            check_folder(mine)
    for here in (".", "..", str(pathlib.Path.cwd())):
        with pytest.raises(FileExistsError, match="the folder in which you are"):
            check_folder(pathlib.Path(here))
    assert sorted(os.listdir()) == ["mine", "out"]


def test_a_linked_folder_stays_linked(folder):
    """Results go to where the link points."""
    os.mkdir("disk")
    pathlib.Path("out").symlink_to(pathlib.Path("disk", "out").absolute(), target_is_directory=True)
    for _ in range(2):
        with ResultFolder(pathlib.Path("out")).filling({}) as inside:
            (inside / "b.txt").touch()
    assert os.path.islink("out")
    assert (sorted(os.listdir()), os.listdir("disk")) == (["disk", "out"], ["out"])


def test_a_report_may_not_name_files_itself(folder):
    """The entry is the folder's."""
    with pytest.raises(ValueError, match="an entry 'files'"), ResultFolder(pathlib.Path("out")).filling({"files": []}):
        pass
    assert os.listdir() == []


@pytest.mark.parametrize(("trouble", "code"), [(UnusableError("no such place"), cli.UNUSABLE), (OSError("no disk"), cli.UNUSABLE)])
def test_trouble_with_the_folder_itself_is_one_line(trouble, code, folder, capsys):
    """Raised where a scene says where its results go."""

    def place(given):
        raise trouble

    scene = Command("swing", "", "", lambda parser: None, place, lambda given, out: Written("", ""))
    assert cli.main(["swing"], [scene], "swing") == code
    assert capsys.readouterr().err == f"swing: {trouble}\n"


def test_a_folder_may_be_a_string_and_a_job_says_what_it_wrote(folder, capsys):
    """What a scene of a user's own may get wrong."""
    as_text = Command("swing", "", "", lambda parser: None, lambda given: "out", lambda given, out: Written("done", "a file"))
    assert cli.main(["swing"], [as_text], "swing") == cli.DONE
    silent = Command("swing", "", "", lambda parser: None, lambda given: "out", lambda given, out: None)
    with pytest.raises(TypeError, match="returned NoneType; expected a Written"):
        cli.main(["swing"], [silent], "swing")


def test_transparent_pixels_are_refused_and_the_option_named(folder, capsys):
    """A picture with transparent pixels is not read by its hidden colours: the line names the pixel and --fill."""
    pixels = np.full((8, 8, 2), 255, np.uint8)
    pixels[2, 5, 1] = 0
    PIL.Image.fromarray(pixels).save("logo.png")
    line = complaint(["fit", "logo.png"], capsys)
    assert "pixel [2, 5] is transparent" in line
    assert "--fill" in line
    filled = command.load(cli.parse(["fit", "logo.png", "--fill", "-3.5"])[1]).values
    np.testing.assert_array_equal(filled, np.where(pixels[..., 1] == 0, -3.5, 255.0))


# A whole run


@pytest.mark.slow
def test_a_run_from_image_to_folder(hill, capsys, monkeypatch):
    """Report, mesh, pictures and checkpoint; interrupted and resumed it reports the same errors to the last bit."""
    assert cli.main(["fit", hill, *RUN, "--out", "whole"]) == cli.DONE
    out, _ = capsys.readouterr()
    assert "fitted" in out
    report = json.loads(pathlib.Path("whole/report.json").read_text())
    check_report(report)
    check_mesh(report)
    assert set(os.listdir("whole")) == {
        *("report.json", "mesh.npz", "checkpoint.npz"),
        *("meshes.png", "reconstructions.png", "errors.png", "loss.png"),
    }
    check_interrupt_and_resume(hill, report, capsys, monkeypatch)
    check_failure_leaves_nothing(hill, capsys, monkeypatch)
    assert "its problem is" in complaint(["fit", hill, "--nodes", "6x6", "--out", "whole", "--resume"], capsys)


def check_report(report):
    """The keys, the order of the errors, and rmse in the image's own unit against NumPy."""
    rmse = report["rmse"]
    assert list(rmse) == ["uniform", "law", "fitted"]
    assert all(0 < errors["best"] <= errors["sampled"] for errors in rmse.values())
    assert rmse["fitted"]["best"] < rmse["uniform"]["best"]
    assert (report["folds"], report["outside"]) == (0, 0)
    image = np.load("hill.npy")
    assert report["range"] == pytest.approx([image.min(), image.max()], rel=1e-6)
    assert report["settings"] == {"nodes": [5, 6], "parameters": ["stiffness"], "iterations": 4}
    assert len(report["loss"]) == 5
    assert report["versions"]["jax"]
    assert all(report["greatest_error"][name][rule] > errors[rule] for name, errors in rmse.items() for rule in errors)
    assert set(report["seconds"]) == {"compile", "run", "other", "total"}
    assert report["parameters"]["before"] != report["parameters"]["after"]


def check_mesh(report):
    """The surface in mesh.npz, drawn by matplotlib, has the error that the report says."""
    from matplotlib.tri import LinearTriInterpolator, Triangulation

    mesh, image = read_archive("whole/mesh.npz").arrays, np.load("hill.npy")
    assert mesh["edges"].shape == (49, 2)
    assert mesh["stiffness"].shape == (49,)
    x, y, z = mesh["points"].T
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    for rule, heights in (("best", z), ("sampled", mesh["z_sampled"])):
        surface = LinearTriInterpolator(Triangulation(x, y, mesh["triangles"]), heights)(columns.astype(float), rows.astype(float))
        # Pixels on the border that fall outside by a rounding are left out by matplotlib.
        assert np.ma.count(surface) > 0.98 * image.size
        assert float(np.sqrt(np.ma.mean((surface - image) ** 2))) == pytest.approx(report["rmse"]["fitted"][rule], rel=1e-2)


def check_interrupt_and_resume(hill, report, capsys, monkeypatch):
    """Ctrl-C leaves a checkpoint alone, with code 130; --resume goes on bit for bit."""
    from jaxspring.scenes.reconstruction import job

    bar = job.draw_bar

    def interrupt(label, done, total, note):
        if done == 2:
            signal.raise_signal(signal.SIGINT)
        bar(label, done, total, note)

    monkeypatch.setattr(job, "draw_bar", interrupt)
    assert cli.main(["fit", hill, *RUN, "--out", "broken"]) == cli.INTERRUPTED
    assert capsys.readouterr().err == "jaxspring: interrupted after 2 iterations; the same command with --resume goes on.\n"
    assert "broken" not in os.listdir()
    assert "broken.checkpoint.npz" in os.listdir()
    monkeypatch.setattr(job, "draw_bar", bar)
    assert cli.main(["fit", hill, *RUN, "--out", "broken", "--resume"]) == cli.DONE
    again = json.loads(pathlib.Path("broken/report.json").read_text())
    for key in ("rmse", "loss", "parameters"):
        assert again[key] == report[key]
    capsys.readouterr()


def check_failure_leaves_nothing(hill, capsys, monkeypatch):
    """Where a picture cannot be written, the old folder stays as it was, and no temporary one is left."""
    from jaxspring.scenes.reconstruction import job

    def full(folder, image, found):
        (folder / "half.png").touch()
        raise OSError("No space left on device")

    before = pathlib.Path("whole/report.json").read_text()
    with monkeypatch.context() as patch:
        patch.setattr(job, "draw_pictures", full)
        assert cli.main(["fit", hill, *RUN, "--out", "whole"]) == cli.FAILED
    assert "the results could not be written (No space left on device); --resume tries again" in capsys.readouterr().err
    assert pathlib.Path("whole/report.json").read_text() == before
    assert sorted(os.listdir()) == ["broken", hill, "whole", "whole.checkpoint.npz"]


@pytest.mark.slow
@pytest.mark.parametrize("names", ["k_min,k_max,sigma,k_data,drag", "k_pixel"])
def test_the_constants_of_the_slides_mesh_are_fitted(tmp_path, names):
    """Each named constant is reported before and after, and moved; the loss fell."""
    out = tmp_path / "out"
    assert cli.main(["fit", "--nodes", "9x9", "--parameters", names, "--iterations", "6", "--out", str(out)]) == 0
    report = json.loads((out / "report.json").read_text())
    before, after = report["parameters"]["before"], report["parameters"]["after"]
    assert set(before) == set(after) == set(names.split(","))
    assert all(before[name] != after[name] > 0 for name in before)
    assert min(report["loss"]) < report["loss"][0]


def test_the_command_makes_as_many_updates_as_the_settings_say():
    """The defaults that `--help` prints are those of the settings."""
    from jaxspring.scenes.reconstruction.constants import ConstantsSettings
    from jaxspring.scenes.reconstruction.fitting import SpringSettings

    assert SpringSettings().n_iterations == command.UPDATES_OF_STIFFNESS
    assert ConstantsSettings().n_iterations == command.UPDATES_OF_CONSTANTS
