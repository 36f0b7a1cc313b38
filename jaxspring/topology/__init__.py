"""Which nodes exist and which springs join them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .edge_field import EdgeField as EdgeField
    from .base import Topology as Topology
    from .builders import from_networkx as from_networkx
    from .builders import from_scipy as from_scipy
    from .overlay import Overlay as Overlay
    from .padding import NetBatch as NetBatch
    from .padding import pad_nets as pad_nets
    from .lattice import BEND as BEND
    from .lattice import BODY as BODY
    from .lattice import SHEAR as SHEAR
    from .lattice import STRUCTURAL as STRUCTURAL
    from .lattice import Lattice as Lattice
    from .graph import Graph as Graph
    from .mesh_files import from_mesh as from_mesh
    from .builders import delaunay as delaunay
    from .builders import from_triangles as from_triangles
else:
    __all__, __getattr__, __dir__ = _face(__name__)
