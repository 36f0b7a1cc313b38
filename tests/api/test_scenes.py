"""Every scene has one shape: a package of its own with scene, job, pictures and command, and one line in the table of commands."""

import re

import pytest

from jaxspring import cli
from tests import source

HOME = source.LIBRARY / "scenes"
PACKAGES = sorted(path.name for path in HOME.iterdir() if (path / "__init__.py").is_file())
SHARED = sorted(HOME.glob("*.py"))


@pytest.mark.parametrize("name", PACKAGES)
def test_a_scene_has_its_four_files(name):
    """What is simulated, from arguments to a folder, what is drawn, and what the command is called; a line in the table calls it."""
    missing = [part for part in ("scene", "job", "pictures", "command") if not (HOME / name / f"{part}.py").is_file()]
    assert not missing, f"scenes/{name} lacks {missing}; docs/extending.md says what each is for"
    assert name in cli.SCENES


def test_the_table_names_scenes_alone():
    """Each line of the table is a package, and no two commands have one name."""
    assert sorted(cli.SCENES) == PACKAGES
    names = [command.name for command in cli.own_commands()]
    assert len(set(names)) == len(names) == len(PACKAGES)


@pytest.mark.parametrize("path", SHARED, ids=lambda path: path.stem)
def test_what_scenes_share_knows_none_of_them(path):
    """A file that lies beside the scenes serves them all: it imports none."""
    of_scenes = [name for name, _, _ in source.imports(path) if name.split(".")[2:3] and name.split(".")[2] in PACKAGES]
    assert of_scenes == []


def test_the_command_holds_no_scene():
    """Of a scene, `cli.py` says its name in the table and nothing else."""
    text = (source.LIBRARY / "cli.py").read_text(encoding="utf-8")
    for name in PACKAGES:
        assert len(re.findall(name, text)) == 1
