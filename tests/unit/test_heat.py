"""Heat against closed forms: discrete modes, slabs, tensors, cells, boundaries; what is refused, and how."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

FINE = js.JaxCG(tolerance=1e-14)
SCHEMES = [
    js.thermal.ExplicitHeat(),
    js.thermal.BackwardEulerHeat(FINE),
    js.thermal.CrankNicolsonHeat(FINE),
    js.thermal.SplitHeat(),
    js.thermal.SymmetricSplitHeat(),
]


def name(scheme):
    return type(scheme).__name__


def run(heat, temperature, dt, n_steps, net=None, points=None):
    """The rollout of a body that does not move."""
    net = heat.net if net is None else net
    start = js.State.from_points(net, net.grid() if points is None else points, temperature=temperature)
    result = js.rollout(js.System(net, 1.0, rules=heat), start, js.Still(), dt, n_steps)
    js.raise_for_status(result)
    return result.state


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES, ids=name)
def test_a_cosine_decays_by_its_discrete_factor(scheme):
    """On equal cells a product of cosines is a mode: each scheme multiplies it by its own factor a step, to 1e-12."""
    net, dt, g, c = js.lattice((6, 5, 4)), 0.3, 0.7, 1.3
    mode, rates = np.ones(net.shape), []
    for axis, (n, p) in enumerate(zip(net.shape, (2, 1, 3), strict=True)):
        shape = [n if a == axis else 1 for a in range(3)]
        mode = mode * np.cos(p * np.pi * (np.arange(n) + 0.5) / n).reshape(shape)
        rates.append(4 * g / c * np.sin(p * np.pi / (2 * n)) ** 2)
    total, turns = sum(rates), (rates[0], *rates[1:], *rates[1:])
    factor = {
        "ExplicitHeat": 1 - dt * total,
        "BackwardEulerHeat": 1 / (1 + dt * total),
        "CrankNicolsonHeat": (1 - dt * total / 2) / (1 + dt * total / 2),
        "SplitHeat": 1 / np.prod([1 + dt * r for r in rates]),
        # The springs of axis 0 come last, and take the step whole; those of the others take two halves.
        "SymmetricSplitHeat": np.prod([(1 - s * r / 2) / (1 + s * r / 2) for s, r in zip((dt, *[dt / 2] * 4), turns, strict=True)]),
    }[name(scheme)]
    end = run(js.Heat(net, c, g, scheme), mode.ravel(), dt, 5)
    np.testing.assert_allclose(end.temperature, mode * factor**5, atol=1e-12)


def test_the_sine_of_the_reference_page():
    """32 intervals between ends at zero, r = 0.4, 200 steps of sin(pi x): the middle is 0.4621196155, the discrete formula to 1e-14."""
    net = js.lattice(33)
    x = np.arange(33) / 32
    ends = js.thermal.FixedTemperature(net, (np.arange(33) % 32) == 0, 0.0)
    end = run(js.Heat(net, 1.0, 0.4, boundaries=ends), np.sin(np.pi * x), 1.0, 200)
    assert float(end.temperature[16]) == pytest.approx((1 - 1.6 * np.sin(np.pi / 64) ** 2) ** 200, rel=1e-13)
    assert float(end.temperature[16]) == pytest.approx(0.4621196155, abs=1e-10)


@pytest.mark.slow
def test_the_interface_of_a_two_layer_slab():
    """Steady ends at T1, T2: the interface is (c1 T1/d1 + c2 T2/d2) / (c1/d1 + c2/d2) with harmonic means; arithmetic ones miss it."""
    n, k, h = 12, 5, 0.1
    net = js.lattice(n)
    c = np.where(np.arange(n) <= k, 1.0, 0.2)
    t1, t2, d1, d2 = 400.0, 300.0, (k + 0.5) * h, (n - 1 - k - 0.5) * h
    expected = (1.0 * t1 / d1 + 0.2 * t2 / d2) / (1.0 / d1 + 0.2 / d2)
    ends = (js.thermal.FixedTemperature(net, np.arange(n) == 0, t1), js.thermal.FixedTemperature(net, np.arange(n) == n - 1, t2))

    def interface(conductance):
        heat = js.Heat(net, 1.0, conductance, js.thermal.BackwardEulerHeat(js.Skyline(net)), boundaries=ends)
        t = np.asarray(run(heat, 350.0, 1e6, 3).temperature)
        return t[k] + (t[k - 1] - t[k]) * -0.5  # half a spacing on, with the slope of the first layer

    assert interface(js.thermal.conductances(net, c, h, section=1e-2)) == pytest.approx(expected, abs=1e-8)
    arithmetic = 1e-2 / h * 0.5 * (c[1:] + c[:-1])
    assert abs(interface(arithmetic) - expected) > 0.5


@pytest.mark.slow
def test_a_tensor_conducts_what_it_says():
    """On theta = x'Ax/2 inside an anisotropic sheet the heat that enters a node is V tr(C A), to rounding; so in a block."""
    for shape, spacing, tensor in [
        ((5, 6), (0.3, 0.2), np.array([[3.0, 1.1], [1.1, 2.0]])),
        ((4, 5, 5), (0.3, 0.3, 0.2), np.array([[3.0, 0.4, -0.5], [0.4, 2.5, 0.3], [-0.5, 0.3, 2.0]])),
    ]:
        dim = len(shape)
        net = js.lattice(shape, js.STRUCTURAL + js.SHEAR)
        a = np.random.default_rng(1).normal(size=(dim, dim))
        a = a + a.T
        x = net.grid(spacing)
        heat = js.Heat(net, 1.0, js.thermal.conductances(net, tensor, spacing, section=0.5 if dim == 2 else 1.0))
        state = js.State.from_points(net, x, temperature=0.5 * np.einsum("ni,ij,nj->n", x, a, x))
        inner = heat.power(state)[(slice(1, -1),) * dim]
        volume = np.prod(spacing) * (0.5 if dim == 2 else 1.0)
        np.testing.assert_allclose(inner, volume * np.trace(tensor @ a), rtol=1e-10)


