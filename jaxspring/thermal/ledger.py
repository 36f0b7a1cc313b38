"""The energy ledger: what changed the energy of a scene, by name, step after step.

    columns   kinetic, the potential of each force, heat (with latent heat)                                [J]
    motion    work of forces without potential, dt F . (v + v'') / 2, and of the drag within others; what the columns changed besides
              is the stepper's own error, which falls with dt
    rules     what each rule changed: a kick J of the velocity counts J . (v + v'') / 2, potentials and heat count after minus before

v is the velocity before the step, v'' the one after motion and all rules: what a rule does to the velocity acts beside the forces of
that step. With symplectic Euler the kicks of forces and rules sum to the change of kinetic energy exactly. All entries together are the
change of the columns to rounding. Momentum is kept alike: what motion and each rule gave.

Commands of driven springs change between steps, while nothing moves: what that changes of the potential is the actuators' work.

An impact counts as what it takes of the kinetic energy there, m (e^2 - 1) (n . w)^2 / 2, and as friction: the rest of the step that it
splits is motion. A node at rest on a floor, which falls g dt^2 in each step and is put back, books nothing.

A spring that yields at once books its plastic work: what motion has put into it above its yield force, as the rule acts once a step, is
taken back from motion.

Source: first law; the split of kicks is that of m (v''^2 - v^2) / 2 = (dt F + J) . (v + v'') / 2.
"""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..forces.base import Force, Rule, Scene, Step
from ..forces.contact import Books
from ..forces.fluid import Fluid
from ..memory import entry_at
from ..state import State
from ..status import Status
from ..vector import Vector
from .heat import Heat, total_heat


class Account(eqx.Module):
    """What a `Ledger` remembers; `energy_ledger` reads it.

    Attributes:
        start: (2 + F,) columns at the start [J]: kinetic, F forces, heat.
        now: the same now.
        work: (F,) work of drag and of forces without potential [J].
        motion: (2 + F,) what the columns changed by motion [J].
        rules: (R, 2 + F) what each rule changed [J]; those that watch, such as a ledger, change nothing.
        impulses: (1 + R, D) momentum given by motion and by each rule [kg m/s].
        driven: (F,) work of the actuators of each force [J]; None where there are none.
    """

    start: Array
    now: Array
    work: Array
    motion: Array
    rules: Array
    impulses: Array
    driven: Array | None = None


