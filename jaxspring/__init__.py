"""Differentiable mass-spring physics on JAX: springs, damping, data springs to images, adaptive meshes.

Every public name is loaded on first use, so that `import jaxspring` costs little more than `import jax`.
"""

from __future__ import annotations

import importlib
from typing import Any

from ._version import __version__

_HOMES = {
    "vector": ("Vector",),
    "status": ("Flag", "SimulationError", "StabilityWarning", "Status", "raise_for_status"),
    "state": ("State",),
    "system": ("Energy", "Motion", "System"),
    "masses": ("lumped_mass",),
    "edit": ("replace",),
    "resume": ("Resume",),
    "rollouts": ("Result", "rollout"),
    "ode": ("OdeInfo", "OdeResult", "diffeqsolve"),
    "blocks": ("Checkpointed", "StoreAll", "StoreStates"),
    "watch": ("Solves",),
    "progress": ("Progress",),
    "files": ("load", "save", "save_trajectory"),
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
    "forces.base": ("Finding", "Force"),
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


def __getattr__(name: str) -> Any:
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'jaxspring' has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{home}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME_OF])
