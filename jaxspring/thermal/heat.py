"""Heat as a rule: after each step of the nodes, heat flows for the same time.

    C_i dtheta_i/dt = sum_j G_ij (theta_j - theta_i) + q_i + sum of boundaries P_i        [W]

along the springs of a net, in material coordinates: conductances do not change as the body deforms. A boundary nobody names is insulated.

Source: slides "Heating and Melting", "Heat Equation (Discretised)".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, finite, nonnegative, positive
from ..forces.base import Rule, Scene, Step, any_refused
from ..linalg.operators import SpringBlocks
from ..numerics import cast_inexact, stopped
from ..state import State
from ..status import Flag, Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, field_of, fields_of
from ..topology.lattice import Lattice
from .boundaries import ThermalBoundary
from .flow import Flow
from .latent import LatentHeat
from .schemes import ExplicitHeat, HeatScheme


class Heat(Rule):
    """Conduction of heat, with sources and boundaries. Belongs to a system's `rules`; the state needs a temperature.

    Attributes:
        net: along whose springs heat flows; its nodes are the system's, its springs may be others.
        capacity: C [J/K], a number, or (N,) in the user's order; once bound, a node array.
        conductance: G [W/K], a number, (E,) in the user's order, or an `EdgeField`.
        scheme: how it is advanced.
        boundaries: what enters from outside.
        source: heat made in each node [W]: a number, (N,) in the user's order, or a function of time [s] that gives one; None is none.
        latent: melting, or None.
        cut_by: the net whose broken springs (`state.alive`) conduct nothing; None where breaking does not cut.
        substeps: heat steps in one step of the nodes (static).
        every: steps of the nodes in one heat step (static).

    Raises:
        ValueError: a capacity that is not positive, a conductance that is negative or infinite, a shape that does not fit, a net that
            the scheme cannot serve, or whose springs are not those of `cut_by`.
        TypeError: a scheme or boundary of another kind.

    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> heat = Heat(net, capacity=1.0, conductance=0.5)
    >>> system = js.System(net, mass=1.0, rules=heat)
    >>> start = js.State.from_points(net, net.grid(), temperature=np.array([300.0, 300.0, 400.0]))
    >>> print(js.rollout(system, start, js.Still(), dt=0.5, n_steps=1).state.temperatures)
    [300. 325. 375.]
    """

    sets_temperature: ClassVar[bool] = True
    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    net: Topology
    capacity: Array
    conductance: Any
    scheme: HeatScheme
    boundaries: tuple[ThermalBoundary, ...]
    source: Any
    latent: LatentHeat | None
    cut_by: Topology | None
    substeps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    families: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        net: Topology,
        capacity: Numbers,
        conductance: SpringNumbers,
        scheme: HeatScheme | None = None,
        boundaries: ThermalBoundary | Sequence[ThermalBoundary] = (),
        source: Numbers | Callable[[Array], Numbers] | None = None,
        substeps: int = 1,
        every: int = 1,
        latent: LatentHeat | None = None,
        cut_by: Topology | None = None,
    ):
        """Check what is given, and bring it to the shape of the net.

        Args:
            net: the topology along which heat flows.
            capacity: [J/K]: a number, or (N,) in the user's order; see `capacities`.
            conductance: [W/K]: a number, (E,) in the user's order, an edge field (`conductances`), or numbers by family (`Springs`).
            scheme: `ExplicitHeat()` unless said.
            boundaries: one or several; where none is named the body is insulated.
            source: [W]: a number, (N,) in the user's order, or a function of time [s] that gives a number or a node array.
            substeps: heat steps in one step of the nodes, of dt / substeps each.
            every: steps of the nodes in one heat step, of every * dt, which falls on the multiples of that on the time axis. In between
                the temperature stands still.
            latent: melting; its values are numbers, or (N,) in the user's order.
            cut_by: the system's net, where broken springs are to conduct nothing. On a lattice it must have every family of `net`.
        """
        self.net = net
        capacity = as_inexact("capacity", capacity)
        positive("capacity", capacity, "A node without capacity would get an infinite temperature.")
        net.node_field(capacity, "capacity")  # refuses a wrong shape
        self.capacity = capacity
        self.conductance = _conductance(net, conductance)
        self.scheme = _kind("scheme", ExplicitHeat() if scheme is None else scheme, HeatScheme)
        self.scheme.check(net)
        given = tuple(boundaries) if isinstance(boundaries, Iterable) else (boundaries,)
        self.boundaries = tuple(_kind(f"boundaries[{i}]", b, ThermalBoundary) for i, b in enumerate(given))
        self.source = source if source is None or callable(source) else _source(source)
        self.latent = None if latent is None else _kind("latent", latent, LatentHeat)
        self._on_net()  # refuses what does not fit
        for name, count in (("substeps", substeps), ("every", every)):
            if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
                raise ValueError(f"{name} = {count!r}; expected a whole number, 1 or more.")
        self.substeps, self.every = int(substeps), int(every)
        self.cut_by = cut_by
        self.families = None if cut_by is None else _shared_families(net, cut_by)

    def begin(self, state: State) -> State:
        """The state with given temperatures in their place and, with latent heat, an enthalpy.

        Raises ValueError for a state without temperature, or with an enthalpy that this heat does not know.
        """
        if state.temperature is None:
            raise ValueError("Heat needs a temperature, but the state has none. Pass temperature=... to State.from_points.")
        if self.latent is None and state.enthalpy is not None:
            raise ValueError(
                "the state holds latent heat (enthalpy), but this Heat knows no melting, so that it would never come back. Pass "
                "latent=LatentHeat(...), or a state with enthalpy=None."
            )
        ready = self.ready(state.dtype)
        flow = ready.flow(state, cuts=False)
        return _left(flow, flow.hold(flow.entered(state.temperature, state.enthalpy)), state)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """Heat for a time dt, with the nodes where motion left them."""
        before, dt = step.before, step.dt
        refused = Status.when(Flag.INVALID, dt < 0)
        flow = self.flow(state, cuts=self.cut_by is not None)
        y = flow.entered(_temperature(state), state.enthalpy)
        if self.every == 1:
            y, status = self._advanced(flow, y, dt)
        else:
            is_due = self._count(state.time, dt) > self._count(before.time, dt)
            y, status = lax.cond(is_due, lambda y: self._advanced(flow, y, self.every * dt), lambda y: (y, Status.ok()), y)
        return _left(flow, y, state), refused.then(status).then(self._too_long(before, state, dt))

    def _count(self, time: Array, dt: Array) -> Array:
        """Heat steps that were due up to a time: they fall on the multiples of every * dt.

        A step of the nodes takes the difference between its two ends, so that none is lost or taken twice by rounding. The quarter keeps
        rounding of times that are multiples of dt from moving a heat step to the next step of the nodes.
        """
        return jnp.floor((time / jnp.where(dt == 0, jnp.ones_like(dt), dt) + 0.25) / self.every)

    def _advanced(self, flow: Flow, y: Array, span: Array) -> tuple[Array, Status]:
        """Heat for a time `span` [s] that ends at the flow's."""
        if self.substeps == 1:
            return self.scheme.advance(flow.at(flow.state.time - span), y, span)
        dt, start = span / self.substeps, flow.state.time - span

        def substep(carry: tuple[Array, Status], i: Array) -> tuple[tuple[Array, Status], None]:
            y, status = carry
            y, seen = self.scheme.advance(flow.at(start + i * dt), y, dt)
            return (y, status.then(seen)), None

        return lax.scan(substep, (y, Status.ok()), jnp.arange(self.substeps, dtype=dt.dtype))[0]

    def _too_long(self, before: State, state: State, dt: Array) -> Status:
        """DT_LIMIT where a node has become so hot that `dt` is too long for it; elsewhere the limit is that at the start of the run."""
        if all(boundary.is_linear for boundary in self.boundaries):
            return Status.ok()
        ready, state, dt = stopped((self, dataclasses.replace(state, temperature=before.temperature), dt))
        rate = ready._rate(state)
        limit = ready._limit(rate)
        if limit is None:
            return Status.ok()
        # The slack of the check at the start.
        slack = jnp.asarray(1 + 8 * float(jnp.finfo(limit.dtype).eps), limit.dtype)
        return Status.when(Flag.DT_LIMIT, jnp.abs(dt) > limit * slack, node=jnp.argmax(jnp.ravel(rate)).astype(jnp.int32))

    def limit(self, state: State) -> Array | None:
        """Largest dt [s] of the nodes' steps at which an explicit scheme is stable and makes no new extreme; None for the others."""
        ready = self.ready(state.dtype)
        return ready._limit(ready._rate(state))

    def _limit(self, rate: Array) -> Array | None:
        limit = self.scheme.limit(jnp.max(rate))
        return None if limit is None else limit * self.substeps / self.every

    def _rate(self, state: State) -> Array:
        """Share of its heat that each free node gives away per time, at most [1/s]; of a bound rule."""
        out = self.net.incident_sum(self.conductance).astype(state.dtype)
        for boundary in self.boundaries:
            slope = boundary.slope_bound(state, _temperature(state))
            out = out if slope is None else out + slope
        rate = out / self.capacity
        held = self.flow(state, cuts=False).held()
        return rate if held is None else jnp.where(held, jnp.zeros_like(rate), rate)

    def power(self, state: State) -> Array:
        """Heat per time into each node [W], in node shape: conduction, sources and boundaries."""
        return self.ready(state.dtype).flow(state, cuts=self.cut_by is not None).power(_temperature(state))

    def supplied(self, state: State) -> Array:
        """Heat per time into each node from outside [W], in node shape: sources and boundaries but fixed temperatures."""
        return self.ready(state.dtype).flow(state, cuts=False).supplied(_temperature(state))

    def flow(self, state: State, cuts: bool) -> Flow:
        """What heats the nodes in this state; broken springs conduct nothing where `cuts`."""
        conductance = self._alive(state) if cuts else self.conductance
        return Flow(self.capacity, (SpringBlocks(self.net, conductance),), self.boundaries, self.source, self.latent, state)

    def _alive(self, state: State) -> EdgeField:
        if state.alive is None or self.families is None or self.cut_by is None:
            raise ValueError(
                "cut_by says that broken springs conduct nothing, but no spring of this state can break (its `alive` is None). Add the "
                "rule that breaks springs, or pass cut_by=None."
            )
        cuts = field_of(self.cut_by, state.alive)
        if cuts is None:
            other = fields_of(state.alive)[0]
            raise ValueError(
                f"state.alive tells about other springs than those of cut_by ({self.cut_by.identity}): they are of "
                f"{other.identity or 'no known net'}, in families of shapes {tuple(entry.shape for entry in other.families)}."
            )
        alive = EdgeField(tuple(cuts.families[i] for i in self.families))
        # `where`, since zero times a conductance that is not finite is not zero.
        return self.conductance.map(lambda g, is_whole: jnp.where(is_whole, g, jnp.zeros_like(g)), alive)

    def bind(self, scene: Scene) -> Heat:
        """Capacity in node shape, conductance as an edge field."""
        return self.ready(scene.dtype)

    def ready(self, dtype: DTypeLike) -> Heat:
        """The same, without a system: what `power`, `supplied` and `total_heat` read."""
        if self.place is not None:
            return self
        capacity = jnp.broadcast_to(self.net.node_field(self.capacity, "capacity"), self.net.node_shape)
        conductance = self.net.edge_field(self.conductance, "conductance")
        if not isinstance(conductance, EdgeField):
            conductance = self.net.own(jnp.broadcast_to(conductance, shape) for shape in self.net.family_shapes)
        made = (capacity, self.net.inside(conductance, 0), *self._on_net())
        places = eqx.tree_at(
            lambda h: (h.capacity, h.conductance, h.boundaries, h.latent, h.source), self, made, is_leaf=lambda a: a is None
        )
        return cast_inexact(places, dtype)

    def _on_net(self) -> tuple[tuple[ThermalBoundary, ...], LatentHeat | None, Any]:
        """Boundaries, latent heat and source with their values as node arrays.

        Raises:
            ValueError: values or nodes of another net.
        """
        boundaries = tuple(b.on(self.net, f"boundaries[{i}]") for i, b in enumerate(self.boundaries))
        source = self.source if self.source is None or callable(self.source) else self.net.node_field(self.source, "source")
        return boundaries, None if self.latent is None else self.latent.on(self.net), source

    def invalid(self) -> Array:
        """Whether a constant has a value that the constructor would refuse."""
        bad = any_refused(self.capacity, self.conductance) | ~jnp.all(self.capacity > 0)
        for part in (*self.boundaries, *(() if self.latent is None else (self.latent,))):
            by_part = part.invalid()
            bad = bad if by_part is None else bad | by_part
        return bad


