"""The command `jaxspring walk`."""

from __future__ import annotations

import argparse
import pathlib

from ..command import Command, UnusableError, Written, add_out, number, out_folder, settings_of, whole_number

LARGEST_DEPTH = 8
LONGEST = 20.0  # seconds of a walk: gradients through more are lost in chaos


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `jaxspring walk` takes."""
    parser.add_argument("--iterations", type=whole_number, metavar="N", default=100, help="updates of the controller (100)")
    parser.add_argument("--depth", type=depth, metavar="N", help="cells across the way: 0 is two dimensions, 1 or more three")
    parser.add_argument("--body", type=body, metavar="ROWS", help="rows of cells from the top down, such as '####/#..#'")
    parser.add_argument("--duration", type=number, metavar="S", help="simulated time of a walk in seconds (2)")
    parser.add_argument("--seed", type=whole_number, metavar="N", help="of the first weights (0)")
    add_out(parser, "jaxspring-walk")
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted or finished run with the same DIR"
    )


def run(given: argparse.Namespace, out: pathlib.Path) -> Written:
    """Train a robot and write the folder; see `job.walk_job`.

    Raises:
        UnusableError: the settings make no scene.
    """
    from .job import walk_job
    from .scene import RobotSettings

    settings = settings_of(RobotSettings, given, ("depth", "body", "duration", "seed"))
    if settings.duration > LONGEST:
        raise UnusableError(f"--duration {settings.duration:g}: a walk takes {LONGEST:g} seconds at most.")
    return walk_job(settings, given.iterations, out, given.resume)


def depth(text: str) -> int:
    """Cells across the way."""
    value = whole_number(text)
    if value > LARGEST_DEPTH:
        raise argparse.ArgumentTypeError(f"{text!r}: more than {LARGEST_DEPTH} cells across the way")
    return value


def body(text: str) -> tuple[str, ...]:
    """`####/#..#` as ("####", "#..#")."""
    if len(text) > 256:
        raise argparse.ArgumentTypeError(f"a drawing of {len(text)} characters; 256 at most")
    return tuple(text.split("/"))


COMMAND = Command(
    name="walk",
    help="train a soft robot to walk",
    description="A robot of springs learns to walk by gradients through the simulation; writes a report, pictures and an animation.",
    add_arguments=add_arguments,
    folder=out_folder,
    run=run,
)