class Ledger(Rule):
    """Books what the motion and every other rule do to the energy. It watches, and changes nothing.

    Attributes:
        forces: those of the system, once bound.
        rules: those of the system, once bound.
        mass: [kg], once bound.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, (js.Springs(net, 1.0, 1.0), js.Drag(0.5)), rules=Ledger())
    >>> start = js.State.from_points(net, [[0.0], [2.0]])
    >>> book = energy_ledger(system, js.rollout(system, start, js.SymplecticEuler(), dt=0.01, n_steps=100).state)
    >>> print(sorted(book), abs(book["residual"]) < 1e-6, book["work"]["Drag"] < 0)
    ['end', 'impulses', 'integration', 'residual', 'rules', 'start', 'work'] True True
    """

    watches: ClassVar[bool] = True
    moves: ClassVar[bool] = False
    breaks: ClassVar[bool] = False
    forces: tuple[Force, ...] | None
    rules: tuple[Rule, ...] | None
    mass: Array | None

    def __init__(self) -> None:
        self.forces = self.rules = self.mass = None

    def bind(self, scene: Scene) -> Ledger:
        """The same, knowing masses, forces and rules of the scene."""
        first = len(scene.forces)
        forces = tuple(scene.bound(i) for i in range(first))
        rules = tuple(rule if rule.watches else scene.bound(first + i) for i, rule in enumerate(scene.rules))
        known = (forces, rules, scene.mass)
        return eqx.tree_at(lambda r: (r.forces, r.rules, r.mass), self, known, is_leaf=lambda leaf: leaf is None)

    def remember(self, state: State) -> Account:
        """An account with nothing in it."""
        forces, rules = self._parts()
        now, (n, r) = self.columns(state), (len(forces), len(rules))
        work, books = jnp.zeros(n, state.dtype), jnp.zeros((r, n + 2), state.dtype)
        driven = jnp.zeros_like(work) if any(force.drives and not force.is_idle for force in forces) else None
        return Account(now, now, work, jnp.zeros_like(now), books, jnp.zeros((1 + r, state.dim), state.dtype), driven)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state with the step in the books."""
        account: Account = self.recall(state)
        forces, rules = self._parts()
        before, driven = step.before, account.driven
        stages, columns, places = [before, step.moved], [account.now, self.columns(step.moved)], [-1]
        for place, after in step.stages:
            if 0 <= place < len(forces):
                columns.append(self.columns(after, columns[-1]))
                driven = driven if driven is None else driven.at[place].add(jnp.sum(columns[-1] - columns[-2]))
                continue
            row = place - len(forces) if place >= 0 else -1
            is_still = row >= 0 and not (rules[row].moves or rules[row].breaks)
            columns.append(self.columns(after, columns[-1] if is_still else None))
            stages.append(after)
            places.append(row)
        mean = 0.5 * (before.velocity + state.velocity)
        books, momenta = jnp.zeros_like(account.rules), jnp.zeros_like(account.impulses)
        motion = jnp.zeros_like(account.motion)
        for i, a, b, x, y in zip(places, stages, stages[1:], columns, columns[1:], strict=False):
            change, given = self._change(a, b, mean, x, y), self._momentum(b) - self._momentum(a)
            motion, change = self._returned(i, a, b, motion, change)
            momenta = momenta.at[1 + i].add(given)
            books, motion = (books, motion + change) if i < 0 else (books.at[i].add(change), motion)
        if step.impacts is not None:
            books, motion, momenta = self._by_obstacle(state, step.impacts, books, motion, momenta)
        work = account.work + self._work(before, mean, step.dt)
        books, momenta = account.rules + books, account.impulses + momenta
        new = Account(account.start, columns[-1], work, account.motion + motion, books, momenta, driven)
        return self.keep(state, new), Status.ok()

    def _by_obstacle(self, state: State, struck: Books, books: Array, motion: Array, momenta: Array) -> tuple[Array, Array, Array]:
        """The entries, where what each obstacle took of energy and gave of momentum is its own and no longer motion's."""
        mass, rows = self._mass(state), [i for i, rule in enumerate(self._parts()[1]) if rule.is_obstacle]
        for i, book in zip(rows, struck, strict=True):
            energy, momentum = jnp.sum(mass * book.work), jnp.stack([jnp.sum(mass * a) for a in book.normal + book.friction])
            books, motion = books.at[i, 0].add(energy), motion.at[0].add(-energy)
            momenta = momenta.at[1 + i].add(momentum).at[0].add(-momentum)
        return books, motion, momenta

    def _returned(self, i: int, a: State, b: State, motion: Array, change: Array) -> tuple[Array, Array]:
        """The entries of motion and of what rule i changed, where a part of that is motion's."""
        over = None if i < 0 else self._parts()[1][i].overshoot(a, b)
        if over is None:
            return motion, change
        place, energy = over
        return motion.at[1 + place].add(-energy), change.at[1 + place].add(energy)

    def _change(self, a: State, b: State, mean: Vector, before: Array, after: Array) -> Array:
        """(2 + F,) what happened to the columns between two stages of a step: kicks at the mean velocity of the step [J]."""
        return (after - before).at[0].set(jnp.sum(self._mass(a) * (b.velocity - a.velocity).dot(mean)))

    def columns(self, state: State, known: Array | None = None) -> Array:
        """(2 + F,) kinetic energy, potential of each force (0 where there is none), heat [J].

        `known` are the columns of a state with the same particles in the same places: a fluid is then not summed again.
        """
        kinetic = 0.5 * jnp.sum(self._mass(state) * state.velocity.dot(state.velocity))
        zero = jnp.zeros((), state.dtype)
        stored = []
        for i, force in enumerate(self._parts()[0]):
            energy = force.energy(state) if known is None or not isinstance(force, Fluid) else known[1 + i]
            stored.append(zero if energy is None else energy)
        heat = sum((total_heat(r, state) for r in self._parts()[1] if isinstance(r, Heat)), start=zero)
        return jnp.stack([kinetic, *stored, heat])

    def _work(self, before: State, mean: Vector, dt: Array) -> Array:
        """(F,) work of drag and of forces without potential in one step at this mean velocity [J]."""
        still = before.moved(before.position, Vector.zeros_like(before.velocity))
        parts = []
        for force in self._parts()[0]:
            has_potential = force.has_potential
            if has_potential and force.is_symmetric and force.damping_bound(before) is None:
                parts.append(jnp.zeros((), before.dtype))
                continue
            f = force.force(before)
            f = f - force.force(still) if has_potential else f
            parts.append(dt * jnp.sum(f.dot(mean)))
        return jnp.stack(parts) if parts else jnp.zeros(0, before.dtype)

    def _momentum(self, state: State) -> Array:
        mass = self._mass(state)
        return jnp.stack([jnp.sum(mass * a) for a in state.velocity])

    def _parts(self) -> tuple[tuple[Force, ...], tuple[Rule, ...]]:
        if self.forces is None or self.rules is None:
            raise ValueError("Ledger knows no forces yet. Put it in System(rules=...), and call rollout, or system.bind(state.dtype).")
        return self.forces, self.rules

    def _mass(self, state: State) -> Array:
        self._parts()
        return jnp.asarray(self.mass, state.dtype)


