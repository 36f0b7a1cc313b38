"""Every docstring of the library, the tests and the benchmarks, with the code that it describes."""

import ast
import functools
import pathlib
from dataclasses import dataclass

from tests import source

FOLDERS = ("jaxspring", "tests", "benchmarks")
Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
Owner = ast.Module | Definition


@dataclass(frozen=True)
class Docstring:
    """One docstring.

    Attributes:
        path: of its file.
        name: dotted, of what it describes within the file; empty for the file itself.
        owner: syntax tree of what it describes.
        within: classes and functions around it, the outermost first.
        file: syntax tree of the file.
        text: the docstring without its indentation.
    """

    path: pathlib.Path
    name: str
    owner: Owner
    within: tuple[Owner, ...]
    file: ast.Module
    text: str

    @property
    def place(self) -> str:
        """Where to look, for a message."""
        line = f":{self.owner.lineno}" if not isinstance(self.owner, ast.Module) else ""
        return f"{self.path.relative_to(source.ROOT)}{line} {self.name}".rstrip()


@functools.cache
def of_file(path: pathlib.Path) -> tuple[Docstring, ...]:
    """All docstrings of a file, from the top."""
    file = source.tree(path)
    found: list[Docstring] = []

    def note(owner: Owner, within: tuple[Owner, ...], name: str) -> None:
        text = ast.get_docstring(owner)
        if text:
            found.append(Docstring(path, name, owner, within, file, text))
        visit(owner, (*within, owner), name)

    def visit(node: ast.AST, within: tuple[Owner, ...], name: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Definition):
                note(child, within, f"{name}.{child.name}".lstrip("."))
            else:
                visit(child, within, name)

    note(file, (), "")
    return tuple(found)


def all_docstrings(*folders: str) -> list[Docstring]:
    """The docstrings of these folders, of all three unless said."""
    paths = [path for folder in folders or FOLDERS for path in sorted((source.ROOT / folder).rglob("*.py"))]
    return [docstring for path in paths for docstring in of_file(path)]


def identifiers(*nodes: ast.AST) -> set[str]:
    """Every name in some code: of variables, parameters, attributes, keywords, functions and classes."""
    found: set[str] = set()
    for node in (inner for outer in nodes for inner in ast.walk(outer)):
        if isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.keyword) and node.arg:
            found.add(node.arg)
        elif isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.alias):
            found.update((node.asname or node.name).split("."))
    return found
