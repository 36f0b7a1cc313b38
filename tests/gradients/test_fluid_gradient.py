"""Gradients through the particle fluid: positions and constants, all pairs and lists, one force and a rollout."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests.particles import blob, make

pytestmark = pytest.mark.slow
CHOICES = pytest.mark.parametrize("pairs", [js.fluid.AllPairs(tile=5), js.fluid.NeighbourList(64, 0.3)], ids=["tiles", "list"])


def fluid_of(pairs, rng, n=20):
    """A short-ranged fluid with its list begun, a direction to move in and one to weigh the forces with."""
    system, state = make(blob(rng, n), rng.uniform(0.5, 2, n), cutoff=js.fluid.ShiftedForce(2.5), pairs=pairs)
    along, weights = (js.Vector(tuple(jnp.asarray(rng.normal(size=n)) for _ in range(3))) for _ in range(2))
    return system.bind(state.dtype), jax.jit(lambda s: system.begin(s))(state), along, weights


def dot(a, b):
    """Sum over nodes and coordinates."""
    return sum(jnp.sum(p * q) for p, q in zip(a, b, strict=True))


@CHOICES
def test_derivative_of_the_force(pairs, rng):
    """Forward and reverse mode agree to rounding (dot test), and with a central difference; Hessian of the energy: symmetric."""
    system, state, along, weights = fluid_of(pairs, rng)
    force = lambda x: system.force(state.moved(x, state.velocity))  # noqa: E731

    @jax.jit
    def products(x):
        forward = jax.jvp(force, (x,), (along,))[1]
        (backward,) = jax.vjp(force, x)[1](weights)
        (of_along,) = jax.vjp(force, x)[1](along)
        ahead, behind = force(x + 1e-5 * along), force(x - 1e-5 * along)
        return dot(forward, weights), dot(backward, along), dot(of_along, weights), dot(ahead - behind, weights) / 2e-5

    forward, backward, swapped, difference = (float(a) for a in products(state.position))
    assert forward == pytest.approx(backward, rel=1e-11)
    assert forward == pytest.approx(swapped, rel=1e-11)
    assert forward == pytest.approx(difference, rel=1e-6)


@CHOICES
def test_gradient_of_a_rollout(pairs, rng):
    """The Taylor remainder over 12 steps falls as h^2, in the start and in alpha together; the list is remade on the way."""
    system, state, along, _ = fluid_of(pairs, rng)
    first = state.moved(state.position, 2 * along)

    def loss(h):
        changed = js.fluid.SlideLaw(1.0 + 0.3 * h, 1.0, 0.1)
        fluid = js.Fluid(changed, cutoff=js.fluid.ShiftedForce(2.5), pairs=pairs)
        moved = first.moved(first.position + h * along, first.velocity)
        end = js.rollout(js.System(system.net, system.mass, fluid), moved, js.SymplecticEuler(), 5e-3, 12).state
        return dot(end.position, end.position)

    value, slope = jax.jit(jax.value_and_grad(loss))(0.0)
    run = jax.jit(loss)
    remainder = [abs(float(run(h) - value - h * slope)) for h in (1e-3, 5e-4, 2.5e-4)]
    assert np.log2(remainder[0] / remainder[1]) == pytest.approx(2, abs=0.1)
    assert np.log2(remainder[1] / remainder[2]) == pytest.approx(2, abs=0.1)


@CHOICES
def test_no_scatter(pairs, rng):
    """Force, gradient, Hessian-vector product of the energy: no scatter, though many particles share a neighbour."""
    system, state, along, weights = fluid_of(pairs, rng)
    force = lambda x: system.force(state.moved(x, state.velocity))  # noqa: E731
    energy = lambda x: system.energy(state.moved(x, state.velocity)).potential[0]  # noqa: E731
    programs = {
        "force": jax.jit(force).lower(state.position),
        "gradient": jax.jit(lambda x: jax.vjp(force, x)[1](weights)).lower(state.position),
        "product": jax.jit(lambda x: jax.jvp(jax.grad(energy), (x,), (along,))).lower(state.position),
    }
    for name, program in programs.items():
        assert "scatter" not in program.as_text(), name


@CHOICES
def test_derivatives_by_everything(pairs, rng):
    """A dragged, half molten fluid of uneven masses, by positions, speeds, masses and constants: the dot test, and central differences."""
    points, n = blob(rng, 20), 20
    net = js.Graph.from_edges([[i, i + 1] for i in range(0, n // 2)], n)
    alive = js.topology.EdgeField((jnp.ones(net.n_springs, bool),))
    start = js.State.from_points(net, points, rng.normal(size=(n, 3)))
    start = dataclasses.replace(start, alive=alive)
    weights = js.Vector(tuple(jnp.asarray(rng.normal(size=n)) for _ in range(3)))

    def force(at):
        position, velocity, mass, alpha, zeta, damping, radius = at
        drag, law = js.fluid.PairDrag(damping, radius), js.fluid.SlideLaw(alpha, 1.0, zeta)
        fluid = js.Fluid(law, js.fluid.ShiftedForce(2.5), pairs, drag, molten=js.fluid.Molten(net))
        system = js.System(net, mass, fluid)
        return system.force(system.begin(start.moved(position, velocity)))

    at = (start.position, start.velocity, jnp.asarray(rng.uniform(0.5, 2, n)), *(jnp.asarray(a) for a in (1.0, 0.1, 0.7, 2.2)))
    ways = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), at)

    @jax.jit
    def products(at, ways):
        forward = jax.jvp(force, (at,), (ways,))[1]
        backward = jax.vjp(force, at)[1](weights)[0]
        moved = lambda h: jax.tree.map(lambda a, w: a + h * w, at, ways)  # noqa: E731
        ahead, behind = force(moved(1e-6)), force(moved(-1e-6))
        pulled = sum(jnp.sum(a * b) for a, b in zip(jax.tree.leaves(backward), jax.tree.leaves(ways), strict=True))
        return dot(forward, weights), pulled, dot(ahead - behind, weights) / 2e-6

    still = jax.tree.map(jnp.zeros_like, ways)
    one_at_a_time = [(*still[:i], ways[i], *still[i + 1 :]) for i in range(len(ways))]
    for way in [ways, *one_at_a_time]:
        forward, backward, difference = (float(a) for a in products(at, way))
        assert forward != 0
        assert forward == pytest.approx(backward, rel=1e-10)
        assert forward == pytest.approx(difference, rel=1e-6)


@CHOICES
def test_second_derivatives(pairs, rng):
    """Forward over reverse and reverse over reverse of the energy agree to rounding, and with a difference of the forces."""
    system, state, along, weights = fluid_of(pairs, rng)
    energy = lambda x: system.energy(state.moved(x, state.velocity)).potential[0]  # noqa: E731

    @jax.jit
    def products(x):
        forward = jax.jvp(jax.grad(energy), (x,), (along,))[1]
        backward = jax.grad(lambda x: dot(jax.grad(energy)(x), weights))(x)
        force = lambda x: system.force(state.moved(x, state.velocity))  # noqa: E731
        return dot(forward, weights), dot(backward, along), -dot(force(x + 1e-5 * along) - force(x - 1e-5 * along), weights) / 2e-5

    forward, backward, difference = (float(a) for a in products(state.position))
    assert forward == pytest.approx(backward, rel=1e-10)
    assert forward == pytest.approx(difference, rel=1e-6)
