"""A floor: a plane that nothing passes, with restitution and friction.

    at an impact, w the velocity there       J = -(1 + e)(n . w) n - min(mu j, |w_t|) w_t / |w_t|         j = -(1 + e) n . w
    at rest on the plane                     v' = v - (n . v) n - min(mu j, |v_t|) v_t / |v_t|            j = -n . v

The step is split where a node meets a plane: see `impacts.py`, which holds the rule and its source.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, has_shape, is_concrete, nonnegative, plane
from ..numerics import any_lane
from ..state import State
from ..status import Flag, Status
from ..vector import Vector
from .base import Rule, Step, any_refused
from .impacts import Impacts, Path
from .planes import Plane, counted_from, pick, without


def coefficients(friction: Numbers, restitution: Numbers) -> tuple[Array, Array]:
    """Friction and restitution of an obstacle, as arrays.

    Raises:
        ValueError: a negative one, a restitution above 1, an array in the place of a number.
    """
    mu, e = as_inexact("friction", friction), as_inexact("restitution", restitution)
    for name, value in (("friction", mu), ("restitution", e)):
        has_shape(name, value, {"one number": ()})
        nonnegative(name, value, "It would feed energy in.")
    if is_concrete(e) and np.asarray(e) > 1:
        raise ValueError(f"restitution = {e} throws nodes back faster than they came. Pass 0 to 1.")
    return mu, e


def refused(friction: Array, restitution: Array) -> Array:
    """Whether a coefficient is one that `coefficients` refuses."""
    return any_refused(friction, restitution) | (restitution > 1)


class Floor(Rule):
    """A plane that nothing passes: `js.contact.Contact` with a plane. Belongs to a system's `rules`; all obstacles act together, after the
    other rules.

    A node that begins a step below the plane counts from where it is: it goes no deeper, and is not lifted. Held nodes and held
    coordinates stay.

    Attributes:
        point: (D,) a point of the plane [m].
        normal: (D,) its normal, away from the wall; of length one.
        friction: mu, Coulomb's coefficient.
        restitution: e: 0 takes all of the inward speed, 1 throws it back.

    Raises:
        ValueError: a negative friction, a restitution outside 0 to 1, a normal without length, shapes that differ.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, js.Gravity((0.0, -10.0)), rules=Floor(point=(0.0, 0.0), normal=(0.0, 1.0)))
    >>> start = js.State.from_points(net, [[0.0, 0.05], [1.0, 9.0]])
    >>> print(js.rollout(system, start, js.SymplecticEuler(), dt=0.1, n_steps=2).state.position.y)
    [0.  8.7]
    """

    is_obstacle: ClassVar[bool] = True
    breaks: ClassVar[bool] = False
    point: Array
    normal: Array
    friction: Array
    restitution: Array

    def __init__(self, point: Numbers, normal: Numbers, friction: Numbers = 0.0, restitution: Numbers = 0.0):
        self.point, self.normal = plane(point, normal)
        self.friction, self.restitution = coefficients(friction, restitution)

    def height(self, state: State) -> Array:
        """(x - p) . n of each node [m], in node shape."""
        return self.plane(state).height(state.position)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state after all impacts of the step on this plane."""
        state, status, _ = strike((self.plane(step.moved),), step, state)
        return state, status

    def invalid(self) -> Array:
        """Whether a coefficient is one that the constructor refuses."""
        return refused(self.friction, self.restitution)

    def plane(self, state: State) -> Plane:
        """The plane in the dtype of the state.

        Raises:
            ValueError: another number of coordinates than the state's.
        """
        if self.point.shape[0] != state.dim:
            raise ValueError(f"the floor has {self.point.shape[0]} coordinates, the positions have {state.dim}.")
        point, normal = (Vector(tuple(a.astype(state.dtype))) for a in (self.point, self.normal))
        return Plane(point, normal, self.friction.astype(state.dtype), self.restitution.astype(state.dtype))


class Book(eqx.Module):
    """What one obstacle did to each node in a step, over its mass.

    Attributes:
        work: change of v^2 / 2 [m^2/s^2].
        normal: velocity that it gave along its normal [m/s].
        friction: velocity that it gave along its surface [m/s].
    """

    work: Array
    normal: Vector
    friction: Vector


