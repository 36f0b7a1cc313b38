"""Breaks: springs of a height field give way where that lowers its energy, and the surface falls apart along lines.

    energy of a surface       E = sum k/2 (z_i - z_j)^2 over whole springs + sum k_d/2 (z_i - d_i)^2 + sum of the prices of broken ones
    the fit                   A z = k_d d,   A = diag(k_d) + sum k b b',   b' z = z_j - z_i
    breaking the set S gains  1/2 e' M^-1 e,   M = diag(1/k) - B' A^-1 B,   e = B' z,   B the columns b of S               (exact)
    of one spring             (k e)^2 / (2 K),   K = k (1 - k b' A^-1 b)
    a straight edge           S = (k_d + sqrt(k_d^2 + 4 k_d k)) / 2,   K = 1 / (1/k + 2/S): a step H across it shows as e = H K / k only,
                              and breaking along it gains K H^2 / 2 per spring

In two dimensions one spring gains far less than K H^2 / 2, as its neighbours carry the step around it. So a spring whose e foretells a
step is only where a line begins. The line grows from cell to cell, each time through the spring that gains most beside those already cut,
as long as these too foretell half of the step; then the part of it that gains most is taken if it gains more than its price. At the end
nodes change sides, and springs are made whole, where that lowers the energy.

Source: the energy is the weak membrane of Blake and Zisserman (1987), "Visual Reconstruction"; gain of a set by the Woodbury identity; two
thresholds along a line as in Canny (1986). Prices from the step that is wanted, and growth with the exact gain, are this library's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._arrays import Numbers
from ..._checks import as_inexact, has_shape, nonnegative
from ...topology.base import Topology
from ...topology.edge_field import EdgeField
from .break_energy import LOOSE, Fitted, HeightField
from .break_lines import Faces, locate_breaks, trace
from .given import host_number

# Lines begin where a step of so many times the wanted one shows, then of less.
STAGES = (4.0, 2.0, 1.0)
# A line goes on through springs that show this share of the step.
WEAKER = 0.5
# Sweeps of moves at most; each lowers the energy.
SWEEPS = 50
# Share of the energy below which a change is none.
ROUNDING = 1e-12


def step_stiffness(stiffness: Numbers, data_stiffness: Numbers) -> Array:
    """K of a spring of a long uniform chain: a step H across it costs K H^2 / 2 while it is whole, and shows as an extension of H K / k.

    Args:
        stiffness: k of the chain's springs [N/m].
        data_stiffness: k_d of the data spring at each node [N/m].

    Returns:
        K [N/m]; 0 where k is 0.

    Raises:
        ValueError: a negative stiffness, or shapes that differ.

    >>> print(step_stiffness(1.0, 0.01).round(4))
    0.0499
    """
    k, kd = as_inexact("stiffness", stiffness), as_inexact("data_stiffness", data_stiffness)
    for name, value in (("stiffness", k), ("data_stiffness", kd)):
        nonnegative(name, value, "A negative spring pushes away.")
    has_shape("data_stiffness", kd, {"one number": (), "one per spring": k.shape})
    kd = kd.astype(k.dtype)
    side = (kd + jnp.sqrt(kd * kd + 4 * kd * k)) / 2
    whole = side + 2 * k
    return k * side / jnp.where(whole > 0, whole, jnp.ones_like(whole))


@dataclass(frozen=True)
class Breaks:
    """What `find_breaks` returns.

    Attributes:
        net: whose springs break.
        points: (N, 2) or (N, 1) nodes [m].
        broken: (E,) booleans, in the user's order.
        heights: (N,) of the broken surface in balance [unit of the data].
        fraction: (E,) where along each broken spring the break is, from its tail (0) to its head (1).
        lines: break lines, (M, 2) points each [m].
        gain: energy of the unbroken fit minus that of the broken one.
        price: what the broken springs cost.
        steepest: slope above which a smooth surface would break too [unit of the data per spring].
    """

    net: Topology
    points: np.ndarray
    broken: np.ndarray
    heights: np.ndarray
    fraction: np.ndarray
    lines: tuple[np.ndarray, ...]
    gain: float
    price: float
    steepest: float

    @property
    def n_broken(self) -> int:
        """How many springs are broken."""
        return int(self.broken.sum())

    @property
    def whole(self) -> EdgeField:
        """Where springs hold, for `state.with_alive(net, breaks.whole)`: rollouts and `js.equilibrium` leave the broken ones out."""
        return self.net.split(jnp.asarray(~self.broken))


def find_breaks(
    net: Topology,
    points: Numbers,
    data: Numbers,
    stiffness: Numbers,
    data_stiffness: Numbers,
    step: Numbers,
    image: Any = None,
) -> Breaks:
    """Break the springs of a height field where its energy falls by more than the price of a step, strongest edges first.

    The net is a chain, a lattice with structural springs, or a graph of triangles with springs along their sides. Springs of the border
    ring never break. A long straight edge along a row of the net breaks where it is higher than `step`; one along the diagonal of a
    lattice from about 1.2 `step`, since it crosses more springs. Take three times the noise at least, four where data springs are stiffer
    than springs. Where the surface rises by more than `steepest` per spring it breaks without any edge: stiffer data springs allow more.

    On the host, between rollouts: a decision, of derivative zero. The heights of the broken surface have one, in `js.equilibrium`.

    Args:
        net: nodes and springs.
        points: (N, D) or (N, 2) positions; the first two coordinates count [m].
        data: (N,) height of the data at each node; where the data spring is 0 it is not read.
        stiffness: of the springs along z [N/m]: a number, or (E,).
        data_stiffness: of the data springs [N/m]: a number, or (N,).
        step: the lowest step that is to break [unit of the data].
        image: a `js.Image` that tells where between two nodes the break is; else it is halfway.

    Returns:
        `Breaks`.

    Raises:
        ValueError: a net with other springs, two springs between the same nodes, a step that is not positive, no data at all.

    >>> import jaxspring as js
    >>> net = js.lattice((6, 8))
    >>> edge = np.where(net.grid()[:, 0] < 3.5, 0.0, 1.0)
    >>> found = find_breaks(net, net.grid(), edge, stiffness=1.0, data_stiffness=0.1, step=0.5)
    >>> found.n_broken, found.lines[0][0].tolist(), found.steepest.__round__(3)
    (4, [3.5, 1.0], 0.078)
    """
    field = HeightField.of(net, points, data, stiffness, data_stiffness)
    lowest = host_number("step", step, "Every spring would break.")
    faces, (chain, price) = Faces.of(net), _priced(field, lowest)
    allowed = ~faces.ring & (field.stiffness > 0)
    broken = np.zeros(net.n_springs, bool)
    for factor in STAGES:
        broken = _stage(field, faces, chain, factor**2 * price, allowed, broken)
    return assembled(net, field, lowest, _mended(field, price, allowed, broken), image)


def assembled(net: Topology, field: HeightField, step: float, broken: np.ndarray, image: Any) -> Breaks:
    """The surface in balance with these springs (E,) broken, and what there is to say of it."""
    chain, price = _priced(field, step)
    fit, before = Fitted(field, broken), Fitted(field, np.zeros_like(broken))
    fraction = locate_breaks(image, field.points, field.edges, broken)
    lines = trace(Faces.of(net), field.points, field.edges, broken, fraction)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(field.stiffness > 0, step * chain / field.stiffness, np.inf)
    gain = before.energy - fit.energy
    return Breaks(net, field.points, broken, fit.z, fraction, lines, gain, float(price[broken].sum()), float(slope.min()))


def _priced(field: HeightField, step: float) -> tuple[np.ndarray, np.ndarray]:
    """K of each spring in a chain of its like, and the price of breaking it. In a hole it is what it would be with data: free of charge,
    any slope would break there.
    """
    known = field.data_stiffness > 0
    at_nodes = np.where(known, field.data_stiffness, field.data_stiffness[known].mean())
    both = 0.5 * (at_nodes[field.edges[:, 0]] + at_nodes[field.edges[:, 1]])
    chain = np.asarray(step_stiffness(field.stiffness, both), np.float64)
    return chain, 0.5 * chain * step**2


class _Line:
    """A line of springs being cut: which, and what each gains beside those before it."""

    def __init__(self, fit: Fitted, stiffness: np.ndarray):
        self._fit, self._stiffness = fit, stiffness
        self.cut: list[int] = []
        self.gains: list[float] = []
        self._matrix = np.zeros((0, 0))

    def gain(self, spring: int) -> float:
        """What breaking one more spring gains, exactly."""
        extension, compliance, _ = self._beside(spring)
        return 0.5 * extension**2 / compliance if compliance > LOOSE / self._stiffness[spring] else 0.0

    def take(self, spring: int) -> None:
        """Cut it."""
        self.gains.append(self.gain(spring))
        _, _, column = self._beside(spring)
        own = 1 / self._stiffness[spring] - self._fit.coupling(spring, [spring])[0]
        self._matrix = np.block([[self._matrix, -column[:, None]], [-column[None, :], np.array([[own]])]])
        self.cut.append(spring)

    def _beside(self, spring: int) -> tuple[float, float, np.ndarray]:
        """Extension of a spring once those of the line are cut, and 1/k - b' A^-1 b then."""
        extension = self._fit.extension[spring]
        compliance = 1 / self._stiffness[spring] - self._fit.coupling(spring, [spring])[0]
        column = self._fit.coupling(spring, self.cut)
        if self.cut:
            found = np.linalg.solve(self._matrix, np.stack([self._fit.extension[self.cut], column], axis=-1))
            extension, compliance = extension + column @ found[:, 0], compliance - column @ found[:, 1]
        return float(extension), float(compliance), column


