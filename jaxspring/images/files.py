"""Loading images: PNG and JPEG through Pillow, TIFF through tifffile, NumPy's files and arrays, and the elevation model of matplotlib.

Files are not trusted. The kind is read from the first bytes, not from the name; the size that a header claims is checked before anything is
decoded or allocated; arrays are never unpickled. Whatever is wrong with a file is one `ImageError` with one line.
"""

from __future__ import annotations

import os
import stat
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from jax.core import Tracer
from numpy.typing import ArrayLike

from .channels import OneChannel, Pixels
from .holes import Holes
from .image import Image, PerAxis
from .numpy_files import read_npy, read_npz
from .tiff_files import MAGIC, read_tiff

MAX_PIXELS = 64_000_000
"""Largest image that is loaded unless told otherwise: 64 million pixels are 0.5 GB in float64."""

T = TypeVar("T")
_PNG_HEAD = 26  # bytes up to the bits per channel and the kind of colour


class ImageError(ValueError):
    """An image file that cannot be used: missing, damaged, too large, of the wrong shape, or with pixels that are not finite.

    The message is one line that names the file, what is wrong and what to do.
    """


def image_from_array(
    pixels: ArrayLike,
    channel: OneChannel | None = None,
    *,
    spacing: PerAxis = 1.0,
    origin: PerAxis = 0.0,
    fill: float | None = None,
    holes: Holes | None = None,
) -> Image:
    """An `Image` from a NumPy array `(ny, nx)`, or `(ny, nx, n_channels)` with a `channel` that says which grey to take.

    Args:
        pixels: the array, of any real type. Of bytes with two or four channels the last is opacity, as in a PNG: where a pixel is
            transparent it has no value.
        channel: `Luminance()`, `Channel(index)`, `TerrainRGB()`, `Terrarium()`, or None for an array of one channel.
        spacing: distance between pixels [m], as in `Image`.
        origin: position of the first pixel [m], as in `Image`.
        fill: number to put where a pixel is masked (in a masked array), NaN or infinite; without it such an array is refused, unless
        holes: says that pixels without a value are holes, and which further ones have none; see `Holes`.

    Returns:
        The image, its pixels in the unit of the array.

    Raises:
        ValueError: a shape without a channel that fits, pixels without a value and neither `fill` nor `holes`, or both; else as `Image`.
        TypeError: traced pixels, or pixels of a type that `Image` refuses.

    >>> import numpy as np
    >>> print(image_from_array(np.ones((2, 2, 3)), js.images.Luminance()).values[0])
    [1. 1.]
    """
    if isinstance(pixels, Tracer):
        raise TypeError("pixels are traced, so that they cannot be looked at: build Image(values) inside jit and grad.")
    mask = np.ma.getmaskarray(pixels) if isinstance(pixels, np.ma.MaskedArray) else None
    return image_of(Pixels.of_array(np.asarray(pixels), mask), channel, spacing, origin, fill, holes)


def image_of(
    pixels: Pixels, channel: OneChannel | None, spacing: PerAxis, origin: PerAxis, fill: float | None, holes: Holes | None
) -> Image:
    """The image of what a file holds, its pixels without a value filled, made holes, or refused."""
    if holes is None:
        return Image(pixels.one_channel(channel, fill), spacing, origin)
    if fill is not None:
        raise ValueError(f"fill = {fill} and holes are both given, but a hole is not filled: pass one of them.")
    values, weights = pixels.weighted(channel, holes)
    # Where there is no hole there are no weights: nothing is carried along for them.
    return Image(values, spacing, origin, None if weights is None or (weights == 1).all() else weights)


