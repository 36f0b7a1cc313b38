"""Contact: obstacles of any form, a smooth force that keeps nodes out of them, and one that keeps nodes apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .base import Obstacle as Obstacle
    from .rule import Contact as Contact
    from .reactions import Impulse as Impulse
    from .reactions import Impulses as Impulses
    from .reactions import impulses as impulses
    from .reactions import push_out as push_out
    from .obstacles import Box as Box
    from .obstacles import Capsule as Capsule
    from .obstacles import Cylinder as Cylinder
    from .obstacles import HalfSpaces as HalfSpaces
    from .obstacles import Plane as Plane
    from .obstacles import Sphere as Sphere
    from .height_field import HeightField as HeightField
    from .mesh_field import MeshField as MeshField
    from .moving import Moving as Moving
    from .moving import SignedDistance as SignedDistance
    from .penalty import Penalty as Penalty
    from .pairs import NodeContact as NodeContact
    from ..forces.contact import Floor as Floor
else:
    __all__, __getattr__, __dir__ = _face(__name__)
