"""SciPy: a linear backward Euler step. The matrix is assembled and solved, directly or by conjugate gradients to jaxspring's tolerance."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse.linalg

from .layouts import Forms, Program, Scene
from .references import Implicit

# That of `JaxCG` in float32.
TOLERANCE = 1e-5


def forms(scene: Scene) -> Forms:
    """SuperLU in symmetric mode, and conjugate gradients with the diagonal as preconditioner, both in float32."""
    return {"SuperLU": lambda: implicit(scene, superlu), "CG, Jacobi": lambda: implicit(scene, jacobi)}


def superlu(matrix: Any, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """A direct solve."""
    options = {"SymmetricMode": True}
    factor = scipy.sparse.linalg.splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factor.solve(right)


def jacobi(matrix: Any, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Conjugate gradients, from the velocities before."""
    inverse = 1 / matrix.diagonal()
    scale = scipy.sparse.linalg.LinearOperator(matrix.shape, lambda r: inverse * r)
    x, _ = scipy.sparse.linalg.cg(matrix, right, x0=start, rtol=TOLERANCE, maxiter=10_000, M=scale)
    return x


def implicit(scene: Scene, solve: Callable[..., np.ndarray]) -> Program:
    """The matrix's pattern is made once."""
    step = Implicit(scene["edges"], len(scene["x"]), np.float32)
    k, l, dt, last = scene["k"], scene["l"], np.float32(scene["dt"]), [scene["x"]]

    def run(n_steps: int) -> None:
        x, v = scene["x"], scene["v"]
        for _ in range(n_steps):
            matrix, right = step.system(x, v, k, l, dt)
            v = solve(matrix, right, v.ravel()).reshape(-1, 3)
            x = x + dt * v
        last[0] = x

    return Program(run, lambda: last[0])
