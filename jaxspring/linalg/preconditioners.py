"""Preconditioners: cheap approximate inverses that make conjugate gradients need fewer iterations.

A preconditioner is an object; `build` makes the map r -> about A^-1 r from the numbers of one `SpringMatrix`, once per solve. The map is
symmetric and positive definite even where the matrix is not, so that a failure is the matrix's own and is reported as such.
It changes the work and never the answer, so no derivative is taken of it.
"""

from __future__ import annotations

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..vector import Vector
from .operators import SpringMatrix

Map = Callable[[Vector], Vector]


class Preconditioner(eqx.Module):
    """Makes approximate inverses. Abstract: `Unpreconditioned`, `Jacobi`, `BlockJacobi` and `Multigrid` are final."""

    @abc.abstractmethod
    def build(self, matrix: SpringMatrix) -> Map:
        """The map r -> about A^-1 r, `Vector`s in node shape; symmetric and positive definite, and the identity where held."""


class Unpreconditioned(Preconditioner):
    """No preconditioner."""

    def build(self, matrix: SpringMatrix) -> Map:
        """The identity."""
        return lambda r: r


class Jacobi(Preconditioner):
    """Division by the diagonal: makes up for stiffnesses and masses of very different size."""

    def build(self, matrix: SpringMatrix) -> Map:
        """The map r -> r over the diagonal's magnitude (1 where that is zero)."""
        inverse = matrix.diagonal().map(lambda a: 1 / _or_one(jnp.abs(a)))
        return lambda r: r.map(lambda a, b: a * b, inverse)


class BlockJacobi(Preconditioner):
    """Solves with every node's own D x D block: Jacobi that also knows the directions of the springs at a node."""

    def build(self, matrix: SpringMatrix) -> Map:
        """The map r -> the solution with each node's block; with the diagonal alone where the coordinates decouple."""
        if matrix.is_scalar:
            return Jacobi().build(matrix)
        return BlockFactors.of(matrix.node_blocks()).solve


class BlockFactors(eqx.Module):
    """L D L' of the symmetric D x D block of every node, elementwise over the nodes.

    Closed forms by determinants overflow in float32 (the cube of 1e13); pivots do not. A pivot that is not positive is replaced by the
    block's diagonal entry, so that the solve is positive definite for any block.

    Attributes:
        lower: `lower[i][j]`, j < i: the entries of L below its unit diagonal.
        inverse_pivots: 1 / D.
    """

    lower: tuple[tuple[Array, ...], ...]
    inverse_pivots: tuple[Array, ...]

    @staticmethod
    def of(blocks: tuple[Vector, ...]) -> BlockFactors:
        """Factors of `blocks[i][j]`, node arrays."""
        lower: list[tuple[Array, ...]] = []
        inverse_pivots: list[Array] = []
        for i, row in enumerate(blocks):
            scaled, pivot = [], row[i]  # scaled[j] = L[i, j] D[j]
            for j in range(i):
                entry = row[j]
                for m in range(j):
                    entry = entry - scaled[m] * lower[j][m]
                scaled.append(entry)
            found = tuple(s * d for s, d in zip(scaled, inverse_pivots, strict=True))
            for s, l in zip(scaled, found, strict=True):
                pivot = pivot - s * l
            least = 100 * jnp.finfo(pivot.dtype).eps * jnp.abs(row[i])
            inverse_pivots.append(1 / jnp.where(pivot > least, pivot, _or_one(jnp.abs(row[i]))))
            lower.append(found)
        return BlockFactors(tuple(lower), tuple(inverse_pivots))

    def solve(self, r: Vector) -> Vector:
        """The solution with every node's block."""
        y: list[Array] = []
        for i, a in enumerate(r):
            for j in range(i):
                a = a - self.lower[i][j] * y[j]
            y.append(a)
        x = [a * d for a, d in zip(y, self.inverse_pivots, strict=True)]
        for i in reversed(range(len(x))):
            for j in range(i):
                x[j] = x[j] - self.lower[i][j] * x[i]
        return Vector(tuple(x))


def _or_one(a: Array) -> Array:
    return jnp.where(a > 0, a, jnp.ones_like(a))


__all__ = ["BlockFactors", "BlockJacobi", "Jacobi", "Preconditioner", "Unpreconditioned"]
