"""Heat on a lattice by one axis after the other: `SplitHeat`, `SymmetricSplitHeat`.

    split        B_z(dt) B_y(dt) B_x(dt)                                    B_d: a backward Euler step along axis d
    symmetric    T_x(dt/2) T_y(dt/2) T_z(dt) T_y(dt/2) T_x(dt/2)            T_d: a Crank-Nicolson step along axis d

Each factor is a set of tridiagonal systems, and conserves heat. Neither B_d nor T_d lets the differences grow (in the norm weighed with
the capacities), for any dt, so that their products are stable in any dimension; Peaceman and Rachford's scheme is not, in three. B_d makes
no new extreme either, T_d only up to dt = 2 C_i / (conductances along d). Sources and boundaries go with the first axis.

Split is of order 1: the error grows with dt where heat flows along two axes at once, and with sources a steady state has an error of that
order. Symmetric is of order 2, in time-dependent sources and temperatures too: time passes in the steps along the first axis alone.

Source: Yanenko (1971), The Method of Fractional Steps; Strang (1968) for the symmetric order; stability from the factors' norms.
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
from .schemes import HeatScheme, pushed


class _AxisByAxis(HeatScheme):
    """For lattices whose heat flows along structural springs alone."""

    iteration: HeatIteration = HeatIteration()

    def check(self, net: Topology) -> None:
        """Raise ValueError where the net is no lattice, wraps, or has other springs than structural ones."""
        if not isinstance(net, Lattice):
            raise ValueError(
                f"{type(self).__name__} goes along the axes of a lattice; this net is a {type(net).__name__}. Take BackwardEulerHeat."
            )
        if any(net.periodic):
            raise ValueError(f"{type(self).__name__} does not go round a periodic axis. Take BackwardEulerHeat.")
        oblique = [offset for offset in net.offsets if sorted(offset) != [0] * (len(offset) - 1) + [1]]
        if oblique:
            raise ValueError(
                f"{type(self).__name__} goes along the axes, but springs of the net have the offset {oblique[0]}. Give Heat a net of "
                f"structural springs, js.lattice({net.shape}), or take BackwardEulerHeat."
            )


class SplitHeat(_AxisByAxis):
    """One backward Euler step per axis, solved directly: order 1, any dt, and no new extreme.

    Attributes:
        iteration: how far the iteration goes where the power is not linear (latent heat, radiation).
    """

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """Every axis in turn, all at the end of the step."""
        status = Status.ok()
        for axis, part in _by_axis(flow.at(flow.state.time + dt)):
            y, seen = BackwardStep(LineSolver(axis), self.iteration).solve(part, y, dt)
            status = status.then(seen)
        return y, status


class SymmetricSplitHeat(_AxisByAxis):
    """Crank-Nicolson steps along the axes, there and back, solved directly: order 2, any dt is stable. Jumps ring where dt is long.

    Attributes:
        iteration: how far the iteration goes where the power is not linear (latent heat, radiation).
    """

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """Half a step along each axis but the last, a whole one along that, and back."""
        start, half = flow.state.time, 0.5 * dt
        before, middle, after = (_by_axis(flow.at(time)) for time in (start, start + half, start + dt))
        if len(middle) == 1:
            stages = [(before[0], after[0], dt)]
        else:
            within = [(part, part, half) for part in middle[1:-1]]
            turn = (middle[-1], middle[-1], dt)
            stages = [(before[0], middle[0], half), *within, turn, *within[::-1], (middle[0], after[0], half)]
        status = Status.ok()
        for (_, begin), (axis, end), span in stages:
            y, seen = BackwardStep(LineSolver(axis), self.iteration).solve(end, pushed(begin, y, 0.5 * span), 0.5 * span)
            status = status.then(seen)
        return y, status


def _by_axis(flow: Flow) -> list[tuple[int, Flow]]:
    """For each spring family its axis, and what flows along it; sources and boundaries with the first. One without springs where there
    is none.
    """
    found: list[tuple[int, Flow]] = []
    held = tuple(b for b in flow.boundaries if b.held() is not None)
    for link in flow.links:
        net = link.net
        if not isinstance(net, Lattice):
            raise ValueError("heat by axes needs a lattice.")
        for offset, entry in zip(net.offsets, link.weight.families, strict=True):
            alone = SpringBlocks(Lattice(net.shape, (offset,), net.periodic, None), EdgeField((entry,)))
            part = dataclasses.replace(flow, links=(alone,))
            found.append((offset.index(1), dataclasses.replace(part, boundaries=held, source=None) if found else part))
    return found or [(0, dataclasses.replace(flow, links=()))]


__all__ = ["SplitHeat", "SymmetricSplitHeat"]
