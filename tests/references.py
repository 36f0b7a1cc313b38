"""What the words between backticks may stand for: files, commands and names, and whether there is such a one."""

import ast
import builtins
import functools
import importlib
import importlib.util
import keyword
import pathlib
import re
import tomllib
import types
from collections.abc import Iterator
from dataclasses import dataclass

import jax

import jaxspring
from tests import docstrings, face, markdown, source

# Packages whose names the text uses, by what they are called there.
FOREIGN = {
    "jax": "jax",
    "jnp": "jax.numpy",
    "lax": "jax.lax",
    "np": "numpy",
    "numpy": "numpy",
    "scipy": "scipy",
    "eqx": "equinox",
    "equinox": "equinox",
    "diffrax": "diffrax",
    "optax": "optax",
    "lineax": "lineax",
    "optimistix": "optimistix",
    "networkx": "networkx",
}
# What stands in a text for whatever the reader puts there.
PLACEHOLDER = re.compile(r"\b(?:NAME|DIR|IMAGE)\b")
PATH = re.compile(r"[\w./-]+(?:\.(?:py|md|toml|lock|yml|sh)|/)")
FILE = re.compile(r"[\w-]+\.(?:npz|npy|json|png|gif)")
NAME = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*")
CALL = re.compile(rf"({NAME.pattern})\((.*)\)")
KEYWORD = re.compile(r"(\w+)=(?!=)")


@dataclass(frozen=True)
class Text:
    """A text with names in it, and the code that it is about.

    Attributes:
        path: of its file.
        place: where to look, for a message.
        text: as it stands.
        near: names of the code around it: its own function or class, the file, or the programs of the page.
    """

    path: pathlib.Path
    place: str
    text: str
    near: frozenset[str]


@functools.cache
def texts() -> tuple[Text, ...]:
    """Every page and every docstring."""
    root = source.ROOT
    pages = [root / "README.md", root / "CONTRIBUTING.md", *sorted((root / "docs").glob("*.md"))]
    found = []
    for path in pages:
        code = ast.parse("\n".join(markdown.blocks(path, "python")))
        near = frozenset(docstrings.identifiers(code) | quoted(code) | around())
        found.append(Text(path, path.relative_to(root).as_posix(), path.read_text(encoding="utf-8"), near))
    for docstring in docstrings.all_docstrings():
        # Of the code around a function only what it defines: a local name of another function is not meant.
        near = docstrings.identifiers(docstring.owner) | defined(docstring.file) | said(docstring.file)
        near |= {name for outer in docstring.within for name in defined(outer)}
        found.append(Text(docstring.path, docstring.place, docstring.text, frozenset(near)))
    return tuple(found)


@functools.cache
def around() -> frozenset[str]:
    """What pages tell of besides names of the library: files and keys, benchmarks and their columns, options of bootstrap.py, fixtures."""
    found = docstrings.identifiers(source.tree(source.ROOT / "bootstrap.py")) | quoted(source.tree(source.ROOT / "bootstrap.py"))
    for name, tree in modules().items():
        if name.startswith("tests"):
            found |= defined(tree)
        else:
            found |= quoted(tree) | (docstrings.identifiers(tree) | {name.split(".")[-1]} if name.startswith("benchmarks") else set())
    return frozenset(found)


