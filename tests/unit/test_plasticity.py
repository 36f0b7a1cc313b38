"""Springs that yield, harden, creep and tear: against closed forms, with derivatives, on every kind of net."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.plasticity import Onset, Tearing, Yielding

PAIR = js.lattice(2)
K, YIELD, HARD = 100.0, 2.0, 25.0  # k [N/m], F_y [N], H [N/m]


class Path(eqx.Module):
    """The second node stands at these stretches of a spring of 1 m at t = 0, 1, 2 ... s, and moves evenly between."""

    stretches: jax.Array

    def __call__(self, time):
        times = jnp.arange(len(self.stretches), dtype=time.dtype)
        x = 1 + jnp.interp(time, times, self.stretches.astype(time.dtype))
        return js.Vector((jnp.stack([jnp.zeros_like(x), x]),))


def pulled(rules, stretches, k=K):
    """A spring of 1 m that is pulled along a path."""
    motion = js.Motion(np.array([False, True]), Path(jnp.asarray(stretches)))
    return js.System(PAIR, 1.0, js.Springs(PAIR, k, 1.0), free=np.zeros(2, bool), motion=motion, rules=(*rules, js.Ledger()))


def seen(state):
    """What the rule remembers of the spring, and what it has taken."""
    memory, account = state.memory[1].value, state.memory[2].value
    return {"stretch": memory.stretch, "slip": memory.slip, "taken": account.rules[0, 1], "moved": account.motion[1]}


@partial(jax.jit, static_argnums=2)
def driven(constants, stretches, per_second):
    """Pull, plastic stretch and slip after every step of a path, and the energy that the rule took and that motion gave."""
    k, y, h = constants
    system = pulled((Yielding(PAIR, y, hardening=h),), stretches, k)
    start = js.State.from_points(PAIR, jnp.zeros((2, 1), jnp.result_type(k)).at[1, 0].set(1.0))
    n_steps = per_second * (len(stretches) - 1)
    run = js.rollout(system, start, js.Still(), 1.0 / per_second, n_steps, save_every=1, observe=seen)
    found = {n: jax.vmap(PAIR.flatten)(f)[:, 0] if isinstance(f, js.topology.EdgeField) else f for n, f in run.saved.items()}
    e = jax.vmap(Path(stretches))(1.0 / per_second * (1 + jnp.arange(n_steps, dtype=k.dtype)))[0][:, 1] - 1
    return {"pull": k * (e - found["stretch"]), **found}


def constants(*values, dtype=float):
    return tuple(jnp.asarray(v, dtype) for v in (values or (K, YIELD, HARD)))


def loaded(k, y, h, e):
    """Pull and plastic stretch of a spring that is stretched once, from the equations of the yield surface."""
    return y + k * h / (k + h) * (e - y / k), (e - y / k) * k / (k + h)


def test_loading_unloading_and_reverse_yield():
    """k = 100, F_y = 2, H = 25 to .1 and back: f = 3.6, e_p = .064, then .0416 by reverse yield."""
    per_second = 7
    found = driven(constants(), jnp.array([0.0, 0.1, 0.0]), per_second)
    there, back = per_second - 1, 2 * per_second - 1
    np.testing.assert_allclose([found["pull"][there], found["stretch"][there]], [3.6, 0.064], rtol=1e-13)
    np.testing.assert_allclose(loaded(K, YIELD, HARD, 0.1), [3.6, 0.064], rtol=1e-13)
    np.testing.assert_allclose([found["stretch"][back], found["slip"][back]], [0.0416, 0.064 + 0.0224], rtol=1e-13)
    # The work of slipping from 0 to a is F_y a + H a^2 / 2, whatever the steps.
    a = np.asarray(found["slip"])
    np.testing.assert_allclose(found["taken"], -(YIELD * a + HARD * a**2 / 2), rtol=1e-12)


@pytest.mark.parametrize("per_second", [1, 5])
def test_a_perfectly_plastic_cycle_dissipates(per_second):
    """Between +-A a settled cycle takes 4 F_y (A - F_y / k), to rounding and at any dt; motion gives as much."""
    amplitude = 0.1
    path = jnp.array([0.0, *[amplitude, -amplitude] * 4])
    found = driven(constants(K, YIELD, 0.0), path, per_second)
    expected = 4 * YIELD * (amplitude - YIELD / K)
    for one in range(3, 7):  # from one turn to the same turn one cycle later
        begin, end = (i * per_second - 1 for i in (one, one + 2))
        assert found["taken"][end] - found["taken"][begin] == pytest.approx(-expected, rel=1e-12)
        assert found["moved"][end] - found["moved"][begin] == pytest.approx(expected, rel=1e-12)


def branches(at, per_second=7):
    """Pull and plastic stretch where the path is at its end, and plastic stretch one second later."""
    found = driven(tuple(at[:3]), jnp.array([0.0, 1.0, 0.0]) * at[3], per_second)
    i = per_second - 1
    return jnp.stack([found["pull"][i], found["stretch"][i], found["stretch"][2 * per_second - 1]])


@pytest.mark.slow
def test_derivatives_on_both_branches():
    """By k, F_y, H and the stretch: those of the closed forms and of central differences, where it yields and where it does not."""

    def closed(at):
        k, y, h, e = at
        pull, stretch = loaded(k, y, h, e)
        return jnp.stack([pull, stretch, stretch - (k * stretch - y - h * stretch) / (k + h)])

    def elastic(at):
        return jnp.stack([at[0] * at[3], 0 * at[0], 0 * at[0]])

    slope = jax.jit(jax.jacrev(branches))
    for e, form in ((0.1, closed), (0.015, elastic)):
        at = jnp.array([K, YIELD, HARD, e])
        found = slope(at)
        np.testing.assert_allclose(found, jax.jacfwd(form)(at), rtol=1e-11, atol=1e-12)
        step = 1e-5 * np.diag(np.asarray(at))
        differences = [(branches(at + h) - branches(at - h)) / (2 * np.linalg.norm(h)) for h in step]
        np.testing.assert_allclose(found, np.stack(differences, 1), rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_lanes_and_single_precision():
    """Under vmap each lane is the run by itself; in float32 the numbers agree to seven digits and stay float32."""
    many = tuple(jnp.asarray(v) for v in ([K, 80.0, K], [YIELD, 1.5, 30.0], [HARD, 0.0, HARD]))
    path = jnp.array([0.0, 0.1, 0.0])
    lanes = jax.vmap(lambda *c: driven(c, path, 7))(*many)
    for i in range(3):
        alone = driven(tuple(v[i] for v in many), path, 7)
        for name, value in alone.items():
            np.testing.assert_allclose(lanes[name][i], value, rtol=1e-12, atol=1e-15, err_msg=name)
    single = driven(constants(dtype=np.float32), path.astype(np.float32), 7)
    double = driven(constants(), path, 7)
    for name, value in single.items():
        assert value.dtype == np.float32
        np.testing.assert_allclose(value, double[name], rtol=3e-5, atol=3e-6, err_msg=name)


# --- creep -----------------------------------------------------------------------------------------------------------------------------


def relaxed(eta, y, dt, n_steps=8):
    """Pull of a spring that is held at a stretch of .1 after a time of .4 s."""
    system = js.System(PAIR, 1.0, js.Springs(PAIR, K, 1.0), free=np.zeros(2, bool), rules=Yielding(PAIR, y, hardening=HARD, viscosity=eta))
    state = js.rollout(system, js.State.from_points(PAIR, [[0.0], [1.1]]), js.Still(), dt, n_steps).state
    return K * (0.1 - PAIR.flatten(state.memory[1].value.stretch)[0])


@pytest.mark.parametrize("y", [0.0, YIELD], ids=["Maxwell", "overstress"])
def test_creep_follows_the_exponential(y):
    """Held at a stretch the overstress falls as exp(-(k + H) t / eta), at any dt, with its derivatives by eta and F_y."""

    def closed(eta, y, t=0.4):
        slip = (K * 0.1 - y) / (K + HARD) * -jnp.expm1(-(K + HARD) * t / eta)
        return K * (0.1 - slip)

    found = jax.jit(partial(relaxed, dt=0.05))
    for eta in (20.0, 200.0):
        assert float(found(eta, y)) == pytest.approx(float(closed(eta, y)), rel=1e-13)
        assert float(jax.jit(partial(relaxed, dt=0.4, n_steps=1))(eta, y)) == pytest.approx(float(closed(eta, y)), rel=1e-13)
    slopes = jax.grad(found, argnums=(0, 1))(20.0, y)
    np.testing.assert_allclose(slopes, jax.grad(closed, argnums=(0, 1))(20.0, y), rtol=1e-12)


# --- tearing ---------------------------------------------------------------------------------------------------------------------------


def torn_pull(at, stretches=(0.0, 0.3, 0.25)):
    """Pull of a spring that tears over a band, at the end of a path."""
    k, limit, band = at
    system = pulled((Tearing(PAIR, strain=limit, band=band),), jnp.asarray(stretches), k)
    run = js.rollout(system, js.State.from_points(PAIR, [[0.0], [1.0]]), js.Still(), 0.1, 10 * (len(stretches) - 1))
    return PAIR.flatten(system.forces[0].tension(run.state))[0], run.state


@pytest.mark.slow
def test_a_band_has_a_derivative():
    """At .25 after .3 the pull is that of the worst strain: value and derivatives by k, limit and band are the closed form's."""

    def closed(at):
        k, limit, band = at
        t = (0.3 - limit) / band
        return k * 0.25 * (1 - t**2 * (3 - 2 * t))

    at = jnp.array([K, 0.2, 0.4])
    f = jax.jit(jax.value_and_grad(torn_pull, has_aux=True))
    (value, _), found = f(at)
    assert float(value) == pytest.approx(float(closed(at)), rel=1e-12)
    np.testing.assert_allclose(found, jax.grad(closed)(at), rtol=1e-10)
    steps = 1e-5 * np.diag(np.asarray(at))
    differences = [(f(at + h)[0][0] - f(at - h)[0][0]) / (2 * np.linalg.norm(h)) for h in steps]
    np.testing.assert_allclose(found, differences, rtol=1e-7)
    # A band that is passed altogether breaks the spring, for good and with derivative zero.
    (value, state), found = f(jnp.array([K, 0.2, 0.05]))
    assert not PAIR.flatten(state.alive).any()
    np.testing.assert_array_equal([value, *found], 0.0)
    # As the band shrinks it tears within the band after the limit: what it took is what a spring that breaks at once held, to O(band).
    taken = [f(jnp.array([K, 0.2, band]))[0][1].memory[2].value.rules[0, 1] for band in (0.02, 0.005)]
    errors = np.abs(np.array(taken) + K * 0.21**2 / 2)
    assert errors[1] < 0.4 * errors[0]


