"""The library is a stack of layers, and imports go down only."""

import graphlib

import pytest

from tests import source

# One layer per module or package right under jaxspring/. A module may import its own layer and those below.
LAYERS = {
    "_version": 0,
    "_arrays": 0,
    "_checks": 0,
    "_lazy": 0,
    "_names": 0,  # a table of strings, though of the names of all layers
    "numerics": 0,
    "closures": 0,  # functions opened for derivatives
    "facts": 0,
    "printing": 0,
    "status": 0,
    "vector": 0,
    "archive": 0,  # files of arrays, whole or not at all
    "pickling": 0,
    "processes": 0,  # arrays that several processes hold together
    "topology": 1,
    "images": 1,
    "memory": 1,
    "linalg": 2,
    "state": 2,  # a topology and its node fields; forces read it
    "files": 5,
    "numbering": 5,  # what a file holds of nodes and springs
    "forces": 3,
    "contact": 3,
    "thermal": 3,
    "fluid": 3,  # public names of forces
    "plasticity": 3,  # as well
    "cloth": 8,  # public names of forces, meshes, fabrics, files of surfaces, and scenes
    "masses": 4,
    "nodes": 4,
    "bound": 4,
    "system": 4,
    "edit": 4,
    "stability": 4,
    "steppers": 5,
    "equilibrium": 5,
    "modes": 5,
    "watch": 6,  # watch, blocks, progress and resume are the parts of a rollout
    "blocks": 6,
    "progress": 6,
    "resume": 6,
    "rollouts": 6,
    "events": 6,
    "batching": 6,
    "sharing": 6,
    "ode": 6,
    "inverse": 7,
    "study": 7,
    "plots": 7,
    "export": 7,  # files for viewers
    "scenes": 8,
    "lens": 8,  # public names of a scene
    "reconstruction": 8,  # public names of a scene
    "robot": 8,  # public names of a scene and of what drives it
    "cli": 8,
    "__main__": 9,
    "__init__": 9,  # the public names
}
# Third-party packages that any module may load; the rest waits inside the function that needs it.
EVERYWHERE = {"jax", "numpy", "equinox", "jaxtyping"}
# Packages kept to certain places, at the top of the file or inside a function.
CONFINED = {
    "diffrax": {"ode"},
    "optax": {"inverse"},
    "optimistix": {"inverse", "equilibrium"},
    "lineax": {"linalg", "steppers", "equilibrium", "inverse"},
}


def unit(name: str) -> str:
    """The part of a dotted name that has a layer: `forces` for `jaxspring.forces.springs`."""
    return [*name.split("."), "__init__"][1]


@pytest.mark.parametrize("path", source.files(), ids=source.module_name)
def test_imports_go_down(path):
    """A module imports its own layer or a lower one; so does a function inside it."""
    here = unit(source.module_name(path))
    assert here in LAYERS, f"{path.name}: jaxspring/{here} has no layer. Give it one in tests/api/test_layers.py."
    upward = [
        f"line {line}: {name}"
        for name, line, _ in source.imports(path)
        if name.split(".")[0] == "jaxspring" and LAYERS.get(unit(name), 99) > LAYERS[here]
    ]
    assert not upward, f"{source.module_name(path)} (layer {LAYERS[here]}) imports from above: {'; '.join(upward)}"


def test_no_import_cycle():
    """Some order of loading exists in which every module comes after all that it imports, early or late."""
    graph = {source.module_name(path): {name for name, _, _ in source.imports(path) if "jaxspring." in name} for path in source.files()}
    try:
        list(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        pytest.fail("an import cycle: " + " -> ".join(error.args[1]))


@pytest.mark.parametrize("path", source.files(), ids=source.module_name)
def test_heavy_packages_are_loaded_late_and_in_their_place(path):
    """A file loads few packages; optional and heavy ones wait inside a function, and some belong to one layer."""
    here = unit(source.module_name(path))
    at_home = {package for package, places in CONFINED.items() if here in places}
    allowed_early = source.STANDARD | EVERYWHERE | at_home | {"jaxspring"}
    wrong = []
    for name, line, early in source.imports(path):
        package = name.split(".")[0]
        if package in CONFINED and package not in at_home:
            wrong.append(f"line {line}: {package} belongs to {' or '.join(sorted(CONFINED[package]))}")
        elif early and package not in allowed_early:
            wrong.append(f"line {line}: import {package} inside the function that needs it")
    assert not wrong, f"{source.module_name(path)}: {'; '.join(wrong)}"
