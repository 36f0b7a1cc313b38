"""NumPy `.npy` and `.npz` files from strangers: headers are checked before memory is taken, and nothing is unpickled."""

from __future__ import annotations

import math
import zipfile
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

# `.npy` headers of version 3 differ from 2 in allowing field names outside Latin-1, which no image has.
_HEADER_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_MAX_CHANNELS = 4


def read_npy(stream: IO[bytes], size: int, max_pixels: int) -> NDArray[Any]:
    """The array in an `.npy` stream of `size` bytes. ValueError where it claims more than is there, or more than `max_pixels`."""
    version = npy.read_magic(stream)
    if version not in _HEADER_READERS:
        raise ValueError(f".npy version {version} is not supported; save the array again with numpy.save.")
    shape, is_fortran, dtype = _HEADER_READERS[version](stream)
    if dtype.kind not in "biuf":
        raise ValueError(f"the array has dtype {dtype}, which is not real numbers (objects are never unpickled); save real numbers.")
    if any(n < 0 for n in shape):
        raise ValueError(f"the header claims the shape {shape}; save the array again.")
    count = math.prod(shape)
    n_channels = shape[-1] if len(shape) == 3 and shape[-1] <= _MAX_CHANNELS else 1
    if count > max_pixels * n_channels:
        raise ValueError(f"shape {shape} is more than max_pixels = {max_pixels}; make the image smaller or raise max_pixels.")
    n_bytes = count * dtype.itemsize
    if n_bytes > size - stream.tell():
        raise ValueError(f"the file is cut short: shape {shape} needs {n_bytes} bytes, {size - stream.tell()} are there; fetch it again.")
    data = stream.read(n_bytes)
    if len(data) < n_bytes:
        raise ValueError(f"the file is cut short: shape {shape} needs {n_bytes} bytes, {len(data)} came; fetch it again.")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if is_fortran else "C")


def read_npz(stream: IO[bytes], array: str | None, max_pixels: int) -> NDArray[Any]:
    """One array of an `.npz` archive: the one named `array`, or the only one. ValueError where that is unclear or damaged."""
    try:
        with zipfile.ZipFile(stream) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if array is None and len(members) == 1:
                (array,) = members
            if array not in members:
                wanted = "no array was named" if array is None else f"there is no array {array!r}"
                raise ValueError(f"{wanted}; it holds {', '.join(sorted(members)[:20]) or 'nothing'}: pass array=<one of these>.")
            info = members[array]
            with archive.open(info) as member:
                return read_npy(member, info.file_size, max_pixels)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise ValueError(f"the archive is damaged ({error}); fetch or save it again.") from None
