"""Tridiagonal systems along one axis of a lattice, all lines at once: `LineSolver`.

    (e_i + w_i-1 + w_i) x_i - w_i-1 x_i-1 - w_i x_i+1 = b_i        e > 0, w >= 0

Elimination in terms of the excess e of the diagonal instead of the diagonal itself,

    s_i = e_i + w_i-1 s_i-1 / (s_i-1 + w_i-1)        b_i <- b_i + w_i-1 b_i-1 / (s_i-1 + w_i-1)
    x_i = (b_i + w_i x_i+1) / (s_i + w_i)

has no difference in it: every x is an average to the last digit, however large w is beside e.

Source: Thomas' algorithm; without subtraction as in Grassmann, Taksar and Heyman (1985).
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import stopped
from ..status import Flag, Status
from ..topology.lattice import Lattice
from ..vector import Vector
from .base import LinearSolver, SolveInfo
from .iterative import norm
from .operators import SpringMatrix


class LineSolver(LinearSolver):
    """Solves directly with a matrix whose springs all lie along one axis of a lattice, and join neighbours.

    One coordinate, weights of zero or more. Differentiable in b and in the matrix by implicit differentiation.

    Attributes:
        axis: along which the springs lie (static).
    """

    axis: int = eqx.field(static=True)

    def solve_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """Solve every line; `guess` is not needed."""
        lines = self._line(matrix)

        def solve(_: Any, right_side: Vector) -> tuple[Vector, SolveInfo]:
            return self._solved(*lines, right_side)

        x, info = lax.custom_linear_solve(matrix, matrix.pick(b, Vector.zeros_like(b)), solve, symmetric=True, has_aux=True)
        return matrix.pick(x, b), info, memory

    def find_in_step(self, matrix: SpringMatrix, b: Vector, guess: Vector | None, memory: Any) -> tuple[Vector, SolveInfo, Any]:
        """As `solve_in_step`, without a derivative."""
        matrix, b = stopped((matrix, b))
        x, info = self._solved(*self._line(matrix), matrix.pick(b, Vector.zeros_like(b)))
        return matrix.pick(x, b), info, memory

    def _solved(self, excess: Array, weight: Array, b: Vector) -> tuple[Vector, SolveInfo]:
        x = Vector((solve_lines(excess, weight, b[0], self.axis),))
        bad = ~jnp.isfinite(norm(x))
        # Its residual is rounding, and not worth a product.
        return x, SolveInfo(jnp.zeros((), b.dtype), jnp.zeros((), jnp.int32), Status.when(Flag.NONFINITE, bad))

    def _line(self, matrix: SpringMatrix) -> tuple[Array, Array]:
        """Excess of the diagonal at each node, and weight of the spring to the next node (zero after the last)."""
        excess = jnp.zeros(matrix.like.shape, matrix.like.dtype)
        for diagonal in matrix.blocks.diagonal:
            excess = excess + diagonal[0]
        weight = jnp.zeros_like(excess)
        for term in matrix.blocks.springs:
            for offset, entry in zip(_offsets(term.net), term.weight.families, strict=True):
                if offset != tuple(int(i == self.axis) for i in range(excess.ndim)):
                    raise ValueError(f"LineSolver works along axis {self.axis}, but a spring has the offset {offset}.")
                weight = weight + lax.slice_in_dim(entry, 1, excess.shape[self.axis] + 1, axis=self.axis)
        (free,) = matrix.free
        if free is None:
            return excess, weight
        # A spring to a held node ties the other end to the ground.
        last = jnp.zeros_like(lax.slice_in_dim(free, 0, 1, axis=self.axis))
        free_after = jnp.concatenate([lax.slice_in_dim(free, 1, None, axis=self.axis), last], axis=self.axis)
        zero = jnp.zeros_like(weight)
        tied = jnp.where(free_after, zero, weight) + _moved(jnp.where(free, zero, weight), self.axis)
        return jnp.where(free, excess + tied, jnp.ones_like(excess)), jnp.where(free & free_after, weight, zero)


def solve_lines(excess: Array, weight: Array, b: Array, axis: int) -> Array:
    """Solution of all lines along `axis`; `weight` couples each node with the next one.

    >>> e, w = jnp.ones(3), jnp.array([2.0, 2.0, 0.0])
    >>> print(solve_lines(e, w, jnp.array([1.0, 1.0, 1.0]), 0))
    [1. 1. 1.]
    """
    e, w, b = (jnp.moveaxis(a, axis, 0) for a in (excess, weight, b))
    zero = jnp.zeros_like(e[0])

    def forward(carry: tuple[Array, Array], line: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        passed_on, pushed = carry
        e, w, b = line
        s, b = e + passed_on, b + pushed
        inverse = 1 / (s + w)
        share = w * inverse
        return (s * share, b * share), (b, share, inverse)

    def backward(after: Array, line: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        b, share, inverse = line
        x = b * inverse + share * after
        return x, x

    _, lines = lax.scan(forward, (zero, zero), (e, w, b))
    _, x = lax.scan(backward, zero, lines, reverse=True)
    return jnp.moveaxis(x, 0, axis)


def _offsets(net: Any) -> tuple[tuple[int, ...], ...]:
    if not isinstance(net, Lattice) or any(net.periodic):
        raise ValueError("LineSolver works on lattices that do not wrap.")
    return net.offsets


def _moved(a: Array, axis: int) -> Array:
    """Each value at the next node."""
    first = jnp.zeros_like(lax.slice_in_dim(a, 0, 1, axis=axis))
    return jnp.concatenate([first, lax.slice_in_dim(a, 0, a.shape[axis] - 1, axis=axis)], axis=axis)


__all__ = ["LineSolver", "solve_lines"]
