"""Public names that are loaded on first use: what a module that hands them out defines, and what it says of a name it does not have."""

from __future__ import annotations

import difflib
import importlib
import sys
from collections.abc import Callable
from typing import Any

from ._names import PUBLIC

TOP = "jaxspring"
SUBMODULES = sorted(set(PUBLIC) - {""})
# Name -> the module that hands it out, and the one in which it lives.
FACE_OF = dict.fromkeys(SUBMODULES, "") | {name: face for face, homes in PUBLIC.items() for names in homes.values() for name in names}
HOME_OF = {name: name for name in SUBMODULES} | {name: home for homes in PUBLIC.values() for home, names in homes.items() for name in names}
# Names of the top that a submodule hands out as well, though its list does not repeat them: `from jaxspring.thermal import Heat`. Not
# those that are modules there: `jaxspring.inverse.fit`.
ALSO = {
    face: [name for home, names in PUBLIC[""].items() if face in home.split(".") for name in names if not home.endswith(f".{name}")]
    for face in SUBMODULES
}


def face(module: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """`__all__`, `__getattr__` and `__dir__` of a public module: `jaxspring`, `jaxspring.linalg` and the like."""
    short = module.removeprefix(TOP).removeprefix(".")
    public = sorted(name for name, where in FACE_OF.items() if where == short)

    def load(name: str) -> Any:
        if FACE_OF.get(name) != short and name not in ALSO.get(short, ()):
            # By its name alone: given the module, too, the interpreter would add a guess of its own.
            raise AttributeError(f"module {module!r} has no attribute {name!r}{hint(name)}", name=name)
        home = importlib.import_module(f"{TOP}.{HOME_OF[name]}")
        value = home if name in SUBMODULES else getattr(home, name)
        setattr(sys.modules[module], name, value)
        return value

    def listed() -> list[str]:
        return sorted({*(name for name in vars(sys.modules[module]) if name.startswith("__")), *public})

    return public, load, listed


def hint(name: str) -> str:
    """Where a public name is to be found, or the public name that is spelt most like it; empty where there is none."""
    if name.startswith("_"):
        return ""
    if name in FACE_OF:
        return f". It is {spelt(name)}"
    small = {public.lower(): public for public in FACE_OF}
    near = difflib.get_close_matches(name, FACE_OF, n=1) or [small[a] for a in difflib.get_close_matches(name.lower(), small, n=1)]
    return f". Did you mean {spelt(near[0])}?" if near else ""


def spelt(name: str) -> str:
    """A public name as one writes it after `import jaxspring as js`."""
    return f"js.{FACE_OF[name]}.{name}" if FACE_OF[name] else f"js.{name}"
