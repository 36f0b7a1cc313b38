"""Hard cases C, D and J of implicit steps: stiff, loose, pinned, spinning."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from jaxspring.status import Flag

LIMIT = 5e-4  # explicit limit of the cloth below [s]


def cloth(n=12, dtype=float, gravity=0.0, crumple=0.01, is_graph=False):
    """An n x n sheet, crumpled by so many metres, k = 1e4, m = 0.01, held by two corners; a graph's programs are half as long."""
    net = js.lattice((n, n), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.concatenate([net.grid(0.1), np.zeros((n * n, 1))], axis=1)
    net = js.Graph.from_edges(net.edges, n * n) if is_graph else net
    points = (flat + crumple * np.random.default_rng(3).normal(size=flat.shape)).astype(dtype)
    free = np.ones(n * n, bool)
    free[[0, n - 1]] = False
    springs = js.Springs(net, 1e4, net.lengths(flat))
    start = js.State.from_points(net, points)
    return js.System(net, 0.01, (springs, js.Gravity([0.0, 0.0, -gravity])), free=free), start, free


@pytest.mark.slow
@pytest.mark.parametrize(("times", "most"), [(1, 20), (10, 120), (100, 300), (1000, 400)])
def test_c3_stiff_steps_lose_energy_and_keep_pins(times, most):
    """60 steps at 1 to 1,000 times the explicit limit: residual below the tolerance, energy never rises, pins do not move by a bit."""
    system, start, free = cloth()
    run = js.rollout(system, start, js.BackwardEuler(js.CG(tolerance=1e-8)), times * LIMIT, 60, save_every=1, keep_solves=True)
    js.raise_for_status(run)  # ENERGY_ROSE is an error
    assert float(run.info.solves.residual) <= 1e-8
    assert int(np.max(run.info.solves_saved.iterations)) <= most
    energies = jax.jit(jax.vmap(lambda s: system.energy(s).total))(run.saved)
    assert np.all(np.diff(energies) < 0)
    np.testing.assert_array_equal(run.state.points[~free], start.points[~free])


@pytest.mark.slow
def test_a_flat_sheet_that_falls_far_in_one_step_gains_energy_and_says_so():
    """Flat, a sheet has no stiffness sideways: under gravity one long linear step stretches it without resistance, and is reported."""
    system, start, _ = cloth(6, gravity=9.81, crumple=0.0)
    run = js.rollout(system, start, js.BackwardEuler(), 200 * LIMIT, 2)
    assert bool(run.status.has(Flag.ENERGY_ROSE))


@pytest.mark.slow
def test_c4_too_tight_for_float32_is_reported():
    """Tolerance 1e-5 is met in float32; 1e-10 cannot be: CG_MAXITER with the true residual, never OK."""
    system, start, _ = cloth(dtype=np.float32)
    fine = js.rollout(system, start, js.BackwardEuler(js.CG(tolerance=1e-5)), 100 * LIMIT, 5)
    assert bool(fine.status.is_ok)
    assert float(fine.info.solves.residual) <= 1e-4
    tight = js.rollout(system, start, js.BackwardEuler(js.CG(tolerance=1e-10, max_iter=300)), 100 * LIMIT, 2)
    assert bool(tight.status.has(Flag.CG_MAXITER))
    assert int(tight.status.step) == 1
    assert 1e-9 < float(tight.info.solves.residual) < 1e-2


def test_c8_every_node_pinned():
    """Nothing moves, no iteration, status OK, and a gradient of zeros."""
    net = js.lattice(4)
    start = js.State.from_points(net, net.grid() * 1.5)
    system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), js.Gravity([-1.0])), free=np.zeros(4, bool))

    def of(k):
        run = js.rollout(js.replace(system, stiffness=k), start, js.BackwardEuler(js.CG()), 0.1, 3)
        return jnp.sum(run.state.position.x**2), run

    gradient, run = jax.grad(of, has_aux=True)(10.0)
    np.testing.assert_array_equal(run.state.points, start.points)
    assert float(gradient) == 0
    assert int(run.info.solves.iterations) == 0
    assert bool(run.status.is_ok)


def test_c10_one_iteration_is_not_enough():
    """max_iter = 1 ends in CG_MAXITER at the first step, and `raise_for_status` raises."""
    system, start, _ = cloth(4)
    run = js.rollout(system, start, js.BackwardEuler(js.JaxCG(max_iter=1)), 100 * LIMIT, 2)
    assert bool(run.status.has(Flag.CG_MAXITER))
    with pytest.raises(js.SimulationError, match=r"step 1"):
        js.raise_for_status(run)


@pytest.mark.parametrize("stepper", [js.BackwardEuler(), js.ImplicitMidpoint(), js.BDF2()], ids=lambda s: type(s).__name__)
def test_c19_a_pin_under_a_great_load(stepper):
    """A pinned node under 1e8 N stays where it is, bit for bit, and the hold's reaction is that load and the spring's."""
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.3, 0.1], [1.3, 0.1]])
    load = js.Load.from_points(net, [[1e8, -1e8], [0.0, 0.0]])
    system = js.System(net, 1.0, (js.Springs(net, 10.0, 1.0), load), free=np.array([False, True]))
    run = js.rollout(system, start, stepper, 0.1, 5)
    np.testing.assert_array_equal(run.state.points[0], start.points[0])
    reaction = np.array([a[0] for a in system.reaction(run.state)])
    np.testing.assert_allclose(reaction, [-1e8, 1e8], rtol=1e-6)


