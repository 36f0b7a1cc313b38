"""What several processes hold together: laid out over all of them, brought to one place, written by one.

`jax.distributed.initialize` makes the devices of several processes one mesh. All run the same program, and each holds its own part of an
array that is spread over that mesh. Bringing parts together is a collective: every process must come to it. One that has ended is a
`ConnectionError` in the others, not a wait without end.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.sharding import Sharding
from jaxtyping import Array

PyTree = Any


def is_spread(tree: PyTree) -> bool:
    """Whether other processes hold parts of an array in a tree."""
    return any(map(_is_spread, jax.tree.leaves(tree)))


def is_readable(tree: PyTree) -> bool:
    """Whether this process can read every array of a tree by itself: what each process holds whole is read by each."""
    return not any(_is_spread(leaf) and not leaf.is_fully_replicated for leaf in jax.tree.leaves(tree))


def spread(tree: PyTree, sharding: Sharding) -> PyTree:
    """The arrays of a tree laid out over a mesh; where that is one of several processes, each must have the same arrays.

    Raises:
        AssertionError: processes have different numbers. JAX compares them.
    """

    def one(a: Array) -> Array:
        is_bound = not (sharding.is_fully_addressable or isinstance(a, Tracer) or _is_spread(a)) and a.committed
        # An array that was put on one device is moved within its process alone; the host's may go anywhere.
        return jax.device_put(np.asarray(a) if is_bound else a, sharding)

    return jax.tree.map(one, tree)


def placed(array: np.ndarray, sharding: Sharding | None) -> Array:
    """An array of this host laid out as told, each process taking its part; wherever JAX puts arrays where nothing is told."""
    if sharding is None:
        return jnp.asarray(array)
    return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])


def gathered(tree: PyTree) -> PyTree:
    """The tree with arrays that are spread over processes whole on every host, as NumPy arrays; all else as it is.

    Raises:
        ConnectionError: another process has ended.
    """

    def one(a: Any) -> Any:
        if is_readable(a):
            return np.asarray(a) if _is_spread(a) else a
        return _together(a)

    return jax.tree.map(one, tree)


def write_by_one(path: str | os.PathLike[str], tree: PyTree, write: Callable[[PyTree], None]) -> None:
    """Call `write` with the tree; where processes hold it together, in process 0 alone, while the others wait until it has written.

    Args:
        path: of the file, for messages.
        tree: what is written.
        write: writes it, given whole.

    Raises:
        ConnectionError: another process has ended.
        OSError: process 0 could not write; there, whatever `write` raised.
    """
    if not is_spread(tree):
        write(tree)
        return
    whole, failure = gathered(tree), None
    if jax.process_index() == 0:
        try:
            write(whole)
        except Exception as error:  # the others wait for the outcome
            failure = error
    has_failed = _together(np.asarray(failure is not None))
    if failure is not None:
        raise failure
    if has_failed.any():
        raise OSError(f"{os.fspath(path)} was not written: process 0 could not, and says why.")


def _is_spread(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and not isinstance(leaf, Tracer) and not leaf.is_fully_addressable


def _together(a: Any) -> np.ndarray:
    """The whole array; of one that is not spread, that of every process, stacked."""
    try:
        return multihost_utils.process_allgather(a, tiled=_is_spread(a))
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # an error that comes late is a ValueError
        raise ConnectionError(
            f"another process has ended or cannot be reached, so that arrays which all of them hold cannot be brought together "
            f"({str(error).splitlines()[0]:.200}). Start all processes again, and go on from the last file that was saved: it is whole."
        ) from error


__all__ = ["gathered", "is_readable", "is_spread", "placed", "spread", "write_by_one"]
