"""The library's source files as the tests of its layout read them: paths, names and syntax trees."""

import ast
import functools
import pathlib
import sys

ROOT = pathlib.Path(__file__).resolve().parents[1]
LIBRARY = ROOT / "jaxspring"
STANDARD = sys.stdlib_module_names


def files() -> list[pathlib.Path]:
    """Every source file of the library."""
    found = sorted(LIBRARY.rglob("*.py"))
    assert found, f"no source under {LIBRARY}"
    return found


@functools.cache
def tree(path: pathlib.Path) -> ast.Module:
    """The syntax tree of a file, read once: not to be changed."""
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def module_name(path: pathlib.Path) -> str:
    """The dotted name of a file: `jaxspring.forces.springs`; a package goes by its folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def modules() -> list[str]:
    """The dotted names of all importable modules: all files but `__main__`."""
    return [module_name(path) for path in files() if path.stem != "__main__"]


def imports(path: pathlib.Path) -> list[tuple[str, int, bool]]:
    """Every module that a file imports, at any depth: (dotted name, line, whether it is loaded with the file itself).

    `from jaxspring.forces import springs` names `jaxspring.forces.springs` where that is a file, else `jaxspring.forces`.
    Imports inside functions and under `if TYPE_CHECKING` are not loaded with the file.
    """
    known = set(modules())
    syntax = tree(path)
    late = set()
    for node in ast.walk(syntax):
        if isinstance(node, ast.FunctionDef | ast.Lambda) or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)):
            late.update(id(inner) for inner in ast.walk(node))
    found = set()
    for node in ast.walk(syntax):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node, path)
            names = [f"{base}.{alias.name}" if f"{base}.{alias.name}" in known else base for alias in node.names]
        else:
            continue
        found.update((name, node.lineno, id(node) not in late) for name in names)
    return sorted(found, key=lambda entry: entry[1])


def absolute(node: ast.ImportFrom, path: pathlib.Path) -> str:
    """The absolute name behind `from ... import`, relative forms included."""
    if not node.level:
        return node.module or ""
    package = path.relative_to(ROOT).with_suffix("").parts[: -node.level]
    return ".".join([*package, *([node.module] if node.module else [])])
