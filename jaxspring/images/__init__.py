"""Images: sampling between pixels, smoothing, observation functions, loading. Source of the physics: slides "Adaptive Meshes"."""

from .files import MAX_PIXELS, Channel, ImageError, Luminance, elevation_model, image_from_array, load_image
from .image import Image, Surface
from .observation import (
    Combined,
    Curvature,
    GradientMagnitude,
    Intensity,
    Observation,
    adaptation,
    gradient_magnitude,
    image_gradient,
    principal_curvatures,
)
from .sampling import Bilinear, CubicSpline, Sampling
from .smoothing import smooth, smoothing_radius

__all__ = [
    "MAX_PIXELS",
    "Bilinear",
    "Channel",
    "Combined",
    "CubicSpline",
    "Curvature",
    "GradientMagnitude",
    "Image",
    "ImageError",
    "Intensity",
    "Luminance",
    "Observation",
    "Sampling",
    "Surface",
    "adaptation",
    "elevation_model",
    "gradient_magnitude",
    "image_from_array",
    "image_gradient",
    "load_image",
    "principal_curvatures",
    "smooth",
    "smoothing_radius",
]