Books = tuple[Book, ...]


def strike(
    planes: tuple[Plane, ...], step: Step, state: State, books: bool = False, is_kicked: bool = True
) -> tuple[State, Status, Books | None]:
    """The state after the impacts of a step on all these planes, whatever their order, and what went wrong.

    Args:
        planes: all of them, in the dtype of the state.
        step: what is known of the step.
        state: what the other rules left.
        books: whether to tell what each plane did.
        is_kicked: whether another rule may have moved or kicked nodes since the end of motion.
    """
    moved = step.moved
    planes, order = _ordered(planes)
    scene, path = _begun(planes, step, books)

    def met(path: Path) -> tuple[Vector, Vector, Any, Array]:
        path, unfinished = scene.follow(path)
        end, velocity = scene.end(path)
        position, velocity = where(path.is_struck, end.position, moved.position), where(path.is_struck, velocity, moved.velocity)
        basis = scene.basis(end.held)
        position, velocity = damped(path, step, lambda v: without(v, basis), scene.lifted, position, velocity)
        return position, velocity, (end.work, end.given), unfinished

    def passed(path: Path) -> tuple[Vector, Vector, Any, Array]:
        return moved.position, moved.velocity, (path.work, path.given), jnp.zeros_like(path.is_struck)

    # Most steps of most scenes hold no impact: they pay for looking alone.
    any_meets = any_lane(jnp.any(scene.next_impact(path)[2]))
    position, velocity, (work, given), unfinished = lax.cond(any_meets, met, passed, path)
    after = changed(state, moved, position, velocity, is_kicked)
    status = unfinished_in(step, unfinished if len(planes) > 1 else None)
    if work is None or given is None:
        return after, status, None
    rubbed = [v - scene.lever(p.normal, left)[0] * v.dot(p.normal) for p, v, left in zip(planes, given, work, strict=True)]
    told = [Book(pick(c, work), pick_vector(c, given), pick_vector(c, tuple(rubbed))) for c in order]
    return after, status, tuple(Book(b.work, b.normal - b.friction, b.friction) for b in told)


def _begun(planes: tuple[Plane, ...], step: Step, books: bool) -> tuple[Impacts, Path]:
    """The step as a parabola, and every node at its beginning. With dt <= 0 no time is left, in which nothing is met."""
    before, (dt, u, a, offset, left) = step.before, parabola(step)
    free = step.free if step.free is not None else (None,) * u.dim
    rounding = tuple(p.rounding(before.position) for p in planes)
    base = tuple(counted_from(p.height(before.position), least) for p, least in zip(planes, rounding, strict=True))
    scene = Impacts(planes, free, base, rounding, dt, a, offset)
    nothing, none = jnp.zeros_like(left), Vector.zeros_like(u)
    asks = step.by_velocity is not None
    path = Path(
        position=before.position,
        velocity=u,
        left=left,
        held=(),
        is_struck=jnp.zeros_like(left, bool),
        first=(none, none, nothing) if asks else None,
        moments=(none, none) if asks else None,
        work=(nothing,) * len(planes) if books else None,
        given=(none,) * len(planes) if books else None,
    )
    return scene, path


def parabola(step: Step) -> tuple[Array, Vector, Vector, Vector, Array]:
    """dt, u, a, `off` (see `impacts.py`), and the time that each node has [s]: none with dt <= 0, where dt comes back as 1.

    What obstacles have given in the step already is left out of a: they give it again, where it meets friction and stands in the books.
    """
    before, moved = step.before, step.moved
    goes = step.dt > 0
    dt = jnp.where(goes, step.dt, jnp.ones_like(step.dt))
    per_dt = 1 / dt  # one division for all nodes
    a = per_dt * (moved.velocity - before.velocity)
    u = per_dt * (moved.position - before.position) - (0.5 * dt) * a
    left = jnp.broadcast_to(jnp.where(goes, step.dt, jnp.zeros_like(step.dt)), moved.position.shape)
    offset = moved.velocity - (u + dt * a)
    return dt, u, a if step.pushed is None else a - per_dt * step.pushed, offset, left


