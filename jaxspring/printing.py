"""How objects print: a few lines for a person. What is in them, their sizes, the ranges of their constants.

`str` and `print` give these; `repr` gives the tree, as equinox has it. A value that is traced shows its type and shape.
"""

from __future__ import annotations

import dataclasses
import textwrap
from typing import Any

import equinox as eqx
import numpy as np

from .numerics import is_traced
from .processes import is_readable

_INDENT = "  "


def numbers(values: Any) -> str:
    """An array in a few words: `50`, `40 to 60`, `3 of 9`, `float32[9], traced`.

    >>> print(numbers(np.array([2.0, 0.5, 1.0])), numbers(np.array([True, False])))
    0.5 to 2 1 of 2
    """
    if is_traced(values):
        return f"{values.dtype}{list(values.shape)}, traced"
    if not is_readable(values):
        return f"{values.dtype}{list(values.shape)} in several processes"
    if not isinstance(getattr(values, "dtype", np.dtype(float)), np.dtype):
        return str(values.dtype)  # keys of random numbers
    array = np.asarray(values)
    if array.size == 0:
        return "none"
    if array.dtype == bool:
        return f"{array.sum()} of {array.size}"
    bad = int(np.sum(~np.isfinite(array)))
    if bad:
        return f"{bad} of {array.size} not finite"
    low, high = array.min(), array.max()
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def effect(thing: Any) -> str:
    """A force or a rule in one line: its name, its net and its constants."""
    net = getattr(thing, "net", None)
    words = [] if net is None else [f"{net.n_springs} springs"]
    for field in dataclasses.fields(thing):
        said = _said(getattr(thing, field.name), net)
        if said and field.name not in ("net", "place"):
            words.append(f"{field.name} {said}")
    return f"{type(thing).__name__}: {', '.join(words)}" if words else type(thing).__name__


def _said(value: Any, net: Any) -> str:
    """A constant in words; nothing of what is left out, and of options that are off."""
    if value is None or value is False:
        return ""
    if hasattr(value, "families") and hasattr(value, "identity"):  # an edge field
        return "per spring" if net is None or is_traced(value) else numbers(net.flatten(value))
    if eqx.is_array(value):
        return f"({numbers_of_each(value)})" if value.ndim == 1 and value.size <= 3 and not is_traced(value) else numbers(value)
    if isinstance(value, tuple | list):
        return ", ".join(filter(None, (_said(entry, net) for entry in value)))
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return getattr(value, "__name__", None) or str(value)


def net(thing: Any) -> str:
    """A topology in one line."""
    shape = getattr(thing, "shape", None)
    nodes = " x ".join(str(n) for n in shape) if shape else str(thing.n_nodes)
    box = "" if getattr(thing, "box", None) is None else f", box {numbers_of_each(thing.box)} m"
    return f"{type(thing).__name__} of {nodes} nodes, {thing.n_springs} springs{box}"


def numbers_of_each(values: Any) -> str:
    """A short array, number by number."""
    return numbers(values) if is_traced(values) else ", ".join(f"{v:.6g}" for v in np.ravel(values))


def state(thing: Any) -> str:
    """A state, or a batch of states, in a few lines."""
    first = thing.position[0]
    batch = first.shape[: first.ndim - len(thing.layout.shape)]
    nodes = int(np.prod(thing.layout.shape))
    head = f"{type(thing).__name__} of {nodes} nodes in {len(thing.position)} coordinates, {first.dtype}, at {numbers(thing.time)} s"
    head += f", a batch of {' x '.join(str(n) for n in batch)}" if batch else ""
    lines = [f"{name} {numbers(a)} m" for name, a in zip("xyz", thing.position, strict=False)]
    speed = "traced" if is_traced(thing.velocity) else f"{numbers(thing.velocity.norm())} m/s"
    lines.append(f"speed {speed}")
    for name, unit in (("temperature", " K"), ("enthalpy", " J")):
        value = getattr(thing, name)
        if value is not None:
            lines.append(f"{name} {numbers(value)}{unit}")
    lines += [f"with {name}" for name in ("alive", "rest_length") if getattr(thing, name) is not None]
    lines += [f"with the memory of {entry.owner.kind}" for entry in thing.memory or () if entry is not None]
    return under(head, lines)


def system(thing: Any) -> str:
    """A system in a few lines."""
    lines = [f"mass {numbers(thing.mass)} kg"]
    if thing.free is not None:
        free = [numbers(mask) for mask in (thing.free if isinstance(thing.free, tuple) else (thing.free,))]
        lines.append("free " + ", ".join(free))
    if thing.motion is not None:
        lines.append(f"moved {numbers(thing.motion.moved)}")
    lines += [str(force) for force in thing.forces]
    lines += [f"after each step, {rule}" for rule in thing.rules or ()]
    return under(f"{type(thing).__name__} on a {net(thing.net)}", lines)


def under(head: str, lines: list[str]) -> str:
    """Lines under a head, indented."""
    return "\n".join([head, *(textwrap.indent(line, _INDENT) for line in lines)])


__all__ = ["effect", "net", "numbers", "state", "system", "under"]
