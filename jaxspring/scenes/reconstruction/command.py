"""The command `jaxspring fit`."""

from __future__ import annotations

import argparse
import pathlib
from typing import TYPE_CHECKING

from ..command import Command, UnusableError, Written, number, whole_number

if TYPE_CHECKING:
    from ...images.image import Image

LAW = ("k_min", "k_max", "sigma", "k_data", "drag")
# As SpringSettings and ConstantsSettings have them; a test compares. Repeated so that `--help` loads no JAX.
UPDATES_OF_STIFFNESS, UPDATES_OF_CONSTANTS = 700, 100
PARAMETERS = ("stiffness", "k_pixel", *LAW)
ENDINGS = ("obj", "ply", "geojson")
LARGEST_MESH = 4_000_000  # nodes: beyond, one rollout alone takes minutes


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `jaxspring fit` takes."""
    parser.add_argument(
        "image", nargs="?", metavar="IMAGE", help="PNG, JPEG, TIFF, .npy or .npz; the built-in elevation model unless given"
    )
    parser.add_argument("--nodes", type=nodes, default=(41, 41), metavar="NYxNX", help="nodes of the mesh along y and x (41x41)")
    parser.add_argument(
        "--parameters",
        type=parameters,
        default=("stiffness",),
        metavar="LIST",
        help=f"what is fitted: stiffness (one per spring, the default), k_pixel, or some of {','.join(LAW)}",
    )
    parser.add_argument(
        "--iterations",
        type=whole_number,
        metavar="N",
        help=f"updates ({UPDATES_OF_STIFFNESS} of the stiffness, {UPDATES_OF_CONSTANTS} of constants)",
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the results (jaxspring-<image>); an older result there is replaced")
    parser.add_argument("--fill", type=number, metavar="VALUE", help="what stands where a pixel is no-data, masked, NaN or transparent")
    parser.add_argument(
        "--holes", action="store_true", help="pixels that are no-data, masked, NaN or transparent are holes, which nothing is fitted to"
    )
    parser.add_argument(
        "--nodata", type=number, action="append", metavar="VALUE", help="pixels of this value are holes as well (repeatable)"
    )
    parser.add_argument("--page", type=whole_number, metavar="N", help="page of a TIFF, or frame of an animated PNG, from 0")
    parser.add_argument(
        "--break", dest="step", type=above_zero, metavar="STEP", help="break the surface along steps higher than this, in the image's unit"
    )
    parser.add_argument("--max-error", type=above_zero, metavar="E", help="split triangles until no pixel is off by more than this")
    parser.add_argument(
        "--export", type=endings, default=(), metavar="LIST", help=f"write the surface as a TIN: some of {','.join(ENDINGS)}"
    )
    parser.add_argument(
        "--resume", action="store_true", help="go on from the checkpoint of an interrupted or finished run with the same DIR"
    )


def folder(given: argparse.Namespace) -> pathlib.Path:
    """Where the results go: named by the image unless given."""
    stem = "elevation" if given.image is None else pathlib.Path(given.image).stem or "image"
    return pathlib.Path(given.out or f"jaxspring-{stem}")


def run(given: argparse.Namespace, out: pathlib.Path) -> Written:
    """Load the image, fit, write the folder; see `job.Job`.

    Raises:
        UnusableError: the image cannot be used.
    """
    from ...images.files import ImageError
    from .extras import Extras
    from .job import Job

    name = "elevation model of matplotlib" if given.image is None else str(pathlib.Path(given.image))
    usual = UPDATES_OF_STIFFNESS if given.parameters == ("stiffness",) else UPDATES_OF_CONSTANTS
    updates = usual if given.iterations is None else given.iterations
    try:
        extras = Extras(given.step, given.max_error, given.export)
        return Job(load(given), name, given.nodes, given.parameters, updates, out, extras).run(given.resume)
    except ImageError as error:
        raise UnusableError(str(error)) from error


def load(given: argparse.Namespace) -> Image:
    """The image that the arguments name, or the built-in one."""
    import numpy as np

    from ...images.channels import Luminance
    from ...images.files import elevation_model, image_from_array, load_image
    from ...images.holes import Holes

    holes = Holes(tuple(given.nodata or ()), nan=True) if given.holes or given.nodata else None
    if given.image is None:
        image = elevation_model()
        return image if holes is None else image_from_array(np.asarray(image.values), holes=holes)
    return load_image(pathlib.Path(given.image), channel=Luminance(), fill=given.fill, page=given.page, holes=holes)


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


def above_zero(text: str) -> float:
    """An argument that is a number above zero."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above zero")
    return value


def endings(text: str) -> tuple[str, ...]:
    """`obj,ply` as ("obj", "ply")."""
    names = tuple(part.strip().lower() for part in text.split(","))
    unknown = [name for name in names if name not in ENDINGS]
    if unknown:
        raise argparse.ArgumentTypeError(f"{', '.join(unknown) or 'nothing'} is not among {', '.join(ENDINGS)}")
    return tuple(dict.fromkeys(names))


COMMAND = Command(
    name="fit",
    help="fit a spring mesh to an image",
    description="Fit a spring mesh to an image by gradients through the simulation, and write a report, the mesh and pictures.",
    add_arguments=add_arguments,
    folder=folder,
    run=run,
)
