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
else:
    __all__, __getattr__, __dir__ = _face(__name__)
