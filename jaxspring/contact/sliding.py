"""What rests on obstacles slides along them, with Coulomb's friction.

    begun = w moving with the surface, as all of the following              off: the stepper's own offset of the velocity
    y     = begun + t a' + off'                                             ' : without the parts along the normals
    j     = -(n . w + d_t) - t b - n . off                                  pressed in the time t, b the bend of the height
    share = min(mu j / |y - drag|, 1)                                       of the slip that friction takes; 1: the node sticks
    place = x + t (begun + t a' / 2 - share (y - drag) / 2 + share off')    then along n onto the surface, by push
          = x + t drag + t q b / 2       where it stops, b = begun + off' - drag, in the time t q, q = |b| / (|b| + mu j - |y - drag|)
    v     = y - share (y - drag) + push / t + t (a - a') / 2 + (off - off') then moving with the surface there; share by all that pressed

The push is half of what turns the velocity on a curved obstacle, the end the other half. Without friction, that keeps the energy: RATTLE.

Source: Andersen (1983), "Rattle: a velocity version of the Shake algorithm".
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.contact import Book
from ..forces.planes import braked, halted
from ..vector import Vector
from .frames import Frame
from .passage import Passage, Way
from .paths import Path

PRESSINGS = 2  # times that friction is made to fit what presses: each leaves an angle's share of the error
LANDINGS = 3  # steps of Newton's method onto a surface: each doubles the digits


def slide(scene: Passage, path: Path, t: Array, way: Way, bends: tuple[Array, ...]) -> Path:
    """A time t later, where nothing else is met on the way. What rests on nothing flies.

    Args:
        scene: the obstacles.
        path: where nodes are.
        t: [s].
        way: how they go on.
        bends: of the height over each surface along that way [m/s^2].
    """
    end, frame = scene.clock(path) + t, way.frame
    w, a, off = path.velocity, scene.acceleration, scene.offset
    begun, pulled, lag = way.velocity, way.acceleration, frame.without(off)
    y = begun + t * pulled + lag
    pull, parts = _pulls(scene, _pressed(scene, path, t, way, bends))
    carried = _carried(way, y, parts)
    slip = y - carried
    share = braked(pull, slip)
    # A constant force of friction over the time t; one that stops the node also ends what the stepper's offset moves it.
    place = path.position + t * (begun + (0.5 * t) * pulled - (0.5 * share) * slip + share * lag)
    # Where it stops before, half of the velocity at the begin, seen from the surface, lasts as long.
    first = begun + lag - _carried(way, begun + lag, parts)
    stopped = path.position + t * carried + (0.5 * t * halted(pull, slip, first)) * first
    place = place.map(lambda a, b: jnp.where(share < 1, a, b), stopped)
    landed = _landed(scene, place, frame, end)
    # In a shorter time what the surface turns is none, and the rounding of a place over it would be a speed.
    goes = t > float(jnp.finfo(t.dtype).eps) ** 0.5 * scene.dt
    turned = (landed - place) * jnp.where(goes, 1 / jnp.where(goes, t, jnp.ones_like(t)), jnp.zeros_like(t))
    ended = scene.frame(scene.touches(landed, end), path.held)
    free = y + turned + (0.5 * t) * (a - pulled) + (off - lag)
    for _ in range(PRESSINGS):
        # By what has pressed in the end, friction keeps to its cone where the obstacle is curved.
        pushed = ended.onto(free - share * slip) + share * slip - (w + t * a + off)
        pull, parts = _pulls(scene, frame.shares(tuple(pushed.dot(e) for e in frame.directions)))
        share = braked(pull, slip)
    v = ended.onto(free - share * slip)
    books = path.books
    if books is not None:
        given = v - (w + t * a + off) + share * slip
        lost = share * slip.dot(0.5 * (begun + lag + y - share * slip))
        books = _entered(scene, path, way, given, slip, [(p * share, p * lost) for p in parts])
    velocity = v - ended.without(off)
    return dataclasses.replace(path, position=landed, velocity=velocity, arrived=v, left=path.left - t, books=books)


def braking(scene: Passage, path: Path, way: Way, bends: tuple[Array, ...]) -> Vector:
    """By what friction slows each node that slides, and is not stopped by it [m/s^2]."""
    pull, parts = _pulls(scene, _pressed(scene, path, scene.dt, way, bends))
    begun = way.velocity + way.frame.without(scene.offset)
    slip = begun - _carried(way, begun, parts)
    speed = slip.norm()
    return (jnp.where(speed > 0, pull / scene.dt, jnp.zeros_like(speed)) / jnp.where(speed > 0, speed, jnp.ones_like(speed))) * slip


def _carried(way: Way, velocity: Vector, parts: list[Array]) -> Vector:
    """What the surfaces along which a velocity goes move by themselves, each by its part of the friction [m/s]."""
    carried = way.frame.carried(velocity)
    for part, touch in zip(parts, way.touches, strict=True):
        carried = carried if touch.drag is None else carried + part * way.frame.without(touch.drag)
    return carried


def _pressed(scene: Passage, path: Path, t: Array, way: Way, bends: tuple[Array, ...]) -> tuple[Array, ...]:
    """What each obstacle will have to take of the velocity along its normal in the time t [m/s]."""
    frame, total = way.frame, path.velocity + t * scene.acceleration + scene.offset
    parts = []
    for touch, bend, e, c in zip(way.touches, bends, frame.directions, frame.speeds, strict=True):
        # Of the surface alone: its curvature along the way, and what it moves by itself.
        turning = bend - way.acceleration.dot(touch.normal)
        parts.append(jnp.where(e.dot(e) > 0, c - total.dot(e) - t * turning, jnp.zeros_like(t)))
    return frame.shares(tuple(parts))


def _pulls(scene: Passage, pressed: tuple[Array, ...]) -> tuple[Array, list[Array]]:
    """How much tangential velocity friction can take [m/s], and which part of that each obstacle's."""
    pulls = [s.friction * jnp.maximum(j, jnp.zeros_like(j)) for s, j in zip(scene.surfaces, pressed, strict=True)]
    pull = sum(pulls[1:], start=pulls[0])
    return pull, [p / jnp.where(pull > 0, pull, jnp.ones_like(pull)) for p in pulls]


