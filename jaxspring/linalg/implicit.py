"""Derivatives of a solution that was found by any means: the implicit function theorem, written once.

    r(theta, y) = 0        dy = -(dr/dy)^-1 dr/dtheta dtheta

How y was found is never differentiated: the cost and the memory of a derivative are those of one linear solve, in forward and in
reverse mode, and derivatives of derivatives are right too.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

PyTree = Any

# Reverse mode may keep what carries this name and compute the rest of a step again: the solve is then not repeated.
SOLUTION = "jaxspring_solution"


class ImplicitProblem(eqx.Module):
    """Equations r(theta, y) = 0 for y. Abstract."""

    @abc.abstractmethod
    def residual(self, theta: PyTree, y: PyTree, /) -> PyTree:
        """R, of the structure of y."""

    @abc.abstractmethod
    def solve_linearised(self, theta: PyTree, y: PyTree, right_side: PyTree, /) -> PyTree:
        """(dr/dy)^-1 right_side, linear in `right_side`, by a solve that brings its own transpose."""


def implicitly(problem: ImplicitProblem, theta: PyTree, solution: PyTree) -> PyTree:
    """`solution`, with the derivative by `theta` that the problem's equations give it."""
    found = jax.tree.map(lambda a: checkpoint_name(lax.stop_gradient(a), SOLUTION), solution)
    return _implicit(problem, theta, found)


@eqx.filter_custom_jvp
def _implicit(problem: ImplicitProblem, theta: PyTree, solution: PyTree) -> PyTree:
    return solution


@_implicit.def_jvp
def _implicit_jvp(primals: Any, tangents: Any) -> tuple[PyTree, PyTree]:
    problem, theta, solution = primals
    # Once more through the rule, so that a derivative of this derivative sees how y depends on theta.
    y = _implicit(problem, theta, solution)
    moves = jax.tree.map(lambda t: t is not None, tangents[1], is_leaf=lambda t: t is None)
    moving, still = eqx.partition(theta, moves)
    if not jax.tree.leaves(moving):
        return y, jax.tree.map(_zeros, y)
    moved = eqx.filter(tangents[1], moves)
    _, change = jax.jvp(lambda some: problem.residual(eqx.combine(some, still), y), (moving,), (moved,))
    return y, problem.solve_linearised(theta, y, jax.tree.map(lambda a: -a, change))


def _zeros(a: Array) -> Array:
    return a * 0


__all__ = ["SOLUTION", "ImplicitProblem", "implicitly"]
