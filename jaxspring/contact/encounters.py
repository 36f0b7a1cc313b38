"""Impacts on any obstacle: the step is split where a node meets one, as on planes (`forces/impacts.py`), by one rule for every stepper.

    X(t) = x0 + u t + a t^2 / 2         the parabola through the places before and after the step
    1. t    the first root of d(X(t), t0 + t): found with the derivative stopped, then differentiated steps of Newton's method
    2. J    -(1 + e)(n . w + d_t) n,    w = u + a t,    n = grad d at X(t), differentiated: on a curved obstacle its turning counts
    3.      X goes on from there with w + J, for the time r = dt - t that is left

The earliest impact comes first, of all obstacles in whatever order, MOST times at most; from LATE on, the bounces that still fit are taken
together. A node that would go on longer waits at its last impact, and is counted.

Source: events in a step as in Hairer, Norsett and Wanner (1993), II.6; the numbers it was tried on are in `docs/physics.md`.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.planes import is_slow, meeting, pick
from ..numerics import any_lane, stopped
from ..vector import Vector
from .bounces import thrown
from .passage import Passage, Way
from .paths import Path
from .search import first_root
from .sliding import braking, slide
from .surfaces import Flat, picked

MOST = 8  # impacts followed one by one in a step
LATE = 4  # from this one on, further bounces on the same obstacle are taken together
SHORT = 1e-5  # of the time to an obstacle: whom friction leaves further from it slides on before it counts as met
REFINEMENTS = 2  # differentiated steps of Newton's method: with two, second derivatives are right as well


class Meeting(NamedTuple):
    """The next impact of each node: in which time, on which obstacle, whether there is one, and whether it lies still on the obstacle."""

    time: Array
    chosen: tuple[Array, ...]
    is_hit: Array
    is_still: Array


def follow(scene: Passage, path: Path) -> tuple[Path, Array]:
    """Through the impacts of the step to its end, and which nodes would have gone on beyond `MOST`."""

    def sweep(carry: tuple[Path, Array], i: Array) -> tuple[tuple[Path, Array], None]:
        return lax.cond(any_lane(jnp.any(carry[1])), lambda p: _leap(scene, p, i), lambda p: (p, carry[1]), carry[0]), None

    (path, goes_on), _ = lax.scan(sweep, (path, jnp.ones_like(path.is_struck)), jnp.arange(MOST + 1))
    return path, goes_on


def _leap(scene: Passage, path: Path, i: Array) -> tuple[Path, Array]:
    """Every node at its next impact, or at the end of the step, and which had an impact. After `MOST` of them a node waits there."""
    clock = scene.clock(path)
    touches = scene.touches(path.position, clock)
    frame = scene.frame(touches, path.held)
    way = Way(touches, frame, frame.onto(path.velocity), frame.without(scene.acceleration))
    bends = tuple(s.bend(path.position, way.velocity, way.acceleration, clock) for s in scene.surfaces)
    # Stopped on both sides: a distance function of the user's own may hold values that are differentiated by.
    found = stopped(_next_impact(*stopped((scene, path, way, bends))))
    t = jnp.where(found.is_hit, found.time, path.left)
    is_any_held = any_lane(jnp.any(jnp.stack([jnp.any(h) for h in path.held])))
    at, slowed = lax.cond(
        is_any_held,
        lambda: (slide(scene, path, t, way, bends), way.acceleration - braking(scene, path, way, bends)),
        lambda: (_flown(scene, path, t), way.acceleration),
    )
    at, reaches = _refined(scene, at, path.left, slowed, found, i >= MOST - 2)
    is_hit = found.is_hit & reaches
    after = thrown(scene, at, way.acceleration, found.chosen, is_hit, i >= LATE)
    zero = jnp.zeros_like(path.left)
    after = dataclasses.replace(after, left=jnp.where(i < MOST, after.left, zero))
    # Whom friction stops short of an obstacle goes on from there.
    at = dataclasses.replace(at, left=jnp.where(found.is_hit & (i < MOST), at.left, zero))
    # Whose way has ended before stays there.
    after = jax.tree.map(lambda new, old: jnp.where(is_hit, new, old), after, at)
    return jax.tree.map(lambda new, old: jnp.where(path.left > 0, new, old), after, path), found.is_hit


def _flown(scene: Passage, path: Path, t: Array) -> Path:
    """A time t later, where nothing is met on the way and no node rests."""
    v = path.velocity + t * scene.acceleration
    x = path.position + t * (path.velocity + (0.5 * t) * scene.acceleration)
    return dataclasses.replace(path, position=x, velocity=v, arrived=v + scene.offset, left=path.left - t)


def _refined(scene: Passage, at: Path, span: Array, pulled: Vector, found: Meeting, is_late: Array) -> tuple[Path, Array]:
    """The place and time of an impact, with their derivatives, and whether there is one in the time `span` that was left before."""
    zero, one = jnp.zeros_like(at.left), jnp.ones_like(at.left)
    hair = float(jnp.finfo(zero.dtype).eps) ** 0.5 * scene.dt
    rounding = pick(found.chosen, scene.rounding)
    slides = functools.reduce(jnp.logical_or, at.held) & ~is_late

    def nearer(at: tuple[Vector, Vector, Array, Array], _: None) -> tuple[tuple[Vector, Vector, Array, Array], None]:
        x, v, left, reaches = at
        touch = picked(found.chosen, scene.touches(x, scene.start + (scene.dt - left)))
        speed = touch.speed(v)
        # What is rounding counts as on the obstacle: its value is dropped, its derivative is kept.
        height = touch.height - lax.stop_gradient(jnp.where(jnp.abs(touch.height) <= rounding, touch.height, zero))
        moves = found.is_hit & ~found.is_still & (speed < 0)
        t = jnp.where(moves, -height / jnp.where(moves, speed, one), zero)
        # The search knows no friction: it may have stopped the node, or slowed it, on the way, and goes on doing so.
        is_near = (t <= left + hair) & (t >= -span) & ~(slides & (t > SHORT * found.time))
        reaches = reaches & ((moves & is_near) | (height <= rounding) | found.is_still)
        t = jnp.where(is_near, t, zero)
        return (x + t * (v + (0.5 * t) * pulled), v + t * pulled, left - t, reaches), None

    begin = (at.position, at.velocity, at.left, jnp.ones_like(found.is_hit))
    (x, v, left, reaches), _ = lax.scan(nearer, begin, None, length=REFINEMENTS)
    return dataclasses.replace(at, position=x, velocity=v, left=left), reaches


def _next_impact(scene: Passage, path: Path, way: Way, bends: tuple[Array, ...]) -> Meeting:
    """Each node's next impact; no derivative goes through it."""
    best, nothing = jnp.zeros_like(path.left), jnp.zeros_like(path.is_struck)
    is_hit, is_still = nothing, nothing
    chosen: list[Array] = []
    for i, (surface, touch, bend) in enumerate(zip(scene.surfaces, way.touches, bends, strict=True)):
        speed = touch.speed(way.velocity)
        is_on = touch.height <= scene.rounding[i]
        lies = is_on & is_slow(speed, bend, scene.dt, scene.rounding[i])
        if isinstance(surface.obstacle, Flat):
            height = jnp.where(is_on, jnp.zeros_like(touch.height), touch.height)
            t, meets = meeting(height, speed, bend, path.left, lies)
        else:
            t, meets = _sought(scene, i, path, way, speed, bend, lies)
        meets = meets & (scene.free_part(touch.normal).norm() > 0) & ~path.held[i]
        is_earlier = meets & (~is_hit | (t < best))
        best, is_still = jnp.where(is_earlier, t, best), jnp.where(is_earlier, lies, is_still)
        is_hit, chosen = is_hit | meets, [*(c & ~is_earlier for c in chosen), is_earlier]
    return Meeting(best, tuple(chosen), is_hit, is_still)


