"""A block on a hot plate: it conducts, softens, melts and spreads.

    springs    structural and shear, k falls from softening to melting, then they fuse                      `ThermalStiffness`, `Fusing`
    heat       along structural springs; the plate heats what touches it, Newton's term                     `Heat`, `HotPlane`
    fluid      between particles that no spring holds any more, pairs at rest at the lattice's spacing        `Fluid`, `gentle_fluid`
    loads      weight, drag, a floor with friction                                                          `Gravity`, `Drag`, `Floor`

The material is like wax, but conducts some thousand times better, so that melting takes a second instead of an hour; the laws are the same
under that scaling. Earlier settings let the melt draw together. Three changes were made together: the fluid's attraction is switched off
between 1.05 and 1.4 spacings, drag is stronger, and the stiffness would vanish only at 357 K, above the melting point. What each of them
does alone was not measured.

Source: slides "Heating and Melting" and "Discrete Fluid Model"; constants are this library's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax.numpy as jnp

from ..._checks import finite, nonnegative, positive
from ...forces.contact import Floor
from ...forces.cutoffs import Switched
from ...forces.damping import Drag
from ...forces.fluid import Fluid
from ...forces.loads import Gravity
from ...forces.molten import Molten
from ...forces.pair_laws import gentle_fluid
from ...forces.pairs import AllPairs
from ...forces.springs import Springs
from ...state import State
from ...system import System
from ...thermal.cells import capacities
from ...thermal.conduction import conductances
from ...thermal.fusing import Fusing
from ...thermal.heat import Heat
from ...thermal.hot_plane import HotPlane
from ...thermal.ledger import Ledger
from ...thermal.stiffness import ThermalStiffness
from ...topology.lattice import SHEAR, STRUCTURAL, Lattice, lattice


@dataclass(frozen=True)
class MeltSettings:
    """The scene in numbers.

    Attributes:
        nodes: along x, y and z.
        spacing: of the lattice [m].
        density: [kg/m^3]; of a node with the cell around it.
        stiffness: of a cold spring [N/m].
        drag: on every node [N s/m].
        softening: where springs start to soften [K].
        melting: where they fuse [K].
        vanishing: where the falling stiffness would be zero [K]; the melting point or above, so that a spring still holds when it fuses.
        start: temperature of the block at first [K].
        plate: temperature of the plate [K].
        conductivity: [W/(m K)].
        specific_heat: [J/(kg K)].
        transfer: from the plate to what touches it [W/(m^2 K)].
        attraction: alpha of the fluid [N m / kg^2].
        friction: of the plate.
        gravity: [m/s^2], downward.
        dt: longest step [s].
        duration: [s].

    Raises:
        ValueError: fewer than two nodes along an axis; a number that is not finite and positive (stiffness, drag, transfer, attraction,
            friction and gravity may be 0); temperatures out of order; a duration shorter than a step. The message names the field.
    """

    nodes: tuple[int, int, int] = (6, 6, 6)
    spacing: float = 0.01
    density: float = 900.0
    stiffness: float = 200.0
    drag: float = 1.5e-2
    softening: float = 320.0
    melting: float = 350.0
    vanishing: float = 357.0
    start: float = 300.0
    plate: float = 420.0
    conductivity: float = 3000.0
    specific_heat: float = 2000.0
    transfer: float = 5e5
    attraction: float = 1000.0
    friction: float = 0.1
    gravity: float = 9.81
    dt: float = 4e-4
    duration: float = 1.0

    def __post_init__(self) -> None:
        if len(self.nodes) != 3 or any(int(n) != n or n < 2 for n in self.nodes):
            raise ValueError(
                f"nodes = {self.nodes}; expected three whole numbers of 2 or more, along x, y and z. Pass e.g. nodes=(6, 6, 6)."
            )
        for name in ("spacing", "density", "softening", "start", "plate", "conductivity", "specific_heat", "dt", "duration"):
            positive(name, getattr(self, name), "The scene needs a positive number here.")
        for name in ("stiffness", "drag", "transfer", "attraction", "friction", "gravity"):
            nonnegative(name, getattr(self, name), "It would feed energy in, or turn the law around.")
        for name in ("melting", "vanishing"):
            finite(name, getattr(self, name))
        self._check_order()

    def _check_order(self) -> None:
        order = (("softening", "melting", False), ("melting", "vanishing", True), ("start", "melting", False), ("start", "plate", False))
        for low, high, is_equal_allowed in order:
            a, b = getattr(self, low), getattr(self, high)
            if a > b or (a == b and not is_equal_allowed):
                wanted = "at most" if is_equal_allowed else "below"
                raise ValueError(f"{low} = {a:g} K, {high} = {b:g} K; expected {low} {wanted} {high}. Change {low} or {high}.")
        if self.duration < self.dt:
            raise ValueError(
                f"duration = {self.duration:g} s is shorter than one step, dt = {self.dt:g} s. Pass duration={self.dt:g} or more."
            )

    @property
    def n_steps(self) -> int:
        """The fewest steps that fill the duration."""
        return math.ceil(self.duration / self.dt * (1 - 1e-9))  # less a little: 0.3 / 0.1 is above 3


@dataclass(frozen=True)
class Melting:
    """The scene, ready to run.

    Attributes:
        net: structural and shear springs.
        system: forces, and one rule, the ledger.
        state: at the start.
        heat: the rule of heat, for what it can tell.
    """

    net: Lattice
    system: System
    state: State
    heat: Heat


def melting_block(settings: MeltSettings | None = None, dtype: jnp.dtype | None = None) -> Melting:
    """The block on its plate, at rest, its lowest nodes on the plate.

    Args:
        settings: `MeltSettings()` unless said.
        dtype: of the state; JAX's default unless said.
    """
    s = MeltSettings() if settings is None else settings
    dtype = jnp.result_type(float) if dtype is None else dtype
    nx, ny, nz = s.nodes
    net = lattice((nz, ny, nx), springs=STRUCTURAL + SHEAR)
    along = lattice((nz, ny, nx), springs=STRUCTURAL)
    points = jnp.asarray(net.grid(s.spacing), dtype)
    points = points - jnp.asarray([(nx - 1) * s.spacing / 2, (ny - 1) * s.spacing / 2, 0.0], dtype)[None, :]
    mass = s.density * s.spacing**3
    springs = Springs(net, ThermalStiffness(s.stiffness, s.softening, s.vanishing), net.lengths(points))
    fluid = Fluid(
        gentle_fluid(s.spacing, alpha=s.attraction),
        cutoff=Switched(1.05 * s.spacing, 1.4 * s.spacing),
        pairs=AllPairs(),
        core=0.2 * s.spacing,
        molten=Molten(net),
    )
    ground, up = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    plate = HotPlane(ground, up, s.plate, s.transfer, s.spacing**2, reach=0.25 * s.spacing, fade=0.5 * s.spacing)
    heat = Heat(
        along,
        capacities(along, s.density, s.specific_heat, s.spacing),
        conductances(along, s.conductivity, s.spacing),
        boundaries=plate,
    )
    rules = (heat, Fusing(net, s.melting), Floor(ground, up, s.friction), Ledger())
    system = System(net, mass, (springs, Gravity((0.0, 0.0, -s.gravity)), Drag(s.drag), fluid), rules=rules)
    start = State.from_points(net, points, temperature=jnp.asarray(s.start, dtype))
    return Melting(net, system, start, heat)


__all__ = ["MeltSettings", "Melting", "melting_block"]
