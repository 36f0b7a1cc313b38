"""What editors and type checkers see of `jaxspring`: one import per public name, in `jaxspring/__init__.py`.

    python -m tests.face

writes the block anew after a change of `_HOMES`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jaxspring

FILE = Path(jaxspring.__file__)
START = "if TYPE_CHECKING:  # written by `python -m tests.face`\n"
END = "else:\n"


def block() -> str:
    """The imports, in the order of the table."""
    lines = (f"    from .{home} import {name} as {name}\n" for home, names in jaxspring._HOMES.items() for name in names)
    return START + "".join(lines) + END


def written(text: str) -> str:
    """The block as it stands in the file."""
    return text[text.index(START) : text.index(END, text.index(START)) + len(END)]


def main() -> None:
    """Put the block where the old one was."""
    text = FILE.read_text()
    FILE.write_text(text.replace(written(text), block()))


if __name__ == "__main__":
    sys.exit(main())
