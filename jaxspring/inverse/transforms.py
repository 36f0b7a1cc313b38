"""Coordinates in which every number is allowed: an optimiser walks freely, and a stiffness stays positive.

A transform is a smooth one-to-one map from all real numbers onto its domain. `fit` optimises the unconstrained number.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import is_concrete
from ..files import leaf_name

PyTree = Any


class Transform(eqx.Module):
    """A map between an allowed value and an unconstrained number. Abstract."""

    @abc.abstractmethod
    def constrain(self, free: Array) -> Array:
        """The allowed value that belongs to an unconstrained number."""

    @abc.abstractmethod
    def free(self, value: Array) -> Array:
        """The unconstrained number that belongs to an allowed value."""

    @abc.abstractmethod
    def allowed(self, value: np.ndarray) -> np.ndarray:
        """Which entries lie in the domain."""

    @property
    @abc.abstractmethod
    def domain(self) -> str:
        """The domain, in words."""


class Identity(Transform):
    """No constraint."""

    def constrain(self, free: Array) -> Array:
        """The number itself."""
        return free

    def free(self, value: Array) -> Array:
        """The number itself."""
        return value

    def allowed(self, value: np.ndarray) -> np.ndarray:
        """Every finite number."""
        return np.isfinite(value)

    @property
    def domain(self) -> str:
        """The domain, in words."""
        return "finite"


class Positive(Transform):
    """Above zero, by its logarithm: equal steps are equal ratios. For stiffnesses, masses, widths.

    >>> print(Positive().constrain(Positive().free(jnp.float32(2.0))))
    2.0
    """

    def constrain(self, free: Array) -> Array:
        """The value exp(u) of the number u."""
        return jnp.exp(free)

    def free(self, value: Array) -> Array:
        """The number log(value)."""
        return jnp.log(value)

    def allowed(self, value: np.ndarray) -> np.ndarray:
        """Above zero and finite."""
        return (value > 0) & np.isfinite(value)

    @property
    def domain(self) -> str:
        """The domain, in words."""
        return "positive"


class SoftPositive(Transform):
    """Above zero, by log(1 + exp(u / scale)) scale: near zero equal steps are ratios, far above it differences.

    Attributes:
        scale: where the one becomes the other, in the parameter's own unit.
    """

    scale: float = eqx.field(static=True, default=1.0)

    def __check_init__(self):
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale = {self.scale}; expected a positive number, in the parameter's unit.")

    def constrain(self, free: Array) -> Array:
        """The soft maximum of the number and zero."""
        return self.scale * jax.nn.softplus(free / self.scale)

    def free(self, value: Array) -> Array:
        """The number log(exp(value / scale) - 1) scale, without overflow."""
        ratio = value / self.scale
        return self.scale * (ratio + jnp.log(-jnp.expm1(-ratio)))

    def allowed(self, value: np.ndarray) -> np.ndarray:
        """Above zero and finite."""
        return (value > 0) & np.isfinite(value)

    @property
    def domain(self) -> str:
        """The domain, in words."""
        return "positive"


class Bounded(Transform):
    """Strictly between two numbers, by the logistic function.

    Attributes:
        low: lower bound, in the parameter's unit.
        high: upper bound.
    """

    low: float = eqx.field(static=True)
    high: float = eqx.field(static=True)

    def __check_init__(self):
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"low = {self.low}, high = {self.high}; expected two finite numbers, low below high.")

    def constrain(self, free: Array) -> Array:
        """The value low + (high - low) / (1 + exp(-u))."""
        return self.low + (self.high - self.low) * jax.nn.sigmoid(free)

    def free(self, value: Array) -> Array:
        """The number log((value - low) / (high - value))."""
        return jnp.log(value - self.low) - jnp.log(self.high - value)

    def allowed(self, value: np.ndarray) -> np.ndarray:
        """Strictly between the bounds."""
        return (value > self.low) & (value < self.high)

    @property
    def domain(self) -> str:
        """The domain, in words."""
        return f"strictly between {self.low} and {self.high}"


def transform_per_leaf(transforms: PyTree, parameters: PyTree) -> tuple[Transform, ...]:
    """The transform of each leaf of `parameters`, in the order of its leaves.

    Args:
        transforms: None (no constraint), one `Transform` for all, or a tree of them that is a prefix of `parameters`. A mapping may
            leave names out, and its keys may be paths: `{"stiffness": Positive()}`, `{"forces/0/stiffness": Positive()}`.
        parameters: what is trained.

    Raises:
        ValueError: a transform is given for a name that `parameters` does not have.
        TypeError: something other than a `Transform`.
    """
    given = {}
    for path, transform in jax.tree_util.tree_leaves_with_path(transforms, is_leaf=lambda x: isinstance(x, Transform)):
        name = leaf_name(path) if path else ""
        if not isinstance(transform, Transform):
            raise TypeError(f"transforms: {name or 'the whole'} is a {type(transform).__name__}; expected a Transform, e.g. Positive().")
        given[name] = transform
    names = [leaf_name(path) for path, _ in jax.tree_util.tree_leaves_with_path(parameters)]
    idle = [name for name in given if not any(_covers(name, leaf) for leaf in names)]
    if idle:
        raise ValueError(f"transforms name {', '.join(idle)}, but what is trained is {', '.join(names)}. Correct the name.")
    return tuple(_closest(given, name) for name in names)


def to_free(transforms: tuple[Transform, ...], parameters: PyTree) -> PyTree:
    """Unconstrained coordinates of every leaf; ValueError naming leaf and index where a value is outside its domain."""
    named, treedef = jax.tree_util.tree_flatten_with_path(parameters)
    for transform, (path, leaf) in zip(transforms, named, strict=True):
        if is_concrete(leaf):
            _check_domain(transform, leaf_name(path), np.asarray(leaf))
    return treedef.unflatten([t.free(leaf) for t, (_, leaf) in zip(transforms, named, strict=True)])


def to_constrained(transforms: tuple[Transform, ...], free: PyTree) -> PyTree:
    """The parameters that belong to unconstrained coordinates."""
    leaves, treedef = jax.tree.flatten(free)
    return treedef.unflatten([t.constrain(leaf) for t, leaf in zip(transforms, leaves, strict=True)])


def _covers(name: str, leaf: str) -> bool:
    return not name or leaf == name or leaf.startswith(f"{name}/")


def _closest(given: Mapping[str, Transform], leaf: str) -> Transform:
    fitting = [name for name in given if _covers(name, leaf)]
    return given[max(fitting, key=len)] if fitting else Identity()


def _check_domain(transform: Transform, name: str, value: np.ndarray) -> None:
    bad = np.argwhere(~transform.allowed(value))
    if len(bad):
        index = tuple(int(i) for i in bad[0])
        place = f"{name}[{', '.join(map(str, index))}]" if index else name
        raise ValueError(
            f"{place} = {value[index]}, but {transform} takes only values that are {transform.domain} "
            f"({len(bad)} of {value.size} are not). Unchecked, the fit would start from NaN. "
            "Start from a value inside, or choose another transform."
        )
