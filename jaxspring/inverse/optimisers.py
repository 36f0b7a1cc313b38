"""Optimisers behind one interface: first-order ones of optax, L-BFGS with a line search, and least squares of optimistix.

An optimiser sees only unconstrained coordinates and an objective. One call of `step` evaluates the objective and says where to go next.
"""

from __future__ import annotations

import abc
import contextlib
import inspect
import math
from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
import optimistix
from jaxtyping import Array

from ..files import leaf_name
from ..numerics import cast_inexact, power_of_two

PyTree = Any
# (free parameters, carried) -> (value or residuals, (carried, info))
Objective = Callable[[PyTree, PyTree], tuple[Any, tuple[PyTree, PyTree]]]


class Evaluation(eqx.Module):
    """What one step of an optimiser found.

    Attributes:
        at: where the objective was evaluated (for least squares: the last accepted point).
        value: the loss there, a 0-d array.
        gradient: its gradient there.
        after: where to go next.
        memory: what the optimiser carries to the next step.
        carried: the auxiliary state that the loss handed on.
        info: what else the loss returned.
        is_done: whether the optimiser itself sees no further progress.
    """

    at: PyTree
    value: Array
    gradient: PyTree
    after: PyTree
    memory: PyTree
    carried: PyTree
    info: PyTree
    is_done: Array