@functools.cache
def extras() -> frozenset[str]:
    """Extras and groups of packages."""
    project = tomllib.loads((source.ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return frozenset({*project["project"]["optional-dependencies"], *project["dependency-groups"]})


def spans(text: str) -> Iterator[str]:
    """What stands between single backticks, outside fenced blocks."""
    text = re.sub(r"^```.*?^```\s*$", "", text, flags=re.M | re.S)
    return (found.strip() for found in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text))


@functools.cache
def quoted(code: ast.AST) -> frozenset[str]:
    """Texts in some code that are one word: keys, columns, names of files."""
    texts = [node.value for node in ast.walk(code) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return frozenset(text for text in texts if re.fullmatch(r"[\w.-]+", text))


@functools.cache
def said(code: ast.AST) -> frozenset[str]:
    """Words of all texts in some code that are no docstrings: keys, messages, lines that are written to files."""
    owners = [node for node in ast.walk(code) if isinstance(node, docstrings.Owner) and ast.get_docstring(node)]
    told = {id(owner.body[0].value) for owner in owners if isinstance(owner.body[0], ast.Expr)}
    texts = [node.value for node in ast.walk(code) if isinstance(node, ast.Constant) and id(node) not in told]
    return frozenset(word for text in texts if isinstance(text, str) for word in re.findall(r"[A-Za-z_]\w*", text))


@functools.cache
def defined(code: ast.AST) -> frozenset[str]:
    """Names that are bound right in a file, class or function, imports included, and the attributes that methods set."""
    found = set()
    for node in ast.iter_child_nodes(code):
        if isinstance(node, docstrings.Definition):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found.update(alias.asname or alias.name for alias in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            found.update(name.id for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store))
        elif isinstance(node, ast.arguments):
            found.update(argument.arg for argument in ast.walk(node) if isinstance(argument, ast.arg))
        elif isinstance(node, ast.If | ast.Try):
            found |= defined(node)
    if isinstance(code, ast.ClassDef):
        inner = [node for node in ast.walk(code) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)]
        found.update(node.attr for node in inner if isinstance(node.value, ast.Name) and node.value.id == "self")
    return frozenset(found)


@functools.cache
def modules() -> dict[str, ast.Module]:
    """Syntax trees of library, tests and benchmarks by dotted name."""
    paths = [path for folder in docstrings.FOLDERS for path in sorted((source.ROOT / folder).rglob("*.py"))]
    return {source.module_name(path): source.tree(path) for path in paths}


@functools.cache
def classes() -> dict[str, list[ast.ClassDef]]:
    """Every class by name."""
    found: dict[str, list[ast.ClassDef]] = {}
    for tree in modules().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(node)
    return found


def lineage(name: str) -> list[ast.ClassDef]:
    """The classes of that name and their parents."""
    own = classes().get(name, [])
    parents = [ast.unparse(base).split(".")[-1].split("[")[0] for node in own for base in node.bases]
    return [*own, *(node for parent in parents if parent != name for node in lineage(parent))]


@functools.cache
def members(name: str) -> frozenset[str]:
    """What a class of that name has, with what it inherits."""
    return frozenset(member for node in lineage(name) for member in defined(node))


@functools.cache
def known() -> frozenset[str]:
    """Names that are known everywhere: of the library's files, functions, classes, constants, their members and parameters, of Python, and
    of the packages that it stands on.
    """
    found = {*dir(builtins), *keyword.kwlist, *face.public(), *FOREIGN, *extras(), *dir(jax.Array), "js", "jaxspring"}
    found |= {name.lower() for name in classes()}  # a thing of that class
    for name, tree in modules().items():
        if name.startswith("jaxspring"):
            found |= {*name.split("."), *defined(tree)}
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef):
                    found |= defined(node)
                if isinstance(node, ast.FunctionDef):
                    found.update(argument.arg for argument in ast.walk(node.args) if isinstance(argument, ast.arg))
    for package in FOREIGN.values():
        found.update(dir(importlib.import_module(package)))
    return frozenset(found)


def complaint(span: str, text: Text) -> str:
    """What is wrong with the words between two backticks; "" where nothing is, or where they are a formula."""
    if PLACEHOLDER.search(span):
        return ""
    if FILE.fullmatch(span):
        return "" if span in around() else "no program here writes such a file"
    if PATH.fullmatch(span):
        return "" if has_path(span, text.path) else "there is no such path"
    call = CALL.fullmatch(span)
    name = call[1] if call else span
    if NAME.fullmatch(name):
        # A single letter is a symbol.
        if len(name) > 1 and not has_name(name, text.near):
            return f"there is no {name}"
        return wrong_keywords(name, call[2]) if call else ""
    if re.match(KEYWORD, span):
        unknown = [word for word in KEYWORD.findall(top_level(span)) if word not in known() | text.near]
        return f"nothing takes {', '.join(unknown)}" if unknown else ""
    unknown = [name for name in re.findall(r"\bjs(?:\.\w+)+", span) if not has_name(name, text.near)]
    return f"there is no {', '.join(unknown)}" if unknown else ""


def top_level(arguments: str) -> str:
    """Arguments without what stands in brackets among them."""
    while (shorter := re.sub(r"\([^()]*\)|\[[^\[\]]*\]|\{[^{}]*\}", "", arguments)) != arguments:
        arguments = shorter
    return arguments


def wrong_keywords(name: str, arguments: str) -> str:
    """Keywords that a function or class of the library does not take."""
    wanted = set(KEYWORD.findall(top_level(arguments)))
    if not wanted or name.split(".")[0] in FOREIGN:
        return ""
    taken = parameters().get(name.split(".")[-1], wanted) | members(name.split(".")[-1])
    return f"{name} does not take {', '.join(sorted(wanted - taken))}" if wanted - taken else ""


