"""Multigrid: a preconditioner whose iterations do not grow with the mesh.

A few sweeps with every node's own block remove the rough part of an error; the smooth part is seen just as well by a net of fewer nodes:

    x = S r                          smooth
    x = x + P C^-1 P' (r - A x)      correct on the coarser net, there in the same way, at last by a dense inverse
    x = x + S (r - A x)              smooth again, so that the whole map is symmetric

The coarser matrix C is again made of spring blocks: `multigrid_lattice.py`, `multigrid_graph.py`.

Source: Trottenberg, Oosterlee and Schueller, Multigrid (2001); smoothing by Chebyshev polynomials as in Adams, Brezina, Hu and
Tuminaro (2003).
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from ..vector import Vector
from .operators import SpringMatrix

PyTree = Any

# A sum of positive semi-definite springs is at most twice its own block diagonal; errors above a seventh of that are called rough.
_HIGHEST, _LOWEST = 2.0, 0.3


class Level(eqx.Module):
    """The matrix of one net of the hierarchy, and the way to the next. Abstract: `LatticeLevel` and `GraphLevel` are final."""

    @abc.abstractmethod
    def product(self, v: PyTree) -> PyTree:
        """A v."""

    @abc.abstractmethod
    def solve_blocks(self, r: PyTree) -> PyTree:
        """Solve with every node's own block."""

    @abc.abstractmethod
    def restrict(self, r: PyTree) -> PyTree:
        """P' r, on the next level."""

    @abc.abstractmethod
    def prolong(self, v: PyTree) -> PyTree:
        """P v, from the next level."""


class Hierarchy(eqx.Module):
    """Which nets follow each other; made once on the host. Abstract: `LatticeHierarchy` and `GraphHierarchy` are final."""

    @property
    @abc.abstractmethod
    def node_shape(self) -> tuple[int, ...]:
        """Shape of a node field of the finest net."""

    @abc.abstractmethod
    def build(self, matrix: SpringMatrix, dtype: jnp.dtype) -> tuple[tuple[Level, ...], Array]:
        """The matrices of all nets but the last, and the last as a dense array."""

    @abc.abstractmethod
    def enter(self, r: Vector) -> PyTree:
        """A field in node shape as the levels want it."""

    @abc.abstractmethod
    def leave(self, v: PyTree, like: Vector) -> Vector:
        """The way back."""


def cycle(levels: tuple[Level, ...], coarsest: Array, r: PyTree, n_sweeps: int) -> PyTree:
    """One V-cycle from zero; W'W with `coarsest` W is the inverse of the last matrix.

    The sweeps and the correction are the steps of one loop, so that each level's product is compiled once.
    """
    if not levels:
        flat, back = ravel_pytree(r)
        return back(coarsest.T @ (coarsest @ flat))
    level = levels[0]
    keep, new = (jnp.asarray(a, jax.tree.leaves(r)[0].dtype) for a in _chebyshev(n_sweeps))

    def correct(r: PyTree) -> PyTree:
        return level.prolong(cycle(levels[1:], coarsest, level.restrict(r), n_sweeps))

    def sweep(n: Array, step: PyTree, r: PyTree) -> PyTree:
        return _mixed(keep[n], step, new[n], level.solve_blocks(r))

    def advance(n: Array, carry: tuple[PyTree, PyTree, PyTree]) -> tuple[PyTree, PyTree, PyTree]:
        x, r, step = carry
        x, r = _plus(x, step), _minus(r, level.product(step))
        return x, r, lax.cond(n == n_sweeps, lambda: correct(r), lambda: sweep(n, step, r))

    zero = jax.tree.map(jnp.zeros_like, r)
    first = jax.tree.map(lambda a: a * new[0], level.solve_blocks(r))
    x, _, step = lax.fori_loop(1, 2 * n_sweeps + 1, advance, (zero, r, first))
    return _plus(x, step)


def half_inverse(matrix: Array) -> Array:
    """W with W'W the inverse of a small symmetric positive semi-definite matrix, shifted a little so that it exists."""
    if not len(matrix):
        return matrix
    diagonal = jnp.diagonal(matrix)
    size = jnp.sqrt(jnp.where(diagonal > 0, diagonal, jnp.ones_like(diagonal)))
    # Scaled to a unit diagonal, where rounding is of the size of eps.
    unit = matrix / (size[:, None] * size[None, :])
    shift = len(matrix) * float(jnp.finfo(matrix.dtype).eps) + jnp.where(diagonal > 0, jnp.zeros_like(size), jnp.ones_like(size))
    factor = jnp.linalg.cholesky(unit + jnp.diag(shift))
    return lax.linalg.triangular_solve(factor, jnp.diag(1 / size), left_side=True, lower=True)


def _chebyshev(n_sweeps: int) -> tuple[list[float], list[float]]:
    """Of steps 0, 1, ... 2 n_sweeps: how much of the last step is kept, and how much of D^-1 r is new; D is the block diagonal.

    After the correction the polynomial starts again. It is the one that is smallest between the two bounds.
    """
    centre, radius = (_HIGHEST + _LOWEST) / 2, (_HIGHEST - _LOWEST) / 2
    keep, new, rho = [0.0], [1 / centre], radius / centre
    for _ in range(n_sweeps - 1):
        rho, last = 1 / (2 * centre / radius - rho), rho
        keep.append(rho * last)
        new.append(2 * rho / radius)
    return [*keep, 0.0, *keep], [*new, 0.0, *new]


def _plus(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.add, a, b)


def _minus(a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(jnp.subtract, a, b)


def _mixed(keep: Array, a: PyTree, new: Array, b: PyTree) -> PyTree:
    return jax.tree.map(lambda p, q: keep * p + new * q, a, b)


__all__ = ["Hierarchy", "Level", "cycle", "half_inverse"]
