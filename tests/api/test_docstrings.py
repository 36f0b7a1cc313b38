"""What docstrings say: an answer with its question, symbols in their own case, every argument, result and error of a public name."""

import ast
import enum
import inspect
import re
import textwrap
import types
from typing import Any

import pytest

import jaxspring as js
from tests import docstrings, references

GREEK = "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi rho sigma tau phi chi psi omega"
LETTERS = "|".join(["[A-Za-z]", "[dD][A-Za-z]", *GREEK.split(), *GREEK.title().split()])
SYMBOL = re.compile(rf"(?:{LETTERS})(?:_\w+)?(?![\w-])")
# Where a sentence begins: at the top, after a paragraph, after another sentence.
SENTENCE = re.compile(r"\A|(?<=\n\n)|(?<=[a-z)\]]\. )")


def public(module: types.ModuleType, before: str = "") -> dict[str, Any]:
    """What a module hands out, and its public modules, by name."""
    found = {}
    for name in module.__all__:
        thing = getattr(module, name)
        found |= public(thing, f"{before}{name}.") if isinstance(thing, types.ModuleType) else {before + name: thing}
    return found


PUBLIC = public(js)
FUNCTIONS = [name for name, thing in PUBLIC.items() if inspect.isroutine(thing)]
# An exception and an enumeration are not built from arguments.
CLASSES = [name for name, thing in PUBLIC.items() if inspect.isclass(thing) and not issubclass(thing, Exception | enum.Enum)]


def test_no_docstring_is_a_bare_answer():
    """No docstring is one word, or begins with Yes, No or None: it says what is asked, as in "Whether dt may be negative: ..."."""
    answer = re.compile(r"(?:Yes|No|None|It does|It does not)[.:,;]")
    bare = [d for d in docstrings.all_docstrings() if answer.match(d.text) or len(d.text.split()) == 1]
    assert [d.place for d in bare] == []


def test_docstrings_begin_with_a_capital_or_a_symbol():
    """A docstring begins with a capital, unless it begins with a symbol, a name or a call: these keep their case."""
    found = []
    for docstring in docstrings.all_docstrings():
        word = re.match(r"[a-z]\w*", docstring.text)
        is_name = word and (re.search(r"[_\d]", word[0]) or re.match(r"[('^/.\[]", docstring.text[word.end() :]))
        if word and not is_name and not SYMBOL.match(docstring.text) and word[0] not in parameters(docstring.owner):
            found.append(f"{docstring.place}: {word[0]}")
    assert found == []


def test_symbols_keep_their_case():
    """A sentence that begins with a symbol does not change its case: `v + dt a`, not `V + dt a`. How a symbol is written is taken from
    the rest of the docstring and the parameters, else from the other docstrings of the file, but for their first words.
    """
    found = []
    for docstring in docstrings.all_docstrings():
        elsewhere = {word for other in docstrings.of_file(docstring.path) for word in words(re.sub(r"\A\W*\w+", "", other.text))}
        for symbol, rest in first_symbols(docstring.text):
            nearby = words(rest) | parameters(docstring.owner)
            other = symbol[0].swapcase() + symbol[1:]
            known = nearby if {symbol, other} & nearby else elsewhere
            if other in known and symbol not in known:
                found.append(f"{docstring.place}: {symbol}, elsewhere {other}")
    assert found == []


def first_symbols(text: str) -> list[tuple[str, str]]:
    """The symbols with which sentences begin, each with the text without it."""
    found = []
    for start in SENTENCE.finditer(text):
        symbol = SYMBOL.match(text, start.end())
        if symbol and not (symbol[0] in ("A", "I") and not re.match(r" [-+*/] ", text[symbol.end() :])) and symbol[0] != "Do":
            found.append((symbol[0], text[: symbol.start()] + text[symbol.end() :]))
    return found


def words(text: str) -> set[str]:
    """Every word and symbol in a text."""
    return set(re.findall(r"[A-Za-z]\w*", text))


def parameters(owner: docstrings.Owner) -> set[str]:
    """Names of a function's parameters; none of a class or a file."""
    if not isinstance(owner, ast.FunctionDef | ast.AsyncFunctionDef):
        return set()
    taken = owner.args
    rest = () if taken.kwarg is None else (taken.kwarg,)
    return {argument.arg for argument in (*taken.posonlyargs, *taken.args, *taken.kwonlyargs, *rest)}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_public_functions_say_what_they_take_return_and_raise(name):
    """Under `Args:` stands every parameter, under `Returns:` what comes back, under `Raises:` every error that its own body raises."""
    function = PUBLIC[name]
    text, signature = inspect.getdoc(function) or "", inspect.signature(function)
    assert set(signature.parameters) == entries(text, "Args")
    assert bool(section(text, "Returns").strip()) == (signature.return_annotation not in ("None", None))
    body = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(function))))
    raised = {ast.unparse(node.exc).split("(")[0] for node in ast.walk(body) if isinstance(node, ast.Raise) and node.exc}
    assert raised <= entries(text, "Raises")


@pytest.mark.parametrize("name", CLASSES)
def test_public_classes_say_what_they_are_built_from(name):
    """Every parameter of a constructor stands under `Attributes:` or `Args:`, of the class or of the constructor."""
    cls = PUBLIC[name]
    texts = [inspect.cleandoc(text or "") for text in (cls.__doc__, cls.__init__.__doc__)]
    told = {entry for text in texts for title in ("Attributes", "Args") for entry in entries(text, title)}
    assert set(inspect.signature(cls).parameters) - told == set()


def test_sections_name_what_there_is():
    """In all code: under `Args:` stand the parameters, every one and no other; under `Attributes:` what the class has."""
    wrong = []
    for docstring in docstrings.all_docstrings():
        if isinstance(docstring.owner, ast.ClassDef):
            unknown = entries(docstring.text, "Attributes") - references.members(docstring.owner.name)
        else:
            told, taken = entries(docstring.text, "Args"), parameters(docstring.owner) - {"self", "cls"}
            unknown = told ^ taken if told else set()
        wrong += [f"{docstring.place}: {name}" for name in sorted(unknown)]
    assert wrong == []


def section(text: str, title: str) -> str:
    """The lines under a title, up to the next line that is not indented."""
    found = re.search(rf"^{title}:\n((?:[ ]{{4}}.*\n|\n)*)", text + "\n", flags=re.M)
    return textwrap.dedent(found[1]) if found else ""


def entries(text: str, title: str) -> set[str]:
    """The names that stand under a title, as `name:` or `name, other:`."""
    return {name for line in re.findall(r"^(\w+(?:, \w+)*): ", section(text, title), flags=re.M) for name in line.split(", ")}
