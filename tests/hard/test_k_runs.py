"""Hard cases K2, K7 and K12: runs that go on, alarms on good runs, and statuses of batches."""

import pickle
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag, Status

NET = js.lattice(3)
POINTS = np.array([[0.0], [1.1], [1.9]])
SYSTEM = js.System(NET, 1.0, (js.Springs(NET, 20.0, 0.9), js.Drag(0.3)), free=np.array([False, True, True]))
STEPPERS = [js.VelocityVerlet(), js.BDF2(newton=False)]


def start(dtype=float):
    return js.State.from_points(NET, POINTS.astype(dtype))


def same(a, b):
    """Whether two trees have the same bits."""
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


CHANGES = {
    "dt": lambda system, state, dt: (system, state, 0.5 * dt),
    "constant": lambda system, state, dt: (js.replace(system, stiffness=35.0), state, dt),
    "position": lambda system, state, dt: (system, eqx.tree_at(lambda s: s.position, state, 1.05 * state.position), dt),
    "time": lambda system, state, dt: (system, eqx.tree_at(lambda s: s.time, state, state.time + 1.0), dt),
    "free": lambda system, state, dt: (js.System(NET, 1.0, system.forces), state, dt),
}


@pytest.mark.parametrize("stepper", STEPPERS, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("change", [*CHANGES, "nothing"])
def test_k2_a_run_goes_on_after_a_change(stepper, change):
    """With another dt, constant, state, time or hold, the resumed run is the one that starts afresh from that state, time counted from the
    state's; with none it is the unbroken one, bit for bit, whatever is observed.
    """
    first = js.rollout(SYSTEM, start(), stepper, 0.02, 5)
    if change == "nothing":
        on = js.rollout(SYSTEM, first.state, stepper, 0.02, 7, 1, lambda s: s.time, js.StoreAll(), resume=first.resume)
        expected = js.rollout(SYSTEM, start(), stepper, 0.02, 12)
        np.testing.assert_array_equal(on.saved, 0.02 * np.arange(6, 13))
    else:
        system, state, dt = CHANGES[change](SYSTEM, first.state, 0.02)
        on = js.rollout(system, state, stepper, dt, 7, resume=first.resume)
        expected = js.rollout(system, state, stepper, dt, 7)
        np.testing.assert_allclose(on.state.time, state.time + 7 * dt, rtol=1e-14)
    for a, b in zip(jax.tree.leaves(on.state), jax.tree.leaves(expected.state), strict=True):
        np.testing.assert_allclose(a, b, rtol=0 if change == "nothing" else 1e-14, atol=0)
    assert int(on.info.n_steps) == int(on.resume.step) == 12
    assert on.status.describe() == "OK"


def test_k2_a_history_of_another_dt_is_not_used():
    """A free node at 1 m/s, two steps of 0.1 s and one of 0.01 s by BDF2: 0.21 m, in one run of 1 step and in two of 0."""
    net = js.lattice(1)
    system, state = js.System(net, 1.0), js.State.from_points(net, [[0.0]], [[1.0]])
    first = js.rollout(system, state, js.BDF2(newton=False), 0.1, 2)
    none = js.rollout(system, first.state, js.BDF2(newton=False), 0.01, 0, resume=first.resume)
    for before in (first, none):
        run = js.rollout(system, before.state, js.BDF2(newton=False), 0.01, 1, resume=before.resume)
        assert float(run.state.position.x[0]) == pytest.approx(0.21, rel=1e-12)
        assert float(run.state.time) == pytest.approx(0.21, rel=1e-12)
    assert int(none.resume.step) == 2


def test_k2_loads_in_time_by_numpy():
    """A push that comes at 0.6 s, 50 steps of 0.01 s, then 100 of 0.005 s: the slides' update in NumPy, time from the state's."""
    push = js.Load(lambda t: js.Vector((jnp.stack([0 * t, jnp.where(t > 0.6, 1.0, 0.0), 0 * t]),)))
    system = js.System(NET, 1.0, push)
    a = js.rollout(system, start(), js.SymplecticEuler(), 0.01, 50)
    b = js.rollout(system, a.state, js.SymplecticEuler(), 0.005, 100, resume=a.resume)
    x, v, t = POINTS[1, 0], 0.0, 0.0
    for dt, n in ((0.01, 50), (0.005, 100)):
        begun = t
        for i in range(n):
            v += dt * (begun + i * dt > 0.6)
            x, t = x + dt * v, begun + (i + 1) * dt
    np.testing.assert_allclose([b.state.time, b.state.points[1, 0], b.state.velocities[1, 0]], [t, x, v], rtol=1e-12)


def test_k2_another_function_is_seen():
    """Verlet's carried acceleration is of the old load: with another function of time, or one that holds another number, it is made anew; a
    function written again that says the same changes nothing.
    """

    def pushed(strength):
        return js.System(NET, 1.0, js.Load(lambda t: js.Vector((jnp.stack([0 * t, strength + 0 * t, 0 * t]),))))

    first = js.rollout(pushed(1.0), start(), js.VelocityVerlet(), 0.1, 1)
    for strength in (1.0, 3.0):
        run = js.rollout(pushed(strength), first.state, js.VelocityVerlet(), 0.1, 1, resume=first.resume)
        assert float(run.state.velocities[1, 0]) == pytest.approx(0.1 + 0.1 * strength, rel=1e-12)
    origin = js.rollout(pushed(1.0), start(), js.VelocityVerlet(), 0.1, 0).resume.origin
    assert origin == first.resume.origin
    assert origin != js.rollout(pushed(3.0), start(), js.VelocityVerlet(), 0.1, 0).resume.origin


def test_k2_heat_and_motion_go_on():
    """1 W and a node moved at 2 m/s, 4 steps of 0.1 s and 8 of 0.05 s with heat every fourth: 0.8 K and 1.6 m."""
    motion = js.Motion(np.array([True, False, False]), lambda t: js.Vector((jnp.array([2.0, 0.0, 0.0]) * t,)))
    system = js.System(NET, 1.0, motion=motion, rules=js.Heat(NET, 1.0, 0.0, source=1.0, every=4))
    state = js.State.from_points(NET, POINTS, temperature=300.0)
    a = js.rollout(system, state, js.SymplecticEuler(), 0.1, 4)
    b = js.rollout(system, a.state, js.SymplecticEuler(), 0.05, 8, resume=a.resume)
    np.testing.assert_allclose(b.state.temperatures, 300.8, rtol=1e-12)
    np.testing.assert_allclose(b.state.points[0, 0], 1.6, rtol=1e-12)


def test_k2_what_cannot_go_on_is_refused_by_name():
    """Another stepper, option, dtype, topology or list of effects, a result in place of its resume, and a batch's resume: one sentence."""
    resume = js.rollout(SYSTEM, start(), js.BDF2(newton=False), 0.02, 0).resume

    def refused(kind, match, system=SYSTEM, state=None, stepper=STEPPERS[1], given=resume):
        with pytest.raises(kind, match=match):
            js.rollout(system, start() if state is None else state, stepper, 0.02, 2, resume=given)

    refused(ValueError, "of a run by BDF2, but the stepper is VelocityVerlet.*Leave resume out", stepper=js.VelocityVerlet())
    refused(ValueError, r"stepper had solver.tolerance = None; here it is 0.1", stepper=js.BDF2(js.JaxCG(tolerance=0.1), newton=False))
    refused(ValueError, "in float64; this one is in float32", state=start(np.float32))
    refused(ValueError, "with Springs on a Lattice.*Drag; this one is with Springs", js.System(NET, 1.0, SYSTEM.forces[0]))
    ring = js.Graph.from_edges([(0, 1), (1, 2), (2, 0)], 3)
    other = js.System(ring, 1.0, (js.Springs(ring, 20.0, 0.9), js.Drag(0.3)))
    refused(ValueError, "on a Lattice of 3 nodes and 2 springs.*on a Graph of 3", other, js.State.from_points(ring, POINTS))
    refused(TypeError, "resume is a tuple", given=(1, 2))
    refused(ValueError, r"of a batch of \(4,\) runs", given=jax.tree.map(lambda a: jnp.stack([a] * 4), resume))


@pytest.mark.filterwarnings("ignore::jaxspring.StabilityWarning")
def test_k2_start_checks_run_on_resume():
    """A dt above the limit, a negative stiffness and a NaN show at the step where the run goes on."""
    stepper = js.SymplecticEuler()
    first = js.rollout(SYSTEM, start(), stepper, 0.02, 5)
    spoilt = eqx.tree_at(lambda s: s.position.components[0], first.state, first.state.position.x.at[2].set(jnp.nan))
    negative = eqx.tree_at(lambda s: s.forces[0].stiffness, SYSTEM, jnp.asarray(-1.0))
    for system, state, dt, flag, word in (
        (SYSTEM, first.state, 1.0, Flag.DT_LIMIT, "step 5"),
        (negative, first.state, 0.02, Flag.INVALID, "step 5, effect Springs"),
        (SYSTEM, spoilt, 0.02, Flag.NONFINITE, "step 5, node 2"),
    ):
        run = js.rollout(system, state, stepper, dt, 2, resume=first.resume)
        assert bool(run.status.has(flag))
        assert word in run.status.describe(run.effects)


def test_k2_a_resume_is_pickled_and_saved(tmp_path):
    """After pickle, and after save and load, the run goes on bit for bit."""
    first = js.rollout(SYSTEM, start(), STEPPERS[1], 0.02, 5)
    expected = js.rollout(SYSTEM, start(), STEPPERS[1], 0.02, 12)
    js.save(tmp_path / "run.npz", (first.state, first.resume))
    saved = js.load(tmp_path / "run.npz", like=(start(), js.rollout(SYSTEM, start(), STEPPERS[1], 0.02, 0).resume))
    for state, resume in (pickle.loads(pickle.dumps((first.state, first.resume))), saved):
        run = js.rollout(SYSTEM, state, STEPPERS[1], 0.02, 7, resume=resume)
        assert same(run.state, expected.state)
        assert same(run.resume, expected.resume)


def test_k2_joined_runs_have_the_derivative_of_one():
    """Under jit, grad by stiffness and by dt: 3 + 4 steps as 7, and chunks under a scan; a batch in which one lane changes dt."""

    def joined(k, dt, dt_then):
        system = js.replace(SYSTEM, stiffness=k)
        a = js.rollout(system, start(), js.VelocityVerlet(), dt, 3)
        b = js.rollout(system, a.state, js.VelocityVerlet(), dt_then, 4, resume=a.resume)
        return b.state.points[2, 0] + b.state.time

    def one(k, dt):
        run = js.rollout(js.replace(SYSTEM, stiffness=k), start(), js.VelocityVerlet(), dt, 7).state
        return run.points[2, 0] + run.time

    whole = jax.jit(jax.value_and_grad(one, argnums=(0, 1)))(20.0, 0.02)
    parts = jax.jit(jax.value_and_grad(lambda k, dt: joined(k, dt, dt), argnums=(0, 1)))(20.0, 0.02)
    np.testing.assert_allclose(np.ravel(parts[1]), np.ravel(whole[1]), rtol=1e-12)
    assert float(parts[0]) == float(whole[0])
    lanes = jax.jit(jax.vmap(joined, in_axes=(None, None, 0)))(20.0, 0.02, jnp.array([0.02, 0.01]))
    np.testing.assert_allclose(lanes, [joined(20.0, 0.02, 0.02), joined(20.0, 0.02, 0.01)], rtol=1e-14)


def test_k2_a_loop_of_edits_by_numpy():
    """Six runs of one to six steps, after each of which a node is kicked, a stiffness is halved or dt is changed: a plain loop in NumPy."""
    system, state, resume, dt = js.System(NET, 1.0, js.Springs(NET, 20.0, 0.9)), start(), None, 0.05
    x, v, k, t = POINTS[:, 0].copy(), np.zeros(3), 20.0, 0.0
    for i in range(6):
        run = js.rollout(system, state, js.SymplecticEuler(), dt, i + 1, resume=resume)
        state, resume = run.state, run.resume
        for _ in range(i + 1):
            pull = k * (np.diff(x) - 0.9)
            v += dt * (np.r_[pull, 0] - np.r_[0, pull])
            x += dt * v
        t += (i + 1) * dt
        np.testing.assert_allclose(np.r_[state.points[:, 0], state.time], np.r_[x, t], rtol=1e-12)
        if i % 3 == 0:
            state, x[1] = eqx.tree_at(lambda s: s.position.components[0], state, state.position.x.at[1].add(0.2)), x[1] + 0.2
        elif i % 3 == 1:
            k = k / 2
            system = js.replace(system, stiffness=k)
        else:
            dt = 0.03
    assert int(resume.step) == 21


def sheet(dtype, rate):
    """A free sheet that turns."""
    net = js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR)
    flat = net.grid(1.0) - 1.0
    points = np.c_[flat, np.zeros(9)].astype(dtype)
    turning = rate * np.c_[-flat[:, 1], flat[:, 0], np.zeros(9)].astype(dtype)
    return js.System(net, 1.0, js.Springs(net, 100.0, net.lengths(points))), js.State.from_points(net, points, turning)


