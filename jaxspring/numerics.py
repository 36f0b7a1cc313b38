"""Small numerical tools: guards, and one primitive for linear maps that bring their own transpose.

`linear_call` exists because JAX's `linear_call` cannot be batched and `custom_vjp` cannot be differentiated forward. A map given as
a pair (forward, transpose), each linear in its operand, works here under `jit`, `vmap`, `jvp`, `grad`, `jacfwd` and `hessian`.

This is the one module that reads `jax.extend` and `jax.interpreters`, which promise nothing from one version of JAX to the next:
other modules make their primitives with `new_primitive`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import tree_util
from jax.core import ShapedArray, Tracer
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

PyTree = Any


def tiny(dtype: Any) -> Any:
    """Smallest normal positive number of `dtype`: a squared length below it counts as zero.

    >>> print(tiny("float32"))
    1.1754944e-38
    """
    return jnp.finfo(dtype).tiny


def linear_call(
    forward: Callable[[PyTree, PyTree], PyTree], transpose: Callable[[PyTree, PyTree], PyTree], residuals: PyTree, operand: PyTree
) -> PyTree:
    """Apply `forward(residuals, operand)`, a map linear in `operand` whose transpose is `transpose(residuals, cotangent)`.

    Reverse mode calls `transpose`, never differentiates `forward` in its operand. Derivatives with respect to the residuals are
    taken by JAX. Neither function may close over a traced value: pass it in `residuals`.
    """
    residual_leaves, residual_tree = tree_util.tree_flatten(residuals)
    operand_leaves, operand_tree = tree_util.tree_flatten(operand)
    leaves = [jnp.asarray(leaf) for leaf in (*residual_leaves, *operand_leaves)]
    there = _Flat(*_taken_apart(forward), residual_tree, operand_tree)
    out_tree, _ = _outcome(there, leaves)
    back = _Flat(*_taken_apart(transpose), residual_tree, out_tree)
    return tree_util.tree_unflatten(out_tree, _linear_call.bind(*leaves, forward=there, transpose=back, n_residuals=len(residual_leaves)))


@dataclass(frozen=True)
class _Flat:
    """A function of residuals and operand as one of their leaves; equal to another with the same function, arguments and trees."""

    function: Callable[..., PyTree]
    fixed: tuple[Any, ...]
    residual_tree: Any
    operand_tree: Any

    def tree(self, *leaves: Array) -> PyTree:
        """What the function makes of these leaves."""
        n = self.residual_tree.num_leaves
        residuals = tree_util.tree_unflatten(self.residual_tree, leaves[:n])
        return self.function(*self.fixed, residuals, tree_util.tree_unflatten(self.operand_tree, leaves[n:]))

    def __call__(self, *leaves: Array) -> list[Array]:
        return tree_util.tree_leaves(self.tree(*leaves))


@dataclass(frozen=True)
class _Lanes:
    """A function of leaves for every lane of a batch; None is the axis of what all lanes share."""

    function: _Flat | _Lanes
    residual_axes: tuple[int | None, ...]

    def tree(self, *leaves: Array) -> PyTree:
        """What the function makes of these leaves, lanes first."""
        return jax.vmap(self.function.tree, in_axes=[*self.residual_axes, *[0] * (len(leaves) - len(self.residual_axes))])(*leaves)

    def __call__(self, *leaves: Array) -> list[Array]:
        return tree_util.tree_leaves(self.tree(*leaves))


def _taken_apart(function: Callable[..., PyTree]) -> tuple[Callable[..., PyTree], tuple[Any, ...]]:
    """The function under a `partial`, and what it was given: partials are equal to themselves alone."""
    return (function.func, function.args) if isinstance(function, partial) else (function, ())


def _outcome(function: _Flat | _Lanes, args: Sequence[Any]) -> tuple[Any, list[ShapedArray]]:
    """The tree and the shapes of what a function makes of leaves like these: JAX asks for them again and again."""
    like = tuple((a.shape, a.dtype) for a in args)
    try:
        hash(function)
    except TypeError:
        return _outcome_anew(function, like)
    return _outcome_once(function, like, str(jax.dtypes.canonicalize_dtype("float64")))


def _outcome_anew(function: _Flat | _Lanes, like: tuple[Any, ...], widest: str | None = None) -> tuple[Any, list[ShapedArray]]:
    """The same by tracing; `widest` is the largest floating type that JAX allows, by which cached results are told apart."""
    out = jax.eval_shape(function.tree, *(jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in like))
    leaves, tree = tree_util.tree_flatten(out)
    return tree, [ShapedArray(leaf.shape, leaf.dtype) for leaf in leaves]


_outcome_once = lru_cache(maxsize=1024)(_outcome_anew)


def _evaluate(*args, forward, transpose, n_residuals):
    return forward(*args)


def _abstract(*args, forward, transpose, n_residuals):
    return _outcome(forward, args)[1]


def _jvp(primals, tangents, *, forward, transpose, n_residuals):
    residuals, operand = primals[:n_residuals], primals[n_residuals:]
    params = {"forward": forward, "transpose": transpose, "n_residuals": n_residuals}
    out = _linear_call.bind(*primals, **params)
    total: list[Any] = [jnp.zeros_like(o) for o in out]
    if not all(is_zero_tangent(t) for t in tangents[n_residuals:]):
        moved = [ad.instantiate_zeros(t) for t in tangents[n_residuals:]]
        total = _linear_call.bind(*residuals, *moved, **params)
    varying = [i for i in range(n_residuals) if not is_zero_tangent(tangents[i])]
    if varying:

        def of_residuals(*some):
            full = list(residuals)
            for i, value in zip(varying, some, strict=True):
                full[i] = value
            return forward(*full, *operand)

        _, by_residuals = jax.jvp(of_residuals, [residuals[i] for i in varying], [tangents[i] for i in varying])
        total = [ad.add_tangents(a, b) for a, b in zip(total, by_residuals, strict=True)]
    return out, total


def _transpose(cotangents, *args, forward, transpose, n_residuals):
    residuals, operand = args[:n_residuals], args[n_residuals:]
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    out = _linear_call.bind(*residuals, *cotangents, forward=transpose, transpose=forward, n_residuals=n_residuals)
    wanted = [o if ad.is_undefined_primal(a) else None for a, o in zip(operand, out, strict=True)]
    return [None] * n_residuals + wanted


def _batch(args, dims, *, forward, transpose, n_residuals):
    args, residual_axes = lanes_first(args, dims, n_residuals)
    out = _linear_call.bind(
        *args,
        forward=_Lanes(forward, residual_axes),
        transpose=_Lanes(transpose, residual_axes),
        n_residuals=n_residuals,
    )
    return out, [0] * len(out)


def lanes_first(args: Sequence[Array], dims: Sequence[int | None], n_shared: int) -> tuple[list[Array], tuple[int | None, ...]]:
    """What a primitive's rule for `vmap` is given, with the batch axis in front: the arguments, and the axes of the first `n_shared`.

    Those may be shared by all lanes (axis None); every later argument gets a batch axis, so that each lane has its own.
    """
    (size,) = {a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None}
    moved = [a if d is None else jnp.moveaxis(a, d, 0) for a, d in zip(args, dims, strict=True)]
    own = [jnp.broadcast_to(a, (size, *jnp.shape(a))) if d is None else a for a, d in zip(moved, dims, strict=True)]
    return moved[:n_shared] + own[n_shared:], tuple(None if d is None else 0 for d in dims[:n_shared])


def new_primitive(name: str, evaluate: Any, abstract: Any, batch: Any, jvp: Any = None, transpose: Any = None) -> Primitive:
    """A primitive with several results.

    Args:
        name: in programs.
        evaluate: (*args, **params) -> results, in terms of JAX: what the primitive computes.
        abstract: the same for shapes.
        batch: (args, dims, **params) -> results, dims; a dim is None where an argument has no batch axis.
        jvp: (primals, tangents, **params) -> results, their tangents; None where it has no derivative.
        transpose: (cotangents, *args, **params) -> cotangents.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(evaluate)
    primitive.def_abstract_eval(abstract)
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(evaluate, multiple_results=True))
    if jvp is not None:
        ad.primitive_jvps[primitive] = jvp
    if transpose is not None:
        ad.primitive_transposes[primitive] = transpose
    return primitive


