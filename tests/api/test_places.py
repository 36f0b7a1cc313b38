"""The twelve places that CONTRIBUTING.md names: each is two links from the first page at most, and is still where it says."""

import ast
import re

import pytest

from tests import markdown, source

PAGE = source.ROOT / "CONTRIBUTING.md"
FIRST = source.ROOT / "docs" / "index.md"


def rows() -> dict[str, str]:
    """What each row of the table under "Twelve places" is about, and the places it names."""
    text = markdown.prose(PAGE)
    table = text[text.index("\n## Twelve places") :]
    found = dict(re.findall(r"^\| (.+?) \| (.+) \|$", table[: table.index("\n\n", table.index("|---"))], flags=re.M))
    return {what: places for what, places in found.items() if what != "where"}


def hops() -> dict[str, int]:
    """Path of every file that links reach from the first page, and how many links it takes."""
    reached, edge = {FIRST: 0}, [FIRST]
    while edge:
        page = edge.pop(0)
        for target, _ in markdown.links(page) if page.suffix == ".md" and page.exists() else ():
            if target not in reached:
                reached[target] = reached[page] + 1
                edge.append(target)
    return {path.relative_to(source.ROOT).as_posix(): n for path, n in reached.items()}


def defined(path: str) -> set[str]:
    """Names that a file defines: functions, classes, constants, and what stands in a class, after its name and a dot."""
    found = set()

    def note(body: list[ast.stmt], before: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                found.add(before + node.name)
            if isinstance(node, ast.ClassDef):
                note(node.body, f"{before}{node.name}.")
            if isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                found.update(before + target.id for target in targets if isinstance(target, ast.Name))

    note(source.tree(source.ROOT / path).body, "")
    return found


def test_there_are_twelve():
    """The table has the twelve rows of its heading."""
    assert len(rows()) == 12


@pytest.mark.parametrize("what", rows())
def test_place(what):
    """Each file of a row exists within two links of docs/index.md; names after a link to Python are defined in that file."""
    near = hops()
    places = re.findall(r"\]\(([^)#]+)[^)]*\)([^\[]*)", rows()[what])
    assert places
    assert [path for path, _ in places if near.get(path, 3) > 2 or not (source.ROOT / path).exists()] == []
    named = [(path, re.findall(r"`([\w.]+)`", text)) for path, text in places if path.endswith(".py")]
    assert [path for path, names in named if not names] == []
    assert [f"{path}: {name}" for path, names in named for name in names if name not in defined(path)] == []
