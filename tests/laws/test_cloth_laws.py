"""Laws of one spring for cloth, against quadratures, closed forms and differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import jaxspring as js
from jaxspring.forces.cloth_laws import arc_of

PAIR = js.lattice(2)
K_B = 0.3  # [N m^2]


def pull(law, k, l, r):
    """Pull of one spring at length r [N]."""
    springs = js.Springs(PAIR, k, l, law=law)
    return PAIR.flatten(springs.tension(js.State.from_points(PAIR, jnp.stack([jnp.zeros(1), jnp.reshape(r, 1)]))))[0]


def stored(law, k, l, r):
    """Its energy [J]."""
    return js.Springs(PAIR, k, l, law=law).energy(js.State.from_points(PAIR, jnp.stack([jnp.zeros(1), jnp.reshape(r, 1)])))


def arc_energy(chord, length):
    """Energy of an arc of this length over this chord [J], the chord taken by a quadrature along the arc."""

    def miss(curvature):
        half, _ = quad(lambda s: np.cos(curvature * s), 0, length / 2, epsabs=1e-14)
        return 2 * half - chord

    return 0.5 * K_B * brentq(miss, 1e-9, 2 * np.pi / length, xtol=1e-15) ** 2 * length


def elastica_push(share):
    """Force over k_b / L^2 of a thread hinged at both ends, bent to a chord of this share of it: 4 K(m)^2, r / L = 2 E(m) / K(m) - 1."""
    m = brentq(lambda m: 2 * ellipe(m) / ellipk(m) - 1 - share, 0.0, 0.999)
    return 4 * ellipk(m) ** 2


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.99])
def test_a_buckled_thread_pushes_like_an_arc(share):
    """Where the straight thread would push harder, the pull is minus the derivative of the arc's energy by its chord."""
    length, h = 0.8, 1e-5
    r = share * length
    by_quadrature = (arc_energy(r + h, length) - arc_energy(r - h, length)) / (2 * h)
    assert float(pull(js.cloth.ChoiKo(K_B), 1e5, length, r)) == pytest.approx(by_quadrature, rel=1e-6)


def test_an_arc_is_near_the_elastica():
    """An arc, which Choi and Ko take for the bent thread, pushes 1.2 to 1.5 times as hard as a thread whose ends are hinged."""
    for share, wanted in ((0.9, 1.229), (0.7, 1.264), (0.5, 1.318), (0.2, 1.488)):
        arc = -float(pull(js.cloth.ChoiKo(1.0), 1e6, 1.0, share))
        assert arc / elastica_push(share) == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize("k", [3.0, 18.0, 21.5, 30.0, 1e4])
def test_the_thread_takes_the_smaller_push(k):
    """Straight until the arc pushes less; nothing when stretched. Energy and pull agree, also where the two forces cross twice."""
    law, length = js.cloth.ChoiKo(K_B), 0.8
    r = jnp.asarray(np.linspace(1e-3, 1.2, 601) * length)
    pulls = np.asarray(jax.vmap(lambda r: pull(law, k, length, r))(r))
    q = np.asarray(arc_of(jnp.minimum(r / length, 1 - 1e-6)))
    np.testing.assert_allclose(np.sin(np.sqrt(q)) / np.sqrt(q), np.minimum(r / length, 1 - 1e-6), atol=1e-13)
    arcs = K_B / length**2 * 4 * q / (np.cos(np.sqrt(q)) - np.sin(np.sqrt(q)) / np.sqrt(q))
    wanted = np.where(r < length, np.maximum(arcs, k * (np.asarray(r) - length)), 0.0)
    np.testing.assert_allclose(pulls, wanted, rtol=1e-6, atol=1e-6)
    work = np.asarray(jax.vmap(lambda r: stored(law, k, length, r))(r))
    by_quadrature = -np.cumsum((0.5 * (pulls[1:] + pulls[:-1]) * np.diff(r))[::-1])[::-1]
    np.testing.assert_allclose(work[:-1], by_quadrature, rtol=1e-3, atol=5e-4 * work.max())  # the sum cuts the corner
    slopes = jax.vmap(jax.grad(lambda r: stored(law, k, length, r)))(r)
    np.testing.assert_allclose(slopes, pulls, rtol=1e-12, atol=1e-12)


