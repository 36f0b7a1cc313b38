"""The same system with other constants: `replace`.

Every part is looked through, forces and rules, a user's own too, and what they hold: laws, cut-offs, boundaries. A constant is what a
constructor takes and keeps under the same name; the part is made anew by its constructor, which checks.
"""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import numpy as np

from ._arrays import Numbers
from ._checks import as_inexact, finite, has_shape, is_concrete, shape_of
from .closures import opened
from .images.image import Image
from .system import System, as_system
from .topology.base import Topology
from .topology.edge_field import EdgeField, SpringNumbers

# Where in a part a constant is: names of fields, and places in tuples.
Path = tuple[str | int, ...]


def replace(system: System, *, mass: Numbers | None = None, effect: int | None = None, **constants: SpringNumbers) -> System:
    """The system with some constants replaced; everything else is shared with the old one.

    A constant goes to the one part, or thing that a part holds, whose constructor takes it: `stiffness` of `Springs`, `alpha` of a
    fluid's law, `coefficient` of a boundary of `Heat`. Where the constant that is replaced is an object with a constant of that name
    itself, such as a stiffness rule, the inner one is meant. Values are checked as in the constructors; traced values work, so that
    `replace` may stand inside `jit`, `grad` and `vmap`.

    Args:
        system: the system.
        mass: of the system's nodes [kg]: a number, or (N,) in the user's order.
        effect: index of the part that is meant, forces first and then rules, where several take the constant.
        constants: new values, by name, in the units that the constructors take.

    Returns:
        A system of the same kind.

    Raises:
        ValueError: no part or several parts with such a constant, or a value that the constructor refuses.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=(js.Springs(net, 1.0), js.Drag(0.1)))
    >>> print(replace(system, stiffness=2.0, mass=3.0).forces[0].stiffness)
    2.0
    """
    system = as_system(system)
    parts = list(system.parts)
    changes: dict[int, dict[Path, Any]] = {}
    for name, value in constants.items():
        i, path = _find(system, name, effect)
        changes.setdefault(i, {})[path] = value
    for i, new in changes.items():
        parts[i] = opened(_with(parts[i], new), _called(system, i))
    n = len(system.forces)
    new_mass = system.mass if mass is None else System(system.net, mass).mass
    rules = None if system.rules is None else tuple(parts[n:])
    return eqx.tree_at(lambda s: (s.forces, s.mass, s.rules), system, (tuple(parts[:n]), new_mass, rules), is_leaf=lambda a: a is None)


def _find(system: System, name: str, effect: int | None) -> tuple[int, Path]:
    """The one part that has the constant, and where."""
    parts, names = system.parts, system.effects
    if effect is not None and not -len(parts) <= effect < len(parts):
        raise ValueError(f"effect = {effect}, but the system has {len(parts)} forces and rules: {', '.join(names)}.")
    found = [(i, path) for i, part in enumerate(parts) for path in _places(part, name)]
    if effect is not None:
        meant = [entry for entry in found if entry[0] == effect % len(parts)]
        if not meant:
            raise ValueError(f"{_called(system, effect % len(parts))} has no {name}.{_where(system, name, found)}")
        found = meant
    if not found:
        near = difflib.get_close_matches(name, sorted({known for part in parts for known in _names(part)}), 1)
        hint = f" Did you mean {near[0]}?" if near else ""
        raise ValueError(
            f"no force of this system has a {name}, and no rule: it holds {', '.join(names) or 'none'}.{hint} Build it with one that has."
        )
    if len(found) > 1:
        say = f"replace(system, {name}=..., effect={found[0][0]})"
        same = len({i for i, _ in found}) == 1
        remedy = "Change the one that is meant by equinox.tree_at." if same else f"Say which, e.g. {say}."
        raise ValueError(f"{name} is ambiguous.{_where(system, name, found)} {remedy}")
    return found[0]


def _called(system: System, i: int) -> str:
    n = len(system.forces)
    which = f"forces[{i}]" if i < n else f"rules[{i - n}]"
    return f"{which} is a {system.effects[i]}, which"


