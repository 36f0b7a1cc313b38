"""Hard cases H7, H8, H10: does the installed jax compute right numbers, in linear time? Nothing here touches the library.

A failure means: install another jax. The range that the library asks for leaves out the releases known to fail.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

MISCOMPILE = (
    f"jax {jax.__version__} returns wrong numbers from jit(vmap) of a small matrix product (jax issue 39103, seen in 0.10.2 on the CPU). "
    "No result of this installation can be trusted. Install a jax in the range that pyproject.toml names."
)
SLOW_STACKING = (
    f"jax {jax.__version__} takes more than linear time to stack the outputs of a scan (jax issue 40101, seen in 0.11.1). "
    "Long rollouts that save frames would crawl. Install a jax in the range that pyproject.toml names."
)
MATRIX = np.array([[1.0, 0.25, 0.0], [0.0, 2.0, -0.5], [0.75, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("precision", "n_rows"),
    [("float64", 16_384), ("float64", 16_385), ("float32", 16_385), ("float32", 32_768), ("float32", 32_769)],
)
def test_h7_h10_matrix_times_each_row_then_squares(precision, n_rows):
    """Under jit(vmap), a small matrix times each row and then a sum of squares is what NumPy gives, at every row."""
    # Row i is about i / n, never zero: a row of wrong values shows whatever block of rows it comes from.
    rows = ((np.arange(3 * n_rows).reshape(n_rows, 3) + 1) / n_rows).astype(precision)
    matrix = jnp.asarray(MATRIX, precision)
    got = jax.jit(jax.vmap(lambda row: jnp.sum((matrix @ row) ** 2)))(rows)
    expected = np.sum((rows.astype("float64") @ MATRIX.T) ** 2, axis=1)
    np.testing.assert_allclose(got, expected, rtol=1e-12 if precision == "float64" else 1e-5, err_msg=MISCOMPILE)


@pytest.mark.parametrize("n_springs", [16_384, 16_385])
def test_h10_sum_of_squares_of_differences(n_springs):
    """The toolchain's share of H10: squared lengths along a chain, one spring past a power of two, are what NumPy gives."""
    position = np.random.default_rng(n_springs).normal(size=(3, n_springs + 1))
    got = jax.jit(lambda x: sum((axis[1:] - axis[:-1]) ** 2 for axis in x))(tuple(jnp.asarray(axis) for axis in position))
    np.testing.assert_allclose(got, np.sum(np.diff(position, axis=1) ** 2, axis=0), rtol=1e-13, err_msg=MISCOMPILE)


def seconds_to_stack(lengths: tuple[int, ...], n_rounds: int = 9) -> list[float]:
    """Least time of a compiled scan that stacks one float per step, per length; the rounds interleave the lengths."""

    def stacked(start, n):
        return lax.scan(lambda carry, _: (carry * 0.999, carry), start, None, length=n)[1]

    programs = [jax.jit(lambda start, n=n: stacked(start, n)) for n in lengths]
    start = jnp.float32(1.0)
    for program in programs:
        program(start).block_until_ready()
    times = np.full((n_rounds, len(lengths)), np.inf)
    for row in times:
        for column, program in enumerate(programs):
            began = time.perf_counter()
            program(start).block_until_ready()
            row[column] = time.perf_counter() - began
    return times.min(axis=0).tolist()


def test_h8_stacking_in_a_scan_takes_linear_time():
    """Twice the steps, with one float stacked in each, take at most three times as long."""
    short, long = seconds_to_stack((25_000, 50_000))
    assert long / short <= 3, f"{long / short:.2f} times as long for 50,000 steps as for 25,000. {SLOW_STACKING}"
