"""The lock agrees with pyproject.toml, names no host, and the version is one."""

import re
import tomllib

import packaging.requirements
import packaging.utils
import packaging.version

import jaxspring._version
from tests import source

PYPROJECT = tomllib.loads((source.ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LOCK = (source.ROOT / "requirements.lock").read_text(encoding="utf-8")


def pinned() -> dict[str, list[str]]:
    """Every package of the lock with its versions: several where they depend on the Python."""
    found: dict[str, list[str]] = {}
    for name, version in re.findall(r"^([\w.-]+)==([^ ;\\]+)", LOCK, flags=re.M):
        found.setdefault(packaging.utils.canonicalize_name(name), []).append(version)
    return found


def asked() -> list[packaging.requirements.Requirement]:
    """Everything that pyproject.toml asks for: to build, to run, the extras, the groups."""
    project = PYPROJECT["project"]
    lists = [PYPROJECT["build-system"]["requires"], project["dependencies"]]
    lists += [*project["optional-dependencies"].values(), *PYPROJECT["dependency-groups"].values()]
    return [packaging.requirements.Requirement(text) for group in lists for text in group]


def test_the_lock_holds_what_is_asked_for():
    """Each requirement of pyproject.toml is pinned, and each pinned version satisfies it."""
    versions = pinned()
    wrong = [
        str(requirement)
        for requirement in asked()
        if not versions.get(name := packaging.utils.canonicalize_name(requirement.name))
        or not all(requirement.specifier.contains(version) for version in versions[name])
    ]
    assert not wrong, f"requirements.lock does not fit: {wrong}. CONTRIBUTING.md says how it is made."


def test_the_lock_pins_by_hash_and_names_no_host():
    """Every pin carries a hash; no address of any kind is in the lock."""
    pins = re.split(r"^(?=[\w.-]+==)", LOCK, flags=re.M)[1:]
    assert [pin.split()[0] for pin in pins if "--hash=sha256:" not in pin] == []
    assert not re.search(r"://|^\s*-(?!-hash)|@ ", LOCK, flags=re.M)


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
