"""A floor: what has sunk below a plane is put on it.

    s = (x - p) . n < 0:    x' = x - s n                                              back on the plane
                            j  = (1 + e) max(-v . n, 0)                               normal impulse over mass [m/s]
                            v' = v + j n - min(mu j, |v_t|) v_t / |v_t|               Coulomb's friction on the tangential part v_t

Source: projection and friction as usual for particles; slide "Heating and Melting" has constraint surfaces.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from .._checks import as_inexact, has_shape, is_concrete, nonnegative, plane
from ..numerics import tiny
from ..state import State
from ..status import Flag, Status
from ..vector import Vector
from .base import Rule, any_refused


class Floor(Rule):
    """A plane that nothing passes. Belongs to a system's `rules`, last. Held nodes below it are lifted too: place them above.

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

    point: Array
    normal: Array
    friction: Array
    restitution: Array

    def __init__(self, point: Any, normal: Any, friction: Any = 0.0, restitution: Any = 0.0):
        self.point, self.normal = plane(point, normal)
        self.friction, self.restitution = as_inexact("friction", friction), as_inexact("restitution", restitution)
        for name, value in (("friction", self.friction), ("restitution", self.restitution)):
            has_shape(name, value, {"one number": ()})
            nonnegative(name, value, "It would feed energy in.")
        if is_concrete(self.restitution) and self.restitution > 1:
            raise ValueError(f"restitution = {self.restitution} throws nodes back faster than they came. Pass 0 to 1.")

    @property
    def is_contact(self) -> bool:
        """Yes: a node is put back where the step began to carry it too far."""
        return True

    def height(self, state: State) -> Array:
        """(x - p) . n of each node [m], in node shape."""
        if self.point.shape[0] != state.dim:
            raise ValueError(f"the floor has {self.point.shape[0]} coordinates, the positions have {state.dim}.")
        parts = [n * (x - p) for x, p, n in zip(state.position, self._of(self.point, state), self._of(self.normal, state), strict=True)]
        return sum(parts[1:], start=parts[0])

    def update(self, before: State, state: State, dt: Array) -> tuple[State, Status]:
        """Nodes below the plane put on it, without inward speed."""
        s, n, v = self.height(state), self._of(self.normal, state), state.velocity
        zero = jnp.zeros((), s.dtype)
        lift = jnp.maximum(-s, zero)
        inward = -sum((b * a for b, a in zip(n[1:], v.components[1:], strict=True)), start=n[0] * v[0])
        stop = jnp.where(s < 0, jnp.maximum(inward, zero), zero)
        impulse = (1 + self.restitution.astype(s.dtype)) * stop
        along = [a + b * inward for a, b in zip(v, n, strict=True)]
        squared = sum((a * a for a in along[1:]), start=along[0] * along[0])
        is_sliding = squared > tiny(s.dtype)
        speed = jnp.sqrt(jnp.where(is_sliding, squared, jnp.ones_like(squared)))
        brake = jnp.where(is_sliding, jnp.minimum(self.friction.astype(s.dtype) * impulse / speed, jnp.ones_like(s)), zero)
        moved = v.map(lambda a, t, b: a + b * impulse - brake * t, Vector(tuple(along)), Vector(n))
        return state.moved(state.position.map(lambda x, b: x + b * lift, Vector(n)), moved), Status.when(Flag.INVALID, dt < 0)

    def invalid(self) -> Array:
        """Whether a coefficient is one that the constructor refuses."""
        return any_refused(self.friction, self.restitution) | (self.restitution > 1)

    def _of(self, vector: Array, state: State) -> tuple[Array, ...]:
        return tuple(vector.astype(state.dtype))


__all__ = ["Floor"]