def _landed(scene: Passage, place: Vector, frame: Frame, time: Array) -> Vector:
    """From a place near the surfaces that hold a node, along the normals where it began, onto them."""

    def nearer(place: Vector, _: None) -> tuple[Vector, None]:
        for surface, base, e in zip(scene.surfaces, scene.base, frame.directions, strict=True):
            touch = surface.touch(place, time, base)
            along = touch.normal.dot(e)
            faces = along > float(jnp.finfo(along.dtype).eps) ** 0.5
            place = place - jnp.where(faces, touch.height / jnp.where(faces, along, jnp.ones_like(along)), jnp.zeros_like(along)) * e
        return place, None

    return lax.scan(nearer, place, None, length=LANDINGS)[0]


def _entered(scene: Passage, path: Path, way: Way, given: Vector, slip: Vector, shares: list[tuple[Array, Array]]) -> tuple[Book, ...]:
    """The books with a slide: what the normals gave together, and of each obstacle which share of the slip friction took, and its work."""
    pressed = way.frame.shares(tuple(given.dot(e) for e in way.frame.directions))
    normals = [j * scene.free_part(touch.normal) for j, touch in zip(pressed, way.touches, strict=True)]
    # What turning the normal leaves over is of the first that holds the node.
    rest, after = given - sum(normals[1:], start=normals[0]), []
    is_open = jnp.ones_like(path.held[0])
    for i, (share, lost) in enumerate(shares):
        book, j, is_held = (path.books or ())[i], pressed[i], path.held[i]
        own = normals[i] + (is_held & is_open).astype(j.dtype) * rest
        after.append(Book(book.work - j * way.touches[i].rate - lost, book.normal + own, book.friction - share * slip))
        is_open = is_open & ~is_held
    return tuple(after)


__all__ = ["braking", "slide"]
