"""What an optimiser is, in words that can be compared: its type and settings, also those that optax hides in closures."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
from typing import Any

import jax
import numpy as np

# Optax nests closures: a chain of schedules of an injected optimiser is six deep.
DEEPEST = 12


def fingerprint(thing: Any) -> dict[str, str]:
    """Settings by name, such as {"type": "Adam", "learning_rate": "0.05"}.

    Functions are known by their name and by what they close over; arrays by shape, type and content.
    """
    found: dict[str, str] = {}
    _describe(thing, "type", found, frozenset())
    return found


def _describe(thing: Any, name: str, found: dict[str, str], above: frozenset[int]) -> None:
    """Add what `thing` is under `name`, and its parts under longer names."""
    if id(thing) in above or len(above) > DEEPEST:
        return
    above = above | {id(thing)}
    prefix = "" if name == "type" else f"{name}/"
    if isinstance(thing, (np.ndarray, jax.Array)):
        array = np.asarray(thing)
        digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
        found[name] = repr(array.item()) if array.ndim == 0 else f"{array.dtype}{list(array.shape)} {digest}"
    elif isinstance(thing, (bool, int, float, complex, str, bytes, type(None), np.generic, np.dtype)):
        found[name] = repr(thing)
    elif inspect.isfunction(thing) or inspect.ismethod(thing):
        _describe_function(thing, name, prefix, found, above)
    elif isinstance(thing, functools.partial):
        for part in ("func", "args", "keywords"):
            _describe(getattr(thing, part), f"{prefix}{part}", found, above)
    elif isinstance(thing, dict):
        for key, value in thing.items():
            _describe(value, f"{prefix}{key}", found, above)
    elif isinstance(thing, (tuple, list)) and not hasattr(thing, "_fields"):
        for i, value in enumerate(thing):
            _describe(value, f"{prefix}{i}", found, above)
    else:
        found[name] = getattr(thing, "__qualname__", type(thing).__name__)
        fields = [f.name for f in dataclasses.fields(thing)] if dataclasses.is_dataclass(thing) else getattr(thing, "_fields", ())
        for part in fields if not isinstance(thing, type) else ():
            _describe(getattr(thing, part), f"{prefix}{part}", found, above)


def _describe_function(function: Any, name: str, prefix: str, found: dict[str, str], above: frozenset[int]) -> None:
    found[name] = f"{function.__module__}.{function.__qualname__}"
    if inspect.ismethod(function):
        _describe(vars(function.__self__) if hasattr(function.__self__, "__dict__") else None, f"{prefix}self", found, above)
        function = function.__func__
    _describe(function.__defaults__ or (), f"{prefix}defaults", found, above)
    for part, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            value = cell.cell_contents
        except ValueError:  # not filled yet
            continue
        _describe(value, f"{prefix}{part}", found, above)
