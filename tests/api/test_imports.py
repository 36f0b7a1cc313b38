"""`import jaxspring` is cheap and changes nothing.

`import jax, equinox` loads none of the packages below either (jax 0.10.1, equinox 0.13.8), so the list is absolute.
"""

import json
import os
import subprocess
import sys

import pytest

from jaxspring._lazy import SUBMODULES
from tests import source

HEAVY = ["diffrax", "optax", "optimistix", "scipy", "matplotlib", "PIL", "trimesh"]


def python(code: str, **environment: str) -> str:
    """What a fresh interpreter prints for the code; its error text where it fails."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=source.ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_import_loads_nothing_heavy():
    """`import jaxspring` loads none of the packages that only some users need."""
    loaded = json.loads(python("import json, sys, jaxspring; print(json.dumps(sorted(sys.modules)))"))
    assert [name for name in HEAVY if name in loaded] == []


def test_names_and_submodules_are_loaded_on_first_use():
    """`import jaxspring` loads the table of names alone; a submodule comes by its attribute and brings nothing; a name brings its home."""
    code = (
        "import json, sys, jaxspring as js\n"
        "def ours(): return sorted(name for name in sys.modules if name.startswith('jaxspring.'))\n"
        "seen = [ours()]\n"
        f"faces = [getattr(js, name) for name in {SUBMODULES!r}]\n"
        "seen.append(ours())\n"
        "js.linalg.Natural\n"
        "seen.append(ours())\n"
        "print(json.dumps(seen))"
    )
    at_import, faces, home = json.loads(python(code))
    assert at_import == ["jaxspring._lazy", "jaxspring._names", "jaxspring._version"]
    assert set(faces) - set(at_import) == {f"jaxspring.{name}" for name in SUBMODULES}
    assert "jaxspring.linalg.ordering" in home
    assert not {"jaxspring.system", "jaxspring.forces", "jaxspring.linalg.cg"} & set(home)


def test_submodules_are_imported_as_any_module():
    """`import jaxspring.linalg` and `from jaxspring.thermal import ...` work without the top being named first, and so does a star."""
    python("import jaxspring.linalg; jaxspring.linalg.Natural; jaxspring.Vector")
    python(
        "from jaxspring.thermal import Convection, Heat\n"
        "from jaxspring import BackwardEuler, thermal\n"
        "from jaxspring.fluid import *\n"
        "SlideLaw, AllPairs, thermal.Convection\n"
        # A package that is also the home of other modules gives these as well.
        "from jaxspring.linalg import cg, Jacobi\n"
        "assert cg.__name__ == 'jaxspring.linalg.cg'"
    )


def test_no_module_makes_an_array_when_imported():
    """No module of the library starts a device: an array made at import would be of the wrong dtype for half of the users."""
    code = f"import importlib\nfor name in {source.modules()!r}: importlib.import_module(name)"
    # With a platform that does not exist, the first array is an error.
    python(code, JAX_PLATFORMS="no_such_platform")
    with pytest.raises(AssertionError, match="no_such_platform"):
        python(code + "\nimport jax.numpy as jnp; jnp.zeros(1)", JAX_PLATFORMS="no_such_platform")


def test_import_leaves_the_settings_of_jax_alone():
    """Importing every module leaves jax.config as it was: 64-bit is the user's choice."""
    code = (
        "import importlib, jax, equinox\n"
        "before = dict(jax.config.values)\n"
        f"for name in {source.modules()!r}: importlib.import_module(name)\n"
        "print({k: v for k, v in jax.config.values.items() if before.get(k, v) != v})"
    )
    assert python(code).strip() == "{}"
