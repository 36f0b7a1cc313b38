"""Conjugate gradients that stop at a radius, and at a direction of no or negative curvature: `truncated_cg`.

    minimise d'K d / 2 - b d   within   |d|_M <= radius

M is the matrix whose inverse the preconditioner applies; lengths in it follow from the iteration's own numbers.

Source: Steihaug (1983); Conn, Gould and Toint, Trust-Region Methods (2000), algorithm 7.5.1 and section 7.5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..linalg.iterative import dot, norm
from ..vector import Vector

Operator = Callable[[Vector], Vector]


class Ended(eqx.Module):
    """How the iteration ended.

    Attributes:
        d: the step.
        left: b - K d.
        length: |d|_M.
        is_cut: whether the radius, or a curvature that is not positive, ended it.
        curvature: the least p'K p / p'M p that was met.
        iterations: how many.
    """

    d: Vector
    left: Vector
    length: Array
    is_cut: Array
    curvature: Array
    iterations: Array


class _Iteration(eqx.Module):
    """Step, residual, direction; r'z; d'M d, d'M p, p'M p; least curvature; whether cut; iterations."""

    d: Vector
    r: Vector
    p: Vector
    rz: Array
    dd: Array
    dp: Array
    pp: Array
    curvature: Array
    is_cut: Array
    n_done: Array


def truncated_cg(product: Operator, b: Vector, precondition: Operator, radius: Array, enough: Array) -> Ended:
    """Iterate until the residual is `enough`, or the step would leave the radius.

    Args:
        product: p -> K p, symmetric; it may be indefinite.
        b: right-hand side.
        precondition: r -> M^-1 r, symmetric positive definite.
        radius: largest |d|_M; where infinite, d is the last iterate before a curvature that is not positive.
        enough: largest residual |b - K d|.
    """
    limit = min(10 * b.dim * math.prod(b.shape), 10_000)
    z = precondition(b)
    rz = dot(b, z)
    zero = jnp.zeros_like(rz)
    far = jnp.full_like(rz, jnp.inf)
    first = _Iteration(Vector.zeros_like(b), b, z, rz, zero, zero, rz, far, jnp.zeros((), bool), jnp.zeros((), jnp.int32))

    def goes_on(s: _Iteration) -> Array:
        return ~s.is_cut & (norm(s.r) > enough) & (s.n_done < limit)

    def step(s: _Iteration) -> _Iteration:
        image = product(s.p)
        bend = dot(s.p, image)
        is_convex = bend > 0
        alpha = jnp.where(is_convex, s.rz / jnp.where(is_convex, bend, jnp.ones_like(bend)), zero)
        inside = s.dd + alpha * (2 * s.dp + alpha * s.pp)
        # NaN compares false: it ends the iteration, and the step it makes is refused.
        is_cut = ~(is_convex & (inside < radius * radius))
        # The root of |d + a p| = radius with a > 0, without cancellation.
        room = radius * radius - s.dd
        is_bounded = jnp.isfinite(room)
        reach = jnp.where(is_bounded, s.dp + jnp.sqrt(s.dp * s.dp + s.pp * room), jnp.ones_like(room))
        to_border = jnp.where(is_bounded, room, zero) / reach
        a = jnp.where(is_cut, to_border, alpha)
        d, r = s.d + a * s.p, s.r - a * image
        z = precondition(r)
        rz = dot(r, z)
        beta = rz / s.rz
        dd = jnp.where(is_cut, radius * radius, inside)
        dp, pp = beta * (s.dp + alpha * s.pp), rz + beta * beta * s.pp
        curvature = jnp.minimum(s.curvature, bend / s.pp)
        return _Iteration(d, r, z + beta * s.p, rz, dd, dp, pp, curvature, is_cut, s.n_done + 1)

    last = lax.while_loop(goes_on, step, first)
    return Ended(last.d, last.r, jnp.sqrt(last.dd), last.is_cut, last.curvature, last.n_done)


__all__ = ["Ended", "truncated_cg"]
