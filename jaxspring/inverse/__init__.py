"""Inverse problems: fitting parameters to data by gradients through a simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .fit import History as History
    from .fit import Iteration as Iteration
    from .determined import Undetermined as Undetermined
    from .iteration import GradientWarning as GradientWarning
    from .optimisers import Optax as Optax
    from .optimisers import Optimiser as Optimiser
    from .stopping import StopReason as StopReason
    from .transforms import Identity as Identity
    from .transforms import SoftPositive as SoftPositive
    from .transforms import Transform as Transform
    from .select import Selection as Selection
    from .check import GradientCheck as GradientCheck
    from .fit import Fit as Fit
    from .optimisers import LBFGS as LBFGS
    from .optimisers import Adam as Adam
    from .optimisers import LeastSquares as LeastSquares
    from .stopping import Stop as Stop
    from .transforms import Bounded as Bounded
    from .transforms import Positive as Positive
    from .losses import squared_distance as squared_distance
    from .checkpoint import Checkpoint as Checkpoint
    from .check import check_gradient as check_gradient
else:
    __all__, __getattr__, __dir__ = _face(__name__)
