"""Named arrays in one file, written whole or not at all, and never trusted when read.

The file is an uncompressed `.npz`, so `numpy.load` opens it too, with one more array, `header.json`, of no dimension, whose `item()` is:

    {"format": "jaxspring", "version": 1, "about": {...}, "arrays": [{"name", "dtype", "shape", "sha256"}, ...]}

and the digest of that header as the archive's comment. (Older files hold the header as it is, for which `numpy.load` gives bytes.)
Nothing is pickled. Reading checks sizes before memory is taken, and digests before a number is used: a damaged file gives a
`CheckpointError`, never a wrong number.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
import os
import pathlib
import secrets
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

VERSION = 1
HEADER = "header.json"
LONGEST_HEADER = 1 << 24  # bytes; an honest header has about 200 per array
KINDS = "biufc"  # bool, integers, real and complex numbers
Path = str | os.PathLike[str]


class CheckpointError(ValueError):
    """A saved file cannot be used. One line: which file, what is wrong, what was expected."""


@dataclass(frozen=True)
class Archive:
    """What a file held.

    Attributes:
        arrays: name -> array, as saved, with shape, dtype, byte order and memory order.
        about: whatever the writer noted, in JSON's types.
    """

    arrays: dict[str, np.ndarray]
    about: dict[str, Any] = field(default_factory=dict)


def write_archive(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any] | None = None) -> None:
    """Write named arrays atomically: the path holds the old file or the new one, whole, whatever happens meanwhile.

    Raises:
        ValueError: a name that could not be a file name inside an archive.
        TypeError: an array that does not hold numbers.
        OSError: the disk is full, or the folder cannot be written. The old file is then still there.
    """
    entries = []
    with atomic_file(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            _check_name(name)
            if name == HEADER:
                raise ValueError(f"An array cannot be called {HEADER!r}, which is what the file says of itself. Rename it.")
            entries.append(_write_array(archive, name, np.asarray(array)))
        header = {"format": "jaxspring", "version": VERSION, "about": dict(about or {}), "arrays": entries}
        data = json.dumps(header, allow_nan=False).encode()
        if len(data) > LONGEST_HEADER:
            raise ValueError(f"The header would take {len(data)} bytes, more than {LONGEST_HEADER}: too many arrays for one file.")
        archive.writestr(zipfile.ZipInfo(f"{HEADER}.npy"), _header_head(len(data)) + data)
        archive.comment = _seal(data)


def read_archive(path: Path) -> Archive:
    """Read and verify a file that `write_archive` wrote.

    Raises:
        CheckpointError: the file is damaged, cut short, from another version, or not ours.
        OSError: there is no such file, or it cannot be opened.
    """
    with open(path, "rb") as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                return _read(archive, os.fstat(stream.fileno()).st_size)
        except (CheckpointError, MemoryError) as error:
            problem = str(error)
        except Exception as error:  # a damaged zip directory raises almost anything
            problem = f"it is damaged or not a jaxspring file ({error}); expected an archive written by jaxspring.save"
    raise CheckpointError(" ".join(f"{os.fspath(path)}: {problem}.".split()))


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[IO[bytes]]:
    """A stream whose bytes appear at `path` at the end, all at once and on the disk; on an error nothing appears.

    A link stays one: what it points to is written.
    """
    target = pathlib.Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"{target.parent} is no folder, so {target.name} cannot be written there.")
    if target.is_dir():
        raise IsADirectoryError(f"{os.fspath(path)} is a folder; choose another name for the file.")
    beside = target.parent / f".{target.name}.{secrets.token_hex(4)}.tmp"
    try:
        with open(beside, "xb") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(beside, target)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    _sync_folder(target.parent)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[pathlib.Path]:
    """A new folder, filled beside `path` and put in its place at the end, whole; what was there before goes only then.

    A link stays one: the folder that it points to is replaced.
    """
    target = pathlib.Path(os.path.realpath(path))
    beside = target.parent / f".{target.name}.{secrets.token_hex(4)}.tmp"
    old = beside.with_suffix(".old")
    beside.mkdir()
    try:
        yield beside
        if target.exists():
            os.replace(target, old)
        os.replace(beside, target)
    except BaseException:
        if old.exists() and not target.exists():
            os.replace(old, target)
        shutil.rmtree(beside, ignore_errors=True)
        raise
    shutil.rmtree(old, ignore_errors=True)
    _sync_folder(target.parent)


def remove_leftovers(path: Path) -> None:
    """Delete temporary files that killed writers of `path` left beside it. Only for the one process that writes `path`."""
    target = pathlib.Path(os.path.realpath(path))
    for left in target.parent.glob(f".{target.name}.*.tmp"):
        left.unlink(missing_ok=True)


def _write_array(archive: zipfile.ZipFile, name: str, array: np.ndarray) -> dict[str, Any]:
    if array.dtype.kind not in KINDS:
        raise TypeError(f"{name} has dtype {array.dtype}; only numbers and booleans are saved, objects are never pickled.")
    is_fortran = array.flags.f_contiguous and not array.flags.c_contiguous
    head = _npy_head(array.dtype, array.shape, is_fortran)
    body = np.ascontiguousarray(array.T if is_fortran else array).reshape(-1).view(np.uint8)
    info = zipfile.ZipInfo(f"{name}.npy")
    info.file_size = len(head) + body.nbytes
    with archive.open(info, "w") as member:
        member.write(head)
        member.write(body.data)
    digest = hashlib.sha256(head)
    digest.update(body.data)
    return {"name": name, "dtype": array.dtype.str, "shape": list(array.shape), "fortran": is_fortran, "sha256": digest.hexdigest()}


def _read(archive: zipfile.ZipFile, file_size: int) -> Archive:
    members = {info.filename: info for info in archive.infolist()}
    if len(members) != len(archive.infolist()):
        raise CheckpointError("a name occurs twice, so that it is unclear which array is meant")
    for info in members.values():
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            raise CheckpointError(f"{info.filename!r} is compressed; expected plain bytes, which cannot grow when they are read")
    if sum(info.file_size for info in members.values()) > file_size:
        raise CheckpointError(f"its arrays claim more than the {file_size} bytes that the file has")
    header = _read_header(archive, members)
    listed = {_header_name(members), *(f"{entry['name']}.npy" for entry in header["arrays"])}
    if listed != set(members) or len(listed) != len(header["arrays"]) + 1:
        differing = ", ".join(repr(name) for name in sorted(listed ^ set(members))[:5])
        raise CheckpointError(f"the header and the archive name different arrays ({differing})")
    arrays = {entry["name"]: _read_array(archive, members[f"{entry['name']}.npy"], entry) for entry in header["arrays"]}
    return Archive(arrays, header["about"])


def _read_header(archive: zipfile.ZipFile, members: Mapping[str, zipfile.ZipInfo]) -> dict[str, Any]:
    name = _header_name(members)
    if name not in members:
        raise CheckpointError(f"it has no {HEADER!r}, so it is not a jaxspring file")
    if members[name].file_size > LONGEST_HEADER + len(_header_head(LONGEST_HEADER)):
        raise CheckpointError(f"its header has {members[name].file_size} bytes; expected at most {LONGEST_HEADER}")
    data = archive.read(name)
    if name != HEADER:
        head = _header_head(max(len(data) - len(_header_head(1)), 1))
        if not data.startswith(head):
            raise CheckpointError("its header is no array of bytes, as it should be: the file is damaged")
        data = data[len(head) :]
    header = json.loads(data)
    if header["format"] != "jaxspring":
        raise CheckpointError(f"its format is {header['format']!r}; expected 'jaxspring'")
    if header["version"] != VERSION:
        raise CheckpointError(f"it is of format version {header['version']}; this library reads version {VERSION}: update jaxspring")
    if archive.comment != _seal(data):
        raise CheckpointError("the digest of its header does not match: the file is damaged or was put together from two")
    for entry in header["arrays"]:
        _check_name(entry["name"])
    return header


def _read_array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, entry: Mapping[str, Any]) -> np.ndarray:
    name, shape, dtype = entry["name"], tuple(entry["shape"]), np.dtype(entry["dtype"])
    if dtype.kind not in KINDS or any(not isinstance(n, int) or n < 0 for n in shape):
        raise CheckpointError(f"{name!r} claims dtype {dtype} and shape {shape}; expected numbers or booleans")
    head = _npy_head(dtype, shape, entry["fortran"])
    n_bytes = math.prod(shape) * dtype.itemsize
    if len(head) + n_bytes != info.file_size:
        raise CheckpointError(f"{name!r} claims shape {shape} of {dtype}, {n_bytes} bytes, but {info.file_size - len(head)} are there")
    body = np.empty(n_bytes, np.uint8)
    with archive.open(info) as member:
        digest = hashlib.sha256(start := member.read(len(head)))
        done = 0
        while done < n_bytes and (piece := member.read(min(1 << 20, n_bytes - done))):
            body[done : done + len(piece)] = np.frombuffer(piece, np.uint8)
            done += len(piece)
    digest.update(body.data)
    if digest.hexdigest() != entry["sha256"] or start != head:
        raise CheckpointError(f"the digest of {name!r} does not match: the file is damaged")
    return body.view(dtype).reshape(shape, order="F" if entry["fortran"] else "C")


def _header_name(members: Mapping[str, zipfile.ZipInfo]) -> str:
    """As a member of its own in older files, as an array in newer ones."""
    return HEADER if HEADER in members else f"{HEADER}.npy"


def _header_head(n_bytes: int) -> bytes:
    """What comes before the bytes of the header; as long for every header."""
    return _npy_head(np.dtype(f"S{n_bytes}"), (), False)


def _npy_head(dtype: np.dtype, shape: tuple[int, ...], is_fortran: bool) -> bytes:
    """The bytes before the numbers in a `.npy` file."""
    stream = io.BytesIO()
    npy.write_array_header_1_0(stream, {"descr": dtype.str, "fortran_order": bool(is_fortran), "shape": shape})
    return stream.getvalue()


def _check_name(name: Any) -> None:
    parts = name.split("/") if isinstance(name, str) else [""]
    if not all(part and part not in (".", "..") and part.isprintable() for part in parts) or "\\" in name or ":" in name or len(name) > 500:
        raise CheckpointError(f"{name!r} is not a name for an array; expected words joined by '/', such as 'forces/0/stiffness'")


def _seal(header: bytes) -> bytes:
    return b"jaxspring sha256 " + hashlib.sha256(header).hexdigest().encode()


def _sync_folder(folder: pathlib.Path) -> None:
    """Make a rename last through a power cut, where the system can."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
