"""Functions of the user's that close over what is differentiated or batched: loads, winds, controllers, motions, surfaces, sources."""

import functools
import types

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

NET = js.lattice((3, 3))
FLAT = np.pad(NET.grid(1.0), ((0, 0), (0, 1)))
SPRINGS = js.Springs(NET, 3.0, 0.9)


def pulled(size, time):
    return js.Vector((size + jnp.zeros((3, 3)), jnp.zeros((3, 3)), size * jnp.cos(time) + jnp.zeros((3, 3))))


class Pull(eqx.Module):
    size: jax.Array

    def at(self, time):
        return pulled(self.size, time)


class Plain:
    def __init__(self, size):
        self.size = size

    def __call__(self, time):
        return pulled(self.size, time)


def nested(size):
    def scaled(time):
        return pulled(2 * size, time)

    return lambda time: scaled(time) * 0.5


def by_default(size):
    def load(time, size=size):
        return pulled(size, time)

    return load


LOADS = {
    "closure": lambda size: lambda time: pulled(size, time),
    "nested": nested,
    "default": by_default,
    "partial": lambda size: functools.partial(pulled, size),
    "jitted": lambda size: jax.jit(lambda time: pulled(size, time)),
    "method": lambda size: Pull(size).at,
    "in a dict": lambda size: (lambda held: lambda time: pulled(held["size"], time))({"size": size}),
    "in a module": lambda size: (lambda held: lambda time: held.at(time))(Pull(size)),
}


def agrees(end, n=1, h=1e-5, least=1e-4):
    """The gradient by n numbers is that of central differences: of one program, since each new closure is compiled anew."""
    both, at = jax.jit(jax.value_and_grad(end)), jnp.full(n, 0.3)
    slopes = [(both(at + h * way)[0] - both(at - h * way)[0]) / (2 * h) for way in jnp.eye(n)]
    assert np.min(np.abs(slopes)) > least
    np.testing.assert_allclose(both(at)[1], slopes, rtol=1e-6)


def pulled_by(sizes):
    """The squared places after three implicit steps, pulled by loads that close over their sizes."""
    loads = [js.Load(make(size)) for make, size in zip(LOADS.values(), sizes, strict=False)]
    system = js.System(NET, 1.0, (SPRINGS, *loads))
    return jnp.sum(js.rollout(system, js.State.from_points(NET, FLAT), js.BackwardEuler(), 0.05, 3).state.points ** 2)


def test_loads_by_implicit_steps():
    """However a function holds its value, the gradient by it is that of central differences."""
    agrees(pulled_by, len(LOADS))


def test_forward_mode_and_a_batch():
    """The tangent is the gradient; a batch is each run by itself."""
    slope = jax.jit(jax.grad(lambda size: pulled_by([size])))
    tangent = jax.jit(lambda a: jax.jvp(lambda size: pulled_by([size]), (a,), (1.0,))[1])
    assert float(tangent(0.3)) == pytest.approx(float(slope(0.3)), rel=1e-9)
    sizes = jnp.asarray([0.1, 0.3])
    np.testing.assert_allclose(jax.jit(jax.vmap(slope))(sizes), [slope(a) for a in sizes], rtol=1e-9)


def many(sizes):
    """Wind, a controller, a surface and one that moves."""
    wind, drive, slope, rise = sizes
    air = js.cloth.Air(NET, wind=lambda places, time: js.Vector((0 * places.x, wind * places.y, wind * jnp.cos(time) + places.x)))
    springs = js.Springs(NET, 3.0, 0.9, actuation=js.robot.Actuation(lambda state: 1 + drive * jnp.cos(state.time)))
    hill = js.contact.SignedDistance(lambda places, time: places.z - slope * (1 + places.x))
    level = js.contact.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    lift = js.contact.Moving(level, lambda t: jnp.stack([t * 0, t * 0, rise + rise * t]))
    return js.System(NET, 1.0, (springs, air, js.contact.Penalty(hill, 5.0), js.contact.Penalty(lift, 5.0)))


def resting(sizes):
    """On a floor that rises."""
    level = js.contact.Plane((0.0, 0.0, -0.01), (0.0, 0.0, 1.0))
    floor = js.contact.Moving(level, lambda t: jnp.stack([t * 0, t * 0, sizes[0] * t]))
    return js.System(NET, 1.0, (SPRINGS, js.Gravity((0.0, 0.0, -1.0))), rules=js.contact.Contact(floor))


def scheduled(sizes):
    """A row of nodes on a schedule."""
    motion = js.Motion(np.arange(9) < 3, lambda time: NET.vector_field(jnp.asarray(FLAT) + sizes[0] * jnp.sin(time)))
    return js.System(NET, 1.0, SPRINGS, motion=motion)


@pytest.mark.parametrize(
    ("make", "n", "stepper"), [(many, 4, js.BackwardEuler()), (resting, 1, js.SymplecticEuler()), (scheduled, 1, js.BackwardEuler())]
)
def test_parts_with_functions(make, n, stepper):
    """Whatever part holds the function: its gradient is that of central differences."""
    agrees(lambda sizes: jnp.sum(js.rollout(make(sizes), js.State.from_points(NET, FLAT), stepper, 0.05, 4).state.points ** 2), n)


def test_a_shape_at_rest():
    """`equilibrium` with a load that closes over its size, against central differences."""
    free = np.arange(9) > 2

    def sag(sizes):
        load = js.Load(lambda time: pulled(sizes[0], time))
        system = js.System(NET, 1.0, (SPRINGS, load), free=free)
        return jnp.sum(js.equilibrium(system, js.State.from_points(NET, FLAT), tolerance=1e-12).state.points)

    agrees(sag)


def held_by_an_object(size):
    return Plain(size)


def closes_over_an_object(size):
    held = types.SimpleNamespace(size=size)
    return lambda time: pulled(held.size, time)


@pytest.mark.parametrize("load", [held_by_an_object, closes_over_an_object])
def test_where_no_derivative_reaches(load):
    """A traced value in an object that JAX does not know is refused by name; one that is known is not."""
    js.System(NET, 1.0, js.Load(load(0.3)))
    with pytest.raises(TypeError, match=r"forces\[0\] \(Load\) .* traced value.*equinox.Module"):
        jax.grad(lambda size: js.System(NET, 1.0, js.Load(load(size))).mass)(0.3)
