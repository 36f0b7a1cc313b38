"""Heat on a lattice by one axis after the other: `SplitHeat`.

    (1 - dt K_x / C) (1 - dt K_y / C) (1 - dt K_z / C) theta' = theta        K = K_x + K_y + K_z

A backward Euler step along each axis in turn (locally one-dimensional), sources and boundaries with the first. Each is a set of
tridiagonal systems and makes no new extreme, so their product is stable for any dt in any dimension; Peaceman and Rachford's scheme is
not, in three. Order 1; the error grows with dt where heat flows along two axes at once, and with sources a steady state has an error of
that order.

Source: Yanenko (1971), The Method of Fractional Steps; stability of three-way schemes from their amplification factors.
"""

from __future__ import annotations

import dataclasses

from jaxtyping import Array

from ..linalg.lines import LineSolver
from ..linalg.operators import SpringBlocks
from ..status import Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from ..topology.lattice import Lattice
from .backward import BackwardStep, HeatIteration
from .flow import Flow
from .schemes import HeatScheme


class SplitHeat(HeatScheme):
    """One backward Euler step per axis, solved directly. For lattices whose heat flows along structural springs alone.

    Attributes:
        iteration: how far the iteration goes where the power is not linear (latent heat, radiation).
    """

    iteration: HeatIteration = HeatIteration()

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """Every axis in turn, all at the end of the step."""
        end = flow.at(flow.state.time + dt)
        status = Status.ok()
        for i, (axis, link) in enumerate(_by_axis(end)):
            part = dataclasses.replace(end, links=() if link is None else (link,))
            if i:
                held = tuple(b for b in end.boundaries if b.held() is not None)
                part = dataclasses.replace(part, boundaries=held, source=None)
            y, seen = BackwardStep(LineSolver(axis), self.iteration).solve(part, y, dt)
            status = status.then(seen)
        return y, status

    def check(self, net: Topology) -> None:
        """Raise ValueError where the net is no lattice, wraps, or has other springs than structural ones."""
        if not isinstance(net, Lattice):
            raise ValueError(f"SplitHeat goes along the axes of a lattice; this net is a {type(net).__name__}. Take BackwardEulerHeat.")
        if any(net.periodic):
            raise ValueError("SplitHeat does not go round a periodic axis. Take BackwardEulerHeat.")
        oblique = [offset for offset in net.offsets if sorted(offset) != [0] * (len(offset) - 1) + [1]]
        if oblique:
            raise ValueError(
                f"SplitHeat goes along the axes, but springs of the net have the offset {oblique[0]}. Give Heat a net of structural "
                f"springs, js.lattice({net.shape}), or take BackwardEulerHeat."
            )


def _by_axis(flow: Flow) -> list[tuple[int, SpringBlocks | None]]:
    """Axis and conductances of each spring family; one axis without springs where there is none."""
    found: list[tuple[int, SpringBlocks | None]] = []
    for link in flow.links:
        net = link.net
        if not isinstance(net, Lattice):
            raise ValueError("SplitHeat goes along the axes of a lattice.")
        for offset, entry in zip(net.offsets, link.weight.families, strict=True):
            alone = Lattice(net.shape, (offset,), net.periodic, None)
            found.append((offset.index(1), SpringBlocks(alone, EdgeField((entry,)))))
    return found or [(0, None)]


__all__ = ["SplitHeat"]
