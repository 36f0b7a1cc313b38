"""`replace`: the same system with other constants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.edit import replace
from jaxspring.images.image import Image


@pytest.fixture
def scene(rng):
    """A chain with one of each force that has a constant of its own."""
    net = js.lattice(4)
    forces = (js.Springs(net, 2.0, 0.5), js.Drag(0.1), js.Dashpots(net, 0.3), js.Gravity([0.0, -9.81]))
    free = np.array([False, True, True, True])
    points = rng.normal(size=(4, 2))
    return js.System(net, mass=1.5, forces=forces, free=free), js.State.from_points(net, points, rng.normal(size=(4, 2)))


def test_each_constant_reaches_its_force(scene):
    """The replaced system has the acceleration of one built with the new constants, and the old one is unchanged."""
    system, state = scene
    net, k, m = system.net, np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 3.0, 4.0])
    before = [np.asarray(a) for a in system.acceleration(state)]
    new = replace(system, stiffness=k, rest_length=0.7, gamma=0.2, damping=0.4, acceleration=[0.0, -1.0], mass=m)
    forces = (js.Springs(net, k, 0.7), js.Drag(0.2), js.Dashpots(net, 0.4), js.Gravity([0.0, -1.0]))
    expected = js.System(net, mass=m, forces=forces, free=np.array([False, True, True, True]))
    for got, wanted, old, now in zip(
        new.acceleration(state), expected.acceleration(state), before, system.acceleration(state), strict=True
    ):
        np.testing.assert_array_equal(got, wanted)
        np.testing.assert_array_equal(old, now)


def test_the_law_and_the_axes_stay(scene):
    """What is not named stays: law, axes, masks, topology."""
    system, _ = scene
    springs = js.Springs(system.net, 1.0, 0.5, law=js.TensionOnly(), axes=(0,))
    new = replace(js.System(system.net, 1.0, springs, free=system.free), stiffness=3.0)
    assert isinstance(new.forces[0].law, js.TensionOnly)
    assert new.forces[0].axes == (0,)
    assert new.net.shape == system.net.shape
    np.testing.assert_array_equal(new.free, system.free)


def test_a_force_by_its_index(scene):
    """With two springs `effect` says which; without it the error lists both."""
    system, _ = scene
    two = js.System(system.net, 1.0, (js.Springs(system.net, 1.0), js.Drag(0.0), js.Springs(system.net, 2.0)))
    with pytest.raises(ValueError, match=r"forces\[0\] \(Springs\) and forces\[2\] \(Springs\).*effect=0"):
        replace(two, stiffness=5.0)
    assert [float(replace(two, stiffness=5.0, effect=i).forces[2].stiffness) for i in (0, 2, -1)] == [2.0, 5.0, 5.0]


def test_constants_of_a_stiffness_rule():
    """k_min, k_max and sigma reach the image rule inside the springs, and a number for sigma makes the filter anew."""
    net = js.lattice((3, 3))
    image = Image(np.eye(12))
    system = js.System(net, 1.0, js.Springs(net, js.ImageStiffness(image, 1.0, 5.0, sigma=1.0)))
    new = replace(system, k_min=2.0, k_max=7.0, sigma=2.0)
    fresh = js.Springs(net, js.ImageStiffness(image, 2.0, 7.0, sigma=2.0))
    state = js.State.from_points(net, np.concatenate([3 * net.grid(), np.zeros((9, 1))], axis=1))
    for got, expected in zip(new.forces[0].force(state), fresh.force(state), strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stiffness": -1.0}, "stiffness = -1.0"),
        ({"stiffness": [1.0, 2.0]}, "one per spring"),
        ({"mass": 0.0}, "mass = 0.0"),
        ({"mass": [1.0, 2.0, np.nan, 1.0]}, r"mass\[2\] = nan"),
        ({"gamma": np.inf}, "gamma = inf"),
        ({"strength": 1.0}, "no force of this system has a strength"),
        ({"gamma": 1.0, "effect": 0}, r"forces\[0\] is a Springs, which has no gamma.*forces\[1\] \(Drag\)"),
        ({"gamma": 1.0, "effect": 9}, "4 forces"),
    ],
)
def test_wrong_values_are_refused(scene, changes, message):
    """Concrete values are checked as by the constructors; what cannot be meant is named."""
    with pytest.raises(ValueError, match=message):
        replace(scene[0], **changes)


def test_traced_values(scene):
    """Under jit, grad and vmap replace equals building the system anew."""
    system, state = scene

    def energy(k):
        return replace(system, stiffness=k).energy(state).total

    def built(k):
        return js.Springs(system.net, k, 0.5).energy(state)

    k = jnp.asarray([1.0, 2.0, 3.0])
    np.testing.assert_allclose(jax.jit(jax.grad(energy))(k), jax.grad(built)(k), rtol=1e-14)
    lanes = jnp.stack([k, 2 * k])
    np.testing.assert_allclose(jax.vmap(jax.grad(energy))(lanes), jax.vmap(jax.grad(built))(lanes), rtol=1e-14)


def test_masses_are_traced_too(scene):
    """The gradient with respect to the mass of each node is that of the kinetic energy, v^2 / 2."""
    system, state = scene
    free = js.System(system.net, 1.0)
    got = jax.grad(lambda m: replace(free, mass=m).energy(state).total)(jnp.ones(4))
    np.testing.assert_allclose(got, 0.5 * (np.asarray(state.velocities) ** 2).sum(axis=1), rtol=1e-14)
