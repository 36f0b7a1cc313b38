"""Going on from where a run ended: what a `Resume` holds, and what of it still fits.

    nothing changed                               the stepper's memory as it was, t = t0 + i dt: bit for bit the unbroken run
    dt, a constant, a function or the state       the stepper's memory made anew, t goes on from the state's
    stepper, dtype, topology, list of effects     refused by name

Numbers are compared by checksums inside the program, so that traced ones are seen as well; what is fixed when a program is compiled is
compared as text. Two sets of numbers have the same checksum by chance once in four thousand million times.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .bound import BoundSystem
from .facts import Fact, digest, facts
from .numerics import stopped
from .state import State
from .steppers.base import Stepper
from .system import System
from .topology.base import Topology
from .topology.periods import box_of


@dataclass(frozen=True)
class Origin:
    """What kind of run a `Resume` is of: all that is fixed when its program is compiled, as text.

    Attributes:
        stepper: its type and options.
        dtype: of the state.
        net: type, shape and order of the topology.
        effects: forces and rules, each with its topology.
        rest: digest of everything else in the system: laws, functions of time, which constants are numbers and which arrays.
    """

    stepper: tuple[Fact, ...]
    dtype: str
    net: str
    effects: tuple[str, ...]
    rest: str

    @staticmethod
    def of(system: System, state: State, stepper: Stepper) -> Origin:
        """What kind of run these make."""
        effects = tuple(type(part).__name__ + _on(getattr(part, "net", None)) for part in system.parts)
        own = dataclasses.fields(system)
        rest = digest(tuple(fact for field in own if field.name != "net" for fact in facts(getattr(system, field.name), field.name)))
        return Origin(facts(stepper), str(state.dtype), _named(system.net), effects, rest)


class Resume(eqx.Module):
    """What a run carries besides its state, and what it belongs to: pass it to `rollout(resume=...)` to go on as if unbroken.

    Attributes:
        start_time: time from which steps of dt are counted [s].
        start_step: steps done then.
        step: steps done.
        time: that was reached [s].
        dt: time step [s].
        memory: what the stepper carries.
        constants: checksum of the system's and the stepper's numbers.
        state: checksum of the state that was handed out.
        origin: what kind of run it is of (static).
    """

    start_time: Array
    start_step: Array
    step: Array
    time: Array
    dt: Array
    memory: Any
    constants: Array
    state: Array
    origin: Origin = eqx.field(static=True)

    def refuse(self, origin: Origin) -> None:
        """ValueError where another kind of run would go on, naming the difference."""
        old, remedy = self.origin, "Leave resume out: the run then goes on from the state at its time, with a fresh stepper"
        if old.stepper != origin.stepper:
            if dict(old.stepper)[""] != dict(origin.stepper)[""]:
                was, now = (o.stepper[0][1].split(".")[-1] for o in (old, origin))
                raise ValueError(f"resume is of a run by {was}, but the stepper is {now}, which carries something else. {remedy}.")
            at, was, now = _first_difference(old.stepper, origin.stepper)
            raise ValueError(f"resume is of a run whose stepper had {at} = {was}; here it is {now}. {remedy}.")
        for what, was, now in (
            ("in", old.dtype, origin.dtype),
            ("on", old.net, origin.net),
            ("with", _listed(old.effects), _listed(origin.effects)),
        ):
            if was != now:
                raise ValueError(f"resume is of a run {what} {was}; this one is {what} {now}. {remedy}.")


def check_kind(resume: Any) -> None:
    """Raise where `resume` is no `Resume`, or one of a batch."""
    if not isinstance(resume, Resume):
        raise TypeError(f"resume is a {type(resume).__name__}; expected the `resume` of an earlier result: resume=result.resume.")
    if resume.step.ndim:
        raise ValueError(
            f"resume is of a batch of {resume.step.shape} runs. Call rollout inside jax.vmap, with the batch's states and resume as its "
            f"arguments."
        )


def taken_up(
    resume: Resume, system: System, ready: BoundSystem, state: State, start: State, stepper: Stepper, dt: Array
) -> tuple[Resume, State]:
    """The resume as it fits this run, memory and time as they were, or anew; and the start, with the commands that were in force where
    nothing changed: they may have been rounded otherwise.

    Args:
        resume: of the earlier run.
        system: as the user gave it.
        ready: the same bound.
        state: as the user gave it.
        start: the same as the run begins.
        stepper: how the run steps.
        dt: [s], 0-d.
    """
    origin = Origin.of(system, state, stepper)
    resume.refuse(origin)
    constants = checksum(numbers((system, stepper)))
    still_dt, still_time = stopped((dt, state.time))
    same_dt = still_dt == resume.dt
    goes_on = same_dt & (still_time == resume.time)
    is_same = same_dt & (constants == resume.constants) & (checksum(state) == resume.state)
    is_same = is_same & jnp.asarray(resume.origin.rest == origin.rest)
    taken = Resume(
        start_time=jnp.where(goes_on, resume.start_time, state.time),
        start_step=jnp.where(goes_on, resume.start_step, resume.step),
        step=resume.step,
        time=state.time,
        dt=dt,
        memory=_memory(resume, is_same, stepper, ready, start),
        constants=constants,
        state=resume.state,
        origin=origin,
    )
    return taken, ready.commanded_as(state, start, is_same)


def numbers(tree: Any) -> Any:
    """The tree without the tables of its nets: they follow from their springs, which are compared as text. Periods stay."""

    def without_tables(leaf: Any) -> Any:
        return box_of(leaf) if isinstance(leaf, Topology) else leaf

    return jax.tree.map(without_tables, tree, is_leaf=lambda leaf: isinstance(leaf, Topology))


def checksum(tree: Any) -> Array:
    """uint32, of every bit of every array in a tree, each by its place."""
    total = jnp.zeros((), jnp.uint32)
    for i, leaf in enumerate(jax.tree.leaves(eqx.filter(stopped(tree), eqx.is_array))):
        # What is stored is read: without the barrier the compiler may compute it again and round otherwise.
        bits = jnp.ravel(_bits(lax.optimization_barrier(jnp.asarray(leaf))))
        x = bits + _word(0x9E3779B9) * (lax.iota(jnp.uint32, bits.size) + _word(0x85EBCA6B * (i + 1)))
        # The mixer "lowbias32" of Wellons (2018): every bit of x moves every bit of the result.
        x = (x ^ (x >> _word(16))) * _word(0x7FEB352D)
        x = (x ^ (x >> _word(15))) * _word(0x846CA68B)
        total = total + jnp.sum(x ^ (x >> _word(16)), dtype=jnp.uint32)
    return total


def _memory(resume: Resume, is_same: Array, stepper: Stepper, ready: BoundSystem, start: State) -> Any:
    """The stepper's memory as it was where nothing changed, else made anew."""
    fresh = eqx.filter_eval_shape(stepper.init, ready, start)
    if _kind(fresh) != _kind(resume.memory):
        return stepper.init(ready, start)
    old, rest = eqx.partition(resume.memory, eqx.is_array)
    new = lax.cond(is_same, lambda: old, lambda: eqx.filter(stepper.init(ready, start), eqx.is_array))
    return eqx.combine(new, rest)


