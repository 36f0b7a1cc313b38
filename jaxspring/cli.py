"""The command `jaxspring`: run a scene into a folder, without writing a program.

Exit codes: 0 done; 1 the work failed; 2 the arguments or a file cannot be used; 130 interrupted. Trouble is one line on the error stream.
Everything heavy is imported after the arguments are understood, so that `--help` and mistakes answer at once.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pathlib
import sys
from collections.abc import Sequence
from typing import NoReturn

from ._version import __version__
from .scenes.command import Command, FailedError, StoppedError, UnusableError, Written, check_folder

DONE, FAILED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130
# The scenes with a command: the name of each one's package in `scenes`. What the command is called and takes is said there, in `command`.
SCENES = (
    "reconstruction",
    "melting",
    "robot",
    "cloth",
    "lens",
)


def main(argv: Sequence[str] | None = None, commands: Sequence[Command] | None = None, program: str = "jaxspring") -> int:
    """Run the command with these arguments (those of the process unless given); returns its exit code.

    Args:
        argv: the words after the program's name.
        commands: what it can do; the library's own scenes unless given.
        program: its name, for the help and for what it says of trouble.
    """
    try:
        command, given = parse(sys.argv[1:] if argv is None else argv, commands, program)
    except SystemExit as ended:  # argparse: --help and --version with 0, a mistake with 2
        return int(ended.code or 0)
    try:
        code, trouble = run(command, given)
    except KeyboardInterrupt:
        code, trouble = INTERRUPTED, "interrupted; no results were written."
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    if trouble:
        print(f"{program}: {' '.join(trouble.split())}", file=sys.stderr)
    return code


def parse(argv: Sequence[str], commands: Sequence[Command] | None = None, program: str = "jaxspring") -> tuple[Command, argparse.Namespace]:
    """The command that was called, and its arguments, checked. Ends the process with code 2 and one line where they make no sense."""
    known = {command.name: command for command in (own_commands() if commands is None else commands)}
    parser = _Parser(prog=program, description="Differentiable mass-spring systems.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"jaxspring {__version__}")
    choices = parser.add_subparsers(title="commands", dest="command", required=True, parser_class=_Parser)
    for name, command in known.items():
        command.add_arguments(choices.add_parser(name, help=command.help, description=command.description, allow_abbrev=False))
    given = parser.parse_args(argv)
    return known[given.command], given


def own_commands() -> list[Command]:
    """The commands of the library's own scenes."""
    return [importlib.import_module(f".scenes.{name}.command", __package__).COMMAND for name in SCENES]


def run(command: Command, given: argparse.Namespace) -> tuple[int, str]:
    """Do the work and say what was written; returns the exit code and, where there was trouble, what it was."""
    try:
        out = pathlib.Path(command.folder(given))
        check_folder(out)
    except (UnusableError, OSError) as error:
        return UNUSABLE, str(error)
    from .archive import CheckpointError

    try:
        written = command.run(given, out)
    except StoppedError as done:
        return INTERRUPTED, f"interrupted after {done}; the same command with --resume goes on."
    except FailedError as error:
        return FAILED, str(error)
    except (UnusableError, CheckpointError, OSError, ImportError, MemoryError) as error:
        return UNUSABLE, str(error) or "there is not enough memory."
    if not isinstance(written, Written):
        raise TypeError(
            f"the run of {command.name!r} returned {type(written).__name__}; expected a Written, which says what the folder holds."
        )
    print(written.table)
    print(f"Written to {out}{os.sep}: {written.files}.")
    return DONE, ""


class _Parser(argparse.ArgumentParser):
    """Mistakes in one line, without the usage text around it."""

    def error(self, message: str) -> NoReturn:
        self.exit(UNUSABLE, f"{self.prog}: {message} (see {self.prog} --help)\n")
