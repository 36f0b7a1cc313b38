"""Hard cases L5, L6: hinges and joints that are flat, folded over, without area or length; angles that pass half a turn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

PAIR = js.from_triangles([(0, 1, 2), (1, 0, 3)], 4)
ROD = js.lattice(3)
HINGES, JOINTS = js.cloth.Hinges(PAIR, 2.0), js.cloth.AngularJoints(ROD, 2.0)


def folded(degrees, length=1.0):
    """Two triangles, the second turned about their edge."""
    t = np.radians(degrees)
    return length * np.array([(0, 0, 0), (1, 0, 0), (0.5, 1, 0), (0.5, -np.cos(t), -np.sin(t))])


FOLDS = {
    "flat": (folded(0.0), 0),
    "folded by 179.9": (folded(179.9), 0),
    "folded by -179.9": (folded(-179.9), 0),
    "folded flat": (np.array([(0, 0, 0), (1, 0, 0), (0.5, 1, 0), (0.5, 1, 0)], float), 0),
    "tiny": (folded(90.0, 1e-9), 0),
    "huge": (folded(90.0, 1e9), 0),
    "far and thin": (folded(90.0) * [1.0, 1e-4, 1e-4], 0),
    "no area": (np.array([(0, 0, 0), (1, 0, 0), (0.25, 0, 0), (0.5, 0, 1)], float), 1),
    "no area but for rounding": (np.array([(0, 0, 0), (1, 0, 0), (0.3, 1e-20, 0), (0.5, 0, 1)], float), 1),
    "no edge": (np.array([(0, 0, 0), (0, 0, 0), (0, 1, 0), (0.5, 0, 1)], float), 1),
    "corner on the edge's end": (np.array([(0, 0, 0), (1, 0, 0), (1, 0, 0), (0.5, 0, 1)], float), 1),
    "a point": (np.zeros((4, 3)), 1),
}
BENDS = {
    "straight": (np.array([(0, 0, 0), (1, 0, 0), (2, 0, 0)], float), 0),
    "turned by 179.9": (np.array([(0, 0, 0), (1, 0, 0), (1 + np.cos(np.radians(179.9)), np.sin(np.radians(179.9)), 0)]), 0),
    "folded": (np.array([(0, 0, 0), (1, 0, 0), (0.25, 0, 0)], float), 1),
    "tiny": (1e-15 * np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)], float), 0),
    "huge": (1e15 * np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0)], float), 0),
    "no length": (np.array([(0, 0, 0), (0, 0, 0), (0, 1, 0)], float), 1),
    "a point": (np.zeros((3, 3)), 1),
}


def answers(net, effect, points):
    """Forces, a gradient of all of them, energy and its gradient, blocks, bound, and how many are reported, of every set of points."""

    def of(x):
        state = js.State.from_points(net, x)

        def force(x):
            return jnp.stack(effect.force(js.State.from_points(net, x)).components)

        def weighed(x):
            return jnp.vdot(jnp.linspace(0.3, 1.7, x.size, dtype=x.dtype), jnp.ravel(force(x)))

        blocks = effect.stiffness_blocks(state, js.steppers.ExactTangent()).product(state.position)
        (found,) = effect.diagnose(state)
        work = jax.grad(lambda x: effect.energy(js.State.from_points(net, x)))(x)
        return (force(x), jax.grad(weighed)(x), effect.energy(state), work, blocks, effect.stiffness_bound(state)), found.count

    return jax.jit(jax.vmap(of))(points)


@pytest.mark.parametrize(("net", "effect", "cases"), [(PAIR, HINGES, FOLDS), (ROD, JOINTS, BENDS)], ids=["hinges", "joints"])
def test_l5_flat_folded_without_area_or_length(net, effect, cases, dtype, sooner):
    """Force and energy, a gradient of each, blocks and bound are finite everywhere; where there is no direction, zero and counted."""
    points = jnp.asarray(np.stack([p for p, _ in cases.values()]), dtype)
    effect = jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, effect)
    values, counts = answers(net, effect, points)
    for value in jax.tree.leaves(values):
        assert value.dtype == dtype
        for name, each in zip(cases, value, strict=True):
            assert bool(jnp.all(jnp.isfinite(each))), name
    np.testing.assert_array_equal(counts, [n for _, n in cases.values()])
    for n, force, slope in zip(counts, values[0], values[1], strict=True):
        assert not n or (not jnp.any(force) and not jnp.any(slope))


def test_l5_the_status_names_the_node():
    """A run with a triangle of area zero warns DEGENERATE, with a node of the hinge and the effect, and goes on."""
    points = FOLDS["no area"][0]
    run = js.rollout(js.System(PAIR, 1.0, (js.Drag(0.1), HINGES)), js.State.from_points(PAIR, points), js.SymplecticEuler(), 1e-3, 2)
    assert run.status.has(js.Flag.DEGENERATE)
    assert bool(run.status.is_ok)
    assert (int(run.status.effect), int(run.status.count)) == (1, 1)
    assert int(run.status.node) in (0, 1)
    np.testing.assert_array_equal(run.state.points, points)


def test_l6_an_angle_passes_half_a_turn():
    """Energies of a hinge and of a joint have no jump at half a turn, whatever the rest angle; the angle stays in (-pi, pi]."""
    turns = np.linspace(170.0, 190.0, 41)
    rests = np.radians([0.0, 60.0, -170.0])

    def hinge(x, rest):
        effect, state = js.cloth.Hinges(PAIR, 2.0, rest), js.State.from_points(PAIR, x)
        return effect.energy(state), effect.angles(state)[0]

    points = jnp.asarray(np.stack([folded(t) for t in turns]))
    energy, angle = jax.jit(jax.vmap(jax.vmap(hinge, (0, None)), (None, 0)))(points, jnp.asarray(rests))
    apart = np.radians(turns)[None] - rests[:, None]
    wrapped = apart - 2 * np.pi * np.ceil((apart - np.pi) / (2 * np.pi) - 1e-12)
    np.testing.assert_allclose(energy, wrapped**2, rtol=1e-9)
    assert np.abs(np.diff(energy, axis=1)).max() < 2 * np.pi * 2 * np.radians(0.5) * 1.01
    np.testing.assert_allclose(np.asarray(angle)[0], np.where(turns > 180, np.radians(turns - 360), np.radians(turns)), atol=1e-12)
    assert angle.max() <= np.pi
    assert angle.min() > -np.pi

    def joint(t):
        x = jnp.stack([jnp.zeros(2), jnp.array([1.0, 0.0]), jnp.array([1 + jnp.cos(t), jnp.sin(t)])])
        return JOINTS.energy(js.State.from_points(ROD, x))

    bent = np.radians(turns)
    np.testing.assert_allclose(jax.vmap(joint)(jnp.asarray(bent)), np.minimum(bent, 2 * np.pi - bent) ** 2, rtol=1e-9)
