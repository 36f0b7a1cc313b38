"""Springs as a list of pairs: what a graph and a net laid over another have in common.

An edge field holds one entry of shape (E,). Springs are kept in an order in which what is read together lies together; the user's is kept
outside.
"""

from __future__ import annotations

import abc
import hashlib
from collections.abc import Callable
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..vector import Vector
from .base import Topology
from .edge_field import AtEnds, EdgeField, ZeroOutside
from .end_tables import build
from .ends import Ends, Spread
from .identity import NetIdentity
from .periods import minimum_image
from .permutation import Permutation, locality_order


class ListedSprings(Topology):
    """A topology whose springs are one list. Abstract: see `Graph` and `Overlay`."""

    ends: eqx.AbstractVar[Ends]
    box: eqx.AbstractVar[Array | None]
    springs: eqx.AbstractVar[Permutation]
    digest: eqx.AbstractVar[str]
    name: eqx.AbstractVar[str | None]

    @property
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape of an edge field of the only family of springs: ((E,),)."""
        return (self.family_sizes,)

    @property
    def family_sizes(self) -> tuple[int, ...]:
        """Number of springs of the only family: (E,)."""
        return (self.springs.order.size,)

    @property
    def identity(self) -> NetIdentity:
        """The springs' digest, and the name."""
        springs = (f"{self.n_nodes} nodes", f"{self.springs.order.size} springs", f"digest {self.digest}")
        return NetIdentity(type(self).__name__, springs, self.name, self.springs)

    def _ends(self) -> np.ndarray:
        """(E, 2) places of tail and head, on the host."""
        return np.stack([of_one(self.ends.tails), of_one(self.ends.heads)], axis=-1)

    @abc.abstractmethod
    def _taken(self, a: Array) -> Array:
        """Node array -> the nodes that have springs here."""

    @abc.abstractmethod
    def _put(self, a: Array) -> Array:
        """The nodes that have springs here -> node array."""

    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail along each spring."""
        d = x.map(lambda a: self.ends.difference(self._taken(a)))
        return self.own((d if self.box is None else minimum_image(d, self.box),))

    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node: each pull on its tail, the opposite on its head; zero on nodes without springs."""
        return pulls.families[0].map(lambda p: self._put(self.ends.accumulate(p)))

    def net_pull(self, pull: Callable[..., Vector], x: Vector | tuple[Vector, ...], *fields: Any) -> Vector:
        """Sum of the pulls at each node, each spring taken at both of its ends; `pull` is odd in the differences."""
        moving = x if isinstance(x, tuple) else (x,)
        if self.n_springs == 0:
            return Vector.zeros_like(moving[0])
        whole = pull if self.box is None else _Wrapped(pull, self.box)
        pulls = self.ends.net_pull(
            whole, [v.map(self._taken) for v in moving], [self._at_ends(f) if isinstance(f, EdgeField) else f for f in fields]
        )
        return pulls.map(self._put)

    def at_ends(self, field: EdgeField) -> EdgeField:
        """An edge field that each step reads, spread over both ends of each spring once."""
        return AtEnds(field.families, field.identity, self._at_ends(field))

    def vanishing(self, field: EdgeField) -> EdgeField:
        """The same, zero at entries of no spring."""
        full = self._spread(field)
        return ZeroOutside(full.families, full.identity, self.ends.spread(full.families[0], vanishing=True))

    @property
    def exists(self) -> EdgeField:
        """Where there is a spring, as a field of `net_pull`."""
        real = self.ends.real
        return AtEnds((), self.identity, tuple(jnp.ones((), bool) if real is None else one.rows(real) for one in self.ends.classes))

    def _at_ends(self, field: EdgeField) -> Spread:
        return field.ends if isinstance(field, AtEnds) else self.ends.spread(self._spread(field).families[0])

    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node."""
        return self._put(self.ends.sum_at_nodes(values.families[0]))

    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""
        return self.own((self.ends.mean_of_ends(self._taken(a)),))

    @property
    def has_margins(self) -> bool:
        """A list has no place for a spring that does not exist."""
        return False

    def unboxed(self) -> Self:
        """The same springs without periods."""
        return eqx.tree_at(lambda net: net.box, self, None, is_leaf=lambda leaf: leaf is None)

    def inside(self, field: EdgeField, fill: float) -> EdgeField:
        """The field itself: a list keeps no margins."""
        return field

    def split(self, flat: Array) -> EdgeField:
        """(E,) array in the user's order -> edge field."""
        return self.own((self.springs.inward(flat),))

    def joined(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array as it is kept."""
        return self._spread(field).families[0]

    def _flatten(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array in the user's order."""
        return self.springs.outward(field.families[0])


class _Wrapped(eqx.Module):
    """A pull of the nearest images."""

    pull: Callable[..., Vector]
    box: Array

    def __call__(self, d: Vector, *others: Any) -> Vector:
        return self.pull(minimum_image(d, self.box), *others)


def arranged(pairs: np.ndarray, n_nodes: int) -> tuple[Ends, np.ndarray, Permutation]:
    """How the springs between these (E, 2) pairs of nodes are kept: their ends, the given number of each node that is kept, and the order
    of the springs.
    """
    near = locality_order(pairs, n_nodes)
    inner = np.argsort(near)[pairs]
    springs = Permutation(np.lexsort((inner.max(axis=1), inner.min(axis=1))))
    ends, order = build(inner[springs.order], n_nodes)
    return ends, near[order], springs


def of_one(table: Array) -> np.ndarray:
    """A table on the host; of stacked nets, which are all one, the first's."""
    array = np.asarray(table)
    return array.reshape(-1, array.shape[-1])[0] if array.ndim > 1 else array


def digest_of(pairs: np.ndarray) -> str:
    """Of the springs in the user's numbering and order."""
    return hashlib.sha256(np.ascontiguousarray(pairs, "<i4").data).hexdigest()[:16] if len(pairs) else ""


__all__ = ["ListedSprings", "arranged", "digest_of", "of_one"]
