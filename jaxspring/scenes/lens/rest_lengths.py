"""The lens by rest lengths alone, uncalibrated: springs of the foci rest M times longer, and the net finds its balance.

    l_ij = l0_ij (1 - tension (1 - a_ij)) (M_i + M_j) / 2            k_ij = k0_ij (1 + firmness a_ij)

An isotropic sheet: both diagonals of each cell, half as stiff as rows and columns (Poisson's ratio 1/3). With tension 0 and firmness 0 a
disc far from the border is Eshelby's inclusion (1957): its strain is uniform, and K_in / (K_in + G_out) of what was wanted,

    m_delivered - 1 = 2/3 (m - 1)                      u_r = (m_delivered - 1) R^2 / r outside        [pixels]

So rest lengths alone do not deliver the magnification; `Lens` calibrates them. Such springs push as well as pull, hence nothing keeps the
net from folding: look at the certificate. Large magnifications are reached by a ramp, else the net crumples into a balance of its own.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._checks import constant
from ...forces.springs import Springs
from ...state import State
from ...status import Status
from ...steppers.equilibrium import equilibrium
from ...system import System
from ...topology.edge_field import EdgeField
from .foci import combined, several
from .mesh import LensMesh
from .scene import Foci, Lens
from .warp import Warp

# Of a diagonal over that of a row, for an isotropic sheet.
ISOTROPIC = 0.5


def rest_length_system(lens: Lens, foci: Foci, tension: Array | float = 0.0, firmness: Array | float = 0.0) -> System:
    """The net whose rest lengths are M times the undeformed lengths, on the nodes of a lens.

    Args:
        lens: its mesh.
        foci: what is to be magnified.
        tension: 0 where the context rests at its own size, 1 where its springs rest at zero.
        firmness: how much stiffer the springs of the foci are than the context's, less one.

    Returns:
        A `js.System` of unit stiffness along rows and columns [N/m], positions (x, y) in pixels; its borders slide.

    Raises:
        ValueError: a tension or firmness that is negative.
    """
    return _system(lens.mesh, *_wanted(lens.mesh, foci), tension, firmness)


def by_rest_lengths(
    lens: Lens, foci: Foci, tension: Array | float = 0.0, firmness: Array | float = 0.0, n_steps: int = 1, tolerance: float | None = None
) -> Warp:
    """The mesh at the balance of `rest_length_system`, reached in a ramp of ln M.

    Args:
        lens: its mesh.
        foci: what is to be magnified.
        tension: 0 where the context rests at its own size, 1 where its springs rest at zero.
        firmness: how much stiffer the springs of the foci are than the context's, less one.
        n_steps: equilibria on the way, each from the last.
        tolerance: of the equilibria; see `js.equilibrium`.

    Returns:
        A `Warp`, whose status is that of the last equilibrium, and whose `stiffness` is the tension per length, of either sign.

    Raises:
        ValueError: fewer steps than one, a tension or firmness that is negative.

    >>> import jaxspring as js
    >>> lens = js.lens.Lens((61, 61), nodes=31)
    >>> disc = js.lens.Disc((30.0, 30.0), radius=8.0, magnification=1.03, rim=1.0)
    >>> warp = js.lens.by_rest_lengths(lens, disc)
    >>> bool(1.015 < warp.delivered[0] < 1.025)
    True
    """
    if n_steps < 1:
        raise ValueError(f"n_steps = {n_steps}; the ramp needs one equilibrium or more.")
    mesh = lens.mesh
    log_wanted, share = _wanted(mesh, foci)
    state = State.from_points(mesh.net, np.stack([np.ravel(mesh.x), np.ravel(mesh.y)], axis=1))
    status = Status.ok()
    for step in range(1, n_steps + 1):
        system = _system(mesh, log_wanted * (step / n_steps), share, tension, firmness)
        found = equilibrium(system, state, tolerance=tolerance)
        state, status = found.state, status.then(found.status)
    shares = tuple(focus.share(mesh.x, mesh.y) for focus in several(foci))
    stiffness, rest = _constants(mesh, log_wanted, share, tension, firmness)
    length = mesh.net.difference(state.position).map(lambda d: jnp.sqrt(d.dot(d)))
    weight = stiffness.map(lambda k, l0, r: k * (1 - l0 / r), rest, length)
    return Warp(lens.shape, lens.sampling, mesh, state.position, weight, log_wanted, share, shares, status)


def _wanted(mesh: LensMesh, foci: Foci) -> tuple[Array, Array]:
    return combined(several(foci), mesh.x, mesh.y)


def _constants(
    mesh: LensMesh, log_wanted: Array, share: Array, tension: Array | float, firmness: Array | float
) -> tuple[EdgeField, EdgeField]:
    """Stiffness and rest length of every spring."""
    why = "The context would be pushed, or the foci pulled, the wrong way."
    slack, firm = (constant(n, a, why, may_be_zero=True).astype(share.dtype) for n, a in (("tension", tension), ("firmness", firmness)))
    net, of_focus = mesh.net, mesh.net.average(share)
    factor = net.average(jnp.exp(log_wanted))
    rest = mesh.length.map(lambda length, m, a: length * m * (1 - slack * (1 - a)), factor, of_focus)
    rows, columns, *diagonals = mesh.stiffness.families
    even = net.own([rows, columns, *(jnp.full_like(d, ISOTROPIC) for d in diagonals)])
    return even.map(lambda k, a: k * (1 + firm * a), of_focus), rest


def _system(mesh: LensMesh, log_wanted: Array, share: Array, tension: Array | float, firmness: Array | float) -> System:
    net = mesh.net
    stiffness, rest = _constants(mesh, log_wanted, share, tension, firmness)
    free = np.stack([np.ravel(a) for a in mesh.is_free], axis=-1)
    return System(net, 1.0, Springs(net, net.flatten(stiffness), net.flatten(rest)), free=free)


__all__ = ["by_rest_lengths", "rest_length_system"]
