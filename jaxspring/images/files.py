"""Loading images: PNG, JPEG and TIFF through Pillow, NumPy `.npy` and `.npz` files, plain arrays, and the elevation model of matplotlib.

Files are not trusted. The kind is read from the first bytes, not from the name; the size that a header claims is checked before anything is
decoded or allocated; arrays are never unpickled. Whatever is wrong with a file is one `ImageError` with one line.
"""

from __future__ import annotations

import os
import stat
import warnings
from typing import Any

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .image import Image, PerAxis
from .numpy_files import read_npy, read_npz

MAX_PIXELS = 64_000_000
"""Largest image that is loaded unless told otherwise: 64 million pixels are 0.5 GB in float64."""


class ImageError(ValueError):
    """An image file that cannot be used: missing, damaged, too large, of the wrong shape, or with pixels that are not finite.

    The message is one line that names the file, what is wrong and what to do.
    """


class Channel(eqx.Module):
    """Take one channel of a colour image by its index: 0, 1, 2 are red, green, blue; of two channels, 0 is grey and 1 is opacity."""

    index: int = eqx.field(static=True)

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, n_channels)` to `(ny, nx)`."""
        n_channels = pixels.shape[-1]
        if not -n_channels <= self.index < n_channels:
            raise ValueError(f"Channel({self.index}) does not exist: shape {pixels.shape} has channels 0 to {n_channels - 1}.")
        return pixels[..., self.index]


class Luminance(eqx.Module):
    """Grey from colour by the weights 0.299, 0.587, 0.114 of red, green, blue (ITU-R BT.601, on the stored values). Opacity is ignored."""

    def __call__(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """From `(ny, nx, n_channels)` to `(ny, nx)`, in the range of the channels."""
        if pixels.shape[-1] < 3:
            return pixels[..., 0]
        dtype = pixels.dtype if pixels.dtype.kind == "f" else np.float64
        return pixels[..., :3] @ np.array([0.299, 0.587, 0.114], dtype)


def image_from_array(
    pixels: ArrayLike,
    channel: Channel | Luminance | None = None,
    *,
    spacing: PerAxis = 1.0,
    origin: PerAxis = 0.0,
    fill: float | None = None,
) -> Image:
    """An `Image` from a NumPy array `(ny, nx)`, or `(ny, nx, n_channels)` with a `channel` that says which grey to take.

    `fill` replaces pixels that are NaN or infinite; without it they are an error. `spacing` and `origin` [m] and errors as in `Image`.

    >>> import numpy as np
    >>> print(image_from_array(np.ones((2, 2, 3)), Luminance()).values[0])
    [1. 1.]
    """
    array = np.asarray(pixels)
    if channel is not None and array.ndim == 3 and array.shape[-1] in (1, 2, 3, 4):
        array = channel(array)
    if fill is not None and array.dtype.kind == "f":
        array = np.where(np.isfinite(array), array, np.asarray(fill, array.dtype))
    return Image(array, spacing, origin)


def load_image(
    path: str | os.PathLike[str],
    channel: Channel | Luminance | None = None,
    *,
    array: str | None = None,
    spacing: PerAxis = 1.0,
    origin: PerAxis = 0.0,
    fill: float | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Image:
    """An `Image` from a PNG, JPEG or TIFF file (needs Pillow) or from a NumPy `.npy` or `.npz` file.

    Pixels keep their stored range (0 to 255, or 0 to 65535 for 16 bits); row 0 is the top row. A photograph is turned upright as its EXIF
    tag says; of several pages the first is taken. A colour file is an error unless `channel` says how to make it grey.

    Args:
        path: the file.
        channel: `Luminance()`, `Channel(index)`, or None for files of one channel.
        array: which array of an `.npz` file; may be left out where there is only one.
        spacing: distance between pixels [m], as in `Image`.
        origin: position of the first pixel [m], as in `Image`.
        fill: number to put where a pixel is NaN or infinite; without it such a file is refused.
        max_pixels: larger images are refused before they are decoded.

    Raises:
        ImageError: the file cannot be used; one line says why.
        ImportError: it is not a NumPy file, and Pillow is not installed.
    """
    try:
        pixels = _read_pixels(os.fspath(path), array, max_pixels)
        return image_from_array(pixels, channel, spacing=spacing, origin=origin, fill=fill)
    except ImportError:
        raise
    except OSError as error:
        problem = f"{error.strerror or error}; check the path and its permissions."
    except MemoryError:
        problem = "there is not enough memory to hold it; make the image smaller."
    except Exception as error:  # decoders of damaged files raise almost anything
        problem = f"{error}"
    raise ImageError(" ".join(f"{os.fspath(path)}: {problem}".split()))


def elevation_model(spacing: PerAxis = 1.0) -> Image:
    """The elevation model that ships with matplotlib: Jacksboro fault, Tennessee, 344 x 403 heights [m] from 236 to 1076.

    One pixel is 1/1200 degree, about 74 m along x and 93 m along y; `spacing` is 1 (pixels) unless given.

    Raises:
        ImportError: matplotlib is not installed.
        ImageError: matplotlib is there without its sample data.
    """
    try:
        from matplotlib import cbook
    except ImportError as error:
        raise ImportError("The built-in elevation model ships with matplotlib, which is missing: pip install jaxspring[viz]") from error
    return load_image(cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False), array="elevation", spacing=spacing)


def _read_pixels(path: str, array: str | None, max_pixels: int) -> NDArray[Any]:
    """Pixels of a file as an array of two or three axes. Raises whatever the decoder raises."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError("it is not a file; pass the path of an image file.")
    with open(path, "rb") as stream:
        start = stream.read(8)
        stream.seek(0)
        if not start:
            raise ValueError("the file is empty; write the image again.")
        if start.startswith(b"PK"):
            return read_npz(stream, array, max_pixels)
        if start.startswith(b"\x93NUMPY"):
            return read_npy(stream, os.fstat(stream.fileno()).st_size, max_pixels)
        return _read_with_pillow(stream, max_pixels)


def _read_with_pillow(stream: Any, max_pixels: int) -> NDArray[Any]:
    """Decode PNG, JPEG or TIFF, after the size in the header has been checked."""
    try:
        import PIL.Image
        import PIL.ImageOps
    except ImportError as error:
        raise ImportError("Reading PNG, JPEG and TIFF needs Pillow: pip install jaxspring[viz]") from error
    with warnings.catch_warnings():
        # Pillow only warns of a large image; here it is an error below. Its other warnings are of tags that do not touch the pixels.
        warnings.simplefilter("ignore")
        try:
            picture = PIL.Image.open(stream, formats=("PNG", "JPEG", "TIFF"))
        except PIL.UnidentifiedImageError:
            raise ValueError("it is damaged, or not an image; pass a PNG, JPEG, TIFF, .npy or .npz file.") from None
        except PIL.Image.DecompressionBombError as error:
            raise ValueError(f"it is too large: {error} Make the image smaller.") from None
        with picture:
            width, height = picture.size
            if width * height > max_pixels:
                raise ValueError(f"{width} x {height} pixels exceed max_pixels = {max_pixels}; make the image smaller or raise max_pixels.")
            try:
                picture.load()
                if picture.mode in ("P", "PA"):
                    picture = picture.convert("RGBA" if "transparency" in picture.info or picture.mode == "PA" else "RGB")
                elif picture.mode in ("CMYK", "YCbCr", "HSV"):
                    picture = picture.convert("RGB")
                return np.array(PIL.ImageOps.exif_transpose(picture))
            except Exception as error:
                raise ValueError(f"the file is damaged or cut short ({error}); fetch or write it again.") from None
