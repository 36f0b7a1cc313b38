"""What a type checker says of programs by users: nothing of those that are right, and every mistake of those that are not."""

import json
import subprocess
import sys

import pytest

from tests import markdown, source

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("basedpyright", reason="the lock of the newest jax does not lint")

MISTAKES = source.ROOT / "tests" / "api" / "mistakes.txt"
NOTEBOOKS = sorted((source.ROOT / "notebooks").glob("*.ipynb"))
PAGES = [source.ROOT / "README.md", *sorted((source.ROOT / "docs").glob("*.md"))]
# A page shows a value that may be None where it knows that it is not, and a variable of a loop after it.
LET_PASS = {"reportOptionalMemberAccess", "reportPossiblyUnboundVariable"}


def cells(path):
    """The Python of a notebook, without the lines that are for IPython."""
    code = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    return "\n".join(line for line in "\n".join(code).splitlines() if not line.startswith(("%", "!")))


@pytest.fixture(scope="module")
def complaints(tmp_path_factory):
    """Name of a program -> the lines that the checker complains about, with what it says; all programs in one run of it."""
    folder = tmp_path_factory.mktemp("programs")
    programs = {"mistakes": MISTAKES.read_text(encoding="utf-8")}
    programs |= {path.stem: "\n".join(markdown.blocks(path, "python")) for path in PAGES}
    programs |= {path.stem: cells(path) for path in NOTEBOOKS}
    for name, text in programs.items():
        (folder / f"{name}.py").write_text(text + "\n", encoding="utf-8")
    settings = {"typeCheckingMode": "standard", "pythonVersion": "3.11", "extraPaths": [str(source.ROOT)], "include": ["."]}
    (folder / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "--project", str(folder)]
    found = json.loads(subprocess.run(command, capture_output=True, text=True, cwd=folder).stdout)
    assert found["summary"]["filesAnalyzed"] == len(programs)
    said = {name: {} for name in programs}
    for one in found["generalDiagnostics"]:
        if one["severity"] == "error" and one.get("rule") not in LET_PASS:
            name = one["file"].replace("\\", "/").split("/")[-1].removesuffix(".py")
            said[name][one["range"]["start"]["line"] + 1] = one["message"]
    return said


@pytest.mark.slow
def test_every_mistake_is_reported(complaints):
    """Misspelt arguments, wrong objects, attributes that a result does not have: each line with a mistake, and no other."""
    lines = MISTAKES.read_text(encoding="utf-8").splitlines()
    wrong = {i for i, line in enumerate(lines, 1) if line.endswith("# wrong")}
    assert len(wrong) >= 25
    assert {lines[i - 1] for i in wrong - set(complaints["mistakes"])} == set()
    assert set(complaints["mistakes"]) <= wrong


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in (*PAGES, *NOTEBOOKS)])
def test_programs_of_the_documentation_have_no_type_error(name, complaints):
    """README's and the pages' programs, and the notebooks, pass."""
    assert complaints[name] == {}
