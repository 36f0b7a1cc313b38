"""Penalty contact: a smooth force that pushes nodes out of an obstacle.

    elastic     -k p(-d) grad d                              [N]    p: see `law.py`; the gradient of an energy
    damper      -c g(-d) (grad d . v + d_t) grad d           [N]    against sinking in, and against leaving
    friction    -mu |push| h(|v_t|) v_t                      [N]    v_t: the velocity along the surface, relative to the obstacle's own

A node stands as deep as the load asks: push / k + w / 2. In an explicit step the stiffness counts like that of a spring (`stable_dt`). In
an implicit step the matrix holds, of a node inside,

    K = k p' n n' - k p hess d        G = c g n n' + mu push [h (I - n n') + (h' / |v_t|) v_t v_t']        n = grad d

where the bend of the surface, hess d, is clamped where the linearisation asks for a positive semi-definite matrix.
For impacts that are sharp, and derivatives that do not depend on a stiffness, take a rule such as `Floor` instead.

Source: the penalty method, e.g. Wriggers (2006), Computational Contact Mechanics, 5.3; friction as in `law.py`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import kind
from ..forces.base import Force, Scene
from ..forces.linearisation import Linearisation
from ..linalg.operators import Blocks, NodeDyads, isotropic
from ..numerics import cast_inexact
from ..state import State
from ..vector import Vector
from .base import Obstacle, curvature, length, seen, unit
from .law import ContactLaw
from .node_blocks import bent, blocks_of


class Penalty(Force):
    """A smooth push out of an obstacle, with a damper and friction where asked for.

    Attributes:
        obstacle: `Plane`, `Sphere`, any `Obstacle`.
        law: how hard it pushes: stiffness, onset, damping, friction, creep.

    Raises:
        TypeError: what is no obstacle.
        ValueError: a negative constant, an onset or a creep that is not positive.

    >>> net = js.lattice(1)
    >>> ground = Penalty(js.contact.Plane((0.0,), (1.0,)), stiffness=1000.0, onset=0.01)
    >>> system = js.System(net, mass=1.0, forces=(ground, js.Gravity((-10.0,))))
    >>> at_rest = js.equilibrium(system, js.State.from_points(net, [[0.0]]))
    >>> print(ground.depth(at_rest.state).round(5))
    [0.015]
    """

    obstacle: Obstacle
    law: ContactLaw

    def __init__(
        self,
        obstacle: Obstacle,
        stiffness: Numbers,
        damping: Numbers | None = None,
        friction: Numbers | None = None,
        onset: Numbers = 1e-3,
        creep: Numbers = 1e-3,
    ):
        """Check what is given.

        Args:
            obstacle: what nodes are kept out of.
            stiffness: k [N/m]: a number, or (N,) in the user's order. An impact at speed v goes as deep as v sqrt(m / k).
            damping: c [N s/m], a number or (N,); None: no damper.
            friction: mu, a number or (N,); None: no friction. With a damper or friction the matrix of implicit steps is not symmetric, and
                `equilibrium` has no energy to go by: leave both out there.
            onset: w [m], over which the stiffness sets in; 1 mm unless said. Much below the depths reached it is felt as a kink.
            creep: [m/s], below which friction falls to zero; 1 mm/s unless said.
        """
        self.obstacle = kind("obstacle", obstacle, Obstacle, "Plane((0.0, 0.0), (0.0, 1.0))")
        self.law = ContactLaw(stiffness, onset, damping, friction, creep)

    def bind(self, scene: Scene) -> Penalty:
        """Constants in node shape, the obstacle ready."""
        ready = eqx.tree_at(lambda p: p.obstacle, self, self.obstacle.bind(scene.dtype))
        return cast_inexact(ready, scene.dtype)

    def depth(self, state: State) -> Array:
        """How deep each node is inside [m], node shape; negative outside."""
        self.obstacle.check(state.dim)
        return -self.obstacle.distance(state.position, state.time)

    def force(self, state: State) -> Vector:
        """Push, damper and friction [N]."""
        law, d, normal, rate = self._seen(state)
        push = law.stiffness * law.push(-d)
        strength = push
        if law.damping is not None:
            strength = strength - law.damping * law.grip(-d) * (normal.dot(state.velocity) + rate)
        total = strength * normal
        if law.friction is not None:
            along = self._along(state, normal)
            total = total - (law.friction * push * length(normal) * law.drag(length(along))) * along
        return total

    def energy(self, state: State) -> Array | None:
        """Elastic energy, summed [J]; None where the obstacle moves, which feeds energy in."""
        return None if self.obstacle.moves else self._stored(state)

    @property
    def has_potential(self) -> bool:
        """Whether the elastic part is the gradient of an energy that depends on places alone: where the obstacle stands still."""
        return not self.obstacle.moves

    @property
    def is_symmetric(self) -> bool:
        """Whether there is no damper and no friction, whose strength depends on the depth."""
        return self.law.damping is None and self.law.friction is None

    @property
    def can_feed(self) -> bool:
        """Whether the obstacle moves: else damper and friction take energy out."""
        return self.obstacle.moves

    def incremental_potential(self, state: State, dt: Array) -> Array | None:
        """Elastic energy, with the obstacle at the state's time [J]; None with a damper or friction, which have none."""
        return self._stored(state) if self.is_symmetric else None

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """k p' n n' - k p hess d [N/m], the second part clamped where asked; damper and friction change with the place: left out."""
        law, d, normal, _ = self._seen(state)
        stiff = Blocks(dyads=(NodeDyads(jnp.broadcast_to(law.stiffness * law.slope(-d), d.shape), normal),))
        if self.obstacle.is_flat:
            return stiff
        # Each computed once: without the barrier XLA would write every chain of operations anew wherever an entry is read.
        hessian, normal, d = lax.optimization_barrier((curvature(self.obstacle, state.position, state.time), normal, d))
        rows = lax.optimization_barrier(bent(hessian, normal, -law.stiffness * law.push(-d), linearisation))
        return stiff + blocks_of(rows)

    def damping_blocks(self, state: State) -> Blocks | None:
        """c g n n' and the slope of friction [N s/m]."""
        law, d, normal, _ = self._seen(state)
        blocks = Blocks()
        if law.damping is not None:
            blocks = blocks + Blocks(dyads=(NodeDyads(jnp.broadcast_to(law.damping * law.grip(-d), d.shape), normal),))
        if law.friction is not None:
            along = self._along(state, normal)
            speed, limit = length(along), law.friction * law.stiffness * law.push(-d) * length(normal)
            drag = limit * law.drag(speed)
            more = limit * law.drag_slope(speed) - drag
            blocks = blocks + Blocks((isotropic(drag, normal),), (NodeDyads(-drag, unit(normal)), NodeDyads(more, unit(along))))
        return None if self.is_symmetric else blocks

    def stiffness_bound(self, state: State) -> Array:
        """k of every node, whether it touches or not, and what the bend of the surface adds where it does [N/m]."""
        law, d, normal, _ = self._seen(state)
        squared = normal.dot(normal)
        bound = law.stiffness * jnp.where(squared > 1, squared, jnp.ones_like(squared))
        if self.obstacle.is_flat:
            return bound
        rows = curvature(self.obstacle, state.position, state.time)
        size = jnp.sqrt(sum((row.dot(row) for row in rows), start=jnp.zeros_like(d)))
        return bound + law.stiffness * law.push(-d) * size

    def damping_bound(self, state: State) -> Array | None:
        """c of every node, and 2 mu push / creep of those that touch now [N s/m]; None without damper and friction."""
        if self.is_symmetric:
            return None
        law, d, normal, _ = self._seen(state)
        bound = jnp.zeros_like(d)
        if law.damping is not None:
            squared = normal.dot(normal)
            bound = bound + law.damping * jnp.where(squared > 1, squared, jnp.ones_like(squared))
        if law.friction is not None:
            bound = bound + 2 * law.friction * law.stiffness * law.push(-d) * length(normal) / law.creep
        return bound

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the onset."""
        return self.law.rounding(state.position)

    def invalid(self) -> Array:
        """Whether law or obstacle has a constant that its constructor would refuse."""
        bad, of_obstacle = self.law.invalid(), self.obstacle.invalid()
        return bad if of_obstacle is None else bad | of_obstacle

    def _stored(self, state: State) -> Array:
        self.obstacle.check(state.dim)
        law, d = self._law(state), self.obstacle.distance(state.position, state.time)
        return jnp.sum(law.stiffness * law.energy(-d))

    def _seen(self, state: State) -> tuple[ContactLaw, Array, Vector, Array]:
        """The law in node shape; the distance, its gradient and its rate."""
        self.obstacle.check(state.dim)
        return self._law(state), *seen(self.obstacle, state.position, state.time)

    def _law(self, state: State) -> ContactLaw:
        law: Any = cast_inexact(self.law, state.dtype)
        names = [name for name in ("stiffness", "damping", "friction") if getattr(law, name) is not None]
        values = [state.layout.constant(name, getattr(law, name)) for name in names]
        return eqx.tree_at(lambda law: [getattr(law, name) for name in names], law, values)

    def _along(self, state: State, normal: Vector) -> Vector:
        """Velocity along the surface, relative to the obstacle's own [m/s]."""
        velocity = state.velocity
        if self.obstacle.moves:
            velocity = velocity - self.obstacle.velocity(state.position, state.time)
        n = unit(normal)
        return velocity - velocity.dot(n) * n


__all__ = ["Penalty"]
