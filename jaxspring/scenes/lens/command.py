"""The command `jaxspring lens`."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from ..command import Command, UnusableError, Written, add_out, number, out_folder, whole_number

MOST_NODES = 257


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `jaxspring lens` takes."""
    parser.add_argument(
        "image", nargs="?", metavar="IMAGE", help="PNG, JPEG, TIFF, .npy or .npz; the built-in elevation model unless given"
    )
    parser.add_argument(
        "--at", type=place, metavar="X,Y", action="append", help="centre of a lens, column and row in pixels; may be repeated"
    )
    parser.add_argument(
        "--radius", type=number, metavar="R", action="append", help="of a lens in pixels: one for all, or one for each --at"
    )
    parser.add_argument(
        "--magnify", type=number, metavar="M", action="append", help="how many times: one for all, or one for each --at (2)"
    )
    parser.add_argument("--rim", type=number, metavar="W", help="width of the rim in pixels (0.4 radius)")
    parser.add_argument(
        "--importance", metavar="MASK", help="an image as large as IMAGE: what is bright there is magnified, by the last --magnify"
    )
    parser.add_argument("--nodes", type=whole_number, metavar="N", default=33, help="nodes of the mesh along the longer side (33)")
    parser.add_argument("--fill", type=number, metavar="VALUE", help="what stands where a pixel is no-data, masked, NaN or transparent")
    add_out(parser, "jaxspring-lens")


def run(given: argparse.Namespace, out: pathlib.Path) -> Written:
    """Load the image, make the lens, write the folder; see `job.lens_job`.

    Raises:
        UnusableError: the image or the mask cannot be used, the arguments make no lens, or one that is not feasible.
    """
    from ...images.files import ImageError
    from ...progress import Progress
    from .job import lens_job, load

    at, radii, factors = given.at or [], given.radius or [], given.magnify or [2.0]
    if not at and given.importance is None:
        raise UnusableError("nothing to magnify: give --at X,Y with --radius R, or --importance MASK.")
    if given.nodes > MOST_NODES:
        raise UnusableError(f"--nodes {given.nodes}: more than {MOST_NODES}.")
    name = "elevation model of matplotlib" if given.image is None else str(pathlib.Path(given.image))
    try:
        channels, mask = load(given.image, given.importance, given.fill)
        foci = _foci(at, _each("--radius", radii, len(at)), _each("--magnify", factors, len(at)), given.rim)
        foci += [_importance(mask, factors[-1])] if mask is not None else []
        return lens_job(name, channels, tuple(foci), given.nodes, out, Progress("lens"))
    except (ImageError, ValueError) as error:
        raise UnusableError(str(error)) from error


def place(text: str) -> tuple[float, float]:
    """`120,80` as (120.0, 80.0)."""
    parts = text.split(",")
    if len(parts) != 2:
        raise argparse.ArgumentTypeError(f"{text!r} is not a column and a row such as 120,80")
    x, y = (number(part) for part in parts)
    return x, y


def _each(option: str, values: list[float], count: int) -> list[float]:
    """One value for each place."""
    if not count or len(values) == count:
        return values[:count]
    if len(values) != 1:
        raise UnusableError(f"{option} was given {len(values)} times for {count} of --at: give it once for all, or once for each.")
    return values * count


def _foci(at: list[tuple[float, float]], radii: list[float], factors: list[float], rim: float | None) -> list[Any]:
    """The discs."""
    from .foci import Disc

    return [Disc(centre, radius, factor, rim) for centre, radius, factor in zip(at, radii, factors, strict=True)]


def _importance(mask: Any, factor: float) -> Any:
    from .foci import Importance

    return Importance(mask.normalised(), factor)


COMMAND = Command(
    name="lens",
    help="magnify parts of an image by a lens of springs",
    description="Magnify discs or whatever a mask paints, squeeze the rest, and fold nothing. "
    "Writes the image before and after, the mesh, a map of the achieved magnification, an animation, and a report.",
    add_arguments=add_arguments,
    folder=out_folder,
    run=run,
)
