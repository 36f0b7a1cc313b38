"""The directions that obstacles take from a node which rests on them.

    e_i     normals of the obstacles that hold it, made orthonormal one after the other (Gram-Schmidt)
    c_i     speed of the surfaces along e_i, so that n_i . v = -rate_i for each of them:  v' = v - sum (v . e_i - c_i) e_i
    n_i     = sum_j L_ij e_j: an impulse with parts b_j along e_j is sum_i a_i n_i with L' a = b, an impulse a_i of each obstacle

Source: Gram-Schmidt, as in Golub and Van Loan (2013), 5.2.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..forces.planes import without
from ..vector import Vector


class Frame(eqx.Module):
    """Orthonormal directions, one for each obstacle: zero where it does not hold the node.

    Attributes:
        directions: e_i.
        speeds: c_i [m/s].
        rows: of L, each up to its diagonal; the diagonal is one where e_i is zero.
    """

    directions: tuple[Vector, ...]
    speeds: tuple[Array, ...]
    rows: tuple[tuple[Array, ...], ...]

    def without(self, v: Vector) -> Vector:
        """`v` without its parts along the directions."""
        return without(v, self.directions)

    def onto(self, v: Vector) -> Vector:
        """`v` moving with the surfaces along the directions."""
        for e, c in zip(self.directions, self.speeds, strict=True):
            v = v - (v.dot(e) - c) * e
        return v

    def carried(self, like: Vector) -> Vector:
        """Velocity of the surfaces along the directions [m/s]."""
        total = Vector.zeros_like(like)
        for e, c in zip(self.directions, self.speeds, strict=True):
            total = total + c * e
        return total

    def shares(self, parts: tuple[Array, ...]) -> tuple[Array, ...]:
        """What of a sum of normals with these parts along the directions is each normal's."""
        found: list[Array] = [jnp.zeros_like(b) for b in parts]
        for i in reversed(range(len(parts))):
            rest = parts[i]
            for k in range(i + 1, len(parts)):
                rest = rest - self.rows[k][i] * found[k]
            found[i] = rest / self.rows[i][i]
        return tuple(found)


def frame_of(normals: tuple[Vector, ...], rates: tuple[Array, ...], held: tuple[Array, ...]) -> Frame:
    """The directions of the obstacles that hold each node, by their normals (of which only free coordinates count) and rates [m/s]."""
    directions: list[Vector] = []
    speeds: list[Array] = []
    rows: list[tuple[Array, ...]] = []
    for normal, rate, is_held in zip(normals, rates, held, strict=True):
        n, c, row = normal, -rate, []
        for e, speed in zip(directions, speeds, strict=True):
            part = normal.dot(e)
            n, c, row = n - part * e, c - part * speed, [*row, part]
        squared = n.dot(n)
        counts = is_held & (squared > 64 * float(jnp.finfo(squared.dtype).eps))
        one = jnp.ones_like(squared)
        length = jnp.sqrt(jnp.where(counts, squared, one))
        per_length = jnp.where(counts, one / length, jnp.zeros_like(one))
        directions.append(n * per_length)
        speeds.append(c * per_length)
        rows.append((*row, length))
    return Frame(tuple(directions), tuple(speeds), tuple(rows))


__all__ = ["Frame", "frame_of"]
