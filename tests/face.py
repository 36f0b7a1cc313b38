"""The public names: in which modules they stand, and what editors and type checkers see of these modules, one import per name.

    python -m tests.face

writes the imports anew after a change of `jaxspring/_names.py`.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from jaxspring._lazy import ALSO, HOME_OF, SUBMODULES, TOP, spelt
from jaxspring._names import PUBLIC

START = "if TYPE_CHECKING:  # written by `python -m tests.face`\n"
END = "else:\n"


def faces() -> dict[str, Any]:
    """The public modules, by what stands in the table of names: "" is `jaxspring` itself."""
    return {name: importlib.import_module(f"{TOP}.{name}".rstrip(".")) for name in PUBLIC}


def public() -> dict[str, Any]:
    """Every public name, bare, and what it stands for; without the version and the submodules."""
    found = {name: getattr(module, name) for module in faces().values() for name in module.__all__ if name != "__version__"}
    return {name: thing for name, thing in found.items() if not isinstance(thing, ModuleType)}


def written_as() -> set[str]:
    """Every public name as users write it: `js.rollout`, `js.linalg`, `js.linalg.Jacobi`."""
    return {spelt(name) for name in (*public(), *SUBMODULES)}


def file(face: str) -> Path:
    """The source of a public module."""
    return Path(str(faces()[face].__file__))


def block(face: str) -> str:
    """The imports of a public module, in the order of the table."""
    submodules = SUBMODULES if not face else []
    lines = [f"    from . import {name} as {name}\n" for name in submodules]
    names = [name for names in PUBLIC[face].values() for name in names]
    lines += [f"    from {relative(HOME_OF[name], face)} import {name} as {name}\n" for name in (*names, *ALSO.get(face, ()))]
    return START + "".join(lines) + END


def relative(home: str, face: str) -> str:
    """A home as the public module imports from it."""
    is_package = file(face).name == "__init__.py"
    if is_package and home.startswith(f"{face}."):
        return home.removeprefix(face)
    return f"..{home}" if face and is_package else f".{home}"


def written(text: str) -> str:
    """The block as it stands in the file."""
    return text[text.index(START) : text.index(END, text.index(START)) + len(END)]


def main() -> None:
    """Put the blocks where the old ones were."""
    for face in PUBLIC:
        text = file(face).read_text(encoding="utf-8")
        file(face).write_text(text.replace(written(text), block(face)), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
