"""The public names: few at the top, each resolves, has one home, says what it is, and stands in docs/api.md."""

import collections
import importlib
import inspect
import json
import pathlib
import pickle
import re
import types

import pytest

import jaxspring as js
from jaxspring._lazy import ALSO
from jaxspring._names import PUBLIC
from tests import face, source

MOST_AT_THE_TOP = 120  # what one can still read through, submodules and version included
# Where names are written as users write them; not CHANGELOG.md, which speaks of names that are no more.
WRITTEN = ("README.md", "CONTRIBUTING.md", "docs/**/*.md", "docs/**/*.py", "notebooks/*.ipynb", "jaxspring/**/*.py", "benchmarks/*.py")
each_face = pytest.mark.parametrize("name", PUBLIC, ids=lambda name: name or "top")


@each_face
def test_every_public_name_resolves_and_is_listed_once(name):
    """`__all__` has no double, no private name but the version, and each name resolves; so does `dir`."""
    module = face.faces()[name]
    assert [name for name, n in collections.Counter(module.__all__).items() if n > 1] == []
    assert [name for name in module.__all__ if name.startswith("_") and name != "__version__"] == []
    assert [name for name in module.__all__ if not hasattr(module, name)] == []
    assert set(module.__all__) <= set(dir(module))


def test_no_name_stands_in_two_modules():
    """A public name is bare in one module only, so that an error can say which."""
    every = [name for homes in PUBLIC.values() for names in homes.values() for name in names]
    assert [name for name, n in collections.Counter(every).items() if n > 1] == []
    assert set(face.public()) == set(every)


def test_few_names_at_the_top():
    """What most scenes need is seen at a glance; an expert's name goes to a submodule."""
    assert len(js.__all__) <= MOST_AT_THE_TOP, "give the new name to a submodule: jaxspring/_names.py"


@each_face
def test_type_checkers_see_the_same_names(name):
    """The imports under TYPE_CHECKING are those of the table; `python -m tests.face` writes them."""
    assert face.written(face.file(name).read_text(encoding="utf-8")) == face.block(name)


@each_face
def test_an_unknown_name_is_an_attribute_error(name):
    """Lazy loading must not turn a misspelt name into another kind of error: hasattr and doctest rely on it."""
    module = face.faces()[name]
    assert not hasattr(module, "no_such_name")
    assert not hasattr(module, "__no_such_name__")


@pytest.mark.parametrize(
    ("name", "wrong", "answer"),
    [
        ("", "BlockJacobi", "It is js.linalg.BlockJacobi"),
        ("", "latice", "Did you mean js.lattice?"),
        ("", "bdf2", "Did you mean js.BDF2?"),
        ("", "lin_alg", "Did you mean js.linalg?"),
        ("thermal", "Convecion", "Did you mean js.thermal.Convection?"),
        ("thermal", "Jacobi", "It is js.linalg.Jacobi"),
        ("fluid", "rollout", "It is js.rollout"),
        ("reconstruction", "thermal", "It is js.thermal"),
        ("", "no_such_name_at_all", "has no attribute 'no_such_name_at_all'"),
    ],
)
def test_a_name_of_elsewhere_is_told_where_it_stands(name, wrong, answer):
    """The error names the place of a public name, or the public name that is spelt most like it; and ends there."""
    with pytest.raises(AttributeError) as caught:
        getattr(face.faces()[name], wrong)
    assert str(caught.value).endswith(answer)


def test_submodules_hand_out_what_lives_in_them_and_stands_at_the_top():
    """`from jaxspring.thermal import Heat` is `js.Heat`; the list of `js.thermal` does not repeat it."""
    assert "Heat" in ALSO["thermal"]
    assert "Fluid" in ALSO["fluid"]
    for name, names in ALSO.items():
        module = face.faces()[name]
        assert not set(names) & set(module.__all__)
        assert [one for one in names if getattr(module, one) is not getattr(js, one)] == []


def test_every_name_that_is_written_is_public():
    """Pages, notebooks, programs, examples and messages write `js.NAME` and `js.linalg.NAME` of public names only."""
    submodules = "|".join(filter(None, PUBLIC))
    name = re.compile(rf"(?<![\w./])js\.(?:(?:{submodules})\.)?[A-Za-z]\w*")
    written = {path: set(name.findall(text_of(path))) for pattern in WRITTEN for path in source.ROOT.glob(pattern)}
    assert {path.name: sorted(names - face.written_as()) for path, names in written.items() if names - face.written_as()} == {}
    assert {"js.rollout", "js.linalg", "js.linalg.Jacobi"} <= set().union(*written.values())


def text_of(path: pathlib.Path) -> str:
    """What stands in a file; of a notebook, the sources of its cells."""
    text = path.read_text(encoding="utf-8")
    return "".join(line for cell in json.loads(text)["cells"] for line in cell["source"]) if path.suffix == ".ipynb" else text


def test_every_public_name_has_one_home():
    """A class or function is reached by one public name, and the module it says it comes from has it."""
    homeless = []
    names = collections.defaultdict(list)
    for name, thing in face.public().items():
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
    for name, thing in face.public().items():
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
    """docs/api.md has one line for each public name, and for nothing else."""
    text = (source.ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `([\w.]+)` \|", text, flags=re.M)
    assert [name for name, n in collections.Counter(named).items() if n > 1] == []
    assert sorted({*face.written_as(), "__version__"} - set(named)) == [], "docs/api.md has no line for these"
    assert sorted(set(named) - face.written_as() - {"__version__"}) == [], "docs/api.md has lines for what is not public"


@each_face
def test_no_public_name_is_also_a_module_of_the_package(name):
    """Importing `jaxspring.NAME` as a module would put the module in the place of the function of that name."""
    module = face.faces()[name]
    folder = face.file(name).parent
    modules = {path.stem for path in folder.iterdir()} if face.file(name).name == "__init__.py" else set()
    assert not modules & {one for one in module.__all__ if not isinstance(getattr(module, one), types.ModuleType)}


@each_face
def test_every_public_class_and_function_pickles(name):
    """It goes to other processes under its own name, and comes back as itself."""
    module = face.faces()[name]
    for public in (getattr(module, name) for name in module.__all__):
        if callable(public) and not isinstance(public, types.GenericAlias):
            assert pickle.loads(pickle.dumps(public)) is public
