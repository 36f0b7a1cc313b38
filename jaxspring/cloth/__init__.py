"""Cloth: bending by hinges of a mesh and by joints of a chain or a grid."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from ..forces.hinges import Hinges as Hinges
    from ..forces.joints import AngularJoints as AngularJoints
    from ..forces.plastic_hinges import PlasticHinges as PlasticHinges
    from ..forces.history import Creased as Creased
else:
    __all__, __getattr__, __dir__ = _face(__name__)
