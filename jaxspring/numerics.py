"""Small numerical tools: guards, and one primitive for linear maps that bring their own transpose.

`linear_call` exists because JAX's `linear_call` cannot be batched and `custom_vjp` cannot be differentiated forward. A map given as
a pair (forward, transpose), each linear in its operand, works here under `jit`, `vmap`, `jvp`, `grad`, `jacfwd` and `hessian`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
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
    out_tree = tree_util.tree_structure(jax.eval_shape(forward, residuals, operand))

    def flat(function, tree_in, *leaves):
        out = function(
            tree_util.tree_unflatten(residual_tree, leaves[: len(residual_leaves)]),
            tree_util.tree_unflatten(tree_in, leaves[len(residual_leaves) :]),
        )
        return tree_util.tree_leaves(out)

    out_leaves = _linear_call.bind(
        *residual_leaves,
        *operand_leaves,
        forward=partial(flat, forward, operand_tree),
        transpose=partial(flat, transpose, out_tree),
        n_residuals=len(residual_leaves),
    )
    return tree_util.tree_unflatten(out_tree, out_leaves)


def _evaluate(*args, forward, transpose, n_residuals):
    return forward(*args)


def _abstract(*args, forward, transpose, n_residuals):
    shapes = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in args]
    return [ShapedArray(out.shape, out.dtype) for out in jax.eval_shape(forward, *shapes)]


def _jvp(primals, tangents, *, forward, transpose, n_residuals):
    residuals, operand = primals[:n_residuals], primals[n_residuals:]
    params = {"forward": forward, "transpose": transpose, "n_residuals": n_residuals}
    out = _linear_call.bind(*primals, **params)
    total: list[Any] = [jnp.zeros_like(o) for o in out]
    if any(type(t) is not ad.Zero for t in tangents[n_residuals:]):
        moved = [ad.instantiate_zeros(t) for t in tangents[n_residuals:]]
        total = _linear_call.bind(*residuals, *moved, **params)
    varying = [i for i in range(n_residuals) if type(tangents[i]) is not ad.Zero]
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
    (size,) = {a.shape[d] for a, d in zip(args, dims, strict=True) if d is not None}
    moved = []
    for i, (a, d) in enumerate(zip(args, dims, strict=True)):
        if d is not None:
            a = jnp.moveaxis(a, d, 0)
        elif i >= n_residuals:  # every operand gets the batch axis, so that the transpose returns one cotangent per lane
            a = jnp.broadcast_to(a, (size, *jnp.shape(a)))
        moved.append(a)
    residual_axes = [None if d is None else 0 for d in dims[:n_residuals]]
    out = _linear_call.bind(
        *moved,
        forward=partial(_over_lanes, forward, tuple(residual_axes)),
        transpose=partial(_over_lanes, transpose, tuple(residual_axes)),
        n_residuals=n_residuals,
    )
    return out, [0] * len(out)


def _over_lanes(function, residual_axes, *leaves):
    in_axes = [*residual_axes, *[0] * (len(leaves) - len(residual_axes))]
    return jax.vmap(function, in_axes=in_axes)(*leaves)


_linear_call = Primitive("jaxspring_linear_call")
_linear_call.multiple_results = True
_linear_call.def_impl(_evaluate)
_linear_call.def_abstract_eval(_abstract)
ad.primitive_jvps[_linear_call] = _jvp
ad.primitive_transposes[_linear_call] = _transpose
batching.primitive_batchers[_linear_call] = _batch
mlir.register_lowering(_linear_call, mlir.lower_fun(_evaluate, multiple_results=True))


def any_lane(flag: Array) -> Array:
    """`flag`, a 0-d bool, and under `vmap` whether it holds in any lane: one value for all lanes.

    A `lax.cond` on it stays a conditional under `vmap`, where one on a value per lane would run both branches.
    """
    return _any_lane.bind(flag)


def _reduce_lanes(args: tuple[Array], dims: tuple[int]) -> tuple[Array, Any]:
    return any_lane(jnp.any(args[0], axis=dims[0])), None


_any_lane = Primitive("jaxspring_any_lane")
_any_lane.def_impl(lambda flag: flag)
_any_lane.def_abstract_eval(lambda flag: ShapedArray(flag.shape, flag.dtype))
batching.primitive_batchers[_any_lane] = _reduce_lanes
mlir.register_lowering(_any_lane, mlir.lower_fun(lambda flag: flag, multiple_results=False))


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
    return linear_call(lambda _, operand: operand, lambda _, cotangent: cotangent, (), tree)


def is_traced(*trees: PyTree) -> bool:
    """Whether any leaf is a tracer: inside `jit`, `grad` or `vmap` of this value."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


__all__ = ["Array", "any_lane", "cast_inexact", "is_traced", "linear_call", "stopped", "tied", "tiny"]
