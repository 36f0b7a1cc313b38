"""What a lens does to an image: the mesh, both maps, the image warped and brought back, and the measures of it.

    J = d shown / d image, constant in each triangle        magnification sqrt(det J)        anisotropy s_1 / s_2 of its singular values

The certificate: in a triangle det J is its signed area over that of the regular grid, so one sign per triangle is all there is to test;
with a border whose nodes keep their order along each side, the whole map is one-to-one.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._arrays import Numbers
from ..._checks import as_inexact
from ...forces.springs import Springs
from ...images.image import Image, without_holes
from ...images.sampling import Sampling
from ...images.surface import Surface
from ...status import Status
from ...system import System
from ...topology.edge_field import EdgeField
from ...vector import Vector
from ..reconstruction.triangles import doubled_areas
from .mesh import LensMesh, at_cells
from .search import Affine, search, triangle_at, turned

Picture = TypeVar("Picture", Image, Array)
# Stiffness of a spring of the foci over its tension per length, in `Warp.system`: it rests at 0.9 of its length.
FIRMNESS = 9.0
# The search for the triangles of all pixels starts with one pixel in so many along each axis.
COARSE = 4


class Certificate(NamedTuple):
    """Whether a map is one-to-one.

    Attributes:
        n_folds: triangles that are folded over or have no area.
        least_area: the least signed area of a triangle over that of the regular grid.
        is_border_kept: whether the border covers the image's border in order.
    """

    n_folds: Int[Array, ""]
    least_area: Float[Array, ""]
    is_border_kept: Array

    @property
    def is_one_to_one(self) -> Array:
        """No fold, and a border in order."""
        return (self.n_folds == 0) & self.is_border_kept


class Warp(eqx.Module):
    """A map of the image onto itself, one-to-one and affine on triangles, made by `Lens.warp`.

    Attributes:
        shape: (rows, columns) of the image (static).
        sampling: how images are read between pixels.
        mesh: the regular grid.
        position: (x, y) of the nodes where they are shown, two arrays (ny, nx) [pixels].
        stiffness: tension per length w of every spring, zero where there is none [N/m].
        log_wanted: (ny, nx) ln M of all foci.
        share: (ny, nx) how much the foci have to say.
        shares: the same of each focus by itself.
        status: INVALID where traced foci are not feasible; what the solver said.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    sampling: Sampling
    mesh: LensMesh
    position: Vector
    stiffness: EdgeField
    log_wanted: Array
    share: Array
    shares: tuple[Array, ...]
    status: Status

    def forward(self, x: Numbers, y: Numbers) -> tuple[Array, Array]:
        """Where the points (x, y) of the image are shown, two arrays of any one shape [pixels]; beyond the border as triangles go on."""
        x, y = as_inexact("x", x), as_inexact("y", y)
        hx, hy = self.mesh.cell_size
        flat_x, flat_y = jnp.ravel(x), jnp.ravel(y)
        triangle = triangle_at(flat_x / hx, flat_y / hy, self.mesh.cells)
        shown = Affine.between(self.mesh.x, self.mesh.y, self.position.x, self.position.y)(flat_x, flat_y, triangle)
        return shown[0].reshape(x.shape), shown[1].reshape(x.shape)

    def inverse(self, x: Numbers, y: Numbers) -> tuple[Array, Array]:
        """Which points of the image are shown at (x, y), two arrays of any one shape [pixels]: the exact inverse of `forward`."""
        x, y = as_inexact("x", x), as_inexact("y", y)
        flat_x, flat_y = jnp.ravel(x), jnp.ravel(y)
        back = Affine.between(self.position.x, self.position.y, self.mesh.x, self.mesh.y)
        found = search(back, flat_x, flat_y, self.mesh.cells, self.mesh.cell_size)
        u, v = back(flat_x, flat_y, found.triangle)
        return u.reshape(x.shape), v.reshape(x.shape)

    def apply(self, image: Picture) -> Picture:
        """The image as the lens shows it: at each pixel the value from where that pixel comes.

        Args:
            image: a `js.Image`, or pixels (..., ny, nx) of one image or several; whole numbers are rounded to such.

        Raises:
            ValueError: an image of another shape, or with weights.
        """
        return self._sampled(image, *self._inverse_of_pixels())

    def undo(self, image: Picture) -> Picture:
        """The image that the lens shows as `image`: what `apply` did is undone, up to what sampling has lost."""
        return self._sampled(image, *self.forward(*self._pixels()))

    def certificate(self) -> Certificate:
        """Whether the map is one-to-one."""
        area = self._areas()
        x, y = self.position
        along = [jnp.diff(a) > 0 for a in (x[0], x[-1], y[:, 0], y[:, -1])]
        (ny, nx), right, bottom = self.mesh.net.node_shape, self.shape[1] - 1, self.shape[0] - 1
        kept = [jnp.all(x[:, 0] == 0), jnp.all(x[:, nx - 1] == right), jnp.all(y[0] == 0), jnp.all(y[ny - 1] == bottom)]
        is_kept = jnp.all(jnp.stack([*(jnp.all(a) for a in along), *kept]))
        return Certificate(jnp.sum(~(area > 0), dtype=jnp.int32), jnp.min(area), is_kept)

    @property
    def magnification(self) -> Float[Array, "my mx"]:
        """Linear magnification of every cell, the square root of its area over that of the regular grid; NaN where it is folded."""
        return jnp.sqrt(jnp.mean(self._areas(), axis=0))

    @property
    def wanted(self) -> Float[Array, "my mx"]:
        """The magnification M that the foci want of every cell: 1 in the context, which cannot have it."""
        return jnp.exp(at_cells(self.log_wanted))

    @property
    def anisotropy(self) -> Float[Array, "2 my mx"]:
        """The larger stretch over the smaller in every triangle: 1 where shapes are kept."""
        rows = Affine.between(self.mesh.x, self.mesh.y, self.position.x, self.position.y).rows
        a, b, c, d = (rows[:, i] for i in range(4, 8))
        # Singular values of a 2 x 2 matrix: half the sum and difference of the moduli of its two complex parts.
        turn = jnp.sqrt((a + d) ** 2 + (c - b) ** 2)
        shear = jnp.sqrt((a - d) ** 2 + (b + c) ** 2)
        return ((turn + shear) / jnp.abs(turn - shear)).reshape(2, *self.mesh.cells)

    @property
    def delivered(self) -> Float[Array, " L"]:
        """What each focus was magnified: the geometric mean over its cells, weighted to those that are wholly in it."""
        return jnp.stack([self._mean_over(share, jnp.log(self.magnification)) for share in self.shares])

    @property
    def requested(self) -> Float[Array, " L"]:
        """What each focus asked for, with what others ask for where they overlap, by the same mean."""
        return jnp.stack([self._mean_over(share, at_cells(self.log_wanted)) for share in self.shares])

    def system(self, firmness: float = FIRMNESS) -> System:
        """The net as springs with rest lengths, whose equilibrium is this mesh: to run, to load, to look at.

        In the context springs rest at zero, with stiffness k = w. In the foci they have k = w (1 + firmness), and so their rest length

            l = r (1 - w / k) = r firmness / (1 + firmness)        [pixels]

        is what calibration found: nearly M times the undeformed length. Across the rim, in proportion to the share. Nodes weigh as much as
        their springs are stiff; borders slide.

        Args:
            firmness: above 0; the larger, the stiffer the foci.

        Raises:
            ValueError: a firmness that is not positive.
        """
        if not firmness > 0:
            raise ValueError(f"firmness = {firmness}, but must be positive: without it the foci would have no rest length.")
        net = self.mesh.net
        extra = net.average(self.share) * firmness
        stiffness = self.stiffness.map(lambda w, f: w * (1 + f), extra)
        length = net.difference(self.position).map(lambda d: jnp.sqrt(d.dot(d)))
        rest = length.map(lambda r, f: r * f / (1 + f), extra)
        free = jnp.stack([jnp.ravel(a) for a in self.mesh.is_free], axis=-1)
        springs = Springs(net, net.flatten(stiffness), net.flatten(rest))
        return System(net, net.incident_sum(stiffness), springs, free=free)

    def _pixels(self) -> tuple[Array, Array]:
        """(x, y) of all pixels, two arrays of the image's shape."""
        ny, nx = self.shape
        dtype = self.position.dtype
        x, y = jnp.arange(nx, dtype=dtype), jnp.arange(ny, dtype=dtype)
        return jnp.broadcast_to(x[None, :], self.shape), jnp.broadcast_to(y[:, None], self.shape)

    def _inverse_of_pixels(self) -> tuple[Array, Array]:
        """`inverse` at all pixels, whose search starts from that of every fourth along each axis."""
        x, y = self._pixels()
        back, cells, size = Affine.between(self.position.x, self.position.y, self.mesh.x, self.mesh.y), self.mesh.cells, self.mesh.cell_size
        few = [jnp.ravel(a[COARSE // 2 :: COARSE, COARSE // 2 :: COARSE]) for a in (x, y)]
        rough = search(back, few[0], few[1], cells, size).triangle.reshape([len(range(COARSE // 2, n, COARSE)) for n in self.shape])
        near = jnp.repeat(jnp.repeat(rough, COARSE, axis=0), COARSE, axis=1)
        near = jnp.pad(near, [(0, max(n - m, 0)) for n, m in zip(self.shape, near.shape, strict=True)], mode="edge")
        start = jnp.ravel(near[: self.shape[0], : self.shape[1]])
        triangle = search(back, jnp.ravel(x), jnp.ravel(y), cells, size, start).triangle
        u, v = back(jnp.ravel(x), jnp.ravel(y), triangle)
        return u.reshape(self.shape), v.reshape(self.shape)

    def _sampled(self, image: Picture, x: Array, y: Array) -> Picture:
        """The image read at (x, y) of every pixel."""
        if isinstance(image, Image):
            self._check_shape(image.shape)
            image = without_holes("image", image, "what a lens shows lies elsewhere than its weights.")
            return image.with_values(self._read(image.values, x, y))
        self._check_shape(image.shape[-2:])
        stack = image.reshape(-1, *self.shape)
        read = self._read(stack[0], x, y)[None] if len(stack) == 1 else jax.vmap(lambda one: self._read(one, x, y))(stack)
        return read.reshape(image.shape)

    def _read(self, values: Array, x: Array, y: Array) -> Array:
        if not jnp.issubdtype(values.dtype, jnp.inexact):
            # To the nearest grey level, within their range: cut off, every picture would become darker.
            low, high = (0, 1) if values.dtype == bool else (jnp.iinfo(values.dtype).min, jnp.iinfo(values.dtype).max)
            return jnp.clip(jnp.rint(self._read(values.astype(x.dtype), x, y)), low, high).astype(values.dtype)
        one, zero = jnp.ones((), x.dtype), jnp.zeros((), x.dtype)
        surface = Surface(self.sampling.coefficients(values), (one, one), (zero, zero), self.shape, self.sampling)
        return surface.value(x, y).astype(values.dtype)

    def _check_shape(self, shape: tuple[int, ...]) -> None:
        if tuple(shape) != self.shape:
            raise ValueError(f"image has {tuple(shape)} pixels, but the lens was made for {self.shape}: make a lens of that shape.")

    def _areas(self) -> Float[Array, "2 my mx"]:
        """Signed area of every triangle over that of the regular grid."""
        hx, hy = self.mesh.cell_size
        return doubled_areas(self.position.x, self.position.y, jnp.asarray(turned(self.mesh.cells))) / (hx * hy)

    def _mean_over(self, share: Array, values: Array) -> Array:
        # Over the largest share, so that faint foci count as strong ones do; where no cell lies within one, all count alike.
        largest = jnp.max(share)
        share = share / jnp.where(largest > 0, largest, jnp.ones_like(largest))
        weight = (share[:-1, :-1] * share[:-1, 1:] * share[1:, :-1] * share[1:, 1:]) ** 8
        weight = jnp.where(jnp.sum(weight) > 0, weight, jnp.ones_like(weight))
        return jnp.exp(jnp.sum(weight * values) / jnp.sum(weight))


__all__ = ["Certificate", "Warp"]
