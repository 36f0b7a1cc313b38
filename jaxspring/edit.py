"""The same system with other constants: `replace`."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

import equinox as eqx

from ._arrays import Numbers
from ._checks import is_concrete
from .forces.adaptive import ImageStiffness
from .forces.base import Force
from .system import System
from .topology.edge_field import SpringNumbers


def replace(
    system: System,
    *,
    stiffness: SpringNumbers | None = None,
    rest_length: SpringNumbers | None = None,
    gamma: Numbers | None = None,
    damping: SpringNumbers | None = None,
    acceleration: Numbers | None = None,
    strength: Numbers | None = None,
    mass_rate: Numbers | None = None,
    stiffness_time: Numbers | None = None,
    k_min: Numbers | None = None,
    k_max: Numbers | None = None,
    sigma: Numbers | None = None,
    mass: Numbers | None = None,
    effect: int | None = None,
) -> System:
    """The system with some constants replaced; everything else is shared with the old one.

    A constant goes to the one force that has a field of that name (or whose stiffness rule has). Values are checked as in the
    constructors; traced values work, so that `replace` may stand inside `jit`, `grad` and `vmap`.

    Args:
        system: the system.
        stiffness: of `Springs` or `DataSprings` [N/m].
        rest_length: of `Springs` [m].
        gamma: of `Drag` [N s/m].
        damping: of `Dashpots` [N s/m].
        acceleration: of `Gravity` [m/s^2].
        strength: of `ImageAttraction` [J per unit of the image].
        mass_rate: of `Rayleigh` [1/s].
        stiffness_time: of `Rayleigh` [s].
        k_min: of `ImageStiffness` [N/m].
        k_max: of `ImageStiffness` [N/m].
        sigma: of `ImageStiffness`, in the image's unit of length. A number sets the width of the filter anew; a traced value keeps it.
        mass: of the system's nodes [kg]: a number, or (N,) in the user's order.
        effect: index of the force that is meant, where several have the field.

    Returns:
        A system of the same kind.

    Raises:
        ValueError: no force or several forces with such a field, or a value that the constructor refuses.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=(js.Springs(net, 1.0), js.Drag(0.1)))
    >>> print(replace(system, stiffness=2.0, mass=3.0).forces[0].stiffness)
    2.0
    """
    names = ("stiffness", "rest_length", "gamma", "damping", "acceleration", "strength", "mass_rate", "stiffness_time")
    values = (stiffness, rest_length, gamma, damping, acceleration, strength, mass_rate, stiffness_time)
    names, values = (*names, "k_min", "k_max", "sigma"), (*values, k_min, k_max, sigma)
    changes: dict[int, dict[str, Any]] = {}
    for name, value in zip(names, values, strict=True):
        if value is not None:
            changes.setdefault(_find(system, name, effect), {})[name] = value
    forces = tuple(_with(force, changes[i]) if i in changes else force for i, force in enumerate(system.forces))
    new_mass = system.mass if mass is None else System(system.net, mass).mass
    return eqx.tree_at(lambda s: (s.forces, s.mass), system, (forces, new_mass))


def _find(system: System, name: str, effect: int | None) -> int:
    """Index of the one force that has the field."""
    names = [type(force).__name__ for force in system.forces]
    having = [i for i, force in enumerate(system.forces) if name in _fields(force) or name in _fields(_rule(force))]
    if effect is not None:
        if not -len(names) <= effect < len(names):
            raise ValueError(f"effect = {effect}, but the system has {len(names)} forces: {', '.join(names)}.")
        if effect % len(names) not in having:
            raise ValueError(f"forces[{effect}] is a {names[effect]}, which has no {name}.{_where(name, having, names)}")
        return effect % len(names)
    if not having:
        raise ValueError(f"no force of this system has a {name}: it holds {', '.join(names) or 'no force'}. Build it with one that has.")
    if len(having) > 1:
        raise ValueError(
            f"{name} is ambiguous.{_where(name, having, names)} Say which, e.g. replace(system, {name}=..., effect={having[0]})."
        )
    return having[0]


def _where(name: str, having: list[int], names: list[str]) -> str:
    listed = " and ".join(f"forces[{i}] ({names[i]})" for i in having)
    return f" A {name} is in {listed}." if having else f" No force of this system has a {name}."


def _with(force: Force, changes: dict[str, Any]) -> Force:
    rule = _rule(force)
    of_rule = {name: value for name, value in changes.items() if name in _fields(rule)}
    own = {name: value for name, value in changes.items() if name not in of_rule}
    if of_rule:
        own["stiffness"] = _rebuilt(rule, of_rule)
    return _rebuilt(force, own)


def _rebuilt(thing: Any, changes: dict[str, Any]) -> Any:
    """`thing` made anew by its constructor, which checks; fields that the constructor does not take are its own to make."""
    taken = [name for name in inspect.signature(type(thing)).parameters if name in _fields(thing)]
    if isinstance(thing, ImageStiffness) and is_concrete(changes.get("sigma")):
        taken.remove("radius")  # follows from sigma
    return type(thing)(**{**{name: getattr(thing, name) for name in taken}, **changes})


def _rule(force: Force) -> Any:
    rule = getattr(force, "stiffness", None)
    return rule if isinstance(rule, eqx.Module) else None


def _fields(thing: Any) -> set[str]:
    return {field.name for field in dataclasses.fields(thing)} if isinstance(thing, eqx.Module) else set()
