"""The locks agree with pyproject.toml, name no host, and the version is one."""

import re
import tomllib

import packaging.requirements
import packaging.utils
import packaging.version
import pytest

import jaxspring._version
from tests import source

PYPROJECT = tomllib.loads((source.ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCKS = ("requirements.lock", "requirements-newest.lock")
each_lock = pytest.mark.parametrize("lock", LOCKS)


def text_of(lock: str) -> str:
    return (source.ROOT / lock).read_text(encoding="utf-8")


def pinned(lock: str) -> dict[str, list[str]]:
    """Every package of the lock with its versions: several where they depend on the Python."""
    found: dict[str, list[str]] = {}
    for name, version in re.findall(r"^([\w.-]+)==([^ ;\\]+)", text_of(lock), flags=re.M):
        found.setdefault(packaging.utils.canonicalize_name(name), []).append(version)
    return found


def asked(lock: str) -> list[packaging.requirements.Requirement]:
    """Everything that pyproject.toml asks for: to build, to run, the extras, the groups; the newest is not linted."""
    project = PYPROJECT["project"]
    groups = dict(PYPROJECT["dependency-groups"])
    if lock == "requirements-newest.lock":
        del groups["lint"]
    lists = [PYPROJECT["build-system"]["requires"], project["dependencies"]]
    lists += [*project["optional-dependencies"].values(), *groups.values()]
    found = [packaging.requirements.Requirement(text) for group in lists for text in group]
    here = {"python_version": "3.12" if lock == "requirements-newest.lock" else "3.11"}
    return [one for one in found if one.marker is None or one.marker.evaluate(here)]


@each_lock
def test_the_lock_holds_what_is_asked_for(lock):
    """Each requirement of pyproject.toml is pinned, and each pinned version satisfies it."""
    versions = pinned(lock)
    wrong = [
        str(requirement)
        for requirement in asked(lock)
        if not versions.get(name := packaging.utils.canonicalize_name(requirement.name))
        or not all(requirement.specifier.contains(version) for version in versions[name])
    ]
    assert not wrong, f"{lock} does not fit: {wrong}. CONTRIBUTING.md says how it is made."


@each_lock
def test_the_lock_pins_by_hash_and_names_no_host(lock):
    """Every pin carries a hash; no address of any kind is in the lock."""
    pins = re.split(r"^(?=[\w.-]+==)", text_of(lock), flags=re.M)[1:]
    assert [pin.split()[0] for pin in pins if "--hash=sha256:" not in pin] == []
    assert not re.search(r"://|^\s*-(?!-hash)|@ ", text_of(lock), flags=re.M)


def test_the_locks_are_the_two_ends():
    """The first lock holds the oldest jax that the project allows, the second a newer one."""
    (oldest,), (newest,) = (pinned(lock)["jax"] for lock in LOCKS)
    (allowed,) = (r.specifier for r in asked(LOCKS[0]) if r.name == "jax")
    assert f">={oldest}" in [str(part) for part in allowed]
    assert packaging.version.Version(oldest) < packaging.version.Version(newest)


def test_the_library_asks_for_every_package_it_imports():
    """What a source file imports is a dependency or in an extra; a test-only package in the library is a broken install."""
    project = PYPROJECT["project"]
    texts = [*project["dependencies"], *(text for extra in project["optional-dependencies"].values() for text in extra)]
    declared = {packaging.requirements.Requirement(text).name for text in texts}
    imported_as = {"PIL": "pillow", "mpl_toolkits": "matplotlib"}
    bare = {name.split(".")[0] for path in source.files() for name, _, _ in source.imports(path)}
    third_party = {imported_as.get(name, name) for name in bare} - source.STANDARD - {"jaxspring"}
    assert sorted(third_party - declared - {"networkx"}) == []  # networkx: only ever the user's own graph


def test_the_version_is_one():
    """The version in CITATION.cff and the newest one in CHANGELOG.md are the library's."""
    version = jaxspring._version.__version__
    packaging.version.Version(version)
    assert f"\nversion: {version}\n" in (source.ROOT / "CITATION.cff").read_text(encoding="utf-8")
    headings = re.findall(r"^## \[(.+?)\]", (source.ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.M)
    assert version in headings[:2]  # the first may be [Unreleased]
