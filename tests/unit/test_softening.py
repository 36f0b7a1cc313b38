"""Stiffness, rest length and breaking as rules of temperature; the floor."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

CHAIN = js.lattice(5)
SHEET = js.lattice((4, 5), js.STRUCTURAL + js.SHEAR)


def warm(net, temperature, scale=1.0, **more):
    return js.State.from_points(net, scale * net.grid(), temperature=temperature, **more)


def stiffness_at(theta, sharpness=None):
    net = js.lattice(2)
    rule = js.thermal.ThermalStiffness(80.0, 300.0, 400.0, sharpness)
    return float(net.flatten(rule.stiffness(net, warm(net, theta)))[0])


@pytest.mark.parametrize(("theta", "share"), [(200.0, 1), (300.0, 1), (350.0, 0.5), (400.0, 0), (500.0, 0)])
def test_ramp(theta, share):
    """Stiffness is k0 up to theta_s, k0 / 2 in the middle, 0 from theta_m on."""
    assert stiffness_at(theta) == pytest.approx(80 * share, abs=1e-12)


def test_the_smooth_ramp_tends_to_the_hard_one():
    """The largest difference over all temperatures is k0 ln 2 / b, and halves when b doubles."""
    at = np.linspace(250, 450, 81)
    hard = np.array([stiffness_at(t) for t in (300.0, 400.0)])
    assert hard.tolist() == [80, 0]
    for b in (20.0, 40.0):
        gap = max(abs(stiffness_at(float(t), b) - 80 * np.clip((400 - t) / 100, 0, 1)) for t in at[::4])
        assert gap == pytest.approx(80 * np.log(2) / b, rel=1e-6)


def test_mean_of_the_ends():
    """A spring between 300 K and 400 K is as one at 350 K."""
    net = js.lattice(2)
    rule = js.thermal.ThermalStiffness(80.0, 300.0, 400.0)
    assert float(net.flatten(rule.stiffness(net, warm(net, [300.0, 400.0])))[0]) == pytest.approx(40)


def test_expansion():
    """A free chain heated by 100 K is at rest when longer by a * 100 K: no force there, and the closed form before it."""
    springs = js.Springs(CHAIN, 7.0, 1.0, expansion=js.thermal.ThermalExpansion(2e-3, 300.0))
    at_rest = js.System(CHAIN, 1.0, springs).force(warm(CHAIN, 400.0, 1.2))
    np.testing.assert_allclose(at_rest.x, 0, atol=1e-14)
    squeezed = js.System(CHAIN, 1.0, springs).force(warm(CHAIN, 400.0))
    np.testing.assert_allclose(squeezed.x, [-1.4, 0, 0, 0, 1.4], atol=1e-14)


def test_expansion_stops_at_nothing():
    """Cooled below -1 / a a rest length is zero, never less: the springs pull their ends together, and no further."""
    springs = js.Springs(CHAIN, 7.0, 1.0, expansion=js.thermal.ThermalExpansion(2e-2, 300.0))
    cold = warm(CHAIN, 200.0)
    np.testing.assert_array_equal(CHAIN.flatten(springs.natural_length(cold)), 0)
    np.testing.assert_allclose(springs.force(cold).x, [7, 0, 0, 0, -7], atol=1e-14)


def test_springs_with_thermal_stiffness_have_an_energy():
    """Minus the gradient of the energy by position is the force, at any temperature."""
    import jax

    springs = js.Springs(SHEET, js.thermal.ThermalStiffness(80.0, 300.0, 400.0), 0.9)
    state = warm(SHEET, np.linspace(280.0, 420.0, 20))
    slope = jax.grad(lambda x: springs.energy(state.moved(x, state.velocity)))(state.position)
    for a, b in zip(slope, springs.force(state), strict=True):
        np.testing.assert_allclose(-a, b, atol=1e-12)


def fused(temperature, net=CHAIN, refreezing=None, state=None, scale=1.3):
    system = js.System(net, 1.0, js.Springs(net, 10.0, 1.0), rules=js.Fusing(net, 350.0, refreezing))
    start = warm(net, temperature, scale) if state is None else dataclasses.replace(state, temperature=jnp.asarray(temperature))
    return system, js.rollout(system, start, js.Still(), 0.1, 1).state


def test_fusing_breaks_for_good():
    """A spring whose mean is at the melting point or above breaks, and stays so when cold again."""
    _, hot = fused([300.0, 300.0, 400.0, 400.0, 300.0])
    assert CHAIN.flatten(hot.alive).tolist() == [True, False, False, False]
    system, cold = fused([300.0] * 5, state=hot)
    assert CHAIN.flatten(cold.alive).tolist() == [True, False, False, False]
    assert float(system.force(cold).x[3]) == 0


def test_refreezing_takes_the_present_length():
    """What comes back has no pull and no energy; within the hysteresis, or out of reach, nothing comes back."""
    again = js.thermal.Refreezing(hysteresis=20.0, reach=1.5)
    _, hot = fused([400.0] * 5, refreezing=again)
    assert not CHAIN.flatten(hot.alive).any()
    _, cool = fused([340.0] * 5, refreezing=again, state=hot)
    assert not CHAIN.flatten(cool.alive).any()
    system, cold = fused([320.0] * 5, refreezing=again, state=cool)
    assert CHAIN.flatten(cold.alive).all()
    np.testing.assert_allclose(CHAIN.flatten(cold.rest_length), 1.3, rtol=1e-14)
    np.testing.assert_allclose(system.force(cold).x, 0, atol=1e-13)
    assert float(system.energy(cold).potential[0]) == pytest.approx(0, abs=1e-20)
    _, far = fused([300.0] * 5, refreezing=js.thermal.Refreezing(20.0, reach=1.2), state=hot)
    assert not CHAIN.flatten(far.alive).any()


def test_refreezing_without_hysteresis():
    """At the melting point itself a spring stays broken; a hair below it comes back."""
    again = js.thermal.Refreezing(hysteresis=0.0, reach=2.0)
    _, hot = fused([400.0] * 5, refreezing=again)
    _, end = fused([350.0, 350.0, 350.0, 349.99, 349.99], refreezing=again, state=hot)
    assert CHAIN.flatten(end.alive).tolist() == [False, False, True, True]


def test_refreezing_under_expansion():
    """What comes back while its material is cooler or warmer than the reference has no pull there, and the length of that temperature."""
    springs = js.Springs(CHAIN, 10.0, 1.0, expansion=js.thermal.ThermalExpansion(2e-3, 400.0))
    system = js.System(CHAIN, 1.0, springs, rules=js.Fusing(CHAIN, 350.0, js.thermal.Refreezing(20.0, 2.0)))
    hot = js.rollout(system, warm(CHAIN, 400.0, 1.3), js.Still(), 0.1, 1).state
    cold = js.rollout(system, dataclasses.replace(hot, temperature=jnp.full(5, 300.0)), js.Still(), 0.1, 1).state
    assert CHAIN.flatten(cold.alive).all()
    np.testing.assert_allclose(system.force(cold).x, 0, atol=1e-13)
    np.testing.assert_allclose(CHAIN.flatten(cold.rest_length), 1.3 / 0.8, rtol=1e-14)


def test_a_melting_point_that_slipped_in_is_reported():
    """NaN put in after construction, by which nothing would ever melt, gives INVALID."""
    rule = eqx.tree_at(lambda r: r.melting, js.Fusing(CHAIN, 350.0), jnp.asarray(jnp.nan))
    state = rule.begin(warm(CHAIN, 400.0))
    assert bool(rule.update(js.Step(state, state, jnp.asarray(0.1)), state)[1].has(js.Flag.INVALID))


def test_broken_springs_by_where():
    """A broken spring with an infinite stiffness pulls by nothing, not by 0 times infinity."""
    springs = js.Springs(CHAIN, 10.0, 1.0)
    # Constructors refuse an infinite stiffness; `tree_at` does not ask them.
    endless = eqx.tree_at(lambda s: s.stiffness, springs, jnp.asarray([10.0, jnp.inf, 10.0, 10.0]))
    state = dataclasses.replace(warm(CHAIN, None, 1.3), alive=CHAIN.split(jnp.asarray([True, False, True, True])))
    np.testing.assert_allclose(endless.force(state).x, [3, -3, 3, 0, -3], atol=1e-13)


BARE = js.lattice((4, 5))
WHOLE_SHEET = js.topology.EdgeField(tuple(jnp.ones(shape, bool) for shape in SHEET.family_shapes))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: js.thermal.ThermalStiffness(-1.0, 300.0, 400.0), "stiffness"),
        (lambda: js.thermal.ThermalStiffness(1.0, 400.0, 400.0), "not below melting"),
        (lambda: js.thermal.ThermalStiffness(1.0, 300.0, 400.0, 0.0), "sharpness"),
        (lambda: js.thermal.Refreezing(-1.0, 1.0), "hysteresis"),
        (lambda: js.Fusing(CHAIN, float("nan")), "melting"),
        (lambda: js.Floor((0.0, 0.0), (0.0, 0.0)), "no length"),
        (lambda: js.Floor((0.0, 0.0), (0.0, 1.0), friction=-0.1), "friction"),
        (lambda: js.Floor((0.0, 0.0), (0.0, 1.0), restitution=1.5), "restitution"),
        (
            lambda: js.System(CHAIN, 1.0, rules=js.Fusing(CHAIN, 1.0, js.thermal.Refreezing(1.0, 1.0))).bind(float),
            "one Springs on the net of Fusing, whose rest lengths change; this system has 0",
        ),
        (
            lambda: js.System(CHAIN, 1.0, rules=js.Fusing(CHAIN, 1.0)).begin(dataclasses.replace(warm(CHAIN, 1.0), alive=WHOLE_SHEET)),
            "springs of another net than any of this system",
        ),
        (
            lambda: js.System(SHEET, 1.0, js.Springs(SHEET, 1.0, 1.0), rules=(js.Fusing(BARE, 1.0), js.Ledger())).bind(float),
            r"Fusing has a Lattice of \d+ springs .* Springs of this system have a Lattice of \d+ springs",
        ),
        (lambda: js.System(CHAIN, 1.0, rules=js.Fusing(CHAIN, 1.0)).begin(js.State.from_points(CHAIN, CHAIN.grid())), "from_points"),
    ],
)
def test_refusals(make, match):
    """Constants without meaning, and a state without temperature, are refused with what to do."""
    with pytest.raises(ValueError, match=match):
        make()


def test_fusing_beside_springs_of_other_nets():
    """One Springs on the net of Fusing is enough; a system without Springs may fuse for forces of its own."""
    beside = (js.Springs(SHEET, 1.0, 1.0), js.Springs(BARE, 1.0, 1.0))
    system = js.System(SHEET, 1.0, beside, rules=js.Fusing(BARE, 350.0))
    end = js.rollout(system, warm(SHEET, 400.0), js.Still(), 0.1, 1).state
    assert not BARE.flatten(end.alive).any()
    js.System(BARE, 1.0, js.Drag(1.0), rules=js.Fusing(BARE, 350.0)).bind(float)


# Compiled: one operation at a time it takes seconds.
after_floor = eqx.filter_jit(lambda floor, step, state: floor.update(step, state))


def on_floor(velocity, friction=0.0, restitution=0.0, height=0.1):
    """One node that flew with this velocity for 0.1 s and would end 0.1 m below the floor, or begins at this height; after the floor."""
    net = js.lattice(1)
    floor = js.Floor((0.0, 0.0), (0.0, 1.0), friction, restitution)
    before = js.State.from_points(net, [[0.0, height]], [velocity])
    moved = before.moved(before.position + 0.1 * before.velocity, before.velocity)
    return after_floor(floor, js.Step(before, moved, jnp.asarray(0.1)), moved)[0]


def test_floor():
    """From the impact on, half a step, the node goes out with e times the speed; friction takes mu times the impulse, and at most all."""
    fast = (3.0, -2.0)
    np.testing.assert_allclose(on_floor(fast).points, [[0.3, 0]], atol=1e-15)
    np.testing.assert_allclose(on_floor(fast).velocities, [[3, 0]])
    half = on_floor(fast, restitution=0.5)
    np.testing.assert_allclose((half.points, half.velocities), ([[0.3, 0.05]], [[3, 1]]), atol=1e-15)
    slowed = on_floor(fast, friction=0.4)
    np.testing.assert_allclose((slowed.points, slowed.velocities), ([[0.3 - 0.05 * 0.8, 0]], [[3 - 0.4 * 2, 0]]), atol=1e-15)
    stopped = on_floor(fast, friction=4.0)
    np.testing.assert_allclose((stopped.points, stopped.velocities), ([[0.15, 0]], [[0, 0]]), atol=1e-15)
    # What is thrown back presses more, and is braked more: by mu (1 + e) times the inward speed.
    np.testing.assert_allclose(on_floor(fast, 0.4, 0.5).velocities, [[3 - 0.4 * 1.5 * 2, 1]])
    # Above it nothing happens, however fast the node comes, and nothing to one that goes up.
    above = on_floor(fast, 0.4, 0.5, height=0.3)
    np.testing.assert_allclose((above.points, above.velocities), ([[0.3, 0.1]], [[3, -2]]), atol=1e-15)
    np.testing.assert_allclose(on_floor((3.0, 2.0), 4.0, height=0.0).velocities, [[3, 2]])
    # What begins below goes no deeper, and is not lifted.
    np.testing.assert_allclose(on_floor(fast, height=-0.2).points, [[0.3, -0.2]], atol=1e-15)
    np.testing.assert_allclose(on_floor((3.0, 1.0), height=-0.2).points, [[0.3, -0.1]], atol=1e-15)


def test_floor_anywhere(rng):
    """A plane in space that is not through the origin: nodes that pass it in a step without forces end on it, their inward speed gone."""
    net, p, n = js.lattice(6), np.array([0.3, -2.0, 1.0]), np.array([1.0, 2.0, -2.0])
    unit = n / 3
    x, v = p + rng.normal(size=(6, 3)) * 0.1 + 0.5 * unit, 10 * rng.normal(size=(6, 3))
    before = js.State.from_points(net, x, v)
    moved = before.moved(before.position + 0.1 * before.velocity, before.velocity)
    end, status = after_floor(js.Floor(p, n), js.Step(before, moved, jnp.asarray(0.1)), moved)
    flown = x + 0.1 * v
    height = (flown - p) @ unit
    assert 0 < (height < 0).sum() < 6
    np.testing.assert_allclose(end.points, flown - np.minimum(height, 0)[:, None] * unit, atol=1e-14)
    np.testing.assert_allclose(end.velocities, v - np.where(height < 0, v @ unit, 0)[:, None] * unit, atol=1e-14)
    assert int(status.flags) == 0


def test_a_floor_does_not_run_backward():
    """What a floor took is gone: a step back in time is INVALID."""
    state = js.State.from_points(CHAIN, CHAIN.grid())
    status = after_floor(js.Floor((0.0,), (1.0,)), js.Step(state, state, jnp.asarray(-0.1)), state)[1]
    assert bool(status.has(js.Flag.INVALID))