@pytest.mark.slow
@pytest.mark.parametrize("stepper", [js.BackwardEuler(), js.ImplicitMidpoint(), js.BDF2()], ids=lambda s: type(s).__name__)
def test_k7_a_good_run_raises_no_alarm(stepper, dtype):
    """A free sheet that turns, one at rest, one that flies: 400 steps with their turning points, and the status is OK."""
    system, state = sheet(dtype, 0.3)
    flying = eqx.tree_at(lambda s: s.velocity.components[2], state, 30 + state.velocity.z)
    still = eqx.tree_at(lambda s: s.velocity, state, 0 * state.velocity)
    energy = jax.jit(lambda state: system.energy(state).total)
    for begin in (state, flying, still):
        run = js.rollout(system, begin, stepper, 0.02, 400)
        assert run.status.describe() == "OK"
        # What rounding of the places is worth: k (eps x)^2 for each of 20 springs, 100 N/m and 1.4 m.
        rounding = 20 * 100 * (10 * np.finfo(dtype).eps * 1.4) ** 2
        assert float(energy(run.state)) <= float(energy(begin)) * (1 + 1e-4) + rounding


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4()], ids=lambda s: type(s).__name__)
def test_k7_five_thousand_explicit_steps_raise_no_alarm(stepper, dtype):
    """A sheet that turns for 100 s: the status is OK."""
    system, state = sheet(dtype, 0.3)
    assert js.rollout(system, state, stepper, 0.02, 5000).status.describe() == "OK"


