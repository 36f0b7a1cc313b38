"""Springs whose rest lengths are driven: muscles, motors, tendons.

    l = l_0 c        c = clip(controller(state), low, high)        one command for all springs, one for each, or one for each group

A command is taken where a step begins and held to its end: stages and iterations inside a step see rest lengths that do not depend on
where the nodes are, so that matrices stay symmetric whatever the controller reads. Between two steps the commands change while nothing
moves, and the actuators do the work

    W = sum over the springs of E(r, l') - E(r, l)        [J]

Source: sampled control with a zero-order hold, Astrom and Wittenmark (1997), chapter 2; robots of springs driven by their rest lengths, Hu
and others (2020).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers, as_indices, own
from .._checks import as_inexact, has_shape, is_concrete, positive
from ..state import State
from ..topology.base import Topology
from ..topology.edge_field import EdgeField

PASSIVE = -1  # the group of springs that nobody drives


class Actuation(eqx.Module):
    """Rest lengths that a controller drives, for `Springs(..., actuation=...)`.

    Attributes:
        controller: state -> commands, factors of the rest lengths: one number, (E,) in the user's order, or with `groups` (G,). Any
            callable whose weights are a tree of arrays: a module of equinox, a function of `state.time`. It is called once a step, with
            the state in which the step begins.
        groups: (E,) group of each spring, from 0, in the user's order; -1 where nobody drives it. None: no groups.
        low, high: range to which commands are clipped; beyond it they have no derivative.
        n_groups: G, or None where there are no groups (static).
        members: one entry per spring family, 1 where a spring is of a group, else 0, once bound.

    Raises:
        TypeError: a controller that is not callable, groups that are not whole numbers.
        ValueError: groups in another form than (E,), or below -1; limits that are not above zero, or out of order.

    >>> import jax.numpy as jnp
    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> beat = js.robot.Actuation(lambda state: 1 + 0.2 * jnp.sin(jnp.stack([state.time, -state.time])), groups=[0, 1])
    >>> springs = js.Springs(net, 10.0, 1.0, actuation=beat)
    >>> later = js.State.from_points(net, net.grid(), time=0.5 * jnp.pi)
    >>> print(net.flatten(springs.natural_length(later)))
    [1.2 0.8]
    """

    controller: Callable[[State], Any]
    groups: np.ndarray | None
    low: Array
    high: Array
    n_groups: int | None = eqx.field(static=True)
    members: tuple[Array, ...] | None

    def __init__(self, controller: Callable[[State], Any], groups: Numbers | None = None, low: Numbers = 0.5, high: Numbers = 1.5):
        if not callable(controller):
            raise TypeError(f"controller is a {type(controller).__name__}; expected a function of a state, or a module with __call__.")
        self.controller = controller
        self.groups = None if groups is None else _as_groups(groups)
        self.n_groups = None if self.groups is None else int(self.groups.max(initial=PASSIVE)) + 1
        self.low, self.high = as_inexact("low", low), as_inexact("high", high)
        for name, value in (("low", self.low), ("high", self.high)):
            has_shape(name, value, {"one number": ()})
            positive(name, value, "A rest length would vanish, or turn around.")
        if is_concrete(self.low) and is_concrete(self.high) and self.low > self.high:
            raise ValueError(f"low = {self.low}, high = {self.high}; expected low at most high. Change one of them.")
        self.members = None

    def check(self, net: Topology) -> None:
        """Raise ValueError where the groups are not those of these springs."""
        if self.groups is not None and self.groups.shape != (net.n_springs,):
            raise ValueError(
                f"groups has shape {self.groups.shape}; expected ({net.n_springs},), one whole number per spring of the net, in the order "
                f"of net.edges."
            )

    def bind(self, net: Topology, dtype: Any) -> Actuation:
        """The same, knowing which springs of each family are of each group."""
        if self.groups is None:
            return self
        families = net.split(jnp.asarray(self.groups)).families
        members = tuple(jax.nn.one_hot(group, self.n_groups or 0, dtype=dtype) for group in families)  # of -1: none
        return eqx.tree_at(lambda a: a.members, self, members, is_leaf=lambda leaf: leaf is None)

    def command(self, net: Topology, state: State) -> Array:
        """What the controller asks for in this state, within the limits.

        Raises:
            ValueError: an answer of another shape.
        """
        found = own("what the controller gives", self.controller(state), state.dtype)
        many = {"one per spring": (net.n_springs,)} if self.groups is None else {"one per group": (self.n_groups or 0,)}
        has_shape("what the controller gives", found, {"one number": (), **many})
        return jnp.clip(found, self.low.astype(state.dtype), self.high.astype(state.dtype))

    def factor(self, net: Topology, command: Array) -> Array | EdgeField:
        """The command of each spring; one number where there is one for all."""
        if self.groups is None:
            return net.edge_field(command, "command")
        # A product with zeros and ones: a table look-up would put a scatter into the gradient.
        members = self.members or self.bind(net, command.dtype).members or ()
        change = jnp.broadcast_to(command - 1, (self.n_groups or 0,))
        return net.own(1 + of_family @ change for of_family in members)

    def invalid(self) -> Array:
        """Whether the limits are such as the constructor refuses."""
        return ~((self.low > 0) & (self.low <= self.high) & jnp.isfinite(self.high))


def _as_groups(groups: Any) -> np.ndarray:
    """Groups of the object's own, which nobody can change."""
    found = as_indices("groups", groups).astype(np.int32)
    if found.ndim != 1:
        raise ValueError(f"groups has shape {found.shape}; expected (E,), one whole number per spring.")
    if np.any(found < PASSIVE):
        i = int(np.argmax(found < PASSIVE))
        raise ValueError(f"groups[{i}] = {found[i]}; expected 0 or more, or -1 for a spring that nobody drives.")
    found.setflags(write=False)
    return found


__all__ = ["PASSIVE", "Actuation"]