class Optimiser(eqx.Module):
    """How parameters are improved. Abstract; `Adam`, `LBFGS`, `LeastSquares`, or any optax transformation."""

    # Settings that a resumed fit may change; any other is refused there.
    may_change: ClassVar[frozenset[str]] = frozenset()

    @abc.abstractmethod
    def init(self, objective: Objective, free: PyTree, carried: PyTree) -> PyTree:
        """What the optimiser remembers before the first step."""

    @abc.abstractmethod
    def step(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Evaluation:
        """Evaluate the objective at `free`, and choose the next point."""

    def linearised(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> tuple[Array, Array] | None:
        """(R,) residuals where the last step came to and (R, P) their derivatives by the raveled coordinates; None where not known."""
        return None


class Optax(Optimiser):
    """Any gradient transformation of optax, such as `optax.adam(0.05)`; `fit` wraps a bare one in this.

    Those that ask for more than the gradient get it: line searches and whatever reads the loss take `value`, `grad`, `value_fn` (and
    `obj_fn`, the same). Within one iteration a line search holds `carried` fixed.

    Attributes:
        transformation: pass the same object again to avoid a new compilation: optax objects compare by identity.
    """

    transformation: optax.GradientTransformation = eqx.field(static=True)

    def init(self, objective: Objective, free: PyTree, carried: PyTree) -> PyTree:
        """The transformation's own state."""
        with _loose(), _named("init"):
            return self.transformation.init(free)

    def step(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Evaluation:
        """One gradient, one update, with what the update asks of the loss."""
        (value, (new_carried, info)), gradient = _value_and_grad(objective, free, carried)

        def value_at(point: PyTree, obj_fn: Any = None) -> Array:
            # A line search refuses names that value_fn does not take.
            return objective(point, carried)[0]

        def grad_at(point: PyTree, _: Any) -> PyTree:
            return jax.grad(value_at)(point)

        extra = {"value": value, "grad": gradient, "value_fn": value_at, "obj_fn": value_at, "grad_fn": grad_at}
        with _loose(), _named("update"):
            update_with = optax.with_extra_args_support(self.transformation).update
            update, new_memory = update_with(gradient, memory, free, **_asked_for(update_with, extra))
            after = jax.tree.map(lambda p, u: p + u.astype(p.dtype).reshape(p.shape), free, update)
            jax.tree.map(lambda old, new: None, memory, new_memory)  # refused here, by name, where the structure has changed
        return Evaluation(free, value, gradient, after, new_memory, new_carried, info, jnp.zeros((), bool))


class Adam(Optimiser):
    """Adam, with a learning rate that may fall along a cosine. Two of equal settings share a compilation.

    Attributes:
        learning_rate: of the first iteration, in unconstrained coordinates (static).
        b1: decay of the mean gradient per iteration (static).
        decay_over: iterations over which the rate falls; None keeps it (static). A resumed fit may change it, to go on for longer.
        last_fraction: what is left of the rate then (static).
        largest_norm: longer gradients are shortened to this norm; None takes them as they are (static).

    Source: optax.adam, optax.cosine_decay_schedule, optax.clip_by_global_norm.
    """

    may_change: ClassVar[frozenset[str]] = frozenset({"decay_over"})

    learning_rate: float = eqx.field(static=True, default=0.05)
    b1: float = eqx.field(static=True, default=0.9)
    decay_over: int | None = eqx.field(static=True, default=None)
    last_fraction: float = eqx.field(static=True, default=0.05)
    largest_norm: float | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        _expect("learning_rate", self.learning_rate, self.learning_rate > 0, "a positive number")
        _expect("b1", self.b1, 0 <= self.b1 < 1, "zero or more, and less than one")
        _expect("decay_over", self.decay_over, self.decay_over is None or self.decay_over >= 1, "1 or more iterations, or None")
        _expect("last_fraction", self.last_fraction, self.last_fraction >= 0, "zero or more")
        _expect("largest_norm", self.largest_norm, self.largest_norm is None or self.largest_norm > 0, "a positive number, or None")

    def init(self, objective: Objective, free: PyTree, carried: PyTree) -> PyTree:
        """Mean gradient, mean square, count."""
        return self._optax().init(objective, free, carried)

    def step(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Evaluation:
        """One gradient, one update."""
        return self._optax().step(objective, free, memory, carried)

    def _optax(self) -> Optax:
        rate: Any = self.learning_rate
        if self.decay_over:
            rate = optax.cosine_decay_schedule(self.learning_rate, self.decay_over, self.last_fraction)
        adam = optax.adam(rate, b1=self.b1)
        return Optax(adam if self.largest_norm is None else optax.chain(optax.clip_by_global_norm(self.largest_norm), adam))


class LBFGS(Optimiser):
    """Limited-memory BFGS with a zoom line search: several evaluations per iteration, few iterations on smooth losses.

    Within one iteration the line search holds `carried` fixed.

    Attributes:
        memory_size: how many past steps shape the direction (static).
        max_line_search_steps: evaluations in one line search, at most (static).

    Source: optax.lbfgs.
    """

    memory_size: int = eqx.field(static=True, default=10)
    max_line_search_steps: int = eqx.field(static=True, default=20)

    def __check_init__(self):
        for name in ("memory_size", "max_line_search_steps"):
            _expect(name, getattr(self, name), getattr(self, name) >= 1, "1 or more")

    def init(self, objective: Objective, free: PyTree, carried: PyTree) -> PyTree:
        """The state of optax.lbfgs."""
        return self._optax().init(objective, free, carried)

    def step(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Evaluation:
        """One gradient, one line search along the quasi-Newton direction."""
        return self._optax().step(objective, free, memory, carried)

    def _optax(self) -> Optax:
        search = optax.scale_by_zoom_linesearch(max_linesearch_steps=self.max_line_search_steps, initial_guess_strategy="one")
        return Optax(optax.lbfgs(memory_size=self.memory_size, linesearch=search))


class LeastSquares(Optimiser):
    """Levenberg-Marquardt: the loss function returns residuals (an array or a tree of arrays), and half their sum of squares is minimised.

    Parameters count in units of their size at the start (the largest of each array; 1 where all are zero), and residuals in units of
    theirs, so that the damping and the tolerances mean the same whatever the units are.

    Attributes:
        rtol, atol: stop where an accepted step changes parameters and residuals by less (relative and absolute, in those units, static).
        by_reverse_mode: differentiate the residuals in reverse instead of forward mode: cheaper with more parameters than residuals
            (static).

    Source: optimistix.LevenbergMarquardt.
    """

    rtol: float = eqx.field(static=True, default=1e-8)
    atol: float = eqx.field(static=True, default=1e-8)
    by_reverse_mode: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        for name in ("rtol", "atol"):
            _expect(name, getattr(self, name), getattr(self, name) >= 0, "zero or more")

    def init(self, objective: Objective, free: PyTree, carried: PyTree) -> PyTree:
        """Arrays of the solver's state."""
        with _loose():
            units = _Units.of(objective, free, carried)
            state = self._fresh(units.objective(objective), units.inward(free), carried)
            return units, jax.tree.leaves(eqx.filter(state, eqx.is_array))

    def step(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Evaluation:
        """One evaluation; the point moves only where the sum of squares fell."""
        with _loose():
            units, _ = memory
            state = self._state(objective, free, memory, carried)
            solver, options = self._solver()
            at, state, _ = solver.step(units.objective(objective), units.inward(free), carried, options, state, frozenset())
        value = 0.5 * units.residual**2 * jnp.sum(jnp.stack([jnp.sum(r * r) for r in jax.tree.leaves(state.f_info.residual)]))
        gradient = jax.tree.map(lambda g, u: g / u * units.residual**2, state.f_info.compute_grad(), units.free)
        carried, info = state.aux
        at, memory = units.outward(at), (units, jax.tree.leaves(eqx.filter(state, eqx.is_array)))
        return Evaluation(at, value, gradient, at, memory, carried, info, state.terminate)

    @eqx.filter_jit
    def linearised(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> tuple[Array, Array] | None:
        """Those of the last accepted step."""
        with _loose():
            units, _ = memory
            found = self._state(objective, free, memory, carried).f_info
            residual = jnp.concatenate([jnp.ravel(r) for r in jax.tree.leaves(found.residual)]) * units.residual
            columns = jnp.concatenate([jnp.full(jnp.size(p), u) for p, u in zip(*map(jax.tree.leaves, (free, units.free)), strict=True)])
            return residual, found.jac.as_matrix() * (units.residual / columns)[None, :]

    def _state(self, objective: Objective, free: PyTree, memory: PyTree, carried: PyTree) -> Any:
        # The solver's state holds a traced program, compared by identity: only its arrays leave a step, and a fresh state gives the rest.
        units, arrays = memory
        fresh_arrays, program = eqx.partition(self._fresh(units.objective(objective), units.inward(free), carried), eqx.is_array)
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(fresh_arrays), arrays), program)

    def _solver(self) -> tuple[Any, dict[str, Any]]:
        return optimistix.LevenbergMarquardt(self.rtol, self.atol), {"jac": "bwd" if self.by_reverse_mode else "fwd"}

    def _fresh(self, objective: Objective, free: PyTree, carried: PyTree) -> Any:
        solver, options = self._solver()
        residual, aux = jax.eval_shape(objective, free, carried)
        _check_residuals(residual, free)
        state = solver.init(objective, free, carried, options, residual, aux, frozenset())
        # The damping starts as a float of JAX's own width; it must not widen the parameters.
        return eqx.tree_at(lambda s: s.search_state, state, cast_inexact(state.search_state, jax.tree.leaves(free)[0].dtype))


class _Units(eqx.Module):
    """The sizes of parameters and residuals at the start, as powers of two, so that to divide by them rounds nothing.

    Attributes:
        free: one number for each array of parameters.
        residual: the norm of all residuals together.
    """

    free: PyTree
    residual: Array

    @staticmethod
    def of(objective: Objective, free: PyTree, carried: PyTree) -> _Units:
        """Where a fit starts."""
        residual, _ = objective(free, carried)
        largest = jnp.max(jnp.stack([jnp.max(jnp.abs(r), initial=0.0).astype(float) for r in jax.tree.leaves(residual)]))
        dtype = jax.tree.leaves(residual)[0].dtype
        sizes = jax.tree.map(lambda p: _unit(jnp.max(jnp.abs(p), initial=0.0)).astype(p.dtype), free)
        return _Units(sizes, _unit(largest).astype(dtype))

    def inward(self, free: PyTree) -> PyTree:
        """Parameters in units of their sizes."""
        return jax.tree.map(lambda p, u: p / u, free, self.free)

    def outward(self, scaled: PyTree) -> PyTree:
        """Parameters in their own units again."""
        return jax.tree.map(lambda p, u: p * u, scaled, self.free)

    def objective(self, objective: Objective) -> Objective:
        """The same residuals, in their unit, as a function of the parameters in theirs."""

        def of_scaled(scaled: PyTree, carried: PyTree) -> tuple[PyTree, PyTree]:
            residual, aux = objective(self.outward(scaled), carried)
            return jax.tree.map(lambda r: r / self.residual.astype(r.dtype), residual), aux

        return of_scaled


def _unit(size: Array) -> Array:
    """The power of two at or below a size; 1 for zero, and for what is not finite."""
    one = jnp.ones_like(size)
    return power_of_two(jnp.where(jnp.isfinite(size) & (size > 0), size, one))


def as_optimiser(optimiser: Any) -> Optimiser:
    """An `Optimiser`: Adam with a learning rate of 0.05 for None, and optax transformations wrapped.

    Raises:
        TypeError: something else, such as a class or a function that was not called.
    """
    if optimiser is None:
        return Adam()
    if isinstance(optimiser, Optimiser):
        return optimiser
    if isinstance(optimiser, optax.MultiSteps):
        return Optax(optimiser.gradient_transformation())
    if isinstance(optimiser, optax.GradientTransformation):
        return Optax(optimiser)
    is_uncalled = isinstance(optimiser, type) or inspect.isroutine(optimiser)
    what = f"{optimiser.__name__} itself, which was not called" if is_uncalled else f"a {type(optimiser).__name__}"
    raise TypeError(f"optimiser is {what}; expected an optax transformation such as optax.sgd(0.1), or Adam(), LBFGS(), LeastSquares().")


def _expect(name: str, value: Any, is_right: bool, expected: str) -> None:
    """ValueError where a setting is not what it must be; NaN never is."""
    if not is_right or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError(f"{name} = {value}; expected {expected}.")


def _asked_for(update: Callable[..., Any], extra: dict[str, Any]) -> dict[str, Any]:
    """What an update takes by name. Most pass on whatever they get; `grad_fn` goes to those alone that name it."""
    names = inspect.signature(update).parameters
    takes_all = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in names.values())
    return {name: value for name, value in extra.items() if name in names or (takes_all and name != "grad_fn")}


@contextlib.contextmanager
def _named(method: str) -> Iterator[None]:
    """An optimiser's own complaint, with what `fit` gives to it and what else there is."""
    try:
        yield
    except Exception as error:
        raise TypeError(
            f"The optimiser's own {method} failed ({type(error).__name__}: {error}). fit gives it the parameters that are trained, the "
            "gradient of the whole loss, and value, grad, value_fn, obj_fn and grad_fn by name. Optimisers that want other parameters or "
            "arguments, gradients per example, or a state that changes its structure cannot be used. Use Adam(), LBFGS() or, e.g., "
            "optax.adamw(0.01)."
        ) from error


def _check_residuals(residuals: PyTree, free: PyTree) -> None:
    """TypeError where the residuals are no real arrays of the parameters' one type; ValueError where there are none."""
    dtypes = sorted({str(leaf.dtype) for leaf in jax.tree.leaves(free)})
    if len(dtypes) > 1:
        raise TypeError(f"The parameters are of {' and '.join(dtypes)}; least squares needs one type. Cast them, e.g. by astype(float).")
    leaves = jax.tree_util.tree_leaves_with_path(residuals)
    for path, leaf in leaves:
        found = str(getattr(leaf, "dtype", type(leaf).__name__))
        if found != dtypes[0]:
            name = f" at {leaf_name(path)}" if path else ""
            raise TypeError(f"loss returned residuals of {found}{name}, but the parameters are {dtypes[0]}; expected the same. Cast one.")
    if sum(leaf.size for _, leaf in leaves) == 0:
        raise ValueError("loss returned no residuals; expected an array, or a tree of arrays, with at least one entry.")


@contextlib.contextmanager
def _loose() -> Iterator[None]:
    """JAX's ordinary promotion rules: optax and optimistix mix integer counts with floats. Parameters keep their types all the same."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


def _value_and_grad(objective: Objective, free: PyTree, carried: PyTree) -> Any:
    def scalar(point: PyTree) -> Any:
        value, rest = objective(point, carried)
        return one_number(value), rest

    return jax.value_and_grad(scalar, has_aux=True)(free)


def one_number(value: Any) -> Array:
    """What a loss returned as a 0-d array; TypeError where it is not one real floating-point number."""
    advice = "For residuals pass optimiser=LeastSquares() to fit; for more results use its `carried`."
    if not eqx.is_array_like(value):
        what = "nothing (None)" if value is None else f"a {type(value).__name__}"
        raise TypeError(f"loss returned {what}; expected one real number. {advice}")
    if jnp.shape(value) != () or not jnp.issubdtype(jnp.result_type(value), jnp.floating):
        raise TypeError(f"loss returned {jnp.shape(value)} of {jnp.result_type(value)}; expected one real number. {advice}")
    return jnp.asarray(value, jnp.result_type(value))
