"""The command `jaxspring cloth`."""

from __future__ import annotations

import argparse
import pathlib
from typing import Any

from ..command import Command, UnusableError, Written, add_out, number, out_folder, settings_of

# The scenes of `scene.SCENES`, and the published fabrics; said again here, since nothing heavy is imported for `--help`.
NAMES = ("hanging", "ball", "table", "flag", "cantilever", "drape")
FABRICS = ("interlock", "denim", "swim-knit")
MOST_NODES = 20_000
# Options that a scene does not read.
UNREAD = {"flag": (), "drape": ("size", "wind"), **dict.fromkeys(("hanging", "ball", "table", "cantilever"), ("wind",))}
UNREAD_BY_FILES = ("size", "spacing", "wind")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What `jaxspring cloth` takes."""
    parser.add_argument(
        "scene", metavar="SCENE", nargs="?", default="hanging",
        help=f"one of {', '.join(NAMES)} (hanging), or a file of a flat mesh in the plane z = 0, in metres, which hangs from its largest y",
    )  # fmt: skip
    parser.add_argument(
        "--fabric", type=fabric, metavar="NAME", default="interlock",
        help=f"{', '.join(FABRICS)}, or numbers DENSITY,C11,C22,SHEAR,B in kg/m^2, N/m and N m (interlock)",
    )  # fmt: skip
    parser.add_argument("--size", type=number, metavar="M", help="side of the sheet in metres (0.5); not of drape or a file")
    parser.add_argument("--spacing", type=number, metavar="M", help="of the nodes in metres (0.02); not of a file")
    parser.add_argument("--duration", type=number, metavar="S", help="simulated time in seconds (2)")
    parser.add_argument("--dt", type=number, metavar="S", help="time step in seconds (0.01)")
    parser.add_argument("--wind", type=number, metavar="V", help="speed of the air in m/s, of the flag alone (6)")
    add_out(parser, "jaxspring-cloth")
    parser.add_argument("--resume", action="store_true", help="go on from the checkpoint of an interrupted run with the same DIR")


def run(given: argparse.Namespace, out: pathlib.Path) -> Written:
    """Run a scene and write the folder; see `job.cloth_job`.

    Raises:
        UnusableError: no such scene or file, a mesh that is not flat, settings that make no scene.
    """
    from ...progress import Progress
    from .job import cloth_job
    from .scene import SCENES, ClothSettings

    for name in UNREAD.get(given.scene, UNREAD_BY_FILES):
        if getattr(given, name) is not None:
            raise UnusableError(f"--{name} says nothing to {given.scene}: leave it out. A mesh has its own size, Cusick's disc as well.")
    given.material = _material(given.fabric)
    settings = settings_of(ClothSettings, given, ("material", "size", "spacing", "duration", "dt", "wind"))
    try:
        scene = SCENES[given.scene](_counted(settings)) if given.scene in SCENES else _of_file(given.scene, settings)
    except ValueError as error:
        raise UnusableError(str(error)) from error
    name = given.scene if given.scene in SCENES else pathlib.Path(given.scene).name
    return cloth_job(name, scene, out, Progress("cloth"), given.resume)


def fabric(text: str) -> str | tuple[float, ...]:
    """A name, or five numbers."""
    if text in FABRICS:
        return text
    parts = text.split(",")
    if len(parts) != 5:
        raise argparse.ArgumentTypeError(f"{text!r} is neither one of {', '.join(FABRICS)} nor five numbers such as 0.2,100,100,40,5e-5")
    return tuple(number(part) for part in parts)


def _material(given: str | tuple[float, ...]) -> Any:
    """The fabric of a name or of five numbers."""
    from ...cloth.materials import DENIM, INTERLOCK, SWIM_KNIT, Fabric

    if isinstance(given, str):
        return (INTERLOCK, DENIM, SWIM_KNIT)[FABRICS.index(given)]
    density, warp, weft, shear, bending = given
    try:
        return Fabric(density, (warp, weft), shear, bending)
    except ValueError as error:
        raise UnusableError(f"--fabric: {error}") from error


def _counted(settings: Any) -> Any:
    """The settings, unless they make more nodes than one waits for."""
    count = 1.2 * (settings.size / settings.spacing) ** 2
    if count > MOST_NODES:
        raise UnusableError(
            f"--size {settings.size:g} with --spacing {settings.spacing:g} makes about {count:.0f} nodes; {MOST_NODES} at most."
        )
    return settings


def _of_file(text: str, settings: Any) -> Any:
    """The scene of a mesh file."""
    import numpy as np

    from ...topology.mesh_files import from_mesh
    from .scene import with_mesh

    if text.isidentifier():
        raise UnusableError(f"there is no scene {text}: {', '.join(NAMES)}, or a file of a flat mesh.")
    try:
        net, points = from_mesh(text)
    except (OSError, ImportError) as error:
        raise UnusableError(str(error)) from error
    if net.triangles is None:
        raise UnusableError(f"{text} holds no faces, and a cloth is a surface.")
    return with_mesh(settings, net, np.asarray(points))


COMMAND = Command(
    name="cloth",
    help="hang, drape or blow a cloth of measured fabric",
    description="A sheet of a measured fabric: hung, laid over a ball or a table, a flag, or a test of a fabric laboratory. "
    "Writes a report, the mesh, frames for ParaView, pictures and an animation.",
    add_arguments=add_arguments,
    folder=out_folder,
    run=run,
)
