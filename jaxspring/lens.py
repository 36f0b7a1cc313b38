"""Lenses of springs: parts of an image magnified, the rest squeezed, without a fold; differentiable, invertible, usable as a layer."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .scenes.lens.foci import Disc as Disc
    from .scenes.lens.foci import Focus as Focus
    from .scenes.lens.foci import Importance as Importance
    from .scenes.lens.foci import Polygon as Polygon
    from .scenes.lens.foci import ramped as ramped
    from .scenes.lens.rest_lengths import by_rest_lengths as by_rest_lengths
    from .scenes.lens.rest_lengths import rest_length_system as rest_length_system
    from .scenes.lens.scene import Lens as Lens
    from .scenes.lens.warp import Certificate as Certificate
    from .scenes.lens.warp import Warp as Warp
else:
    __all__, __getattr__, __dir__ = _face(__name__)
