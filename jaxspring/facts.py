"""What of an object is fixed when a program is compiled, as text: types, shapes, options, and functions by what they say.

Text is compared where objects cannot be: between processes, after pickling, and where a function was written anew but says the same.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import hashlib
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Fact = tuple[str, str]
# Deeper than any object of the library: a user's object may hold itself.
_DEPTH = 16
_PLAIN = (bool, int, float, complex, str, bytes, type(None), enum.Enum, np.dtype, np.generic, slice)


def facts(value: Any, path: str = "") -> tuple[Fact, ...]:
    """The facts about a value, each with the path where it stands, such as ("solver.tolerance", "1e-08").

    Of an array only shape and type, since its numbers may be traced; of one that is an option or that a function holds, its numbers too.
    """
    return tuple(_facts(value, path, False, _DEPTH, set()))


def digest(found: tuple[Fact, ...]) -> str:
    """Facts as a short text: equal where they are."""
    return hashlib.sha256(repr(found).encode()).hexdigest()[:32]


def of_functions(*trees: Any) -> str:
    """What the functions in a scene hold, as text, by which a program is told from one of the same functions that held something else."""
    held = [leaf for leaf in jax.tree.leaves(trees) if callable(leaf)]
    return digest(facts(held)) if held else ""


def _facts(value: Any, path: str, is_fixed: bool, depth: int, seen: set[int]) -> Iterator[Fact]:
    if depth == 0:
        return
    if isinstance(value, jax.Array | np.ndarray):
        yield path, _of_array(value, is_fixed)
    elif isinstance(value, _PLAIN):
        yield path, repr(value)
    elif isinstance(value, type):
        yield path, _name(value)
    elif isinstance(value, tuple | list):
        yield path, f"{type(value).__name__} of {len(value)}"
        for i, entry in enumerate(value):
            yield from _facts(entry, f"{path}[{i}]", is_fixed, depth - 1, seen)
    elif isinstance(value, dict):
        for key in sorted(value, key=repr):
            yield from _facts(value[key], f"{path}[{key!r}]", is_fixed, depth - 1, seen)
    elif callable(value) and not dataclasses.is_dataclass(value):
        yield from _of_function(value, path, depth, seen)
    else:
        yield path, _name(type(value))
        for name, part, fixed in _parts(value):
            yield from _facts(part, f"{path}.{name}" if path else name, is_fixed or fixed, depth - 1, seen)


def _parts(value: Any) -> Iterator[tuple[str, Any, bool]]:
    """Fields of an object, and whether each is fixed when a program is compiled."""
    if not dataclasses.is_dataclass(value):
        yield from ((name, part, True) for name, part in sorted(attributes(value).items()))
        return
    # An object that JAX does not know is a leaf, and as a whole fixed.
    is_tree = not any(leaf is value for leaf in jax.tree.leaves(value))
    for field in dataclasses.fields(value):
        if hasattr(value, field.name):
            yield field.name, getattr(value, field.name), not is_tree or field.metadata.get("static", False)


def _of_array(value: Any, is_fixed: bool) -> str:
    kind = f"{value.dtype}{tuple(value.shape)}"
    if not is_fixed or isinstance(value, Tracer) or jnp.issubdtype(value.dtype, jax.dtypes.extended):
        return kind
    return f"{kind} {hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()[:16]}"


def attributes(value: Any) -> dict[str, Any]:
    """What an object holds, by name, in `__dict__` or in slots."""
    slots = (name for kind in type(value).__mro__ for name in np.atleast_1d(getattr(kind, "__slots__", ())).tolist())
    held = {name: getattr(value, name) for name in slots if name not in ("__dict__", "__weakref__") and hasattr(value, name)}
    return {**held, **getattr(value, "__dict__", {})}


def _of_function(function: Any, path: str, depth: int, seen: set[int]) -> Iterator[Fact]:
    """Its name, its code and what it holds: what it closes over, what it reads from its module, or its fields as an object."""
    name = getattr(function, "__qualname__", _name(type(function)))
    yield path, f"{name} {_of_code(function.__code__)}" if isinstance(function, types.FunctionType) else name
    if isinstance(function, types.FunctionType):
        if id(function) in seen:  # told already, or calling itself
            return
        seen.add(id(function))
    yield from _facts(held_by(function), f"{path}()", True, depth - 1, seen)


def held_by(function: Any) -> Any:
    """What a function holds besides its code."""
    if isinstance(function, functools.partial):
        return function.func, function.args, function.keywords
    if isinstance(function, types.MethodType):
        return function.__func__, function.__self__
    if isinstance(function, types.FunctionType):
        closed = tuple(content(cell) for cell in function.__closure__ or ())
        return function.__defaults__, function.__kwdefaults__, closed, _read_from_module(function)
    if isinstance(function, types.BuiltinFunctionType):
        return None
    return attributes(function), vars(type(function)).get("__call__")


def _read_from_module(function: types.FunctionType) -> dict[str, Any]:
    """The values that a function reads from its module by name. Modules and classes, and functions of other modules, stay as they are."""
    held = {name: function.__globals__[name] for name in function.__code__.co_names if name in function.__globals__}
    fixed = types.ModuleType | type | types.BuiltinFunctionType
    return {
        name: value
        for name, value in held.items()
        if not isinstance(value, fixed) and getattr(value, "__module__", function.__module__) in (function.__module__, None)
    }


def _of_code(code: types.CodeType) -> str:
    constants = [_of_code(c) if isinstance(c, types.CodeType) else repr(c) for c in code.co_consts]
    return hashlib.sha256(repr((code.co_code, code.co_names, constants)).encode()).hexdigest()[:16]


def content(cell: types.CellType) -> Any:
    """What a cell of a closure holds; None before it is filled."""
    try:
        return cell.cell_contents
    except ValueError:
        return None


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
