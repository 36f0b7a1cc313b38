"""The command `jaxspring melt`."""

from __future__ import annotations

import argparse
import pathlib

from ..command import Command, Written, add_out, out_folder, settings_of

LARGEST_BLOCK = 4_096  # particles: every pair of them is looked at in every step


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `jaxspring melt` takes."""
    parser.add_argument("--nodes", type=block, metavar="NXxNYxNZ", help="particles of the block along x, y and z")
    parser.add_argument("--duration", type=seconds, metavar="S", help="simulated time in seconds")
    add_out(parser, "jaxspring-melt")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted run with the same DIR")


def run(given: argparse.Namespace, out: pathlib.Path) -> Written:
    """Melt a block and write the folder; see `job.melt`.

    Raises:
        UnusableError: the settings make no scene.
    """
    from ...progress import Progress
    from .job import melt
    from .scene import MeltSettings

    return melt(settings_of(MeltSettings, given, ("nodes", "duration")), out, Progress("melt"), given.resume)


def block(text: str) -> tuple[int, int, int]:
    """`8x8x8` as (8, 8, 8)."""
    parts = text.lower().split("x")
    if len(parts) != 3 or not all(part.isascii() and part.isdigit() and len(part) < 5 for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of particles along x, y and z such as 8x8x8")
    nx, ny, nz = (int(part) for part in parts)
    if min(nx, ny, nz) < 2 or nx * ny * nz > LARGEST_BLOCK:
        raise argparse.ArgumentTypeError(f"{text!r}: a block has 2 particles or more each way, and {LARGEST_BLOCK} at most in all")
    return nx, ny, nz


def seconds(text: str) -> float:
    """A time above zero, at most a minute."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.01 <= value <= 60:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time from 0.01 to 60 seconds")
    return value


COMMAND = Command(
    name="melt",
    help="melt a block on a hot plate",
    description="A block of springs on a hot plate conducts, softens, melts and spreads; writes a report, pictures and an animation.",
    add_arguments=add_arguments,
    folder=out_folder,
    run=run,
)
