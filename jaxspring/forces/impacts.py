"""Impacts on planes: the step is split where a node meets a plane, by one rule for every stepper.

From the state before a step (x0, v0) and the one after it (x1, v1), a parabola through both places:

    a = (v1 - v0) / dt        u = (x1 - x0) / dt - a dt / 2        X(t) = x0 + u t + a t^2 / 2
    off = v1 - (u + a dt)                                          the stepper's own: 0 for Verlet, -a dt / 2 for symplectic Euler

Where X first meets a plane, at t, with w = u + a t and r = dt - t left:

    bounce     J = -(1 + e)(n . w) n - min(mu j, |w_t|) w_t / |w_t|      j = -(1 + e) n . w: Coulomb's friction on the tangential part
    k more     the next flight lasts q = 2 out / |n . a|, out = -e n . w, each further one e times as long:
               k = floor(log(1 - r (1 - e) / q) / log e)  of them fit      floor(r / q) for e = 1
    rest       iff q <= r (1 - e), all of them fit, or out <= |n . off|: the node stays on the plane, its normal velocity gone, and slides
    then       the parabola goes on from there; the velocity at its end is its own plus `off`, of which rest drops the normal part

t, n and w are differentiated, so that the derivative of a bounce is that of the motion: a node that is put on the plane instead forgets
how deep it was, and gets derivative zero. Without position-dependent forces values and derivatives are exact for a stepper that is; with
them the values are of order 2 and the derivatives of order 1.

With several planes the earliest impact comes first, whatever their order, and the search goes on in the time that is left, MOST times
at most; a node that would go on longer waits at its last impact, and is counted. Where it rests on two planes it keeps what both let it.

A node that begins a step below a plane counts from where it is. What is held does not take part. Forces that depend on velocity change
at an impact: M^-1 (F(v + J) - F(v)) acts for the time r, on every node that they reach.

Source: events in a step as in Hairer, Norsett and Wanner (1993), II.6; the numbers it was tried on are in `docs/physics.md`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics import any_lane
from ..vector import Vector
from .planes import Plane, bounces, braked, halted, is_slow, meeting, pick, without

MOST = 16  # impacts (with a pair of planes) followed in one step


class Path(eqx.Module):
    """Where nodes are on their way through a step.

    Attributes:
        position: at the last impact.
        velocity: of the parabola there, without the stepper's offset.
        left: time that is left [s].
        held: for each plane, whether the node rests on it; empty before the first impact.
        is_struck: whether a node has met a plane.
        first: at the first impact: velocity, J, time left; None where no force depends on velocity.
        moments: J r and J r^2 / 2, summed over impacts; None likewise.
        work: for each plane, what it took of v^2 / 2; None where nobody books.
        given: for each plane, the velocity that it gave; None likewise.
    """

    position: Vector
    velocity: Vector
    left: Array
    held: tuple[Array, ...]
    is_struck: Array
    first: tuple[Vector, Vector, Array] | None
    moments: tuple[Vector, Vector] | None
    work: tuple[Array, ...] | None
    given: tuple[Vector, ...] | None


def kicked(path: Any, velocity: Vector, kick: Vector) -> tuple[tuple[Vector, Vector, Array] | None, tuple[Vector, Vector] | None]:
    """`first` and `moments` of a path after one more change of velocity, from this velocity on."""
    if path.first is None or path.moments is None:
        return path.first, path.moments
    now = (velocity, kick, path.left)
    first = jax.tree.map(lambda old, new: jnp.where(path.is_struck, old, new), path.first, now)
    return first, (path.moments[0] + path.left * kick, path.moments[1] + (0.5 * path.left * path.left) * kick)


class _Hit(eqx.Module):
    """What one impact does. All in node shape.

    Attributes:
        normal: of the plane that was met.
        lever: change of velocity per unit of change along the normal: the normal itself, unless coordinates are held.
        restitution: e.
        friction: mu.
        out: speed away from the plane after a bounce [m/s].
        bounce: J [m/s].
        stop: what rest takes of the velocity [m/s].
        pressed: n . a, toward the plane where negative [m/s^2].
        rests: whether the node stays on the plane.
    """

    normal: Vector
    lever: Vector
    restitution: Array
    friction: Array
    out: Array
    bounce: Vector
    stop: Vector
    pressed: Array
    rests: Array


class Impacts(eqx.Module):
    """The motion of one step, and the planes in its way.

    Attributes:
        planes: in a fixed order.
        free: per coordinate, where nodes are free (None: all are).
        base: per plane, the height from which a node counts [m]: 0, or where it began below the plane.
        rounding: per plane, below which a height is rounding [m].
        dt: of the whole step [s].
        acceleration: a, in node shape [m/s^2].
        offset: what the stepper's velocity differs by from the parabola's [m/s].
    """

    planes: tuple[Plane, ...]
    free: tuple[Array | None, ...]
    base: tuple[Array, ...]
    rounding: tuple[Array, ...]
    dt: Array
    acceleration: Vector
    offset: Vector

    def follow(self, path: Path) -> tuple[Path, Array]:
        """Through all impacts of the step, and which nodes would have gone on beyond `MOST`."""
        if len(self.planes) == 1:
            return self.strike(path)[0], jnp.zeros_like(path.is_struck)

        def sweep(carry: tuple[Path, Array], _: None) -> tuple[tuple[Path, Array], None]:
            path, goes_on = carry
            return lax.cond(any_lane(goes_on), lambda p: self.strike(p), lambda p: (p, goes_on), path), None

        path = dataclasses.replace(path, held=tuple(jnp.zeros_like(path.is_struck) for _ in self.planes))
        (path, goes_on), _ = lax.scan(sweep, (path, jnp.ones((), bool)), None, length=MOST)
        unfinished = self.next_impact(path)[2] & goes_on
        return dataclasses.replace(path, left=jnp.where(unfinished, jnp.zeros_like(path.left), path.left)), unfinished

    def strike(self, path: Path) -> tuple[Path, Array]:
        """Every node's next impact, where there is one, and whether there was any."""
        t, chosen, is_hit = self.next_impact(path)
        at = self.advance(path, t)
        before, any_hit = path, jnp.any(is_hit)
        if path.held:
            # The search knows no friction: whom it stops short of a plane, or slows on the way there, goes on from where it is.
            is_short = is_hit & self._falls_short(at, chosen)
            before, is_hit = jax.tree.map(lambda new, old: jnp.where(is_short, new, old), at, path), is_hit & ~is_short
        else:
            before = dataclasses.replace(path, held=tuple(jnp.zeros_like(c) for c in chosen))
        after = self._thrown(at, chosen, is_hit)
        return jax.tree.map(lambda new, old: jnp.where(is_hit, new, old), after, before), any_hit

    def _falls_short(self, at: Path, chosen: tuple[Array, ...]) -> Array:
        """Where a node that rests on one plane is not yet on the other that it was to meet."""
        rests, short = jnp.zeros_like(at.is_struck), jnp.zeros_like(at.is_struck)
        for plane, base, rounding, was, c in zip(self.planes, self.base, self.rounding, at.held, chosen, strict=True):
            rests, short = rests | was, short | (c & (plane.height(at.position) - base > rounding))
        return rests & short

    def next_impact(self, path: Path) -> tuple[Array, tuple[Array, ...], Array]:
        """The time until each node meets its next plane [s], for each plane whether it is that one, and whether there is one."""
        basis = self.basis(path.held)
        u, a = without(path.velocity, basis), without(self.acceleration, basis)
        best, is_hit = jnp.zeros_like(path.left), jnp.zeros_like(path.is_struck)
        chosen: list[Array] = []
        for i, plane in enumerate(self.planes):
            height = plane.height(path.position) - self.base[i]
            # What is rounding counts as on the plane: its value is dropped, its derivative is kept.
            is_on = height <= self.rounding[i]
            height = height - lax.stop_gradient(jnp.where(is_on, height, jnp.zeros_like(height)))
            v, b = u.dot(plane.normal), a.dot(plane.normal)
            t, meets = meeting(height, v, b, path.left, is_on & self.is_still(v, b, i))
            if any(mask is not None for mask in self.free):
                meets = meets & (self.free_part(plane.normal, height).norm() > 0)
            if path.held:
                meets = meets & ~path.held[i]
            is_earlier = meets & (~is_hit | (t < best))
            best, is_hit = jnp.where(is_earlier, t, best), is_hit | meets
            chosen = [*(c & ~is_earlier for c in chosen), is_earlier]
        return best, tuple(chosen), is_hit

    def is_still(self, into: Array, pressed: Array, plane: int) -> Array:
        """Whether a speed along a normal is rounding of places, or nothing beside what the acceleration makes of it in the step."""
        return is_slow(into, pressed, self.dt, self.rounding[plane])

    def free_part(self, v: Vector, like: Array) -> Vector:
        """`v` where free, zero where held; in node shape where a coordinate is held anywhere."""
        return Vector(
            tuple(
                a if m is None else jnp.where(m, jnp.broadcast_to(a, like.shape), jnp.zeros_like(like))
                for a, m in zip(v, self.free, strict=True)
            )
        )

    def basis(self, held: tuple[Array, ...]) -> tuple[Vector, ...]:
        """Directions of length one that the planes take from nodes that rest on them, at right angles to each other; elsewhere zero."""
        found: list[Vector] = []
        if held and len(self.planes) == 1 and all(mask is None for mask in self.free):
            return (self.planes[0].normal * held[0].astype(self.base[0].dtype),)
        for plane, is_held in zip(self.planes, held, strict=bool(held)):
            n = self.free_part(plane.normal, self.base[0])
            for e in found:
                n = n - n.dot(e) * e
            squared = n.dot(n)
            counts = is_held & (squared > 64 * float(jnp.finfo(squared.dtype).eps))
            length = jnp.sqrt(jnp.where(counts, squared, jnp.ones_like(squared)))
            found.append(n * jnp.where(counts, 1 / length, jnp.zeros_like(length)))
        return tuple(found)

    def advance(self, path: Path, t: Array) -> Path:
        """A time t later, where no plane is met on the way; what rests slides, with friction."""
        w, a, off = path.velocity, self.acceleration, self.offset
        if not path.held:
            return dataclasses.replace(path, position=path.position + t * (w + (0.5 * t) * a), velocity=w + t * a, left=path.left - t)
        basis = self.basis(path.held)
        free = w + t * a + off
        pressed = [jnp.maximum(-free.dot(e), jnp.zeros_like(t)) for e in basis]
        pulls = [plane.friction * j for plane, j in zip(self.planes, pressed, strict=True)]
        pull = sum(pulls[1:], start=pulls[0])
        along, slip, begun = without(free, basis), without(off, basis), without(w, basis)
        share = braked(pull, along)
        # A constant force of friction over the time t; one that stops the node also ends what the stepper's offset moves it.
        slid = begun + (0.5 * t) * without(a, basis) - (0.5 * share) * along + share * slip
        # Where it stops before, half of the true velocity at the begin lasts as long.
        stopped = (0.5 * halted(pull, along, begun + slip)) * (begun + slip)
        slid = slid.map(lambda a, b: jnp.where(share < 1, a, b), stopped)
        velocity = (1 - share) * along
        work, given = path.work, path.given
        if work is not None and given is not None:
            lost = share * along.dot(0.5 * (begun + slip + velocity))
            parts = [p / jnp.where(pull > 0, pull, jnp.ones_like(pull)) for p in pulls]
            work = tuple(b - p * lost for b, p in zip(work, parts, strict=True))
            given = tuple(b - free.dot(e) * e - (p * share) * along for b, e, p in zip(given, basis, parts, strict=True))
        # The offset comes back at the end of the step.
        rest = without(off, basis)
        return dataclasses.replace(
            path, position=path.position + t * slid, velocity=velocity - rest, left=path.left - t, work=work, given=given
        )

    def end(self, path: Path) -> tuple[Path, Vector]:
        """The end of the step, what rests exactly on its plane, and the velocity there."""
        gone = self.advance(path, path.left)
        position, velocity = gone.position, gone.velocity + without(self.offset, self.basis(path.held))
        for plane, base, is_held in zip(self.planes, self.base, path.held, strict=True):
            off = base - plane.height(position)
            position = position + self.lever(plane.normal, off)[0] * jnp.where(is_held, off, jnp.zeros_like(off))
        return dataclasses.replace(gone, position=position), velocity

    def lifted(self, position: Vector) -> Vector:
        """The positions, none of them below a plane."""
        for plane, base in zip(self.planes, self.base, strict=True):
            depth = plane.height(position) - base
            position = position - jnp.minimum(depth, jnp.zeros_like(depth)) * self.lever(plane.normal, depth)[0]
        return position

    def lever(self, normal: Vector, like: Array) -> tuple[Vector, Array]:
        """Change of velocity per unit of change along a normal, where nodes are free, and its length: the normal, and 1, of free nodes."""
        if all(mask is None for mask in self.free):
            return normal, jnp.ones((), like.dtype)
        part = self.free_part(normal, like)
        squared = part.dot(part)
        squared = jnp.where(squared > 0, squared, jnp.ones_like(squared))
        return part / squared, 1 / jnp.sqrt(squared)

    def _hit(self, path: Path, chosen: tuple[Array, ...], is_hit: Array) -> _Hit:
        """What the impact is that the path has come to."""
        normal = Vector(tuple(pick(chosen, n) for n in zip(*(p.normal for p in self.planes), strict=True)))
        e, mu = (pick(chosen, c) for c in zip(*((p.restitution, p.friction) for p in self.planes), strict=True))
        lever, length = self.lever(normal, path.left)
        w, true = path.velocity, path.velocity + self.offset
        into, zero = w.dot(normal), jnp.zeros_like(path.left)
        out = -e * into
        slip = true - true.dot(normal) * lever
        bounce = (out - into) * lever - braked(mu * (1 + e) * length * jnp.maximum(-into, zero), slip) * slip
        pressed = without(self.acceleration, self.basis(path.held)).dot(normal)
        falls = is_hit & (pressed < 0)
        # The next flight lasts 2 out / -pressed.
        # What falls from rest for half a step counts as rest, for e = 1 too: the hair is for rounding.
        slow = out <= (1 + float(jnp.finfo(out.dtype).eps) ** 0.5) * jnp.abs(self.offset.dot(normal))
        fits = (2 * out <= -pressed * path.left * (1 - e)) | slow
        for i, c in enumerate(chosen):
            fits = fits | (c & self.is_still(into, pressed, i))
        return _Hit(normal, lever, e, mu * length, out, bounce, -true.dot(normal) * lever, pressed, falls & fits)

    def _thrown(self, path: Path, chosen: tuple[Array, ...], is_hit: Array) -> Path:
        """The path after the impact that it has come to."""
        hit = self._hit(path, chosen, is_hit)
        kick = hit.bounce.map(lambda b, s: jnp.where(hit.rests, s, b), hit.stop)
        work, given = path.work, path.given
        first, moments = kicked(path, path.velocity + self.offset, kick)
        if work is not None and given is not None:
            at = path.velocity.map(lambda w, o: jnp.where(hit.rests, w + o, w), self.offset)
            work = tuple(b + jnp.where(c, kick.dot(at + 0.5 * kick), jnp.zeros_like(b)) for b, c in zip(work, chosen, strict=True))
            given = tuple(b + hit.bounce * (c & ~hit.rests).astype(path.left.dtype) for b, c in zip(given, chosen, strict=True))
        # Exactly on the plane, where rounding would leave it a little below. The derivative is that of the path: its height stays zero.
        position = path.position
        for plane, base, c in zip(self.planes, self.base, chosen, strict=True):
            position = position + jnp.where(c, base - plane.height(position), jnp.zeros_like(base)) * hit.lever
        held = self._held(path, hit, chosen)
        velocity = path.velocity.map(lambda w, j: jnp.where(hit.rests, w, w + j), hit.bounce)
        struck = jnp.ones_like(path.is_struck)
        after = Path(position, velocity, path.left, held, struck, first, moments, work, given)
        return self._hopped(after, hit, chosen, is_hit, path.held)

    def _held(self, path: Path, hit: _Hit, chosen: tuple[Array, ...]) -> tuple[Array, ...]:
        """On which planes each node rests after the impact: on this one, and on those that it stays pressed to."""
        if len(self.planes) == 1:
            return (hit.rests,)
        w, a = path.velocity, self.acceleration
        w, a = w - w.dot(hit.normal) * hit.lever, a - a.dot(hit.normal) * hit.lever
        moved = w + (0.5 * path.left) * a
        stays = [was & (moved.dot(plane.normal) <= 0) for plane, was in zip(self.planes, path.held, strict=True)]
        return tuple(hit.rests & (c | s) for c, s in zip(chosen, stays, strict=True))

    def _hopped(self, path: Path, hit: _Hit, chosen: tuple[Array, ...], is_hit: Array, held: tuple[Array, ...]) -> Path:
        """After all further bounces on the same plane that fit into the time left, where no other plane is in their way."""
        more = is_hit & ~hit.rests & (hit.pressed < 0) & (2 * hit.out < -hit.pressed * path.left)
        for was in held:
            more = more & ~was
        # Rare: what it takes, a logarithm per node, is left out of other steps.
        return lax.cond(any_lane(jnp.any(more)), lambda p: self._hops(p, hit, chosen, more), lambda p: p, path)

    def _hops(self, path: Path, hit: _Hit, chosen: tuple[Array, ...], more: Array) -> Path:
        """The bounces of `_hopped`, of the nodes that have more of them."""
        e, left, zero = hit.restitution, path.left, jnp.zeros_like(path.left)
        total, spread, power = bounces(e, hit.out, hit.pressed, left, more)
        w = path.velocity - hit.out * hit.lever
        along = w + total * (self.acceleration - hit.pressed * hit.lever)
        slip = along + self.offset - self.offset.dot(hit.normal) * hit.lever
        impulse = jnp.where(more, (1 + e) * hit.out * spread, zero)
        share = braked(hit.friction * impulse, slip)
        position = path.position + (0.5 * total) * (w + along - share * slip)
        velocity = along - share * slip + (hit.out * power) * hit.lever
        work, given = path.work, path.given
        if work is not None and given is not None:
            lost = 0.5 * hit.out * hit.out * (1 - power * power) * hit.lever.dot(hit.lever) + share * (1 - 0.5 * share) * slip.dot(slip)
            gained = impulse * hit.lever - share * slip
            work = tuple(b - jnp.where(c, lost, zero) for b, c in zip(work, chosen, strict=True))
            given = tuple(b + gained * c.astype(left.dtype) for b, c in zip(given, chosen, strict=True))
        after = dataclasses.replace(path, position=position, velocity=velocity, left=left - total, work=work, given=given)
        if len(self.planes) == 1:
            return after
        end = position + after.left * (velocity + (0.5 * after.left) * self.acceleration)
        clear = more
        for plane, base, c in zip(self.planes, self.base, chosen, strict=True):
            clear = clear & (c | (plane.height(end) >= base))
        return jax.tree.map(lambda new, old: jnp.where(clear, new, old), after, path)


__all__ = ["MOST", "Impacts", "Path", "kicked"]
