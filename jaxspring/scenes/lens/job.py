"""A lens from an image to a folder: calibrate, certify, measure, and write report, mesh and pictures."""

from __future__ import annotations

import pathlib
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...archive import write_archive
from ...images.channels import Channel, Luminance
from ...images.files import ImageError, elevation_model, load_image
from ...images.image import Image
from ...progress import Progress, Stopwatch
from ..command import FailedError, Written
from ..drawing import canvas_and_figure
from ..folder import ResultFolder, versions
from .feasible import check_feasible, ideal_anisotropy, largest
from .foci import Disc, Focus, ramped
from .pictures import draw_animation, draw_magnification, draw_mesh, eight_bits, save_pixels
from .scene import Lens
from .warp import Warp

# Pictures of the ramp, the image as it is included.
N_STEPS = 12


def load(image: str | None, mask: str | None, fill: float | None) -> tuple[np.ndarray, Image | None]:
    """The image's channels (1 or 3, ny, nx) in its own unit, and the mask.

    Raises:
        ImageError: a file that cannot be used, or a mask of another size.
    """
    if image is None:
        channels = np.asarray(elevation_model().values)[None]
    else:
        channels = _channels(pathlib.Path(image), fill)
    painted = None if mask is None else load_image(pathlib.Path(mask), channel=Luminance(), fill=0.0)
    if painted is not None and painted.shape != channels.shape[1:]:
        sizes = ["{} x {}".format(*shape) for shape in (painted.shape, channels.shape[1:])]
        raise ImageError(f"{mask}: {sizes[0]} pixels for an image of {sizes[1]}; paint a mask as large as the image.")
    return channels, painted


def lens_job(
    name: str, channels: np.ndarray, foci: tuple[Focus, ...], nodes: int, out: pathlib.Path, progress: Progress | None = None
) -> Written:
    """Make the lens in a ramp, measure it and write the folder.

    Raises:
        ValueError: a mesh or foci that the image cannot have; the message says what is feasible.
        ImportError: what draws the pictures is not installed.
        FailedError: the solver failed, or the folder could not be written.
    """
    canvas_and_figure()
    clock = Stopwatch()
    lens = Lens((channels.shape[1], channels.shape[2]), nodes)
    pixels = jnp.asarray(channels, jnp.result_type(float))
    check_feasible(foci, lens.mesh, lens.shape)  # traced foci could only say it by status

    @eqx.filter_jit
    def shown(part: jax.Array) -> tuple[Warp, jax.Array]:
        warp = lens.warp(ramped(foci, part))
        return warp, warp.apply(pixels)

    warp, after = shown(jnp.zeros((), pixels.dtype))
    frames, ramp = [np.asarray(after)], [_step(0.0, warp)]
    for step in range(1, N_STEPS + 1):
        warp, after = shown(jnp.asarray(step / N_STEPS, pixels.dtype))
        if not bool(warp.status.is_ok):
            raise FailedError(f"the lens failed: {warp.status.describe()}.")
        frames.append(np.asarray(after))
        ramp.append(_step(step / N_STEPS, warp))
        if progress is not None:
            progress.update(step, N_STEPS)
    report = report_of(name, lens, foci, warp, ramp, clock.seconds)
    with ResultFolder(out).filling(report) as folder:
        _fill(folder, channels, frames, warp)
    return Written(table(report), "report.json, warp.npz, four pictures and lens.gif")


def report_of(name: str, lens: Lens, foci: tuple[Focus, ...], warp: Warp, ramp: list[dict[str, Any]], seconds: float) -> dict[str, Any]:
    """Everything `report.json` holds."""
    certificate, anisotropy = warp.certificate(), np.asarray(warp.anisotropy)
    of_foci = zip(foci, np.asarray(warp.requested), np.asarray(warp.delivered), strict=True)
    return {
        "image": {"name": name, "pixels": list(lens.shape)},
        "settings": {"nodes": list(lens.mesh.net.node_shape), "passes": lens.n_passes},
        "versions": versions(),
        "foci": [_focus(lens, focus, float(wanted), float(got)) for focus, wanted, got in of_foci],
        "folds": int(certificate.n_folds),
        "least_area": float(certificate.least_area),
        "one_to_one": bool(certificate.is_one_to_one),
        "anisotropy": {"largest": float(anisotropy.max()), "median": float(np.median(anisotropy))},
        "inverse_error_pixels": inverse_error(warp),
        "ramp": ramp,
        "seconds": seconds,
    }


