"""TIFF files, by their own tags: tifffile gives the stored numbers, whatever their type, byte order, tiling and planes.

Pillow decodes what tifffile leaves to other packages (LZW, JPEG, fax), but only kinds of pixels that it keeps whole: colours of 16 bits
it would cut to 8 without a word.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .channels import Pixels

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_NODATA_TAG = 42113  # of GDAL, as text
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _CMYK, _YCBCR = 0, 1, 2, 3, 5, 6
_PREMULTIPLIED, _OPACITY = 1, 2
# Bits, kind and channels of grey pixels that Pillow keeps whole.
_KEPT_BY_PILLOW = {(1, "b"), (2, "u"), (4, "u"), (8, "u"), (16, "u"), (16, "i"), (32, "i"), (32, "u"), (32, "f")}


def read_tiff(stream: IO[bytes], page: int | None, max_pixels: int) -> Pixels:
    """One page of a TIFF file. ValueError where it is damaged, too large, or of a kind that is not read."""
    try:
        import tifffile
    except ImportError as error:
        raise ImportError("Reading TIFF needs tifffile: pip install jaxspring[viz]") from error
    with _quiet(), tifffile.TiffFile(stream) as file:
        chosen, mask = _pages(file, page)
        width, height = chosen.imagewidth, chosen.imagelength
        tile = chosen.tilewidth * chosen.tilelength if chosen.is_tiled else 0
        if max(width * height * chosen.imagedepth, tile) > max(max_pixels, 0):
            raise ValueError(f"{width} x {height} pixels exceed max_pixels = {max_pixels}; make the image smaller or raise max_pixels.")
        values = _values(stream, chosen)
        hidden = None if mask is None else _upright(mask.asarray() == 0, chosen)
        text = chosen.tags.get(_NODATA_TAG)
        nodata = None if text is None else _number(str(text.value))
        extra = [int(sample) for sample in chosen.extrasamples]
        alpha = next((i for i, sample in enumerate(extra) if sample in (_PREMULTIPLIED, _OPACITY)), None)
    if alpha is None or values.ndim == 2:
        has_bands = int(chosen.photometric) in (_WHITE_IS_ZERO, _BLACK_IS_ZERO)
        return Pixels(values, nodata, hidden, has_bands=has_bands)
    return Pixels(values, nodata, hidden, values.shape[-1] - len(extra) + alpha, extra[alpha] == _PREMULTIPLIED)


def read_place(stream: IO[bytes], page: int | None) -> dict[str, Any] | None:
    """The GeoTIFF tags of a page, by their names; None where it has none."""
    import tifffile

    with _quiet(), tifffile.TiffFile(stream) as file:
        chosen, _ = _pages(file, page)
        tags = chosen.geotiff_tags
        turned = chosen.tags.get("Orientation")
        if tags is not None and turned is not None and int(turned.value) != 1:
            raise ValueError("it has a place on a map and is turned by its orientation tag as well; save it upright.")
        return tags


def _pages(file: Any, page: int | None) -> tuple[Any, Any]:
    """The page to be read and its mask page, if it has one. Smaller copies of a page are no pages of their own."""
    kept = [p for p in file.pages if not p.subfiletype & 5]
    if page is None and len(kept) > 1:
        raise ValueError(f"it holds {len(kept)} pages; pass page=<0 to {len(kept) - 1}>.")
    if not -len(kept) <= (page or 0) < len(kept):
        raise ValueError(f"there is no page {page}; it holds {len(kept)}.")
    chosen = kept[page or 0]
    masks = [p for p in file.pages if p.subfiletype & 4 and p.shape[:2] == chosen.shape[:2]]
    return chosen, masks[0] if masks and len(kept) == 1 else None


def _values(stream: IO[bytes], page: Any) -> NDArray[Any]:
    """The pixels `(ny, nx)` or `(ny, nx, n)`; brighter is larger, palettes are looked up, inks and YCbCr become RGB."""
    kind = int(page.photometric)
    if kind not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE):
        return _by_pillow(stream, page)
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueError(f"its pixels have the axes {page.axes}; only planes are read: save one plane.")
    try:
        values = page.asarray()
        values = _upright(np.moveaxis(values, 0, -1) if page.axes == "SYX" else values, page)
    except Exception as error:
        if not isinstance(error, ImportError) and "imagecodecs" not in str(error):
            raise ValueError(f"the file is damaged or cut short ({error}); fetch or write it again.") from None
        values = _by_pillow(stream, page)
        kind = _RGB if kind == _PALETTE else kind
    if kind == _PALETTE:
        # The table holds 16 bits per colour, of which writers fill the upper 8.
        return np.moveaxis(page.colormap >> 8, 0, -1).astype(np.uint8)[values]
    if kind == _WHITE_IS_ZERO:
        return _inverted(values, page.bitspersample)
    return values


def _inverted(values: NDArray[Any], bits: int) -> NDArray[Any]:
    """Brightness from darkness, of unsigned whole numbers."""
    if values.dtype.kind == "b":
        return ~values
    if values.dtype.kind != "u":
        raise ValueError(f"zero is white, but {values.dtype} has no blackest number to count from; write it with black as zero.")
    return np.asarray(2**bits - 1, values.dtype) - values


def _by_pillow(stream: IO[bytes], page: Any) -> NDArray[Any]:
    """What Pillow decodes, upright, as stored; inks, YCbCr and palettes as RGB. ValueError where it would not keep the numbers."""
    import PIL.Image

    bits, samples, kind = page.bitspersample, page.samplesperpixel, int(page.photometric)
    letter = "b" if bits == 1 else "?" if page.dtype is None else page.dtype.kind
    is_grey = kind in (_WHITE_IS_ZERO, _BLACK_IS_ZERO)
    is_kept = (samples == 1 and (bits, letter) in _KEPT_BY_PILLOW) if is_grey else bits == 8 or (kind == _PALETTE and samples == 1)
    if not is_kept or kind > _YCBCR:
        found = f"{samples} x {bits} bits, {page.photometric.name}, compression {page.compression.name}"
        raise ValueError(f"this kind of TIFF is not read ({found}); save it without compression, or as .npy.")
    stream.seek(0)
    try:
        with PIL.Image.open(stream, formats=("TIFF",)) as picture:
            picture.seek(page.index)
            if not is_grey and picture.mode not in ("RGB", "RGBA"):
                picture = picture.convert("RGB")
            stored = np.array(picture)
    except Exception as error:
        raise ValueError(f"the file is damaged, or of a kind of TIFF that is not read ({error}); save it without compression.") from None
    if letter == "u" and bits == 32:
        return stored.view(np.uint32)
    if is_grey and bits in (2, 4):
        stored = stored // (255 // (2**bits - 1))  # Pillow spreads them over 8 bits
    # Pillow inverts up to 8 bits, and only those.
    return _inverted(stored, bits) if kind == _WHITE_IS_ZERO and bits <= 8 else stored


def _upright(values: NDArray[Any], page: Any) -> NDArray[Any]:
    """Turned and mirrored as the tag says: 2 to 4 keep rows as rows, 5 to 8 exchange rows and columns. (Pillow does so by itself.)"""
    tag = page.tags.get("Orientation")
    orientation = 1 if tag is None else int(tag.value)
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return values[:, ::-1] if orientation in (2, 3, 6, 7) else values


def _number(text: str) -> float:
    """The no-data number from its text; a whole number as such, since a float rounds those of 64 bits."""
    text = text.strip(" \0")
    try:
        return int(text) if text.lstrip("+-").isdecimal() and len(text) < 21 else float(text)
    except ValueError:
        raise ValueError(
            f"it declares the no-data value {text!r}, which is no number; read it yourself and use image_from_array."
        ) from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without tifffile's log: what is wrong with a file is one line of ours."""
    log = logging.getLogger("tifffile")
    was, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = was
