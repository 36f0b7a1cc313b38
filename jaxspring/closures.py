"""Functions of the user's that hold traced values, as pytrees: so that derivatives and batches reach what they close over.

A function is a leaf that JAX does not look into. The derivative of an implicit step is taken with respect to the leaves of a system:
one by a value that hides in a closure would be zero. So a `System` opens such functions.
"""

from __future__ import annotations

import functools
import types
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jax.core import Tracer

from .facts import attributes, content, held_by

# Deeper than any function of a user's: an object may hold itself.
_DEPTH = 8


class Closure(eqx.Module):
    """A function whose traced values are leaves.

    Attributes:
        rebuild: the function again, from its values (static).
        values: what it closes over, or was given in advance, where that is traced.
    """

    rebuild: Callable[[list[Any]], Callable[..., Any]] = eqx.field(static=True)
    values: list[Any]

    def __call__(self, *arguments: Any) -> Any:
        """What the function returns."""
        return self.rebuild(self.values)(*arguments)


def opened(effect: Any, name: str) -> Any:
    """The same part of a system with every function that holds a traced value as a `Closure`.

    Args:
        effect: a force, a rule or a motion.
        name: of it, for the message.

    Raises:
        TypeError: a function that holds a traced value where it cannot be taken out: in an attribute of an object, or in a module.
    """
    if not any(callable(leaf) and _holds_traced(leaf, _DEPTH, set()) for leaf in jax.tree.leaves(effect)):
        return effect
    return jax.tree.map(lambda leaf: _opened(leaf, name, frozenset()), effect)


def _opened(value: Any, name: str, within: frozenset[int]) -> Any:
    if not callable(value) or not _holds_traced(value, _DEPTH, set()):
        return value
    if not isinstance(value, types.FunctionType) and hasattr(value, "__wrapped__"):  # by jax.jit and its like
        return _opened(getattr(value, "__wrapped__", None), name, within)
    if isinstance(value, functools.partial):
        parts, make = (value.func, value.args, value.keywords), _as_partial
    elif isinstance(value, types.FunctionType) and id(value) not in within:
        cells = tuple(content(cell) for cell in value.__closure__ or ())
        parts, make = (cells, value.__defaults__, value.__kwdefaults__), functools.partial(_as_function, value)
    elif isinstance(value, types.MethodType) and jax.tree.leaves(value.__self__) != [value.__self__]:
        parts, make = (value.__func__, value.__self__), _as_method
    else:
        raise TypeError(
            f"{name} holds {getattr(value, '__qualname__', type(value).__name__)}, a function that reads a traced value from an object or "
            f"a module, where no derivative can reach it. Make it an equinox.Module with that value as a field, or a function that "
            f"closes over the value."
        )
    leaves, tree = jax.tree.flatten(parts)
    leaves = [_opened(leaf, name, within | {id(value)}) for leaf in leaves]
    if any(not isinstance(leaf, Tracer | Closure) and _holds_traced(leaf, _DEPTH, set()) for leaf in leaves):
        raise TypeError(
            f"{name} holds a function that closes over an object with a traced value, where no derivative can reach it. Make that object "
            f"an equinox.Module, or close over the value itself."
        )
    values = [leaf if isinstance(leaf, Tracer | Closure) else None for leaf in leaves]
    fixed = [None if isinstance(leaf, Tracer | Closure) else leaf for leaf in leaves]

    def rebuild(values: list[Any]) -> Callable[..., Any]:
        whole = [f if v is None else v for v, f in zip(values, fixed, strict=True)]
        return make(*jax.tree.unflatten(tree, whole))

    return Closure(rebuild, values)


def _as_partial(function: Callable[..., Any], arguments: tuple[Any, ...], named: dict[str, Any]) -> Callable[..., Any]:
    return functools.partial(function, *arguments, **named)


def _as_method(function: Callable[..., Any], owner: Any) -> Callable[..., Any]:
    return functools.partial(function, owner)


def _as_function(like: types.FunctionType, cells: tuple[Any, ...], defaults: Any, named: Any) -> Callable[..., Any]:
    made = types.FunctionType(like.__code__, like.__globals__, like.__name__, defaults, tuple(types.CellType(c) for c in cells))
    made.__kwdefaults__ = named
    return made


def _holds_traced(value: Any, depth: int, seen: set[int]) -> bool:
    """Whether a value is traced, or holds something that is: in a pytree, a function or an object."""
    if isinstance(value, Tracer):
        return True
    if depth == 0 or id(value) in seen or isinstance(value, types.ModuleType | type):
        return False
    seen.add(id(value))
    leaves = jax.tree.leaves(value)
    if len(leaves) != 1 or leaves[0] is not value:
        return any(_holds_traced(leaf, depth - 1, seen) for leaf in leaves)
    return _holds_traced(held_by(value) if callable(value) else attributes(value), depth - 1, seen)