def energy_ledger(system: Any, state: State, which: int = 0) -> dict[str, Any]:
    """The books of a run as names and numbers; for the host.

    Args:
        system: of whose rules one is a `Ledger`.
        state: the last of a rollout.
        which: the ledger that is meant, where there are several.

    Returns:
        `start`, `end`: energy by column [J]. `work`: of drag, of forces without potential and of actuators [J]. `rules`: what each rule
        changed, by column [J]. `integration`: the stepper's own error [J]. `residual`: what is left, rounding [J]. `impulses`: momentum
        that motion and each rule gave [kg m/s].

    Raises:
        ValueError: no ledger in the system, or none in the state.
    """
    places = [i for i, part in enumerate(system.parts) if isinstance(part, Ledger)]
    entry = entry_at(state.memory, places[which]) if which < len(places) else None
    if entry is None or not isinstance(entry.value, Account):
        raise ValueError("there is no ledger. Pass rules=(..., Ledger()) to System, and a state that came out of rollout.")
    account = entry.value
    forces, rules = _names(system.forces), _names(system.rules)
    changing = [i for i, rule in enumerate(system.rules) if not rule.watches]
    columns = ("kinetic", *forces, "heat")
    start, now, work, motion, books = (
        np.asarray(a, np.float64) for a in (account.start, account.now, account.work, account.motion, account.rules)
    )
    impulses = np.asarray(account.impulses, np.float64).tolist()
    integration = float(np.sum(motion) - np.sum(work))
    work = work if account.driven is None else work + np.asarray(account.driven, np.float64)

    def named(values: np.ndarray) -> dict[str, float]:
        return dict(zip(columns, map(float, values), strict=True))

    return {
        "start": named(start),
        "end": named(now),
        "work": dict(zip(forces, map(float, work), strict=True)),
        "rules": {rules[i]: named(books[i]) for i in changing},
        "integration": integration,
        "residual": float(np.sum(now - start) - np.sum(work) - integration - np.sum(books)),
        "impulses": {"motion": impulses[0], **{rules[i]: impulses[1 + i] for i in changing}},
    }


def _names(effects: tuple[Any, ...]) -> tuple[str, ...]:
    """Class names, numbered where there are two of a kind."""
    kinds = [type(effect).__name__ for effect in effects]
    return tuple(kind if kinds.count(kind) == 1 else f"{kind} {kinds[:i].count(kind) + 1}" for i, kind in enumerate(kinds))


__all__ = ["Account", "Ledger", "energy_ledger"]
