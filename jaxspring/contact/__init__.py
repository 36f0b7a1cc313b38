"""Contact with obstacles of any form: impacts in a step, sliding with friction, and what they gave."""

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
    from ..forces.contact import Floor as Floor
else:
    __all__, __getattr__, __dir__ = _face(__name__)