def test_coordinates_that_grow_too_large_are_told():
    """In float32 a spring of 1 m that flies off is warned of from 10 km on, where rounding is a thousandth of it; in float64 it is not."""
    net = js.lattice(2)
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0))
    for dtype, speed, is_told in ((np.float32, 1e7, True), (np.float32, 1e4, True), (np.float32, 1e3, False), (np.float64, 1e7, False)):
        state = js.State.from_points(net, np.array([[0.0], [1.0]], dtype), np.full((2, 1), speed, dtype))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run = js.rollout(system, state, js.SymplecticEuler(), 0.01, 100)
        assert bool(run.status.has(Flag.PRECISION)) == is_told
        assert any("PRECISION" in str(w.message) for w in caught) == is_told
        assert "effect Springs" in run.status.describe(run.effects) or not is_told


def statuses(shape):
    """A batch of statuses without a flag."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, shape), Status.ok())


def raised(batch, lane, flag, step, node=-1, effect=-1):
    """The batch with one more flag in one lane."""
    new = Status.when(flag, True, step=step, node=node, effect=effect)
    one = jax.tree.map(lambda a: a[lane], batch).then(new)
    return jax.tree.map(lambda a, b: a.at[lane].set(b), batch, one)


def test_k12_a_batch_says_how_many_failed_and_where():
    """Counts of lanes that failed and that warn; the place is that of the first lane that failed, never of a warning."""
    batch = raised(statuses((256,)), 78, Flag.DT_LIMIT, 0)
    assert batch.describe().startswith("no lane failed, 1 of 256 warn. DT_LIMIT in 1: ")
    assert batch.describe().endswith("(first warning lane: lane 78, DT_LIMIT, step 0)")
    for lane in range(165, 256):
        batch = raised(batch, lane, Flag.NONFINITE if lane < 200 else Flag.INVALID, 12, 3, 1)
    said = batch.describe(("Drag", "Springs"))
    assert said.startswith("91 of 256 lanes failed, 1 of 256 warn. NONFINITE in 35: ")
    assert "INVALID in 56: " in said
    assert said.index("INVALID") < said.index("DT_LIMIT")
    assert said.endswith("(first failing lane: lane 165, NONFINITE, step 12, node 3, effect Springs)")
    with pytest.raises(js.SimulationError, match="91 of 256 lanes failed"):
        js.raise_for_status(batch)
    grid = raised(raised(statuses((4, 6)), (2, 5), Flag.PIVOT, 7), (0, 1), Flag.OVERLAP, 1)
    assert "1 of 24 lanes failed, 1 of 24 warn" in grid.describe()
    assert "lane (2, 5), PIVOT, iteration 7" in grid.describe(step_word="iteration")
    assert statuses((5,)).describe() == statuses((0,)).describe() == "OK"


def test_one_status_names_errors_first_and_effects_apart():
    """One run: errors before warnings, whichever came first; of two effects of one name, which."""
    status = Status.when(Flag.PRECISION, True, step=0).then(Status.when(Flag.NONFINITE, True, step=4, effect=1))
    assert status.describe(("Springs", "Springs")).startswith("NONFINITE")
    assert status.describe(("Springs", "Springs")).endswith("(first at step 4, effect 1 (Springs))")


@pytest.mark.parametrize("stepper", [js.SymplecticEuler(), js.BackwardEuler()], ids=lambda s: type(s).__name__)
def test_k12_lanes_that_fail_leave_the_others_alone(stepper):
    """A lane of NaN and one of negative stiffness among good ones: their steps and effects are named, the others have the bits of a batch
    in which none fails, and the limit that is named is the failing lane's.
    """

    def run(x, k):
        system = js.replace(SYSTEM, stiffness=k)
        return js.rollout(system, eqx.tree_at(lambda s: s.position.components[0], start(), x), stepper, 0.02, 20)

    batched = jax.jit(jax.vmap(run))
    x, k = jnp.stack([POINTS[:, 0]] * 4), jnp.array([20.0, 10.0, 5.0, 40.0])
    good, mixed = batched(x, k), batched(x.at[1, 2].set(jnp.nan), k.at[2].set(-1.0))
    for lane in (0, 3):
        assert same(*(jax.tree.map(lambda a, lane=lane: a[lane], result.state) for result in (good, mixed)))
    assert good.status.describe() == "OK"
    assert np.asarray(mixed.status.step).tolist() == [-1, 0, 0, -1]
    assert "2 of 4 lanes failed. NONFINITE in 1: " in mixed.status.describe(mixed.effects)
    assert "lane 1, NONFINITE, step 0, node 2" in mixed.status.describe(mixed.effects)


def test_an_interrupted_run_goes_on_with_a_bar(capsys):
    """Ctrl-C in the second chunk of a resumed run with frames: frames, state and resume are of one moment; what goes on from there is the
    unbroken run, and the bar counts the steps of its own run.
    """
    stepper = js.VelocityVerlet()
    first = js.rollout(SYSTEM, start(), stepper, 0.02, 5)
    seen = []

    def stop(done, total):
        seen.append((done, total))
        if len(seen) == 2:
            raise KeyboardInterrupt

    progress = js.Progress(callback=stop, bar=False)
    broken = js.rollout(SYSTEM, first.state, stepper, 0.02, 30, save_every=5, progress=progress, resume=first.resume)
    done = int(broken.info.n_steps) - 5
    assert seen[-1] == (done, 30)
    assert broken.saved.time.shape == (done // 5,)
    assert float(broken.saved.time[-1]) == float(broken.state.time) == (done + 5) * 0.02
    rest = js.rollout(SYSTEM, broken.state, stepper, 0.02, 30 - done, resume=broken.resume, progress=js.Progress())
    assert same(rest.state, js.rollout(SYSTEM, start(), stepper, 0.02, 35).state)
    assert "100 %" in capsys.readouterr().err