def _kind(tree: Any) -> Any:
    """Structure, shapes and types."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(a.shape, a.dtype) if hasattr(a, "dtype") else a for a in leaves]


def _bits(a: Array) -> Array:
    """An array as uint32, two for each number of 64 bits."""
    if jnp.issubdtype(a.dtype, jax.dtypes.prng_key):
        return jax.random.key_data(a)
    if a.dtype.itemsize < 4:
        return _bits(a.astype(jnp.float32)) if jnp.issubdtype(a.dtype, jnp.inexact) else a.astype(jnp.uint32)
    if jnp.issubdtype(a.dtype, jnp.complexfloating):
        return jnp.stack([_bits(a.real), _bits(a.imag)])
    return lax.bitcast_convert_type(a, jnp.uint32)


def _word(number: int) -> Array:
    return jnp.asarray(number & 0xFFFFFFFF, jnp.uint32)


def _named(net: Any) -> str:
    """A topology in words, with a digest of what words leave out."""
    return f"a {type(net).__name__} of {net.n_nodes} nodes and {net.n_springs} springs ({digest(facts(net))[:8]})"


def _on(net: Any) -> str:
    return "" if net is None else f" on {_named(net)}"


def _listed(effects: tuple[str, ...]) -> str:
    return ", ".join(effects) or "no effect"


def _first_difference(old: tuple[Fact, ...], new: tuple[Fact, ...]) -> tuple[str, str, str]:
    """Path, old and new value of the first fact that differs."""
    was, now = dict(old), dict(new)
    at = next(path for path in (*was, *now) if was.get(path) != now.get(path))
    return at, was.get(at, "nothing"), now.get(at, "nothing")
