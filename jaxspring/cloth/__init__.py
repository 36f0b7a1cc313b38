"""Cloth: meshes of sheets, fabrics in measured units, bending by hinges and joints, air, pressure, limits of strain."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from ..forces.cloth_laws import ChoiKo as ChoiKo
    from ..forces.cloth_laws import Stiffening as Stiffening
    from ..forces.strain_limit import StrainLimit as StrainLimit
    from ..forces.hinges import Hinges as Hinges
    from ..forces.joints import AngularJoints as AngularJoints
    from ..forces.plastic_hinges import PlasticHinges as PlasticHinges
    from ..forces.history import Creased as Creased
    from .meshes import disc as disc
    from .meshes import outline as outline
    from .meshes import provot as provot
    from .meshes import rectangle as rectangle
    from .materials import DENIM as DENIM
    from .materials import FAST as FAST
    from .materials import Fabric as Fabric
    from .materials import INTERLOCK as INTERLOCK
    from .materials import KES as KES
    from .materials import Published as Published
    from .materials import SWIM_KNIT as SWIM_KNIT
    from .constants import Cloth as Cloth
    from .constants import fabric as fabric
    from .moduli import Moduli as Moduli
    from ..forces.air import Air as Air
    from ..forces.pressure import Pressure as Pressure
    from ..topology.mesh_checks import MeshReport as MeshReport
    from ..topology.mesh_checks import examine as examine
    from ..topology.mesh_checks import rewound as rewound
    from ..export.surfaces import save_obj as save_obj
    from ..export.surfaces import save_stl as save_stl
    from ..scenes.cloth.scene import ClothScene as ClothScene
    from ..scenes.cloth.scene import ClothSettings as ClothSettings
    from ..scenes.cloth.scene import cantilever as cantilever
    from ..scenes.cloth.scene import cusick as cusick
    from ..scenes.cloth.scene import drape_coefficient as drape_coefficient
    from ..scenes.cloth.scene import flag as flag
    from ..scenes.cloth.scene import hanging as hanging
    from ..scenes.cloth.scene import on_ball as on_ball
    from ..scenes.cloth.scene import on_table as on_table
else:
    __all__, __getattr__, __dir__ = _face(__name__)
