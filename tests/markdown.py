"""Reads and runs the code blocks of a Markdown page."""

import pathlib
import re


def blocks(path: pathlib.Path, language: str, after: str = "") -> list[str]:
    """The fenced blocks of one language, in order; `after` starts at the first heading with that text."""
    text = path.read_text(encoding="utf-8")
    if after:
        heading = re.search(rf"^#+ {re.escape(after)}\s*$", text, flags=re.M)
        assert heading, f"{path.name} has no heading {after!r}"
        text = text[heading.end() :]
    return re.findall(rf"^```{language}\n(.*?)^```\s*$", text, flags=re.M | re.S)


def run(path: pathlib.Path, code: list[str]) -> None:
    """Run the blocks of a page one after another, in one namespace, as a reader would."""
    namespace = {"__name__": "__page__"}
    for number, block in enumerate(code, 1):
        exec(compile(block, f"{path.name}, python block {number}", "exec"), namespace)
