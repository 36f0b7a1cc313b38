"""The public names: each resolves, has one home, says what it is, and stands in docs/api.md."""

import collections
import importlib
import inspect
import re
import types

import jaxspring as js
from tests import face, source


def public() -> dict[str, object]:
    """Every public name and what it stands for."""
    return {name: getattr(js, name) for name in js.__all__}


def test_every_public_name_resolves_and_is_listed_once():
    """`__all__` has no double, no private name but the version, and each name resolves; so does `dir`."""
    assert [name for name, n in collections.Counter(js.__all__).items() if n > 1] == []
    assert [name for name in js.__all__ if name.startswith("_") and name != "__version__"] == []
    assert [name for name in js.__all__ if not hasattr(js, name)] == []
    assert set(js.__all__) <= set(dir(js))


def test_type_checkers_see_the_same_names():
    """The imports under TYPE_CHECKING are those of the table; `python -m tests.face` writes them."""
    assert face.written(face.FILE.read_text()) == face.block()


def test_an_unknown_name_is_an_attribute_error():
    """Lazy loading must not turn a misspelt name into another kind of error: hasattr and doctest rely on it."""
    assert not hasattr(js, "no_such_name")


def test_every_public_name_has_one_home():
    """A class or function is reached by one public name, and the module it says it comes from has it."""
    homeless = []
    names = collections.defaultdict(list)
    for name, thing in public().items():
        if inspect.isclass(thing) or inspect.isroutine(thing):
            names[id(thing)].append(name)
            home = importlib.import_module(thing.__module__)
            if not thing.__module__.startswith("jaxspring.") or getattr(home, name, None) is not thing:
                homeless.append(f"{name} says it lives in {thing.__module__}")
    assert homeless == []
    assert [several for several in names.values() if len(several) > 1] == []


def test_every_public_name_has_a_docstring():
    """Classes, functions and modules say what they are in their own words, and so does each public method."""
    silent = []
    for name, thing in public().items():
        if inspect.isclass(thing) or inspect.isroutine(thing) or isinstance(thing, types.ModuleType):
            if not written(thing, name):
                silent.append(name)
            if inspect.isclass(thing):
                silent += [f"{name}.{method}" for method in silent_methods(thing)]
    assert silent == []


def silent_methods(cls: type) -> list[str]:
    """Public methods and properties that the library defines without a docstring, own or inherited."""
    found = []
    for name in dir(cls):
        member = getattr(cls, name, None)
        function = inspect.unwrap(getattr(member, "fget", member))
        ours = inspect.isroutine(function) and (getattr(function, "__module__", None) or "").startswith("jaxspring")
        if ours and not name.startswith("_") and not inspect.getdoc(member):
            found.append(name)
    return found


def written(thing: object, name: str) -> bool:
    """Whether there is a docstring that somebody wrote: a dataclass without one is given its name and fields in brackets."""
    text = thing.__doc__ or ""
    return bool(text.strip()) and not text.startswith(f"{name}(")


def test_every_public_name_is_in_the_reference():
    """docs/api.md names each public name, and no name of `js` that does not exist."""
    text = (source.ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    in_code = set(re.findall(r"[A-Za-z_]\w*", " ".join(re.findall(r"```.*?```|`[^`\n]+`", text, flags=re.S))))
    missing = [name for name in js.__all__ if name not in in_code]
    assert not missing, f"docs/api.md does not name, in backquotes: {', '.join(missing)}"
    unknown = sorted({name for name in re.findall(r"\bjs\.([A-Za-z_]\w*)", text) if not hasattr(js, name)})
    assert not unknown, f"docs/api.md names what js does not have: {', '.join(unknown)}"


def test_no_public_name_is_also_a_module_of_the_package():
    """Importing `jaxspring.NAME` as a module would put the module in the place of the function of that name."""
    modules = {path.stem for path in source.LIBRARY.iterdir()}
    assert not modules & set(js.__all__)
