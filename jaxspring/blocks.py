"""How a run of T steps is cut: blocks of about sqrt(T) steps, so that reverse mode remembers about 2 sqrt(T) states.

    few frames    frame = blocks of b steps              frames x scan(blocks) x scan(steps)
    many frames   block = g frames of s steps each       scan(blocks) x scan(frames) x scan(steps)

A block and a step inside it are rematerialised: the backward pass runs each block forward once more, and each step in it once more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

from .linalg.implicit import SOLUTION
from .status import Status
from .watch import Carry

Pair = tuple[Carry, Status]
Inspect = Callable[[Carry, Status], Status]


class Checkpointed(eqx.Module):
    """Reverse mode in O(sqrt T) memory that computes each step three times in all. The default.

    Attributes:
        block: steps in a block; None takes about sqrt(n_steps).
    """

    block: int | None = eqx.field(static=True, default=None)


class StoreStates(eqx.Module):
    """Reverse mode that stores the state and the solution of every step and computes the rest of a step again: O(T) memory, no second
    solve. For implicit steps.
    """


class StoreAll(eqx.Module):
    """Reverse mode that stores everything every step computes: O(T) memory, no second forward run."""


Adjoint = Checkpointed | StoreStates | StoreAll


@dataclass(frozen=True)
class Plan:
    """How a run is cut.

    Attributes:
        n_steps: T.
        save_every: steps s in a frame, or None for no frames.
        block: steps b in a block (few frames).
        group: frames g in a block (many frames), or 0.
        steps_again: whether reverse mode runs a step again, but for its solve, instead of storing all it computed.
        blocks_again: whether it runs blocks again instead of storing their states.
        check_every: look for trouble every so many steps; None is once per block.
    """

    n_steps: int
    save_every: int | None
    block: int
    group: int
    steps_again: bool
    blocks_again: bool
    check_every: int | None

    @property
    def unit(self) -> int:
        """Steps that a chunk of this run must hold whole."""
        if self.save_every is None:
            return self.block
        return self.save_every * max(self.group, 1)

    def pieces(self, n_pieces: int) -> list[Plan]:
        """The same run as consecutive runs of whole units, about `n_pieces` of equal length, so that they share one compile."""
        units = self.n_steps // self.unit
        if units < 2 or n_pieces < 2:
            return [self]
        each = max(units // n_pieces, 1) * self.unit
        lengths = [each] * (self.n_steps // each)
        rest = self.n_steps - each * len(lengths)
        return [replace(self, n_steps=n) for n in lengths + [rest] * bool(rest)]


def make_plan(n_steps: int, save_every: int | None, adjoint: Adjoint, check_every: int | None) -> Plan:
    """Cut a run of `n_steps`, frames after every `save_every`."""
    remat = (not isinstance(adjoint, StoreAll), isinstance(adjoint, Checkpointed))
    wanted = adjoint.block if isinstance(adjoint, Checkpointed) and adjoint.block else max(round(math.sqrt(n_steps)), 1)
    if save_every is None:
        return Plan(n_steps, None, _near_divisor(n_steps, wanted), 0, *remat, check_every)
    if save_every >= wanted:
        return Plan(n_steps, save_every, _near_divisor(save_every, wanted), 0, *remat, check_every)
    group = _near_divisor(n_steps // save_every, max(round(wanted / save_every), 1))
    return Plan(n_steps, save_every, save_every, group, *remat, check_every)


def run_blocks(
    advance: Callable[[Carry], Carry],
    inspect: Inspect,
    keep: Callable[[Carry], Any],
    report: Callable[[Carry], None],
    pair: Pair,
    plan: Plan,
) -> tuple[Pair, Any]:
    """Run the plan; returns the last carry, what was seen, and the kept frames (None without)."""
    steps = _stepping(advance, inspect, plan)

    def block(pair: Pair, n: int) -> Pair:
        return _seen(_remat(lambda p: steps(p, n), plan)(pair))

    def _seen(pair: Pair) -> Pair:
        carry, status = pair
        report(carry)
        return carry, status if plan.check_every else inspect(carry, status)

    def stretch(pair: Pair, n: int) -> Pair:
        """n steps, in blocks."""
        whole, rest = divmod(n, plan.block)
        if whole == 1:
            pair = block(pair, plan.block)
        elif whole:
            pair, _ = lax.scan(lambda p, _: (block(p, plan.block), None), pair, None, length=whole)
        return block(pair, rest) if rest else pair

    if plan.save_every is None:
        return stretch(pair, plan.n_steps), None
    every = plan.save_every
    n_frames = plan.n_steps // every
    if not plan.group:

        def frame(pair: Pair, _: None) -> tuple[Pair, Any]:
            pair = stretch(pair, every)
            return pair, keep(pair[0])

        return lax.scan(frame, pair, None, length=n_frames)

    def group(pair: Pair, n: int) -> tuple[Pair, Any]:
        def frames(pair: Pair) -> tuple[Pair, Any]:
            def frame(pair: Pair, _: None) -> tuple[Pair, Any]:
                pair = steps(pair, every)
                return pair, keep(pair[0])

            return lax.scan(frame, pair, None, length=n)

        after, saved = _remat(frames, plan)(pair)
        return _seen(after), saved

    whole, rest = divmod(n_frames, plan.group)
    pair, saved = lax.scan(lambda p, _: group(p, plan.group), pair, None, length=whole)
    saved = jax.tree.map(lambda a: a.reshape(whole * plan.group, *a.shape[2:]), saved)
    if rest:
        pair, last = group(pair, rest)
        saved = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), saved, last)
    return pair, saved


def _stepping(advance: Callable[[Carry], Carry], inspect: Inspect, plan: Plan) -> Callable[[Pair, int], Pair]:
    def one(pair: Pair, _: None) -> tuple[Pair, None]:
        before, status = pair
        after = advance(before)
        if plan.check_every:
            due = after.step % plan.check_every == 0
            status = lax.cond(due, lambda s: inspect(after, s), lambda s: s, status)
        return (after, status), None

    # What a solve found is kept: the backward pass then solves once per step, for its own right-hand side.
    keep = jax.checkpoint_policies.save_only_these_names(SOLUTION)
    step = jax.checkpoint(one, prevent_cse=False, policy=keep) if plan.steps_again else one

    def steps(pair: Pair, n: int) -> Pair:
        if n == 1:
            return step(pair, None)[0]
        if plan.check_every:
            return lax.scan(step, pair, None, length=n)[0]
        carry, status = pair
        carry, _ = lax.scan(lambda c, _: (step((c, status), None)[0][0], None), carry, None, length=n)
        return carry, status

    return steps


def _remat(function: Callable[[Pair], Any], plan: Plan) -> Callable[[Pair], Any]:
    return jax.checkpoint(function, prevent_cse=False) if plan.blocks_again else function


def _near_divisor(n: int, wanted: int) -> int:
    """A divisor of n within a factor of two of `wanted`, the nearest one; else `wanted` itself (the last block is then shorter)."""
    wanted = min(max(wanted, 1), max(n, 1))
    fitting = [d for d in range(max(wanted // 2, 1), 2 * wanted + 1) if n % d == 0]
    return min(fitting, key=lambda d: abs(d - wanted)) if fitting else wanted
