"""Training some leaves of a system only, and rebuilding the system from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx

PyTree = Any


class Selection(eqx.Module):
    """Puts values back where `select` took them from: `selection(values)` is the whole tree again.

    Attributes:
        tree: the tree, whose other leaves stay as they are.
        where: tree -> the selected part (static).
    """

    tree: PyTree
    where: Callable[[PyTree], Any] = eqx.field(static=True)

    def __call__(self, values: PyTree) -> PyTree:
        """The tree with `values` in the selected places; differentiable in `values`."""
        return eqx.tree_at(self.where, self.tree, values, is_leaf=lambda x: x is None)


def select(tree: PyTree, where: Callable[[PyTree], Any]) -> tuple[Any, Selection]:
    """The part of a tree that is to be trained, and the way back.

    Args:
        tree: a system, or any tree.
        where: function from the tree to one part of it, or a tuple of parts, such as `lambda s: (s.mass, s.forces[0].stiffness)`.

    Returns:
        The selected parts, and a function from new values for them to the whole tree.

    One value used in several places (tied parameters) needs no helper: train the value itself, and build the system from it inside
    the loss, as in `lambda k: energy(js.System(net, 1.0, (js.Springs(net, k), js.DataSprings(image, k))))`.

    >>> part, build = select({"a": 1.0, "b": 2.0}, lambda tree: tree["b"])
    >>> part, build(5.0)
    (2.0, {'a': 1.0, 'b': 5.0})
    """
    return where(tree), Selection(tree, where)
