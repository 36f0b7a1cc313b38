"""The energy ledger: what changed the energy of a scene, by name, step after step.

    columns   kinetic, the potential of each force, heat (with latent heat)                                [J]
    motion    work of forces without potential, dt F . (v + v'') / 2, and of the drag within others; what the columns changed besides
              is the stepper's own error, which falls with dt
    rules     what each rule changed: a kick J of the velocity counts J . (v + v'') / 2, potentials and heat count after minus before

v is the velocity before the step, v'' the one after motion and all rules: what a rule does to the velocity acts beside the forces of
that step. With symplectic Euler the kicks of forces and rules sum to the change of kinetic energy exactly. All entries together are the
change of the columns to rounding. Momentum is kept alike: what motion and each rule gave.

An impact counts as what it takes of the kinetic energy there, m (e^2 - 1) (n . w)^2 / 2, and as friction: the rest of the step that it
splits is motion. A node at rest on a floor, which falls g dt^2 in each step and is put back, books nothing.

Source: first law; the split of kicks is that of m (v''^2 - v^2) / 2 = (dt F + J) . (v + v'') / 2.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..forces.base import Finding, Force, Rule, Step
from ..forces.contact import Books, strike
from ..forces.fluid import Fluid
from ..numerics import cast_inexact
from ..state import State
from ..status import Status
from ..topology.base import Topology
from ..vector import Vector
from .heat import Heat, total_heat


class Account(eqx.Module):
    """What a `Ledger` keeps in `state.ledger`; `energy_ledger` reads it.

    Attributes:
        start: (2 + F,) columns at the start [J]: kinetic, F forces, heat.
        now: the same now.
        work: (F,) work of drag and of forces without potential [J].
        motion: (2 + F,) what the columns changed by motion [J].
        rules: (R, 2 + F) what each rule changed [J].
        impulses: (1 + R, D) momentum given by motion and by each rule [kg m/s].
    """

    start: Array
    now: Array
    work: Array
    motion: Array
    rules: Array
    impulses: Array


class Ledger(Rule):
    """Runs other rules, in their order, and books what they and the motion do to the energy. It takes their place in `System(rules=...)`.

    Attributes:
        rules: heat, fusing, contact; may be empty.
        forces: those of the system, which fills them in.
        mass: [kg]; the system fills it in.

    Raises:
        TypeError: something that is not a rule.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, (js.Springs(net, 1.0, 1.0), js.Drag(0.5)), rules=Ledger())
    >>> start = js.State.from_points(net, [[0.0], [2.0]])
    >>> book = energy_ledger(system, js.rollout(system, start, js.SymplecticEuler(), dt=0.01, n_steps=100).state)
    >>> print(sorted(book), abs(book["residual"]) < 1e-6, book["work"]["Drag"] < 0)
    ['end', 'impulses', 'integration', 'residual', 'rules', 'start', 'work'] True True
    """

    rules: tuple[Rule, ...]
    forces: tuple[Force, ...] | None
    mass: Array | None

    def __init__(self, rules: Rule | Sequence[Rule] = ()):
        self.rules = (rules,) if isinstance(rules, Rule) else tuple(rules)
        for i, rule in enumerate(self.rules):
            if not isinstance(rule, Rule) or isinstance(rule, (Force, Ledger)):
                raise TypeError(f"rules[{i}] is a {type(rule).__name__}; expected a rule, e.g. Heat(net, ...), and no second Ledger.")
        self.forces = None
        self.mass = None

    @property
    def net(self) -> Topology | None:
        """The topology of the first rule that has one."""
        return next((net for net in (getattr(r, "net", None) for r in self.rules) if net is not None), None)

    @property
    def obstacles(self) -> tuple[Rule, ...]:
        """Those among its rules."""
        return tuple(obstacle for rule in self.rules for obstacle in rule.obstacles)

    @property
    def sets_temperature(self) -> bool:
        """Whether one of its rules does."""
        return any(rule.sets_temperature for rule in self.rules)

    def with_mass(self, mass: Array) -> Ledger:
        """The same, knowing the masses [kg]."""
        rules = tuple(r.with_mass(mass) for r in self.rules)
        return eqx.tree_at(lambda r: (r.rules, r.mass), self, (rules, mass), is_leaf=lambda leaf: leaf is None)

    def with_forces(self, forces: tuple[Force, ...]) -> Ledger:
        """The same, knowing the forces."""
        rules = tuple(r.with_forces(forces) for r in self.rules)
        return eqx.tree_at(lambda r: (r.rules, r.forces), self, (rules, forces), is_leaf=lambda leaf: leaf is None)

    def prepare(self, dtype: Any) -> Ledger:
        """Every rule as the loop wants it."""
        return cast_inexact(eqx.tree_at(lambda r: r.rules, self, tuple(r.prepare(dtype) for r in self.rules)), dtype)

    def limit(self, state: State) -> Array | None:
        """The smallest limit of its rules [s]."""
        limits = [limit for limit in (r.limit(state) for r in self.rules) if limit is not None]
        return None if not limits else jnp.min(jnp.stack(limits))

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """What its rules have to report."""
        return tuple(finding for r in self.rules for finding in r.diagnose(state))

    def invalid(self) -> Array | None:
        """Whether a rule holds a constant that its constructor refuses."""
        bad = [b for b in (r.invalid() for r in self.rules) if b is not None]
        return None if not bad else jnp.any(jnp.stack(bad))

    def begin(self, state: State) -> State:
        """The state with what its rules need, and an account."""
        for rule in self.rules:
            state = rule.begin(state)
        if state.ledger is not None:
            return state
        now = self.columns(state)
        n = len(self._forces())
        work, books = jnp.zeros(n, state.dtype), jnp.zeros((len(self.rules), n + 2), state.dtype)
        account = Account(now, now, work, jnp.zeros_like(now), books, jnp.zeros((1 + len(self.rules), state.dim), state.dtype))
        return dataclasses.replace(state, ledger=account)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """Every rule, with its entry: obstacles last, all of them together."""
        account: Account = state.ledger
        before, status = step.before, Status.ok()
        stages, columns, places = [before, state], [account.now, self.columns(state)], [-1]
        for i, rule in enumerate(self.rules):
            if not rule.obstacles:
                last = state
                state, seen = rule.update(step, last)
                status = status.then(seen)
                stages.append(state)
                columns.append(self.columns(state, last, columns[-1]))
                places.append(i)
        struck = None
        if self.obstacles:
            last = state
            state, seen, struck = strike(self.obstacles, step, last, books=True)
            status = status.then(seen)
            stages.append(state)
            columns.append(self.columns(state, last, columns[-1]))
            places.append(-1)
        mean = 0.5 * (before.velocity + state.velocity)
        books, momenta = jnp.zeros_like(account.rules), jnp.zeros_like(account.impulses)
        motion = jnp.zeros_like(account.motion)
        for i, a, b, x, y in zip(places, stages, stages[1:], columns, columns[1:], strict=False):
            change, given = self._change(a, b, mean, x, y), self._momentum(b) - self._momentum(a)
            momenta = momenta.at[1 + i].add(given)
            books, motion = (books, motion + change) if i < 0 else (books.at[i].add(change), motion)
        if struck is not None:
            books, motion, momenta = self._by_obstacle(state, struck, books, motion, momenta)
        work = account.work + self._work(before, mean, step.dt)
        new = Account(account.start, columns[-1], work, account.motion + motion, account.rules + books, account.impulses + momenta)
        return dataclasses.replace(state, ledger=new), status

    def _by_obstacle(self, state: State, struck: Books, books: Array, motion: Array, momenta: Array) -> tuple[Array, Array, Array]:
        """The entries, where what each obstacle took of energy and gave of momentum is its own and no longer motion's."""
        mass, (work, given) = self._mass(state), struck
        rows = [i for i, rule in enumerate(self.rules) if rule.obstacles]
        for i, taken, velocity in zip(rows, work, given, strict=True):
            energy, momentum = jnp.sum(mass * taken), jnp.stack([jnp.sum(mass * a) for a in velocity])
            books, motion = books.at[i, 0].add(energy), motion.at[0].add(-energy)
            momenta = momenta.at[1 + i].add(momentum).at[0].add(-momentum)
        return books, motion, momenta

    def _change(self, a: State, b: State, mean: Vector, before: Array, after: Array) -> Array:
        """(2 + F,) what happened to the columns between two stages of a step: kicks at the mean velocity of the step [J]."""
        return (after - before).at[0].set(jnp.sum(self._mass(a) * (b.velocity - a.velocity).dot(mean)))

    def columns(self, state: State, last: State | None = None, known: Array | None = None) -> Array:
        """(2 + F,) kinetic energy, potential of each force (0 where there is none), heat [J].

        `known` are the columns of the state `last`: a fluid whose particles are where they were is not summed again.
        """
        kinetic = 0.5 * jnp.sum(self._mass(state) * state.velocity.dot(state.velocity))
        zero = jnp.zeros((), state.dtype)
        is_moved = last is None or known is None or last.position is not state.position or last.alive is not state.alive
        stored = []
        for i, force in enumerate(self._forces()):
            energy = force.energy(state) if is_moved or known is None or not isinstance(force, Fluid) else known[1 + i]
            stored.append(zero if energy is None else energy)
        heat = sum((total_heat(r, state) for r in self.rules if isinstance(r, Heat)), start=zero)
        return jnp.stack([kinetic, *stored, heat])

    def _work(self, before: State, mean: Vector, dt: Array) -> Array:
        """(F,) work of drag and of forces without potential in one step at this mean velocity [J]."""
        still = before.moved(before.position, Vector.zeros_like(before.velocity))
        parts = []
        for force in self._forces():
            has_potential = force.energy(before) is not None
            if has_potential and force.is_symmetric(before) and force.damping_bound(before) is None:
                parts.append(jnp.zeros((), before.dtype))
                continue
            f = force.force(before)
            f = f - force.force(still) if has_potential else f
            parts.append(dt * jnp.sum(f.dot(mean)))
        return jnp.stack(parts) if parts else jnp.zeros(0, before.dtype)

    def _momentum(self, state: State) -> Array:
        mass = self._mass(state)
        return jnp.stack([jnp.sum(mass * a) for a in state.velocity])

    def _forces(self) -> tuple[Force, ...]:
        if self.forces is None:
            raise ValueError("Ledger knows no forces yet. Put it in System(rules=...), and call rollout, or system.prepare(dtype).")
        return self.forces

    def _mass(self, state: State) -> Array:
        self._forces()
        return jnp.asarray(self.mass, state.dtype)


