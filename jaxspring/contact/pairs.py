"""Contact of nodes with nodes: cloth with itself, bodies with each other.

    depth       s = R_i + R_j - |x_i - x_j|                       [m]   R: radius of a node's ball
    elastic     k p(s) u                                          [N]   u: from j to i; p: see `law.py`; the gradient of an energy
    damper      -c g(s) ((v_i - v_j) . u) u                       [N]
    friction    -mu k p(s) h(|v_t|) v_t                           [N]   v_t: the rest of v_i - v_j

Left out are pairs that a spring joins, and pairs that touch at rest already: sheets may lie closer than their radii. What one of a pair
gets the other loses, to the bit. Nodes do not spin: friction, which acts at a distance from the centres, keeps no angular momentum.

Source: soft balls as in Cundall and Strack (1979), "A discrete numerical model for granular assemblies", without rotation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, has_shape, is_concrete, kind, node_values, nonnegative
from ..forces.base import Finding, Force, Scene, Step, any_refused
from ..forces.neighbour_list import NeighbourList
from ..forces.pair_sums import Fields
from ..forces.pairs import AllPairs, Pairs
from ..memory import entry_at
from ..numerics import cast_inexact, stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.periods import check_dim
from ..vector import Vector
from .base import any_not_finite, length
from .joined import Joined, UnjoinedList, UnjoinedPairs
from .law import ContactLaw
from .pair_contact import PairContact


class NodeContact(Force):
    """A ball around every node, which no other enters without being pushed back. Off unless it is among the forces.

    Nodes that no spring joins, and that did not touch at rest, push each other apart. Where balls leave gaps (radii below half the spacing
    of a cloth, times the square root of two across its squares) a node may slip through.

    Attributes:
        joined: which nodes springs join.
        radius: R [m].
        law: how hard they push: stiffness, onset, damping, friction, creep.
        rest: places at rest, where pairs that touch are left out; None: no pair is but the joined ones.
        pairs: `AllPairs()` or `NeighbourList`.
        box: (D,) period of each coordinate [m], or None; `System` fills it in from its net.

    Raises:
        TypeError: pairs of another kind.
        ValueError: a negative radius or constant, an onset or a creep that is not positive.

    >>> net = js.Graph.from_edges(np.zeros((0, 2), int), 2)
    >>> system = js.System(net, mass=1.0, forces=NodeContact(net, radius=0.5, stiffness=100.0, onset=0.1))
    >>> print(system.force(js.State.from_points(net, [[0.0, 0.0], [0.75, 0.0]])).x.round(3))
    [-20.  20.]
    """

    is_cache: ClassVar[bool] = True
    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    joined: Joined
    radius: Array
    law: ContactLaw
    rest: Any
    pairs: AllPairs | NeighbourList
    box: Array | None

    def __init__(
        self,
        joined: Topology | Sequence[Topology] | Joined,
        radius: Numbers,
        stiffness: Numbers,
        damping: Numbers | None = None,
        friction: Numbers | None = None,
        onset: Numbers = 1e-3,
        creep: Numbers = 1e-3,
        rest: Numbers | None = None,
        pairs: Pairs | None = None,
    ):
        """Check what is given.

        Args:
            joined: the net, or several over the same nodes, whose springs join nodes that are left out.
            radius: R [m]: a number, or (N,) in the user's order; 0 is a point, which other balls push.
            stiffness: k [N/m], one number. Two nodes that meet at a relative speed v go as deep as v sqrt(m / (2 k)).
            damping: c [N s/m], one number; None: no damper.
            friction: mu, one number; None: no friction.
            onset: w [m], over which the stiffness sets in; 1 mm unless said.
            creep: [m/s], below which friction falls to zero; 1 mm/s unless said.
            rest: (N, D) places of the nodes at rest, in the user's order [m].
            pairs: which pairs are looked at; `AllPairs()` unless said, or `NeighbourList(capacity, skin)`, whose capacity counts the joined
                neighbours too.
        """
        self.joined = Joined.of(joined)
        self.radius = node_values("radius", radius)
        nonnegative("radius", self.radius, "A ball of negative radius touches nothing.")
        self.law = ContactLaw(stiffness, onset, damping, friction, creep)
        for name in ("stiffness", "damping", "friction"):
            value = getattr(self.law, name)
            if value is not None and value.ndim:
                raise ValueError(f"{name} has shape {value.shape}; expected one number: a pair has two nodes. Give radii per node.")
        self.rest = None if rest is None else as_inexact("rest", rest)
        if self.rest is not None:
            n = math.prod(self.joined.layout.shape)
            has_shape("rest", self.rest, {f"{dim} coordinates per node": (n, dim) for dim in (1, 2, 3)})
            finite("rest", self.rest)
        chosen = AllPairs() if pairs is None else kind("pairs", pairs, Pairs, "NeighbourList(capacity=32, skin=0.05)")
        if not isinstance(chosen, AllPairs | NeighbourList):
            raise TypeError(f"pairs is a {type(chosen).__name__}; expected AllPairs or NeighbourList, which can leave pairs out.")
        self.pairs = chosen
        self.box = None

    def check(self, scene: Scene) -> None:
        """Raise ValueError for another net's nodes, radii or places of another number, and for balls wider than half a period."""
        if self.joined.layout != scene.net.layout:
            raise ValueError("NodeContact was built with a net over other nodes than the system's. Build it with the system's net.")
        scene.net.node_field(self.radius, "radius")
        if self.rest is not None:
            scene.net.vector_field(self.rest, "rest")
        if scene.box is not None and is_concrete(scene.box) and is_concrete(self.radius):
            periods = np.asarray(scene.box)
            if np.any((periods > 0) & (4 * np.max(np.asarray(self.radius)) > periods)):
                raise ValueError(
                    f"two balls of radius {float(jnp.max(self.radius))} m reach beyond half a period of box = {periods} m: a node would "
                    f"touch two images of another, of which one acts. Use a larger box, or smaller radii."
                )

    def bind(self, scene: Scene) -> NodeContact:
        """The same with constants in node shape, and with what the springs of the scene join."""
        rest = None if self.rest is None else scene.net.vector_field(self.rest, "rest")
        pairs = UnjoinedList(self.pairs, self.joined) if isinstance(self.pairs, NeighbourList) else UnjoinedPairs(self.pairs, self.joined)
        radius = scene.net.node_field(self.radius, "radius")
        ready = eqx.tree_at(
            lambda f: (f.radius, f.rest, f.pairs, f.box),
            self,
            (radius, rest, pairs, scene.box),
            is_leaf=lambda leaf: leaf is None,
        )
        return cast_inexact(ready, scene.dtype)

    def force(self, state: State) -> Vector:
        """Force on each node [N]."""
        return Vector(self._sum(state, PairContact.force, -1, not self.is_symmetric))

    def energy(self, state: State) -> Array:
        """Elastic energy of all pairs [J]."""
        return jnp.sum(self._sum(state, PairContact.energy, 1)[0])

    @property
    def is_symmetric(self) -> bool:
        """Whether there is no damper and no friction, whose strength depends on the depth."""
        return self.law.damping is None and self.law.friction is None

    @property
    def can_feed(self) -> bool:
        """Whether the force can raise the energy: damper and friction take energy out."""
        return False

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """Elastic energy [J]; None with a damper or friction, which have none."""
        return self.energy(state) if self.is_symmetric else None

    def touching(self, state: State) -> Array:
        """How many others touch each node, node shape."""
        return self._sum(state, PairContact.touches, 1)[0]

    def stiffness_bound(self, state: State) -> Array:
        """2 k for each that touches a node, and for one that may come at any time [N/m]."""
        n = self.touching(state)
        return 2 * self.law.stiffness.astype(state.dtype) * jnp.maximum(n, jnp.ones_like(n))

    def damping_bound(self, state: State) -> Array | None:
        """2 c, and 4 mu push / creep, for each that touches [N s/m]; None without damper and friction."""
        return None if self.is_symmetric else self._sum(state, PairContact.damping, 1)[0]

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """NEIGHBOUR_OVERFLOW, with the capacity that is needed."""
        needed = self.pairs.needed(self._list(state))
        return () if needed is None else (Finding(Flag.NEIGHBOUR_OVERFLOW, needed, jnp.asarray(-1, jnp.int32)),)

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the onset."""
        return self.law.rounding(state.position)

    def remember(self, state: State) -> Any:
        """The list that its pairs reuse, or None."""
        return self.pairs.begin(stopped(self._flat(state.position)), self._reach, *self._periods)

    def renew(self, memory: Any, state: State) -> Any:
        """The list where it serves these positions, else a new one."""
        return self.pairs.keep(memory, stopped(self._flat(state.position)), self._reach, *self._periods)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The list brought up to date; DT_LIMIT where a node moved farther than the smallest radius in one step: it may have passed
        through another.
        """
        before, now = stopped((step.before.position, state.position))
        moved = jnp.ravel(length(now - before))
        radius = jnp.where(self.radius > 0, self.radius, jnp.full_like(self.radius, jnp.inf))
        node = jnp.argmax(moved).astype(jnp.int32)
        status = Status.when(Flag.DT_LIMIT, jnp.max(moved) > jnp.min(stopped(radius)), node=node)
        memory = self._list(state)
        if memory is None:
            return state, status
        memory, of_list = self.pairs.update(memory, self._flat(before), self._flat(now), self._reach, *self._periods)
        return self.keep(state, memory), of_list.then(status)

    def invalid(self) -> Array:
        """Whether a constant is negative or not finite, or not positive where it must be."""
        bad = self.law.invalid() | any_refused(self.radius)
        bad = bad if self.rest is None else bad | any_not_finite(*_arrays(self.rest))
        return bad | any_refused(self.pairs.skin) if isinstance(self.pairs, NeighbourList) else bad

    @property
    def _reach(self) -> Array:
        """Farthest that two balls touch [m]."""
        return 2 * jnp.max(self.radius)

    @property
    def _periods(self) -> tuple[Array, ...]:
        return () if self.box is None else (self.box,)

    def _list(self, state: State) -> Any:
        entry = entry_at(state.memory, self.place)
        return None if entry is None else entry.value

    def _sum(self, state: State, term: Callable[..., Fields], sign: int, with_velocity: bool = False) -> Fields:
        """Sum of a pair term at each node, in node shape."""
        if not isinstance(self.pairs, UnjoinedPairs | UnjoinedList):
            raise ValueError("NodeContact has no nodes yet. Put it in a System and ask that, or the forces of system.bind(state.dtype).")
        check_dim(self.box, state.dim)
        shape, position = state.position.shape, self._flat(state.position)
        rest = () if self.rest is None else self._flat(self.rest)
        radius = () if self.radius.ndim == 0 else (jnp.ravel(self.radius),)
        velocity = self._flat(state.velocity) if with_velocity else ()
        memory = self.pairs.ready(self._list(state), stopped(position), self._reach, *self._periods)
        common = self.radius if self.radius.ndim == 0 else None
        terms = PairContact(self.law, common, self.box, state.dim, bool(rest), bool(velocity))
        found = self.pairs.sum(term, terms, (*position, *rest, *radius, *velocity), memory, sign)
        return tuple(a.reshape(shape) for a in found)

    def _flat(self, v: Vector) -> Fields:
        return tuple(jnp.ravel(a) for a in v)


def _arrays(rest: Any) -> tuple[Array, ...]:
    return rest.components if isinstance(rest, Vector) else (rest,)


__all__ = ["NodeContact"]
