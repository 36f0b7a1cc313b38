"""What a lens cannot be: larger than its image.

Along x a focus of width b that is magnified m times shows m b wide, and the rest must still lie beside it: m b < width, and likewise
along y. For a disc of radius R in a sheet of half width 1 that is m R < 1. All of them together must leave some area to the context:

    sum over the foci of  m^2 area < area of the image

and a focus narrower than two cells is seen by too few springs to be magnified at all.

The radial ideal of a disc in a disc, to measure a lens by: outside of R the context is squeezed evenly in area, by c,

    r'^2 = m^2 R^2 + c (r^2 - R^2),   c = (1 - m^2 R^2) / (1 - R^2)          anisotropy at the rim  m^2 / c
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jaxtyping import Array

from ..._checks import is_concrete
from ...status import Flag, Status
from .foci import Focus, combined
from .mesh import LensMesh, at_cells


def largest(focus: Focus, shape: tuple[int, int]) -> Array:
    """The magnification that a focus cannot reach, since the image would hold nothing else along x or y; infinite where it has no edge."""
    extent = focus.extent()
    if extent is None:
        return jnp.full_like(focus.magnification, jnp.inf)
    width, height = _inside(extent, shape)
    room = jnp.minimum((shape[1] - 1) / width, (shape[0] - 1) / height)
    return room.astype(focus.magnification.dtype)


def narrowest(focus: Focus, mesh: LensMesh) -> Array:
    """Width of a focus in cells of the mesh, along the axis where it has fewest; infinite where it has no edge."""
    extent = focus.extent()
    if extent is None:
        return jnp.full_like(focus.magnification, jnp.inf)
    hx, hy = mesh.cell_size
    # A focus cut by the border is seen by its mirror image too.
    x0, y0, x1, y1 = extent
    return jnp.minimum((x1 - x0) / hx, (y1 - y0) / hy)


def filled(foci: tuple[Focus, ...], mesh: LensMesh) -> Array:
    """Part of the image's area that is shown magnified; the rest is left to the context. Shrunk foci ask for no room."""
    log_wanted, share = combined(foci, mesh.x, mesh.y)
    area = jnp.where((share > 0.5) & (log_wanted > 0), jnp.exp(2 * log_wanted), jnp.zeros_like(share))
    return jnp.mean(at_cells(area))


def check_feasible(foci: tuple[Focus, ...], mesh: LensMesh, shape: tuple[int, int]) -> None:
    """Raise ValueError, naming the focus and the largest magnification, where known foci are not feasible."""
    for i, focus in enumerate(foci):
        extent = focus.extent()
        if extent is None or not all(is_concrete(a) for a in (*extent, focus.magnification)):
            continue
        width, height = _inside(extent, shape)
        if not (float(width) > 0 and float(height) > 0):
            raise ValueError(
                f"foci[{i}] lies outside the image, whose pixels run from 0 to {shape[1] - 1} along x and 0 to {shape[0] - 1} along y."
            )
        cells = float(narrowest(focus, mesh))
        if cells < 2:
            raise ValueError(
                f"foci[{i}] is {cells:.2g} cells of the mesh wide: too few springs see it. Make it {2 / cells:.3g} times larger, or pass "
                f"nodes={int((max(mesh.net.node_shape) - 1) * 2 / cells) + 2} or more to the lens."
            )
        most, m = float(largest(focus, shape)), float(focus.magnification)
        if m >= most:
            raise ValueError(
                f"foci[{i}].magnification = {m:.4g}, but magnified {most:.4g} times the focus would be as large as the image and leave no "
                f"room beside it. The largest feasible value is below {most:.4g}; lower it, or make the focus smaller."
            )
    part = filled(foci, mesh)
    if is_concrete(part) and float(part) >= 1:
        raise ValueError(
            f"The foci, magnified, would fill {float(part):.3g} times the area of the image. The largest feasible values are "
            f"{float(part) ** -0.5:.3g} times these; lower the magnifications, or make the foci smaller."
        )


def feasibility(foci: tuple[Focus, ...], mesh: LensMesh, shape: tuple[int, int]) -> Status:
    """INVALID where foci are not feasible, for those that are traced."""
    is_wrong = filled(foci, mesh) >= 1
    for focus in foci:
        is_wrong |= ~(focus.magnification < largest(focus, shape)) | ~(narrowest(focus, mesh) >= 2)
    return Status.when(Flag.INVALID, is_wrong)


def ideal_anisotropy(magnification: float, radius: float) -> float:
    """Anisotropy at the rim of the radial ideal, for a radius over that of the sheet; infinite where the ideal is not feasible."""
    left = 1 - (magnification * radius) ** 2
    return magnification**2 * (1 - radius**2) / left if left > 0 else math.inf


def _inside(extent: tuple[Array, Array, Array, Array], shape: tuple[int, int]) -> tuple[Array, Array]:
    """Width and height of what lies on the image [pixels]; not positive where nothing does."""
    x0, y0, x1, y1 = extent
    return (
        jnp.minimum(x1, shape[1] - 1) - jnp.maximum(x0, 0),
        jnp.minimum(y1, shape[0] - 1) - jnp.maximum(y0, 0),
    )


__all__ = ["check_feasible", "feasibility", "filled", "ideal_anisotropy", "largest", "narrowest"]
