"""Derivatives of a solution that was found by any means: the implicit function theorem, written once.

    r(theta, y) = 0        dy = -(dr/dy)^-1 dr/dtheta dtheta

How y was found is never differentiated: the cost and the memory of a derivative are those of one linear solve, in forward and in
reverse mode, and derivatives of derivatives are right too.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

from ..numerics import is_zero_tangent, lanes_first, new_primitive, tied

PyTree = Any

# Reverse mode may keep what carries this name and compute the rest of a step again: the solve is then not repeated.
SOLUTION = "jaxspring_solution"


class ImplicitProblem(eqx.Module):
    """Equations r(theta, y) = 0 for y. Abstract."""

    @abc.abstractmethod
    def residual(self, theta: PyTree, y: PyTree, /) -> PyTree:
        """r(theta, y), of the structure of y."""

    @abc.abstractmethod
    def solve_linearised(self, theta: PyTree, y: PyTree, right_side: PyTree, /) -> PyTree:
        """(dr/dy)^-1 right_side, linear in `right_side`, by a solve that brings its own transpose."""


def implicitly(problem: ImplicitProblem, theta: PyTree, solution: PyTree) -> PyTree:
    """`solution`, with the derivative by `theta` that the problem's equations give it."""
    found = jax.tree.map(lambda a: checkpoint_name(lax.stop_gradient(a), SOLUTION), solution)
    y_leaves, y_tree = jax.tree.flatten(found)
    arrays, static = eqx.partition((problem, theta), eqx.is_array)
    theta_leaves, theta_tree = jax.tree.flatten(arrays)

    def tangent(which: tuple[int, ...], given: Sequence[Array], y: Sequence[Array], moved: Sequence[Array]) -> list[Array]:
        """The tangent of y for tangents `moved` of the leaves `which` of theta."""
        problem, theta = eqx.combine(jax.tree.unflatten(theta_tree, list(given)), static)
        at = jax.tree.unflatten(y_tree, list(y))

        def residual(*some: Array) -> PyTree:
            full = list(given)
            for i, value in zip(which, some, strict=True):
                full[i] = value
            problem, theta = eqx.combine(jax.tree.unflatten(theta_tree, full), static)
            return problem.residual(theta, at)

        _, change = jax.jvp(residual, [given[i] for i in which], list(moved))
        return jax.tree.leaves(problem.solve_linearised(theta, at, tied(jax.tree.map(lambda a: -a, change))))

    out = _implicit.bind(*y_leaves, *theta_leaves, tangent=tangent, n=len(y_leaves))
    return jax.tree.unflatten(y_tree, out)


def grown(rate: Callable[[PyTree], PyTree], theta: PyTree, time: Array, like: PyTree) -> PyTree:
    """Zeros like `like`, whose derivative by `time` is rate(theta): what grows at that rate, when no time has passed.

    The rate is computed where a derivative by `time` is taken, and nowhere else; derivatives of that derivative see theta.
    """
    zeros, tree = jax.tree.flatten(jax.tree.map(jnp.zeros_like, like))
    arrays, static = eqx.partition(theta, eqx.is_array)
    theta_leaves, theta_tree = jax.tree.flatten(arrays)

    def tangent(which: tuple[int, ...], given: Sequence[Array], y: Sequence[Array], moved: Sequence[Array]) -> list[Array]:
        if 0 not in which:
            return [jnp.zeros_like(a) for a in y]
        rates = jax.tree.leaves(rate(eqx.combine(jax.tree.unflatten(theta_tree, list(given[1:])), static)))
        return [moved[0] * a for a in rates]

    out = _implicit.bind(*zeros, time, *theta_leaves, tangent=tangent, n=len(zeros))
    return jax.tree.unflatten(tree, out)


def _values(*args: Array, tangent: Any, n: int) -> list[Array]:
    return list(args[:n])


def _jvp(primals: Any, tangents: Any, *, tangent: Any, n: int) -> tuple[Any, Any]:
    # Once more through the primitive, so that a derivative of this derivative sees how y depends on theta.
    y = _implicit.bind(*primals, tangent=tangent, n=n)
    which = tuple(i for i, t in enumerate(tangents[n:]) if not is_zero_tangent(t))
    if not which:
        return y, [jnp.zeros_like(a) for a in y]
    return y, tangent(which, primals[n:], y, [tangents[n + i] for i in which])


def _batch(args: Any, dims: Any, *, tangent: Any, n: int) -> tuple[Any, Any]:
    theta_first, axes = lanes_first([*args[n:], *args[:n]], [*dims[n:], *dims[:n]], len(args) - n)
    theta, y = theta_first[: len(axes)], theta_first[len(axes) :]

    def over_lanes(which: tuple[int, ...], given: Sequence[Array], y: Sequence[Array], moved: Sequence[Array]) -> list[Array]:
        lane = partial(tangent, which)
        return jax.vmap(lane, in_axes=(list(axes), 0, [axes[i] for i in which]))(list(given), list(y), list(moved))

    return _implicit.bind(*y, *theta, tangent=over_lanes, n=n), [0] * n


# A primitive, because a scan drops the rule of a `jax.custom_jvp` when it is differentiated: second derivatives would be wrong.
_implicit = new_primitive("jaxspring_implicit", _values, _values, _batch, _jvp)


__all__ = ["SOLUTION", "ImplicitProblem", "grown", "implicitly"]
