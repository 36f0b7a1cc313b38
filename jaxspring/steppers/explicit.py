"""Explicit steppers.

    ForwardEuler        x' = x + dt v              v' = v + dt a(x, v)                                       order 1
    SymplecticEuler     v' = v + dt a(x, v)        x' = x + dt v'                    the slides' update      order 1
    VelocityVerlet      x' = x + dt v + dt^2/2 a   v' = v + dt/2 (a + a')            a' = a(x', v + dt a)    order 2
    RungeKutta4         the classical four stages                                                            order 4

The orders hold with damping too. Without velocity-dependent forces, symplectic Euler and Verlet keep a nearby energy for ever, and
Verlet runs backward with a negative dt. Drag is taken at the old velocity (lagged), so it LOWERS the stable step.

With w the highest frequency and c = gamma / m the damping rate, the stable steps are

    ForwardEuler        dt <= c_min / w^2 and 2 / c          SymplecticEuler     dt <= 4 / (c + sqrt(c^2 + 4 w^2))
    VelocityVerlet      dt <= 2 / (c + sqrt(c^2 + w^2))      RungeKutta4         dt <= 2.61 / max(w, c), and sqrt(8) / w if c = 0

Those of symplectic Euler are sharp; Verlet's is sharp for c = 0 and for w = 0 and safe between; Runge-Kutta's uses the smallest
radius of its stability region in the left half plane.

Source: slide "Mass-Spring Forces" for the update of x and v; limits from the characteristic polynomials.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.history import of_springs
from ..numerics import any_lane
from ..state import State
from ..vector import Vector
from .base import Stepper


class ForwardEuler(Stepper):
    """Forward Euler: unstable for undamped springs at every dt; here for contrast."""

    def step(self, system: BoundSystem, state: State, dt: Array, memory: None) -> tuple[State, None]:
        """x + dt v, v + dt a."""
        a = system.acceleration(state)
        return state.moved(state.position + dt * state.velocity, state.velocity + dt * a), None

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """c_min / w^2, and 2 / c."""
        return jnp.minimum(_ratio(damping_floor, squared_frequency), _ratio(jnp.full_like(damping, 2), damping))


class SymplecticEuler(Stepper):
    """Symplectic (semi-implicit) Euler, kick then drift: the slides' update."""

    def step(self, system: BoundSystem, state: State, dt: Array, memory: None) -> tuple[State, None]:
        """v + dt a, then x + dt of the new v."""
        v = state.velocity + dt * system.acceleration(state)
        return state.moved(state.position + dt * v, v), None

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """4 / (c + sqrt(c^2 + 4 w^2))."""
        return _ratio(jnp.full_like(damping, 4), damping + jnp.sqrt(damping * damping + 4 * squared_frequency))


class VelocityVerlet(Stepper):
    """Velocity Verlet. It carries the acceleration, so that a step costs one evaluation of the forces."""

    def init(self, system: BoundSystem, state: State) -> Vector:
        """The acceleration at the start."""
        return system.acceleration(state)

    def step(self, system: BoundSystem, state: State, dt: Array, memory: Vector) -> tuple[State, Vector]:
        """Drift with the old acceleration, kick with the mean of old and new."""
        a = memory
        x = state.position + dt * (state.velocity + (0.5 * dt) * a)
        predicted = system.stage(state.moved(x, state.velocity + dt * a, state.time + dt))
        a_new = system.acceleration(predicted)
        return state.moved(x, state.velocity + (0.5 * dt) * (a + a_new)), a_new

    def after_rules(self, system: BoundSystem, before: State, moved: State, now: State, dt: Array, memory: Vector) -> Vector:
        """The acceleration where the rules have left nodes and springs, made anew where they changed any, or gave commands."""
        if system.is_driven:
            return system.acceleration(now)
        pairs = [*zip(now.position, moved.position, strict=True), *zip(now.velocity, moved.velocity, strict=True)]
        pairs += zip(of_springs(now), of_springs(moved), strict=True)
        is_changed = jnp.any(jnp.stack([jnp.any(a != b) for a, b in pairs]))
        return lax.cond(any_lane(is_changed), lambda: system.acceleration(now), lambda: memory)

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """2 / (c + sqrt(c^2 + w^2))."""
        return _ratio(jnp.full_like(damping, 2), damping + jnp.sqrt(damping * damping + squared_frequency))


class RungeKutta4(Stepper):
    """The classical Runge-Kutta method of order 4: four evaluations of the forces in a step."""

    def step(self, system: BoundSystem, state: State, dt: Array, memory: None) -> tuple[State, None]:
        """x and v by four stages."""

        def slope(fraction: float, dx: Vector | None, dv: Vector | None) -> tuple[Vector, Vector]:
            if dx is None or dv is None:
                stage = state
            else:
                at = state.time + fraction * dt
                stage = system.stage(state.moved(state.position + (fraction * dt) * dx, state.velocity + (fraction * dt) * dv, at))
            return stage.velocity, system.acceleration(stage)

        x1, v1 = slope(0.0, None, None)
        x2, v2 = slope(0.5, x1, v1)
        x3, v3 = slope(0.5, x2, v2)
        x4, v4 = slope(1.0, x3, v3)
        sixth = dt / 6
        x = state.position + sixth * (x1 + 2 * (x2 + x3) + x4)
        v = state.velocity + sixth * (v1 + 2 * (v2 + v3) + v4)
        return state.moved(x, v), None

    def limit(self, squared_frequency: Array, damping: Array, damping_floor: Array) -> Array:
        """2.61 / max(w, c); sqrt(8) / w without damping."""
        frequency = jnp.sqrt(squared_frequency)
        radius = jnp.where(damping > 0, jnp.full_like(damping, 2.61), jnp.full_like(damping, 8**0.5))
        return _ratio(radius, jnp.maximum(frequency, damping))


def _ratio(a: Array, b: Array) -> Array:
    """a / b, infinite where b is zero."""
    is_zero = b == 0
    return jnp.where(is_zero, jnp.full_like(b, jnp.inf), a / jnp.where(is_zero, jnp.ones_like(b), b))