def test_a_torn_spring_is_booked_with_what_it_held():
    """Pulled to .3 in steps of .03 it breaks in the one beyond .2, at k .21^2 / 2; by force alike; motion gave that much."""
    for rule, held in (
        (Tearing(PAIR, strain=0.2), K * 0.21**2 / 2),
        (Tearing(PAIR, force=25.0), K * 0.27**2 / 2),
        (Tearing(PAIR, strain=1.0), 0.0),
    ):
        system = pulled((rule,), jnp.array([0.0, 0.3]))
        end = js.rollout(system, js.State.from_points(PAIR, [[0.0], [1.0]]), js.Still(), 0.1, 10).state
        book = js.energy_ledger(system, end)
        assert book["rules"]["Tearing"]["Springs"] == pytest.approx(-held, rel=1e-12)
        assert abs(book["residual"]) < 1e-13
        first, when = rule.onset(end), {0.0: np.inf, K * 0.21**2 / 2: 0.7, K * 0.27**2 / 2: 0.9}[held]
        assert (int(first.count), int(first.spring)) == ((1, 0) if held else (0, -1))
        assert float(first.time) == pytest.approx(when, rel=1e-12)


# --- nets ------------------------------------------------------------------------------------------------------------------------------

SHEET = js.lattice((3, 4), js.STRUCTURAL + js.SHEAR)
EDGES = SHEET.edges
NETS = {
    "lattice": SHEET,
    "graph": js.Graph.from_edges(EDGES, 12),
    "overlay": js.lattice((3, 4), js.BEND).with_edges(EDGES),
}
RNG = np.random.default_rng(5)
POINTS = np.concatenate([SHEET.grid(), np.zeros((12, 1))], 1) + 0.05 * RNG.normal(size=(12, 3))
SPEEDS = 0.8 * RNG.normal(size=(12, 3))
STRENGTH = RNG.uniform(1.0, 2.0, len(EDGES))
LIMIT = RNG.uniform(0.25, 0.5, len(EDGES))


