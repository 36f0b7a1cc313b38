"""Springs and dampers so long that the square of their length overflows: what a law then makes of it is no number to trust.

|r| <= 2 sqrt(D) max |x|        no spring is measured before the coordinates are large enough for the longest to be beyond the range
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import any_lane
from ..state import State
from ..status import Flag
from ..topology.base import Topology
from ..vector import Vector
from .base import Finding
from .laws import is_beyond_range
from .living import map_living


def beyond_range(net: Topology, near: Topology, state: State, seen: Vector) -> Finding:
    """NONFINITE: how many springs of this net are too long.

    Args:
        net: the topology.
        near: the same with the periods of the coordinates between which the springs run.
        state: with `alive`, which is heeded.
        seen: these coordinates.
    """
    largest = seen.largest()
    safe = (float(jnp.finfo(largest.dtype).max) / (8 * seen.dim)) ** 0.5

    def count() -> Array:
        # Differences are taken in here: as inputs of the branch they would be stored, whether it is taken or not.
        return net.sum(map_living(net, state, lambda d: is_beyond_range(d).astype(jnp.int32), near.difference(seen)))

    n = lax.cond(any_lane(~(largest < safe)), count, lambda: jnp.zeros((), jnp.int32))
    return Finding(Flag.NONFINITE, n, jnp.asarray(-1, jnp.int32))


__all__ = ["beyond_range"]