def _stage(field: HeightField, faces: Faces, chain: np.ndarray, price: np.ndarray, allowed: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Lines that pay this price, strongest first; each is fitted before the next is looked for."""
    tried = broken | ~allowed
    fit = Fitted(field, broken)
    while True:
        # What a straight edge of the step that this spring shows would gain.
        with np.errstate(divide="ignore", invalid="ignore"):
            shown = np.where(allowed & ~broken, 0.5 * (field.stiffness * fit.extension) ** 2 / chain, 0.0)
        seed = int(np.argmax(np.where(tried, -1.0, shown - price)))
        if tried[seed] or shown[seed] <= price[seed]:
            return broken
        tried[seed] = True
        line = _grown(fit, field, faces, seed, (shown > WEAKER**2 * price) & allowed, price, broken)
        if line:
            broken = broken.copy()
            broken[line] = True
            tried, fit = tried | broken, Fitted(field, broken)


def _grown(
    fit: Fitted, field: HeightField, faces: Faces, seed: int, foretell: np.ndarray, price: np.ndarray, broken: np.ndarray
) -> list[int]:
    """The springs of a line through `seed` that gains more than its price, or none."""
    line = _Line(fit, field.stiffness)
    line.take(seed)
    off = broken.copy()
    off[seed] = True
    tips = [(face, seed) for face in faces.at(seed)]
    while True:
        # Where another break is met, or the line itself, it ends.
        tips = [(face, last) for face, last in tips if off[faces.springs(face)].sum() == 1]
        ways = [(spring, i) for i, (face, _) in enumerate(tips) for spring in faces.springs(face) if foretell[spring] and not off[spring]]
        if not ways:
            break
        gains = [line.gain(spring) / price[spring] for spring, _ in ways]
        spring, i = ways[int(np.argmax(gains))]
        line.take(spring)
        off[spring] = True
        beyond = [face for face in faces.at(spring) if face != tips[i][0]]
        tips[i : i + 1] = [(face, spring) for face in beyond]
    total = np.cumsum(np.asarray(line.gains) - price[line.cut])
    best = int(np.argmax(total))
    return line.cut[: best + 1] if total[best] > 0 else []


def _mended(field: HeightField, price: np.ndarray, allowed: np.ndarray, broken: np.ndarray) -> np.ndarray:
    """Lines moved and springs made whole while that lowers the energy, prices included.

    A line moves across a node by toggling all springs of the node: it changes its side.
    """
    broken = broken.copy()
    at_node: list[list[int]] = [[] for _ in field.data]
    for spring in np.flatnonzero(allowed):
        for node in field.edges[spring]:
            at_node[node].append(int(spring))
    for _ in range(SWEEPS):
        if not broken.any():
            break
        fit = Fitted(field, broken)
        moves = [[int(spring)] for spring in np.flatnonzero(broken)]
        moves += [at_node[node] for node in np.unique(field.edges[broken]) if at_node[node]]
        change = np.array([fit.change(move) + price[move] @ np.where(broken[move], -1.0, 1.0) for move in moves])
        # The best of those near each other; the rest is looked at again.
        touched, n_moved = np.zeros(len(field.data), bool), 0
        for i in np.argsort(change):
            if change[i] >= -ROUNDING * fit.energy:
                break
            nodes = np.unique(field.edges[moves[i]])
            if not touched[nodes].any():
                touched[nodes] = True
                broken[moves[i]] ^= True
                n_moved += 1
        if not n_moved:
            break
    return broken


__all__ = ["Breaks", "find_breaks", "step_stiffness"]
