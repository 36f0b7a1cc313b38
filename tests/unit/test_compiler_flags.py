"""The compiler's flags that `docs/scale.md` tells of: results change by rounding alone, and trouble is still told."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxspring as js
from benchmarks import gradient, scenes

PAGE = Path(__file__).resolve().parents[2] / "docs" / "scale.md"


def documented():
    """Name -> value of every flag in the section on flags, as a compilation takes it."""
    section = PAGE.read_text(encoding="utf-8").split("## The compiler's flags")[1].split("\n## ")[0]
    words = {"true": True, "false": False}
    return {name: words.get(value, value) for name, value in re.findall(r"--(xla_\w+)=(\w+)", section)}


@pytest.mark.slow
def test_documented_flags_change_rounding_alone(user_mode):
    """With all of them, positions and gradients in float32 are as near to float64 as they must be, and a run that blows up says so."""
    flags = documented()
    assert flags
    system, state = scenes.sheet(12)
    n_steps, dt = gradient.CHECKED_STEPS, gradient.DT
    function, arrays = scenes.program(system, state, dt, n_steps)
    run = function.lower(*arrays).compile(compiler_options=flags)
    expected = scenes.numpy_positions(system, state, float(dt), n_steps)
    # Rounding of float32, which 30 steps let grow a few times.
    np.testing.assert_allclose(run(*arrays).state.points, expected, rtol=0, atol=10 * np.finfo(np.float32).eps * np.ptp(expected))
    blown_up = run(*arrays[:2], np.float32(50)).status
    assert blown_up.has(js.Flag.NONFINITE)

    function, arrays = scenes.gradient_program(system, state, dt, n_steps)
    found = function.lower(*arrays).compile(compiler_options=flags)(*arrays)
    with jax.enable_x64(True):
        exact, arrays = scenes.gradient_program(*gradient._in_float64(system, state), np.float64(dt), n_steps)
        for a, b in zip(found, exact(*arrays), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * float(np.abs(b).max()))