def test_cells_fill_the_body():
    """Equal cells add up to n h along each axis, half cells to (n - 1) h; a linear profile carries the same heat through every link."""
    net, spacing = js.lattice((3, 4)), (0.5, 0.2)
    assert float(js.thermal.EqualCells().volumes(net, spacing, 0.1).sum()) == pytest.approx(4 * 0.5 * 3 * 0.2 * 0.1)
    assert float(js.thermal.HalfCells().volumes(net, spacing, 0.1).sum()) == pytest.approx(3 * 0.5 * 2 * 0.2 * 0.1)
    half = js.thermal.conductances(net, 2.0, spacing, 0.1, js.thermal.HalfCells())
    along_x = np.asarray(net.flatten(half))[:9].reshape(3, 3)
    np.testing.assert_allclose(along_x, 2.0 * 0.1 * 0.2 / 0.5 * np.array([[0.5], [1.0], [0.5]]) * np.ones(3))
    c = js.thermal.capacities(net, 1000.0, 4.0, spacing, 0.1, js.thermal.HalfCells())
    np.testing.assert_allclose(c, 4000.0 * np.asarray(js.thermal.HalfCells().volumes(net, spacing, 0.1)))


def test_boundaries_by_hand(rng):
    """Flux, convection, radiation and a hot plane give each node the heat of their formulas, on a graph in the user's order."""
    net = js.Graph.from_edges([(3, 0), (0, 2), (2, 1)], 4)
    t, nodes = rng.uniform(300, 900, 4), np.array([True, False, True, True])
    h, area, flux = rng.uniform(1, 9, 4), rng.uniform(0.1, 1, 4), rng.normal(size=4)
    points = np.c_[rng.normal(size=(4, 2)), [0.0, 0.05, 0.15, 0.3]]
    plane = js.thermal.HotPlane((0, 0, 0), (0, 0, 2), 1000.0, 7.0, 0.5, reach=0.1, fade=0.1)
    terms = [
        (js.thermal.HeatFlux(net, nodes, flux, area), nodes * flux * area),
        (js.thermal.Convection(net, nodes, h, 280.0, area), nodes * h * area * (280.0 - t)),
        (js.thermal.Radiation(net, nodes, 0.8, lambda time: 500.0 + time, area), nodes * 0.8 * 5.670374419e-8 * area * (500.0**4 - t**4)),
        (plane, np.array([1, 1, 0.5, 0]) * 7.0 * 0.5 * (1000.0 - t)),
        (js.thermal.HotPlane((9, 9, 0.02), (0, 0, 1), 1000.0, 7.0, 0.5, reach=0.08), np.array([1, 1, 0, 0]) * 3.5 * (1000.0 - t)),
    ]
    state = js.State.from_points(net, points, temperature=t)
    for boundary, expected in terms:
        heat = js.Heat(net, 1.0, 0.0, boundaries=boundary, source=np.arange(4.0))
        np.testing.assert_allclose(net.flatten_nodes(heat.power(state)), expected + np.arange(4.0), rtol=1e-12)
        np.testing.assert_allclose(heat.supplied(state), heat.power(state))
        slope = boundary.slope(state, state.temperature)
        by_hand = js.thermal.ThermalBoundary.slope(boundary, state, state.temperature)
        np.testing.assert_allclose(jnp.zeros(4) if slope is None else slope, by_hand, rtol=1e-12)


