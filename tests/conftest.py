"""What every test runs under: 64-bit, strict promotion, one thread for host linear algebra, seeds as fixtures.

Strict is stricter than what a user has. A test that must see JAX as users run it asks for the fixture `user_mode`.
"""

import gc
import os
import signal

# Before NumPy is imported: on few cores the threads of OpenBLAS cost more than they bring (a 300 x 300 Cholesky took 235 ms).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# No figure may open a window.
os.environ.setdefault("MPLBACKEND", "agg")

import hypothesis
import jax
import numpy as np
import pytest

# A job started in the background may ignore Ctrl-C; the tests of interrupted runs, and the processes they start, must not.
signal.signal(signal.SIGINT, signal.default_int_handler)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Compiling inside an example breaks any deadline; a suite that draws new examples each day cannot be bisected.
hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True)
hypothesis.settings.load_profile("repeatable")

SEED = 20260101


def pytest_addoption(parser):
    """`--reversed` runs the last test first."""
    parser.addoption("--reversed", action="store_true", help="run the last test first: what leans on an earlier test's leftovers fails")


def pytest_collection_modifyitems(config, items):
    """The other order, where it was asked for."""
    if config.getoption("--reversed"):
        items.reverse()


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Drop a file's compiled programs after it: each holds pieces of address space, of which Linux gives a process 65,530."""
    yield
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def rng() -> np.random.Generator:
    """A fresh NumPy generator, the same for every test and every order of tests."""
    return np.random.default_rng(SEED)


@pytest.fixture
def key() -> jax.Array:
    """A fresh JAX random key, the same for every test."""
    return jax.random.key(SEED)


@pytest.fixture
def user_mode():
    """JAX as it is out of the box: 32-bit, standard dtype promotion, rank promotion allowed."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def sooner():
    """Programs that run a few times need no optimisation."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(params=["float32", "float64"])
def dtype(request) -> np.dtype:
    """Each of the two precisions in turn, both under the strict flags."""
    return np.dtype(request.param)
