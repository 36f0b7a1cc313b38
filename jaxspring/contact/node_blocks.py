"""Symmetric D x D blocks of single nodes as the matrices of implicit steps take them, and the positive part of the bend of a surface.

    M = sum over i of (M_ii - sum over j of M_ij) e_i e_i'  +  sum over i < j of M_ij (e_i + e_j) (e_i + e_j)'

A bend acts across the normal n alone, where it has two eigenvalues in space, a >= b, and one in the plane. What makes them a' and b' is

    s M + (a' - s a) (I - n n')         s = (a' - b') / (a - b)

so that neither needs its direction.

Source: the spectral theorem, written out for two eigenvalues.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from ..forces.linearisation import ExactTangent, Linearisation
from ..linalg.operators import Blocks, NodeDyads
from ..vector import Vector
from .base import unit

Rows = tuple[Vector, ...]


def blocks_of(rows: Rows) -> Blocks:
    """The symmetric blocks with these rows [N/m], as a diagonal and dyads."""
    dim = len(rows)
    diagonal = [rows[i][i] - sum((rows[i][j] for j in range(dim) if j != i), start=jnp.zeros_like(rows[i][i])) for i in range(dim)]
    dyads = []
    for i in range(dim):
        for j in range(i + 1, dim):
            ones = [jnp.ones_like(a) if k in (i, j) else jnp.zeros_like(a) for k, a in enumerate(rows[i])]
            dyads.append(NodeDyads(rows[i][j], Vector(tuple(ones))))
    return Blocks((Vector(tuple(diagonal)),), tuple(dyads))


def bent(hessian: Rows, normal: Vector, factor: Array, linearisation: Linearisation) -> Rows:
    """Rows of `factor` times the second derivative of a distance: as it is for `ExactTangent`, else its positive part across the normal.

    Args:
        hessian: rows of the second derivative [1/m].
        normal: the first one.
        factor: [N].
        linearisation: of the matrix.
    """
    rows = tuple(factor * row for row in hessian)
    return rows if isinstance(linearisation, ExactTangent) else positive_part(rows, unit(normal))


def positive_part(rows: Rows, n: Vector) -> Rows:
    """Rows of the part of symmetric blocks that acts across `n` (of length one) and resists."""
    across = _across(rows, n)
    trace = sum((row[i] for i, row in enumerate(across)), start=jnp.zeros_like(n[0]))
    zero = jnp.zeros_like(trace)
    if len(rows) == 2:
        share, rest = zero, jnp.maximum(trace, zero)
    else:
        squared = 0.5 * sum((row.dot(row) for row in across), start=-0.5 * trace * trace)
        is_apart = squared > 0
        half_gap = jnp.where(is_apart, jnp.sqrt(jnp.where(is_apart, squared, jnp.ones_like(squared))), zero)
        high, low = 0.5 * trace + half_gap, 0.5 * trace - half_gap
        kept, kept_low = jnp.maximum(high, zero), jnp.maximum(low, zero)
        share = jnp.where(is_apart, (kept - kept_low) / (2 * jnp.where(is_apart, half_gap, jnp.ones_like(half_gap))), zero)
        rest = kept - share * high
    return tuple(
        Vector(tuple(share * a + rest * ((1.0 if i == j else 0.0) - n[i] * n[j]) for j, a in enumerate(row)))
        for i, row in enumerate(across)
    )


def _across(rows: Rows, n: Vector) -> Rows:
    """The blocks between projections across `n`: T M T with T = I - n n'."""
    along = Vector(tuple(row.dot(n) for row in rows))
    both = along.dot(n)
    return tuple(row - n[i] * along - along[i] * n + (n[i] * both) * n for i, row in enumerate(rows))


__all__ = ["bent", "blocks_of", "positive_part"]
