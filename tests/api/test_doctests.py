"""The examples in the docstrings run as printed, under JAX's own defaults."""

import doctest
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import source

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.mark.parametrize("name", source.modules())
def test_docstring_examples(name, user_mode, tmp_path, monkeypatch):
    """Every `>>>` line gives what stands below it; `js`, `jax`, `jnp` and `np` need no import there."""
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(name)
    known = {"js": importlib.import_module("jaxspring"), "jax": jax, "jnp": jnp, "np": np}
    report = []
    runner = doctest.DocTestRunner(optionflags=OPTIONS, verbose=False)
    for example in doctest.DocTestFinder(exclude_empty=True).find(module, name, extraglobs=known):
        runner.run(example, out=report.append)
    assert runner.failures == 0, "".join(report)
