"""The contact pass of a step: all obstacles together, the earliest impact first, whatever the order in which a system names them."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.base import Step
from ..forces.contact import Book, Books, changed, damped, goes_first, parabola, pick_vector, unfinished_in, where
from ..forces.planes import counted_from, pick
from ..numerics import any_lane
from ..state import State
from ..status import Status
from ..vector import Vector
from .encounters import follow, is_any_near
from .passage import Passage
from .paths import Path
from .surfaces import Surface

SMALL = 64  # numbers: obstacles of more constants are taken in the order in which they are given, where they are of one form


def strike(
    surfaces: tuple[Surface, ...], step: Step, state: State, books: bool = False, is_kicked: bool = True
) -> tuple[State, Status, Books | None]:
    """The state after the impacts of a step on all these surfaces, and what went wrong.

    Args:
        surfaces: all of them, in the dtype of the state.
        step: what is known of the step.
        state: what the other rules left.
        books: whether to tell what each of them did.
        is_kicked: whether another rule may have moved or kicked nodes since the end of motion.
    """
    moved = step.moved
    surfaces, order = _ordered(surfaces)
    scene, path = _begun(surfaces, step, books)

    def met(path: Path) -> tuple[Vector, Vector, Any, Array]:
        end, unfinished = _followed(scene, path)
        position, velocity = where(end.is_struck, end.position, moved.position), where(end.is_struck, end.arrived, moved.velocity)
        if end.first is not None:
            frame = scene.frame(scene.touches(end.position, jnp.broadcast_to(scene.start + scene.dt, end.left.shape)), end.held)
            position, velocity = damped(end, step, frame.without, scene.lifted, position, velocity)
        return position, velocity, end.books, unfinished

    def passed(path: Path) -> tuple[Vector, Vector, Any, Array]:
        return moved.position, moved.velocity, path.books, jnp.zeros_like(path.is_struck)

    # Most steps of most scenes bring no node near: they pay for a distance alone.
    position, velocity, told, unfinished = lax.cond(any_lane(is_any_near(scene, path)), met, passed, path)
    after, status = changed(state, moved, position, velocity, is_kicked), unfinished_in(step, unfinished)
    return after, status, None if told is None else tuple(_entry(chosen, told) for chosen in order)


_followed = eqx.filter_jit(follow)  # traced once in a run, which holds a step at several places


def _begun(surfaces: tuple[Surface, ...], step: Step, books: bool) -> tuple[Passage, Path]:
    """The step as a parabola, and every node at its beginning. With dt <= 0 no time is left, in which nothing is met."""
    before, (dt, u, a, offset, left) = step.before, parabola(step)
    free = step.free if step.free is not None else (None,) * u.dim
    rounding = tuple(s.rounding(before.position) for s in surfaces)
    base = tuple(counted_from(s.distance(before.position, before.time), least) for s, least in zip(surfaces, rounding, strict=True))
    scene = Passage(surfaces, free, base, rounding, before.time, dt, a, offset)
    nothing, none = jnp.zeros_like(left), Vector.zeros_like(u)
    asks = step.by_velocity is not None
    path = Path(
        position=before.position,
        velocity=u,
        arrived=u,
        left=left,
        held=tuple(jnp.zeros_like(left, bool) for _ in surfaces),
        is_struck=jnp.zeros_like(left, bool),
        first=(none, none, nothing) if asks else None,
        moments=(none, none) if asks else None,
        books=tuple(Book(nothing, none, none) for _ in surfaces) if books else None,
    )
    return scene, path


def _ordered(surfaces: tuple[Surface, ...]) -> tuple[tuple[Surface, ...], tuple[tuple[Array, ...], ...]]:
    """The surfaces in an order that is theirs alone, and for each that was given the place in it, as one truth value per place.

    Which of two impacts at the same time comes first, and every rounding, is then the same in whatever order they were given: by their
    form, and among those of one form by their constants.
    """
    if len(surfaces) == 1:
        return surfaces, ((jnp.ones((), bool),),)
    kinds = [_form(s) for s in surfaces]
    no, yes = jnp.zeros((), bool), jnp.ones((), bool)
    ordered: list[Surface] = []
    at: dict[int, dict[int, Array]] = {i: {} for i in range(len(surfaces))}
    for form in sorted(set(kinds)):
        own = [i for i, kind in enumerate(kinds) if kind == form]
        first = len(ordered)
        keys = [_key(surfaces[i]) for i in own]
        if len(own) == 1 or any(len(key) > SMALL for key in keys):
            ordered += [surfaces[i] for i in own]
            for place, i in enumerate(own):
                at[i][first + place] = yes
            continue
        none = jnp.zeros((), jnp.int32)
        before = [
            sum((goes_first(k, key, n < m).astype(jnp.int32) for n, k in enumerate(keys) if n != m), none) for m, key in enumerate(keys)
        ]
        for place in range(len(own)):
            chosen = tuple(b == place for b in before)
            arrays, rest = zip(*(eqx.partition(surfaces[i], eqx.is_array) for i in own), strict=True)
            picked = jax.tree.map(lambda *values, c=chosen: pick(c, values), *arrays)
            ordered.append(eqx.combine(picked, rest[0]))
            for i, c in zip(own, chosen, strict=True):
                at[i][first + place] = c
    return tuple(ordered), tuple(tuple(at[i].get(place, no) for place in range(len(surfaces))) for i in range(len(surfaces)))


def _form(surface: Surface) -> str:
    """What tells surfaces apart that cannot be compared number by number: the same in every order of a run."""
    leaves, tree = jax.tree.flatten(surface)
    said = [f"{a.shape}{a.dtype}" if eqx.is_array(a) else f"{getattr(a, '__qualname__', a)}{id(a)}" for a in leaves]
    return f"{tree} {said}"


def _key(surface: Surface) -> tuple[Array, ...]:
    """The numbers of a surface."""
    leaves = [jnp.ravel(leaf) for leaf in jax.tree.leaves(surface) if eqx.is_inexact_array(leaf)]
    if sum(leaf.size for leaf in leaves) > SMALL:
        return (jnp.zeros(()),) * (SMALL + 1)
    return tuple(leaf[i] for leaf in leaves for i in range(leaf.size))


def _entry(chosen: tuple[Array, ...], told: Books) -> Book:
    """What the books say of one of the given obstacles."""
    work = pick(chosen, tuple(book.work for book in told))
    return Book(work, pick_vector(chosen, tuple(b.normal for b in told)), pick_vector(chosen, tuple(b.friction for b in told)))


__all__ = ["strike"]
