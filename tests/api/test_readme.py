"""The README's commands and example, and the Python on every page of docs/, are what works today."""

import pytest

from tests import markdown, source

README = source.ROOT / "README.md"
PAGES = [path for path in sorted((source.ROOT / "docs").glob("*.md")) if markdown.blocks(path, "python")]


def test_quick_start_is_two_commands():
    """The first `sh` block after "Quick start" holds the two commands that do it all, and nothing else."""
    commands = markdown.blocks(README, "sh", after="Quick start")[0].splitlines()
    assert commands == ["python3 bootstrap.py fit", "python3 bootstrap.py test"]


def test_the_check_of_every_change_runs_the_second_command():
    """`.ci/run` runs what the README promises, to the letter, and then quick tests on the newest jax."""
    lines = (source.ROOT / ".ci" / "run").read_text(encoding="utf-8").split("\n")
    assert "python3 bootstrap.py test" in lines
    (newest,) = [line for line in lines if line.startswith('python3 bootstrap.py newest -m "not slow" ')]
    assert all((source.ROOT / folder).is_dir() for folder in newest.split()[6:])


def test_first_example(user_mode, tmp_path, monkeypatch):
    """The first Python example has at most 15 lines and runs as it stands."""
    monkeypatch.chdir(tmp_path)
    example = markdown.blocks(README, "python")[0]
    assert len(example.splitlines()) <= 15
    markdown.run(README, [example])


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_python_on_a_page_runs(path, user_mode, tmp_path, monkeypatch):
    """The Python blocks of a page, run in order in one namespace, work and hold what they assert."""
    monkeypatch.chdir(tmp_path)
    markdown.run(path, markdown.blocks(path, "python"))