def energy_ledger(system: Any, state: State) -> dict[str, Any]:
    """The books of a run as names and numbers; for the host.

    Args:
        system: whose rule is a `Ledger`.
        state: the last of a rollout.

    Returns:
        `start`, `end`: energy by column [J]. `work`: of drag and forces without potential [J]. `rules`: what each rule changed, by column
        [J]. `integration`: the stepper's own error [J]. `residual`: what is left, rounding [J]. `impulses`: momentum that motion and each
        rule gave [kg m/s].

    Raises:
        ValueError: no ledger in the system, or none in the state.
    """
    ledger = next((rule for rule in system.rules or () if isinstance(rule, Ledger)), None)
    if ledger is None or not isinstance(state.ledger, Account):
        raise ValueError("there is no ledger. Pass rules=Ledger(rules) to System, and a state that came out of rollout.")
    account = state.ledger
    forces, rules = _names(system.forces), _names(ledger.rules)
    columns = ("kinetic", *forces, "heat")
    start, now, work, motion, books = (
        np.asarray(a, np.float64) for a in (account.start, account.now, account.work, account.motion, account.rules)
    )
    integration = float(np.sum(motion) - np.sum(work))

    def named(values: np.ndarray) -> dict[str, float]:
        return dict(zip(columns, map(float, values), strict=True))

    return {
        "start": named(start),
        "end": named(now),
        "work": dict(zip(forces, map(float, work), strict=True)),
        "rules": {name: named(row) for name, row in zip(rules, books, strict=True)},
        "integration": integration,
        "residual": float(np.sum(now - start) - np.sum(work) - integration - np.sum(books)),
        "impulses": dict(zip(("motion", *rules), np.asarray(account.impulses, np.float64).tolist(), strict=True)),
    }


def _names(effects: tuple[Any, ...]) -> tuple[str, ...]:
    """Class names, numbered where there are two of a kind."""
    kinds = [type(effect).__name__ for effect in effects]
    return tuple(kind if kinds.count(kind) == 1 else f"{kind} {kinds[:i].count(kind) + 1}" for i, kind in enumerate(kinds))


__all__ = ["Account", "Ledger", "energy_ledger"]
