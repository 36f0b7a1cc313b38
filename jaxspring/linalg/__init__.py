"""Linear solvers that report how they ended, preconditioners, and the matrices of springs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .base import LinearSolver as LinearSolver
    from .base import SolveInfo as SolveInfo
    from .exact import ExactSolver as ExactSolver
    from .lineax_solver import Lineax as Lineax
    from .operators import Blocks as Blocks
    from .operators import CellDyads as CellDyads
    from .operators import NodeDyads as NodeDyads
    from .operators import SpringBlocks as SpringBlocks
    from .operators import SpringMatrix as SpringMatrix
    from .multigrid import Multigrid as Multigrid
    from .preconditioners import BlockJacobi as BlockJacobi
    from .preconditioners import Jacobi as Jacobi
    from .preconditioners import Preconditioner as Preconditioner
    from .preconditioners import Unpreconditioned as Unpreconditioned
    from .envelope import Profile as Profile
    from .ordering import Natural as Natural
    from .ordering import Ordering as Ordering
    from .ordering import ReverseCuthillMcKee as ReverseCuthillMcKee
    from .skyline import SkylineFactor as SkylineFactor
    from .cg import CG as CG
    from .cg import JaxCG as JaxCG
    from .skyline import Skyline as Skyline
else:
    __all__, __getattr__, __dir__ = _face(__name__)
