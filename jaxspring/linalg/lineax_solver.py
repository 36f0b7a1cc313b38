"""Any solver of lineax in the place of ours: `Lineax`."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from ..status import Flag, Status
from .iterative import Ended, IterativeSolver, Operator, PyTree, identity
from .preconditioners import BlockJacobi, Preconditioner


class Lineax(IterativeSolver):
    """A lineax solver within the guards of ours: unit right-hand side, true residual, statuses, NaN where a backward solve fails.

    It sees the matrix as a `lineax.FunctionLinearOperator`; a direct solver makes a dense matrix of that, so keep those to small nets.

    Args:
        solver: for instance `lineax.CG(rtol=1e-8, atol=1e-12)` or `lineax.Cholesky()`.
        tolerance: residual over |b| above which (by more than a factor of 10) a solve has failed; None is the solver's `rtol`, and 1e-8
            in float64 and 1e-5 in float32 where it has none. How far to iterate is the solver's own affair.
        tags: what lineax may take for granted; None is symmetric and positive semi-definite.
        preconditioner: handed on to solvers that take one.

    Raises:
        ValueError: a tolerance that is not positive, or a solver with `rtol` alone: lineax divides by `atol + rtol |b|`, which is 0 / 0 at
            every held coordinate, and takes the NaN for converged. The right-hand side has norm 1: `atol=1e-12` does no harm.

    >>> import lineax
    >>> x, info = Lineax(lineax.CG(rtol=1e-6, atol=1e-12)).solve(lambda x: 2 * x, jnp.array([2.0, 4.0]))
    >>> print(x.round(5), info.status.describe())
    [1. 2.] OK
    """

    solver: Any = None
    tags: Any = eqx.field(static=True, default=())

    unconverged: ClassVar[Flag] = Flag.SOLVER

    def __init__(
        self,
        solver: Any,
        tolerance: float | None = None,
        tags: Iterable[object] | None = None,
        preconditioner: Preconditioner | None = None,
    ):
        import lineax

        if getattr(solver, "atol", None) == 0 and solver.rtol != 0:
            raise ValueError("solver.atol is 0: at a coordinate that does not move lineax divides 0 by 0 and stops; set atol=1e-12")
        self.solver = solver
        given = (lineax.symmetric_tag, lineax.positive_semidefinite_tag) if tags is None else tuple(tags)
        # By name: lineax compares its tags by identity, which neither pickle nor deepcopy keeps.
        self.tags = tuple(repr(tag) if getattr(lineax, repr(tag), None) is tag else tag for tag in given)
        self.tolerance = getattr(solver, "rtol", None) if tolerance is None else tolerance
        self.adjoint_tolerance = None
        self.max_iter = None
        self.preconditioner = BlockJacobi() if preconditioner is None else preconditioner

    def iterate(self, matvec: Operator, b: PyTree, start: PyTree, residual: PyTree, precondition: Operator, tolerance: float) -> Ended:
        """Call `lineax.linear_solve`."""
        import lineax

        structure = jax.eval_shape(lambda: b)
        options: dict[str, Any] = {"y0": start}
        if precondition is not identity:
            definite = lineax.positive_semidefinite_tag
            options["preconditioner"] = lineax.FunctionLinearOperator(precondition, structure, (lineax.symmetric_tag, definite))
        tags = tuple(getattr(lineax, tag) if isinstance(tag, str) else tag for tag in self.tags)
        operator = lineax.FunctionLinearOperator(matvec, structure, tags)
        solution = lineax.linear_solve(operator, b, self.solver, options=options, throw=False)
        results = lineax.RESULTS
        flags = (
            (results.max_steps_reached, Flag.CG_MAXITER),
            (results.singular, Flag.PIVOT),
            (results.breakdown, Flag.SOLVER),
            (results.stagnation, Flag.SOLVER),
            (results.conlim, Flag.SOLVER),
            (results.nonfinite_input, Flag.NONFINITE),
        )
        status = Status.ok()
        for result, flag in flags:
            status = status.then(Status.when(flag, solution.result == result))
        return Ended(solution.value, jnp.asarray(solution.stats.get("num_steps", -1), jnp.int32), status)


__all__ = ["Lineax"]
