"""Where exported files go: one state into a file, a run into a folder of numbered files, each whole or not at all."""

from __future__ import annotations

import contextlib
import pathlib
import re
from collections.abc import Iterator

from ..archive import Path, atomic_folder

# Endings that are taken for a file's where a folder is wanted.
OF_FILES = {".extxyz", ".npz", ".ply", ".pvd", ".vtk", ".vtp", ".vtu", ".xyz"}


def file_place(path: Path, suffixes: tuple[str, ...], reader: str) -> pathlib.Path:
    """The path of one file.

    Raises:
        ValueError: an ending by which no reader would know it.
        OSError: there is no such folder, or a folder of this name.
    """
    path = pathlib.Path(path)
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"path = {str(path)!r}; {reader} knows the file by its ending: let the name end in {' or '.join(suffixes)}.")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; choose another name for the file.")
    _check_parent(path)
    return path


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


__all__ = ["file_place", "series_folder"]
