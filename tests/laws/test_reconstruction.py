"""Laws of adaptive meshes: where zero-rest-length springs bring their nodes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.forces.springs import StiffnessRule
from jaxspring.images.image import Image
from jaxspring.images.observation import Intensity
from jaxspring.rollouts import rollout
from jaxspring.scenes.reconstruction.fitting import LAW_RUN, SpringSettings, prepare_springs, settle
from jaxspring.scenes.reconstruction.scene import Reconstruction, Relaxation
from jaxspring.scenes.reconstruction.triangles import count_folds


def bump(x):
    """Observation along the chain of physics: exp(-((x - 1/2) / 0.08)^2)."""
    return jnp.exp(-(((x - 0.5) / 0.08) ** 2))


class BumpStiffness(StiffnessRule):
    """Stiffness 1 to 10 [N/m] by the observation at both ends."""

    def stiffness(self, net, state):
        return net.average(bump(state.position.x)).map(lambda a: 1 + 9 * a)

    def upper_bound(self):
        return jnp.asarray(10.0)


def adapted_chain(n):
    """Node positions of n springs on [0, 1] with pinned ends, at rest."""
    net = js.lattice(n + 1)
    pinned = np.ones(n + 1, bool)
    pinned[[0, -1]] = False
    # Slowest mode about pi / n with mass 20 (twice the largest stiffness) and stiffness 1.
    drag = 20 * 2 * np.pi / n / np.sqrt(20)
    system = js.System(net, 20.0, (js.Springs(net, BumpStiffness(), 0.0), js.Drag(drag)), free=pinned)
    start = js.State.from_points(net, np.linspace(0, 1, n + 1)[:, None])
    state = rollout(system, start, js.SymplecticEuler(), dt=1.0, n_steps=100 * n).state
    assert float(jnp.max(jnp.abs(state.velocity.x))) < 1e-10
    return np.asarray(state.position.x)


@pytest.mark.slow
def test_chain_spreads_stiffness_evenly_to_second_order():
    """k_i L_i is constant; nodes meet the integral of k = i/N of the whole with error 4.2e-3, 1.5e-3, 3.9e-4 at 20, 40, 80 springs."""
    fine = np.linspace(0, 1, 200_001)
    k = 1 + 9 * np.asarray(bump(fine))
    integral = np.concatenate([[0.0], np.cumsum((k[1:] + k[:-1]) / 2)])
    error = []
    for n in (20, 40, 80):
        x = adapted_chain(n)
        springs = 1 + 4.5 * np.asarray(bump(x[1:]) + bump(x[:-1]))
        tension = springs * np.diff(x)
        np.testing.assert_allclose(tension, tension[0], rtol=1e-6)
        error.append(np.max(np.abs(x - np.interp(np.arange(n + 1) / n, integral / integral[-1], fine))))
    np.testing.assert_allclose(error, [4.2e-3, 1.5e-3, 3.9e-4], rtol=0.05)
    assert np.log2(error[1] / error[2]) == pytest.approx(2, abs=0.1)


def test_rest_length_of_the_spacing_adapts_nothing():
    """With l equal to the spacing, no stiffness moves any node."""
    net = js.lattice(21)
    k = np.random.default_rng(1).uniform(1, 10, 20)
    pinned = np.ones(21, bool)
    pinned[[0, -1]] = False
    system = js.System(net, 20.0, (js.Springs(net, k, 0.05),), free=pinned)
    start = js.State.from_points(net, np.linspace(0, 1, 21)[:, None])
    end = rollout(system, start, js.SymplecticEuler(), dt=0.5, n_steps=200).state
    lengths = np.asarray(net.lengths(end.position))
    assert lengths.max() / lengths.min() == pytest.approx(1, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "size"), [(3, 1.81), (10, 3.70), (30, 6.27)])
def test_ring_draws_cells_together(ratio, size):
    """31 x 31 nodes on a ring: sqrt of largest over smallest cell is 1.81, 3.70, 6.27 for stiffness 3, 10, 30, and nothing folds."""
    n = 601
    y, x = np.mgrid[:n, :n] / (n - 1)
    ring = np.exp(-(((np.hypot(x - 0.5, y - 0.5) - 0.25) / 0.06) ** 2))
    scene = Reconstruction(Image(ring, spacing=1 / (n - 1)), (31, 31))
    rule = js.ImageStiffness(scene.image, 1.0, float(ratio), 0.0, observation=Intensity())
    _, state = eqx.filter_jit(lambda: scene.adapt(rule, LAW_RUN, 200))()
    px, py = (np.asarray(a) for a in state.position)
    dx, dy = px[1:, 1:] - px[:-1, :-1], py[1:, 1:] - py[:-1, :-1]
    ex, ey = px[1:, :-1] - px[:-1, 1:], py[1:, :-1] - py[:-1, 1:]
    areas = 0.5 * (dx * ey - dy * ex)
    assert areas.min() > 0
    assert np.sqrt(areas.max() / areas.min()) == pytest.approx(size, abs=0.1 if ratio < 30 else 0.3)


@pytest.mark.slow
def test_no_stiffness_folds_the_mesh(rng):
    """Rough stiffnesses over six decades: every triangle keeps its orientation, and the mesh its border."""
    scene = Reconstruction(Image(rng.random((60, 80))), (11, 13))
    for _ in range(5):
        k = jnp.asarray(np.exp(rng.uniform(-7, 7, scene.net.n_springs)))
        state = scene.relax(k, scene.at_rest(*scene.rest), Relaxation(20_000, 1.3, 0.02)).state
        x, y = state.position
        for flip in (False, True):
            assert int(count_folds(x, y, jnp.full((10, 12), flip))) == 0
        np.testing.assert_array_equal(x[:, 0], scene.rest.x[:, 0])
        np.testing.assert_array_equal(y[-1], scene.rest.y[-1])


@pytest.mark.slow
def test_equal_stiffness_restores_the_uniform_mesh(rng):
    """From the mesh of the law, stiffness 1 everywhere leads back to the regular lattice."""
    y, x = np.mgrid[:60, :80]
    picture = 1 / (1 + np.exp(-(np.hypot(x - 40, y - 30) - 18)))
    loss, carried = prepare_springs(Image(picture), SpringSettings(nodes=(11, 13)))
    scene = loss.error.scene
    moved = float(jnp.max(jnp.abs(carried.x - scene.rest.x)))
    ones = eqx.tree_at(lambda m: m.log_law, loss.springs, jnp.zeros_like(loss.springs.log_law))
    mesh, status = settle(eqx.tree_at(lambda f: f.springs, loss, ones), loss.springs.zero(), carried)
    assert moved > 1
    assert bool(status.is_ok)
    np.testing.assert_allclose(mesh.x, scene.rest.x, atol=1e-9)
    np.testing.assert_allclose(mesh.y, scene.rest.y, atol=1e-9)
