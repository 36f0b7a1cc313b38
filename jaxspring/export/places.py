"""Where exported files go: one state into a file, a run into a folder of numbered files, each whole or not at all."""

from __future__ import annotations

import contextlib
import pathlib
import re
from collections.abc import Callable, Iterator

import numpy as np

from ..archive import Path, atomic_file, atomic_folder
from .frames import Frames

# Endings that are taken for a file's where a folder is wanted.
OF_FILES = {".extxyz", ".npz", ".obj", ".ply", ".pvd", ".stl", ".vtk", ".vtp", ".vtu", ".xyz"}


def file_place(path: Path, suffixes: tuple[str, ...], reader: str) -> pathlib.Path:
    """The path of one file.

    Raises:
        ValueError: an ending by which no reader would know it.
        OSError: there is no such folder above.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"path = {str(path)!r}; {reader} knows the file by its ending: let the name end in {' or '.join(suffixes)}.")
    _check_parent(path)
    return path


def write_frames(
    path: Path,
    suffix: str,
    reader: str,
    frames: Frames,
    render: Callable[[Frames, int], bytes],
    collection: tuple[str, Callable[[list[str], np.ndarray], bytes]] | None = None,
) -> None:
    """One state as the file `path`; frames as a folder of numbered files, and one more that lists them where a format has such.

    Args:
        path: the file, or the folder.
        suffix: of the files.
        reader: what reads them, for messages.
        frames: what is written.
        render: the bytes of frame i.
        collection: suffix of the file that lists the others, and its bytes from their names and times [s]; None: no such file.
    """
    if not frames.is_series:
        place, data = file_place(path, (suffix,), reader), render(frames, 0)
        with atomic_file(place) as stream:
            stream.write(data)
        return
    with series_folder(path, suffix, "" if collection is None else collection[0], len(frames)) as (folder, names):
        for i, name in enumerate(names):
            (folder / name).write_bytes(render(frames, i))
        if collection is not None:
            listing = names[0].rpartition("_")[0] + collection[0]
            (folder / listing).write_bytes(collection[1](names, frames.time))


@contextlib.contextmanager
def series_folder(path: Path, suffix: str, collection: str, n_frames: int) -> Iterator[tuple[pathlib.Path, list[str]]]:
    """A folder that stands at `path` once the block has ended, and the names of its numbered files.

    Args:
        path: the folder. An older series there is replaced.
        suffix: of the numbered files.
        collection: suffix of the file that lists them, or "".
        n_frames: how many files.

    Raises:
        ValueError: the name of a file.
        OSError: there is no such folder above, a file of this name, or a folder with other files, which would be lost.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() in OF_FILES:
        raise ValueError(
            f"path = {str(path)!r} is the name of a file, but {n_frames} frames make a folder. Pass e.g. {str(path.with_suffix(''))!r}, or "
            f"one state: jax.tree.map(lambda a: a[-1], states)."
        )
    name = path.absolute().name
    _check_parent(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"{path} is a file, but {n_frames} frames make a folder; choose another name.")
    if path.is_dir():
        ours = re.compile(re.escape(name) + rf"(_\d+{re.escape(suffix)}" + (f"|{re.escape(collection)}" if collection else "") + ")")
        other = sorted(found.name for found in path.iterdir() if not ours.fullmatch(found.name))
        if other:
            raise FileExistsError(f"{path} holds other files ({', '.join(other[:3])}), which would be lost; choose another folder.")
    width = max(4, len(str(n_frames - 1)))
    with atomic_folder(path) as folder:
        yield folder, [f"{name}_{i:0{width}d}{suffix}" for i in range(n_frames)]


def _check_parent(path: pathlib.Path) -> None:
    parent = path.absolute().parent
    if not parent.is_dir():
        raise FileNotFoundError(f"{parent} is no folder, so {path.name} cannot be written there.")


__all__ = ["file_place", "series_folder", "write_frames"]