def test_the_limit_as_a_law():
    """Hooke's law up to the strain, `factor` times as stiff beyond the band; the pull is the energy's derivative, its slope continuous."""
    law, k, l = js.cloth.Stiffening(0.1, 20.0, 0.05), 7.0, 2.0
    r = jnp.asarray([0.5, 1.9, 2.2, 2.25, 2.3, 2.6])
    by_energy = jax.vmap(jax.grad(lambda r: stored(law, k, l, r)))(r)
    np.testing.assert_allclose(by_energy, jax.vmap(lambda r: pull(law, k, l, r))(r), rtol=1e-13)
    np.testing.assert_allclose(by_energy[:3], k * (r[:3] - l), rtol=1e-13)
    tangents = jax.vmap(jax.grad(lambda r: pull(law, k, l, r)))(r)
    np.testing.assert_allclose(tangents, [k, k, k, 10.5 * k, 20 * k, 20 * k], rtol=1e-9)
    assert float(by_energy[-1]) == pytest.approx(k * (0.6 + 19 * (0.4 - 0.05)), rel=1e-13)
    assert float(pull(js.cloth.Stiffening(0.1, 1.0), k, l, 3.0)) == pytest.approx(k, rel=1e-14)


@pytest.mark.parametrize("law", [js.cloth.Stiffening(), js.cloth.ChoiKo(0.1)])
def test_no_length_is_finite(law):
    """At length zero, and without a rest length, pulls and gradients are finite, in float32 as well."""
    for rest in (0.0, 1.0):

        def total(r, k, l):
            state = js.State.from_points(PAIR, jnp.stack([jnp.zeros(1, r.dtype), jnp.reshape(r, 1)]))
            system = js.System(PAIR, jnp.float32(1.0), js.Springs(PAIR, k, l, law=law)).bind(r.dtype)
            return system.force(state).x[0]

        at = [jnp.asarray(a, jnp.float32) for a in (0.0, 2.0, rest)]
        assert np.isfinite(total(*at))
        assert all(np.isfinite(jax.grad(total, (0, 1, 2))(*at)))


@pytest.mark.parametrize("law", [js.cloth.Stiffening(0.1, 5.0, 0.1), js.cloth.ChoiKo(0.2)])
def test_gradients_through_implicit_steps(law):
    """By every constant of a law, after steps in which springs cross the limit or buckle, against central differences."""
    net = js.lattice(4)
    start = js.State.from_points(net, jnp.asarray([[0.0, 0.0], [0.75, 0.1], [1.95, 0.0], [3.1, -0.1]]))

    def end(law):
        system = js.System(net, 1.0, (js.Springs(net, 30.0, 1.0, law=law), js.Gravity((0.0, -3.0))), free=np.arange(4) > 0)
        return jnp.sum(js.rollout(system, start, js.BackwardEuler(), 0.05, 10).state.points ** 2)

    slopes = jax.tree.leaves(jax.jit(jax.grad(end))(law))
    leaves, tree = jax.tree.flatten(law)
    end = jax.jit(end)
    for i, slope in enumerate(slopes):
        h = 1e-5 * float(leaves[i])
        up, down = (end(jax.tree.unflatten(tree, [a + s * h * (j == i) for j, a in enumerate(leaves)])) for s in (1, -1))
        assert abs(slope) > 1e-4
        assert float(slope) == pytest.approx(float((up - down) / (2 * h)), rel=1e-5)


def test_bad_constants_are_refused():
    """By name."""
    for wrong, word in (({"strain": -0.1}, "strain"), ({"factor": 0.0}, "factor"), ({"band": 0.0}, "band"), ({"band": np.ones(2)}, "band")):
        with pytest.raises(ValueError, match=word):
            js.cloth.Stiffening(**wrong)
    with pytest.raises(ValueError, match="bending"):
        js.cloth.ChoiKo(0.0)