def _sought(scene: Passage, i: int, path: Path, way: Way, speed: Array, bend: Array, lies: Array) -> tuple[Array, Array]:
    """The time until each node meets a surface [s], and whether it does, by a search where the step reaches as far."""
    surface, clock, zero, height = scene.surfaces[i], scene.clock(path), jnp.zeros_like(path.left), way.touches[i].height
    is_on = height <= scene.rounding[i]
    at_once = is_on & jnp.where(lies, bend < 0, speed < 0) & (path.left > 0)
    rises = is_on & (bend < 0) & (speed > 0)
    # What has just left comes back after the top of its flight.
    top = jnp.where(rises, jnp.minimum(speed / jnp.where(rises, -bend, jnp.ones_like(bend)), path.left), zero)
    reach = _fastest(scene, i, path, way.velocity, way.acceleration)
    wanted = (height <= reach * path.left + scene.rounding[i]) & ~at_once & ~path.held[i]
    t, meets = first_root(
        lambda s: surface.along(s, path.position, way.velocity, way.acceleration, clock, scene.base[i]),
        top,
        path.left,
        reach,
        scene.rounding[i],
        wanted,
    )
    return jnp.where(at_once, zero, t), at_once | meets


def _fastest(scene: Passage, i: int, path: Path, velocity: Vector, acceleration: Vector) -> Array:
    """A bound of the speed at which each node and a surface approach each other [m/s]."""
    speed = jnp.maximum(velocity.norm(), (velocity + path.left * acceleration).norm())
    if not scene.surfaces[i].obstacle.moves:
        return speed
    clock = scene.clock(path)
    rates = [scene.surfaces[i].touch(path.position, t, scene.base[i]).rate for t in (clock, clock + path.left)]
    return speed + jnp.maximum(jnp.abs(rates[0]), jnp.abs(rates[1]))


def is_any_near(scene: Passage, path: Path) -> Array:
    """Whether any node is nearer to a surface than the step can cover."""
    still, path = stopped((scene, path))
    near = jnp.zeros((), bool)
    for i, surface in enumerate(still.surfaces):
        height = surface.distance(path.position, still.start) - still.base[i]
        reach = _fastest(still, i, path, path.velocity, still.acceleration)
        near = near | jnp.any((height <= reach * path.left + still.rounding[i]) & (path.left > 0))
    return near


__all__ = ["MOST", "follow", "is_any_near"]
