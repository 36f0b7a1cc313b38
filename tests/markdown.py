"""Reads a Markdown page: its code blocks, which can be run, its links and its headings."""

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


def prose(path: pathlib.Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```\s*$", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)


def links(path: pathlib.Path) -> list[tuple[pathlib.Path, str]]:
    """The relative links and pictures of a page: the file each leads to, and the heading in it ("" for none)."""
    targets = re.findall(r"\]\(([^)\s]+)[^)]*\)", prose(path))
    local = [target.partition("#") for target in targets if "://" not in target and not target.startswith("mailto:")]
    return [((path.parent / file).resolve() if file else path, heading) for file, _, heading in local]


def headings(path: pathlib.Path) -> set[str]:
    """The names by which links reach the headings of a page: as GitHub makes them, in lower case, hyphens for blanks."""
    titles = re.findall(r"^#+ +(.*?)\s*$", prose(path), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
