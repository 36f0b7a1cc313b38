"""The command `jaxspring`: fit a spring mesh to an image, or melt a block, without writing a program.

Exit codes: 0 done; 1 the fit failed; 2 the arguments or the image cannot be used; 130 interrupted. Trouble is one line on the error stream.
Everything heavy is imported after the arguments are understood, so that `--help` and mistakes answer at once.
"""

from __future__ import annotations

import argparse
import math
import os
import pathlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

from ._version import __version__

DONE, FAILED, UNUSABLE, INTERRUPTED = 0, 1, 2, 130
LAW = ("k_min", "k_max", "sigma", "k_data", "drag")
# As SpringSettings and ConstantsSettings have them; a test compares. Repeated so that `--help` loads no JAX.
UPDATES_OF_STIFFNESS, UPDATES_OF_CONSTANTS = 700, 100
PARAMETERS = ("stiffness", "k_pixel", *LAW)
LARGEST_BLOCK = 4_096  # particles: every pair of them is looked at in every step
LARGEST_MESH = 4_000_000  # nodes: beyond, one rollout alone takes minutes


@dataclass(frozen=True)
class Arguments:
    """What `jaxspring fit` was asked to do.

    Attributes:
        image: file, or None for the elevation model that ships with matplotlib.
        nodes: nodes along y and x.
        parameters: what is fitted.
        iterations: updates of the parameters.
        out: folder for the results.
        resume: go on from a checkpoint.
        fill: what stands where a pixel has no value, or None.
        page: of a file with several, or None.
    """

    image: pathlib.Path | None
    nodes: tuple[int, int]
    parameters: tuple[str, ...]
    iterations: int
    out: pathlib.Path
    resume: bool
    fill: float | None = None
    page: int | None = None


