"""What a user passes, as an array of the library's own, or refused by name.

On the CPU `jnp.asarray` shares the memory of a NumPy array wherever its alignment allows: who changes that array afterwards changes the
simulation. So whatever is not an array of JAX (which nobody can change) is copied here, once, on the host. Here too is read what JAX
does not know: foreign byte orders, long doubles, object arrays of numbers, lists that hold traced numbers, masked arrays.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterable, Mapping, Sequence, Set
from decimal import Decimal
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array

# What a user may pass for numbers: a scalar, an array of any library, nested lists.
Numbers: TypeAlias = "ArrayLike | Sequence[Numbers]"
# And for the springs of a net: node numbers, (E, 2), or any series of pairs.
Edges: TypeAlias = "Numbers | Iterable[Sequence[int]]"

BUILD_OUTSIDE = "Build the net outside of jit, grad and vmap, and pass it in: one net is one program."


def given(name: str, value: Any) -> np.ndarray | Array:
    """`value` as an array of JAX where it is or holds one, else as a NumPy array, which may share the caller's memory.

    Raises:
        TypeError: text, dates, sets, mappings, and whatever else holds no numbers.
        ValueError: masked entries; rows of different lengths.
    """
    if isinstance(value, jax.Array):
        return value
    if isinstance(value, np.ma.MaskedArray):
        return _unmasked(name, value)
    if isinstance(value, np.ndarray | bool | int | float | np.generic):
        return _plain(name, np.asarray(value))
    if hasattr(value, "__jax_array__"):
        return value.__jax_array__()
    if isinstance(value, str | bytes | Set | Mapping):
        raise TypeError(f"{name} is {value!r:.60}, a {type(value).__name__}; expected numbers in an array or a list, in a fixed order.")
    if not isinstance(value, Sequence) and not hasattr(value, "__array__") and isinstance(value, Iterable):
        value = list(value)
    if isinstance(value, list | tuple):
        leaves = list(_leaves(value))
        if any(isinstance(leaf, np.ma.MaskedArray) and np.ma.getmaskarray(leaf).any() for leaf in leaves):
            raise ValueError(f"{name} holds masked entries, which have no value. Fill them, or leave out what they stand for.")
        if any(isinstance(leaf, Tracer) for leaf in leaves):
            return _stacked(name, value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{name} has rows of different lengths: {error}. Pass one array, or rows of one length.") from None
    return _plain(name, array)


def own(name: str, value: Any, dtype: Any = None) -> Array:
    """`value` as an array of JAX that shares its memory with nobody; of its own type, as far as JAX has it, unless `dtype` is given.

    Raises as `given` does.
    """
    array = value if isinstance(value, bool | int | float) else given(name, value)
    if not isinstance(array, np.ndarray):
        return jnp.asarray(array, dtype)
    wanted = array.dtype.newbyteorder("=") if dtype is None else np.dtype(dtype)
    if dtype is None and wanted.kind == "f" and wanted.itemsize > 8:
        wanted = np.dtype(np.float64)
    with np.errstate(over="ignore"):  # what overflows is infinite, which the checks find
        return jnp.asarray(np.array(array, jax.dtypes.canonicalize_dtype(wanted), order="C"))


def kept(value: Any) -> Any:
    """A leaf of a tree as it is, but NumPy arrays and lists as arrays of their own: for what users may build without a door.

    Whatever a transformation may put into a tree (None, a number, an object of its own) passes.
    """
    return own("value", value) if isinstance(value, np.ndarray | list) else value


def as_mask(name: str, value: Any, hint: str) -> np.ndarray | Array:
    """`value` as booleans, which may share the caller's memory.

    Raises:
        TypeError: anything else; `hint` says what was expected.
    """
    array = given(name, value)
    if array.dtype != np.bool_:
        raise TypeError(f"{name} has dtype {array.dtype}; expected booleans{hint}. Node numbers are not accepted.")
    return array


def as_indices(name: str, value: Any) -> np.ndarray:
    """`value` as an integer array on the host, which may share the caller's memory. Sets and the keys of mappings are taken in their order.

    Raises:
        TypeError: what is traced; numbers that are not whole numbers.
    """
    if isinstance(value, Set | Mapping):
        value = list(value)
    array = given(name, value)
    if isinstance(array, Tracer):
        raise TypeError(f"{name} is traced (made inside jit, grad or vmap), but says which nodes are joined. {BUILD_OUTSIDE}")
    array = np.asarray(array)
    if array.size and (array.dtype == np.bool_ or not np.issubdtype(array.dtype, np.integer)):
        raise TypeError(
            f"{name} has dtype {array.dtype}, e.g. {name}[0] = {array[0] if array.ndim else array}; expected integer node numbers. "
            f"JAX would read a bool as a mask."
        )
    return array


def whole_number(name: str, value: Any) -> int:
    """`value` as an int.

    Raises:
        TypeError: what is traced, or not a whole number.
    """
    if isinstance(value, Tracer):
        raise TypeError(f"{name} is traced (made inside jit, grad or vmap), but decides on shapes. {BUILD_OUTSIDE}")
    is_whole = isinstance(value, int | np.integer) or (
        isinstance(value, np.ndarray | jax.Array) and value.ndim == 0 and jnp.issubdtype(value.dtype, jnp.integer)
    )
    if isinstance(value, bool) or not is_whole:
        raise TypeError(f"{name} = {value!r:.60}; expected a whole number.")
    return int(value)


def on_host(name: str, value: Any, may_be_boolean: bool = False) -> np.ndarray:
    """`value` as a float64 array on the host, which may share the caller's memory: for what decides on a net.

    Raises:
        TypeError: what is traced, or holds no real numbers.
    """
    array = given(name, value)
    if isinstance(array, Tracer):
        raise TypeError(f"{name} is traced (made inside jit, grad or vmap), but decides on which nodes are joined. {BUILD_OUTSIDE}")
    array = np.asarray(array)
    if array.dtype.kind not in "iuf" and not (may_be_boolean and array.dtype == np.bool_):
        raise TypeError(f"{name} has dtype {array.dtype}; expected real numbers.")
    with np.errstate(over="ignore"):
        return array.astype(np.float64, copy=False)


def _leaves(value: Any) -> Iterable[Any]:
    for part in value:
        if isinstance(part, list | tuple):
            yield from _leaves(part)
        else:
            yield part


def _unmasked(name: str, value: np.ma.MaskedArray) -> np.ndarray:
    mask = np.ma.getmaskarray(value)
    if mask.any():
        index = [int(i) for i in np.argwhere(mask)[0]]
        raise ValueError(
            f"{name}{index if index else ''} is masked ({int(mask.sum())} of {mask.size} entries are), so that it has no value. Unchecked, "
            f"the number that happens to lie under the mask would be taken. Pass {name}.filled(...), or leave out what it stands for."
        )
    return _plain(name, np.asarray(value.data))


def _stacked(name: str, value: Any) -> Array:
    """A list that holds traced numbers, as one array."""
    try:
        return jnp.stack([_stacked(name, part) if isinstance(part, list | tuple) else jnp.asarray(part) for part in value])
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"{name} is a list with traced entries that do not make one array: {error} Pass one array, e.g. jnp.stack of arrays of one "
            f"shape and type."
        ) from None


def _plain(name: str, array: np.ndarray) -> np.ndarray:
    """The array, which holds numbers or booleans; objects are taken where each is a number."""
    if array.dtype.kind in "biufc":
        return array
    if array.dtype.kind == "O":
        return _from_objects(name, array)
    if array.dtype.kind == "V" and array.dtype.names is None and jnp.issubdtype(array.dtype, jnp.number):
        return array  # the small types that JAX adds to NumPy; the doors say what they take
    what = {"U": "text", "S": "text", "T": "text", "M": "dates", "m": "spans of time"}.get(array.dtype.kind, "no plain numbers")
    raise TypeError(f"{name} has dtype {array.dtype}: {what}; expected numbers, e.g. {name}.astype(float) where that is meant.")


def _from_objects(name: str, array: np.ndarray) -> np.ndarray:
    entries = array.ravel()
    for i, entry in enumerate(entries):
        is_scalar = isinstance(entry, numbers.Real | Decimal) or (isinstance(entry, np.ndarray | jax.Array) and entry.ndim == 0)
        if not is_scalar:
            index = [int(k) for k in np.unravel_index(i, array.shape)]
            raise TypeError(f"{name}{index if index else ''} = {entry!r:.60}, a {type(entry).__name__}; expected a number.")
    if all(isinstance(entry, bool | np.bool_) for entry in entries):
        return array.astype(bool)
    if all(isinstance(entry, numbers.Integral) and not isinstance(entry, bool) and abs(int(entry)) < 2**63 for entry in entries):
        return array.astype(np.int64)
    try:
        return array.astype(np.float64)
    except (OverflowError, TypeError, ValueError) as error:
        raise ValueError(f"{name} holds a number that float64 has not: {error}.") from None


__all__ = ["BUILD_OUTSIDE", "as_indices", "as_mask", "given", "kept", "on_host", "own", "whole_number"]
