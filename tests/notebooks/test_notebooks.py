"""Every notebook runs from top to bottom, says what it is about first, and asserts its numbers last."""

import ast

import nbformat
import pytest
from nbclient import NotebookClient

from tests import source

# Whatever lies in notebooks/ is tested; these must lie there.
PROMISED = [
    "01_first_rollout",
    "02_fit_a_mesh_to_an_image",
    "03_stiff_springs",
    "04_heat_and_melting",
    "05_contact_and_gradients",
    "06_a_robot_that_walks",
    "07_cloth_in_measured_units",
    "08_range_data_with_holes_and_breaks",
    "09_spring_lens",
]
NOTEBOOKS = sorted((source.ROOT / "notebooks").glob("*.ipynb"))
SECONDS = 120  # for the slowest single cell


def read(path):
    """The notebook, checked against its own format."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    return notebook


def test_promised_notebooks_exist():
    """None was renamed or lost."""
    assert set(PROMISED) <= {path.stem for path in NOTEBOOKS}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_is_stripped(path):
    """No outputs, no counts: a change of the code is then the only change in the file."""
    cells = [cell for cell in read(path).cells if cell.cell_type == "code"]
    assert [n for n, cell in enumerate(cells) if cell.outputs or cell.execution_count is not None] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_begins_with_words_and_ends_with_an_assertion(path):
    """The first cell is text; the last asserts the numbers that the notebook showed."""
    first, *_, last = read(path).cells
    assert first.cell_type == "markdown"
    assert last.cell_type == "code"
    assert any(isinstance(node, ast.Assert) for node in ast.walk(ast.parse(last.source)))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_runs(path, tmp_path, monkeypatch):
    """Executed in an empty folder by a fresh kernel, no cell fails, and the files of Jupyter at home are left alone."""
    for variable in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(variable, str(tmp_path / ".jupyter"))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel brings its own
    client = NotebookClient(read(path), timeout=SECONDS, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}})
    client.execute()
    assert any(cell.get("execution_count") for cell in client.nb.cells)
