"""Contact: an obstacle of any form that nothing enters, with restitution and friction.

    at an impact, w the velocity there       J = -(1 + e)(n . w + d_t) n - min(mu j, |w_t|) w_t / |w_t|         j = -(1 + e)(n . w + d_t)
    at rest on the obstacle                  n . v' = -d_t, friction likewise                                  j = what presses

The step is split where a node meets the obstacle: see `encounters.py`. A floor is this rule with a plane.
"""

from __future__ import annotations

from typing import ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import kind
from ..forces.base import Finding, Rule, Scene, Step
from ..forces.contact import Books, Floor, coefficients, refused
from ..forces.contact import strike as strike_planes
from ..forces.planes import Plane
from ..numerics import cast_inexact
from ..state import State
from ..status import Flag, Status
from ..vector import Vector
from .base import Obstacle, seen
from .strike import strike as strike_surfaces
from .surfaces import Flat, Surface

DEPTH = 64  # of the rounding of a distance: what is deeper is inside


class Contact(Rule):
    """An obstacle that nothing enters. Belongs to a system's `rules`; all obstacles act together, after the other rules.

    A node that begins a step inside counts from where it is: it goes no deeper, and is not lifted; the status says `INSIDE`, and
    `push_out` moves such nodes onto the surface. Held nodes and held coordinates stay.

    Attributes:
        obstacle: its form, place and motion.
        friction: mu, Coulomb's coefficient.
        restitution: e: 0 takes all of the inward speed, 1 throws it back.

    Raises:
        ValueError: a negative friction, a restitution outside 0 to 1, an array in the place of a number.
        TypeError: what is no obstacle.

    >>> net = js.lattice(2)
    >>> ball = js.contact.Contact(js.contact.Sphere((0.0, 0.0), 1.0), restitution=1.0)
    >>> system = js.System(net, 1.0, js.Gravity((0.0, -10.0)), rules=ball)
    >>> print(ball.distance(js.State.from_points(net, [[0.0, 1.5], [3.0, 4.0]])))
    [0.5 4. ]
    """

    is_obstacle: ClassVar[bool] = True
    breaks: ClassVar[bool] = False
    obstacle: Obstacle
    friction: Array
    restitution: Array

    def __init__(self, obstacle: Obstacle, friction: Numbers = 0.0, restitution: Numbers = 0.0):
        self.obstacle = kind("obstacle", obstacle, Obstacle, "Sphere((0.0, 0.0), 1.0)")
        self.friction, self.restitution = coefficients(friction, restitution)

    @property
    def does_work(self) -> bool:
        """Whether the obstacle moves."""
        return self.obstacle.moves

    def bind(self, scene: Scene) -> Self:
        """The same with all constants in the dtype of the state."""
        bound = cast_inexact(self, scene.dtype)
        return eqx.tree_at(lambda rule: rule.obstacle, bound, self.obstacle.bind(scene.dtype))

    def distance(self, state: State) -> Array:
        """Signed distance of each node [m], in node shape.

        Raises:
            ValueError: another number of coordinates than the state's.
        """
        return self.surface(state).distance(state.position, state.time)

    def surface(self, state: State) -> Surface:
        """The obstacle as an impact sees it.

        Raises:
            ValueError: another number of coordinates than the state's.
        """
        self.obstacle.check(state.dim)
        friction, restitution = (a.astype(state.dtype) for a in (self.friction, self.restitution))
        return Surface(self.obstacle.bind(state.dtype), friction, restitution)

    def plane(self, state: State) -> Plane | None:
        """The plane that the obstacle is; None where it is another body, or moves."""
        surface = self.surface(state)
        if surface.obstacle.moves or not surface.obstacle.is_flat:
            return None
        origin = Vector(tuple(jnp.zeros((), state.dtype) for _ in range(state.dim)))
        distance, normal, _ = seen(surface.obstacle, origin, state.time)
        per_length = 1 / jnp.sqrt(normal.dot(normal))
        normal = normal * per_length
        return Plane((-distance * per_length) * normal, normal, surface.friction, surface.restitution)

    def update(self, step: Step, state: State) -> tuple[State, Status]:
        """The state after all impacts of the step on this obstacle."""
        state, status, _ = strike((self,), step, state, False, True)
        return state, status

    def depth(self, state: State) -> Array:
        """How deep each node is inside, beyond rounding [m], in node shape; 0 outside."""
        surface = self.surface(state)
        distance = surface.distance(state.position, state.time)
        return jnp.where(distance < -DEPTH * surface.rounding(state.position), -distance, jnp.zeros_like(distance))

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """INSIDE: how many nodes are, and the deepest of them."""
        depth = jnp.ravel(self.depth(state))
        return (Finding(Flag.INSIDE, jnp.sum(depth > 0), jnp.argmax(depth).astype(jnp.int32)),)

    def invalid(self) -> Array:
        """Whether a coefficient, or a constant of the obstacle, is one that a constructor refuses."""
        bad, obstacle = refused(self.friction, self.restitution), self.obstacle.invalid()
        return bad if obstacle is None else bad | obstacle


def strike(obstacles: tuple[Rule, ...], step: Step, state: State, books: bool, is_kicked: bool) -> tuple[State, Status, Books | None]:
    """The state after the impacts of a step on all these obstacles, whatever their order, and what went wrong: by the pass of planes, where
    they are all planes, else by that of any surface.

    Args:
        obstacles: all of them.
        step: what is known of the step.
        state: what the other rules left.
        books: whether to tell what each of them did.
        is_kicked: whether another rule may have moved or kicked nodes since the end of motion.

    Raises:
        TypeError: an obstacle that is neither `Floor` nor `Contact`.
    """
    others = [type(rule).__name__ for rule in obstacles if not isinstance(rule, (Floor, Contact))]
    if others:
        raise TypeError(f"{others[0]} counts as an obstacle, but only Floor and Contact can be one.")
    known = tuple(rule for rule in obstacles if isinstance(rule, (Floor, Contact)))
    flat = tuple(rule.plane(step.moved) for rule in known)
    planes = tuple(plane for plane in flat if plane is not None)
    if len(planes) == len(known):
        return strike_planes(planes, step, state, books, is_kicked)
    return strike_surfaces(tuple(surface_of(rule, step.moved) for rule in known), step, state, books, is_kicked)


def surface_of(rule: Floor | Contact, state: State) -> Surface:
    """An obstacle as an impact sees it, a plane as one that is met in closed form."""
    if isinstance(rule, Contact):
        plane = rule.plane(state)
        if plane is None:
            return rule.surface(state)
    else:
        plane = rule.plane(state)
    return Surface(Flat(plane), plane.friction, plane.restitution)


__all__ = ["Contact", "strike", "surface_of"]
