"""Differentiable mass-spring physics on JAX: springs, damping, data springs to images, adaptive meshes.

Every public name is loaded on first use, so that `import jaxspring` costs little more than `import jax`. What most scenes need is here;
what experts choose is in `jaxspring.linalg`, `.images`, `.thermal`, `.fluid`, `.inverse`, `.reconstruction`, `.robot`, `.steppers` and
`.topology`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face
from ._version import __version__ as __version__

if TYPE_CHECKING:  # written by `python -m tests.face`
    from . import cloth as cloth
    from . import contact as contact
    from . import fluid as fluid
    from . import images as images
    from . import inverse as inverse
    from . import lens as lens
    from . import linalg as linalg
    from . import plasticity as plasticity
    from . import reconstruction as reconstruction
    from . import robot as robot
    from . import steppers as steppers
    from . import thermal as thermal
    from . import topology as topology
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
    from .batching import batch as batch
    from .sharing import domain as domain
    from .ode import OdeInfo as OdeInfo
    from .ode import OdeResult as OdeResult
    from .ode import diffeqsolve as diffeqsolve
    from .blocks import Checkpointed as Checkpointed
    from .blocks import StoreAll as StoreAll
    from .blocks import StoreStates as StoreStates
    from .progress import Progress as Progress
    from .files import load as load
    from .files import save as save
    from .files import save_trajectory as save_trajectory
    from .archive import CheckpointError as CheckpointError
    from .plots import animate as animate
    from .plots import plot as plot
    from .export.vtk import save_vtk as save_vtk
    from .export.xyz import save_xyz as save_xyz
    from .export.ply import save_ply as save_ply
    from .topology.lattice import BEND as BEND
    from .topology.lattice import BODY as BODY
    from .topology.lattice import SHEAR as SHEAR
    from .topology.lattice import STRUCTURAL as STRUCTURAL
    from .topology.lattice import Lattice as Lattice
    from .topology.lattice import lattice as lattice
    from .topology.graph import Graph as Graph
    from .topology.mesh_files import from_mesh as from_mesh
    from .topology.builders import delaunay as delaunay
    from .topology.builders import from_triangles as from_triangles
    from .images.image import Image as Image
    from .images.files import load_image as load_image
    from .forces.base import Finding as Finding
    from .forces.base import Force as Force
    from .forces.base import Rule as Rule
    from .forces.base import Scene as Scene
    from .forces.base import Step as Step
    from .forces.laws import EnergyLaw as EnergyLaw
    from .forces.laws import Hooke as Hooke
    from .forces.laws import Law as Law
    from .forces.laws import PowerLaw as PowerLaw
    from .forces.laws import PullLaw as PullLaw
    from .forces.laws import TensionOnly as TensionOnly
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
    from .forces.fluid import Fluid as Fluid
    from .linalg.cg import CG as CG
    from .linalg.cg import JaxCG as JaxCG
    from .linalg.skyline import Skyline as Skyline
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
    from .thermal.fusing import Fusing as Fusing
    from .thermal.heat import Heat as Heat
    from .thermal.ledger import Ledger as Ledger
    from .thermal.ledger import energy_ledger as energy_ledger
    from .inverse.fit import Fit as Fit
    from .inverse.fit import fit as fit
    from .inverse.optimisers import LBFGS as LBFGS
    from .inverse.optimisers import Adam as Adam
    from .inverse.optimisers import LeastSquares as LeastSquares
    from .inverse.stopping import Stop as Stop
    from .inverse.transforms import Bounded as Bounded
    from .inverse.transforms import Positive as Positive
    from .inverse.select import select as select
    from .inverse.losses import squared_distance as squared_distance
    from .inverse.checkpoint import Checkpoint as Checkpoint
    from .inverse.check import check_gradient as check_gradient
else:
    __all__, __getattr__, __dir__ = _face(__name__)
    __all__ = ["__version__", *__all__]