def sheet_on(net):
    """A sheet on a net that yields, per spring, and tears."""
    rest = np.linalg.norm(SHEET.grid()[EDGES[:, 0]] - SHEET.grid()[EDGES[:, 1]], axis=1)
    home = js.lattice((3, 4), js.BEND) if isinstance(net, js.topology.Overlay) else net
    rules = (Yielding(net, STRENGTH, hardening=5.0), Tearing(net, strain=LIMIT), js.Ledger())
    return js.System(home, 1.0, (js.Springs(net, 40.0, rest), js.Gravity((0.0, 0.0, -1.0))), rules=rules)


def in_users_order(net, state):
    """Points, plastic stretch, slip, and which springs hold."""
    memory = state.memory[2].value
    return state.points, net.flatten(memory.stretch), net.flatten(memory.slip), net.flatten(state.alive_of(net))


@pytest.fixture(scope="module")
def whole():
    """A run on every net, with its half."""
    found = {}
    for name, net in NETS.items():
        system = sheet_on(net)
        run = js.rollout(system, js.State.from_points(system.net, POINTS, SPEEDS), js.SymplecticEuler(), 0.01, 200, save_every=20)
        found[name] = system, jax.tree.map(lambda a: a[0], run.saved), run.state
    return found


@pytest.mark.slow
def test_all_nets_yield_alike(whole):
    """Lattice, graph and overlay give the same points, plastic stretches and torn springs, in the user's order; many of each."""
    system, _, end = whole["lattice"]
    expected = in_users_order(SHEET, end)
    for name, net in NETS.items():
        for a, b in zip(in_users_order(net, whole[name][2]), expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11, err_msg=name)
    yielded, torn = (rule.onset(end) for rule in system.rules[:2])
    assert int(yielded.count) > 10
    assert 0 < int(torn.count) < len(EDGES)
    assert int(torn.count) == int(np.sum(~np.asarray(expected[3])))
    assert 0 < float(yielded.time) < float(torn.time) < 2.0


