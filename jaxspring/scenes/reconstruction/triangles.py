"""Triangles of a lattice: every cell is cut along one of its two diagonals.

Corner names of a cell, x to the right and y down as in an image:

    nw --- ne        flip = False: cut nw-se        upper (nw, ne, se)   lower (nw, se, sw)
    |       |
    sw --- se        flip = True:  cut ne-sw        upper (nw, ne, sw)   lower (ne, se, sw)

Triangle t = half * n_cells + cell, with the upper half first and cells row by row. Node fields are (ny, nx), cell fields (ny-1, nx-1), and
triangle fields (2, ny-1, nx-1) or, flat, (T,). No index is read: corners are shifted slices.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

Node = Float[Array, "ny nx"]
Flip = Bool[Array, "my mx"]
Corners = tuple[Float[Array, "2 my mx"], Float[Array, "2 my mx"], Float[Array, "2 my mx"]]

OUTSIDE = -1


def corners(a: Node, flip: Flip) -> Corners:
    """Values of a node field at the three corners of every triangle, in the order of the table above."""
    nw, ne, sw, se = a[:-1, :-1], a[:-1, 1:], a[1:, :-1], a[1:, 1:]
    return jnp.stack([nw, jnp.where(flip, ne, nw)]), jnp.stack([ne, se]), jnp.stack([jnp.where(flip, sw, se), sw])


def at_nodes(values: Corners, flip: Flip) -> Node:
    """Sum at every node of values at the corners of its triangles: the transpose of `corners`."""
    (a, d), (b, e), (c, f) = values
    zero = jnp.zeros((), a.dtype)
    nw = a + jnp.where(flip, zero, d)
    ne = b + jnp.where(flip, d, zero)
    se = e + jnp.where(flip, zero, c)
    sw = f + jnp.where(flip, c, zero)
    return jnp.pad(nw, ((0, 1), (0, 1))) + jnp.pad(ne, ((0, 1), (1, 0))) + jnp.pad(sw, ((1, 0), (0, 1))) + jnp.pad(se, ((1, 0), (1, 0)))


def doubled_areas(x: Node, y: Node, flip: Flip) -> Float[Array, "2 my mx"]:
    """Twice the signed area of every triangle; positive where it is not folded over."""
    (ax, bx, cx), (ay, by, cy) = corners(x, flip), corners(y, flip)
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def count_folds(x: Node, y: Node, flip: Flip) -> Int[Array, ""]:
    """Number of triangles that are folded over or have no area."""
    return jnp.sum(doubled_areas(x, y, flip) <= 0).astype(jnp.int32)


def triangle_corners(flip: np.ndarray) -> np.ndarray:
    """(T, 3) node numbers of every triangle of a lattice whose cells are cut along `flip`."""
    ny, nx = (n + 1 for n in flip.shape)
    return np.stack([np.ravel(corner) for corner in corners(jnp.arange(ny * nx).reshape(ny, nx), jnp.asarray(flip))], axis=-1)


def refuse_folds(x: Node, y: Node, flip: Flip) -> None:
    """Raise ValueError where triangles of a user's mesh are folded over or have no area."""
    if folds := int(count_folds(x, y, flip)):
        raise ValueError(f"{folds} triangles of the mesh are folded over or have no area: points would be in several. Relax it.")


def neighbours(flip: Flip) -> Int[Array, "3 T"]:
    """Triangle across the edge opposite to each corner (a, b, c), and OUTSIDE (-1) across the border."""
    my, mx = flip.shape
    cell = np.arange(my * mx, dtype=np.int32).reshape(my, mx)
    row, column = np.indices((my, mx))
    lower = my * mx
    above = np.where(row > 0, cell - mx + lower, OUTSIDE)
    below = np.where(row < my - 1, cell + mx, OUTSIDE)
    # A left cell shows us its eastern half: the upper one unless it is flipped. A right cell shows its western half.
    west = jnp.where(column > 0, cell - 1 + jnp.where(jnp.roll(flip, 1, axis=1), lower, 0), OUTSIDE)
    east = jnp.where(column < mx - 1, cell + 1 + jnp.where(jnp.roll(flip, -1, axis=1), 0, lower), OUTSIDE)
    partner = np.stack([cell + lower, cell])
    across_bc = jnp.stack([jnp.where(flip, partner[0], east), jnp.asarray(below)])
    across_ca = jnp.stack([jnp.where(flip, west, partner[0]), jnp.where(flip, partner[1], west)])
    across_ab = jnp.stack([jnp.asarray(above), jnp.where(flip, east, partner[1])])
    return jnp.stack([across_bc, across_ca, across_ab]).reshape(3, -1).astype(jnp.int32)
