"""Which dt? An upper bound of the frequencies gives a step that is surely stable.

    w^2 <= max_i (2 / m_i) sum_j k_ij          Gershgorin's bound of the spectrum of M^-1 K      [1/s^2]
    c   <= max_i gamma_i / m_i                                                                   [1/s]

The bound holds for every shape of the net. On regular meshes it is 1.2 to 1.6 times above the true highest frequency, so the true
limit is that much larger than what `stable_dt` returns.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from ..bound import BoundSystem
from ..state import State
from ..system import System, as_system
from .base import Stepper
from .explicit import SymplecticEuler


def stable_dt(system: System, state: State, stepper: Stepper | None = None) -> Array:
    """Largest dt [s] at which `stepper` is surely stable, infinite where nothing limits it.

    Args:
        system: its forces name their bounds of stiffness and damping.
        state: where position-dependent bounds are taken.
        stepper: `SymplecticEuler()` unless said.

    Returns:
        dt [s], 0-d.

    Raises:
        TypeError: a stepper that does not know its limit.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=1.0, forces=js.Springs(net, 0.5, 1.0))
    >>> print(stable_dt(system, js.State.from_points(net, net.grid())))
    2.0
    """
    stepper = SymplecticEuler() if stepper is None else stepper
    bound = as_system(system).bind(state.checked().dtype)
    limit = dt_limit(bound, bound.own(state), stepper)
    if limit is None:
        raise TypeError(f"{type(stepper).__name__} has no known stability limit (its `limit` returns None).")
    return limit


def dt_limit(system: BoundSystem, state: State, stepper: Stepper) -> Array | None:
    """As `stable_dt`, for a bound system; None for a stepper that does not know its limit."""
    limits = [stepper.limit(*_bounds(system, state, stepper)), *(rule.limit(state) for rule in system.rules or ())]
    known = [limit for limit in limits if limit is not None]
    return functools.reduce(jnp.minimum, known) if known else None


def _bounds(system: BoundSystem, state: State, stepper: Stepper) -> tuple[Array, Array, Array]:
    """Squared frequency, damping rate and its floor, over the free nodes; the damping as far as it is taken at an old velocity."""
    lagged = [effect for effect in system.forces if stepper.lags_damping(effect, state)]
    inverse = 1 / system.mass.astype(state.dtype)
    stiffness = _total(state, (effect.stiffness_bound(state) for effect in system.forces))
    damping = _total(state, (effect.damping_bound(state) for effect in lagged))
    floor = _total(state, (effect.damping_floor(state) for effect in lagged))
    held = system.free_masks(state.dim)
    masks = [jnp.broadcast_to(m, state.position.shape) for m in held if m is not None]
    free = jnp.any(jnp.stack(masks), axis=0) if len(masks) == len(held) else None

    def extreme(rate: Array, reduce: Any, otherwise: float) -> Array:
        rate = jnp.broadcast_to(rate * inverse, state.position.shape)
        return reduce(rate if free is None else jnp.where(free, rate, jnp.full_like(rate, otherwise)))

    return extreme(stiffness, jnp.max, 0.0), extreme(damping, jnp.max, 0.0), extreme(floor, jnp.min, jnp.inf)


def _total(state: State, bounds: Iterable[Array | None]) -> Array:
    """Sum of the bounds that there are, numbers or node arrays."""
    return sum((bound.astype(state.dtype) for bound in bounds if bound is not None), start=jnp.zeros((), state.dtype))
