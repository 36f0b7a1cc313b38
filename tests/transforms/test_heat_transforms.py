"""Heat under transformations: one program for all values, batches equal to loops, no scatter, no cost where there is none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests.reference import Traces

NET = js.lattice((3, 4))
T0 = np.linspace(300, 400, 12)


def end(scheme, conductivity, melting, wall, traces=None):
    """Temperatures after five steps over a hot plane."""
    if traces is not None:
        traces()
    plane = js.thermal.HotPlane((0.0, 0.0), (0.0, 1.0), wall, 5.0, 0.1, reach=0.5, fade=1.0)
    heat = js.Heat(NET, 1.0, js.thermal.conductances(NET, conductivity, 1.0), scheme, plane, latent=js.thermal.LatentHeat(melting, 10.0))
    start = js.State.from_points(NET, NET.grid(), temperature=T0)
    return js.rollout(js.System(NET, 1.0, rules=heat), start, js.Still(), 0.2, 5).state.temperature


@pytest.mark.slow
@pytest.mark.parametrize(
    "scheme",
    [js.thermal.ExplicitHeat(), js.thermal.BackwardEulerHeat(), js.thermal.SplitHeat(), js.thermal.SymmetricSplitHeat()],
    ids=lambda s: type(s).__name__,
)
def test_traced_once_and_batched(scheme):
    """Three sets of constants share one program, and a batch of them gives what they give one by one, to 1e-6 of a kelvin."""
    traces = Traces()
    single = jax.jit(lambda c, m, w: end(scheme, c, m, w, traces))
    sets = [(1.0, 340.0, 500.0), (0.5, 350.0, 600.0), (0.8, 330.0, 300.0)]
    loop = [single(*(jnp.asarray(v) for v in values)) for values in sets]
    assert traces.count == 1
    batch = jax.jit(jax.vmap(lambda c, m, w: end(scheme, c, m, w)))(*jnp.asarray(sets).T)
    np.testing.assert_allclose(batch, jnp.stack(loop), atol=1e-6)


@pytest.mark.slow
def test_no_scatter():
    """The gradient through implicit steps with latent heat holds no scatter, by conductivities in the user's order."""
    program = jax.jit(jax.grad(lambda c: jnp.sum(end(js.thermal.BackwardEulerHeat(), c, 340.0, 500.0)))).lower(jnp.ones(12))
    assert "scatter" not in program.as_text()


def test_the_plane_heats_by_its_place():
    """With a fade the heat has a derivative by the position of the nodes: that of the ramp; without one, zero."""

    def heat_in(height, fade):
        plane = js.thermal.HotPlane((0.0, 0.0), (0.0, 1.0), 500.0, 5.0, 0.1, reach=0.5, fade=fade)
        state = js.State.from_points(NET, jnp.full((12, 2), height), temperature=300.0)
        return jnp.sum(plane.power(state, state.temperature))

    slope = jax.grad(heat_in)
    assert float(slope(jnp.asarray(0.7), jnp.asarray(1.0))) == pytest.approx(-12 * 5.0 * 0.1 * 200.0)
    assert float(slope(jnp.asarray(0.2), jnp.asarray(0.0))) == 0.0


def test_still_nodes_stay():
    """`Still` moves nothing, keeps velocities and lets time pass."""
    start = js.State.from_points(NET, NET.grid(), np.ones((12, 2)))
    system = js.System(NET, 1.0, js.Gravity([0.0, -9.81]))
    state = js.rollout(system, start, js.Still(), 0.5, 4).state
    np.testing.assert_array_equal(state.points, start.points)
    np.testing.assert_array_equal(state.velocities, start.velocities)
    assert float(state.time) == 2.0
