"""The gradient of what a robot walks, by every weight of its controller, through two hundred steps on the ground."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxspring as js

N_STEPS, N_DIRECTIONS = 200, 10


@pytest.mark.slow
def test_the_gradient_of_a_walk_is_that_of_central_differences():
    """Along ten random directions of all weights together, a closed loop with friction and impacts: within 1e-4 of the largest slope, and
    of each; batched over controllers as one by one.
    """
    robot = js.robot.walking_robot(js.robot.RobotSettings(body=("###", "#.#")))
    weights, restored = ravel_pytree(robot.controller)

    def walked(flat):
        return js.robot.distance(robot, restored(flat), N_STEPS)

    ways = np.random.default_rng(0).normal(size=(N_DIRECTIONS, weights.size))
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    value, gradient = jax.jit(jax.value_and_grad(walked))(weights)
    assert weights.dtype == gradient.dtype == jnp.float64
    h, at = 1e-5, np.asarray(weights)
    ends = np.asarray(jax.jit(jax.vmap(walked))(np.concatenate([at + h * ways, at - h * ways, at[None]])))
    slopes = (ends[:N_DIRECTIONS] - ends[N_DIRECTIONS:-1]) / (2 * h)
    found = ways @ np.asarray(gradient)
    assert ends[-1] == pytest.approx(float(value), abs=1e-12)
    np.testing.assert_allclose(found, slopes, rtol=1e-4)
    assert np.abs(found - slopes).max() < 1e-4 * np.abs(slopes).max()
    # All weights have a say, and the ground was touched: without it the mean of x could not move.
    assert all(bool(jnp.any(leaf != 0)) for leaf in jax.tree.leaves(restored(gradient)))
    assert abs(float(value)) > 1e-4
