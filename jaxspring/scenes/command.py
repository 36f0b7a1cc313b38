"""What a scene says of its command, and how its job may end. Loads neither JAX nor NumPy, so that `--help` and mistakes answer at once.

A job is a function of the arguments and the folder for its results. It returns a `Written`, or raises: `UnusableError` where what was asked
for cannot be done, `FailedError` where it went wrong, `StoppedError` where Ctrl-C ended it and `--resume` goes on.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import pathlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

Settings = TypeVar("Settings")
REPORT = "report.json"


@dataclass(frozen=True)
class Written:
    """What a job did.

    Attributes:
        table: what came out, for the terminal.
        files: what the folder holds, in words, such as "report.json and 4 pictures".
    """

    table: str
    files: str


@dataclass(frozen=True)
class Command:
    """A scene's command.

    Attributes:
        name: the word that calls it.
        help: one line for the list of commands.
        description: a sentence or two for its own help.
        add_arguments: adds the scene's arguments to a parser.
        folder: from the arguments, where the results go.
        run: from the arguments and that folder, the work.
    """

    name: str
    help: str
    description: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    folder: Callable[[argparse.Namespace], pathlib.Path]
    run: Callable[[argparse.Namespace, pathlib.Path], Written]


class UnusableError(Exception):
    """The arguments, or a file that they name, cannot be used. One line."""


class FailedError(Exception):
    """The work failed, or its results could not be written. One line."""


class StoppedError(Exception):
    """Ctrl-C ended the work, and there is a checkpoint to go on from. The text says how much was done, such as "12 frames"."""


def check_folder(out: pathlib.Path) -> None:
    """OSError where results could not be written, before anything is computed: the work of minutes would be lost."""
    parent = out.absolute().parent
    if not parent.is_dir():
        raise FileNotFoundError(f"--out {out}: the folder {parent} does not exist; make it first.")
    if not os.access(parent, os.W_OK):
        raise PermissionError(f"--out {out}: the folder {parent} cannot be written; choose another with --out.")
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out {out}: this is a file; choose a folder with --out.")
    if out.is_dir():
        check_replaceable(out)


def check_replaceable(out: pathlib.Path) -> None:
    """OSError unless everything in this folder is what an earlier job wrote there, as its report says: the folder will be replaced."""
    if pathlib.Path.cwd().is_relative_to(out.resolve()):
        raise FileExistsError(f"--out {out}: the folder in which you are cannot be replaced; choose another with --out.")
    ours = _listed(out / REPORT)
    others = [name for name in file_names(out) if name not in ours]
    if others:
        named = ", ".join(others[:3])
        raise FileExistsError(f"--out {out}: the folder holds other files ({named}), which would be lost; choose another with --out.")


def file_names(folder: pathlib.Path) -> list[str]:
    """Every file in a folder and its folders, and every folder that holds nothing, as `pictures/loss.png`; sorted."""
    found = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir() or not any(path.iterdir()))
    return sorted(path.relative_to(folder).as_posix() for path in found)


def _listed(report: pathlib.Path) -> set[str]:
    """The files that a report says were written with it."""
    try:
        files = json.loads(report.read_text(encoding="utf-8"))["files"]
    except (OSError, ValueError, KeyError, TypeError):
        return set()
    return {name for name in files if isinstance(name, str)} if isinstance(files, list) else set()


def settings_of(kind: Callable[..., Settings], given: argparse.Namespace, names: tuple[str, ...]) -> Settings:
    """A scene's settings, with those of these arguments that were given.

    Raises:
        UnusableError: they make no scene.
    """
    changed = {name: getattr(given, name) for name in names if getattr(given, name) is not None}
    try:
        return kind(**changed)
    except ValueError as error:
        raise UnusableError(str(error)) from error


def add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """The argument `--out`, for `out_folder`."""
    parser.add_argument("--out", metavar="DIR", default=default, help="folder for the results; an older result there is replaced")


def out_folder(given: argparse.Namespace) -> pathlib.Path:
    """Where the results go."""
    return pathlib.Path(given.out)


def number(text: str) -> float:
    """An argument that is a finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def whole_number(text: str) -> int:
    """An argument that is a whole number, zero or more."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, zero or more")
    return int(text)


__all__ = [
    "REPORT",
    "Command",
    "FailedError",
    "StoppedError",
    "UnusableError",
    "Written",
    "add_out",
    "check_folder",
    "check_replaceable",
    "file_names",
    "number",
    "out_folder",
    "settings_of",
    "whole_number",
]
