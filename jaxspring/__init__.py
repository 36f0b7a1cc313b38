"""Differentiable mass-spring physics on JAX: springs, damping, data springs to images, adaptive meshes.

Every public name is loaded on first use, so that `import jaxspring` costs little more than `import jax`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from ._version import __version__

_HOMES = {
    "vector": ("Vector",),
    "status": ("Flag", "SimulationError", "StabilityWarning", "Status", "raise_for_status"),
    "state": ("State",),
    "system": ("System",),
    "bound": ("BoundSystem", "Energy"),
    "nodes": ("Motion",),
    "memory": ("Memory",),
    "masses": ("lumped_mass",),
    "edit": ("replace",),
    "resume": ("Resume",),
    "rollouts": ("Result", "rollout"),
    "ode": ("OdeInfo", "OdeResult", "diffeqsolve"),
    "blocks": ("Checkpointed", "StoreAll", "StoreStates"),
    "watch": ("Solves",),
    "progress": ("Progress",),
    "files": ("load", "save", "save_trajectory"),
    "export.vtk": ("save_vtk",),
    "export.xyz": ("save_xyz",),
    "export.ply": ("save_ply",),
    "archive": ("CheckpointError",),
    "plots": ("animate", "plot"),
    "topology.edge_field": ("EdgeField",),
    "topology.base": ("Topology",),
    "topology.lattice": ("BEND", "BODY", "SHEAR", "STRUCTURAL", "Lattice", "lattice"),
    "topology.graph": ("Graph",),
    "topology.reduction": ("Gather", "Scatter"),
    "topology.mesh_files": ("from_mesh",),
    "topology.builders": ("delaunay", "from_networkx", "from_scipy", "from_triangles"),
    "images.image": ("Image",),
    "images.surface": ("Surface",),
    "images.sampling": ("Bilinear", "CubicSpline", "Sampling"),
    "images.smoothing": ("smooth", "smoothing_radius"),
    "images.observation": (
        "Combined",
        "Curvature",
        "GradientMagnitude",
        "Intensity",
        "Observation",
        "adaptation",
        "gradient_magnitude",
        "principal_curvatures",
    ),
    "images.files": ("Channel", "ImageError", "Luminance", "elevation_model", "image_from_array", "load_image"),
    "forces.base": ("Finding", "Force", "Rule", "Scene", "Step"),
    "forces.linearisation": ("ExactTangent", "Linearisation", "Secant", "Tangent"),
    "forces.laws": ("EnergyLaw", "Hooke", "Law", "PowerLaw", "PullLaw", "TensionOnly"),
    "forces.springs": ("ExpansionRule", "Springs", "StiffnessRule"),
    "forces.contact": ("Floor",),
    "forces.adaptive": ("ImageStiffness",),
    "forces.damping": ("Dashpots", "Drag"),
    "forces.rayleigh": ("Rayleigh",),
    "forces.loads": ("Gravity", "Load"),
    "forces.data_springs": ("DataSprings", "ImageAttraction"),
    "forces.pair_laws": ("LennardJones", "PairLaw", "SlideLaw", "UnitVectorLaw", "gentle_fluid"),
    "forces.cutoffs": ("Cutoff", "NoCutoff", "PlainCutoff", "ShiftedForce", "Switched"),
    "forces.pairs": ("AllPairs", "Pairs"),
    "forces.neighbour_list": ("NeighbourList",),
    "forces.pair_drag": ("PairDrag",),
    "forces.molten": ("Molten",),
    "forces.fluid": ("Fluid",),
    "linalg.base": ("LinearSolver", "SolveInfo"),
    "linalg.cg": ("CG", "JaxCG"),
    "linalg.exact": ("ExactSolver",),
    "linalg.lineax_solver": ("Lineax",),
    "linalg.operators": ("Blocks", "NodeDyads", "SpringBlocks", "SpringMatrix"),
    "linalg.multigrid": ("Multigrid",),
    "linalg.preconditioners": ("BlockJacobi", "Jacobi", "Preconditioner", "Unpreconditioned"),
    "linalg.envelope": ("Profile",),
    "linalg.ordering": ("Natural", "Ordering", "ReverseCuthillMcKee"),
    "linalg.skyline": ("Skyline", "SkylineFactor"),
    "modes": ("Modes", "frequency_response", "normal_modes"),
    "steppers.base": ("Stepper",),
    "steppers.equilibrium": ("Equilibrium", "equilibrium"),
    "steppers.explicit": ("ForwardEuler", "RungeKutta4", "SymplecticEuler", "VelocityVerlet"),
    "steppers.implicit": ("BDF2", "BackwardEuler", "ImplicitMidpoint"),
    "steppers.newton": ("Newton",),
    "steppers.semi_implicit": ("SemiImplicit",),
    "steppers.stability": ("stable_dt",),
    "steppers.still": ("Still",),
    "thermal.backward": ("HeatIteration",),
    "thermal.boundaries": ("Convection", "FixedTemperature", "HeatFlux", "Radiation", "ThermalBoundary"),
    "thermal.cells": ("Cells", "EqualCells", "HalfCells", "capacities"),
    "thermal.conduction": ("conductances", "link_conductances"),
    "thermal.fusing": ("Fusing", "Refreezing", "melted_fraction"),
    "thermal.heat": ("Heat", "total_heat"),
    "thermal.hot_plane": ("HotPlane",),
    "thermal.latent": ("LatentHeat",),
    "thermal.ledger": ("Account", "Ledger", "energy_ledger"),
    "thermal.schemes": ("BackwardEulerHeat", "CrankNicolsonHeat", "ExplicitHeat", "HeatScheme"),
    "thermal.split": ("SplitHeat", "SymmetricSplitHeat"),
    "thermal.stiffness": ("ThermalExpansion", "ThermalStiffness"),
    "inverse.fit": ("Fit", "History", "Iteration", "fit"),
    "inverse.determined": ("Undetermined",),
    "inverse.iteration": ("GradientWarning",),
    "inverse.optimisers": ("LBFGS", "Adam", "LeastSquares", "Optax", "Optimiser"),
    "inverse.stopping": ("Stop", "StopReason"),
    "inverse.transforms": ("Bounded", "Identity", "Positive", "SoftPositive", "Transform"),
    "inverse.select": ("Selection", "select"),
    "inverse.losses": ("squared_distance",),
    "inverse.checkpoint": ("Checkpoint",),
    "inverse.check": ("GradientCheck", "check_gradient"),
    "scenes.reconstruction.scene": ("Reconstruction", "Relaxation"),
    "scenes.reconstruction.pixels": ("PixelSprings",),
    "scenes.reconstruction.fitting": ("Reconstructed", "SpringSettings", "fit_springs"),
    "scenes.reconstruction.constants": ("ConstantsSettings", "fit_constants"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME_OF)]


if TYPE_CHECKING:  # written by `python -m tests.face`
    from .vector import Vector as Vector
    from .status import Flag as Flag
    from .status import SimulationError as SimulationError
    from .status import StabilityWarning as StabilityWarning
    from .status import Status as Status
    from .status import raise_for_status as raise_for_status
    from .state import State as State
    from .system import System as System
    from .bound import BoundSystem as BoundSystem
    from .bound import Energy as Energy
    from .nodes import Motion as Motion
    from .memory import Memory as Memory
    from .masses import lumped_mass as lumped_mass
    from .edit import replace as replace
    from .resume import Resume as Resume
    from .rollouts import Result as Result
    from .rollouts import rollout as rollout
    from .ode import OdeInfo as OdeInfo
    from .ode import OdeResult as OdeResult
    from .ode import diffeqsolve as diffeqsolve
    from .blocks import Checkpointed as Checkpointed
    from .blocks import StoreAll as StoreAll
    from .blocks import StoreStates as StoreStates
    from .watch import Solves as Solves
    from .progress import Progress as Progress
    from .files import load as load
    from .files import save as save
    from .files import save_trajectory as save_trajectory
    from .export.vtk import save_vtk as save_vtk
    from .export.xyz import save_xyz as save_xyz
    from .export.ply import save_ply as save_ply
    from .archive import CheckpointError as CheckpointError
    from .plots import animate as animate
    from .plots import plot as plot
    from .topology.edge_field import EdgeField as EdgeField
    from .topology.base import Topology as Topology
    from .topology.lattice import BEND as BEND
    from .topology.lattice import BODY as BODY
    from .topology.lattice import SHEAR as SHEAR
    from .topology.lattice import STRUCTURAL as STRUCTURAL
    from .topology.lattice import Lattice as Lattice
    from .topology.lattice import lattice as lattice
    from .topology.graph import Graph as Graph
    from .topology.reduction import Gather as Gather
    from .topology.reduction import Scatter as Scatter
    from .topology.mesh_files import from_mesh as from_mesh
    from .topology.builders import delaunay as delaunay
    from .topology.builders import from_networkx as from_networkx
    from .topology.builders import from_scipy as from_scipy
    from .topology.builders import from_triangles as from_triangles
    from .images.image import Image as Image
    from .images.surface import Surface as Surface
    from .images.sampling import Bilinear as Bilinear
    from .images.sampling import CubicSpline as CubicSpline
    from .images.sampling import Sampling as Sampling
    from .images.smoothing import smooth as smooth
    from .images.smoothing import smoothing_radius as smoothing_radius
    from .images.observation import Combined as Combined
    from .images.observation import Curvature as Curvature
    from .images.observation import GradientMagnitude as GradientMagnitude
    from .images.observation import Intensity as Intensity
    from .images.observation import Observation as Observation
    from .images.observation import adaptation as adaptation
    from .images.observation import gradient_magnitude as gradient_magnitude
    from .images.observation import principal_curvatures as principal_curvatures
    from .images.files import Channel as Channel
    from .images.files import ImageError as ImageError
    from .images.files import Luminance as Luminance
    from .images.files import elevation_model as elevation_model
    from .images.files import image_from_array as image_from_array
    from .images.files import load_image as load_image
    from .forces.base import Finding as Finding
    from .forces.base import Force as Force
    from .forces.base import Rule as Rule
    from .forces.base import Scene as Scene
    from .forces.base import Step as Step
    from .forces.linearisation import ExactTangent as ExactTangent
    from .forces.linearisation import Linearisation as Linearisation
    from .forces.linearisation import Secant as Secant
    from .forces.linearisation import Tangent as Tangent
    from .forces.laws import EnergyLaw as EnergyLaw
    from .forces.laws import Hooke as Hooke
    from .forces.laws import Law as Law
    from .forces.laws import PowerLaw as PowerLaw
    from .forces.laws import PullLaw as PullLaw
    from .forces.laws import TensionOnly as TensionOnly
    from .forces.springs import ExpansionRule as ExpansionRule
    from .forces.springs import Springs as Springs
    from .forces.springs import StiffnessRule as StiffnessRule
    from .forces.contact import Floor as Floor
    from .forces.adaptive import ImageStiffness as ImageStiffness
    from .forces.damping import Dashpots as Dashpots
    from .forces.damping import Drag as Drag
    from .forces.rayleigh import Rayleigh as Rayleigh
    from .forces.loads import Gravity as Gravity
    from .forces.loads import Load as Load
    from .forces.data_springs import DataSprings as DataSprings
    from .forces.data_springs import ImageAttraction as ImageAttraction
    from .forces.pair_laws import LennardJones as LennardJones
    from .forces.pair_laws import PairLaw as PairLaw
    from .forces.pair_laws import SlideLaw as SlideLaw
    from .forces.pair_laws import UnitVectorLaw as UnitVectorLaw
    from .forces.pair_laws import gentle_fluid as gentle_fluid
    from .forces.cutoffs import Cutoff as Cutoff
    from .forces.cutoffs import NoCutoff as NoCutoff
    from .forces.cutoffs import PlainCutoff as PlainCutoff
    from .forces.cutoffs import ShiftedForce as ShiftedForce
    from .forces.cutoffs import Switched as Switched
    from .forces.pairs import AllPairs as AllPairs
    from .forces.pairs import Pairs as Pairs
    from .forces.neighbour_list import NeighbourList as NeighbourList
    from .forces.pair_drag import PairDrag as PairDrag
    from .forces.molten import Molten as Molten
    from .forces.fluid import Fluid as Fluid
    from .linalg.base import LinearSolver as LinearSolver
    from .linalg.base import SolveInfo as SolveInfo
    from .linalg.cg import CG as CG
    from .linalg.cg import JaxCG as JaxCG
    from .linalg.exact import ExactSolver as ExactSolver
    from .linalg.lineax_solver import Lineax as Lineax
    from .linalg.operators import Blocks as Blocks
    from .linalg.operators import NodeDyads as NodeDyads
    from .linalg.operators import SpringBlocks as SpringBlocks
    from .linalg.operators import SpringMatrix as SpringMatrix
    from .linalg.multigrid import Multigrid as Multigrid
    from .linalg.preconditioners import BlockJacobi as BlockJacobi
    from .linalg.preconditioners import Jacobi as Jacobi
    from .linalg.preconditioners import Preconditioner as Preconditioner
    from .linalg.preconditioners import Unpreconditioned as Unpreconditioned
    from .linalg.envelope import Profile as Profile
    from .linalg.ordering import Natural as Natural
    from .linalg.ordering import Ordering as Ordering
    from .linalg.ordering import ReverseCuthillMcKee as ReverseCuthillMcKee
    from .linalg.skyline import Skyline as Skyline
    from .linalg.skyline import SkylineFactor as SkylineFactor
    from .modes import Modes as Modes
    from .modes import frequency_response as frequency_response
    from .modes import normal_modes as normal_modes
    from .steppers.base import Stepper as Stepper
    from .steppers.equilibrium import Equilibrium as Equilibrium
    from .steppers.equilibrium import equilibrium as equilibrium
    from .steppers.explicit import ForwardEuler as ForwardEuler
    from .steppers.explicit import RungeKutta4 as RungeKutta4
    from .steppers.explicit import SymplecticEuler as SymplecticEuler
    from .steppers.explicit import VelocityVerlet as VelocityVerlet
    from .steppers.implicit import BDF2 as BDF2
    from .steppers.implicit import BackwardEuler as BackwardEuler
    from .steppers.implicit import ImplicitMidpoint as ImplicitMidpoint
    from .steppers.newton import Newton as Newton
    from .steppers.semi_implicit import SemiImplicit as SemiImplicit
    from .steppers.stability import stable_dt as stable_dt
    from .steppers.still import Still as Still
    from .thermal.backward import HeatIteration as HeatIteration
    from .thermal.boundaries import Convection as Convection
    from .thermal.boundaries import FixedTemperature as FixedTemperature
    from .thermal.boundaries import HeatFlux as HeatFlux
    from .thermal.boundaries import Radiation as Radiation
    from .thermal.boundaries import ThermalBoundary as ThermalBoundary
    from .thermal.cells import Cells as Cells
    from .thermal.cells import EqualCells as EqualCells
    from .thermal.cells import HalfCells as HalfCells
    from .thermal.cells import capacities as capacities
    from .thermal.conduction import conductances as conductances
    from .thermal.conduction import link_conductances as link_conductances
    from .thermal.fusing import Fusing as Fusing
    from .thermal.fusing import Refreezing as Refreezing
    from .thermal.fusing import melted_fraction as melted_fraction
    from .thermal.heat import Heat as Heat
    from .thermal.heat import total_heat as total_heat
    from .thermal.hot_plane import HotPlane as HotPlane
    from .thermal.latent import LatentHeat as LatentHeat
    from .thermal.ledger import Account as Account
    from .thermal.ledger import Ledger as Ledger
    from .thermal.ledger import energy_ledger as energy_ledger
    from .thermal.schemes import BackwardEulerHeat as BackwardEulerHeat
    from .thermal.schemes import CrankNicolsonHeat as CrankNicolsonHeat
    from .thermal.schemes import ExplicitHeat as ExplicitHeat
    from .thermal.schemes import HeatScheme as HeatScheme
    from .thermal.split import SplitHeat as SplitHeat
    from .thermal.split import SymmetricSplitHeat as SymmetricSplitHeat
    from .thermal.stiffness import ThermalExpansion as ThermalExpansion
    from .thermal.stiffness import ThermalStiffness as ThermalStiffness
    from .inverse.fit import Fit as Fit
    from .inverse.fit import History as History
    from .inverse.fit import Iteration as Iteration
    from .inverse.fit import fit as fit
    from .inverse.determined import Undetermined as Undetermined
    from .inverse.iteration import GradientWarning as GradientWarning
    from .inverse.optimisers import LBFGS as LBFGS
    from .inverse.optimisers import Adam as Adam
    from .inverse.optimisers import LeastSquares as LeastSquares
    from .inverse.optimisers import Optax as Optax
    from .inverse.optimisers import Optimiser as Optimiser
    from .inverse.stopping import Stop as Stop
    from .inverse.stopping import StopReason as StopReason
    from .inverse.transforms import Bounded as Bounded
    from .inverse.transforms import Identity as Identity
    from .inverse.transforms import Positive as Positive
    from .inverse.transforms import SoftPositive as SoftPositive
    from .inverse.transforms import Transform as Transform
    from .inverse.select import Selection as Selection
    from .inverse.select import select as select
    from .inverse.losses import squared_distance as squared_distance
    from .inverse.checkpoint import Checkpoint as Checkpoint
    from .inverse.check import GradientCheck as GradientCheck
    from .inverse.check import check_gradient as check_gradient
    from .scenes.reconstruction.scene import Reconstruction as Reconstruction
    from .scenes.reconstruction.scene import Relaxation as Relaxation
    from .scenes.reconstruction.pixels import PixelSprings as PixelSprings
    from .scenes.reconstruction.fitting import Reconstructed as Reconstructed
    from .scenes.reconstruction.fitting import SpringSettings as SpringSettings
    from .scenes.reconstruction.fitting import fit_springs as fit_springs
    from .scenes.reconstruction.constants import ConstantsSettings as ConstantsSettings
    from .scenes.reconstruction.constants import fit_constants as fit_constants
else:

    def __getattr__(name: str) -> Any:
        home = _HOME_OF.get(name)
        if home is None:
            raise AttributeError(f"module 'jaxspring' has no attribute {name!r}")
        value = getattr(importlib.import_module(f".{home}", __name__), name)
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME_OF])
