"""The particle fluid: laws of a pair, their cut-offs, and which pairs are summed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ._lazy import face as _face

if TYPE_CHECKING:  # written by `python -m tests.face`
    from .forces.pair_laws import LennardJones as LennardJones
    from .forces.pair_laws import PairLaw as PairLaw
    from .forces.pair_laws import SlideLaw as SlideLaw
    from .forces.pair_laws import UnitVectorLaw as UnitVectorLaw
    from .forces.pair_laws import gentle_fluid as gentle_fluid
    from .forces.cutoffs import Cutoff as Cutoff
    from .forces.cutoffs import NoCutoff as NoCutoff
    from .forces.cutoffs import PlainCutoff as PlainCutoff
    from .forces.cutoffs import ShiftedForce as ShiftedForce
    from .forces.cutoffs import Switched as Switched
    from .forces.pairs import AllPairs as AllPairs
    from .forces.pairs import Pairs as Pairs
    from .forces.neighbour_list import NeighbourList as NeighbourList
    from .forces.pair_drag import PairDrag as PairDrag
    from .forces.molten import Molten as Molten
    from .forces.fluid import Fluid as Fluid
else:
    __all__, __getattr__, __dir__ = _face(__name__)
