"""Cloth: bending, fabrics in measured units, wind, pressure, limits of strain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from ..forces.cloth_laws import ChoiKo as ChoiKo
    from ..forces.cloth_laws import Stiffening as Stiffening
    from ..forces.strain_limit import StrainLimit as StrainLimit
else:
    __all__, __getattr__, __dir__ = _face(__name__)
