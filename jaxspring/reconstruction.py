"""Adaptive surface reconstruction: a spring mesh adapts to an image and recovers it as a piecewise linear surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .scenes.reconstruction.scene import Reconstruction as Reconstruction
    from .scenes.reconstruction.scene import Relaxation as Relaxation
    from .scenes.reconstruction.pixels import PixelSprings as PixelSprings
    from .scenes.reconstruction.fitting import Reconstructed as Reconstructed
    from .scenes.reconstruction.fitting import SpringSettings as SpringSettings
    from .scenes.reconstruction.fitting import fit_springs as fit_springs
    from .scenes.reconstruction.constants import ConstantsSettings as ConstantsSettings
    from .scenes.reconstruction.constants import fit_constants as fit_constants
    from .scenes.reconstruction.points import PointSettings as PointSettings
    from .scenes.reconstruction.points import PointSurface as PointSurface
    from .scenes.reconstruction.points import fit_points as fit_points
    from .scenes.reconstruction.points import point_heights as point_heights
    from .scenes.reconstruction.ground import Ground as Ground
    from .scenes.reconstruction.ground import GroundSettings as GroundSettings
    from .scenes.reconstruction.ground import ground_of_points as ground_of_points
    from .scenes.reconstruction.breaks import Breaks as Breaks
    from .scenes.reconstruction.breaks import find_breaks as find_breaks
    from .scenes.reconstruction.breaks import step_stiffness as step_stiffness
    from .scenes.reconstruction.pieces import BrokenSurface as BrokenSurface
    from .scenes.reconstruction.pieces import break_surface as break_surface
    from .scenes.reconstruction.tin import SurfaceErrors as SurfaceErrors
    from .scenes.reconstruction.tin import Tin as Tin
    from .scenes.reconstruction.tin import fitted_tin as fitted_tin
    from .scenes.reconstruction.refine import Subdivision as Subdivision
    from .scenes.reconstruction.bounded import BoundedSurface as BoundedSurface
    from .scenes.reconstruction.bounded import bound_error as bound_error
    from .scenes.reconstruction.tin_files import save_tin as save_tin
    from .scenes.reconstruction.border import SlidingBorder as SlidingBorder
    from .scenes.reconstruction.planar import PlanarFit as PlanarFit
    from .scenes.reconstruction.planar import PlanarSettings as PlanarSettings
    from .scenes.reconstruction.planar import fit_triangles as fit_triangles
    from .scenes.reconstruction.refined import Refined as Refined
    from .scenes.reconstruction.refined import refine_by_error as refine_by_error
    from .scenes.reconstruction.swaps import swap_sides as swap_sides
    from .scenes.reconstruction.shell import Shell as Shell
    from .scenes.reconstruction.shell import fit_shell as fit_shell
    from .scenes.reconstruction.shell import icosahedron as icosahedron
    from .scenes.reconstruction.contour import active_contour as active_contour
else:
    __all__, __getattr__, __dir__ = _face(__name__)
