"""Conditions that end an adaptive run, written on states.

A condition is a function of (time, state, system) that returns a boolean or a number. diffrax watches for the first step at whose end a
boolean holds or a number has changed its sign, and finds the zero on the step's own interpolation.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array


class Condition(eqx.Module):
    """One condition, as diffrax calls it.

    Attributes:
        function: the user's: (time, state, system), or (time, state). One that names `terms`, as diffrax's own do, is called as diffrax
            calls it, on positions and velocities.
        as_state: (time, y, args) -> `State`.
        side: sign that a number which is zero at the start takes there, in its own type; None for booleans and before it is known.
    """

    function: Callable[..., Any]
    as_state: Callable[[Any, Any, Any], Any]
    side: Array | None = None

    def __call__(
        self,
        t: Any,
        y: Any,
        args: Any,
        terms: Any = None,
        solver: Any = None,
        t0: Any = None,
        t1: Any = None,
        dt0: Any = None,
        saveat: Any = None,
        stepsize_controller: Any = None,
        max_steps: Any = None,
    ) -> Any:
        """The value at one time. diffrax names its arguments, and adds its options."""
        names = inspect.signature(self.function).parameters
        if "terms" in names:
            options = {"t0": t0, "t1": t1, "dt0": dt0, "saveat": saveat, "max_steps": max_steps}
            value = self.function(t, y, args, terms=terms, solver=solver, stepsize_controller=stepsize_controller, **options)
        else:
            given = (t, self.as_state(t, y, args), args.system)
            value = self.function(*given[: _n_positional(names)])
        value = _checked(self.function, value)
        if self.side is None:
            return value
        return jnp.where((value == 0) & (t == t0), self.side, value)


def on_states(event: Any, as_state: Callable[[Any, Any, Any], Any], flow: Callable[[Any, Any, Any], Any], start: Any, t1: Any) -> Any:
    """The event with its conditions on states.

    Args:
        event: a diffrax event.
        as_state: (time, y, args) -> `State`.
        flow: (time, y, args) -> dy/dt.
        start: (time, y, args) at the start.
        t1: time of the end, for the direction of time.

    Raises:
        ValueError: a boolean beside a root finder in another precision than JAX's own.
    """
    conditions = jax.tree.map(lambda f: _starting(Condition(f, as_state), flow, start, t1), event.cond_fn, is_leaf=callable)
    booleans = [c.side is None for c in jax.tree.leaves(conditions, is_leaf=lambda leaf: isinstance(leaf, Condition))]
    own, needed = start[0].dtype, jnp.result_type(float)
    if event.root_finder is not None and any(booleans) and own != needed:
        raise ValueError(
            f"With a root finder and a boolean condition, diffrax needs the run in {needed}, and it is in {own}. "
            "Make the condition a number, such as its distance from zero, leave the root finder out, or build the state in that type."
        )
    return eqx.tree_at(lambda e: e.cond_fn, event, conditions, is_leaf=callable)


def _starting(condition: Condition, flow: Callable[[Any, Any, Any], Any], start: Any, t1: Any) -> Condition:
    """The condition, knowing to which side of zero a number goes that is zero at the start: leaving is no crossing."""
    t0, y0, args = start
    if "terms" in inspect.signature(condition.function).parameters:
        return condition

    def at(t: Any, y: Any) -> Any:
        return condition(t, y, args)

    if not jnp.issubdtype(jax.eval_shape(at, t0, y0).dtype, jnp.floating):
        return condition

    def slope(t: Any, y: Any) -> Any:
        return jax.jvp(at, (t, y), (jnp.ones_like(t), flow(t, y, args)))[1]

    rate, bend = jax.jvp(slope, (t0, y0), (jnp.ones_like(t0), flow(t0, y0, args)))
    forward = jnp.sign(t1 - t0).astype(rate.dtype)
    least = jnp.asarray(float(jnp.finfo(rate.dtype).tiny), rate.dtype)
    # What is let go at rest leaves by its acceleration, either way in time.
    side = jnp.where(rate == 0, jnp.sign(bend), jnp.sign(rate) * forward)
    return Condition(condition.function, condition.as_state, lax.stop_gradient(least * side))


def _n_positional(names: Any) -> int:
    """How many of (time, state, system) a function takes by place."""
    kinds = [p.kind for p in names.values()]
    if inspect.Parameter.VAR_POSITIONAL in kinds:
        return 3
    by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    n = sum(kind in by_place for kind in kinds)
    if n < 2:
        raise TypeError(f"an event's condition takes {n} arguments; expected cond_fn(time, state, system) or cond_fn(time, state).")
    return min(n, 3)


def _checked(function: Any, value: Any) -> Any:
    """The value as an array; TypeError where it is not one real number or boolean."""
    name = getattr(function, "__name__", type(function).__name__)
    if not eqx.is_array_like(value):
        raise TypeError(f"the event's condition {name} returned a {type(value).__name__}; expected one boolean or one real number.")
    dtype = jnp.result_type(value)
    if jnp.shape(value) != () or not (jnp.issubdtype(dtype, jnp.floating) or dtype == jnp.bool_):
        raise TypeError(
            f"the event's condition {name} returned {jnp.shape(value)} of {dtype}; expected one boolean or one real number, such as "
            "state.position.y[0] (the height of node 0) or jnp.min(state.position.y)."
        )
    # diffrax joins the number with a Python zero, which has JAX's own width: a float32 run where x64 is on would not match.
    return jnp.asarray(value, dtype) if dtype == jnp.bool_ else jnp.asarray(value, dtype).astype(float)