def total_heat(heat: Heat, state: State) -> Array:
    """Heat of the body [J], counted from 0 K and solid: the sum of C theta, and of the latent heat taken up.

    What is insulated and has no source keeps it to rounding.

    Args:
        heat: the rule.
        state: with a temperature, and an enthalpy where heat has latent heat (a state that went through `system.begin` or `rollout`).

    Returns:
        The heat [J], 0-d.

    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> state = js.State.from_points(net, net.grid(), temperature=300.0)
    >>> print(total_heat(Heat(net, 2.0, 1.0), state))
    1800.0
    """
    ready = heat.ready(state.dtype)
    temperature = _temperature(state)
    total = jnp.sum(ready.capacity * temperature)
    if ready.latent is None:
        return total
    return total + jnp.sum(ready.latent.taken_up(temperature) if state.enthalpy is None else state.enthalpy)


def _left(flow: Flow, y: Array, state: State) -> State:
    enthalpy = state.enthalpy if flow.latent is None else flow.latent.enthalpy(y, flow.capacity)
    return dataclasses.replace(state, temperature=flow.temperature(y), enthalpy=enthalpy)


def _temperature(state: State) -> Array:
    if state.temperature is None:
        raise ValueError("this state has no temperature. Pass temperature=... to State.from_points.")
    return state.temperature


