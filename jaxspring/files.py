"""Saving and loading systems, states and any tree of arrays.

Every array leaf is stored under its path, such as `forces/0/stiffness`; structure, functions and everything static come from the
`like` given to `load`, which must agree in names, shapes, types and topology. See `archive` for the format and what it withstands.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .archive import CheckpointError, Path, read_archive, write_archive
from .memory import Memory, without_caches
from .numbering import inward, outward
from .processes import placed, write_by_one
from .state import State
from .topology.base import Topology
from .topology.edge_field import EdgeField

PyTree = Any
FORM = 2


def save(path: Path, tree: PyTree) -> None:
    """Save a system, a state, or any tree whose leaves are arrays and numbers, atomically.

    Args:
        path: the file; `.npz` is the fitting suffix, since `numpy.load` opens it.
        tree: what to save. States, systems and edge fields are stored in the user's order of nodes and springs; a bare `Vector` or array as
            it is, which on a graph is the graph's own order: save `net.flatten_nodes(a)` of it instead. Leaves that are no
            arrays or numbers (functions) are not stored: `load` takes them from `like`.

    However many devices hold an array, one whole array is stored. Where its devices are of several processes, all of these call `save`:
    process 0 writes, and none returns before the file is there.

    Raises:
        TypeError: a leaf holds something other than real or complex numbers or booleans; half precision that NumPy lacks.
        ValueError: a name in the tree cannot be stored ('../x').
        OSError: the disk is full; the file that was there is still there. Another process has ended (`ConnectionError`).

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save(folder + "/two.npz", {"stiffness": 3.0})
    ...     print(load(folder + "/two.npz", like={"stiffness": 0.0}))
    {'stiffness': 3.0}
    """
    tree = without_caches(tree)
    about = {"kind": "tree", "form": FORM, "topologies": topologies(tree), "edge_fields": edge_fields(tree), "owners": owners(tree)}
    write_by_one(path, tree, lambda whole: write_archive(path, named_arrays(whole), about))


def load(path: Path, like: PyTree = None) -> PyTree:
    """Load what `save` wrote.

    Args:
        path: the file.
        like: a tree of the same structure, shapes and types, such as a freshly built system; its numbers are replaced.
            None returns a plain dictionary, name -> NumPy array.

    Returns:
        A tree as `like`, with the numbers of the file, each array on the devices of that in `like`; which devices it was saved from does
        not matter.

    Raises:
        CheckpointError: the file is damaged or of another version, or does not fit `like`; both sides are named.
        OSError: there is no such file.
    """
    archive = read_archive(path)
    if like is None:
        return archive.arrays
    expect_same(path, "topology", archive.about.get("topologies"), topologies(like))
    expect_same_springs(path, archive.about.get("edge_fields", {}), edge_fields(like))
    expect_same_owners(path, archive.about.get("owners", {}), owners(like))
    return restored(path, archive.arrays, without_caches(like), archive.about.get("form", 1))


def save_trajectory(path: Path, states: State, net: Topology | None = None) -> None:
    """Save frames as an `.npz` that `numpy.load` opens: `time` (F,) [s], `points` and `velocities` (F, N, D) [m, m/s].

    Args:
        path: the file.
        states: a rollout's `Result` with saved states, or a `State` with a leading axis of frames.
        net: adds `edges` (E, 2), the topology's node pairs.

    Raises:
        ValueError: nothing was saved in the rollout, or not whole states.
    """
    frames = states if isinstance(states, State) else states.saved
    if not isinstance(frames, State) or np.ndim(frames.time) != 1:
        raise ValueError(
            f"There are no frames of whole states to save (got {type(frames).__name__}). Run rollout with save_every and without observe."
        )
    arrays = {"time": np.asarray(frames.time), "points": np.asarray(frames.points), "velocities": np.asarray(frames.velocities)}
    if net is not None:
        arrays["edges"] = np.asarray(net.edges)
    write_archive(path, arrays, {"kind": "trajectory"})


def leaf_name(path: tuple[Any, ...]) -> str:
    """The path of a leaf as words joined by '/', such as `forces/0/stiffness`; `value` for a tree that is one leaf."""
    return jax.tree_util.keystr(path, simple=True, separator="/") or "value"


def named_arrays(tree: PyTree) -> dict[str, np.ndarray]:
    """Every array or number in a tree under its name, on the host, in the user's order of nodes and springs."""
    found: dict[str, np.ndarray] = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(outward(tree)):
        if not eqx.is_array_like(leaf) or isinstance(leaf, jax.ShapeDtypeStruct):
            continue
        name = leaf_name(path)
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            raise TypeError(f"{name} is a random key; save jax.random.key_data of it and wrap it again after loading.")
        if name in found:
            raise ValueError(f"Two leaves are called {name!r}; rename one of the dictionary keys that hold a '/'.")
        found[name] = np.asarray(leaf)
    return found


def restored(path: Path, arrays: Mapping[str, np.ndarray], like: PyTree, form: int = FORM) -> PyTree:
    """`like` with its arrays and numbers replaced by those of the same name.

    Args:
        path: the file, for messages.
        arrays: what it holds.
        like: where they belong.
        form: of the file: 1 where it does not say, with a graph's arrays in the graph's own order; 2 since they are in the user's.

    Raises:
        CheckpointError: names, shapes or types differ; a file of an older form that holds what is kept otherwise now.
    """
    if form < FORM:
        arrays = _of_form_1(path, arrays, like)
    leaves, treedef = jax.tree_util.tree_flatten_with_path(like)
    wanted = {leaf_name(p) for p, leaf in leaves if _is_stored(leaf)}
    missing, unknown = sorted(wanted - set(arrays)), sorted(set(arrays) - wanted)
    if missing or unknown:
        is_memory = any("memory" in name.split("/") for name in (*missing, *unknown))
        hint = ". For a state that remembers something pass like=system.begin(state), by which every part has its memory" * is_memory
        complain(path, f"it lacks {missing[:5]} and has {unknown[:5]} that `like` does not know; expected {sorted(wanted)[:8]}{hint}")
    found = treedef.unflatten([_fitted(path, leaf_name(p), arrays, leaf) for p, leaf in leaves])
    return jax.tree.map(_placed, found if form < FORM else inward(found), like)