@pytest.mark.slow
def test_a_whole_run_keeps_the_laws(whole):
    """No pull is above its yield force, the books close, plastic work is that of the slip, and momentum is kept."""
    for name, net in NETS.items():
        system, early, end = whole[name]
        book = js.energy_ledger(system, end)
        assert abs(book["residual"]) < 1e-12
        assert book["rules"]["Yielding"]["Springs"] < 0 > book["rules"]["Tearing"]["Springs"]
        np.testing.assert_allclose(np.asarray(system.momentum(end))[:2], SPEEDS.sum(0)[:2], rtol=1e-12)
        _, _, a, _ = in_users_order(net, end)
        pull = net.flatten(system.forces[0].tension(end))
        np.testing.assert_array_less(np.abs(pull), (np.asarray(STRENGTH) + 5.0 * a) * (1 + 1e-12))
        # Before anything tears.
        assert int(system.rules[1].onset(early).count) == 0 < int(system.rules[0].onset(early).count)
        b = np.asarray(in_users_order(net, early)[2])
        taken = js.energy_ledger(system, early)["rules"]["Yielding"]["Springs"]
        assert taken == pytest.approx(-np.sum(STRENGTH * b + 2.5 * b**2), rel=1e-11)


@pytest.mark.slow
def test_a_run_goes_on_bit_for_bit(whole, tmp_path):
    """Resumed from a half, or from a file, the run is the unbroken one; a file holds what is remembered in the user's order."""
    system, _, end = whole["graph"]
    net = NETS["graph"]
    start = js.State.from_points(net, POINTS, SPEEDS)
    half = js.rollout(system, start, js.SymplecticEuler(), 0.01, 100)
    js.save(tmp_path / "half.npz", half.state)
    back = js.load(tmp_path / "half.npz", like=system.begin(start))
    resumed = js.rollout(system, back, js.SymplecticEuler(), 0.01, 100, resume=half.resume).state
    for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(resumed), strict=True):
        np.testing.assert_array_equal(a, b)
    arrays = js.load(tmp_path / "half.npz")
    stretch = net.flatten(half.state.memory[2].value.stretch)
    assert np.abs(stretch).max() > 0
    np.testing.assert_array_equal(arrays["memory/2/value/stretch/families/0"], stretch)