def changed(state: State, moved: State, position: Vector, velocity: Vector, is_kicked: bool) -> State:
    """The state after impacts that brought nodes from where they moved to these places and velocities.

    Another rule may have moved or kicked nodes since: then what the impacts change is added to that.
    """
    if is_kicked:
        position = state.position + (position - moved.position)
        velocity = state.velocity + (velocity - moved.velocity)
    return state.moved(position, velocity)


def unfinished_in(step: Step, unfinished: Array | None) -> Status:
    """INVALID for a step backward; IMPACTS where nodes would have gone on, if there is a limit."""
    status = Status.when(Flag.INVALID, step.dt < 0)
    if unfinished is None:
        return status
    node = jnp.argmax(jnp.ravel(unfinished)).astype(jnp.int32)
    return status.then(Status.when(Flag.IMPACTS, jnp.any(unfinished), node=node, count=jnp.sum(unfinished)))


def _ordered(planes: tuple[Plane, ...]) -> tuple[tuple[Plane, ...], tuple[tuple[Array, ...], ...]]:
    """The planes in an order that is theirs alone, and for each that was given the place in it, as one truth value per place.

    Which of two impacts at the same time comes first, and every rounding, is then the same in whatever order they were given.
    """
    if len(planes) == 1:
        return planes, ((jnp.ones((), bool),),)
    keys = [(*p.normal, *p.point, p.restitution, p.friction) for p in planes]
    places = [sum(goes_first(k, key, i < j).astype(jnp.int32) for i, k in enumerate(keys) if i != j) for j, key in enumerate(keys)]
    is_at = [tuple(place == i for place in places) for i in range(len(planes))]
    ordered = tuple(jax.tree.map(lambda *values, c=chosen: pick(c, values), *planes) for chosen in is_at)
    return ordered, tuple(zip(*is_at, strict=True))


def goes_first(a: tuple[Array, ...], b: tuple[Array, ...], otherwise: bool) -> Array:
    """Whether the first number that differs is smaller in `a`; `otherwise` where none does."""
    first, same = jnp.zeros((), bool), jnp.ones((), bool)
    for x, y in zip(a, b, strict=True):
        first, same = first | (same & (x < y)), same & (x == y)
    return first | (same & otherwise)


def damped(
    path: Any, step: Step, let: Callable[[Vector], Vector], lifted: Callable[[Vector], Vector], position: Vector, velocity: Vector
) -> tuple[Vector, Vector]:
    """Positions and velocities with what forces that depend on velocity do otherwise after the impacts.

    A change of velocity J with a time r left gives the accelerations F(v + J) - F(v), over mass, for that time: exactly where they are
    linear, whose parts add up; what is beyond that counts for the node itself.

    Args:
        path: after its impacts.
        step: what is known of the step.
        let: takes from a vector what the obstacles do not let through, where nodes rest.
        lifted: takes positions out of the obstacles.
        position: at the end of the step [m].
        velocity: there [m/s].
    """
    if path.first is None or path.moments is None or step.by_velocity is None:
        return position, velocity
    then, impulse, left = path.first
    at = where(path.is_struck, then, step.moved.velocity)
    force, linear = jax.linearize(step.by_velocity, at)
    bend = step.by_velocity(at + impulse) - force - linear(impulse)
    position = position + let(linear(path.moments[1]) + (0.5 * left * left) * bend)
    velocity = velocity + let(linear(path.moments[0]) + left * bend)
    return lifted(position), velocity


def where(condition: Array, v: Vector, otherwise: Vector) -> Vector:
    """`v` where the condition holds."""
    return v.map(lambda a, b: jnp.where(condition, a, b), otherwise)


def pick_vector(chosen: tuple[Array, ...], values: tuple[Vector, ...]) -> Vector:
    """The vector of the chosen obstacle."""
    return Vector(tuple(pick(chosen, parts) for parts in zip(*values, strict=True)))


__all__ = [
    "Book",
    "Books",
    "Floor",
    "changed",
    "coefficients",
    "damped",
    "goes_first",
    "parabola",
    "pick_vector",
    "refused",
    "strike",
    "unfinished_in",
    "where",
]