def inverse_error(warp: Warp) -> float:
    """The largest distance of inverse(forward(p)) from p, over all pixels [pixels]."""
    ny, nx = warp.shape
    dtype = warp.position.dtype
    x, y = jnp.meshgrid(jnp.arange(nx, dtype=dtype), jnp.arange(ny, dtype=dtype))
    back = warp.inverse(*warp.forward(x, y))
    return float(jnp.max(jnp.hypot(back[0] - x, back[1] - y)))


def table(report: dict[str, Any]) -> str:
    """What was measured, for the terminal."""
    lines = [f"{focus['kind']}: {focus['wanted']:.3f} times wanted, {focus['delivered']:.3f} delivered" for focus in report["foci"]]
    sure = "one-to-one" if report["one_to_one"] else "NOT one-to-one"
    lines.append(
        f"{sure}: {report['folds']} folds, least area {report['least_area']:.3g}, largest anisotropy {report['anisotropy']['largest']:.3g}"
    )
    lines.append(f"inverse of forward within {report['inverse_error_pixels']:.2g} pixels; {report['seconds']:.1f} s in all")
    return "\n".join(lines)


def _channels(path: pathlib.Path, fill: float | None) -> np.ndarray:
    """Red, green and blue; one channel where they are the same, or where there are not three."""
    grey = np.asarray(load_image(path, channel=Luminance(), fill=fill).values)
    try:
        colours = [np.asarray(load_image(path, channel=Channel(i), fill=fill).values) for i in range(3)]
    except ImageError:
        return grey[None]
    is_grey = all(np.array_equal(colours[0], other) for other in colours[1:])
    return grey[None] if is_grey else np.stack(colours)


def _step(part: float, warp: Warp) -> dict[str, Any]:
    certificate = warp.certificate()
    return {
        "part": part,
        "delivered": np.asarray(warp.delivered, float).tolist(),
        "folds": int(certificate.n_folds),
        "least_area": float(certificate.least_area),
    }


def _focus(lens: Lens, focus: Focus, wanted: float, delivered: float) -> dict[str, Any]:
    found: dict[str, Any] = {"kind": type(focus).__name__.lower(), "wanted": wanted, "delivered": delivered}
    limit = float(largest(focus, lens.shape))
    found["below"] = limit if np.isfinite(limit) else None
    if isinstance(focus, Disc):
        half = 0.5 * (min(lens.shape) - 1)
        ideal = ideal_anisotropy(float(focus.magnification), float(focus.radius) / half)
        found |= {"centre": np.asarray(focus.centre, float).tolist(), "radius": float(focus.radius)}
        found["anisotropy_of_radial_ideal"] = ideal if np.isfinite(ideal) else None
    return found


def _fill(folder: pathlib.Path, channels: np.ndarray, frames: list[np.ndarray], warp: Warp) -> None:
    before, *_, after = scaled = [eight_bits(frame, channels) for frame in (channels, *frames)]
    save_pixels(folder / "before.png", before)
    save_pixels(folder / "after.png", after)
    draw_mesh(folder / "mesh.png", before, after, warp)
    draw_magnification(folder / "magnification.png", warp)
    draw_animation(folder / "lens.gif", scaled[1:])
    x, y = (np.asarray(a, float) for a in warp.position)
    arrays = {"x": np.asarray(warp.mesh.x, float), "y": np.asarray(warp.mesh.y, float), "shown_x": x, "shown_y": y}
    write_archive(folder / "warp.npz", {**arrays, "magnification": np.asarray(warp.magnification, float)}, {"kind": "warp"})


__all__ = ["inverse_error", "lens_job", "load", "report_of", "table"]
