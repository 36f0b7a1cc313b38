"""The best heights solved exactly, and how certain they are.

With noise of variance sigma^2 / w_p at each pixel, and springs of stiffness k_z along z as what is believed before any datum, the heights
are a Gaussian about the solution of the pixels' springs (`pixels.py`):

    (N + r L) z = b        covariance  sigma^2 (N + r L)^-1        error bar of node i  sigma sqrt([(N + r L)^-1]_ii)

A node couples only to its own row of the lattice and the two beside it. So the matrix is block tridiagonal, with blocks D_j on the diagonal
and B_j between rows j and j + 1, and both the solution and the diagonal of the inverse come from one sweep down and one up:

    S_j = D_j - B_{j-1}' S_{j-1}^-1 B_{j-1}         y_j = b_j - B_{j-1}' S_{j-1}^-1 y_{j-1}
    X_j = S_j^-1 + T_j X_{j+1} T_j'                 z_j = S_j^-1 y_j - T_j z_{j+1},          T_j = S_j^-1 B_j

in time ny nx^3 and memory ny nx^2, where the inverse itself would take (ny nx)^2.

Source: Rasmussen & Williams (2006), "Gaussian Processes for Machine Learning", section 2.1;
the sweeps: Rybicki & Hummer (1991), appendix B.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .pixels import MIDDLE, NormalEquations
from .triangles import Node, corners

# Longest row that is solved so: beyond, the blocks take gigabytes and minutes.
LONGEST_ROW = 400


class Rows(NamedTuple):
    """A symmetric block tridiagonal matrix, a block per row of the lattice.

    Attributes:
        diagonal: (ny, nx, nx) D_j.
        below: (ny, nx, nx) B_j; the last is zero.
    """

    diagonal: Float[Array, "ny nx nx"]
    below: Float[Array, "ny nx nx"]


def rows(equations: NormalEquations, ratio: Array | float) -> Rows:
    """N + r L by rows of the lattice.

    Args:
        equations: N.
        ratio: r = k_z / k [pixels].
    """
    aa, bb, cc, bc, ca, ab = equations.matrix
    ny, nx = (n + 1 for n in equations.flip.shape)
    index = jnp.arange(ny * nx, dtype=jnp.int32).reshape(ny, nx)
    of_row, of_column = corners(index // nx, equations.flip), corners(index % nx, equations.flip)
    entries = jnp.stack([aa, ab, ca, ab, bb, bc, ca, bc, cc])
    first, second = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    of_row, of_column = jnp.stack(of_row), jnp.stack(of_column)
    place, step = (of_row[first], of_column[first], of_column[second]), of_row[second] - of_row[first]
    empty = jnp.zeros((ny, nx, nx), aa.dtype)
    diagonal, below = (empty.at[place].add(jnp.where(step == apart, entries, 0)) for apart in (0, 1))
    along, across, alone = _chain(nx), np.diag(_chain(ny))[:, None, None], np.eye(nx)[None]
    membrane = jnp.asarray(along[None] + across * alone, aa.dtype)
    joined = jnp.asarray((np.arange(ny) < ny - 1)[:, None, None] * alone, aa.dtype)
    ratio = jnp.asarray(ratio, aa.dtype)
    return Rows(diagonal + ratio * membrane, below - ratio * joined)


@jax.jit
def solve_rows(matrix: Rows, right_side: Node) -> tuple[Node, Node]:
    """Solution, and diagonal of the inverse, in node shape."""
    nx = right_side.shape[1]
    identity = jnp.eye(nx, dtype=right_side.dtype)

    def down(before: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        coupled, carried = before
        diagonal, below, b = row
        factor = jax.scipy.linalg.cho_factor(diagonal - coupled, lower=True)
        y = b - carried
        solved = jax.scipy.linalg.cho_solve(factor, jnp.concatenate([identity, below, y[:, None]], axis=1))
        inverse, t, s = solved[:, :nx], solved[:, nx:-1], solved[:, -1]
        return (below.T @ t, below.T @ s), (inverse, t, s)

    def up(after: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        x, z = after
        inverse, t, s = row
        here, z = inverse + t @ x @ t.T, s - t @ z
        return (here, z), (z, jnp.diagonal(here))

    nothing = jnp.zeros_like(identity), jnp.zeros(nx, right_side.dtype)
    with jax.default_matmul_precision("highest"):
        _, swept = lax.scan(down, nothing, (matrix.diagonal, matrix.below, right_side))
        _, (z, variance) = lax.scan(up, nothing, swept, reverse=True)
    return z, variance


def exact_height(equations: NormalEquations, ratio: Array | float) -> tuple[Node, Node]:
    """The best heights, and the diagonal of (N + r L)^-1 [1/pixels]; see `error_bars` for what that means."""
    z, variance = solve_rows(rows(equations, ratio), equations.right_side)
    return z + MIDDLE, variance


def _chain(n: int) -> np.ndarray:
    """(n, n) Laplacian of n nodes in a row."""
    degree = np.full(n, 2.0)
    degree[[0, -1]] -= 1
    return np.diag(degree) - np.eye(n, k=1) - np.eye(n, k=-1)
