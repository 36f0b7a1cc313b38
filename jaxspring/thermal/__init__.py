"""Heat and melting: conduction, boundary conditions, latent heat, softening springs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from ..forces.springs import ExpansionRule as ExpansionRule
    from .backward import HeatIteration as HeatIteration
    from .boundaries import Convection as Convection
    from .boundaries import FixedTemperature as FixedTemperature
    from .boundaries import HeatFlux as HeatFlux
    from .boundaries import Radiation as Radiation
    from .boundaries import ThermalBoundary as ThermalBoundary
    from .cells import Cells as Cells
    from .cells import EqualCells as EqualCells
    from .cells import HalfCells as HalfCells
    from .cells import capacities as capacities
    from .conduction import conductances as conductances
    from .conduction import link_conductances as link_conductances
    from .fusing import Refreezing as Refreezing
    from .fusing import melted_fraction as melted_fraction
    from .heat import total_heat as total_heat
    from .hot_plane import HotPlane as HotPlane
    from .hot_plane import HotSurface as HotSurface
    from .latent import LatentHeat as LatentHeat
    from .ledger import Account as Account
    from .schemes import BackwardEulerHeat as BackwardEulerHeat
    from .schemes import CrankNicolsonHeat as CrankNicolsonHeat
    from .schemes import ExplicitHeat as ExplicitHeat
    from .schemes import HeatScheme as HeatScheme
    from .split import SplitHeat as SplitHeat
    from .split import SymmetricSplitHeat as SymmetricSplitHeat
    from .stiffness import ThermalExpansion as ThermalExpansion
    from .stiffness import ThermalStiffness as ThermalStiffness
    from .fusing import Fusing as Fusing
    from .heat import Heat as Heat
    from .ledger import Ledger as Ledger
    from .ledger import energy_ledger as energy_ledger
else:
    __all__, __getattr__, __dir__ = _face(__name__)