@functools.cache
def parameters() -> dict[str, set[str]]:
    """Parameters of the library's functions by name, and of constructors by the name of their class, those of its parents included."""
    found: dict[str, set[str]] = {}
    for module, tree in modules().items():
        for node in ast.walk(tree) if module.startswith("jaxspring") else ():
            if isinstance(node, ast.FunctionDef):
                found.setdefault(node.name, set()).update(defined(node))
    for name in classes():
        inits = [inner for node in lineage(name) for inner in node.body if isinstance(inner, ast.FunctionDef) and inner.name == "__init__"]
        found.setdefault(name, set()).update(parameter for init in inits for parameter in defined(init))
    return found


def commands(text: str) -> Iterator[str]:
    """Lines of a text that call a program of this repository, whether between backticks, in a fenced block or indented."""
    start = r"(?:python3? -m (?:jaxspring|benchmarks|tests)|python3? bootstrap\.py|jaxspring (?=fit|melt)|benchmarks\.\w+ -)"
    return (found.strip() for found in re.findall(rf"(?:^\s*|`)({start}[^`\n#]*)", text, flags=re.M))


def command_complaint(line: str) -> str:
    """What is wrong with a command: a module, a subcommand or an option that is not there."""
    words = re.sub(r"[\[\]]", " ", re.sub(r"python3? (?:-m )?", "", line)).split()
    if PLACEHOLDER.search(words[0]):
        return ""
    module = {"bootstrap.py": "bootstrap", "jaxspring": "jaxspring.cli"}.get(words[0], words[0])
    if module != "bootstrap" and module not in modules():
        return f"there is no {module}"
    if module == "jaxspring.cli":
        trees = [tree for name, tree in modules().items() if name.startswith("jaxspring") and name.endswith((".cli", ".command"))]
    elif module == "bootstrap":
        trees = [source.tree(source.ROOT / "bootstrap.py")]
    else:
        trees = [modules()[module], modules()["benchmarks.measure"]]
    options = {option for tree in trees for option in quoted(tree)}
    wanted = [word.split("=")[0] for word in words[1:] if word.startswith("--")] + words[1:2] * (module in ("bootstrap", "jaxspring.cli"))
    unknown = [word for word in wanted if word not in options]
    return f"{module} does not take {', '.join(unknown)}" if unknown else ""


def has_path(span: str, page: pathlib.Path) -> bool:
    """Whether a path exists: from the root, the library or the folder of the file that names it, or as the end of one in the library."""
    places = [folder / span for folder in (source.ROOT, source.LIBRARY, page.parent)]
    return any(place.exists() for place in places) or any(path.as_posix().endswith(f"/{span}") for path in source.files())


def has_name(dotted: str, near: frozenset[str]) -> bool:
    """Whether there is something of that name: alone, in a module, in a class, or of a thing, whatever its class."""
    head, *rest = dotted.split(".")
    if not rest:
        return head in near or head in known()
    if head in FOREIGN:
        return is_foreign(dotted)
    if head in ("js", "jaxspring") and is_public(rest):
        return True
    if any(is_in_module(name, dotted) for name in modules()):
        return True
    if head in classes():
        return rest[0] in members(head)
    return head in near | known() and all(part in known() for part in rest)


def is_public(names: list[str]) -> bool:
    """Whether the library hands out a thing of that name, itself or a public module of it, and the thing has what is named after it."""
    face: object = jaxspring
    while isinstance(face, types.ModuleType) and names and names[0] in getattr(face, "__all__", ()):
        face, names = getattr(face, names[0]), names[1:]
    if isinstance(face, types.ModuleType):
        return face is not jaxspring and not names
    return not names or names[0] in members(face.__name__ if isinstance(face, type) else "")


def is_in_module(module: str, dotted: str) -> bool:
    """Whether `dotted` ends at this module or at something that it defines, the module by its full name or the end of it."""
    if f".{module}".endswith(f".{dotted}"):
        return True
    place, _, name = dotted.rpartition(".")
    return f".{module}".endswith(f".{place}") and name in defined(modules()[module])


def is_foreign(dotted: str) -> bool:
    """Whether another package has that name."""
    head, *rest = dotted.split(".")
    thing: object = importlib.import_module(FOREIGN[head])
    for part in rest:
        if isinstance(thing, types.ModuleType) and not hasattr(thing, part):
            inner = f"{thing.__name__}.{part}"
            if not importlib.util.find_spec(inner):
                return False
            thing = importlib.import_module(inner)
        elif not hasattr(thing, part):
            return False
        else:
            thing = getattr(thing, part)
    return True
