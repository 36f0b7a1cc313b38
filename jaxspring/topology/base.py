"""What every topology offers: differences along springs, and pulls gathered on nodes.

    d = D x        difference: head minus tail, per spring
    f = -D' p      accumulate: a pull p acts on the tail, its opposite on the head

`D` and `D'` are each other's transpose. No file outside `topology/` gathers or scatters along springs.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .. import printing
from .._arrays import Edges, Numbers, own
from .._checks import as_inexact, finite, has_shape, shape_of
from ..vector import Vector
from .edge_field import EdgeField, SpringNumbers, ZeroOutside
from .identity import NetIdentity
from .periods import box_of, check_dim
from .permutation import Permutation


@dataclass(frozen=True)
class NodeLayout:
    """Shape and order in which node fields are stored."""

    shape: tuple[int, ...]
    permutation: Permutation | None

    def flatten(self, a: Array) -> Array:
        """Node array, leading axes allowed -> (..., N) in the user's order."""
        flat = a.reshape(*a.shape[: a.ndim - len(self.shape)], math.prod(self.shape))
        return flat if self.permutation is None else self.permutation.outward(flat)

    def unflatten(self, flat: Array) -> Array:
        """(N,) in the user's order -> node array."""
        return (flat if self.permutation is None else self.permutation.inward(flat)).reshape(self.shape)

    def constant(self, name: str, value: Array) -> Array:
        """A constant of the nodes as the user gave it, one number, (N,) in the user's order or on a lattice its shape, as a node array.

        One number stays as it is. Raises ValueError for any other shape: it would be stretched over the nodes without a word.
        """
        count = math.prod(self.shape)
        has_shape(name, value, {"one number": (), "one per node": (count,), "node shape": self.shape})
        return self.unflatten(value) if value.shape == (count,) else value


def about_middle(points: Any) -> Any:
    """(N, D) points of float64 where JAX has 32 bits: about their middle, for what no shift changes. All others as they are."""
    if not isinstance(points, np.ndarray) or points.dtype != np.float64 or points.ndim != 2 or not points.size:
        return points
    is_held = jax.dtypes.canonicalize_dtype(np.float64) == np.float64
    # What is not finite must not spread to the others: it is refused later, by its index.
    return points if is_held or not np.isfinite(points).all() else points - points.mean(axis=0)


def _of_rows(a: Array, b: Array) -> tuple[Array, Array]:
    """Sums along the last axis, in one row."""
    if a.ndim == 1:
        return jnp.sum(a, dtype=a.dtype, keepdims=True), jnp.sum(b, dtype=b.dtype, keepdims=True)
    zero = jnp.zeros((), a.dtype)
    found = lax.reduce((a, b), (zero, zero), lambda x, y: (x[0] + y[0], x[1] + y[1]), (a.ndim - 1,))
    return found[0].reshape(-1), found[1].reshape(-1)


