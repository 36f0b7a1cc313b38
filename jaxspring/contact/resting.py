"""What obstacles take from nodes that rest on them while an implicit step solves.

    lies     touches an obstacle where the step begins, and moves neither toward it nor away: d = 0, n . v + d_t = 0
    taken    n: the node ends the step on the obstacle's tangent plane there, n . (x0 + h y) known
    sticks   lies where there is friction, and does not slide: the tangential velocity is known too, that of the surface
    pulls    a < 0, where a n is the force that holds the node: none that an obstacle has
    slides   |R_t| > sum of mu a, where R_t is the force that keeps the node from sliding

n is the gradient of the distance where the step begins, differentiated. Who is held is no matter of a derivative.

Source: an active set that only loses members, after Nocedal and Wright (2006), 16.5.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..forces.base import Rule
from ..forces.contact import Floor
from ..forces.planes import ROUNDING, counted_from, is_slow
from ..state import State
from ..vector import Vector
from .frames import Frame, frame_of
from .rule import Contact, surface_of


class Held(eqx.Module):
    """Which nodes are held. All bool, in node shape.

    Attributes:
        lies: for each obstacle, whether a node lies on it.
        sticks: whether it does not slide there.
    """

    lies: tuple[Array, ...]
    sticks: Array

    def without(self, other: Held) -> Held:
        """Less those that are let go; what lies on nothing cannot stick."""
        lies = tuple(a & ~b for a, b in zip(self.lies, other.lies, strict=True))
        return Held(lies, self.sticks & ~other.sticks & _any(lies))

    def nobody(self) -> Held:
        """None of them."""
        return Held(tuple(jnp.zeros_like(a) for a in self.lies), jnp.zeros_like(self.sticks))

    def is_any(self) -> Array:
        """Whether there is one."""
        return jnp.any(_any((*self.lies, self.sticks)))


class Resting(eqx.Module):
    """Nodes that rest on obstacles where a step begins.

    Attributes:
        normals: of each obstacle, zero in held coordinates.
        speeds: along each of them, which lead onto the obstacle [m/s].
        drag: velocity of the obstacles along their surfaces [m/s].
        ends: speeds along the normals, and velocity along the surfaces, where the step ends [m/s]; None where no obstacle moves.
        friction: mu of each obstacle.
        free: per coordinate, where nodes are free (None: all are).
        held: who rests.
    """

    normals: tuple[Vector, ...]
    speeds: tuple[Array, ...]
    drag: Vector
    ends: tuple[tuple[Array, ...], Vector] | None
    friction: tuple[Array, ...]
    free: tuple[Array | None, ...]
    held: Held

    @staticmethod
    def of(
        obstacles: tuple[Rule, ...],
        state: State,
        acceleration: Vector,
        origin: Vector,
        span: Array,
        end: Array,
        free: tuple[Array | None, ...],
    ) -> Resting:
        """Who rests in a state.

        Args:
            obstacles: of the system.
            state: where the step begins.
            acceleration: there, without the obstacles, beside which a speed is none [m/s^2].
            origin: the step ends at origin + span y [m], y the velocity that it solves for.
            span: [s].
            end: time there [s].
            free: per coordinate, where nodes are free (None: all are).
        """
        x, v, now = state.position, state.velocity, jnp.broadcast_to(state.time, state.position.shape)
        normals, rates, speeds, lies, grips, rounding, ends = [], [], [], [], [], [], []
        surfaces = [surface_of(rule, state) for rule in obstacles if isinstance(rule, (Floor, Contact))]
        drag = drag_at_end = Vector.zeros_like(x)
        # A place is no better known than the way of a step: at the origin its own rounding is none.
        way = (ROUNDING * float(jnp.finfo(x.dtype).eps)) * span * (v.norm() + span * acceleration.norm())
        for surface in surfaces:
            least = surface.rounding(x) + way
            base = counted_from(surface.distance(x, state.time), least)
            touch = surface.touch(x, now, base)
            is_on = (touch.height <= least) & is_slow(touch.speed(v), acceleration.norm(), span, least)
            normals.append(touch.normal.where(free))
            rates.append(touch.rate)
            # Where nothing moves, the end of the step is seen from where it begins.
            stands = origin is x and not surface.obstacle.moves
            last = touch if stands else surface.touch(origin, jnp.broadcast_to(end, now.shape), base)
            # What a node is off the obstacle by rounding is dropped, its derivative is kept.
            speeds.append((lax.stop_gradient(touch.height) - last.height) / span)
            ends.append(-last.rate)
            lies.append(is_on)
            grips.append(is_on & (surface.friction > 0))
            rounding.append(jnp.broadcast_to(least, now.shape))
            if touch.drag is not None and last.drag is not None:
                drag = drag + is_on.astype(base.dtype) * touch.drag.where(free)
                drag_at_end = drag_at_end + is_on.astype(base.dtype) * last.drag.where(free)
        slip = frame_of(tuple(normals), tuple(rates), tuple(lies)).without(v.where(free) - drag)
        still = is_slow(slip.norm(), acceleration.norm(), span, sum(rounding[1:], start=rounding[0]))
        held = Held(tuple(lies), _any(tuple(grips)) & still)
        at_end = (tuple(ends), drag_at_end) if any(s.obstacle.moves for s in surfaces) else None
        return Resting(tuple(normals), tuple(speeds), drag, at_end, tuple(s.friction for s in surfaces), free, held)

    def taken(self, held: Held) -> tuple[tuple[Vector, ...], Array, Vector]:
        """Directions that are taken from those who slide, of length one or zero; who sticks; the velocity of both along what is taken."""
        frame, sticks = self._frame(held), held.sticks
        slides = (~sticks).astype(self.drag.dtype)
        return tuple(slides * e for e in frame.directions), sticks, frame.carried(self.drag) + (1 - slides) * self.drag

    def ended(self, held: Held, v: Vector) -> Vector:
        """Velocities at the end of the step, those who are held as fast as what holds them is by then [m/s]."""
        if self.ends is None:
            return v
        speeds, drag = self.ends
        frame = frame_of(self.normals, tuple(-c for c in speeds), held.lies)
        stuck = frame.carried(v) + drag
        return frame.onto(v).map(lambda a, b: jnp.where(held.sticks, b, a), stuck)

    def let_go(self, held: Held, force: Vector, least: Array) -> Held:
        """Who pulls, and who slides, if this force [N] holds the nodes; what is below `least` [N] is none."""
        parts, along = self._parts(held, force)
        pull = sum((mu * jnp.maximum(a, jnp.zeros_like(a)) for mu, a in zip(self.friction, parts, strict=True)), jnp.zeros_like(least))
        pulls = tuple(lies & (a < -least) for lies, a in zip(held.lies, parts, strict=True))
        return Held(pulls, held.sticks & (along.norm() > pull + least))

    def push(self, held: Held, glued: Held, force: Vector) -> Vector:
        """Of a force that holds the nodes, what obstacles have [N]: not the pull on those that should have been let go."""
        parts, along = self._parts(held, force)
        zero, total = jnp.zeros_like(parts[0]), held.sticks.astype(along.dtype) * along
        for a, pulls, n in zip(parts, glued.lies, self.normals, strict=True):
            total = total + jnp.where(pulls, zero, a) * n
        return total

    def _frame(self, held: Held) -> Frame:
        return frame_of(self.normals, tuple(-c for c in self.speeds), held.lies)

    def _parts(self, held: Held, force: Vector) -> tuple[tuple[Array, ...], Vector]:
        """Of a force, what is along each normal, and what is along the surfaces [N]."""
        frame, force = self._frame(held), force.where(self.free)
        return frame.shares(tuple(force.dot(e) for e in frame.directions)), frame.without(force)


def _any(flags: tuple[Array, ...]) -> Array:
    found = flags[0]
    for flag in flags[1:]:
        found = found | flag
    return found


__all__ = ["Held", "Resting"]
