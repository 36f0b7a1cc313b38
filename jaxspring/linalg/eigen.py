"""Eigenvalues and eigenvectors of a symmetric matrix, with derivatives that are right or NaN.

    d lambda_i = q_i' dA q_i                                              finite always
    d q_i      = sum over j of q_j (q_j' dA q_i) / (lambda_i - lambda_j)   where lambda_i stands alone; else NaN

The eigenvectors of a repeated eigenvalue are any basis of their space: they have no derivative, and their eigenvalues' derivatives belong
to the basis that was found; the sum over the group is that of every basis. JAX's own rule gives NaN for the eigenvalues too.

Source: Magnus (1985), "On differentiating eigenvalues and eigenvectors".
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics import linear_call


@jax.custom_jvp
def symmetric_eigen(a: Array) -> tuple[Array, Array]:
    """(n,) eigenvalues, rising, and (n, n) orthonormal eigenvectors as columns, of a symmetric (n, n) matrix."""
    values, vectors = jnp.linalg.eigh(a, symmetrize_input=False)
    return values, vectors


@symmetric_eigen.defjvp
def _symmetric_eigen_jvp(primals: Any, tangents: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    values, q = symmetric_eigen(*primals)
    turned = q.T @ tangents[0] @ q
    gaps = values[None, :] - values[:, None]
    # Closer than this, half of the digits of a derivative would be lost in the difference.
    near = jnp.abs(gaps) <= jnp.asarray(float(jnp.finfo(values.dtype).eps) ** 0.5, values.dtype) * jnp.max(jnp.abs(values))
    turning = jnp.where(near, jnp.zeros_like(gaps), turned / jnp.where(near, jnp.ones_like(gaps), gaps))
    is_alone = jnp.sum(near, axis=0, keepdims=True) == 1
    moved = linear_call(_tangent, _cotangent, jnp.broadcast_to(is_alone, q.shape), q @ turning)
    return (values, q), (jnp.diagonal(turned), moved)


def _tangent(is_alone: Array, dq: Array) -> Array:
    return jnp.where(is_alone, dq, jnp.full_like(dq, jnp.nan))


def _cotangent(is_alone: Array, dq: Array) -> Array:
    """NaN only where the derivative of an eigenvector is asked for that has none."""
    return jnp.where(is_alone | (dq == 0), dq, jnp.full_like(dq, jnp.nan))


def lowest_eigenpairs(a: Any, n_pairs: int) -> tuple[np.ndarray, np.ndarray]:
    """The lowest eigenvalues of a sparse symmetric matrix, on the host, by Lanczos iterations with shift and invert.

    The shift is lowered until the shifted matrix is positive definite by its pivots, so that nothing lies below: what is nearest to
    the shift is then what is lowest.

    Args:
        a: (n, n) SciPy sparse matrix.
        n_pairs: how many, less than n.

    Returns:
        (n_pairs,) eigenvalues, rising, and (n, n_pairs) orthonormal eigenvectors.
    """
    from scipy.sparse import eye_array
    from scipy.sparse.linalg import LinearOperator, eigsh, splu

    bound = float(np.max(abs(a).sum(axis=1)))
    if bound == 0:
        return np.zeros(n_pairs), np.eye(a.shape[0], n_pairs)
    unit = eye_array(a.shape[0], format="csc")
    # Near the lowest eigenvalues of a stable system, for fast convergence, and off its zero ones, so that it can be factored.
    shift = -1e-6 * bound
    while True:
        factor = splu((a - shift * unit).tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        # Without interchanges of rows the signs of the pivots are those of the eigenvalues. Below -bound there are none.
        if shift < -bound or (np.array_equal(factor.perm_r, factor.perm_c) and np.all(factor.U.diagonal() > 0)):
            break
        shift *= 10
    inverse: Any = LinearOperator(a.shape, factor.solve)
    start = np.random.default_rng(0).normal(size=a.shape[0])
    values, vectors = eigsh(a, n_pairs, sigma=shift, OPinv=inverse, v0=start)
    order = np.argsort(values)
    return values[order], vectors[:, order]


__all__ = ["lowest_eigenpairs", "symmetric_eigen"]
