"""Whose springs? What tells the springs of one net from those of another, which is never their number or the shape of their fields."""

from __future__ import annotations

import hashlib
from collections.abc import Hashable
from dataclasses import dataclass, field

from .permutation import Permutation


@dataclass(frozen=True)
class NetIdentity:
    """The springs of a net: which nodes each of them joins, and in which order they are kept.

    Compared and hashed by content, so that a net built again from the same springs is the same net, and shares its compiled programs. Where
    the springs lie, and the periods of a box, have no part in it.

    Attributes:
        kind: the class of the net.
        springs: all that the springs follow from.
        name: given by `net.named`, where there are several sets of springs along the same edges.
        order: from the user's order of the springs to the one in which a graph keeps them, or None; it follows from the springs.
    """

    kind: str
    springs: tuple[Hashable, ...]
    name: str | None = None
    order: Permutation | None = field(default=None, compare=False, repr=False)

    def has_springs_of(self, other: NetIdentity) -> bool:
        """Whether both have the same springs in the same order, whatever they are called."""
        return self.kind == other.kind and self.springs == other.springs

    @property
    def digest(self) -> str:
        """The same for equal identities in every process; for files."""
        return hashlib.sha256(repr((self.kind, self.springs, self.name)).encode()).hexdigest()[:16]

    def __str__(self) -> str:
        called = "" if self.name is None else f"{self.name!r}, "
        return f"{called}{self.kind} of " + ", ".join(map(str, self.springs))