@pytest.mark.slow
def test_equilibrium_holds_what_has_yielded_and_diffeqsolve_refuses():
    """A static shape keeps the plastic stretch; an adaptive solver names the rules; another system refuses the history."""
    system = js.System(PAIR, 1.0, (js.Springs(PAIR, K, 1.0), js.Gravity([5.0])), free=np.array([False, True]), rules=Yielding(PAIR, YIELD))
    start = js.State.from_points(PAIR, [[0.0], [1.03]])
    end = followed(system, start)
    found = js.equilibrium(system, end)
    js.raise_for_status(found)
    np.testing.assert_allclose(found.state.points[1, 0], 1 + (0.03 - YIELD / K) + 5.0 / K, rtol=1e-10)
    with pytest.raises(ValueError, match="Yielding: this acts after steps"):
        js.diffeqsolve(system, start, 1.0)
    with pytest.raises(ValueError, match="remembers something of Yielding"):
        dataclasses.replace(system, rules=()).force(end)


@pytest.mark.slow
def test_implicit_steps_yield():
    """Far above the explicit limit a chain yields with a status of OK, no pull above its yield force, and books that close."""
    net = js.lattice(4)
    rules = (Yielding(net, 8.0, hardening=100.0), js.Ledger())
    system = js.System(net, 1.0, (js.Springs(net, 1e3, 1.0), js.Drag(0.1)), rules=rules)
    run = js.rollout(system, js.State.from_points(net, 1.1 * net.grid(), 5 * (net.grid() - 1.5)), js.BackwardEuler(), 0.2, 10)
    js.raise_for_status(run)
    assert float(js.stable_dt(system, run.state, js.SymplecticEuler())) < 0.05
    assert int(rules[0].onset(run.state).count) == 3
    slip = net.flatten(system.recall(run.state, 2).slip)
    np.testing.assert_array_less(np.abs(net.flatten(system.forces[0].tension(run.state))), (8 + 100 * slip) * (1 + 1e-12))
    taken = js.energy_ledger(system, run.state)["rules"]["Yielding"]["Springs"]
    assert taken == pytest.approx(-float(np.sum(8 * slip + 50 * slip**2)), rel=1e-11)


# --- with other parts ------------------------------------------------------------------------------------------------------------------


def one_step(springs, rules, x=1.1, temperature=None, net=PAIR):
    """A system whose nodes are held, and the state after one step of a second."""
    system = js.System(net, 1.0, springs, free=np.zeros(net.n_nodes, bool), rules=rules)
    points = np.array([[0.0], [x]]) if np.ndim(x) == 0 else x
    return system, followed(system, js.State.from_points(net, points, temperature=temperature))


def followed(system, state):
    """The state after what rules do in a second in which nothing moves."""
    bound = system.bind(state.dtype)
    state = bound.begin(state)
    return bound.follow(state, state, jnp.asarray(1.0))[0]


