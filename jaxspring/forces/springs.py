"""Springs: the internal force g_i = sum over neighbours of s_ij.

    s_ij = k_ij (|r_ij| - l_ij) r_ij / |r_ij|      force on i from the spring to j [N],  r_ij = x_j - x_i

Source: slide "Force Computation" (length |r|, deformation e = |r| - l).
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array

from .._arrays import whole_number
from .._checks import finite, is_concrete, kind, nonnegative, positive
from ..linalg.operators import Blocks, SpringBlocks
from ..numerics import cast_inexact, tiny
from ..state import State
from ..status import Status
from ..topology.base import Topology
from ..topology.edge_field import EdgeField, SpringNumbers, ZeroOutside, named_entries
from ..topology.periods import box_of
from ..vector import Vector
from .actuation import Actuation
from .base import Finding, Force, Scene, Step, any_refused
from .history import has_yielded, lengthened, weakened
from .in_box import along_axes, check_rest_length, long_springs, turned_springs
from .laws import Hooke, Law, PowerLaw, TensionOnly, length_of, spring_block, spring_energy, spring_pull
from .lengths import are_apart, too_short_or_long
from .linearisation import Linearisation
from .living import counted, existing, heeding, living, map_living, vanishing


class StiffnessRule(eqx.Module):
    """A stiffness that follows the state (an image under the node, a temperature). Abstract."""

    @abc.abstractmethod
    def stiffness(self, net: Topology, state: State) -> Array | EdgeField:
        """Stiffness of each spring [N/m] in this state."""

    @abc.abstractmethod
    def upper_bound(self) -> Array:
        """The largest stiffness the rule can give [N/m], for `stable_dt`."""

    @property
    def follows_position(self) -> bool:
        """Whether the stiffness depends on where the nodes are; the springs then have no potential."""
        return True

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse."""
        return None

    def bind(self, net: Topology, dtype: DTypeLike) -> StiffnessRule:
        """The rule as the loop wants it: constants cast, tables made. Called once, before the loop."""
        return cast_inexact(self, dtype)


class ExpansionRule(eqx.Module):
    """By what factor rest lengths have grown in a state; the positions have no part in it. Abstract."""

    @abc.abstractmethod
    def factor(self, net: Topology, state: State) -> EdgeField:
        """Present rest length over that of the reference, per spring."""

    def invalid(self) -> Array | None:
        """Whether a constant has a value that the constructor would refuse."""
        return None


