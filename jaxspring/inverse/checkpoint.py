"""Checkpoints of a fit: everything that the next iteration depends on, so that a resumed fit is bitwise the unbroken one."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..archive import Path, read_archive, remove_leftovers, write_archive
from ..files import FORM, complain, expect_same, named_arrays, restored, topologies
from ..processes import write_by_one

PyTree = Any
PARTS = ("parameters", "best", "memory", "carried", "best_carried")
HISTORY = ("loss", "gradient_norm", "seconds")


class Checkpoint(eqx.Module):
    """Where and how often a fit is saved. One file, replaced as a whole: after a kill the newest complete one is there.

    Attributes:
        path: the file (static).
        every: iterations between two writes (static). The end, a stop and Ctrl-C write too.
        note: names the problem, such as a digest of its data; a checkpoint with another note is refused (static).
    """

    path: Path = eqx.field(static=True)
    every: int = eqx.field(static=True, default=25)
    note: str = eqx.field(static=True, default="")

    def __check_init__(self):
        if self.every < 1:
            raise ValueError(f"every = {self.every}; expected 1 or more iterations.")


class Snapshot(eqx.Module):
    """A fit between two iterations.

    Attributes:
        parameters: unconstrained coordinates of the next iteration.
        best: unconstrained coordinates of the lowest loss so far.
        memory: what the optimiser carries.
        carried: what the loss carries.
        best_carried: what it handed on where the loss was lowest.
        iteration: iterations done.
        best_iteration: iteration of the lowest loss; -1 where there is none yet.
        history: loss, gradient norm and seconds; entries from `iteration` on are not part of the snapshot.
    """

    parameters: PyTree
    best: PyTree
    memory: PyTree
    carried: PyTree
    best_carried: PyTree
    iteration: int
    best_iteration: int
    history: dict[str, list[float]]


def write_checkpoint(place: Checkpoint, snapshot: Snapshot, identity: dict[str, Any]) -> None:
    """Write a snapshot atomically, with the loss at its parameters, which the history holds already.

    Args:
        place: where.
        snapshot: what the iteration after it starts from.
        identity: what the numbers mean nothing without: the transforms ("coordinates") and the settings of the optimiser.
    """
    about = {"kind": "fit", "form": FORM, "note": place.note, "best_iteration": snapshot.best_iteration} | identity
    about |= {"topologies": topologies(snapshot.parameters)}

    def write(parts: dict[str, PyTree]) -> None:
        arrays = {f"history/{name}": np.asarray(snapshot.history[name][: snapshot.iteration], np.float64) for name in HISTORY}
        for part, tree in parts.items():
            arrays |= {f"{part}/{name}": array for name, array in named_arrays(tree).items()}
        arrays["next/loss"] = np.asarray(snapshot.history["loss"][snapshot.iteration], np.float64)
        write_archive(place.path, arrays, about)

    write_by_one(place.path, {part: getattr(snapshot, part) for part in PARTS}, write)


def read_checkpoint(place: Checkpoint, like: Snapshot, identity: dict[str, Any]) -> tuple[Snapshot, float]:
    """The snapshot in a file, in the shape of `like`, and the loss at its parameters.

    Raises:
        CheckpointError: the file is damaged, or belongs to another fit: another note, other parameters, transforms, optimiser or topology.
        OSError: there is no such file.
    """
    path = place.path
    if jax.process_index() == 0:  # of several, the one that writes
        remove_leftovers(path)
    archive = read_archive(path)
    expect_same(path, "kind", archive.about.get("kind"), "fit")
    expect_same(path, "problem", archive.about.get("note"), place.note)
    expect_same(path, "transforms", archive.about.get("coordinates"), identity["coordinates"])
    _expect_same_settings(path, archive.about.get("optimiser") or {}, identity["optimiser"])
    expect_same(path, "topology", archive.about.get("topologies"), topologies(like.parameters))
    groups: dict[str, dict[str, np.ndarray]] = {part: {} for part in (*PARTS, "history", "next")}
    for name, array in archive.arrays.items():
        part, _, rest = name.partition("/")
        if part not in groups:
            complain(path, f"it holds {name!r}; expected only {', '.join(groups)}")
        groups[part][rest] = array
    expect_same(path, "history", sorted(groups["history"]), sorted(HISTORY))
    form = archive.about.get("form", 1)
    parts = {part: restored(path, groups[part], getattr(like, part), form) for part in PARTS}
    history = {name: groups["history"][name].tolist() for name in HISTORY}
    best_iteration = archive.about["best_iteration"]
    values = [parts[part] for part in PARTS]
    snapshot = Snapshot(*values, iteration=len(history["loss"]), best_iteration=best_iteration, history=history)
    return snapshot, float(groups["next"]["loss"])


def expect_same_loss(place: Checkpoint, found: float, expected: float, dtype: Any) -> None:
    """CheckpointError where the loss at the stored parameters is another than when they were stored.

    The same program on the same machine gives the same bits; other machines and versions may differ by rounding.
    """
    slack = float(np.sqrt(np.finfo(dtype).eps)) * abs(expected)
    if not abs(found - expected) <= slack:
        complain(
            place.path,
            f"the loss at its parameters is {found!r}; expected {expected!r}, as when they were stored. The loss, its data or what it "
            "carries has changed: start anew without resume=True, from fit.parameters of the old run if they are a good start",
        )


def _expect_same_settings(path: Path, found: dict[str, str], expected: dict[str, str]) -> None:
    """CheckpointError naming the first setting of the optimiser that differs."""
    for name in sorted({*found, *expected}, key=lambda name: (name != "type", name)):
        expect_same(path, f"optimiser's {name}", found.get(name), expected.get(name))
