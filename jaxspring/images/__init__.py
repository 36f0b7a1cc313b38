"""Images: sampling between pixels, smoothing, observation functions, loading. Source of the physics: slides "Adaptive Meshes"."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .surface import Surface as Surface
    from .sampling import Bilinear as Bilinear
    from .sampling import CubicSpline as CubicSpline
    from .sampling import Sampling as Sampling
    from .smoothing import smooth as smooth
    from .smoothing import smoothing_radius as smoothing_radius
    from .observation import Combined as Combined
    from .observation import Curvature as Curvature
    from .observation import GradientMagnitude as GradientMagnitude
    from .observation import Intensity as Intensity
    from .observation import Observation as Observation
    from .observation import adaptation as adaptation
    from .observation import gradient_magnitude as gradient_magnitude
    from .observation import principal_curvatures as principal_curvatures
    from .files import ImageError as ImageError
    from .files import elevation_model as elevation_model
    from .files import image_from_array as image_from_array
    from .channels import Channel as Channel
    from .channels import Luminance as Luminance
    from .channels import TerrainRGB as TerrainRGB
    from .channels import Terrarium as Terrarium
    from .holes import Holes as Holes
    from .maps import Map as Map
    from .maps import load_map as load_map
    from .points import PointCloud as PointCloud
    from .point_files import load_points as load_points
    from .image import Image as Image
    from .files import load_image as load_image
else:
    __all__, __getattr__, __dir__ = _face(__name__)