class Topology(eqx.Module):
    """Which nodes exist and which springs join them. Abstract: see `Lattice` and `Graph`."""

    def __str__(self) -> str:
        """A few lines for a person."""
        return printing.net(self)

    @property
    @abc.abstractmethod
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field: (ny, nx) on a lattice, (N,) on a graph."""

    @property
    @abc.abstractmethod
    def edges(self) -> np.ndarray:
        """(E, 2) integer array, tail and head node of each spring, in the user's order and numbering."""

    @property
    @abc.abstractmethod
    def family_shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shape of each entry of an edge field."""

    @property
    @abc.abstractmethod
    def identity(self) -> NetIdentity:
        """What tells these springs from those of another net. Known from what is static, so that a traced net has it too."""

    @property
    @abc.abstractmethod
    def node_permutation(self) -> Permutation | None:
        """From the user's node order to the internal one, or None where the two agree."""

    @abc.abstractmethod
    def difference(self, x: Vector) -> EdgeField:
        """Head minus tail of `x` along each spring (minimum image where the topology is periodic)."""

    @abc.abstractmethod
    def accumulate(self, pulls: EdgeField) -> Vector:
        """Force on each node from the pull of each spring: plus on its tail, minus on its head."""

    @abc.abstractmethod
    def net_pull(self, pull: Callable[..., Vector], x: Vector | tuple[Vector, ...], *fields: Any) -> Vector:
        """Sum of the pulls at each node, `pull(D x, *fields)`.

        Args:
            pull: of the springs of a family, or of some of a list: odd in the differences, and zero for springs that do not exist. Where
                there are derivatives by its own constants, a module that holds them.
            x: what differences are taken of, the nearest images of the first; or several `Vector`s.
            *fields: what else a pull takes: numbers, and edge fields whose values do not change their sign with a spring's direction.
        """

    def at_ends(self, field: EdgeField) -> EdgeField:
        """The field as `net_pull` reads it, made once for many steps."""
        return field

    def vanishing(self, field: EdgeField) -> EdgeField:
        """The same, zero at places that are kept for springs that do not exist."""
        return ZeroOutside(self.inside(field, 0).families, field.identity)

    def everywhere(self, number: Array) -> EdgeField:
        """One number for every spring."""
        return self.own(jnp.broadcast_to(number, shape) for shape in self.family_shapes)

    @property
    def exists(self) -> EdgeField:
        """Where there is a spring, as a field of `net_pull`."""
        return self.inside(self.everywhere(jnp.ones((), bool)), False)

    @property
    def has_margins(self) -> bool:
        """Whether edge fields have places for springs that do not exist."""
        return True

    def stiffness_product(self, block: Callable[..., Vector], v: Vector, *fields: EdgeField) -> Vector:
        """D' B D v, where `block(d, *fields of a family)` is B d and vanishes where no spring exists; periods do not wrap `v`."""
        return -self.unboxed().net_pull(block, v, *fields)

    @abc.abstractmethod
    def incident_sum(self, values: EdgeField) -> Array:
        """Sum over the springs at each node, whichever end: node shape."""

    @abc.abstractmethod
    def average(self, a: Array) -> EdgeField:
        """Mean of a node array over the two ends of each spring."""

    @abc.abstractmethod
    def split(self, flat: Array) -> EdgeField:
        """(E,) array in the user's order -> edge field."""

    def flatten(self, field: Numbers | EdgeField | tuple[EdgeField, ...]) -> Array:
        """Edge field -> (E,) array in the user's order. One number is repeated; what is (E,) already comes back as it is; of the fields of
        several nets, such as `state.alive`, this net's is taken.
        """
        if isinstance(field, tuple) and any(isinstance(entry, EdgeField) for entry in field):
            field = next((entry for entry in field if isinstance(entry, EdgeField) and self.owns(entry)), field)
        if isinstance(field, EdgeField):
            return self._flatten(self._spread(field))
        flat = own("field", field)
        has_shape("field", flat, {"one number": (), "one per spring": (self.n_springs,)})
        return jnp.broadcast_to(flat, (self.n_springs,))

    @abc.abstractmethod
    def _flatten(self, field: EdgeField) -> Array:
        """Edge field in full shape -> (E,) array in the user's order."""

    def joined(self, field: EdgeField) -> Array:
        """Edge field -> (E,) array in the net's own order, for sums and extremes over all springs."""
        return self._flatten(self._spread(field))

    def named(self, name: str | None) -> Self:
        """The same net under a name: a set of springs of its own, with its own broken springs, though another net has the same edges.

        >>> import jaxspring as js
        >>> net = js.lattice(3)
        >>> net.named("stiff").identity == net.identity
        False
        """
        return dataclasses.replace(self, name=name)

    @abc.abstractmethod
    def with_edges(self, edges: Edges, name: str | None = None) -> Topology:
        """A further net over the same nodes, with springs of its own: bending springs, a seam, another graph.

        Its springs have constants, damping and breaking of their own; what it costs grows with the nodes that it touches.

        Args:
            edges: (E, 2) tail and head node of each spring, in the user's numbering of this net's nodes.
            name: tells it from another net of the same springs.

        Raises:
            ValueError: a node that does not exist, a spring that joins a node to itself.

        >>> import jaxspring as js
        >>> sheet = js.lattice((2, 3))
        >>> seam = sheet.with_edges([(0, 5), (3, 2)])
        >>> system = js.System(sheet, 1.0, (js.Springs(sheet, 10.0, 1.0), js.Springs(seam, 2.0, 1.0)))
        >>> print(seam.lengths(sheet.grid()).round(2))
        [2.24 2.24]
        """

    def owns(self, field: EdgeField) -> bool:
        """Whether an edge field tells about the springs of this net. One made by hand does not say, and is taken by its shapes."""
        if field.identity is not None:
            return field.identity == self.identity
        return tuple(shape_of(entry) for entry in field.families) == self.family_shapes

    def own(self, families: Iterable[Any]) -> EdgeField:
        """An edge field of this net from an entry for each spring family."""
        return EdgeField(tuple(families), self.identity)

    @abc.abstractmethod
    def unboxed(self) -> Topology:
        """The same springs without periods: a velocity is a difference of neighbouring images, and is never wrapped."""

    @property
    def layout(self) -> NodeLayout:
        """How node fields are stored; a `State` keeps it to give points back in the user's order."""
        return NodeLayout(self.node_shape, self.node_permutation)

    @property
    def n_nodes(self) -> int:
        """Number of nodes N."""
        return int(np.prod(self.node_shape))

    @property
    @abc.abstractmethod
    def family_sizes(self) -> tuple[int, ...]:
        """Number of springs in each entry of an edge field."""

    @property
    def n_springs(self) -> int:
        """Number of springs E."""
        return sum(self.family_sizes)

    @abc.abstractmethod
    def inside(self, field: EdgeField, fill: float) -> EdgeField:
        """The field with `fill` at the places that hold no spring (a lattice keeps such margins); take it before a sum or a minimum."""

    def sum(self, field: EdgeField) -> Array:
        """Sum of a field over all springs."""
        return sum((jnp.sum(entry, dtype=field.dtype) for entry in self.inside(field, 0).families), start=jnp.zeros((), field.dtype))

    def counts(self, first: EdgeField, second: EdgeField) -> tuple[Array, Array]:
        """For how many springs each of two conditions holds, int32."""
        pairs = zip(self.inside(first, False).families, self.inside(second, False).families, strict=True)
        # Both in one reduction: XLA makes one loop of it and of what it counts, where it would store what a single one counts.
        rows = [_of_rows(a.astype(jnp.int32), b.astype(jnp.int32)) for a, b in pairs]
        if not rows:
            return jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
        one, other = (jnp.sum(jnp.concatenate(column), dtype=jnp.int32) for column in zip(*rows, strict=True))
        return one, other

    def map_springs(self, law: Callable[..., Any], *fields: Any) -> EdgeField:
        """Call `law` once per spring family; a number or 0-d array is passed to every family as it is."""
        count = len(self.family_shapes)
        columns = [f.families if isinstance(f, EdgeField) else (f,) * count for f in fields]
        return self.own(law(*entries) for entries in zip(*columns, strict=True))

    def edge_field(self, value: SpringNumbers, name: str = "value") -> Array | EdgeField:
        """A number, an (E,) array in the user's order, an edge field, or on a lattice numbers by family, in the shape of the topology.

        Numbers by family are a mapping such as `{js.STRUCTURAL: 100.0, js.SHEAR: 50.0}`, which names every family of the lattice, or an
        edge field with one number for each. One number for all stays a 0-d array. Raises ValueError where the shape fits neither.
        """
        if isinstance(value, EdgeField):
            self._check_families(name, value)
            return dataclasses.replace(self._spread(value), identity=self.identity)
        value = self.edge_constant(value, name)
        if isinstance(value, EdgeField):
            return self._spread(value)
        return self.split(value) if value.ndim else value

    def edge_constant(self, value: SpringNumbers, name: str = "value") -> Array | EdgeField:
        """What `edge_field` takes, checked and as floating arrays, but in the form it was passed: its gradient comes back in that form.

        Numbers by family become an edge field with one number for each family.
        """
        if isinstance(value, Mapping):
            value = EdgeField(self._by_family(value, name))
        if isinstance(value, EdgeField):
            self._check_families(name, value)
            return self.own(as_inexact(f"{name}.families[{i}]", entry) for i, entry in enumerate(value.families))
        value = as_inexact(name, value)
        has_shape(name, value, {"one number": (), "one per spring": (self.n_springs,)})
        return value

    def _by_family(self, value: Mapping[Any, Any], name: str) -> tuple[Any, ...]:
        """One number for each family, from a mapping that names them."""
        raise TypeError(f"{name} is a mapping, but a {type(self).__name__} has no families by name. Pass a number, or (E,) values.")

    def _check_families(self, name: str, field: EdgeField) -> None:
        shapes = tuple(shape_of(entry) for entry in field.families)
        fits = len(shapes) == len(self.family_shapes)
        if not (fits and all(shape in ((), full) for shape, full in zip(shapes, self.family_shapes, strict=True))):
            raise ValueError(f"{name} is an edge field of shapes {shapes}; this topology has {self.family_shapes}.")
        if field.identity is not None and not field.identity.has_springs_of(self.identity):
            raise ValueError(
                f"{name} is an edge field of another net with fields of the same shapes ({field.identity}; here {self.identity}): its "
                f"values would go to other springs. Make it with this net, e.g. net.edge_field(array)."
            )

    def _spread(self, field: EdgeField) -> EdgeField:
        """The field with the numbers of whole families in full shape."""
        if all(shape_of(entry) for entry in field.families):
            return field
        families = tuple(jnp.broadcast_to(a, shape) for a, shape in zip(field.families, self.family_shapes, strict=True))
        return dataclasses.replace(field, families=families)

    def node_field(self, value: Numbers, name: str = "value") -> Array:
        """A number, an (N,) array in the user's order, or an array in node shape, as a node array (a number stays 0-d)."""
        value = own(name, value)
        allowed = {"one number": (), "one per node": (self.n_nodes,), "node shape": self.node_shape}
        has_shape(name, value, allowed)
        if value.ndim == 0 or (value.shape == self.node_shape and self.node_permutation is None):
            return value
        return self._order_nodes(value)

    def vector_field(self, points: Numbers, name: str = "points") -> Vector:
        """(N, D) array in the user's order -> `Vector` in node shape, D = 1, 2 or 3."""
        points = as_inexact(name, points)
        if points.ndim != 2 or points.shape[0] != self.n_nodes or points.shape[1] not in (1, 2, 3):
            raise ValueError(f"{name} has shape {points.shape}; expected ({self.n_nodes}, D) with D = 1, 2 or 3 coordinates.")
        check_dim(box_of(self), points.shape[1])
        finite(name, points)
        return Vector(tuple(self._order_nodes(points[:, i]) for i in range(points.shape[1])))

    def flatten_nodes(self, a: Array) -> Array:
        """Node array (leading axes allowed) -> (..., N) in the user's order; one number is repeated."""
        a = own("a", a)
        return self.layout.flatten(a if a.ndim else jnp.broadcast_to(a, self.node_shape))

    def lengths(self, position: Numbers | Vector) -> Array:
        """(E,) lengths of the springs [m] in the user's order, for a `Vector` or an (N, D) array of positions."""
        x = position if isinstance(position, Vector) else self.vector_field(about_middle(position), "position")
        if x.shape != self.node_shape:
            raise ValueError(f"position has shape {x.shape}, that of one state is {self.node_shape}. Take many by jax.vmap(net.lengths).")
        return self.flatten(self.difference(x).map(lambda d: d.norm()))

    def _order_nodes(self, flat: Array) -> Array:
        return self.layout.unflatten(flat)
