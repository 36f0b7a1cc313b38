"""Steppers: how a state is advanced by one step, and how large a step may be."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from ..forces.linearisation import ExactTangent as ExactTangent
    from ..forces.linearisation import Linearisation as Linearisation
    from ..forces.linearisation import Secant as Secant
    from ..forces.linearisation import Tangent as Tangent
    from .solves import Solves as Solves
    from .base import Stepper as Stepper
    from .equilibrium import Equilibrium as Equilibrium
    from .explicit import ForwardEuler as ForwardEuler
    from .explicit import RungeKutta4 as RungeKutta4
    from .explicit import SymplecticEuler as SymplecticEuler
    from .explicit import VelocityVerlet as VelocityVerlet
    from .implicit import BDF2 as BDF2
    from .implicit import BackwardEuler as BackwardEuler
    from .implicit import ImplicitMidpoint as ImplicitMidpoint
    from .newton import Newton as Newton
    from .semi_implicit import SemiImplicit as SemiImplicit
    from .stability import stable_dt as stable_dt
    from .still import Still as Still
else:
    __all__, __getattr__, __dir__ = _face(__name__)