def load_image(
    path: str | os.PathLike[str],
    channel: OneChannel | None = None,
    *,
    array: str | None = None,
    page: int | None = None,
    spacing: PerAxis = 1.0,
    origin: PerAxis = 0.0,
    fill: float | None = None,
    holes: Holes | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Image:
    """An `Image` from a PNG, JPEG or TIFF file (needs the extra `viz`) or from a NumPy `.npy` or `.npz` file.

    Pixels keep their stored range (0 to 255, 0 to 15 for 4 bits, 0 to 65535 for 16); row 0 is the top row. A picture is turned upright as
    its tag says. Where a TIFF stores darkness (zero is white), brightness is taken. Colour is an error unless `channel` says how to make it
    grey; no colour profile and no gamma is applied, and inks (CMYK) become RGB without a profile.

    A pixel has no value where the file declares it as no-data (GDAL's tag), masks it, or makes it transparent: that is an error, or `fill`
    stands there, or with `holes` it is a hole. A half transparent pixel is mixed with `fill` as with a background; with `holes` it weighs
    half.

    Args:
        path: the file.
        channel: `Luminance()`, `Channel(index)`, `TerrainRGB()` and `Terrarium()` for tiles, or None for files of one channel.
        array: which array of an `.npz` file; may be left out where there is only one.
        page: which page of a TIFF, or frame of an animated PNG, from 0; may be left out where there is only one.
        spacing: distance between pixels [m], as in `Image`.
        origin: position of the first pixel [m], as in `Image`.
        fill: number to put where a pixel has no value, is NaN or infinite; without it such a file is refused, unless
        holes: says that pixels without a value are holes, and which further ones have none; see `Holes`.
        max_pixels: larger images are refused before they are decoded.

    Returns:
        The image, its pixels in the unit of the file.

    Raises:
        ImageError: the file cannot be used; one line says why.
        ImportError: it is not a NumPy file, and Pillow (or tifffile, for TIFF) is not installed.
    """
    return usable(path, lambda: image_of(_read_pixels(os.fspath(path), array, page, max_pixels), channel, spacing, origin, fill, holes))


def usable(path: str | os.PathLike[str], read: Callable[[], T]) -> T:
    """What `read` makes of a file; whatever goes wrong becomes one `ImageError` of one line that names the file."""
    try:
        return read()
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

    One pixel is 1/1200 degree, about 74 m along x and 93 m along y.

    Args:
        spacing: distance between pixels, as in `Image`: 1 (pixels) unless given; (74.0, 93.0) is in metres.

    Returns:
        The image, `(344, 403)` heights [m].

    Raises:
        ImportError: matplotlib is not installed.
        ImageError: matplotlib is there without its sample data.
    """
    try:
        from matplotlib import cbook
    except ImportError as error:
        raise ImportError("The built-in elevation model ships with matplotlib, which is missing: pip install jaxspring[viz]") from error
    return load_image(cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False), array="elevation", spacing=spacing)


def _read_pixels(path: str, array: str | None, page: int | None, max_pixels: int) -> Pixels:
    """Pixels of a file as they are stored. Raises whatever the decoder raises."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError("it is not a file; pass the path of an image file.")
    with open(path, "rb") as stream:
        start = stream.read(8)
        stream.seek(0)
        if not start:
            raise ValueError("the file is empty; write the image again.")
        if start.startswith(b"PK"):
            return Pixels.of_array(read_npz(stream, array, max_pixels))
        if start.startswith(b"\x93NUMPY"):
            return Pixels.of_array(read_npy(stream, os.fstat(stream.fileno()).st_size, max_pixels))
        if start.startswith(MAGIC):
            return read_tiff(stream, page, max_pixels)
        return _read_with_pillow(stream, page, max_pixels)


def _read_with_pillow(stream: Any, page: int | None, max_pixels: int) -> Pixels:
    """Decode PNG or JPEG, after the size in the header has been checked."""
    try:
        import PIL.Image
    except ImportError as error:
        raise ImportError("Reading PNG, JPEG and TIFF needs Pillow: pip install jaxspring[viz]") from error
    head = stream.read(_PNG_HEAD)
    stream.seek(0)
    with warnings.catch_warnings():
        # Pillow only warns of a large image; here it is an error below. Its other warnings are of tags that do not touch the pixels.
        warnings.simplefilter("ignore")
        try:
            picture = PIL.Image.open(stream, formats=("PNG", "JPEG"))
        except PIL.UnidentifiedImageError:
            raise ValueError("it is damaged, not an image, or of another kind; pass a PNG, JPEG, TIFF, .npy or .npz file.") from None
        except PIL.Image.DecompressionBombError as error:
            raise ValueError(f"it is too large: {error} Make the image smaller.") from None
        with picture:
            width, height = picture.size
            if width * height > max_pixels:
                raise ValueError(f"{width} x {height} pixels exceed max_pixels = {max_pixels}; make the image smaller or raise max_pixels.")
            bits, colour = (head[24], head[25]) if picture.format == "PNG" else (8, 0)
            if bits == 16 and colour:
                raise ValueError("it has several channels of 16 bits, which Pillow cuts to 8; save it as TIFF, or with 8 bits.")
            _choose_frame(picture, page)
            try:
                return _decoded(picture, bits)
            except Exception as error:
                raise ValueError(f"the file is damaged or cut short ({error}); fetch or write it again.") from None


def _choose_frame(picture: Any, page: int | None) -> None:
    """Go to a frame. The further pictures of a photograph (its preview, its depth) are not meant unless asked for."""
    count = getattr(picture, "n_frames", 1)
    if page is None and count > 1 and picture.format == "PNG":
        raise ValueError(f"it is animated, with {count} frames; pass page=<0 to {count - 1}>.")
    if not -count <= (page or 0) < count:
        raise ValueError(f"there is no page {page}; it holds {count}.")
    if page:
        picture.seek(page % count)


def _decoded(picture: Any, bits: int) -> Pixels:
    """The pixels of an opened picture, upright, with their opacity."""
    import PIL.ImageOps

    picture.load()
    through = picture.info.get("transparency")
    if picture.mode in ("P", "PA") or (picture.mode == "RGB" and through is not None):
        picture = picture.convert("RGB" if through is None and picture.mode == "P" else "RGBA")
        through = None
    elif picture.mode in ("CMYK", "YCbCr", "HSV"):
        picture = picture.convert("RGB")
    if picture.mode == "1" and through is not None:
        through = through > 0  # Pillow says 255 for 1
    values = np.array(PIL.ImageOps.exif_transpose(picture))
    if bits in (2, 4) and values.ndim == 2:  # Pillow spreads them over 8 bits
        values = values // (255 // (2**bits - 1))
    alpha = values.shape[-1] - 1 if values.ndim == 3 and picture.mode in ("RGBA", "LA") else None
    is_hidden = None if through is None or values.ndim == 3 else values == through
    return Pixels(values, mask=is_hidden, alpha=alpha)