def test_limit_of_an_explicit_step():
    """C / (sum of G and slopes) of the worst node that is free: a plane counts as if all touched it, radiation at the hotter one."""
    net = js.lattice(4)
    c, g, t = np.array([1.0, 2.0, 3.0, 4.0]), np.array([90.0, 2.0, 3.0]), np.array([300.0, 310.0, 320.0, 400.0])
    boundaries = (
        js.thermal.FixedTemperature(net, np.arange(4) == 0, 300.0),
        js.thermal.Radiation(net, np.arange(4) == 2, 0.2, 900.0, 2.0),
        js.thermal.Convection(net, np.arange(4) == 3, 7.0, 280.0, 0.5),
        js.thermal.HotPlane((0.0,), (1.0,), 400.0, 5.0, 0.2, reach=-99.0),
    )
    radiation = 4 * 0.2 * 5.670374419e-8 * 2.0 * 900.0**3
    rate = (np.array([90.0, 92.0, 5.0, 3.0]) + [0, 0, radiation, 3.5] + 1.0) / c
    state = js.State.from_points(net, net.grid(), temperature=t)
    for held, worst in ((boundaries, rate[1:].max()), (boundaries[1:], rate.max())):
        limit = js.Heat(net, c, g, boundaries=held).limit(state)
        assert float(limit) == pytest.approx(1 / worst, rel=1e-12)
    assert rate[2] < rate[1] < rate[0]
    hot = js.Heat(net, c, [1.0, 2.0, 3.0], boundaries=boundaries[:2])
    assert float(hot.limit(state)) == pytest.approx(3.0 / (5.0 + radiation), rel=1e-12)
    seldom = js.Heat(net, c, g, boundaries=boundaries, substeps=6, every=2)
    assert float(seldom.limit(state)) == pytest.approx(3 / rate[1:].max(), rel=1e-12)


def test_nothing_limits_implicit_heat_of_nodes_that_stand_still():
    """`stable_dt` with `Still` is infinite where heat is implicit, or there is none, and that of heat where it is explicit."""
    net = js.lattice(3)
    state = js.State.from_points(net, net.grid(), temperature=300.0)
    for rules, expected in ((js.Heat(net, 1.0, 2.0, js.thermal.BackwardEulerHeat()), np.inf), ((), np.inf), (js.Heat(net, 1.0, 2.0), 0.25)):
        assert float(js.stable_dt(js.System(net, 1.0, rules=rules), state, js.Still())) == expected


