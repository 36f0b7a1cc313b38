"""Arrays in files are in the user's order: a graph's own numbering of nodes and springs may change from version to version.

What is reordered: a state's node fields, a system's masses and free nodes, and every edge field that says whose it is. Anything else, such
as a load on the nodes or node values that a part of a user's own remembers, is stored as it is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .nodes import Nodes
from .state import State
from .topology.edge_field import EdgeField
from .topology.permutation import Permutation
from .vector import Vector

PyTree = Any
Reorder = Callable[[Permutation, Any], Any]


def outward(tree: PyTree) -> PyTree:
    """Any tree with its nodes and springs in the user's order."""
    return _reordered(tree, lambda permutation, a: a[..., permutation.inverse])


def inward(tree: PyTree) -> PyTree:
    """Any tree that is in the user's order as the library keeps it."""
    return _reordered(tree, lambda permutation, a: a[..., permutation.order])


def _reordered(tree: PyTree, reorder: Reorder) -> PyTree:
    def of_field(node: Any) -> Any:
        return _edge_field(node, reorder) if isinstance(node, EdgeField) else node

    def of_node(node: Any) -> Any:
        if isinstance(node, State):
            node = _with_fields(node, ("position", "velocity", "temperature", "enthalpy"), node.layout.permutation, reorder)
        elif isinstance(node, Nodes):
            node = _with_fields(node, ("mass", "free"), node.net.node_permutation, reorder)
        return jax.tree.map(of_field, node, is_leaf=lambda part: isinstance(part, EdgeField))

    return jax.tree.map(of_node, tree, is_leaf=lambda node: isinstance(node, EdgeField | State | Nodes))


def _edge_field(field: EdgeField, reorder: Reorder) -> EdgeField:
    permutation = None if field.identity is None else field.identity.order
    if permutation is None:
        return field
    families = jax.tree.map(lambda a, p=permutation: _moved(p, a, reorder), field.families)
    return eqx.tree_at(lambda f: f.families, field, families)


def _with_fields(thing: Any, names: tuple[str, ...], permutation: Permutation | None, reorder: Reorder) -> Any:
    if permutation is None:
        return thing
    values = [jax.tree.map(lambda a, p=permutation: _moved(p, a, reorder), getattr(thing, name)) for name in names]
    return eqx.tree_at(lambda t: [getattr(t, name) for name in names], thing, values, is_leaf=lambda a: a is None or isinstance(a, Vector))


def _moved(permutation: Permutation, a: Any, reorder: Reorder) -> Any:
    """One array, where it has an entry for each; a constant of all stays."""
    fits = getattr(a, "ndim", 0) and a.shape[-1] == permutation.order.size
    if isinstance(a, jax.ShapeDtypeStruct) or not fits:
        return a
    return reorder(permutation, a)


__all__ = ["inward", "outward"]