def test_a_rest_length_is_expansion_and_then_plastic_stretch():
    """l = l_0 times the expansion, plus e_p: heated by 100 K a spring of 1 m is at rest at 1.2 m, and yields from there."""
    springs = js.Springs(PAIR, K, 1.0, expansion=js.thermal.ThermalExpansion(2e-3, 300.0))
    system, end = one_step(springs, Yielding(PAIR, YIELD), 1.3, temperature=400.0)
    assert float(PAIR.flatten(system.forces[0].natural_length(end))[0]) == pytest.approx(1.2 + 0.1 - YIELD / K, rel=1e-13)
    cold = dataclasses.replace(end, temperature=jnp.full(2, 300.0))
    assert float(PAIR.flatten(system.forces[0].natural_length(cold))[0]) == pytest.approx(1.0 + 0.1 - YIELD / K, rel=1e-13)


def test_a_yield_strain_is_a_force_of_the_present_stiffness():
    """F_y = k l eps, of a stiffness that falls with temperature, too."""
    soft = js.thermal.ThermalStiffness(K, 300.0, 400.0)
    for temperature, k in ((300.0, K), (350.0, K / 2)):
        system, end = one_step(js.Springs(PAIR, soft, 2.0), Yielding(PAIR, yield_strain=0.01), 2.1, temperature)
        assert float(PAIR.flatten(system.forces[0].tension(end))[0]) == pytest.approx(k * 2.0 * 0.01, rel=1e-12)


def test_ropes_and_projections():
    """A rope yields by pull alone; springs of the plane yield by their projected length."""
    for x, stretch in ((1.1, 0.08), (0.5, 0.0)):
        system, end = one_step(js.Springs(PAIR, K, 1.0, js.TensionOnly()), Yielding(PAIR, YIELD), x)
        assert float(PAIR.flatten(system.recall(end, 1).stretch)[0]) == pytest.approx(stretch, abs=1e-14)
    flat = js.Springs(PAIR, K, 1.0, axes=(0, 1))
    system, end = one_step(flat, Yielding(PAIR, YIELD), np.array([[0.0, 0.0, 0.0], [1.1, 0.0, 7.0]]))
    assert float(PAIR.flatten(system.recall(end, 1).stretch)[0]) == pytest.approx(0.08, rel=1e-12)


def test_several_rules_act_in_a_row():
    """A slider and a creeping damper on one net add their stretches; two bands multiply their shares."""
    system, end = one_step(js.Springs(PAIR, K, 1.0), (Yielding(PAIR, 4.0), Yielding(PAIR, 0.0, viscosity=K)))
    slider, damper = (float(PAIR.flatten(system.recall(end, i).stretch)[0]) for i in (1, 2))
    np.testing.assert_allclose([slider, damper], [0.06, 0.04 * -np.expm1(-1.0)], rtol=1e-13)
    assert float(PAIR.flatten(system.forces[0].tension(end))[0]) == pytest.approx(4.0 * np.exp(-1.0), rel=1e-12)
    system, end = one_step(js.Springs(PAIR, K, 1.0), (Tearing(PAIR, strain=0.05, band=0.1), Tearing(PAIR, force=2.5, band=5.0)))
    assert float(PAIR.flatten(system.forces[0].tension(end))[0]) == pytest.approx(K * 0.1 / 4, rel=1e-12)


def test_what_fuses_forgets_and_comes_back_at_rest():
    """A spring that melts forgets its plastic stretch, and refrozen it has no pull."""
    rules = (js.Fusing(PAIR, 350.0, js.thermal.Refreezing(20.0, 2.0)), Yielding(PAIR, YIELD))
    system, hard = one_step(js.Springs(PAIR, K, 1.0), rules, 1.1, temperature=300.0)
    assert float(PAIR.flatten(system.recall(hard, 2).stretch)[0]) == pytest.approx(0.08, rel=1e-12)
    for temperature in (400.0, 300.0):
        hard = followed(system, dataclasses.replace(hard, temperature=jnp.full(2, temperature)))
    assert PAIR.flatten(hard.alive).all()
    np.testing.assert_allclose(PAIR.flatten(system.forces[0].tension(hard)), 0.0, atol=1e-12)
    assert int(rules[1].onset(hard).count) == 1


