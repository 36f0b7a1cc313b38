"""What an impact does: it throws a node back, or the node comes to rest on the obstacle.

    out    = -e s                        s = n . w + d_t, the speed of the height, w the velocity there
    J      = (out - s) n - min(mu j, |w_t|) w_t / |w_t|           j = out - s: Coulomb's friction on the tangential part
    b      the bend of the height along the surface: n . a + w' H w + ...: negative where the node is pressed
    rest   iff 2 out <= -b r (1 - e): all flights to come fit in r, the first one 2 out / -b long, each further one e times as long;
           or out <= |n . off|: what falls from rest for half a step rests
    k more k = floor(log(1 - r (1 - e) / q) / log e), q = 2 out / -b, floor(r / q) for e = 1: taken together, as on the tangent plane

Source: as in `forces/impacts.py`.
"""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.contact import Book
from ..forces.impacts import kicked
from ..forces.planes import bounces, braked, is_slow, pick
from ..numerics import any_lane
from ..vector import Vector
from .passage import Passage
from .paths import Path
from .surfaces import Touch, picked


class Hit(eqx.Module):
    """What one impact does. All in node shape.

    Attributes:
        normal: of the obstacle that was met.
        lever: change of velocity per unit of change along the normal: the normal itself, unless coordinates are held.
        restitution: e.
        friction: mu.
        out: speed away from the obstacle after a bounce [m/s].
        drag: velocity of the obstacle along its surface [m/s].
        kick: of a bounce along the lever [m/s].
        rub: what its friction takes [m/s].
        stop: what rest takes of the velocity [m/s].
        bend: toward the obstacle where negative [m/s^2].
        rests: whether the node stays on the obstacle.
        rate: how fast the height would grow if the node stood still [m/s].
    """

    normal: Vector
    lever: Vector
    restitution: Array
    friction: Array
    out: Array
    drag: Vector
    kick: Vector
    rub: Vector
    stop: Vector
    bend: Array
    rests: Array
    rate: Array


def thrown(scene: Passage, path: Path, pulled: Vector, chosen: tuple[Array, ...], is_hit: Array, is_late: Array) -> Path:
    """The path after the impact that it has come to, on the chosen surface; `pulled` is the acceleration that brought it there."""
    touches = scene.touches(path.position, scene.clock(path))
    touch = picked(chosen, touches)
    hit = _hit(scene, path, pulled, touch, chosen, is_hit)
    kick = (hit.kick - hit.rub).map(lambda b, s: jnp.where(hit.rests, s, b), hit.stop)
    first, moments = kicked(path, path.velocity + scene.offset, kick)
    books = path.books
    if books is not None:
        at = path.velocity.map(lambda w, o: jnp.where(hit.rests, w + o, w), scene.offset)
        work, bounces = kick.dot(at + 0.5 * kick), (~hit.rests).astype(path.left.dtype)
        books = _entered(books, chosen, work, bounces * hit.kick, (-bounces) * hit.rub)
    # Exactly on the obstacle, where rounding would leave it a little inside. The derivative is that of the path: its height stays zero.
    position = path.position - touch.height * hit.lever
    velocity = path.velocity.map(lambda w, j: jnp.where(hit.rests, w, w + j), hit.kick - hit.rub)
    arrived = path.velocity.map(lambda w, o, j: w + o + j, scene.offset, kick)
    held = _held(scene, path, hit, touches, chosen)
    after = Path(position, velocity, arrived, path.left, held, jnp.ones_like(path.is_struck), first, moments, books)
    more = is_late & is_hit & ~hit.rests & (hit.bend < 0) & (2 * hit.out < -hit.bend * path.left)
    for was in path.held:
        more = more & ~was
    return lax.cond(any_lane(jnp.any(more)), lambda p: _hops(scene, p, hit, chosen, more), lambda p: p, after)