def filled(tangents: PyTree, primals: PyTree) -> PyTree:
    """Tangents as `eqx.filter_custom_jvp` gives them, with zeros for every None."""
    return jax.tree.map(_zero_where_none, tangents, primals, is_leaf=lambda leaf: leaf is None)


def _zero_where_none(tangent: Any, primal: Any) -> Any:
    return jax.tree.map(jnp.zeros_like, primal) if tangent is None else tangent


def is_zero_tangent(tangent: Any) -> bool:
    """Whether a rule was given no tangent for an argument."""
    return type(tangent) is ad.Zero


_linear_call = new_primitive("jaxspring_linear_call", _evaluate, _abstract, _batch, _jvp, _transpose)


def any_lane(flag: Array) -> Array:
    """`flag`, a 0-d bool, and under `vmap` whether it holds in any lane: one value for all lanes.

    A `lax.cond` on it stays a conditional under `vmap`, where one on a value per lane would run both branches.
    """
    return _any_lane.bind(flag)[0]


def _reduce_lanes(args: tuple[Array], dims: tuple[int]) -> tuple[list[Array], list[None]]:
    return [any_lane(jnp.any(args[0], axis=dims[0]))], [None]


_any_lane = new_primitive("jaxspring_any_lane", lambda flag: [flag], lambda flag: [ShapedArray(flag.shape, flag.dtype)], _reduce_lanes)


def power_of_two(size: Array) -> Array:
    """The power of two at or below each number, and 1/2 for zero: what is divided by it keeps all its digits. A constant to derivatives."""
    _, exponent = jnp.frexp(jax.lax.stop_gradient(size))
    return jnp.ldexp(jnp.ones_like(size), exponent - 1)


def cast_inexact(tree: PyTree, dtype: Any) -> PyTree:
    """Cast every inexact array leaf of `tree` to `dtype`, leaving integers, booleans and non-arrays alone."""

    def cast(leaf: Any) -> Any:
        is_inexact = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jnp.inexact)
        return leaf.astype(dtype) if is_inexact and leaf.dtype != dtype else leaf

    return jax.tree.map(cast, tree)


def stopped(tree: PyTree) -> PyTree:
    """`tree` with the derivative of every inexact array stopped."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_inexact_array(leaf) else leaf, tree)


def tied(tree: PyTree) -> PyTree:
    """`tree`, every leaf of which counts as varying where one does: JAX's linear solve cannot be transposed for part of a right side."""
    return linear_call(_operand, _operand, (), tree)


def _operand(_: Any, operand: PyTree) -> PyTree:
    return operand


def is_traced(*trees: PyTree) -> bool:
    """Whether any leaf is a tracer: inside `jit`, `grad` or `vmap` of this value."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


__all__ = [
    "Array",
    "any_lane",
    "cast_inexact",
    "filled",
    "is_traced",
    "is_zero_tangent",
    "lanes_first",
    "linear_call",
    "new_primitive",
    "power_of_two",
    "stopped",
    "tied",
    "tiny",
]
