"""The doors of the library in one place: every public name that takes arrays, how it is built from them, and names that take none.

A door is a function of arrays by field name, with good values for them. `tests/api/test_doors.py` fails where a public name stands neither
here nor among those that take no array of the user's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js


@dataclass(frozen=True)
class Door:
    """How one public name is built from arrays.

    Attributes:
        build: fields -> what holds their values.
        fields: good values.
        on_host: fields that decide on shapes or are read by the host, and so can never be traced.
    """

    build: Callable[..., Any]
    fields: dict[str, Any]
    on_host: tuple[str, ...] = ()


N, E = 4, 3
TRIANGLES = np.array([[0, 1, 2], [1, 2, 3]])
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.1, 1.0]])
TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
PIXELS = np.arange(1.0, 31.0).reshape(5, 6)
PATTERN = np.array([True, False, True, True])


def net() -> js.Lattice:
    """A chain of four nodes."""
    return js.lattice(N)


def sheet() -> js.Graph:
    """Two triangles of four nodes."""
    return js.from_triangles(TRIANGLES, N)


def image() -> js.Image:
    """A good image."""
    return js.Image(PIXELS)


def system(**forces) -> js.System:
    """Springs on the chain."""
    return js.System(net(), 1.0, js.Springs(net(), 5.0, 1.0))


def state() -> js.State:
    """The chain at rest."""
    return js.State.from_points(net(), 1.1 * net().grid())


def per_node(seed: float = 1.0) -> np.ndarray:
    """(N,) values above zero."""
    return seed + 0.25 * np.arange(N)


def per_spring(seed: float = 1.0) -> np.ndarray:
    """(E,) values above zero."""
    return seed + 0.5 * np.arange(E)


def number(value: float) -> np.ndarray:
    """One number as an array without axes."""
    return np.asarray(value)


OVER = np.array([[0.0, 0.0], [5.0, 0.0], [0.0, 4.0], [5.0, 4.0]])  # corners of the image

DOORS: dict[str, Door] = {
    "AngularJoints": Door(
        lambda **a: js.cloth.AngularJoints(js.lattice(N), **a),
        {
            "stiffness": np.array([1.0, 2.0]),
            "joints": np.array([[0, 1, 2], [1, 2, 3]]),
            "clamp": np.array([1.0, 0.5]),
            "ends": np.array([[0, 1]]),
            "clamp_stiffness": number(3.0),
        },
        on_host=("joints", "ends"),
    ),
    "Box": Door(js.contact.Box, {"centre": np.array([0.0, 1.0]), "half_sizes": np.array([1.0, 2.0])}),
    "Capsule": Door(js.contact.Capsule, {"a": np.array([0.0, 1.0]), "b": np.array([1.0, 2.0]), "radius": number(0.5)}),
    "Air": Door(
        lambda **a: js.cloth.Air(sheet(), **a),
        {
            "drag": np.array([1.0, 2.0]),
            "friction": np.array([0.25, 0.5]),
            "lift": np.array([0.25, 0.5]),
            "viscous": np.array([0.25, 0.5]),
            "density": number(1.25),
            "wind": np.array([1.0, 2.0, 3.0]),
            "triangles": TRIANGLES,
        },
        on_host=("triangles",),
    ),
    "Actuation": Door(
        lambda **a: js.robot.Actuation(repr, **a),
        {"groups": np.array([0, -1, 1]), "low": number(0.5), "high": number(1.25)},
        on_host=("groups",),
    ),
    "Combined": Door(
        lambda weights: js.images.Combined((js.images.Intensity(), js.images.Curvature()), weights), {"weights": np.array([1.0, 2.0])}
    ),
    "Contact": Door(
        lambda **a: js.contact.Contact(js.contact.Sphere((0.0, 0.0), 1.0), **a), {"friction": number(0.25), "restitution": number(0.5)}
    ),
    "ChoiKo": Door(js.cloth.ChoiKo, {"bending": number(0.5)}),
    "Convection": Door(
        lambda **a: js.thermal.Convection(net(), **a),
        {"nodes": PATTERN, "coefficient": per_node(), "ambient": per_node(280), "area": per_node()},
    ),
    "Cylinder": Door(js.contact.Cylinder, {"a": np.array([0.0, 1.0]), "b": np.array([1.0, 2.0]), "radius": number(0.5)}),
    "Dashpots": Door(lambda damping: js.Dashpots(net(), damping), {"damping": per_spring()}),
    "DataSprings": Door(lambda stiffness: js.DataSprings(image(), stiffness), {"stiffness": per_node()}),
    "Drag": Door(js.Drag, {"gamma": per_node()}),
    "EdgeField": Door(lambda value: js.topology.EdgeField((value,)), {"value": per_spring()}),
    "Disc": Door(js.lens.Disc, {"centre": np.array([3.0, 4.0]), "radius": number(2.0), "magnification": number(1.5), "rim": number(0.5)}),
    "FixedTemperature": Door(lambda **a: js.thermal.FixedTemperature(net(), **a), {"nodes": PATTERN, "temperature": per_node(300)}),
    "Floor": Door(
        js.Floor,
        {"point": np.array([0.0, 1.0]), "normal": np.array([0.0, 2.0]), "friction": number(0.25), "restitution": number(0.5)},
    ),
    "Fluid": Door(lambda core: js.Fluid(js.fluid.SlideLaw(1.0, 1.0), core=core), {"core": number(0.125)}),
    "FAST": Door(
        js.cloth.FAST,
        {
            "weight": number(120.0),
            "extension": np.array([1.5, 3.0]),
            "bias": number(2.5),
            "bending_length": np.array([18.0, 16.0]),
        },
    ),
    "Fabric": Door(
        js.cloth.Fabric,
        {
            "density": number(0.25),
            "stretch": np.array([100.0, 50.0]),
            "shear": number(20.0),
            "bending": np.array([0.5, 0.25]),
            "coupling": number(10.0),
        },
    ),
    "Fusing": Door(lambda melting: js.Fusing(net(), melting), {"melting": number(350.0)}),
    "Graph": Door(
        lambda edges, triangles, box: js.Graph.from_edges(edges, N, triangles=triangles, box=box),
        {"edges": np.array([[0, 1], [1, 2], [2, 3]]), "triangles": TRIANGLES, "box": np.array([8.0, 9.0])},
        on_host=("edges", "triangles"),
    ),
    "Gravity": Door(js.Gravity, {"acceleration": np.array([0.0, -9.5]), "mass": per_node()}),
    "HalfSpaces": Door(js.contact.HalfSpaces, {"points": np.zeros((2, 2)), "normals": np.array([[0.0, 1.0], [2.0, 0.0]])}),
    "Heat": Door(lambda **a: js.Heat(net(), **a), {"capacity": per_node(), "conductance": per_spring(), "source": per_node()}),
    "HeatFlux": Door(lambda **a: js.thermal.HeatFlux(net(), **a), {"nodes": PATTERN, "flux": per_node(), "area": per_node()}),
    "Hinges": Door(
        lambda **a: js.cloth.Hinges(js.lattice(N), **a),
        {"stiffness": number(2.0), "rest_angle": np.array([0.5]), "triangles": TRIANGLES},
        on_host=("triangles",),
    ),
    "HotPlane": Door(
        js.thermal.HotPlane,
        {
            "point": np.array([0.0, 1.0]),
            "normal": np.array([0.0, 2.0]),
            "temperature": number(400.0),
            "coefficient": number(3.0),
            "area": per_node(),
            "reach": number(0.5),
            "fade": number(0.25),
        },
    ),
    "HotSurface": Door(
        lambda **a: js.thermal.HotSurface(js.contact.Sphere((0.0, 0.0), 1.0), **a),
        {
            "temperature": number(400.0),
            "coefficient": number(3.0),
            "area": per_node(),
            "reach": number(0.5),
            "fade": number(0.25),
        },
    ),
    "Image": Door(js.Image, {"values": PIXELS, "spacing": np.array([1.0, 2.0]), "origin": np.array([0.5, 0.25]), "weights": PIXELS}),
    "PointCloud": Door(
        js.images.PointCloud,
        {"points": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0]]), "weights": np.array([1.0, 2.0, 3.0])},
        on_host=("points", "weights"),
    ),
    "ImageAttraction": Door(lambda strength: js.ImageAttraction(image(), strength), {"strength": number(2.0)}),
    "ImageStiffness": Door(
        lambda **a: js.ImageStiffness(image(), radius=4, **a), {"k_min": number(1.0), "k_max": number(9.0), "sigma": number(1.0)}
    ),
    "Importance": Door(lambda magnification: js.lens.Importance(js.Image(PIXELS / 30), magnification), {"magnification": number(1.5)}),
    "KES": Door(
        js.cloth.KES,
        {
            "weight": number(18.0),
            "extension": np.array([4.0, 6.0]),
            "shear": number(0.5),
            "bending": np.array([0.5, 0.25]),
        },
    ),
    "LatentHeat": Door(js.thermal.LatentHeat, {"melting": per_node(350), "latent": per_node()}),
    "LennardJones": Door(js.fluid.LennardJones, {"epsilon": number(2.0), "sigma": number(0.5)}),
    "Load": Door(lambda forces: js.Load.from_points(net(), forces), {"forces": np.arange(8.0).reshape(N, 2)}),
    "MeshField": Door(
        js.contact.MeshField,
        {
            "vertices": np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
            "faces": np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
            "spacing": number(0.5),
        },
        on_host=("vertices", "faces", "spacing"),
    ),
    "Motion": Door(lambda moved: js.Motion(moved, lambda t: js.Vector((t,))), {"moved": PATTERN}),
    "NeighbourList": Door(lambda skin: js.fluid.NeighbourList(8, skin), {"skin": number(0.5)}),
    "NodeContact": Door(
        lambda **a: js.contact.NodeContact(net(), **a),
        {
            "radius": per_node(),
            "stiffness": number(2.0),
            "damping": number(0.5),
            "friction": number(0.25),
            "onset": number(0.125),
            "creep": number(0.5),
            "rest": np.arange(8.0).reshape(N, 2),
        },
    ),
    "PairDrag": Door(js.fluid.PairDrag, {"damping": number(2.0), "radius": number(1.5)}),
    "Penalty": Door(
        lambda **a: js.contact.Penalty(js.contact.Sphere((0.0, 0.0), 1.0), **a),
        {
            "stiffness": per_node(),
            "damping": per_node(),
            "friction": per_node(),
            "onset": number(0.125),
            "creep": number(0.5),
        },
    ),
    "Oscillators": Door(js.robot.Oscillators, {"amplitude": per_spring(), "phase": per_spring(0.5), "frequency": number(2.0)}),
    "PixelSprings": Door(lambda stiffness: js.reconstruction.PixelSprings(cast(Any, None), stiffness), {"stiffness": number(2.0)}),
    "Plane": Door(js.contact.Plane, {"point": np.array([0.0, 1.0]), "normal": np.array([0.0, 2.0])}),
    "PlasticHinges": Door(lambda **a: js.cloth.PlasticHinges(net(), **a), {"yield_angle": np.array([0.5, 0.25]), "hardening": number(0.5)}),
    "Polygon": Door(js.lens.Polygon, {"corners": SQUARE[[0, 1, 3, 2]], "magnification": number(1.5), "rim": number(0.5)}),
    "PlainCutoff": Door(js.fluid.PlainCutoff, {"radius": number(2.5)}),
    "Pressure": Door(
        lambda **a: js.cloth.Pressure(sheet(), **a),
        {
            "points": CORNER,
            "pressure": number(10.0),
            "volume": number(0.25),
            "ambient": number(100.0),
            "triangles": TETRAHEDRON,
        },
        on_host=("points", "triangles"),
    ),
    "Radiation": Door(
        lambda **a: js.thermal.Radiation(net(), **a),
        {"nodes": PATTERN, "emissivity": per_node(0.125), "ambient": per_node(280), "area": per_node()},
    ),
    "Rayleigh": Door(js.Rayleigh, {"mass_rate": number(0.5), "stiffness_time": number(0.25), "mass": per_node()}),
    "Refreezing": Door(js.thermal.Refreezing, {"hysteresis": number(5.0), "reach": number(1.5)}),
    "ShiftedForce": Door(js.fluid.ShiftedForce, {"radius": number(2.5)}),
    "SlideLaw": Door(js.fluid.SlideLaw, {"alpha": number(1.0), "beta": number(2.0), "zeta": number(0.5)}),
    "Sphere": Door(js.contact.Sphere, {"centre": np.array([0.0, 1.0]), "radius": number(0.5)}),
    "Springs": Door(lambda **a: js.Springs(net(), **a), {"stiffness": per_spring(), "rest_length": per_spring(0.5)}),
    "State": Door(
        lambda **a: js.State.from_points(net(), **a),
        {
            "points": np.arange(8.0).reshape(N, 2),
            "velocities": np.arange(8.0).reshape(N, 2),
            "time": number(1.5),
            "temperature": per_node(300),
        },
    ),
    "Stiffening": Door(js.cloth.Stiffening, {"strain": number(0.1), "factor": number(20.0), "band": number(0.05)}),
    "StrainLimit": Door(lambda **a: js.cloth.StrainLimit(net(), **a), {"strain": per_spring(), "tolerance": number(0.01)}),
    "Switched": Door(js.fluid.Switched, {"on": number(2.0), "off": number(2.5)}),
    "System": Door(lambda **a: js.System(net(), **a), {"mass": per_node(), "free": PATTERN}),
    "ThermalExpansion": Door(js.thermal.ThermalExpansion, {"coefficient": number(0.5), "reference": number(300.0)}),
    "ThermalStiffness": Door(
        js.thermal.ThermalStiffness,
        {"stiffness": per_spring(), "softening": number(300.0), "melting": number(400.0), "sharpness": number(2.0)},
    ),
    "Tearing": Door(lambda **a: js.plasticity.Tearing(net(), **a), {"strain": per_spring(), "band": per_spring(0.5)}),
    "UnitVectorLaw": Door(js.fluid.UnitVectorLaw, {"alpha": number(1.0), "beta": number(2.0), "zeta": number(0.5)}),
    "Vector": Door(lambda value: js.Vector((value, value)), {"value": per_node()}),
    "Yielding": Door(
        lambda **a: js.plasticity.Yielding(net(), **a), {"yield_force": per_spring(), "hardening": per_spring(), "viscosity": per_spring()}
    ),
    "adaptation": Door(lambda sigma: js.images.adaptation(image(), sigma, radius=4), {"sigma": number(1.0)}),
    "capacities": Door(
        lambda **a: js.thermal.capacities(net(), **a),
        {"density": per_node(), "specific_heat": per_node(), "spacing": number(0.5), "section": number(2.0)},
    ),
    "conductances": Door(
        lambda **a: js.thermal.conductances(net(), **a), {"conductivity": per_node(), "spacing": number(0.5), "section": number(2.0)}
    ),
    "delaunay": Door(js.delaunay, {"points": SQUARE}, on_host=("points",)),
    "examine": Door(
        lambda **a: jnp.asarray(js.cloth.examine(sheet(), **a).volumes),
        {"points": CORNER, "triangles": TETRAHEDRON},
        on_host=("points", "triangles"),
    ),
    "fabric": Door(
        lambda points: js.cloth.fabric(js.lattice((3, 3), js.STRUCTURAL + js.SHEAR), points, js.cloth.DENIM).mass,
        {"points": js.lattice((3, 3)).grid(0.5)},
        on_host=("points",),
    ),
    "from_scipy": Door(js.topology.from_scipy, {"matrix": np.array([[0.0, 2.0], [2.0, 0.0]])}, on_host=("matrix",)),
    "from_triangles": Door(lambda triangles: js.from_triangles(triangles, N), {"triangles": TRIANGLES}, on_host=("triangles",)),
    "gentle_fluid": Door(js.fluid.gentle_fluid, {"spacing": number(0.5), "zeta": number(0.25), "alpha": number(2.0)}),
    "image_from_array": Door(js.images.image_from_array, {"pixels": PIXELS}),
    "lattice": Door(lambda box: js.lattice((4, 4), periodic=True, box=box), {"box": np.array([4.0, 4.0])}),
    "link_conductances": Door(
        lambda **a: js.thermal.link_conductances(net(), **a), {"conductivity": per_node(), "area": per_spring(), "length": per_spring()}
    ),
    "lumped_mass": Door(
        lambda **a: js.lumped_mass(js.from_triangles(TRIANGLES, N), **a),
        {"points": SQUARE, "density": number(2.0), "triangles": TRIANGLES},
        on_host=("triangles",),
    ),
    "outline": Door(lambda polygon: js.cloth.outline(polygon, 0.5)[0].ends, {"polygon": SQUARE[[0, 1, 3, 2]]}, on_host=("polygon",)),
    "provot": Door(
        lambda **a: js.cloth.provot((3, 3), 0.5, **a)[2].stiffness,
        {"stretch": np.array([100.0, 50.0]), "shear": number(20.0), "flexion": np.array([2.0, 1.0])},
    ),
    "ramped": Door(lambda part: js.lens.ramped(js.lens.Disc((3.0, 4.0), 2.0, 1.5), part), {"part": number(0.5)}),
    "replace": Door(lambda **a: js.replace(system(), **a), {"stiffness": per_spring(), "rest_length": per_spring(), "mass": per_node()}),
    "rollout": Door(lambda dt: js.rollout(system(), state(), js.SymplecticEuler(), dt, 2).state, {"dt": number(0.0625)}),
    "rewound": Door(lambda points: js.cloth.rewound(sheet(), points).ends, {"points": CORNER}, on_host=("points",)),
    "smooth": Door(lambda sigma: js.images.smooth(image(), sigma, radius=4), {"sigma": number(1.0)}),
    "walking_robot": Door(
        lambda **a: js.robot.walking_robot(net=js.from_triangles(TRIANGLES, N), **a),
        {"points": SQUARE, "groups": np.array([0, 1, -1, 0, 1])},
        on_host=("groups",),
    ),
    "SlidingBorder": Door(
        lambda **a: js.reconstruction.SlidingBorder(sheet(), **a), {"points": SQUARE, "corner": number(2.0)}, on_host=("points", "corner")
    ),
    "Tin": Door(
        lambda **a: jnp.asarray(js.reconstruction.Tin(**a).points),
        {"points": CORNER, "triangles": TETRAHEDRON},
        on_host=("points", "triangles"),
    ),
    "active_contour": Door(
        lambda **a: js.reconstruction.active_contour(image(), sigma=1.0, radius=4, **a),
        {"points": OVER, "tension": per_node(), "bending": per_node(), "strength": number(2.0)},
        on_host=("points",),
    ),
    "bound_error": Door(
        lambda **a: jnp.asarray(js.reconstruction.bound_error(image(), **a).tin.points),
        {"points": OVER, "triangles": TRIANGLES, "bound": number(0.5)},
        on_host=("points", "triangles", "bound"),
    ),
    "break_surface": Door(
        lambda **a: jnp.asarray(js.reconstruction.break_surface(image(), **a).drawn),
        {"points": OVER, "triangles": TRIANGLES, "step": number(40.0), "smoothing": number(2.0)},
        on_host=("points", "triangles", "step", "smoothing"),
    ),
    "find_breaks": Door(
        lambda **a: jnp.asarray(js.reconstruction.find_breaks(net(), **a).heights),
        {
            "points": np.arange(4.0)[:, None],
            "data": per_node(),
            "stiffness": per_spring(),
            "data_stiffness": per_node(),
            "step": number(9.0),
        },
        on_host=("points", "data", "stiffness", "data_stiffness", "step"),
    ),
    "fit_shell": Door(
        lambda **a: jnp.asarray(js.reconstruction.fit_shell(n_levels=0, **a).points),
        {"data": CORNER + 0.125, "points": CORNER, "triangles": TETRAHEDRON, "stiffness": number(0.5)},
        on_host=("data", "points", "triangles", "stiffness"),
    ),
    "fitted_tin": Door(
        lambda **a: jnp.asarray(js.reconstruction.fitted_tin(image(), **a).points),
        {"points": OVER, "triangles": TRIANGLES},
        on_host=("points", "triangles"),
    ),
    "icosahedron": Door(lambda radius: jnp.asarray(js.reconstruction.icosahedron(radius)[0]), {"radius": number(2.0)}, on_host=("radius",)),
    "refine_by_error": Door(
        lambda **a: jnp.asarray(js.reconstruction.refine_by_error(image(), n_nodes=9, **a).stiffness),
        {"points": OVER, "triangles": TRIANGLES, "stiffness": np.arange(1.0, 6.0)},
        on_host=("points", "triangles", "stiffness"),
    ),
    "step_stiffness": Door(js.reconstruction.step_stiffness, {"stiffness": per_spring(), "data_stiffness": per_spring(0.25)}),
    "squared_distance": Door(lambda target: js.squared_distance(jnp.zeros((N, 2)), target), {"target": np.arange(8.0).reshape(N, 2)}),
}

# Doors whose work is too long for every form of every field: tested by hand below or elsewhere.
BY_HAND = {
    "by_rest_lengths",
    "diffeqsolve",
    "fit",
    "fit_triangles",
    "check_gradient",
    "frequency_response",
    "from_networkx",
    "ground_of_points",
    "plot",
    "point_heights",
    "rest_length_system",
    "save_obj",
    "save_ply",
    "save_stl",
    "save_tin",
    "save_vtk",
    "save_xyz",
}

# What the library makes and hands out; nobody else builds it.
MADE_INSIDE = """
    Account Blocks Body BoundedSurface BoundSystem Breaks BrokenSurface CellDyads Certificate Cloth ClothScene
    Creased Energy Equilibrium Finding Fit GradientCheck Ground History Impulse Iteration Map Memory MeshReport
    Modes Moduli NetBatch NodeDyads OdeInfo OdeResult Onset Overlay PlanarFit PointSurface Profile Reconstructed
    Refined Result Resume Scene Selection Shell SkylineFactor SolveInfo Solves SpringBlocks SpringMatrix Status
    Step Subdivision Surface SurfaceErrors Torn Undetermined Warp Yielded
