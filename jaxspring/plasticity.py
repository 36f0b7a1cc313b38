"""Springs that yield, harden, creep and tear."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .forces.yielding import Yielding as Yielding
    from .forces.tearing import Tearing as Tearing
    from .forces.history import Onset as Onset
    from .forces.history import Torn as Torn
    from .forces.history import Yielded as Yielded
else:
    __all__, __getattr__, __dir__ = _face(__name__)
