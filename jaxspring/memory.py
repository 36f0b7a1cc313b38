"""What one effect remembers from step to step: its own entry in `state.memory`.

    a cache       can be made anew from the state: dropped when saved, in `diffeqsolve` and in `equilibrium`       (a list of neighbours)
    a history     cannot: saved, and refused where it would be left out                              (a damper's stretch, a damage, books)

Every part of a system, forces and then rules, has one place there. An entry says whose it is, so that no part ever reads that of another.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax

from .topology.identity import NetIdentity


@dataclass(frozen=True)
class Owner:
    """Whose memory it is.

    Attributes:
        kind: name of the effect's class.
        net: the springs that it is about, or None.
    """

    kind: str
    net: NetIdentity | None

    @staticmethod
    def of(part: Any) -> Owner:
        """Of a force or a rule."""
        net = getattr(part, "net", None)
        return Owner(type(part).__name__, None if net is None else net.identity)

    def __str__(self) -> str:
        return self.kind if self.net is None else f"{self.kind} on {self.net}"


class Memory(eqx.Module):
    """An entry of `state.memory`.

    Attributes:
        value: any tree of arrays.
        owner: whose it is (static).
        is_cache: whether it can be made anew (static).
    """

    value: Any
    owner: Owner = eqx.field(static=True)
    is_cache: bool = eqx.field(static=True)


Memories = tuple[Memory | None, ...] | None


def entry_at(memory: Memories, place: int | None) -> Memory | None:
    """The entry at a place, or None."""
    return memory[place] if memory is not None and place is not None and place < len(memory) else None


def with_entry(memory: Memories, place: int, entry: Memory | None) -> Memories:
    """The memory with this entry at a place."""
    entries = list(memory or ())
    entries += [None] * (place + 1 - len(entries))
    entries[place] = entry
    return _or_none(entries)


def matched(memory: Memories, owners: tuple[Owner, ...]) -> Memories:
    """The memory as a system of these parts may take it: caches of other parts are left behind.

    Raises:
        ValueError: a history of a part that is not there.
    """
    entries: list[Memory | None] = []
    for place, entry in enumerate(memory or ()):
        owner = owners[place] if place < len(owners) else None
        if entry is None or (entry.owner != owner and entry.is_cache):
            entries.append(None)
            continue
        if entry.owner != owner:
            raise ValueError(
                f"the state remembers something of {entry.owner}, part {place} of the system that made it, but part {place} of this system "
                f"is {'missing' if owner is None else owner}. Unchecked, one effect would read what another wrote. Use the system that "
                f"made the state, or forget: dataclasses.replace(state, memory=None)."
            )
        entries.append(entry)
    return _or_none(entries)


def without_caches(tree: Any) -> Any:
    """Any tree of states, in which only histories are left."""
    return jax.tree.map(_history, tree, is_leaf=_holds_memory)


def _holds_memory(node: Any) -> bool:
    return isinstance(node, eqx.Module) and hasattr(node, "layout") and hasattr(node, "memory")


def _history(node: Any) -> Any:
    if not _holds_memory(node) or node.memory is None:
        return node
    return dataclasses.replace(node, memory=_or_none([None if e is None or e.is_cache else e for e in node.memory]))


def _or_none(entries: list[Memory | None]) -> Memories:
    """The entries, or None where there is none: some transformations take an empty tuple for an array."""
    return tuple(entries) if any(entry is not None for entry in entries) else None


__all__ = ["Memories", "Memory", "Owner", "entry_at", "matched", "with_entry", "without_caches"]
