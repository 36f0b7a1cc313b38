"""How heat is advanced in time: `ExplicitHeat`, `BackwardEulerHeat`, `CrankNicolsonHeat`.

    explicit          C (y' - y) = dt P(theta, t)                        order 1; dt at most C_i / sum_j G_ij
    backward Euler    C (y' - y) = dt P(theta', t + dt)                  order 1; any dt, no new extreme
    Crank-Nicolson    C (y' - y) = dt/2 (P(theta, t) + P(theta', t + dt))    order 2; any dt is stable, rough data ring

Crank-Nicolson is half an explicit step, then half a backward one. `y` is the temperature, or with latent heat that of `latent.py`.

Source: slide "Heating and Melting" (explicit); Crank and Nicolson (1947).
"""

from __future__ import annotations

import abc

import equinox as eqx
from jaxtyping import Array

from ..linalg.base import LinearSolver
from ..linalg.cg import JaxCG
from ..status import Status
from ..topology.base import Topology
from .backward import BackwardStep, HeatIteration
from .flow import Flow


class HeatScheme(eqx.Module):
    """How heat is advanced. Abstract: the final ones are in `schemes.py` and `split.py`."""

    @abc.abstractmethod
    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """The unknown y a time dt [s] after that of `flow`, and how the solves ended."""

    def limit(self, rate: Array) -> Array | None:
        """Largest dt [s], where no node gives away its heat faster than `rate` [1/s]; None where nothing limits it."""
        return None

    def check(self, net: Topology) -> None:
        """Raise ValueError where the scheme cannot serve this net."""


class ExplicitHeat(HeatScheme):
    """Forward in time: order 1. Above its limit, which is reported as DT_LIMIT, it blows up."""

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """Forward in time: y + dt P / C."""
        return flow.at(flow.state.time + dt).hold(pushed(flow, y, dt)), Status.ok()

    def limit(self, rate: Array) -> Array:
        """One over the rate: a node then keeps a share of its own temperature, and no new extreme arises."""
        return 1 / rate


class _Solved(HeatScheme):
    """What ends with a backward step by a linear solver."""

    solver: LinearSolver
    iteration: HeatIteration

    def __init__(self, solver: LinearSolver | None = None, iteration: HeatIteration | None = None):
        self.solver = JaxCG() if solver is None else solver
        self.iteration = HeatIteration() if iteration is None else iteration


class BackwardEulerHeat(_Solved):
    """Backward Euler: order 1, any dt, and no new extreme. One linear solve a step; with latent heat or radiation a few.

    Attributes:
        solver: `JaxCG()` unless said. On fine lattices with long steps `JaxCG(preconditioner=Multigrid(net))`.
        iteration: how far the iteration goes where the power is not linear.
    """

    __init__ = _Solved.__init__  # said again for type checkers, which would make one of the fields

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """One backward step."""
        return BackwardStep(self.solver, self.iteration).solve(flow.at(flow.state.time + dt), y, dt)


class CrankNicolsonHeat(_Solved):
    """Crank and Nicolson's trapezoidal rule: order 2, any dt is stable. Jumps ring where dt is far above the explicit limit.

    Attributes:
        solver: `JaxCG()` unless said.
        iteration: how far the iteration goes where the power is not linear.
    """

    __init__ = _Solved.__init__  # said again for type checkers, which would make one of the fields

    def advance(self, flow: Flow, y: Array, dt: Array) -> tuple[Array, Status]:
        """Half an explicit step, half a backward one."""
        half = 0.5 * dt
        return BackwardStep(self.solver, self.iteration).solve(flow.at(flow.state.time + dt), pushed(flow, y, half), half)


def pushed(flow: Flow, y: Array, dt: Array) -> Array:
    """The unknown y after an explicit step of dt [s]."""
    return y + dt * flow.power(flow.temperature(y)) / flow.capacity


__all__ = ["BackwardEulerHeat", "CrankNicolsonHeat", "ExplicitHeat", "HeatScheme", "pushed"]
