"""Hard cases E: images as forces and as stiffness. (Those of the image alone are with the images.)"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.images import Bilinear, CubicSpline, Image, elevation_model
from jaxspring.status import Flag
from tests.reference import relative_error

METHODS = pytest.mark.parametrize("method", [Bilinear(), CubicSpline()], ids=repr)


def node_at(x, y, z=0.0):
    net = js.lattice(1)
    return net, js.State.from_points(net, [[x, y, z]])


def status_of(net, effects, state):
    return js.rollout(js.System(net, 1.0, effects), state, js.SymplecticEuler(), 0.0, 1).status


@METHODS
@pytest.mark.parametrize("row", [-0.5, -1.5, 10.0 + 3])
def test_e1_a_node_outside(rng, method, row):
    """A node beyond the border is pulled to the border's value, with no pull across the border, and is counted OUTSIDE."""
    image = Image(rng.random((10, 8)))
    net, state = node_at(3.0, row, 0.25)
    edge = float(image.values[0 if row < 0 else -1, 3])
    for conservative in (False, True):
        data = js.DataSprings(image, 5.0, sampling=method, conservative=conservative)
        force = data.force(state)
        assert force.z[0] == pytest.approx(5 * (edge - 0.25), abs=1e-13)
        assert force.y[0] == 0
    status = status_of(net, data, state)
    assert Flag(int(status.flags)) == Flag.OUTSIDE
    assert (int(status.count), int(status.node)) == (1, 0)
    assert js.ImageAttraction(image, 2.0, sampling=method).force(state).y[0] == 0


@METHODS
def test_e2_a_constant_image(method):
    """Nothing to see: data springs pull by the value alone, and an adaptive mesh has k = k_min everywhere, with finite derivatives."""
    image = Image(np.full((9, 9), 7.0))
    net = js.lattice((3, 3))
    points = np.c_[2.3 * net.grid() + 1.1, np.ones(9)]
    state = js.State.from_points(net, points)
    force = js.DataSprings(image, 5.0, sampling=method, conservative=True).force(state)
    # A spline's weights sum to one, and their slopes to zero, only to rounding: 5 N/m times 6 m times 7 eps.
    for in_plane in (force.x, force.y):
        np.testing.assert_allclose(in_plane, 0, atol=0 if method == Bilinear() else 5e-14)
    np.testing.assert_allclose(force.z, 5 * 6, rtol=1e-14)

    def total(k_min, points):
        rule = js.ImageStiffness(image, k_min, 30.0, 1.5, sampling=method)
        return net.flatten(rule.stiffness(net, js.State.from_points(net, points)))

    np.testing.assert_array_equal(total(2.0, points), 2)
    by_k, by_x = jax.jacrev(total, argnums=(0, 1))(2.0, points)
    np.testing.assert_array_equal(by_k, 1)
    np.testing.assert_allclose(by_x, 0, atol=1e-12)


def test_e3_a_nan_pixel_in_a_traced_image():
    """A NaN pixel that no constructor could see is a NONFINITE status before the first step, whether or not a node is near."""
    net, state = node_at(1.0, 1.0)

    def go(pixels):
        return status_of(net, js.DataSprings(Image(pixels), 1.0), state)

    pixels = np.ones((12, 12))
    assert jax.jit(go)(pixels).flags == 0
    pixels[10, 10] = np.nan
    status = jax.jit(go)(pixels)
    assert status.has(Flag.NONFINITE)
    assert (int(status.step), int(status.effect)) == (0, 0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e12])
def test_e4_coordinates_that_are_no_place(bad):
    """A node at NaN or infinity is NONFINITE; a node at 1e12 takes the border's value, finite, and is OUTSIDE."""
    net = js.lattice(1)
    image = Image(np.arange(20.0).reshape(4, 5))

    @jax.jit
    def go(points):
        state = js.State.from_points(net, points)
        effect = js.DataSprings(image, 1.0)
        return effect.force(state).z, status_of(net, effect, state)

    pull, status = go(jnp.array([[bad, 1.0, 0.0]]))
    assert status.has(Flag.NONFINITE) == (bad != 1e12)
    assert status.has(Flag.OUTSIDE)
    assert status.step == 0
    if bad == 1e12:
        assert pull[0] == 9  # the last pixel of row 1


