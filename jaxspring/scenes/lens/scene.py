"""The spring lens (Germer, Götzelmann, Spindler & Strothotte 2006): an image on a net of springs that magnifies some of its parts.

Where a focus wants the magnification M, springs of rest lengths about M times their length push the net open; the context between them has
rest length zero, so that it is under tension and gives way. How long the springs must rest, for the lens to be as large as was wanted in
the balance with the context, is found by calibration. It works on the tension per length w of each spring,

    w_ij = pull / length = k_ij (1 - l_ij / r_ij)        [N/m]

which is all that the balance knows of k and l. For given w the balance is linear (see `mesh`), and as long as w > 0 nothing folds. A fixed
number of passes solves it and then corrects w by what came out, with r over the undeformed length in place of r:

    in the foci   ln w += gain a^8 (ln r - ln M)         too short: weaker, until it is as long as was wanted
    elsewhere     w = r^(p - 1)                       squeezed: stiffer, as of a spring whose pull r^p hardly falls as it shortens

with p = ln mean(a M^2) / ln mean(a) - 0.4, whose first term is 1 over the anisotropy of a context that is squeezed evenly. After the first
third of the passes the context stays as it is. With equal springs in the context no disc of radius R could be magnified more than
2 / (1 + R^2) times (R over the radius of the sheet): it would be squeezed to nothing at the rim first. So the limit comes near to 1 / R,
where the lens fills the sheet.

From w follow springs with rest lengths in the end: see `Warp.system`.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..._checks import kind
from ...images.sampling import Bilinear, Sampling
from ...linalg.cg import JaxCG
from ...numerics import cast_inexact
from ...status import Status
from ...topology.edge_field import EdgeField
from ...vector import Vector
from .feasible import check_feasible, feasibility
from .foci import Focus, combined, several
from .mesh import LensMesh
from .warp import Picture, Warp

Foci = Focus | Sequence[Focus]
_Pass = tuple[EdgeField, EdgeField, Vector]  # ln w of the foci and of the context, displacements
# Less than the evenness of the wanted lens is the power of length with which the pull of the context falls.
SLACKNESS = 0.4
# The first third of the passes makes the context as well; the others only bring the foci to their size.
LATE = 0.34
# The largest logarithm of a weight over that of equal springs.
MOST = 5.0
# Only where a focus has nearly all to say are the springs brought to a length: across a rim no mesh has all the lengths that are wanted.
SHARPNESS = 8


class Lens(eqx.Module):
    """A spring lens over images of one shape: a layer `lens(image, foci) -> image`, under `jit`, `vmap` and `grad`.

    Args:
        shape: (rows, columns) of the images.
        nodes: nodes of the mesh along the longer side, or (ny, nx).
        n_passes: calibrations of the springs.
        gain: of the calibration.
        sampling: how images are read between their pixels, `js.images.Bilinear()` or `js.images.CubicSpline()`.
        solver: of the balance; None is `JaxCG()` with a tolerance of 1e-10 in float64 and 1e-5 in float32.

    Attributes:
        shape, n_passes, gain, sampling, solver: as above (static, but for the last two).
        mesh: the net.

    Raises:
        ValueError: an image smaller than 4 x 4 pixels, fewer than 5 nodes along a side or more than pixels, a gain or number of passes
            that is not positive.

    >>> import jax.numpy as jnp
    >>> import jaxspring as js
    >>> lens = js.lens.Lens((64, 64), nodes=17)
    >>> disc = js.lens.Disc(centre=(30.0, 32.0), radius=10.0, magnification=2.0)
    >>> warp = lens.warp(disc)
    >>> print(warp.delivered.round(1), int(warp.certificate().n_folds))
    [2.] 0
    >>> lens(jnp.ones((64, 64)), disc).shape
    (64, 64)
    """

    shape: tuple[int, int] = eqx.field(static=True)
    n_passes: int = eqx.field(static=True)
    gain: float = eqx.field(static=True)
    mesh: LensMesh
    sampling: Sampling
    solver: JaxCG | None

    def __init__(
        self,
        shape: tuple[int, int],
        nodes: int | tuple[int, int] = 33,
        n_passes: int = 16,
        gain: float = 2.0,
        sampling: Sampling = Bilinear(),  # noqa: B008 (frozen, holds no array)
        solver: JaxCG | None = None,
    ):
        if len(shape) != 2 or min(shape) < 4:
            raise ValueError(f"shape = {tuple(shape)}; a lens needs images of 4 x 4 pixels or more, given as (rows, columns).")
        if n_passes < 1 or not gain > 0:
            raise ValueError(f"n_passes = {n_passes}, gain = {gain}; without a pass, or a gain above 0, nothing is calibrated.")
        self.shape = (int(shape[0]), int(shape[1]))
        self.n_passes, self.gain, self.sampling, self.solver = n_passes, float(gain), sampling, solver
        self.mesh = LensMesh.over(self.shape, _nodes(self.shape, nodes))

    def __call__(self, image: Picture, foci: Foci) -> Picture:
        """The image as the lens shows it: `warp(foci).apply(image)`, where the several images of a batch (..., ny, nx) share one warp."""
        return self.warp(foci).apply(image)

    def warp(self, foci: Foci) -> Warp:
        """The mesh that these foci make.

        Args:
            foci: one focus, or several, whose magnifications multiply where they overlap.

        Raises:
            ValueError: the foci do not fit into the image, or are smaller than two cells of the mesh; the message says the largest
                magnification that fits. Where they are traced, the warp's status says INVALID instead.
            TypeError: not foci.
        """
        foci = several(foci)
        for i, focus in enumerate(foci):
            kind(f"foci[{i}]", focus, Focus, "js.lens.Disc((100.0, 80.0), 30.0, 2.0)")
        if not foci:
            raise ValueError("foci is empty: there is nothing to magnify. Pass one focus or more.")
        dtype = jnp.result_type(jax.tree.leaves(eqx.filter(foci[0], eqx.is_inexact_array))[0])
        mesh, foci = cast_inexact(self.mesh, dtype), tuple(cast_inexact(focus, dtype) for focus in foci)
        check_feasible(foci, mesh, self.shape)
        log_wanted, share = combined(foci, mesh.x, mesh.y)
        moved, stiffness, status = self._calibrated(mesh, log_wanted, share)
        status = status.then(feasibility(foci, mesh, self.shape))
        position = Vector((mesh.x, mesh.y)) + moved
        shares = tuple(focus.share(mesh.x, mesh.y) for focus in foci)
        return Warp(self.shape, self.sampling, mesh, position, stiffness, log_wanted, share, shares, status)

    def _calibrated(self, mesh: LensMesh, log_wanted: Array, share: Array) -> tuple[Vector, EdgeField, Status]:
        """Displacements, the tension per length that holds them, and how the last solve went."""
        net = mesh.net
        of_focus, wanted = net.average(share), net.average(log_wanted)
        solver = JaxCG(tolerance=1e-10 if share.dtype == jnp.float64 else 1e-5) if self.solver is None else self.solver

        slackness = _evenness(share, log_wanted) - SLACKNESS

        def one(state: _Pass, index: Array) -> tuple[_Pass, tuple[EdgeField, Status]]:
            focus, context, guess = state
            weight = mesh.stiffness.map(lambda k, f, c, a: k * jnp.exp(f + (1 - a) * c), focus, context, of_focus)
            moved, info = mesh.balance(weight, guess, solver)
            stretch = mesh.differences(moved).map(lambda d, length: 0.5 * jnp.log(d.dot(d)) - jnp.log(length), mesh.length)
            is_late = index >= round(LATE * self.n_passes)
            context = context.map(lambda old, e: jnp.where(is_late, old, _bounded((slackness - 1) * e)), stretch)
            focus = focus.map(lambda f, e, m, a: _bounded(f + self.gain * a**SHARPNESS * (e - m)), stretch, wanted, of_focus)
            return (focus, context, moved), (weight, info.status)

        start = (wanted.map(lambda m: -m), wanted.map(jnp.zeros_like), Vector((jnp.zeros_like(share), jnp.zeros_like(share))))
        (_, _, moved), (weights, statuses) = lax.scan(one, start, jnp.arange(self.n_passes))
        last = jax.tree.map(lambda a: a[-1], (weights, statuses))
        return moved, last[0], last[1]


def _evenness(share: Array, log_wanted: Array) -> Array:
    """Radial over tangential stretch of a context that is squeezed evenly, ln(m R) / ln R for a disc, from the areas of the foci."""
    before, after = jnp.mean(share), jnp.mean(share * jnp.exp(2 * log_wanted))
    # Shrunk foci squeeze nothing, and nothing helps those that fill the image; no focus at all is the limit of small ones.
    is_some = (before > 0) & (before < 1)
    before, after = (jnp.where(is_some, a, jnp.full_like(a, 0.5)) for a in (before, after))
    evenness = jnp.clip(jnp.log(jnp.minimum(after, 0.99)) / jnp.log(before), 0, 1)
    return jnp.where(is_some, evenness, jnp.ones_like(evenness))


def _bounded(log_weight: Array) -> Array:
    """Within what a solve in float32 can hold: reached where a lens is asked for what it cannot deliver."""
    return jnp.clip(log_weight, -MOST, MOST)


def _nodes(shape: tuple[int, int], nodes: int | tuple[int, int]) -> tuple[int, int]:
    """(ny, nx) nodes such that cells are nearly square."""
    if isinstance(nodes, int):
        longest = max(shape) - 1
        ny, nx = (max(round((nodes - 1) * (n - 1) / longest), 4) + 1 for n in shape)
    else:
        ny, nx = nodes
    if (isinstance(nodes, int) and nodes < 5) or min(ny, nx) < 5 or ny > shape[0] or nx > shape[1]:
        raise ValueError(
            f"nodes = {nodes} makes {ny} x {nx} nodes on {shape[0]} x {shape[1]} pixels; expected 5 or more, and no more than pixels."
        )
    return ny, nx


__all__ = ["Foci", "Lens"]