def _of_form_1(path: Path, arrays: Mapping[str, np.ndarray], like: PyTree) -> Mapping[str, np.ndarray]:
    """The arrays of an older file, without the lists of neighbours that it holds.

    Raises:
        CheckpointError: the books of a ledger, which stood elsewhere; a heat on a graph, whose node arrays were in the graph's own order.
    """
    remedy = "load it with the jaxspring that wrote it, or run again"
    kept = {name: a for name, a in arrays.items() if "neighbours" not in name.split("/")}
    if any("ledger" in name.split("/") for name in kept):
        complain(path, f"it is of form 1 and holds a ledger's books, which stand in state.memory since form {FORM}; {remedy}")
    for heat in jax.tree.leaves(like, is_leaf=lambda leaf: hasattr(leaf, "conductance")):
        net = getattr(heat, "net", None)
        if hasattr(heat, "conductance") and isinstance(net, Topology) and net.node_permutation is not None:
            complain(
                path, f"it is of form 1 and holds a Heat on a graph, whose node values are in the user's order since form {FORM}; {remedy}"
            )
    return kept


def topologies(tree: PyTree) -> dict[str, Any]:
    """Node shape, spring count and a digest of the edges of every topology in a tree, by name."""
    found = {}
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: isinstance(x, Topology)):
        if isinstance(leaf, Topology):
            edges = np.ascontiguousarray(leaf.edges, "<i8")
            digest = hashlib.sha256(edges.data).hexdigest()[:16] if edges.size else ""
            called = {} if leaf.identity.name is None else {"name": leaf.identity.name}
            found[leaf_name(path)] = {"nodes": list(leaf.node_shape), "springs": leaf.n_springs, "edges": digest, **called}
    return found


def edge_fields(tree: PyTree) -> dict[str, str]:
    """For every edge field in a tree that says whose springs it is about, the digest of that net, by name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: isinstance(x, EdgeField))
    fields = {leaf_name(path): leaf for path, leaf in leaves if isinstance(leaf, EdgeField)}
    return {name: field.identity.digest for name, field in fields.items() if field.identity is not None}


def owners(tree: PyTree) -> dict[str, str]:
    """For every memory in a tree, the class of the part that it is of, by name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: isinstance(x, Memory))
    return {leaf_name(path): leaf.owner.kind for path, leaf in leaves if isinstance(leaf, Memory)}


def expect_same_owners(path: Path, found: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """CheckpointError where what one effect remembers would be read by another."""
    for name, was, wanted in _differing(found, expected):
        complain(path, f"its {name!r} is what a {was} remembers; expected that of a {wanted}, the part of `like` there")


def expect_same_springs(path: Path, found: Mapping[str, str], expected: Mapping[str, str]) -> None:
    """CheckpointError where an edge field of the file is of another net than that of `like`; older files, and fields made by hand, do
    not say.
    """
    for name, was, wanted in _differing(found, expected):
        complain(path, f"its {name!r} is about the springs of net {was}; expected those of {wanted}, the net of `like` there")


def _differing(found: Mapping[str, str], expected: Mapping[str, str]) -> Iterator[tuple[str, str, str]]:
    """What both have under a name, where it differs: (name, found, expected)."""
    names = sorted(set(found) & set(expected))
    return ((name, found[name], expected[name]) for name in names if found[name] != expected[name])


def expect_same(path: Path, what: str, found: Any, expected: Any) -> None:
    """CheckpointError naming both where they differ."""
    if found != expected:
        complain(path, f"its {what} is {found}; expected {expected}")


def complain(path: Path, problem: str) -> None:
    """Raise the CheckpointError of this file."""
    raise CheckpointError(" ".join(f"{os.fspath(path)}: {problem}.".split()))


def _is_stored(leaf: Any) -> bool:
    return eqx.is_array_like(leaf) or isinstance(leaf, jax.ShapeDtypeStruct)


def _fitted(path: Path, name: str, arrays: Mapping[str, np.ndarray], leaf: Any) -> Any:
    """The stored array where `leaf` is one, a number where it is a number."""
    if not _is_stored(leaf):
        return leaf
    array = arrays[name]
    shape, dtype = (leaf.shape, np.dtype(leaf.dtype)) if hasattr(leaf, "dtype") else ((), np.asarray(leaf).dtype)
    if tuple(array.shape) != tuple(shape) or array.dtype != dtype:
        complain(path, f"{name!r} has shape {array.shape} and dtype {array.dtype}; expected shape {tuple(shape)} and dtype {dtype}")
    if isinstance(leaf, np.ndarray | jax.Array | jax.ShapeDtypeStruct):
        return array
    return array[()] if isinstance(leaf, np.generic) else array.item()


def _placed(array: Any, leaf: Any) -> Any:
    """The array of JAX on the devices of `leaf`, where that is one; what was put nowhere is put nowhere."""
    if not isinstance(leaf, jax.Array | jax.ShapeDtypeStruct):
        return array
    is_bound = isinstance(leaf, jax.ShapeDtypeStruct) or getattr(leaf, "committed", False)
    return placed(array, leaf.sharding if is_bound else None)
