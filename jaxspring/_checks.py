"""Checks made once, on the host, when an object is built.

JAX clamps a bad index, drops it in a scatter, and gives it gradient zero, all without a word; a NaN spreads. So every
constructor looks at its input first and names the field, the index, what was expected and what to do. A traced value (inside
`jit`, `grad` or `vmap`) cannot be looked at: then only its shape and dtype are checked, and its value at step 0, by status.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from ._arrays import as_indices, given, own


def shape_of(value: Any) -> tuple[int, ...]:
    """Shape of an array, a tracer, a number or a shape struct."""
    return tuple(np.shape(value)) if not hasattr(value, "shape") else tuple(value.shape)


def is_concrete(value: Any) -> bool:
    """Whether the numbers in `value` can be looked at now."""
    return isinstance(value, (bool, int, float, np.ndarray, np.generic, list, tuple)) or (
        isinstance(value, jax.Array) and not isinstance(value, Tracer)
    )


def as_inexact(name: str, value: Any, dtype: Any = None) -> Array:
    """`value` as a float32 or float64 array of the library's own: integers are converted, half precision and complex numbers refused.

    What is no array of JAX is copied: the caller may change it afterwards. Lists may hold traced numbers.
    """
    array = given(name, value)
    kind = array.dtype
    if kind == jnp.bool_ or not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise TypeError(f"{name} has dtype {kind}; expected real numbers. Convert it, e.g. {name}.astype(float).")
    if jnp.issubdtype(kind, jnp.floating) and jnp.finfo(kind).bits < 32:
        raise TypeError(
            f"{name} has dtype {kind}: half precision holds 3 digits, too few for a difference of positions. "
            f"Use float32 or float64, e.g. {name}.astype('float32')."
        )
    if dtype is None:
        is_single = jnp.issubdtype(kind, jnp.floating) and kind.itemsize == 4
        dtype = np.float32 if is_single else jnp.result_type(float)
    return own(name, array, jax.dtypes.canonicalize_dtype(dtype))


def finite(name: str, value: Any) -> None:
    """Raise ValueError naming the first NaN or infinity in `value`."""
    if not is_concrete(value):
        return
    numbers = np.asarray(value)
    bad = ~np.isfinite(numbers)
    if bad.any():
        where, shown = _first(bad, numbers)
        raise ValueError(
            f"{name}{where} = {shown}, but must be finite. Unchecked, it would spread to every node it can reach. "
            f"Fix {name}{where} ({int(bad.sum())} of {numbers.size} values are not finite)."
        )


def positive(name: str, value: Any, why: str) -> None:
    """Raise ValueError naming the first number that is not above zero."""
    _sign(name, value, why, strict=True)


def nonnegative(name: str, value: Any, why: str) -> None:
    """Raise ValueError naming the first number below zero."""
    _sign(name, value, why, strict=False)


def _sign(name: str, value: Any, why: str, *, strict: bool) -> None:
    if not is_concrete(value):
        return
    finite(name, value)
    numbers = np.asarray(value)
    bad = numbers <= 0 if strict else numbers < 0
    if bad.any():
        where, shown = _first(bad, numbers)
        expected = "positive" if strict else "zero or more"
        raise ValueError(f"{name}{where} = {shown}, but must be {expected}. {why} Fix {name}{where}.")


def constant(name: str, value: Any, why: str, may_be_zero: bool = False) -> Array:
    """`value` as one finite number above zero, or zero where that is allowed; `why` says what a wrong sign would do.

    Raises:
        TypeError: not a real number.
        ValueError: an array, not finite, or of the wrong sign.
    """
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": ()})
    _sign(name, value, why, strict=not may_be_zero)
    return value


def kind(name: str, value: Any, expected: type, example: str) -> Any:
    """`value`, an object of the class `expected`; else TypeError, with an example of what to pass."""
    if isinstance(value, type):
        raise TypeError(f"{name} is the class {value.__name__}; expected a {expected.__name__}. Make one: {example}.")
    if not isinstance(value, expected):
        shown = " ".join(repr(value).split())
        raise TypeError(f"{name} is {shown:.60}, a {type(value).__name__}; expected a {expected.__name__}, e.g. {example}.")
    return value


def has_shape(name: str, value: Any, allowed: dict[str, tuple[int, ...]]) -> None:
    """Raise ValueError unless the shape of `value` is one of `allowed` (a table of meaning -> shape)."""
    shape = shape_of(value)
    if shape not in allowed.values():
        listed = ", or ".join(f"{expected} ({meaning})" for meaning, expected in allowed.items())
        raise ValueError(f"{name} has shape {shape}; expected {listed}.")


def node_indices(name: str, edges: Any, n_nodes: int) -> np.ndarray:
    """`edges` as an (E, 2) integer array whose every entry names a node 0 ... n_nodes - 1."""
    array = as_indices(name, edges)
    if array.size == 0:
        return np.zeros((0, 2), np.int32)
    if array.ndim != 2 or array.shape[1] != 2:
        raise ValueError(f"{name} has shape {array.shape}; expected (E, 2): tail and head node of each spring.")
    bad = (array < 0) | (array >= n_nodes)
    if bad.any():
        spring, end = (int(i) for i in np.argwhere(bad)[0])
        pair = tuple(int(i) for i in array[spring])
        node = pair[end]
        raise ValueError(
            f"{name}[{spring}] = {pair} names node {node}, but there are n_nodes = {n_nodes} (nodes are 0 to {n_nodes - 1}).\n"
            f"Unchecked, JAX would read another node instead and drop the pull on node {node}, without a word.\n"
            f"Fix {name}[{spring}]" + (f", or pass n_nodes={node + 1} if node {node} exists." if node >= 0 else ".")
        )
    loops = array[:, 0] == array[:, 1]
    if loops.any():
        spring = int(np.argmax(loops))
        raise ValueError(
            f"{name}[{spring}]: spring {spring} joins node {int(array[spring, 0])} to itself. Its length is always 0 and its "
            f"direction undefined. Remove {name}[{spring}]."
        )
    return array.astype(np.int32)


def triangle_indices(name: str, triangles: Any, n_nodes: int) -> np.ndarray:
    """`triangles` as a (T, 3) integer array of its own in which each names three different nodes 0 ... n_nodes - 1."""
    array = as_indices(name, triangles)
    if array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise ValueError(f"{name} has shape {array.shape}; expected (T, 3): three node numbers for each of T >= 1 triangles.")
    bad = (array < 0) | (array >= n_nodes)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"{name}[{row}] = {tuple(array[row].tolist())} names node {array[row, column]}, but there are n_nodes = {n_nodes} "
            f"(nodes are 0 to {n_nodes - 1}).\nUnchecked, JAX would read another node instead. Fix {name}[{row}]."
        )
    a, b, c = array.T
    same = (a == b) | (b == c) | (c == a)
    if same.any():
        row = int(np.argmax(same))
        raise ValueError(f"{name}[{row}] = {tuple(array[row].tolist())} has a corner twice: it is no triangle. Remove it.")
    return array.astype(np.int32)


def node_values(name: str, value: Any) -> Array:
    """`value` as one number or a node array, for what has no net at hand to tell the shape.

    Raises:
        ValueError: more axes than a net has, or a number that is not finite.
    """
    value = as_inexact(name, value)
    if value.ndim > 3:
        raise ValueError(f"{name} has shape {value.shape}; expected () (one number), or one number per node.")
    finite(name, value)
    return value


def fits_nodes(name: str, value: Array, state: Any) -> Array:
    """`value`, which must be one number or an array in the node shape of `state`: other shapes would be stretched over the nodes.

    Raises:
        ValueError: another shape.
    """
    has_shape(name, value, {"one number": (), "node shape: see net.node_field": tuple(state.position.shape)})
    return value


def _first(bad: np.ndarray, numbers: np.ndarray) -> tuple[str, str]:
    index = tuple(int(i) for i in np.argwhere(bad)[0])
    where = "" if not index else "[" + ", ".join(map(str, index)) + "]"
    return where, str(numbers[index])


def plane(point: Any, normal: Any) -> tuple[Array, Array]:
    """(D,) a point of a plane [m] and its unit normal, from a normal of any length.

    Raises:
        ValueError: shapes that are not (D,) or differ, what is not finite, a normal without length.
    """
    point, normal = as_inexact("point", point), as_inexact("normal", normal)
    for name, value in (("point", point), ("normal", normal)):
        finite(name, value)
        if value.ndim != 1 or value.shape[0] not in (1, 2, 3) or value.shape != point.shape:
            raise ValueError(f"{name} has shape {value.shape}; expected (D,), one number per coordinate, e.g. (0, 0, 1).")
    length = jnp.sqrt(jnp.sum(normal**2))
    if is_concrete(length) and not length > 0:
        raise ValueError("normal has no length, so the plane no direction. Pass e.g. normal=(0, 0, 1).")
    return point, normal / length