def _where(system: System, name: str, found: list[tuple[int, Path]]) -> str:
    def said(i: int, path: Path) -> str:
        n = len(system.forces)
        inner = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path[:-1])
        return f"{f'forces[{i}]' if i < n else f'rules[{i - n}]'}{inner} ({system.effects[i]})"

    listed = " and ".join(said(i, path) for i, path in found)
    return f" A {name} is in {listed}." if found else f" No force of this system has a {name}."


def _places(thing: Any, name: str) -> Iterator[Path]:
    """Where in a part there is a constant of this name; the innermost of those within each other."""
    inner = [(key, *path) for key, value in _held(thing) for path in _places(value, name)]
    yield from inner
    if name in _taken(thing) and not any(path[0] == name for path in inner):
        yield (name,)


def _names(thing: Any) -> set[str]:
    """All constants of a part."""
    return set(_taken(thing)).union(*(_names(value) for _, value in _held(thing)))


def _held(thing: Any) -> Iterator[tuple[str | int, Any]]:
    """What a part, or a tuple of things in it, is made of, besides nets and images."""
    entries: Any = enumerate(thing) if isinstance(thing, tuple) else ((name, getattr(thing, name)) for name in _fields(thing))
    for key, value in entries:
        if isinstance(value, eqx.Module | tuple) and not isinstance(value, Topology | Image | EdgeField):
            yield key, value


def _with(thing: Any, changes: dict[Path, Any]) -> Any:
    """The thing with what stands at these places changed, from the inside out."""
    own: dict[Any, Any] = {path[0]: value for path, value in changes.items() if len(path) == 1}
    for key in dict.fromkeys(path[0] for path in changes if len(path) > 1):
        inner = {path[1:]: value for path, value in changes.items() if path[0] == key and len(path) > 1}
        own[key] = _with(thing[int(key)] if isinstance(thing, tuple) else getattr(thing, str(key)), inner)
    if isinstance(thing, tuple):
        return tuple(own.get(i, value) for i, value in enumerate(thing))
    return _rebuilt(thing, own)


def _rebuilt(thing: Any, changes: dict[str, Any]) -> Any:
    """`thing` made anew by its constructor; fields that the constructor does not take are its own to make."""
    follow = getattr(thing, "follows", dict)()
    dropped = {field for name, fields in follow.items() if is_concrete(changes.get(name)) for field in fields}
    parameters = inspect.signature(type(thing)).parameters
    kept = {name: getattr(thing, name) for name in _taken(thing) if name not in dropped}
    missing = [name for name, p in parameters.items() if p.default is p.empty and name not in kept and name not in changes]
    return _changed(thing, changes) if missing else type(thing)(**{**kept, **changes})


def _changed(thing: Any, changes: dict[str, Any]) -> Any:
    """`thing` with other fields, where the constructor takes what it does not keep: values of the same shape as the old ones."""
    new = thing
    for name, value in changes.items():
        old = getattr(thing, name)
        if not isinstance(value, eqx.Module | tuple):
            value = as_inexact(name, value)
            finite(name, value)
            has_shape(name, value, {"as before": shape_of(old), "one number": ()})
        new = eqx.tree_at(lambda t, name=name: getattr(t, name), new, value, is_leaf=lambda a: a is None)
    bad = new.invalid() if hasattr(new, "invalid") else None
    if bad is not None and is_concrete(bad) and np.asarray(bad):
        raise ValueError(f"{type(thing).__name__} refuses {', '.join(f'{name} = {value}' for name, value in changes.items())}.")
    return new


def _taken(thing: Any) -> list[str]:
    """Fields of an object that its constructor takes."""
    if not isinstance(thing, eqx.Module):
        return []
    return [name for name in inspect.signature(type(thing)).parameters if name in _fields(thing)]


def _fields(thing: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(thing)] if isinstance(thing, eqx.Module) else []