@dataclass(frozen=True)
class MeltArguments:
    """What `jaxspring melt` was asked to do.

    Attributes:
        nodes: along x, y and z, or None for the scene's own.
        duration: [s], or None for the scene's own.
        out: folder for the results.
        resume: go on from a checkpoint.
    """

    nodes: tuple[int, int, int] | None
    duration: float | None
    out: pathlib.Path
    resume: bool = False


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (those of the process unless given); returns its exit code."""
    try:
        arguments = parse(sys.argv[1:] if argv is None else argv)
    except SystemExit as ended:  # argparse: --help and --version with 0, a mistake with 2
        return int(ended.code or 0)
    try:
        return melt(arguments) if isinstance(arguments, MeltArguments) else run(arguments)
    except KeyboardInterrupt:
        return complain("interrupted; no results were written.", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED


def parse(argv: Sequence[str]) -> Arguments | MeltArguments:
    """Arguments as typed, checked. Ends the process with code 2 and one line where they make no sense."""
    given = _parser().parse_args(argv)
    if given.command == "melt":
        return MeltArguments(given.nodes, given.duration, pathlib.Path(given.out), given.resume)
    image = None if given.image is None else pathlib.Path(given.image)
    out = pathlib.Path(given.out or f"jaxspring-{'elevation' if image is None else image.stem or 'image'}")
    usual = UPDATES_OF_STIFFNESS if given.parameters == ("stiffness",) else UPDATES_OF_CONSTANTS
    updates = usual if given.iterations is None else given.iterations
    return Arguments(image, given.nodes, given.parameters, updates, out, given.resume, given.fill, given.page)


def run(arguments: Arguments) -> int:
    """Load the image, fit, write the folder; returns the exit code."""
    try:
        check_folder(arguments.out)
    except OSError as error:
        return complain(str(error), UNUSABLE)
    from .archive import CheckpointError
    from .images.files import ImageError
    from .scenes.job import Job

    try:
        name = "elevation model of matplotlib" if arguments.image is None else str(arguments.image)
        job = Job(_load(arguments), name, arguments.nodes, arguments.parameters, arguments.iterations, arguments.out)
        outcome = job.run(arguments.resume)
    except (ImageError, CheckpointError, OSError, ImportError, MemoryError) as error:
        return complain(str(error) or "there is not enough memory.", UNUSABLE)
    if outcome.is_interrupted:
        return complain(f"interrupted after {outcome.iterations} iterations; the same command with --resume goes on.", INTERRUPTED)
    if outcome.failure:
        return complain(outcome.failure, FAILED)
    print(outcome.table)
    print(f"Written to {arguments.out}{os.sep}: report.json, mesh.npz and {len(outcome.pictures)} pictures.")
    return DONE


def melt(arguments: MeltArguments) -> int:
    """Melt a block and write the folder; returns the exit code."""
    try:
        check_folder(arguments.out)
    except OSError as error:
        return complain(str(error), UNUSABLE)
    from .archive import CheckpointError
    from .progress import Progress
    from .scenes.melting.job import melt as melted
    from .scenes.melting.scene import MeltSettings

    given = {"nodes": arguments.nodes, "duration": arguments.duration}
    try:
        settings = MeltSettings(**{name: value for name, value in given.items() if value is not None})
    except ValueError as error:
        return complain(str(error), UNUSABLE)
    try:
        outcome = melted(settings, arguments.out, Progress("melt"), arguments.resume)
    except (CheckpointError, OSError, ImportError, MemoryError) as error:
        return complain(str(error) or "there is not enough memory.", UNUSABLE)
    if outcome.is_interrupted:
        return complain(f"interrupted after {outcome.frames} frames; the same command with --resume goes on.", INTERRUPTED)
    if outcome.failure:
        return complain(outcome.failure, FAILED)
    print(outcome.table)
    print(f"Written to {arguments.out}{os.sep}: report.json, strip.png and melting.gif.")
    return DONE


def check_folder(out: pathlib.Path) -> None:
    """OSError where results could not be written, before anything is computed: the work of minutes would be lost."""
    parent = out.absolute().parent
    if not parent.is_dir():
        raise FileNotFoundError(f"--out {out}: the folder {parent} does not exist; make it first.")
    if not os.access(parent, os.W_OK):
        raise PermissionError(f"--out {out}: the folder {parent} cannot be written; choose another with --out.")
    if out.exists() and not out.is_dir():
        raise FileExistsError(f"--out {out}: this is a file; choose a folder with --out.")
    if out.is_dir() and any(out.iterdir()) and not (out / "report.json").is_file():
        raise FileExistsError(f"--out {out}: the folder holds other files, which would be lost; choose another with --out.")


def complain(problem: str, code: int) -> int:
    """One line on the error stream; returns the exit code."""
    print("jaxspring: " + " ".join(problem.split()), file=sys.stderr)
    return code


def _load(arguments: Arguments):
    from .images.files import Luminance, elevation_model, load_image

    if arguments.image is None:
        return elevation_model()
    return load_image(arguments.image, channel=Luminance(), fill=arguments.fill, page=arguments.page)


class _Parser(argparse.ArgumentParser):
    """Mistakes in one line, without the usage text around it."""

    def error(self, message: str) -> NoReturn:
        self.exit(UNUSABLE, f"{self.prog}: {message} (see {self.prog} --help)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxspring", description="Differentiable mass-spring systems.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"jaxspring {__version__}")
    commands = parser.add_subparsers(title="commands", dest="command", required=True, parser_class=_Parser)
    fit = commands.add_parser(
        "fit",
        help="fit a spring mesh to an image",
        description="Fit a spring mesh to an image by gradients through the simulation, and write a report, the mesh and pictures.",
        allow_abbrev=False,
    )
    fit.add_argument("image", nargs="?", metavar="IMAGE", help="PNG, JPEG, TIFF, .npy or .npz; the built-in elevation model unless given")
    fit.add_argument("--nodes", type=nodes, default=(41, 41), metavar="NYxNX", help="nodes of the mesh along y and x (41x41)")
    fit.add_argument(
        "--parameters",
        type=parameters,
        default=("stiffness",),
        metavar="LIST",
        help=f"what is fitted: stiffness (one per spring, the default), k_pixel, or some of {','.join(LAW)}",
    )
    fit.add_argument(
        "--iterations",
        type=iterations,
        metavar="N",
        help=f"updates ({UPDATES_OF_STIFFNESS} of the stiffness, {UPDATES_OF_CONSTANTS} of constants)",
    )
    fit.add_argument("--out", metavar="DIR", help="folder for the results (jaxspring-<image>); an older result there is replaced")
    fit.add_argument("--fill", type=number, metavar="VALUE", help="what stands where a pixel is no-data, masked, NaN or transparent")
    fit.add_argument("--page", type=iterations, metavar="N", help="page of a TIFF, or frame of an animated PNG, from 0")
    fit.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted or finished run with the same DIR")
    _add_melt(commands)
    return parser


def _add_melt(commands: argparse._SubParsersAction) -> None:
    melting = commands.add_parser(
        "melt",
        help="melt a block on a hot plate",
        description="A block of springs on a hot plate conducts, softens, melts and spreads; writes a report, pictures and an animation.",
        allow_abbrev=False,
    )
    melting.add_argument("--nodes", type=block, metavar="NXxNYxNZ", help="particles of the block along x, y and z")
    melting.add_argument("--duration", type=seconds, metavar="S", help="simulated time in seconds")
    melting.add_argument("--out", metavar="DIR", default="jaxspring-melt", help="folder for the results; an older result there is replaced")
    melting.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted run with the same DIR")


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


def number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def nodes(text: str) -> tuple[int, int]:
    """`41x41` as (41, 41)."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of rows and columns such as 41x41")
    ny, nx = int(parts[0]), int(parts[1])
    if min(ny, nx) < 3:
        raise argparse.ArgumentTypeError(f"{text!r}: a mesh needs at least 3x3 nodes")
    if ny * nx > LARGEST_MESH:
        raise argparse.ArgumentTypeError(f"{text!r}: more than {LARGEST_MESH} nodes")
    return ny, nx


def parameters(text: str) -> tuple[str, ...]:
    """`k_min,k_max` as ("k_min", "k_max")."""
    names = tuple(part.strip() for part in text.split(","))
    unknown = [name for name in names if name not in PARAMETERS]
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(unknown) or 'nothing'} is not among {', '.join(PARAMETERS)}")
    if len(set(names)) != len(names):
        raise argparse.ArgumentTypeError(f"{text!r} names something twice")
    if len(names) > 1 and not set(names) <= set(LAW):
        raise argparse.ArgumentTypeError(f"{text!r}: stiffness and k_pixel are fitted alone; only {', '.join(LAW)} go together")
    return names


def iterations(text: str) -> int:
    """A whole number, zero or more."""
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, zero or more")
    return int(text)
