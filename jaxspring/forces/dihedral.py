"""The angle of a hinge, two triangles with a common edge, and how it changes when corners move.

    edge a -> b, corners c and d opposite to it            e = b - a, t = e / |e|
    normals       N1 ~ e x (c - a), N2 ~ (d - a) x e       alike where the mesh is flat
    angle         theta = atan2((N1 x N2) . t, N1 . N2)    in (-pi, pi], zero where flat, positive where normals diverge
    shares        s_i: of the foot of c (or d) on the edge, 0 at a, 1 at b        heights h_i

With u_1 = dc - (1 - s_1) da - s_1 db, de = db - da, m_1 the unit vector from the foot to c, and the same of d with 2:

    dtheta        - sum of beta_i                                                 beta_i = N_i . u_i / h_i
    d2theta       sum of 2 beta_i eta_i + alpha_i (2 tau_i + mu_i)                eta_i = m_i . u_i / h_i, tau_i = t . u_i / h_i
                                                                                  alpha_i = N_i . de / |e|, mu_i = m_i . de / |e|

A triangle so flat that rounding decides on its normal has none: such a hinge is told by `is_degenerate`, and all its numbers are finite.

Source: first derivative as in Grinspun and others (2003), "Discrete Shells", and Bridson, Marino and Fedkiw (2003); second by
differentiating it.
"""

from __future__ import annotations

import functools
import math

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import power_of_two, tiny
from ..vector import Vector

Corner4 = tuple[Vector, Vector, Vector, Vector]
# Sine of a triangle's angle below which rounding decides on its normal, in units of the precision.
FLAT = 8


class Dihedral(eqx.Module):
    """Hinges at one moment. The four corners are a, b, c, d; every array has shape (H,).

    Attributes:
        angle: theta [rad], 0 where degenerate.
        is_degenerate: whether the edge has no length, or a triangle no area.
        along: t.
        normals: N1, N2.
        per_length: 1 / |e| [1/m].
        per_heights: 1 / h_1, 1 / h_2 [1/m].
        shares: s_1, s_2.
    """

    angle: Array
    is_degenerate: Array
    along: Vector
    normals: tuple[Vector, Vector]
    per_length: Array
    per_heights: tuple[Array, Array]
    shares: tuple[Array, Array]

    @property
    def gradient(self) -> Corner4:
        """The derivative of the angle by each corner [rad/m]."""
        return _plus(self._of_height(0, self.normals[0]), self._of_height(1, self.normals[1]), -1.0, -1.0)

    @property
    def second(self) -> tuple[tuple[float, Corner4], ...]:
        """The second derivative of the angle: factors and corner vectors g of a sum of dyads g g' [1/m^2]."""
        dyads: list[tuple[float, Corner4]] = []
        for i, n in enumerate(self.normals):
            m = cross(n, self.along) if i == 0 else cross(self.along, n)
            beta, eta, tau = (self._of_height(i, v) for v in (n, m, self.along))
            alpha, mu = self._of_edge(n), self._of_edge(m)
            # Products of two linear forms, as 4 p q = (p + q)^2 - (p - q)^2.
            for factor, p, q in ((0.5, beta, eta), (0.25, alpha, _plus(mu, tau, 1.0, 2.0))):
                dyads += [(factor, _plus(p, q, 1.0, 1.0)), (-factor, _plus(p, q, 1.0, -1.0))]
        return tuple(dyads)

    @property
    def second_bound(self) -> tuple[Array, Array, Array, Array]:
        """For each corner an upper bound of the row sum of the second derivative [1/m^2]."""
        zero = jnp.zeros_like(self.per_length)
        totals = [zero] * 4
        edge = (self.per_length, self.per_length, zero, zero)
        for i, h in enumerate(self.per_heights):
            a, b, tip = h * jnp.abs(1 - self.shares[i]), h * jnp.abs(self.shares[i]), h
            weights = (a, b, tip, zero) if i == 0 else (a, b, zero, tip)
            w, e = a + b + tip, 2 * self.per_length
            totals = [t + at * (2 * w + e) + end * (w + e) for t, at, end in zip(totals, weights, edge, strict=True)]
        return totals[0], totals[1], totals[2], totals[3]

    def _of_height(self, i: int, v: Vector) -> Corner4:
        """v . u_i / h_i as a linear form of the corners."""
        tip, s = self.per_heights[i] * v, self.shares[i]
        none = Vector.zeros_like(v)
        ends = ((s - 1) * tip, -s * tip)
        return (*ends, tip, none) if i == 0 else (*ends, none, tip)

    def _of_edge(self, v: Vector) -> Corner4:
        """v . de / |e| as a linear form of the corners."""
        none, end = Vector.zeros_like(v), self.per_length * v
        return -end, end, none, none


def dihedral(e: Vector, f: Vector, g: Vector) -> Dihedral:
    """The hinges whose corners b, c and d are at e, f and g from a [m], each a `Vector` of (H,)."""
    # By a power of two, which changes no digit: squares of squares stay in the range of float32.
    largest = functools.reduce(jnp.maximum, (jnp.abs(a) for v in (e, f, g) for a in v))
    scale = power_of_two(largest)
    e, f, g = (v.map(lambda a: a / scale) for v in (e, f, g))
    first, second, squared = cross(e, f), cross(g, e), e.dot(e)
    areas = first.dot(first), second.dot(second)
    least = (FLAT * float(jnp.finfo(squared.dtype).eps)) ** 2
    smallest = tiny(squared.dtype)
    flat = [a <= jnp.maximum(least * squared * v.dot(v), smallest) for a, v in zip(areas, (f, g), strict=True)]
    is_degenerate = (squared <= smallest) | flat[0] | flat[1]
    one, zero = jnp.ones_like(squared), jnp.zeros_like(squared)
    squared = jnp.where(is_degenerate, one, squared)
    per_length = lax.rsqrt(squared)
    per_areas = [lax.rsqrt(jnp.where(is_degenerate, one, a)) for a in areas]
    along, normals = per_length * e, (per_areas[0] * first, per_areas[1] * second)
    # |e| over twice the area is one over the height.
    per_heights = [squared * per_length * a for a in per_areas]
    sine, cosine = cross(*normals).dot(along), normals[0].dot(normals[1])
    return Dihedral(
        angle=jnp.arctan2(jnp.where(is_degenerate, zero, sine), jnp.where(is_degenerate, one, cosine)),
        is_degenerate=is_degenerate,
        along=along,
        normals=normals,
        per_length=per_length / scale,
        per_heights=(per_heights[0] / scale, per_heights[1] / scale),
        shares=(f.dot(e) / squared, g.dot(e) / squared),
    )


def wrapped(angle: Array) -> Array:
    """An angle [rad] by whole turns in (-pi, pi]; the turns are a constant to every derivative."""
    turn = 2 * math.pi
    return angle - turn * lax.stop_gradient(jnp.ceil((angle - math.pi) / turn))


def cross(a: Vector, b: Vector) -> Vector:
    """The cross product in space."""
    return Vector((a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x))


def _plus(p: Corner4, q: Corner4, of_p: float, of_q: float) -> Corner4:
    a, b, c, d = (of_p * v + of_q * w for v, w in zip(p, q, strict=True))
    return a, b, c, d


__all__ = ["Dihedral", "cross", "dihedral", "wrapped"]
