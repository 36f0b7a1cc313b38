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
from ..topology.edge_field import EdgeField, field_of, fields_of
from .base import Force
from .springs import Springs


class Molten(eqx.Module):
    """A particle is fluid once none of its springs is alive.

    Attributes:
        net: the topology whose springs `state.alive` tells about.
    """

    net: Topology

    def is_fluid(self, state: State) -> Array:
        """Bool in node shape. Where springs do not break (`state.alive` is None), only nodes without any spring are fluid.

        Raises ValueError where `state.alive` tells about the springs of another net.
        """
        if self.net.n_springs == 0:
            return jnp.ones(self.net.node_shape, bool)
        shapes = self.net.family_shapes
        all_whole = self.net.everywhere(jnp.ones((), bool))
        fields = fields_of(state.alive) or (all_whole,)
        alive = field_of(self.net, fields) or fields[0]
        given = tuple(entry.shape for entry in alive.families)
        if not self.net.owns(alive) or given != shapes:
            raise ValueError(
                f"state.alive tells about springs in families of shapes {given}{_whose(alive)}, but this net is a {_described(self.net)}.\n"
                f"Pass the net that the springs and Fusing were built on; for frames of a run, use jax.vmap."
            )
        return self.net.incident_sum(alive.map(lambda a: a.astype(jnp.float32))) == 0


def check_springs(who: str, net: Topology, forces: tuple[Force, ...]) -> None:
    """Raise ValueError where there are springs, but none on the net of `who`: what is alive there would not be theirs."""
    nets = [force.net for force in forces if isinstance(force, Springs)]
    if nets and all(other.identity != net.identity for other in nets):
        raise ValueError(
            f"{who} has a {_described(net)}, but the Springs of this system have a {_described(nets[0])}.\n"
            f"Unchecked, {who} would tell about springs that nothing holds, and those of Springs would never break, without a word.\n"
            f"Build both on one net: pass that of Springs to {who}."
        )


def _described(net: Topology) -> str:
    return f"{type(net).__name__} of {net.n_springs} springs in families of shapes {net.family_shapes} ({net.identity})"


def _whose(field: EdgeField) -> str:
    return "" if field.identity is None else f" ({field.identity})"