def _hit(scene: Passage, path: Path, pulled: Vector, touch: Touch, chosen: tuple[Array, ...], is_hit: Array) -> Hit:
    """What the impact is."""
    clock = scene.clock(path)
    e, mu = (pick(chosen, values) for values in zip(*((s.restitution, s.friction) for s in scene.surfaces), strict=True))
    lever, length = scene.lever(touch.normal)
    w, true, zero = path.velocity, path.velocity + scene.offset, jnp.zeros_like(path.left)
    into = touch.speed(w)
    out = -e * into
    drag = Vector.zeros_like(w) if touch.drag is None else scene.free_part(touch.drag)
    slip = true - (true.dot(touch.normal)) * lever - drag
    rub = braked(mu * (1 + e) * length * jnp.maximum(-into, zero), slip) * slip
    along = w - into * lever
    bend = pick(chosen, tuple(s.bend(path.position, along, pulled, clock) for s in scene.surfaces))
    # What falls from rest for half a step counts as rest, for e = 1 too: the hair is for rounding.
    slow = out <= (1 + float(jnp.finfo(out.dtype).eps) ** 0.5) * jnp.abs(scene.offset.dot(touch.normal))
    still = is_slow(into, bend, scene.dt, pick(chosen, scene.rounding))
    rests = is_hit & (bend < 0) & ((2 * out <= -bend * path.left * (1 - e)) | slow | still)
    kick, stop = (out - into) * lever, -touch.speed(true) * lever
    return Hit(touch.normal, lever, e, mu * length, out, drag, kick, rub, stop, bend, rests, touch.rate)


def _held(scene: Passage, path: Path, hit: Hit, touches: tuple[Touch, ...], chosen: tuple[Array, ...]) -> tuple[Array, ...]:
    """On which obstacles each node rests after the impact: on this one, and on those that it stays pressed to."""
    if len(scene.surfaces) == 1:
        return (hit.rests,)
    into = pick(chosen, tuple(touch.speed(path.velocity) for touch in touches))
    pressed = scene.acceleration.dot(hit.normal)
    moved = path.velocity - into * hit.lever + (0.5 * path.left) * (scene.acceleration - pressed * hit.lever)
    stays = [was & (touch.speed(moved) <= 0) for touch, was in zip(touches, path.held, strict=True)]
    return tuple(hit.rests & (c | s) for c, s in zip(chosen, stays, strict=True))


def _hops(scene: Passage, path: Path, hit: Hit, chosen: tuple[Array, ...], more: Array) -> Path:
    """After all further bounces on the same obstacle that fit into the time left, where no other is in their way."""
    e, left, zero = hit.restitution, path.left, jnp.zeros_like(path.left)
    total, spread, power = bounces(e, hit.out, hit.bend, left, more)
    w, a = path.velocity - hit.out * hit.lever, scene.acceleration
    along = w + total * (a - a.dot(hit.normal) * hit.lever)
    slip = along + scene.offset - (along + scene.offset).dot(hit.normal) * hit.lever - hit.drag
    impulse = jnp.where(more, (1 + e) * hit.out * spread, zero)
    share = braked(hit.friction * impulse, slip)
    position = path.position + (0.5 * total) * (w + along - share * slip)
    velocity = along - share * slip + (hit.out * power) * hit.lever
    books = path.books
    if books is not None:
        taken = 0.5 * hit.out * hit.out * (1 - power * power) * hit.lever.dot(hit.lever) + share * (1 - 0.5 * share) * slip.dot(slip)
        books = _entered(books, chosen, -taken - impulse * hit.rate, impulse * hit.lever, (-share) * slip)
    after = dataclasses.replace(path, position=position, velocity=velocity, left=left - total, books=books)
    # The tangent plane has left the surface: back onto it.
    touch = picked(chosen, scene.touches(after.position, scene.clock(after)))
    after = dataclasses.replace(after, position=after.position - touch.height * scene.lever(touch.normal)[0])
    end, clear = after.position + after.left * (velocity + (0.5 * after.left) * a), more
    for c, surface, base in zip(chosen, scene.surfaces, scene.base, strict=True) if len(chosen) > 1 else ():
        clear = clear & (c | (surface.distance(end, scene.start + scene.dt) >= base))
    return jax.tree.map(lambda new, old: jnp.where(clear, new, old), after, path)


def _entered(books: tuple[Book, ...], chosen: tuple[Array, ...], work: Array, normal: Vector, friction: Vector) -> tuple[Book, ...]:
    """The books with what the chosen obstacle did."""
    after = []
    for book, c in zip(books, chosen, strict=True):
        own = c.astype(work.dtype)
        after.append(Book(book.work + own * work, book.normal + own * normal, book.friction + own * friction))
    return tuple(after)


__all__ = ["Hit", "thrown"]
