"""Pickling: which function of one's own stands in the way, said by name. Pickle itself names the function alone."""

from __future__ import annotations

import pickle
import sys
import types
from typing import Any

import jax

# They store functions by value, and can.
_STORE_ANY_FUNCTION = ("cloudpickle", "dill")


def refuse_local_functions(tree: Any) -> None:
    """Raise PicklingError for a function in a tree that pickle cannot find again by its name: a lambda, or one made in a function.

    Where `cloudpickle` or `dill` are in use nothing is raised.
    """
    if any(name in sys.modules for name in _STORE_ANY_FUNCTION):
        return
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if isinstance(leaf, types.FunctionType) and ("<" in leaf.__qualname__):
            field = jax.tree_util.keystr(path, simple=True, separator="/")
            raise pickle.PicklingError(
                f"{field} is {leaf.__qualname__} of {leaf.__module__}, which pickle cannot find again by its name. Write it as a function "
                f"of a module (def ... at the left margin), or an equinox.Module with __call__. To keep the numbers alone, use "
                f"jaxspring.save, and jaxspring.load with a system built anew."
            )


__all__ = ["refuse_local_functions"]
