"""Files and functions stay short, and the library holds nothing that belongs elsewhere."""

import ast
import re

import pytest

from tests import source

LONGEST_FILE, LONGEST_FUNCTION = 400, 60
SPEAKERS = {"jaxspring.cli", "jaxspring.__main__"}  # the command prints: that is its work
each_file = pytest.mark.parametrize("path", source.files(), ids=source.module_name)


@each_file
def test_files_are_short(path):
    """No file of the library has more than 400 lines."""
    n_lines = len(path.read_text(encoding="utf-8").splitlines())
    assert n_lines <= LONGEST_FILE, f"{n_lines} lines: one idea per file"


@each_file
def test_functions_are_short(path):
    """No function of the library has more than 60 lines, docstring included."""
    functions = [node for node in ast.walk(source.tree(path)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    long = {node.name: n for node in functions if (n := node.end_lineno - node.lineno + 1) > LONGEST_FUNCTION}
    assert not long, f"lines per function: {long}"


@each_file
def test_no_leftovers(path):
    """No print outside the command, no assert, no global, no **kwargs, no unfinished place."""
    found = []
    for node in ast.walk(source.tree(path)):
        if isinstance(node, ast.Assert | ast.Global):
            found.append((node.lineno, type(node).__name__.lower()))
        # `replace` takes the names of whatever a system holds, and refuses every other.
        if isinstance(node, ast.FunctionDef | ast.Lambda) and node.args.kwarg and getattr(node, "name", "") != "replace":
            found.append((node.lineno, f"**{node.args.kwarg.arg}: a mistyped name would be swallowed"))
        if isinstance(node, ast.Raise) and node.exc and "NotImplementedError" in ast.unparse(node.exc):
            found.append((node.lineno, "raise NotImplementedError"))
        if isinstance(node, ast.Name) and node.id == "print" and source.module_name(path) not in SPEAKERS:
            found.append((node.lineno, "print"))
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        found += [(number, word) for word in re.findall(r"\b(?:TODO|FIXME|XXX)\b", line)]
    assert not found, f"(line, what): {found}"