def test_replace_and_traced_values_that_are_refused():
    """Yield force and limits are constants as all others; a bad one that slipped in, and a step back in time, give INVALID."""
    system, _ = one_step(js.Springs(PAIR, K, 1.0), (Yielding(PAIR, YIELD), Tearing(PAIR, strain=0.5)))
    assert float(js.replace(system, yield_force=3.0, strain=0.7).rules[0].yield_force) == 3.0
    bad = eqx.tree_at(lambda s: s.rules[0].yield_force, system, jnp.asarray(jnp.nan))
    start = js.State.from_points(PAIR, [[0.0], [1.1]])
    assert bool(bad.rules[0].invalid())
    assert not bool(system.rules[0].invalid() | system.rules[1].invalid())
    bound = system.bind(start.dtype)
    assert bool(bound.follow(bound.begin(start), bound.begin(start), jnp.asarray(-0.1))[1].has(js.Flag.INVALID))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Yielding(PAIR), "either yield_force .* or yield_strain"),
        (lambda: Yielding(PAIR, 1.0, 0.1), "either yield_force .* or yield_strain"),
        (lambda: Yielding(PAIR, -1.0), "yield_force = -1.0, but must be zero or more"),
        (lambda: Yielding(js.lattice(4), [1.0, np.nan, 1.0]), r"yield_force\[1\] = nan"),
        (lambda: Yielding(PAIR, [1.0, 2.0]), r"yield_force has shape \(2,\)"),
        (lambda: Yielding(PAIR, 1.0, hardening=-2.0), "hardening = -2.0"),
        (lambda: Yielding(PAIR, 1.0, viscosity=0.0), "viscosity = 0.0, but must be positive"),
        (lambda: Tearing(PAIR), "either strain or force"),
        (lambda: Tearing(PAIR, 0.1, 2.0), "either strain or force"),
        (lambda: Tearing(PAIR, strain=0.0), "strain = 0.0, but must be positive"),
        (lambda: Tearing(PAIR, strain=0.1, band=0.0), "band = 0.0, but must be positive"),
        (lambda: one_step(js.Drag(1.0), Yielding(PAIR, 1.0)), "Yielding needs one Springs on its net.*has 0"),
        (lambda: one_step((js.Springs(PAIR, 1.0), js.Springs(PAIR, 1.0)), Tearing(PAIR, force=1.0)), "Tearing needs one Springs.*has 2"),
        (lambda: one_step(js.Springs(PAIR, 1.0, 1.0), Yielding(PAIR.named("other"), 1.0)), "Yielding has a Lattice"),
        (lambda: one_step(js.Springs(PAIR, 1.0, 1.0, js.PowerLaw()), Yielding(PAIR, 1.0)), "have the law PowerLaw"),
        (lambda: one_step(js.Springs(PAIR, 1.0), Yielding(PAIR, yield_strain=0.1)), "yield_strain is a stretch over the rest length"),
        (lambda: one_step(js.Springs(PAIR, 1.0), Tearing(PAIR, strain=0.1)), "strain is a stretch over the rest length"),
        (lambda: Yielding(PAIR, yield_strain=0.1).strength(js.State.from_points(PAIR, [[0.0], [1.0]])), "knows no springs yet"),
        (
            lambda: one_step(
                js.Springs(PAIR, 1.0, 1.0), (js.Fusing(PAIR, 350.0, js.thermal.Refreezing(1.0, 2.0)), Tearing(PAIR, force=1.0)), 1.1, 300.0
            ),
            "refreezing brings back every broken spring",
        ),
    ],
)
def test_bad_input_is_named(make, message):
    """What could not be meant is refused where it is made, by field, with what to do."""
    with pytest.raises(ValueError, match=message):
        make()


def test_no_springs_at_all():
    """A net without springs has none that yield."""
    net = js.lattice(1)
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), rules=(Yielding(net, 1.0), Tearing(net, force=1.0, band=1.0)))
    end = js.rollout(system, js.State.from_points(net, [[0.0]], [[1.0]]), js.SymplecticEuler(), 0.1, 2).state
    found = system.rules[0].onset(end)
    assert isinstance(found, Onset)
    assert (int(found.count), int(found.spring)) == (0, -1)
