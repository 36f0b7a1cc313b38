"""Which particles are fluid: those that no living spring holds.

    two fluid particles      the full law
    one fluid, one solid     the law where it repels, nothing beyond r_0: the lattice holds itself together already
    two solid ones           nothing: their springs act, and no pair that a spring holds is counted twice

Source: Terzopoulos, Platt and Fleischer (1989): a particle whose last unit has fused is fluid.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField


class Molten(eqx.Module):
    """A particle is fluid once none of its springs is alive.

    Attributes:
        net: the topology whose springs `state.alive` tells about.
    """

    net: Topology

    def is_fluid(self, state: State) -> Array:
        """Bool in node shape. Where springs do not break (`state.alive` is None), only nodes without any spring are fluid."""
        if self.net.n_springs == 0:
            return jnp.ones(self.net.node_shape, bool)
        shapes = self.net.family_shapes
        alive = EdgeField(tuple(jnp.ones(shape, bool) for shape in shapes)) if state.alive is None else state.alive
        return self.net.incident_sum(alive.map(lambda a: a.astype(jnp.float32))) == 0
