"""Cloth: meshes of sheets, fabrics in measured units, bending, air and pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .meshes import disc as disc
    from .meshes import outline as outline
    from .meshes import provot as provot
    from .meshes import rectangle as rectangle
    from ..forces.air import Air as Air
    from ..forces.pressure import Pressure as Pressure
    from ..topology.mesh_checks import MeshReport as MeshReport
    from ..topology.mesh_checks import examine as examine
    from ..topology.mesh_checks import rewound as rewound
else:
    __all__, __getattr__, __dir__ = _face(__name__)