def _conductance(net: Topology, value: Any) -> Any:
    """The conductance as the user passed it, so that its gradient comes back in that form."""
    why = "Heat would flow from cold to hot."
    value = net.edge_constant(value, "conductance")
    if isinstance(value, EdgeField):
        for i, entry in enumerate(value.families):
            nonnegative(f"conductance.families[{i}]", entry, why)
        return value
    nonnegative("conductance", value, why)
    return value


def _source(value: Any) -> Array:
    value = as_inexact("source", value)
    finite("source", value)
    return value


def _kind(name: str, value: Any, kind: type) -> Any:
    if isinstance(value, type) and issubclass(value, kind):
        raise TypeError(f"{name} is the class {value.__name__} itself; expected an object of it: write {value.__name__}(...).")
    if not isinstance(value, kind):
        raise TypeError(f"{name} is a {type(value).__name__}; expected a {kind.__name__}.")
    return value


def _shared_families(net: Topology, cut_by: Topology) -> tuple[int, ...]:
    """For each family of `net`, which family of `cut_by` has the same springs."""
    if isinstance(net, Lattice) and isinstance(cut_by, Lattice):
        if (net.shape, net.periodic) == (cut_by.shape, cut_by.periodic) and set(net.offsets) <= set(cut_by.offsets):
            return tuple(cut_by.offsets.index(offset) for offset in net.offsets)
        raise ValueError(
            f"cut_by has the springs {cut_by.offsets} on shape {cut_by.shape}, net {net.offsets} on {net.shape}: heat can only be cut "
            f"where every spring of net is one of cut_by. Build both on one shape."
        )
    if not net.identity.has_springs_of(cut_by.identity):
        raise ValueError("cut_by must hold the springs of net, in the same order. Pass the system's net for both.")
    return tuple(range(len(net.family_shapes)))


__all__ = ["Heat", "total_heat"]