@pytest.mark.slow
def test_radiation_that_gets_too_hot_for_dt_is_reported():
    """A step that is short enough at 300 K and too long at 400 K gives DT_LIMIT with step and node, in the rule's name; a short one does
    not, nor an implicit one, nor a node that is held.
    """
    net, hottest = js.lattice(20), np.arange(20) == 7
    points, source = net.grid(), np.where(hottest, 1000.0, 900.0)
    start = js.State.from_points(net, points, temperature=300.0)

    def go(scheme, dt, n_steps, *more):
        boundaries = (js.thermal.Radiation(net, np.ones(20, bool), 1.0, 300.0, 1.0), *more)
        heat = js.Heat(net, 1.0, 0.0, scheme, source=source, boundaries=boundaries)
        return js.rollout(js.System(net, 1.0, rules=heat), start, js.Still(), dt, n_steps)

    with pytest.warns(js.StabilityWarning, match="dt = 0.14 s was below stable_dt at the start, but later.*a node became too hot"):
        long = go(js.thermal.ExplicitHeat(), 0.14, 40)
    assert bool(long.status.has(js.Flag.DT_LIMIT))
    assert (int(long.status.step), int(long.status.node), int(long.status.effect)) == (2, 7, 0)
    short = go(js.thermal.ExplicitHeat(), 0.03, 1000)
    assert int(short.status.flags) == 0
    settled = (source / 5.670374419e-8 + 300.0**4) ** 0.25
    np.testing.assert_allclose(short.state.temperature, settled, rtol=1e-9)
    assert int(go(js.thermal.BackwardEulerHeat(), 0.14, 40).status.flags) == 0
    held = go(js.thermal.ExplicitHeat(), 0.14, 40, js.thermal.FixedTemperature(net, np.ones(20, bool), lambda t: 300.0 + t))
    assert int(held.status.flags) == 0


def test_radiation_pulls_back_below_zero():
    """Below 0 K, where a step too long may lead, the loss is odd: -50 K lacks what 50 K radiates, and the slope is its derivative."""
    net, factor = js.lattice(2), 0.8 * 5.670374419e-8 * 0.5
    boundary = js.thermal.Radiation(net, np.ones(2, bool), 0.8, 300.0, 0.5)
    state = js.State.from_points(net, net.grid(), temperature=[-50.0, 50.0])
    np.testing.assert_allclose(boundary.power(state, state.temperature), factor * (300.0**4 + np.array([1, -1]) * 50.0**4), rtol=1e-13)
    slope = js.thermal.ThermalBoundary.slope(boundary, state, state.temperature)
    np.testing.assert_allclose(boundary.slope(state, state.temperature), slope, rtol=1e-12)


