"""One iteration of a fit as one compiled program, and the checks around it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import as_inexact
from ..files import leaf_name
from ..forces.base import Force
from ..system import System
from .optimisers import Optimiser
from .transforms import Transform, to_constrained

PyTree = Any


class GradientWarning(UserWarning):
    """A parameter that is trained does not influence the loss at the start."""


class Objective(eqx.Module):
    """The loss in unconstrained coordinates: (free, carried) -> (value, (carried, info)).

    Attributes:
        loss: the user's function.
        rest: the leaves that are not trained.
        transforms: one per trained leaf.
        has_carried: whether `loss` takes and returns auxiliary state (static).
    """

    loss: Callable[..., Any]
    rest: PyTree
    transforms: tuple[Transform, ...]
    has_carried: bool = eqx.field(static=True)

    def parameters(self, free: PyTree) -> PyTree:
        """The user's parameters that belong to unconstrained coordinates."""
        return eqx.combine(to_constrained(self.transforms, free), self.rest)

    def __call__(self, free: PyTree, carried: PyTree) -> tuple[Any, tuple[PyTree, PyTree]]:
        """The user's loss, with what it carries cast to the types that came in."""
        if not self.has_carried:
            return self.loss(self.parameters(free)), (None, None)
        answer = self.loss(self.parameters(free), carried)
        try:
            value, (after, info) = answer
        except (TypeError, ValueError):
            raise TypeError(
                "With `carried`, loss must return (value, (carried, info)); return None for an info that is not there."
            ) from None
        return value, (_same_shapes(carried, after), jax.tree.map(jax.lax.stop_gradient, eqx.filter(info, eqx.is_array_like)))


class Checks(eqx.Module):
    """What the host needs to know of an iteration.

    Attributes:
        value: the loss.
        gradient_norm: Euclidean norm of its gradient.
        is_nonfinite: whether either is NaN or infinite.
        is_invalid: whether a constructor would refuse the parameters.
        bad_gradients: per leaf, whether its gradient is NaN or infinite.
        zeros: tree of the parameters with booleans, where the gradient is exactly zero.
        is_done: whether the optimiser sees no further progress.
    """

    value: Array
    gradient_norm: Array
    is_nonfinite: Array
    is_invalid: Array
    bad_gradients: Array
    zeros: PyTree
    is_done: Array


class Report(eqx.Module):
    """What one iteration hands to the host: see `Evaluation`."""

    at: PyTree
    after: PyTree
    memory: PyTree
    carried: PyTree
    info: PyTree
    checks: Checks


@eqx.filter_jit
def iterate(objective: Objective, optimiser: Optimiser, free: PyTree, memory: PyTree, carried: PyTree) -> Report:
    """Loss, gradient, update and checks, in one program."""
    done = optimiser.step(objective, free, memory, carried)
    leaves = jax.tree.leaves(done.gradient)
    # Scaled before it is squared: the norm of a finite gradient is finite.
    largest = jnp.max(jnp.stack([jnp.max(jnp.abs(g), initial=0).astype(done.value.dtype) for g in leaves]))
    scale = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    norm = scale * jnp.sqrt(sum(jnp.sum((g.astype(scale.dtype) / scale) ** 2) for g in leaves))
    bad_gradients = jnp.stack([~jnp.all(jnp.isfinite(g)) for g in leaves])
    is_nonfinite = ~jnp.isfinite(done.value) | jnp.any(bad_gradients)
    zeros = jax.tree.map(lambda g: g == 0, done.gradient)
    bad = [invalid for _, invalid in invalid_effects(objective.parameters(done.at))]
    is_invalid = jnp.any(jnp.stack(bad)) if bad else jnp.zeros((), bool)
    checks = Checks(done.value, norm, is_nonfinite, is_invalid, bad_gradients, zeros, done.is_done)
    memory = jax.tree.map(_keep_type, memory, done.memory)
    return Report(done.at, jax.tree.map(_keep_type, free, done.after), memory, done.carried, done.info, checks)