def jacobian_asymmetry(data, net, points):
    """Largest |J - J'| of the force's Jacobian."""

    @jax.jit
    @jax.jacfwd
    def jacobian(flat):
        force = data.force(js.State.from_points(net, flat.reshape(points.shape)))
        return jnp.stack(list(force), axis=-1).ravel()

    matrix = jacobian(jnp.ravel(points))
    return np.abs(matrix - matrix.T).max()


@METHODS
def test_e9_the_slides_law_has_no_potential(rng, method):
    """Pulling z alone has an asymmetric Jacobian, so no energy; `conservative=True` makes it symmetric and the gradient of its energy."""
    y, x = np.indices((8, 9))
    image = Image(np.sin(0.7 * x) * np.cos(0.9 * y) * 3)
    net = js.lattice(4)
    points = jnp.asarray(np.c_[rng.uniform(1, 6, (4, 2)), rng.normal(size=4)])
    slides = js.DataSprings(image, 2.0, sampling=method)
    assert jacobian_asymmetry(slides, net, points) > 0.5
    assert slides.energy(js.State.from_points(net, points)) is None
    data = js.DataSprings(image, 2.0, sampling=method, conservative=True)
    assert jacobian_asymmetry(data, net, points) <= 5e-12

    def energy(points):
        return data.energy(js.State.from_points(net, points))

    force = jnp.stack(list(data.force(js.State.from_points(net, points))), axis=-1)
    assert relative_error(-jax.grad(energy)(points), force) <= 1e-13


def test_e9_energy_is_kept_only_with_a_potential():
    """On a smooth image the conservative law keeps kinetic plus potential energy; the slides' law does not."""
    y, x = np.indices((8, 9))
    image = Image(np.sin(0.7 * x) * np.cos(0.9 * y))
    net = js.lattice(1)
    state = js.State.from_points(net, [[3.3, 2.6, 1.5]], [[0.8, 0.5, 0.0]])
    change = []
    for conservative in (False, True):
        system = js.System(net, 1.0, js.DataSprings(image, 4.0, sampling=CubicSpline(), conservative=conservative))
        ledger = js.System(net, 1.0, js.DataSprings(image, 4.0, sampling=CubicSpline(), conservative=True))
        end = js.rollout(system, state, js.VelocityVerlet(), 5e-3, 400).state
        change.append(abs(float(ledger.energy(end).total / ledger.energy(state).total) - 1))
    assert change[1] <= 1e-4
    assert change[0] > 0.05


def test_e11_a_mesh_larger_than_the_image():
    """On the elevation model (344 x 403) a mesh that sticks out has finite results, and OUTSIDE counts the nodes beyond the border."""
    image = elevation_model()
    assert image.shape == (344, 403)
    net = js.lattice((12, 12), js.STRUCTURAL + js.SHEAR)
    points = np.c_[net.grid((40.0, 40.0)), np.zeros(144)]
    n_outside = int(np.sum((points[:, 0] > 402) | (points[:, 1] > 343)))
    assert 0 < n_outside < 144
    rule = js.ImageStiffness(image, 1.0, 10.0, 20.0)
    system = js.System(net, 1.0, (js.Springs(net, rule), js.DataSprings(image, 0.5), js.Drag(1.0)))
    state = js.State.from_points(net, points)
    held = js.rollout(system, state, js.SymplecticEuler(), 0.0, 1).status
    assert Flag(int(held.flags)) == Flag.OUTSIDE
    assert (int(held.count), int(held.effect)) == (n_outside, 1)
    assert int(held.node) == int(np.argmax((points[:, 0] > 402) | (points[:, 1] > 343)))
    result = js.rollout(system, state, js.SymplecticEuler(), 0.05, 50)
    assert result.status.is_ok
    assert np.isfinite(result.state.points).all()
