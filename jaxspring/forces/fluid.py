"""A fluid of particles: every pair attracts at long range and repels at short range.

    g_i = sum over j of q_i q_j w(r_ij) (x_i - x_j)  -  drag of the pair           [N]      w: see `pair_laws`

Momentum and angular momentum are kept to rounding: each pair's force acts along its line, and its two ends are computed alike.
While nothing is fluid no pair is evaluated: the sum stands in a conditional, which stays one under `vmap` (`numerics.any_lane`).

Source: slide "Discrete Fluid Model".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import constant, is_concrete, kind
from ..memory import entry_at
from ..numerics import any_lane, cast_inexact, stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.periods import check_dim
from ..vector import Vector
from .base import Finding, Force, Scene, Step, any_not_positive
from .cutoffs import Cutoff, NoCutoff
from .molten import Molten, check_springs
from .pair_drag import PairDrag
from .pair_laws import PairLaw
from .pair_terms import Fields, PairTerms, Particles
from .pairs import AllPairs, Pairs

# The core unless the user names one, in equilibrium distances: far inside any distance that a resolved run reaches.
CORE_FRACTION = 0.01


class Fluid(Force):
    """A particle fluid on all nodes, or on those that have melted.

    Attributes:
        law: `SlideLaw`, `UnitVectorLaw`, `LennardJones` or your own.
        cutoff: `NoCutoff()` unless said; or `PlainCutoff`, `ShiftedForce`, `Switched`.
        pairs: `AllPairs()` unless said, or `NeighbourList` where the law has a cut-off.
        drag: `PairDrag`, or None.
        core: distance [m] below which the force per unit of difference stops growing; such pairs are counted as OVERLAP. A hundredth of the
            equilibrium distance unless said.
        molten: `Molten(net)`: only particles without a living spring are fluid; None: all are.
        mass: [kg]; `System` fills it in.
        box: (D,) period of each coordinate [m], or None; `System` fills it in from its net. Each pair acts by its nearest image alone.

    Raises:
        TypeError: a law, cut-off, pairs, drag or molten of another kind.
        ValueError: a list without a cut-off, a core or a drag that does not fit inside it.

    >>> net = js.Graph.from_edges(np.zeros((0, 2), int), 2)
    >>> system = js.System(net, mass=1.0, forces=Fluid(js.fluid.SlideLaw(alpha=1.0, beta=1.0)))
    >>> apart = js.State.from_points(net, [[0.0, 0.0], [2.0, 0.0]])
    >>> print(system.force(apart).x)
    [ 0.375 -0.375]
    """

    is_cache: ClassVar[bool] = True
    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    law: PairLaw
    cutoff: Cutoff
    pairs: Pairs
    drag: PairDrag | None
    core: Array
    molten: Molten | None
    mass: Array | None
    box: Array | None

    def __init__(
        self,
        law: PairLaw,
        cutoff: Cutoff | None = None,
        pairs: Pairs | None = None,
        drag: PairDrag | None = None,
        core: Numbers | None = None,
        molten: Molten | None = None,
    ):
        self.law = kind("law", law, PairLaw, "SlideLaw(alpha=1.0, beta=1.0)")
        self.cutoff = NoCutoff() if cutoff is None else kind("cutoff", cutoff, Cutoff, "ShiftedForce(2.5)")
        self.pairs = AllPairs() if pairs is None else kind("pairs", pairs, Pairs, "NeighbourList(capacity=96, skin=0.3)")
        self.drag = None if drag is None else kind("drag", drag, PairDrag, "PairDrag(damping=1.0, radius=1.5)")
        why = "Two particles at one place would have an infinite force."
        self.core = CORE_FRACTION * law.equilibrium_distance if core is None else constant("core", core, why)
        self.molten = None if molten is None else kind("molten", molten, Molten, "Molten(net)")
        self.mass = self.box = None
        self._check()

    @property
    def net(self) -> Topology | None:
        """The topology that tells what is molten, or None."""
        return None if self.molten is None else self.molten.net

    def check(self, scene: Scene) -> None:
        """Refuse a system that it does not fit.

        Raises:
            ValueError: a cut-off, or a radius of the drag, beyond half a period; springs that are not on the net of `molten`.
        """
        box = scene.box
        for name, value in () if box is None else self._within_half().items():
            if is_concrete(value) and is_concrete(box) and np.any(_is_beyond_half(np.asarray(value), np.asarray(box))):
                most = float(np.min(np.asarray(box)[np.asarray(box) > 0])) / 2
                raise ValueError(
                    f"{name} = {value} m is beyond half a period of box = {np.asarray(box)} m: a particle would reach two images of "
                    f"another, of which one acts. Use a larger box, or a {name} of at most {most:.9g} m."
                )
        if self.molten is not None:
            check_springs("Molten", self.molten.net, scene.forces)

    def bind(self, scene: Scene) -> Fluid:
        """The same fluid of these masses, in the box of the net."""
        ready = eqx.tree_at(lambda f: (f.mass, f.box), self, (scene.mass, scene.box), is_leaf=lambda leaf: leaf is None)
        return cast_inexact(ready, scene.dtype)

    def force(self, state: State) -> Vector:
        """Force on each node [N]."""
        return Vector(self._sum(state, PairTerms.force, state.dim, self.drag is not None))

    def energy(self, state: State) -> Array:
        """Sum of the pairs' potentials [J]; below zero, without bound for many particles, where the law attracts at every distance."""
        return jnp.sum(self._sum(state, PairTerms.energy, 1)[0])

    @property
    def can_feed(self) -> bool:
        """Never: the pairs have a potential, and drag takes energy out."""
        return False

    @property
    def is_symmetric(self) -> bool:
        """Whether there is no drag: central forces are symmetric, drag that depends on the distance is not."""
        return self.drag is None

    def stiffness_bound(self, state: State) -> Array:
        """Twice the sum of the pairs' stiffnesses at each node [N/m], where they are now: pairs that come closer are stiffer."""
        return self._sum(state, PairTerms.stiffness, 1)[0]

    def damping_bound(self, state: State) -> Array | None:
        """Twice the sum of the pairs' drag coefficients at each node [N s/m]; None without drag."""
        return None if self.drag is None else self._sum(state, PairTerms.damping, 1)[0]

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """OVERLAP: pairs closer than the core, with the first node of one; NEIGHBOUR_OVERFLOW with the capacity that is needed; BOX where
        a cut-off is beyond half a period.
        """
        count = self._sum(state, PairTerms.overlap, 1)[0]
        pairs = jnp.round(jnp.sum(count) / 2).astype(jnp.int32)
        findings = (Finding(Flag.OVERLAP, pairs, jnp.argmax(jnp.ravel(count) > 0).astype(jnp.int32)),)
        needed = self.pairs.needed(self._list(state))
        nowhere = jnp.asarray(-1, jnp.int32)
        if self.box is not None:
            bad = jnp.any(~(self.box >= 0))
            for value in self._within_half().values():
                bad = bad | jnp.any(_is_beyond_half(value, self.box))
            findings = (*findings, Finding(Flag.BOX, bad.astype(jnp.int32), nowhere))
        return findings if needed is None else (Finding(Flag.NEIGHBOUR_OVERFLOW, needed, nowhere), *findings)

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the equilibrium distance."""
        eps = jnp.asarray(jnp.finfo(state.dtype).eps, state.dtype)
        return state.position.largest() * eps / self.law.equilibrium_distance.astype(state.dtype)

    def begin(self, state: State) -> State:
        """The state with a bit for every spring of `molten`, where springs of other nets break."""
        net = self.net
        return state if net is None or state.alive is None else state.with_alive(net, state.alive_of(net))

    def remember(self, state: State) -> Any:
        """The list that its pairs reuse, or None."""
        return self.pairs.begin(stopped(self._flat(state)), self.cutoff.reach, *self._periods)

    def renew(self, memory: Any, state: State) -> Any:
        """The list where it serves these positions, else a new one."""
        return self.pairs.keep(memory, stopped(self._flat(state)), self.cutoff.reach, *self._periods)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The list brought up to date, and DT_LIMIT where dt is too long for two of the fastest particles that meet head-on."""
        before, still, dt = stopped((step.before, state, step.dt))
        memory, status = self._listed(before, still)
        limit, node = self.collision_dt(still)
        too_long = Status.when(Flag.DT_LIMIT, jnp.abs(dt) > limit, node=node)
        return state if memory is None else self.keep(state, memory), status.then(too_long)

    def _listed(self, before: State, state: State) -> tuple[Any, Status]:
        """The list after a step; left as it is while nothing is fluid."""
        memory = self._list(state)

        def updated() -> tuple[Any, Status]:
            return self.pairs.update(memory, self._flat(before), self._flat(state), self.cutoff.reach, *self._periods)

        if self.molten is None or memory is None:
            return updated()
        return lax.cond(any_lane(jnp.any(self.molten.is_fluid(state))), updated, lambda: (memory, Status.ok()))

    def _list(self, state: State) -> Any:
        """The list that the state remembers, or None."""
        entry = entry_at(state.memory, self.place)
        return None if entry is None else entry.value

    def collision_dt(self, state: State) -> tuple[Array, Array]:
        """Largest dt [s] at which every particle could meet one as fast head-on, and the flat index of the particle that sets it.

        Two particles of mass m and speed v turn where the repulsion has taken up m v**2; the pair's frequency there must stay below 2 / dt.
        """
        mass = self._mass(state)
        speed = state.velocity.dot(state.velocity)
        charge = mass * mass if self.law.uses_mass else jnp.ones_like(mass)
        squared = 2 * charge * self.law.turning_stiffness(mass * speed / charge, self.core) / mass
        if self.molten is not None:
            squared = jnp.where(self.molten.is_fluid(state), squared, jnp.zeros((), squared.dtype))
        node = jnp.argmax(jnp.ravel(squared)).astype(jnp.int32)
        return 2 * lax.rsqrt(jnp.max(squared)), node

    def invalid(self) -> Array:
        """Whether a constant of law, cut-off, list, drag or core is one that its constructor refuses, or does not fit within the reach."""
        bad = any_not_positive(self.core)
        for by_part in (part.invalid() for part in (self.law, self.cutoff, self.pairs, self.drag) if part is not None):
            bad = bad if by_part is None else bad | by_part
        reach = self.cutoff.reach
        if reach is not None:
            for distance in self._within_reach().values():
                bad = bad | _is_beyond(distance, reach)
        return bad

    def _within_reach(self) -> dict[str, Array]:
        """Distances [m] that must not be beyond the cut-off."""
        inner = {"core": self.core, "the equilibrium distance": self.law.equilibrium_distance}
        if self.drag is not None and self.pairs.needs_reach:
            inner["drag.radius"] = self.drag.radius
        return inner

    @property
    def _periods(self) -> tuple[Array, ...]:
        """What `Pairs` get besides positions and reach: nothing in a space without periods."""
        return () if self.box is None else (self.box,)

    def _within_half(self) -> dict[str, Array]:
        """Distances [m] that must not be beyond half a period."""
        outer = {} if self.cutoff.reach is None else {"cut-off": self.cutoff.reach}
        return outer if self.drag is None else {**outer, "drag.radius": self.drag.radius}

    def _check(self) -> None:
        reach = self.cutoff.reach
        if reach is None:
            if self.pairs.needs_reach:
                raise ValueError(
                    "a neighbour list needs a law that ends. Pass cutoff=PlainCutoff(r), ShiftedForce(r) or Switched(on, off)."
                )
            return
        for name, value in self._within_reach().items():
            if is_concrete(value) and is_concrete(reach) and _is_beyond(np.asarray(value), np.asarray(reach)):
                raise ValueError(f"{name} = {value} m is beyond the cut-off, {reach} m. Unchecked, pairs between the two would be dropped.")

    def _sum(self, state: State, term: Callable[..., Fields], n: int, with_velocity: bool = False) -> Fields:
        """Sum of a pair term at each node, `n` arrays in node shape; zeros while nothing is fluid."""
        check_dim(self.box, state.dim)
        shape = state.position.shape
        fluid = None if self.molten is None else self.molten.is_fluid(state)
        particles = Particles(
            position=self._flat(state),
            charge=jnp.ravel(self._mass(state)) if self.law.uses_mass else None,
            fluid=None if fluid is None else jnp.ravel(fluid).astype(state.dtype),
            velocity=tuple(jnp.ravel(a) for a in state.velocity) if with_velocity else (),
        )
        memory = self.pairs.ready(self._list(state), stopped(particles.position), self.cutoff.reach, *self._periods)

        def summed(operands: tuple[Particles, PairTerms, Any]) -> Fields:
            particles, terms, memory = operands
            return self.pairs.sum(term, terms, particles.fields(), memory, sign=-1 if term is PairTerms.force else 1)

        def nothing(operands: tuple[Particles, PairTerms, Any]) -> Fields:
            return (jnp.zeros(particles.position[0].shape, state.dtype),) * n

        terms = PairTerms(self.law, self.cutoff, self.core, self.drag, particles.arrangement, self.box)
        operands = (particles, terms, memory)
        flat = summed(operands) if fluid is None else lax.cond(any_lane(jnp.any(fluid)), summed, nothing, operands)
        return tuple(a.reshape(shape) for a in flat)

    def _flat(self, state: State) -> Fields:
        return tuple(jnp.ravel(a) for a in state.position)

    def _mass(self, state: State) -> Array:
        if self.mass is None:
            raise ValueError("Fluid has no masses yet. Put it in a System and ask that, or the forces of system.bind(state.dtype).")
        return jnp.broadcast_to(self.mass.astype(state.dtype), state.position.shape)


def _is_beyond(distance: Any, reach: Any) -> Any:
    """Whether a distance is beyond the reach; a cut-off at the distance itself is not, whatever its rounding."""
    coarser = max(float(jnp.finfo(value.dtype).eps) for value in (distance, reach))
    return distance > reach.astype(distance.dtype) * (1 + 8 * coarser)


def _is_beyond_half(distance: Any, box: Any) -> Any:
    """(D,) whether a distance is beyond half of each period."""
    return (box > 0) & _is_beyond(distance, box / 2)
