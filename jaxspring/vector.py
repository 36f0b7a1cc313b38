"""A vector field as one array per coordinate.

A stacked `(N, D)` array in the carry of a scan is several times slower on the CPU than D separate arrays, and with separate
arrays the formulas read like the paper's: `d.dot(d)`, `stiffness * d`. Nodes and springs use the same class.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Inexact

from ._arrays import kept, own
from ._checks import shape_of

Operand = Any  # a Vector, an array broadcast against every coordinate, or a number


def _kept(components: Any) -> Any:
    return tuple(kept(a) for a in components) if isinstance(components, tuple | list) else components


class Vector(eqx.Module):
    """A vector at every node (or on every spring), stored as one array per coordinate.

    Arithmetic is elementwise: with another `Vector` coordinate by coordinate, with an array or a number on every coordinate.

    Attributes:
        components: tuple of D arrays of one shape (the topology's node shape, or a spring family's shape). NumPy arrays are copied.

    >>> import jax.numpy as jnp
    >>> v = Vector((jnp.array([3.0, 0.0]), jnp.array([4.0, 1.0])))
    >>> print((2 * v).norm())
    [10.  2.]
    """

    components: tuple[Inexact[Array, "*shape"], ...] = eqx.field(converter=_kept)

    # NumPy must not turn a Vector into an object array: with this, `np.ones(2) * v` calls `Vector.__rmul__`.
    __array_ufunc__ = None

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return len(self.components)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of each coordinate's array."""
        return shape_of(self.components[0])

    @property
    def dtype(self) -> jnp.dtype:
        """The coordinates' floating type."""
        return jnp.result_type(self.components[0])

    @property
    def x(self) -> Array:
        """First coordinate."""
        return self.components[0]

    @property
    def y(self) -> Array:
        """Second coordinate."""
        return self.components[1]

    @property
    def z(self) -> Array:
        """Third coordinate."""
        return self.components[2]

    def map(self, function: Callable[..., Array], *others: Vector) -> Vector:
        """Apply `function` to each coordinate's array (and those of `others`)."""
        return Vector(tuple(function(*arrays) for arrays in zip(self.components, *(o.components for o in others), strict=True)))

    def dot(self, other: Vector) -> Array:
        """Sum over coordinates of the products; shape of one coordinate's array."""
        _same_dim(self, other)
        total = self.components[0] * other.components[0]
        for a, b in zip(self.components[1:], other.components[1:], strict=True):
            total = total + a * b
        return total

    def norm(self) -> Array:
        """Euclidean length, with derivative zero (not NaN) where the length is zero."""
        # Over a power of two near the largest coordinate, which changes no digit: squares alone leave the range of float32 beyond 1e19.
        largest = functools.reduce(jnp.maximum, (jnp.abs(lax.stop_gradient(a)) for a in self))
        info = jnp.finfo(largest.dtype)
        power = lax.reduce_precision(largest, exponent_bits=info.nexp, mantissa_bits=0)
        scale = jnp.where((power > 0) & (power < jnp.inf), power, jnp.ones_like(power))
        scaled = self.map(lambda a: a / scale)
        squared = scaled.dot(scaled)
        is_zero = squared == 0
        one, zero = jnp.ones((), squared.dtype), jnp.zeros((), squared.dtype)
        return scale * jnp.where(is_zero, zero, jnp.sqrt(jnp.where(is_zero, one, squared)))

    def largest(self) -> Array:
        """Largest size of any coordinate; NaN where one is. One pass over the memory."""
        return jnp.max(functools.reduce(jnp.maximum, (jnp.abs(a) for a in self)))

    def __iter__(self) -> Iterator[Array]:
        return iter(self.components)

    def __len__(self) -> int:
        return len(self.components)

    def __getitem__(self, index: int) -> Array:
        return self.components[index]

    def __neg__(self) -> Vector:
        return self.map(jnp.negative)

    def __add__(self, other: Operand) -> Vector:
        return _combine(jnp.add, self, other)

    __radd__ = __add__

    def __sub__(self, other: Operand) -> Vector:
        return _combine(jnp.subtract, self, other)

    def __rsub__(self, other: Operand) -> Vector:
        return (-self) + other

    def __mul__(self, other: Operand) -> Vector:
        return _combine(jnp.multiply, self, other)

    __rmul__ = __mul__

    def __truediv__(self, other: Operand) -> Vector:
        return _combine(jnp.divide, self, other)

    def where(self, masks: tuple[Array | None, ...]) -> Vector:
        """The same where the mask of a coordinate holds, zero elsewhere; None: everywhere."""
        entries = zip(self, masks, strict=True)
        return Vector(tuple(a if mask is None else jnp.where(mask, a, jnp.zeros_like(a)) for a, mask in entries))

    @staticmethod
    def zeros_like(other: Vector) -> Vector:
        """A zero vector field of the same shape and dtype."""
        return other.map(jnp.zeros_like)


def _same_dim(a: Vector, b: Vector) -> None:
    if a.dim != b.dim:
        raise ValueError(f"Vectors of {a.dim} and {b.dim} coordinates cannot be combined.")


def _combine(operation: Callable[[Array, Array], Array], a: Vector, b: Any) -> Vector:
    if isinstance(b, Vector):
        _same_dim(a, b)
        return Vector(tuple(operation(p, q) for p, q in zip(a.components, b.components, strict=True)))
    if not (isinstance(b, (int, float, np.ndarray, np.generic)) or eqx.is_array(b)):
        return NotImplemented
    if isinstance(b, (np.ndarray, np.generic)):
        b = own("the operand", b, a.dtype)
    other: Any = b
    return Vector(tuple(operation(p, other) for p in a.components))