class Springs(Force):
    """Springs along every edge of a network.

    Attributes:
        net: the topology.
        stiffness: k [N/m]: a number, (E,) in the user's order, an `EdgeField`, or a `StiffnessRule`; on a lattice also numbers by family,
            `{js.STRUCTURAL: 100.0, js.SHEAR: 20.0}`.
        rest_length: l [m]: as the stiffness.
        law: the law of one spring; `Hooke()` unless said.
        axes: the coordinates the springs act in (None: all). `axes=(0, 1)` makes springs of the projection on the plane.
        allow_negative_stiffness: accept stiffnesses below zero, which push without bound.
        expansion: an `ExpansionRule` that multiplies the rest lengths, or None.
        actuation: an `Actuation` that multiplies them by commands, which hold for a step, or None.

    A state whose `alive` or `rest_length` is of this net's springs is heeded: a broken spring does nothing, whatever its constants are, and
    rest lengths that have changed take the place of the given ones.

    Raises:
        ValueError: a negative or non-finite constant (named with its index), a shape that fits neither one number nor one per spring, a
            rest length that no image of the net's box can have.
    """

    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    drives: ClassVar[bool] = True
    net: Topology
    stiffness: Any
    rest_length: Any
    law: Law
    axes: tuple[int, ...] | None = eqx.field(static=True)
    allow_negative_stiffness: bool = eqx.field(static=True)
    expansion: ExpansionRule | None
    actuation: Actuation | None

    def __init__(
        self,
        net: Topology,
        stiffness: SpringNumbers | StiffnessRule,
        rest_length: SpringNumbers = 0.0,
        law: Law | None = None,
        axes: tuple[int, ...] | None = None,
        allow_negative_stiffness: bool = False,
        expansion: ExpansionRule | None = None,
        actuation: Actuation | None = None,
    ):
        self.net = net
        self.stiffness = stiffness if isinstance(stiffness, StiffnessRule) else _edge_constant(net, "stiffness", stiffness)
        self.rest_length = _edge_constant(net, "rest_length", rest_length)
        self.law = Hooke() if law is None else law
        self.axes = None if axes is None else tuple(whole_number("axes", a) for a in axes)
        if self.axes is not None and not (self.axes and set(self.axes) <= {0, 1, 2} and len(set(self.axes)) == len(self.axes)):
            raise ValueError(f"axes = {self.axes}; expected different coordinates out of 0 (x), 1 (y), 2 (z), e.g. (0, 1).")
        self.allow_negative_stiffness = allow_negative_stiffness
        self.expansion = expansion
        self.actuation = actuation
        if actuation is not None:
            kind("actuation", actuation, Actuation, "Actuation(controller)").check(net)
        if not isinstance(stiffness, StiffnessRule):
            why = "A negative stiffness pushes without bound. Pass allow_negative_stiffness=True if meant."
            _check_sign("stiffness", self.stiffness, why, any_sign=allow_negative_stiffness)
        _check_sign("rest_length", self.rest_length, "A length cannot be negative.")
        if self.axes is None:
            check_rest_length(net, self.rest_length)
        if isinstance(self.law, PowerLaw):
            for entry in self.rest_length.families if isinstance(self.rest_length, EdgeField) else (self.rest_length,):
                positive("rest_length", entry, "The power law divides by it.")

    def bind(self, scene: Scene) -> Springs:
        """Constants as edge fields."""
        rule = self.stiffness
        stiffness = rule.bind(self.net, scene.dtype) if isinstance(rule, StiffnessRule) else self.net.edge_field(rule, "stiffness")
        if not isinstance(stiffness, StiffnessRule):
            stiffness = vanishing(self.net, cast_inexact(stiffness, scene.dtype))
        rest_length = cast_inexact(self.net.edge_field(self.rest_length, "rest_length"), scene.dtype)
        rest_length = self.net.at_ends(rest_length) if isinstance(rest_length, EdgeField) else rest_length
        bound = (stiffness, rest_length, None if self.actuation is None else self.actuation.bind(self.net, scene.dtype))
        made = eqx.tree_at(lambda s: (s.stiffness, s.rest_length, s.actuation), self, bound, is_leaf=lambda leaf: leaf is None)
        return cast_inexact(made, scene.dtype)

    @property
    def is_idle(self) -> bool:
        """Whether nobody drives them."""
        return self.actuation is None

    def remember(self, state: State) -> Array | None:
        """The command in force, as its controller gives it; None where nobody drives them."""
        return None if self.actuation is None else self.actuation.command(self.net, state)

    def renew(self, memory: Any, state: State) -> Any:
        """The command of the controller that drives them now."""
        return self.remember(state)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state with the command of the next step."""
        return (state if self.actuation is None else self.keep(state, self.remember(state))), Status.ok()

    def force(self, state: State) -> Vector:
        """Sum of the pulls at each node [N]."""
        if self.net.n_springs == 0:
            return Vector.zeros_like(state.position)
        k, l = self._constants(state)
        k = vanishing(self.net, k) if not self.net.has_margins and self.law.needs_no_mask else k
        vanishes = isinstance(k, ZeroOutside) and self.law.needs_no_mask
        if self.net.has_margins and not vanishes:
            return self._embed(self.net.accumulate(self._each(state, _Pull(self.law))), state)
        pull, fields = heeding(self.net, state, _Pull(self.law), k, l)
        if not vanishes:
            pull, fields = existing(self.net, pull, *fields)
        return self._embed(self._near().net_pull(pull, self._seen(state), *fields), state)

    def energy(self, state: State) -> Array | None:
        """Sum of the springs' energies [J]; None where the law has none."""
        if self.net.n_springs == 0:
            return jnp.zeros((), state.dtype)
        if not self.has_potential:
            return None
        return self.net.sum(self._each(state, partial(spring_energy, self.law)))

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks | None:
        """One block per spring [N/m]; a stiffness that follows the state is taken as constant."""
        if self.net.n_springs == 0:
            return None
        blocks = self._each(state, partial(spring_block, self.law, linearisation))
        weight, slope, direction = (self.net.own(column) for column in zip(*blocks.families, strict=True))
        if slope.families[0] is None:
            return Blocks(springs=(SpringBlocks(self.net, weight, None, None, self.axes),))
        return Blocks(springs=(SpringBlocks(self.net, weight, slope, direction, self.axes),))

    @property
    def has_potential(self) -> bool:
        """Whether the law has an energy, and the stiffness does not follow the position."""
        return not self._follows_position and (self.net.n_springs == 0 or self.law.has_energy)

    @property
    def is_symmetric(self) -> bool:
        """Whether the stiffness does not follow the position: central forces are symmetric then."""
        return not self._follows_position

    @property
    def can_feed(self) -> bool:
        """Whether stiffness or rest length follow the state, or the law has no potential."""
        is_driven = self.expansion is not None or self.actuation is not None
        return isinstance(self.stiffness, StiffnessRule) or is_driven or not self.has_potential

    def tension(self, state: State) -> EdgeField:
        """Pull of each spring along itself [N]: positive stretched, negative squeezed, zero broken. `net.flatten` gives (E,)."""

        def of_family(d: Vector, k: Array, l: Array) -> Array:
            squared = d.dot(d)
            return self.law.weight(squared, k, l) * length_of(squared)

        return self._each(state, of_family)

    def strain(self, state: State) -> EdgeField:
        """Stretch over rest length, (r - l) / l; infinite where l = 0, zero where broken."""
        return self._each(state, lambda d, _, l: d.norm() / l - 1)

    def stiffness_bound(self, state: State) -> Array | None:
        """Gershgorin: twice the sum of the stiffnesses at each node [N/m]. A broken spring counts with k: it may come back."""
        if self.net.n_springs == 0:
            return None
        k = self.stiffness.upper_bound() if isinstance(self.stiffness, StiffnessRule) else self.net.edge_field(self.stiffness)
        k = self._steepest(state, cast_inexact(k, state.dtype))
        return 2 * self.net.incident_sum(k)

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """COINCIDENT: springs whose ends are at one place, or so near that the square of their distance underflows, where they have a rest
        length; under a law of one's own also without, unless they are at one place exactly. NONFINITE: springs so long that it overflows.
        BOX: springs of half a period.
        """
        if self.net.n_springs == 0:
            return ()
        in_box = long_springs(self._near(), self._seen(state), living(self.net, state))
        is_linear = isinstance(self.law, Hooke | TensionOnly)
        given = state.rest_length is None and not has_yielded(self.net, state) and is_concrete(self.rest_length) and is_linear
        if given and not np.any(np.asarray(self.rest_length) > 0):
            # A pull k d takes no square.
            return in_box

        d = self._near().difference(self._seen(state))
        needs = (lambda _, l: l > 0) if is_linear else (lambda d, l: (l > 0) | are_apart(d))
        return (*in_box, *too_short_or_long(self.net, state, needs, d, self.natural_length(state)))

    def diagnose_since(self, start: State, state: State) -> tuple[Finding, ...]:
        """BOX: springs that pull to another image than at the start."""
        if self.net.n_springs == 0:
            return ()
        return turned_springs(self._near(), self._seen(start), self._seen(state), living(self.net, state))

    def invalid(self) -> Array | None:
        """Whether a constant is negative or not finite."""
        rule = self.stiffness
        bad = any_refused(self.rest_length, *(() if isinstance(rule, StiffnessRule) or self.allow_negative_stiffness else (rule,)))
        if box_of(self.net) is not None:
            bad = bad | any_refused(box_of(self.net))
        by_rule = rule.invalid() if isinstance(rule, StiffnessRule) else None
        bad = bad if by_rule is None else bad | by_rule
        for driver in (self.expansion, self.actuation):
            by_driver = None if driver is None else driver.invalid()
            bad = bad if by_driver is None else bad | by_driver
        return bad

    def rounding(self, state: State) -> Array | None:
        """The largest coordinate's rounding over the smallest rest or present length. Springs without rest length pull by k d, whose
        error is the same for short and long: they are measured by the longest of them.
        """
        if self.net.n_springs == 0:
            return None
        d, _, l = self._along(state)
        if living(self.net, state) is not None:  # broken springs have length and rest length zero, which count for nothing
            d, l = (map_living(self.net, state, lambda a: a, field) for field in (d, l))
        # Flat, so that one norm and two reductions serve all families.
        length = Vector(tuple(self.net.joined(d.map(lambda of_family, i=i: of_family[i])) for i in range(d[0].dim))).norm()
        rest = self.net.joined(l) if isinstance(l, EdgeField) else jnp.broadcast_to(l, length.shape)
        never = jnp.full_like(length, jnp.inf)
        finest = jnp.min(jnp.where(rest > 0, jnp.minimum(jnp.where(length > 0, length, never), rest), never))
        longest = jnp.max(jnp.where(rest > 0, jnp.zeros_like(length), length))
        length = jnp.where(longest > 0, jnp.minimum(finest, longest), finest)
        return self._seen(state).largest() * jnp.asarray(jnp.finfo(state.dtype).eps, state.dtype) / length

    def natural_length(self, state: State) -> Array | EdgeField:
        """Rest length of each spring in this state [m]: what it would be without yielding, plus the stretch that it has yielded by."""
        return lengthened(self.net, state, self.unyielded_length(state))

    def unyielded_length(self, state: State) -> Array | EdgeField:
        """Rest length without yielding [m]: the state's own where it has one, else the given one, times `growth`."""
        changed = state.rest_length_of(self.net)
        l: Any = changed if changed is not None else cast_inexact(self.net.edge_field(self.rest_length, "rest_length"), state.dtype)
        growth = self.growth(state)
        return l if growth is None else map_living(self.net, state, lambda l, factor: l * factor, l, growth)

    def growth(self, state: State) -> Array | EdgeField | None:
        """Expansion times actuation of each spring in this state; None where there is neither."""
        factor: Any = None
        if self.expansion is not None:
            factor = self.net.edge_field(cast_inexact(self.expansion, state.dtype).factor(self.net, state), "factor")
        if self.actuation is None:
            return factor
        command = self.actuation.factor(self.net, self.recall(state))
        return command if factor is None else map_living(self.net, state, lambda a, b: a * b, factor, command)

    def present_stiffness(self, state: State) -> Array | EdgeField:
        """Stiffness of each spring in this state [N/m]: the given one, or that of its rule, less what tearing has taken of it."""
        rule = self.stiffness
        k = self.net.edge_field(rule.stiffness(self.net, state) if isinstance(rule, StiffnessRule) else rule, "stiffness")
        return weakened(self.net, state, cast_inexact(k, state.dtype))

    def differences(self, state: State) -> EdgeField:
        """Head minus tail of each spring [m], in the coordinates that they act in."""
        return self._near().difference(self._seen(state))

    @property
    def _follows_position(self) -> bool:
        return isinstance(self.stiffness, StiffnessRule) and self.stiffness.follows_position

    def _seen(self, state: State) -> Vector:
        if self.axes is not None and max(self.axes) >= state.dim:
            raise ValueError(f"axes = {self.axes}, but the positions have {state.dim} coordinates.")
        return state.position if self.axes is None else Vector(tuple(state.position[a] for a in self.axes))

    def _near(self) -> Topology:
        """The net with the periods of the coordinates that the springs act in."""
        return along_axes(self.net, self.axes)

    def _constants(self, state: State) -> tuple[Array | EdgeField, Array | EdgeField]:
        return self.present_stiffness(state), cast_inexact(self.natural_length(state), state.dtype)

    def _each(self, state: State, function: Callable[..., Any]) -> EdgeField:
        """`function(d, k, l)` of every spring; zero of a broken one."""
        return map_living(self.net, state, function, *self._along(state))

    def _along(self, state: State) -> tuple[EdgeField, Array | EdgeField, Array | EdgeField]:
        k, l = self._constants(state)
        d = self.differences(state)
        return d if self.law.needs_no_mask else self._filled(d), k, l

    def _filled(self, d: EdgeField) -> EdgeField:
        """Length above zero in a lattice's margins: there a user's law would be taken at length zero, and its NaN reach the gradient."""
        columns = [self.net.inside(d.map(lambda v, i=i: v[i]), 1.0).families for i in range(len(d[0]))]
        return self.net.own(Vector(parts) for parts in zip(*columns, strict=True))

    def _embed(self, force: Vector, state: State) -> Vector:
        if self.axes is None:
            return force
        zero = jnp.zeros_like(state.position[0])
        return Vector(tuple(force[self.axes.index(i)] if i in self.axes else zero for i in range(state.dim)))

    def _steepest(self, state: State, k: Array | EdgeField) -> EdgeField:
        """Largest positive eigenvalue of each spring's block [N/m]."""
        d, _, l = self._along(state)

        def of_family(d: Vector, k: Array, l: Array) -> Array:
            squared = d.dot(d)
            weight = self.law.weight(squared, k, l)
            radial = weight + self.law.slope(squared, k, l)
            is_long = squared > tiny(squared.dtype)
            return jnp.where(is_long, jnp.maximum(jnp.maximum(weight, radial), jnp.zeros((), squared.dtype)), k)

        steepest = map_living(self.net, state, of_family, d, k, l)
        alive = living(self.net, state)
        return steepest if alive is None else self.net.map_springs(counted, steepest, k, alive)


class _Pull(eqx.Module):
    """The pulls of a law."""

    law: Law

    def __call__(self, d: Vector, stiffness: Array, rest_length: Array) -> Vector:
        return spring_pull(self.law, d, stiffness, rest_length)


def _edge_constant(net: Topology, name: str, value: Any) -> Any:
    """`value` as the user passed it (so that its gradient comes back in that form), as inexact arrays of a shape that fits."""
    return net.edge_constant(value, name)


def _check_sign(name: str, value: Any, why: str, any_sign: bool = False) -> None:
    for place, entry in named_entries(name, value):
        if any_sign:
            finite(place, entry)
        else:
            nonnegative(place, entry, why)