"""

# Objects made of options, other objects, functions or files: no array of the user's enters.
NO_ARRAYS = """
    Adam AllPairs BDF2 BackwardEuler BackwardEulerHeat Bilinear BlockJacobi Bounded CG Cells Channel Checkpoint
    CheckpointError Checkpointed ClothSettings ConstantsSettings CrankNicolsonHeat CubicSpline Curvature Cutoff
    EnergyLaw EqualCells ExactSolver ExactTangent ExpansionRule ExplicitHeat Flag Focus Force ForwardEuler
    GradientMagnitude GradientWarning GroundSettings HalfCells HeatIteration HeatScheme HeightField Holes Hooke
    Identity ImageError ImplicitMidpoint Impulses Intensity Jacobi JaxCG Lattice Law LBFGS LeastSquares Ledger Lens
    LinearSolver
    Linearisation Lineax Luminance Molten Moving Multigrid Natural NeuralController Newton NoCutoff Observation
    Obstacle Optax Optimiser Ordering PairLaw Pairs PlanarSettings PointSettings Positive PowerLaw Preconditioner Progress Published PullLaw
    Reconstruction Relaxation ReverseCuthillMcKee Robot RobotSettings Rule RungeKutta4 Sampling Secant SemiImplicit
    SignedDistance SimulationError Skyline SoftPositive SplitHeat SpringSettings StabilityWarning Stepper
    StiffnessRule Still Stop StopReason StoreAll StoreStates SymmetricSplitHeat SymplecticEuler Tangent TensionOnly
    TerrainRGB Terrarium ThermalBoundary Topology Transform Unpreconditioned VelocityVerlet animate batch body_of_cells cantilever cusick
    disc distance domain drape_coefficient elevation_model energy_ledger equilibrium fit_constants fit_points fit_springs flag
    from_mesh gradient_magnitude hanging impulses load load_image load_map load_points melted_fraction normal_modes on_ball on_table
    pad_nets principal_curvatures push_out raise_for_status rectangle save save_trajectory select smoothing_radius
    stable_dt swap_sides total_heat train walk
"""


def at_offset(template: np.ndarray, dtype: np.dtype, offset: int) -> np.ndarray:
    """A copy of the array that begins `offset` bytes after a multiple of 64; floats in `dtype`."""
    kind = dtype if template.dtype.kind == "f" else template.dtype
    n_bytes = template.size * np.dtype(kind).itemsize
    room = np.zeros(n_bytes + 128, np.uint8)
    start = (-room.ctypes.data) % 64 + offset
    copy = room[start : start + n_bytes].view(kind).reshape(template.shape)
    copy[...] = template
    return copy


def spoil(array: np.ndarray) -> None:
    """Other values in the same array."""
    array[...] = ~array if array.dtype == bool else array + 1


def snapshot(built: Any) -> list[np.ndarray]:
    """Copies of all arrays that an object holds."""
    return [np.array(leaf) for leaf in jax.tree.leaves(built) if eqx.is_array(leaf)]