@eqx.filter_jit
def first_memory(objective: Objective, optimiser: Optimiser, free: PyTree, carried: PyTree) -> PyTree:
    """What the optimiser remembers before the first iteration."""
    return jax.tree.map(lambda a: jnp.asarray(a, a.dtype), optimiser.init(objective, free, carried))


def prepare(parameters: PyTree) -> tuple[PyTree, PyTree]:
    """Trained leaves (inexact arrays, with numbers and NumPy arrays converted) and the rest.

    Raises:
        ValueError: there is nothing to train.
        TypeError: half precision, complex numbers.
    """

    def convert(path: Any, leaf: Any) -> Any:
        is_number = isinstance(leaf, (int, float)) and not isinstance(leaf, bool)
        if is_number or (isinstance(leaf, (np.ndarray, np.generic, jax.Array)) and jnp.issubdtype(leaf.dtype, jnp.inexact)):
            return as_inexact(leaf_name(path), leaf)
        return leaf

    trained, rest = eqx.partition(jax.tree_util.tree_map_with_path(convert, parameters), eqx.is_inexact_array)
    if not any(leaf.size for leaf in jax.tree.leaves(trained)):
        raise ValueError("parameters hold no floating-point array, so that there is nothing to train. Convert integers to floats.")
    return trained, rest


def invalid_effects(parameters: PyTree) -> list[tuple[str, Array]]:
    """Name of each force and mass in a tree, and whether its constructor would refuse it now."""
    found = []

    def is_physical(x: Any) -> bool:
        return isinstance(x, (System, Force))

    for path, thing in jax.tree_util.tree_leaves_with_path(parameters, is_leaf=is_physical):
        prefix = leaf_name(path) if path else ""
        if isinstance(thing, System):
            found.append((f"{prefix}.mass", ~jnp.all(thing.mass > 0)))
            found += [(f"{prefix}.forces[{i}] ({type(f).__name__})", f.invalid()) for i, f in enumerate(thing.forces)]
        elif isinstance(thing, Force):
            found.append((f"{prefix} ({type(thing).__name__})", thing.invalid()))
    return [(name.lstrip(". "), bad) for name, bad in found if bad is not None]


def refuse_invalid(parameters: PyTree) -> None:
    """ValueError naming the first force or mass that a constructor would refuse."""
    for name, bad in invalid_effects(parameters):
        if bool(bad):
            raise ValueError(f"{name} has a constant that is NaN or of the wrong sign at the start of the fit. Correct it before fitting.")


def warn_of_zero_gradients(zeros: PyTree) -> None:
    """GradientWarning naming the leaves whose gradient is exactly zero at the first iteration."""
    idle = [leaf_name(path) for path, zero in jax.tree_util.tree_leaves_with_path(zeros) if zero.size and np.all(zero)]
    if idle:
        warnings.warn(
            f"The gradient with respect to {', '.join(idle)} is exactly zero at the first iteration: the loss does not depend on it there, "
            "or a stop_gradient, a clip or an integer cuts the path. Leave it out of `parameters`, or look for the cut.",
            GradientWarning,
            stacklevel=5,
        )


def _keep_type(old: Any, new: Any) -> Any:
    return new.astype(old.dtype) if eqx.is_array(old) else new


def _same_shapes(before: PyTree, after: PyTree) -> PyTree:
    """`after` with the types of `before`, not differentiated; TypeError where structure or shapes changed."""
    if jax.tree.structure(before) != jax.tree.structure(after):
        raise TypeError(
            f"loss was given carried = {jax.tree.structure(before)} and returned {jax.tree.structure(after)}; expected the same."
        )

    def keep(path: Any, old: Any, new: Any) -> Any:
        if not eqx.is_array(old):
            return old
        if jnp.shape(new) != old.shape or jnp.result_type(new) != old.dtype:
            raise TypeError(
                f"loss was given carried {leaf_name(path)} of shape {old.shape} and {old.dtype}, and returned {jnp.shape(new)} of "
                f"{jnp.result_type(new)}. Every iteration would compile anew; keep shape and type."
            )
        return jax.lax.stop_gradient(jnp.asarray(new, old.dtype))

    return jax.tree_util.tree_map_with_path(keep, before, after)