@pytest.mark.parametrize("stepper", [js.BackwardEuler(), js.ImplicitMidpoint(), js.BDF2()], ids=lambda s: type(s).__name__)
def test_c20_a_pin_moved_by_a_schedule(stepper):
    """A moved node is exactly on its path with the path's velocity, and a free node that hangs on it follows at that speed."""
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.0], [1.0]], [[2.0], [2.0]])
    motion = js.Motion(jnp.array([True, False]), lambda t: js.Vector((jnp.array([2.0, 0.0]) * t,)))
    system = js.System(net, 1.0, (js.Springs(net, 100.0, 1.0),), motion=motion)
    run = js.rollout(system, start, stepper, 0.1, 10)
    assert bool(run.status.is_ok)
    np.testing.assert_allclose(run.state.points[:, 0], [2.0, 3.0], atol=1e-7)
    np.testing.assert_allclose(run.state.velocities[:, 0], [2.0, 2.0], atol=1e-6)


@pytest.mark.slow
def test_d4_loose_solves_and_failed_ones():
    """Loose adjoint solves: an error of at most ten times their tolerance (0.3 measured). Loose forward solves move the path itself, ten
    steps of it: at most a hundred times (37 measured). Failed solves: the status says so, and the gradient is NaN.
    """
    system, start, _ = cloth(8, gravity=9.81, is_graph=True)

    def gradient(solver):
        def of(k):
            # Storing every step, a program holds a step twice, not five times: a third of the compile, and the solves are the same.
            run = js.rollout(js.replace(system, stiffness=k), start, js.BackwardEuler(solver), 20 * LIMIT, 10, adjoint=js.StoreAll())
            return jnp.sum(run.state.position.z), run.status

        # Six programs that run for 20 ms each: what the compiler would spend on their speed is not earned back.
        return jax.jit(jax.grad(of, has_aux=True), compiler_options={"xla_backend_optimization_level": 0})(1e4)

    exact, _ = gradient(js.CG(tolerance=1e-13))
    for tolerance in (1e-3, 1e-6):
        loose, status = gradient(js.CG(tolerance=1e-13, adjoint_tolerance=tolerance))
        assert abs(float(loose / exact) - 1) <= 10 * tolerance
        assert bool(status.is_ok)
        looser, _ = gradient(js.CG(tolerance=tolerance))
        assert abs(float(looser / exact) - 1) <= 100 * tolerance
    failed, status = gradient(js.CG(tolerance=1e-13, max_iter=3))
    assert bool(status.has(Flag.CG_MAXITER))
    assert np.isnan(float(failed))


@pytest.mark.parametrize("times", [10, 100, 1000])
def test_j1_a_spinning_spring_gains_energy_and_says_so(times):
    """One linearised step turns a spinning stiff spring into a stretched one: ENERGY_ROSE. Newton's step does not gain."""
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.0, -0.5], [0.0, 0.5]], [[1.0, 0.0], [-1.0, 0.0]])
    system = js.System(net, 1.0, js.Springs(net, 1e4, 1.0))
    dt = times * np.sqrt(2 / 1e4)  # 2 / omega with omega^2 = 2 k / m
    linear = js.rollout(system, start, js.BackwardEuler(), dt, 1)
    assert bool(linear.status.has(Flag.ENERGY_ROSE))
    assert float(system.energy(linear.state).total) > 2 * float(system.energy(start).total)
    newton = js.rollout(system, start, js.BackwardEuler(newton=True), dt, 1)
    assert bool(newton.status.is_ok)
    assert float(system.energy(newton.state).total) <= float(system.energy(start).total)


def test_j2_a_loss_on_a_pin_of_an_implicit_step():
    """The gradient of a pinned node's position by where it was pinned is one, and by the stiffness zero."""
    system, start, _ = cloth(3)

    def of(k, x0):
        begin = js.State.from_points(system.net, start.points.at[0, 0].set(x0))
        return js.rollout(js.replace(system, stiffness=k), begin, js.BackwardEuler(), 100 * LIMIT, 3).state.points[0, 0]

    assert [float(g) for g in jax.grad(of, argnums=(0, 1))(1e4, 0.0)] == [0.0, 1.0]


def test_secant_steps_blow_up_above_two_and_tangent_steps_do_not():
    """One spring stretched by 1e-9 of its length: the slides' matrix is stable below omega dt = 2 only, the tangent at every step."""
    net = js.lattice(2)
    start = js.State.from_points(net, [[0.0], [1.0 + 1e-9]])
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0), free=np.array([False, True]))

    def stretch(stiffness, step):
        run = js.rollout(system, start, js.BackwardEuler(stiffness=stiffness), step, 60, save_every=1)
        return float(np.max(np.abs(run.saved.points[:, 1, 0] - 1.0)))

    assert stretch(js.steppers.Secant(), 1.9) < 1e-8
    assert stretch(js.steppers.Secant(), 2.1) > 0.05
    assert stretch(js.steppers.Tangent(), 2.1) <= 1e-9
    assert stretch(js.steppers.Tangent(), 100.0) <= 1e-9


def test_solves_are_kept_where_asked():
    """`keep_solves` gives every step's residual and iterations, whose sum and maximum are the summary; an explicit stepper refuses."""
    system, start, _ = cloth(3)
    run = js.rollout(system, start, js.BackwardEuler(js.CG()), 10 * LIMIT, 4, save_every=1, keep_solves=True)
    assert int(np.sum(run.info.solves_saved.iterations)) == int(run.info.solves.iterations) > 0
    assert float(np.max(run.info.solves_saved.residual)) == float(run.info.solves.residual)
    with pytest.raises(ValueError, match="implicit stepper"):
        js.rollout(system, start, js.SymplecticEuler(), LIMIT / 10, 4, save_every=1, keep_solves=True)