def test_heat_steps_within_a_step_see_their_own_time():
    """Explicit steps take a source at their start: t^2 in steps, or substeps, of 0.05 s adds the sum of t_i^2 0.05, also with `every`."""
    net = js.lattice(1)
    for options, dt, n_steps in (({}, 0.05, 20), ({"substeps": 10}, 0.5, 2), ({"substeps": 20, "every": 2}, 0.5, 2)):
        heat = js.Heat(net, 1.0, 0.0, source=lambda t: t * t, **options)
        end = run(heat, 300.0, dt, n_steps, points=np.zeros((1, 1)))
        assert float(end.temperature[0]) == pytest.approx(300 + np.sum((0.05 * np.arange(20)) ** 2) * 0.05, rel=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(("every", "dtype"), [(2, "float32"), (4, "float64")])
@pytest.mark.parametrize("start", [0.0, 0.05, 0.075, 0.25, 0.3, 1234.567])
def test_heat_that_comes_seldom_comes_as_often_from_any_start(start, every, dtype):
    """1 W for 4.8 s warms by 4.8 K in one run, in pieces of 7 steps and in resumed ones, to one heat step; dt = 0 does not warm at all."""
    net, n_steps = js.lattice(3), 48
    system = js.System(net, 1.0, rules=js.Heat(net, 1.0, 0.01, source=1.0, every=every))
    first = js.State.from_points(net, net.grid().astype(dtype), temperature=np.full(3, 300.0, dtype), time=start)
    assert first.dtype == dtype
    unbroken = js.rollout(system, first, js.Still(), 0.1, n_steps)
    pieces, resumed, resume = first, first, None
    for n in (7, 7, 7, 7, 7, 7, 6):
        pieces = js.rollout(system, pieces, js.Still(), 0.1, n).state
        run = js.rollout(system, resumed, js.Still(), 0.1, n, resume=resume)
        resumed, resume = run.state, run.resume
    for end in (unbroken.state, pieces):
        assert abs(float(end.temperature.mean()) - 304.8) <= 0.1 * every + 1e-3
    np.testing.assert_array_equal(resumed.temperature, unbroken.state.temperature)
    np.testing.assert_array_equal(js.rollout(system, first, js.Still(), 0.0, 8).state.temperature, first.temperature)


@pytest.mark.slow
def test_heat_that_comes_seldom_follows_a_change_of_dt():
    """Runs of 0.1 s, 0.2 s and 0.04 s a step, one after the other, warm by 1 K/s, each to one heat step of its own."""
    net = js.lattice(3)
    system = js.System(net, 1.0, rules=js.Heat(net, 1.0, 0.01, source=1.0, every=2))
    state = js.State.from_points(net, net.grid(), temperature=300.0)
    for dt, n_steps in ((0.1, 11), (0.2, 30), (0.04, 50)):
        before, state = state, js.rollout(system, state, js.Still(), dt, n_steps).state
        assert abs(float(state.temperature[0] - before.temperature[0]) - dt * n_steps) <= 2 * dt + 1e-9


def test_what_starts_at_the_melting_point_is_solid():
    """Up to the melting point no latent heat has been taken up, above it all; a node at it then melts at a constant temperature."""
    net = js.lattice(3)
    heat = js.Heat(net, 2.0, 0.0, latent=js.thermal.LatentHeat(350.0, 20.0), source=10.0)
    start = heat.begin(js.State.from_points(net, net.grid(), temperature=[349.0, 350.0, 351.0]))
    np.testing.assert_array_equal(start.enthalpy, [0, 0, 20])
    end = run(heat, np.array([349.0, 350.0, 351.0]), 0.1, 5)
    np.testing.assert_allclose(end.temperature, [350.0, 350.0, 353.5], rtol=1e-14)
    np.testing.assert_allclose(end.enthalpy, [3.0, 5.0, 20.0], rtol=1e-12)


def test_springs_that_broke_do_not_conduct():
    """With `cut_by`, a broken structural spring of a sheared net conducts nothing; without it, or without memory of breaks, an error."""
    net, body = js.lattice((2, 3)), js.lattice((2, 3), js.STRUCTURAL + js.SHEAR)
    start = js.State.from_points(body, body.grid(), temperature=np.arange(6.0))
    whole = np.ones(body.n_springs, bool)
    whole[[0, 2]] = False  # both springs between the first two columns
    alive = js.topology.EdgeField(tuple(a > 0.5 for a in body.split(jnp.asarray(whole, float)).families))
    heat = js.Heat(net, 1.0, 1.0, cut_by=body)
    cut = heat.power(dataclasses.replace(start, alive=alive))
    np.testing.assert_allclose(jnp.ravel(cut), [3, 1 + 3, -1 + 3, -3, 1 - 3, -1 - 3], atol=1e-14)
    with pytest.raises(ValueError, match="alive` is None"):
        heat.power(start)
    with pytest.raises(ValueError, match="every spring of net is one of cut_by"):
        js.Heat(body, 1.0, 1.0, cut_by=net)
    with pytest.raises(ValueError, match="same order"):
        js.Heat(js.Graph.from_edges([(0, 1)], 3), 1.0, 1.0, cut_by=js.Graph.from_edges([(1, 2)], 3))


def test_refusals():
    """What cannot be honoured is an error that names it."""
    net, sheet = js.lattice(3), js.lattice((3, 3), js.STRUCTURAL + js.SHEAR)
    for error, match, make in [
        (ValueError, r"capacity\[1\] = 0.0", lambda: js.Heat(net, [1.0, 0.0, 1.0], 1.0)),
        (ValueError, r"conductance\[0\] = -1.0", lambda: js.Heat(net, 1.0, [-1.0, 1.0])),
        (ValueError, "substeps = 0", lambda: js.Heat(net, 1.0, 1.0, substeps=0)),
        (TypeError, "scheme is a str", lambda: js.Heat(net, 1.0, 1.0, "explicit")),
        (TypeError, r"boundaries\[0\] is a float; expected a ThermalBoundary", lambda: js.Heat(net, 1.0, 1.0, boundaries=300.0)),
        (TypeError, r"write BackwardEulerHeat\(", lambda: js.Heat(net, 1.0, 1.0, js.thermal.BackwardEulerHeat)),
        (TypeError, r"forces\[0\] is a Heat, .* in rules=", lambda: js.System(net, 1.0, js.Heat(net, 1.0, 1.0))),
        (TypeError, r"forces\[0\] is a float", lambda: js.System(net, 1.0, 9.81)),
        (TypeError, r"rules\[0\] is a float", lambda: js.System(net, 1.0, rules=9.81)),
        (ValueError, "section = -1.0", lambda: js.thermal.capacities(net, 1.0, 1.0, 1.0, section=-1.0)),
        (ValueError, "section = nan", lambda: js.thermal.conductances(net, 1.0, 1.0, section=np.nan)),
        (ValueError, r"section has shape \(3,\)", lambda: js.thermal.capacities(net, 1.0, 1.0, 1.0, section=np.ones(3))),
        (ValueError, r"section has shape \(2,\)", lambda: js.thermal.conductances(net, 1.0, 1.0, section=np.ones(2))),
        (ValueError, "emissivity = 1.5", lambda: js.thermal.Radiation(net, np.ones(3, bool), [0.5, 1.5, 1.0], 300.0, 1.0)),
        (ValueError, "not symmetric", lambda: js.thermal.conductances(sheet, np.array([[1e-9, 5e-10], [1e-10, 1e-9]]), 1.0)),
        (TypeError, r"boundaries\[0\] is a int", lambda: js.Heat(net, 1.0, 1.0, boundaries=(3,))),
        (ValueError, "axes, but springs", lambda: js.Heat(sheet, 1.0, 1.0, js.thermal.SplitHeat())),
        (ValueError, "this net is a Graph", lambda: js.Heat(js.Graph.from_edges([(0, 1)], 2), 1.0, 1.0, js.thermal.SplitHeat())),
        (ValueError, "periodic axis", lambda: js.Heat(js.lattice(5, periodic=True, box=[5.0]), 1.0, 1.0, js.thermal.SplitHeat())),
        (TypeError, "expected booleans", lambda: js.thermal.FixedTemperature(net, [0, 1, 2], 300.0)),
        (ValueError, "normal has no length", lambda: js.thermal.HotPlane((0, 0), (0, 0), 300.0, 1.0, 1.0, 0.1)),
        (ValueError, "latent = -1.0", lambda: js.thermal.LatentHeat(300.0, -1.0)),
        (ValueError, "too oblique|Tensor", lambda: js.thermal.conductances(sheet, [[1.0, 0.0], [0.0, 1.0]] + 2 * (1 - np.eye(2)), 1.0)),
        (ValueError, "not symmetric", lambda: js.thermal.conductances(sheet, np.array([[1.0, 0.5], [0.0, 1.0]]), 1.0)),
        (ValueError, "STRUCTURAL", lambda: js.thermal.conductances(js.lattice((3, 3)), np.array([[1.0, 0.5], [0.5, 1.0]]), 1.0)),
        (ValueError, "of a lattice", lambda: js.thermal.capacities(js.Graph.from_edges([(0, 1)], 2), 1.0, 1.0, 1.0)),
        (ValueError, "tolerance", lambda: js.thermal.HeatIteration(tolerance=-1.0)),
    ]:
        with pytest.raises(error, match=match):
            make()
    cold = js.State.from_points(net, net.grid())
    with pytest.raises(ValueError, match="needs a temperature"):
        js.System(net, 1.0, rules=js.Heat(net, 1.0, 1.0)).begin(cold)
    wet = dataclasses.replace(cold, temperature=jnp.ones(3), enthalpy=jnp.ones(3))
    with pytest.raises(ValueError, match="knows no melting"):
        js.System(net, 1.0, rules=js.Heat(net, 1.0, 1.0)).begin(wet)


def test_fields_of_another_shape_are_refused():
    """Areas, melting points and masks that are not those of the net would broadcast along an axis of a lattice: each is an error."""
    net, chain = js.lattice((4, 4)), js.lattice(4)

    def plane(area):
        return js.thermal.HotPlane((0.0, 0.0), (0.0, 1.0), 400.0, 5.0, area, reach=1.0)

    for match, more in [
        (r"boundaries\[0\]\.area has shape \(4,\); expected .*\(16,\)", {"boundaries": plane(np.arange(4.0))}),
        (r"latent\.melting has shape \(4,\)", {"latent": js.thermal.LatentHeat([290.0, 310.0, 350.0, 400.0], 1.0)}),
        (r"latent\.latent has shape \(4,\)", {"latent": js.thermal.LatentHeat(290.0, np.ones(4))}),
        (
            r"boundaries\[1\] \(FixedTemperature\) names nodes on a net of shape \(4,\); expected \(4, 4\)",
            {"boundaries": (plane(1.0), js.thermal.FixedTemperature(chain, np.arange(4) < 1, 400.0))},
        ),
        (r"\(HeatFlux\) names nodes", {"boundaries": js.thermal.HeatFlux(chain, np.arange(4) < 1, 1.0, 1.0)}),
    ]:
        with pytest.raises(ValueError, match=match):
            js.Heat(net, 1.0, 1.0, **more)


@pytest.mark.parametrize("net", [js.lattice((2, 2)), js.Graph.from_edges([(3, 0), (0, 2), (2, 1)], 4)], ids=["lattice", "graph"])
def test_areas_and_melting_points_are_in_the_users_order(net):
    """A plane with one area per node, and a melting point per node, act on the nodes that the user numbered."""
    area, melting = np.array([1.0, 2.0, 3.0, 4.0]), np.array([290.0, 310.0, 350.0, 400.0])
    plane = js.thermal.HotPlane((0.0, 0.0), (0.0, 1.0), 400.0, 5.0, area, reach=9.0)
    heat = js.Heat(net, 1.0, 0.0, boundaries=plane, latent=js.thermal.LatentHeat(melting, area))
    state = js.State.from_points(net, np.zeros((4, 2)), temperature=320.0)
    np.testing.assert_allclose(net.flatten_nodes(heat.power(state)), 5.0 * area * 80.0, rtol=1e-14)
    np.testing.assert_array_equal(net.flatten_nodes(heat.begin(state).enthalpy), [1.0, 2.0, 0.0, 0.0])


def test_a_bad_constant_that_slipped_in_is_reported():
    """A negative capacity put in after construction, and a step backward in time, give INVALID."""
    net = js.lattice(3)
    heat = js.Heat(net, 1.0, 0.1, js.thermal.BackwardEulerHeat())
    start = js.State.from_points(net, net.grid(), temperature=300.0)
    bad = eqx.tree_at(lambda h: h.capacity, heat, jnp.asarray(-1.0))
    assert bool(js.rollout(js.System(net, 1.0, rules=bad), start, js.Still(), 0.1, 1).status.has(js.Flag.INVALID))
    assert bool(js.rollout(js.System(net, 1.0, rules=heat), start, js.Still(), -0.1, 1).status.has(js.Flag.INVALID))
