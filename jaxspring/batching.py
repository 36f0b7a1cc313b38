"""Many scenes at once: `vmap` in chunks that fit the cache, one after the other, and over several devices.

A step of one scene reads and writes a few arrays; those of a thousand scenes no longer fit the cache between one kernel and the next.
In chunks the same arithmetic runs out of the cache, and memory grows with the chunk, not with the batch.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh

from ._arrays import own, whole_number
from .processes import spread
from .sharing import shardings

CACHE = 2**18  # bytes of arguments in a chunk: with what a step adds to them they fit the second-level cache of one core
# Bytes of all arguments up to which one chunk is faster, since its long loops are shared by the cores: 2.2 MB were, 4.4 were not.
WHOLE = 3 * 2**20


def batch(function: Callable[..., Any], in_axes: Any = 0, *, chunk: int | None = None, mesh: Mesh | None = None) -> Callable[..., Any]:
    """The function of every scene of a batch, as `jax.vmap` gives it, in chunks; derivatives go through, scene by scene.

    Args:
        function: of one scene: arrays, states, systems in; arrays, states, a `Result` out.
        in_axes: for all arguments or for each in a tuple: the axis of the scenes, None for what all share; a tree of these for parts of an
            argument.
        chunk: scenes that are computed together; None takes what fits the cache. The memory of a run, and of its gradient, is that of a
            chunk beside arguments and results.
        mesh: devices that share the batch, each computing its own scenes; None computes where the arguments are. No device sees another's
            scenes. The number of scenes must be a multiple of that of the devices. Where these are of several processes, all call the
            function with the same arguments, and each holds the results of its own scenes.

    Returns:
        The function of batches; every array that it gives has the scenes on its first axis.

    Outside `jax.jit` every call compiles anew: make `jax.jit(js.batch(f))` once.

    Raises:
        ValueError: when it is called: axes of different lengths, no axis at all, a number of scenes that the devices cannot share.
        TypeError: a mesh or an axis that is none; an argument along an axis that is no array.

    >>> net = js.lattice(2)
    >>> def length(k):
    ...     system = js.System(net, 1.0, (js.Springs(net, k, 1.0), js.Drag(1.0)))
    ...     return js.rollout(system, js.State.from_points(net, [[0.0], [2.0]]), js.SymplecticEuler(), 0.1, 200).state.points[1, 0]
    >>> print(batch(length)(np.array([1.0, 4.0], np.float32)).round(2))
    [1.5 1.5]
    """
    if chunk is not None and whole_number("chunk", chunk) < 1:
        raise ValueError(f"chunk = {chunk}; expected 1 scene or more, or None.")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise TypeError(f"mesh is a {type(mesh).__name__}; expected a jax.sharding.Mesh, e.g. jax.make_mesh((2,), ('scenes',)).")

    @functools.wraps(function)
    def of_batch(*arguments: Any) -> Any:
        axes = tuple(in_axes) if isinstance(in_axes, tuple | list) else (in_axes,) * len(arguments)
        if len(axes) != len(arguments):
            raise ValueError(f"in_axes = {in_axes} has {len(axes)} entries for {len(arguments)} arguments.")
        leaves, tree = jax.tree.flatten(arguments, is_leaf=_is_none)
        each = jax.tree.leaves(jax.tree.broadcast(axes, arguments, is_leaf=_is_none), is_leaf=_is_none)
        is_mapped = [_is_of_each(a, axis) for a, axis in zip(leaves, each, strict=True)]
        along = [(own("an argument", a), axis) for a, axis, m in zip(leaves, each, is_mapped, strict=True) if m]
        size = _size(along)
        mapped = [jnp.moveaxis(a, axis, 0) for a, axis in along]
        common = [None if m else a for a, m in zip(leaves, is_mapped, strict=True)]
        # NumPy's arrays stay what they are: a number of steps, a list of edges.
        shared, rest = eqx.partition(common, lambda a: isinstance(a, jax.Array))

        def of_one(shared: list[Any], mapped: list[Any]) -> Any:
            each_own = iter(mapped)
            whole = zip(eqx.combine(shared, rest), is_mapped, strict=True)
            return function(*tree.unflatten([next(each_own) if m else a for a, m in whole]))

        if mesh is None:
            return _in_chunks(of_one, shared, mapped, size, chunk)
        return _on_devices(of_one, shared, mapped, size, chunk, mesh)

    return of_batch


def _is_of_each(leaf: Any, axis: Any) -> bool:
    """Whether each scene has its own of this leaf. Functions, words and what is None are shared whatever the axis."""
    if axis is None or leaf is None or isinstance(leaf, str) or (callable(leaf) and not hasattr(leaf, "__array__")):
        return False
    if isinstance(axis, bool) or not isinstance(axis, int | np.integer):
        raise TypeError(f"in_axes holds {axis!r}; expected whole numbers, and None for what all scenes share.")
    return True


def _is_none(leaf: Any) -> bool:
    return leaf is None


def _size(mapped: list[tuple[Any, int]]) -> int:
    """Number of scenes."""
    lengths = set()
    for a, axis in mapped:
        if not -np.ndim(a) <= axis < np.ndim(a):
            raise ValueError(
                f"an array of shape {np.shape(a)} has no axis {axis} of scenes. Let in_axes be None for what all scenes share."
            )
        lengths.add(a.shape[axis])
    if len(lengths) != 1:
        found = f"the arguments have axes of different lengths: {sorted(lengths)}" if lengths else "no argument has an axis of scenes"
        raise ValueError(f"{found}; expected one number of scenes. See in_axes.")
    return lengths.pop()


def _on_devices(of_one: Callable[..., Any], shared: list[Any], mapped: list[Any], size: int, chunk: int | None, mesh: Mesh) -> Any:
    """Each device its own scenes."""
    if size % mesh.size:
        raise ValueError(
            f"{size} scenes cannot be shared by {mesh.size} devices; expected a multiple of {mesh.size}. Repeat some to fill up."
        )
    n_here = size // mesh.size

    def of_device(shared: list[Any], mapped: list[Any]) -> Any:
        return _in_chunks(of_one, shared, mapped, n_here, chunk)

    scenes, whole = shardings(mesh)
    of_all = jax.shard_map(of_device, mesh=scenes.mesh, in_specs=(whole.spec, scenes.spec), out_specs=scenes.spec, check_vma=False)
    return of_all(spread(shared, whole), spread(mapped, scenes))


def _in_chunks(of_one: Callable[..., Any], shared: list[Any], mapped: list[Any], size: int, chunk: int | None) -> Any:
    """The scenes of one device."""
    together = jax.vmap(of_one, in_axes=(None, 0))
    count = size if size == 0 else min(size, _fitting(mapped, size) if chunk is None else chunk)
    if count == size:
        return together(shared, mapped)
    # A chunk's steps are computed again in reverse: what they leave is kept for one chunk at a time.
    again = jax.checkpoint(together, prevent_cse=False)
    whole = size - size % count
    rows = [a[:whole].reshape(whole // count, count, *a.shape[1:]) for a in mapped]
    found = lax.map(lambda row: again(shared, row), rows)
    found = jax.tree.map(lambda a: a.reshape(whole, *a.shape[2:]), found)
    if whole == size:
        return found
    last = together(shared, [a[whole:] for a in mapped])
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), found, last)


def _fitting(mapped: list[Any], size: int) -> int:
    """All scenes where they are few; else those whose arguments fit the cache: a number that leaves no rest, if there is one not much
    smaller.
    """
    of_scene = sum(a.dtype.itemsize * math.prod(a.shape[1:]) for a in mapped)
    if of_scene * size <= WHOLE:
        return size
    most = min(max(CACHE // max(of_scene, 1), 1), size)
    even = next(n for n in range(most, 0, -1) if size % n == 0)
    return even if 2 * even > most else most


__all__ = ["batch"]
