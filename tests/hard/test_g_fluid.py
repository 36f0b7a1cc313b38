"""Hard cases G: the particle fluid. a = 2, b = 4, alpha = beta = 1, zeta = 0.1, as printed, unless said."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js
from tests.particles import blob, components, free_net, make, slide_force

OVERLAP, DT_LIMIT, OVERFLOW = js.Flag.OVERLAP, js.Flag.DT_LIMIT, js.Flag.NEIGHBOUR_OVERFLOW


def found(system, state):
    """What the fluid reports of a state: flag -> count."""
    fluid = system.bind(state.dtype).forces[0]
    return {finding.flag: int(finding.count) for finding in fluid.diagnose(state)}


def test_g1_zero_force_at_r0_and_the_force_is_the_potentials():
    """At r = 1.0916079783 the force is zero to 1e-15, and -dU/dr = F to 5e-15 at any distance."""
    law = js.fluid.SlideLaw(1.0, 1.0, 0.1)
    r0 = float(law.equilibrium_distance)
    assert r0 == pytest.approx(1.0916079783, abs=5e-11)
    system, state = make(np.array([[0.0, 0.0], [r0, 0.0]]))
    assert np.abs(components(system.force(state))).max() < 1e-15
    for r in (0.7, 1.0, 1.5, 4.0):
        printed = r * (-1 / (r + 0.1) ** 2 + 1 / r**4)
        slope = -jax.grad(lambda r: jnp.log(r + 0.1) + 0.1 / (r + 0.1) + 1 / (2 * r**2))(r)
        assert float(law.weight(jnp.float64(r * r)) * r) == pytest.approx(printed, abs=5e-15)
        assert float(-jax.grad(lambda r: law.potential(r * r))(r)) == pytest.approx(float(slope), abs=5e-15)


def test_g2_two_particles_at_one_place(dtype):
    """The force is zero, its gradient and the energy's are finite, and one overlap is counted, with the node."""
    points = np.array([[3.0, 0, 0], [1, 1, 1], [1, 1, 1]], dtype)
    system, state = make(points)
    force = components(system.force(state))
    far, _ = make(points[:2])[0].force(make(points[:2])[1]).components[0]
    assert np.isfinite(force).all()
    assert force[1, 0] == pytest.approx(-float(far), rel=1e-5)

    def total(position):
        moved = state.moved(position, state.velocity)
        return sum(jnp.sum(a * a) for a in system.force(moved)) + system.energy(moved).total

    assert np.isfinite(components(jax.grad(total)(state.position))).all()
    assert found(system, state) == {OVERLAP: 1}


@pytest.mark.parametrize(("kind", "r"), [("float32", 1e-9), ("float32", 1e-10), ("float64", 1e-81)])
def test_g3_the_force_is_capped_inside_the_core(kind, r):
    """Nearly coincident particles get the core's pull times their distance, finite, and OVERLAP."""
    system, state = make(np.array([[0.0, 0.0], [r, 0.0]], kind), core=0.01)
    force = components(system.force(state))
    expected = r * (1 / 0.01**4 - 1 / 0.11**2)
    np.testing.assert_allclose(force[:, 0], [-expected, expected], rtol=1e-5)
    assert found(system, state) == {OVERLAP: 1}
    with np.errstate(all="ignore"):
        assert not np.isfinite(np.asarray(1, kind) / np.asarray(r, kind) ** 4 * np.asarray(r, kind) - np.asarray(r, kind) ** -5)


@pytest.mark.slow
def test_g4_uniform_particles_overlap_by_chance(rng):
    """Of 1,000 uniform particles in 10^3 two are much too near for dt = 0.01: DT_LIMIT before the first step."""
    points = rng.uniform(0, 10, (1000, 3))
    system, state = make(points)
    nearest = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1) + 99 * np.eye(1000), axis=None)[0]
    assert nearest < 0.15
    # Where one pair is all that matters: omega^2 = 2 F', F' = 3 / r^4.
    assert float(js.stable_dt(system, state)) <= 2 / np.sqrt(2 * 3 / nearest**4)
    with pytest.warns(js.StabilityWarning, match="DT_LIMIT"):
        result = js.rollout(system, state, js.SymplecticEuler(), 0.01, 1)
    assert int(result.status.step) == 0


@pytest.mark.slow
def test_g5_head_on(rng):
    """Two particles that meet at 5 m/s each: dt = 1e-3 keeps energy to 1e-2 and is quiet, dt = 3e-2 and 1e-1 do not and are flagged."""
    system, state = make(np.array([[-2.0, 0.0], [2.0, 0.0]]), velocities=np.array([[5.0, 0.0], [-5.0, 0.0]]))
    before = float(system.energy(state).total)
    run = jax.jit(lambda dt: (lambda r: (r.status, system.energy(r.state).total))(js.rollout(system, state, js.VelocityVerlet(), dt, 800)))
    status, after = run(1e-3)
    assert int(status.flags) == 0
    assert float(after) == pytest.approx(before, abs=1e-2)
    for dt in (3e-2, 1e-1):
        status, _ = run(dt)
        assert bool(status.has(DT_LIMIT)), dt
        assert int(status.step) == 1


@pytest.mark.parametrize(
    ("dt", "points", "speed", "text"),
    [
        # stable_dt is infinite: no pair is within the cut-off.
        (0.02, [[0.0, 0.0], [9.0, 0.0]], 50.0, "dt = 0.02 s was below.*particles moved or met too fast.*Lower dt, or widen the skin"),
        (0.5, [[0.0, 0.0], [1.2, 0.0]], 0.0, r"dt = 0\.5 s, but this run is surely stable only up to 0\.\d+ s"),
    ],
)
def test_g5_the_warning_names_the_limit_that_was_passed(dt, points, speed, text):
    """A dt above stable_dt is told with it; below it the warning speaks of the particles, and of no limit that dt keeps."""
    options = {"law": js.fluid.LennardJones(1.0, 1.0), "cutoff": js.fluid.PlainCutoff(2.5), "pairs": js.fluid.NeighbourList(4, 0.3)}
    system, state = make(np.array(points), velocities=np.array([[speed, 0.0], [0.0, 0.0]]), **options)
    with pytest.warns(js.StabilityWarning, match=f"DT_LIMIT: .*{text}") as told:
        js.rollout(system, state, js.SymplecticEuler(), dt, 1)
    assert "inf s" not in str(told[0].message)


def test_g5_an_error_names_no_infinite_limit():
    """Where nothing limits dt, an error does not say that the limit was infinite."""
    fast = np.array([[1e307, 0.0], [0.0, 0.0]])
    system, state = make(
        np.array([[0.0, 0.0], [9.0, 0.0]]), law=js.fluid.LennardJones(1.0, 1.0), cutoff=js.fluid.PlainCutoff(2.5), velocities=fast
    )
    result = jax.jit(lambda dt: js.rollout(system, state, js.SymplecticEuler(), dt, 1))(100.0)
    with pytest.raises(js.SimulationError) as told:
        js.raise_for_status(result)
    assert "inf" not in str(told.value).replace("infin", "")


def test_g6_what_a_cutoff_leaves_out(rng):
    """In a box of 20^3 the force on an off-centre particle is wrong by about 100 % at c = 2 and 4, by over 60 % at 8, under 40 % at 16."""
    points = np.concatenate([[[4.0, 10.0, 10.0]], rng.uniform(0, 20, (4000, 3))])
    # The near ones would drown the sum: none within 1.
    keep = np.linalg.norm(points - points[0], axis=1) > 1
    keep[0] = True
    points = points[keep]
    system, state = make(points)
    whole = components(system.force(state))[0]
    errors = []
    for c in (2.0, 4.0, 8.0, 16.0):
        cut, _ = make(points, cutoff=js.fluid.PlainCutoff(c))
        errors.append(np.linalg.norm(components(cut.force(state))[0] - whole) / np.linalg.norm(whole))
    assert errors[0] > 0.9
    assert errors[1] > 0.85
    assert 0.6 < errors[2] < 0.95
    assert errors[3] < 0.4
    assert errors[3] > 0.05


@pytest.mark.slow
def test_g6_shifted_force_keeps_energy_better(rng):
    """Over 4,000 steps the shifted force drifts at most a third of what the plain cut-off does."""
    points, speeds = blob(rng, 27, spacing=1.2), rng.normal(0, 0.4, (27, 3))
    drift = {}
    for cutoff in (js.fluid.PlainCutoff(2.5), js.fluid.ShiftedForce(2.5)):
        system, state = make(points, velocities=speeds, cutoff=cutoff)
        # The plain force has a potential only up to jumps in force: its own, continuous one, is what must stay.
        saved = js.rollout(system, state, js.SymplecticEuler(), 5e-3, 4000, save_every=40).saved
        energy = jax.vmap(lambda s, system=system: system.energy(s).total)(saved)
        drift[type(cutoff).__name__] = float(jnp.max(energy[5:]) - jnp.min(energy[5:]))
    assert drift["ShiftedForce"] < drift["PlainCutoff"] / 3


@pytest.mark.slow
def test_g7_a_list_too_small_says_what_it_needs(rng):
    """Capacity 32 where more are needed: NEIGHBOUR_OVERFLOW with the number, and forces as of all pairs, none left out."""
    points = blob(rng, 227, spacing=0.9)
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 2.3
    needed = near.sum(axis=1).max() - 1
    cut = js.fluid.ShiftedForce(2.0)
    system, state = make(points, cutoff=cut, pairs=js.fluid.NeighbourList(capacity=32, skin=0.3))
    assert needed > 32
    counted = found(system, system.bind(state.dtype).begin(state))[OVERFLOW]
    assert counted >= needed
    everyone, _ = make(points, cutoff=cut)
    np.testing.assert_allclose(components(system.force(state)), components(everyone.force(state)), rtol=1e-12, atol=1e-12)
    enough, _ = make(points, cutoff=cut, pairs=js.fluid.NeighbourList(capacity=int(counted), skin=0.3))
    assert found(enough, enough.bind(state.dtype).begin(state))[OVERFLOW] == 0


@pytest.mark.slow
def test_g7_an_overflow_ends_in_an_exception(rng):
    """A rollout whose list is too small ends with the flag and the capacity as its count, and raises."""
    system, state = make(blob(rng, 100, spacing=0.8), cutoff=js.fluid.ShiftedForce(2.5), pairs=js.fluid.NeighbourList(capacity=8, skin=0.3))
    result = js.rollout(system, state, js.SymplecticEuler(), 1e-4, 2)
    assert int(result.status.count) > 32
    with pytest.raises(js.SimulationError, match=f"NEIGHBOUR_OVERFLOW.*capacity.*count {int(result.status.count)}"):
        js.raise_for_status(result)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2])
def test_g8_one_or_two_particles(n):
    """One particle feels nothing; two feel each other once, by list and by all pairs alike."""
    points = np.array([[0.3, 0.1], [1.3, 0.4]])[:n]
    for pairs in (js.fluid.AllPairs(), js.fluid.NeighbourList(8, 0.3)):
        system, state = make(points, cutoff=js.fluid.PlainCutoff(2.5), pairs=pairs)
        np.testing.assert_allclose(components(system.force(state)), slide_force(points, np.ones(n)), atol=1e-15)


@pytest.mark.slow
def test_g8_cell_borders_and_the_cutoff_itself():
    """Particles on cell borders, below zero too, count once; a pair at exactly r_c has no force, one a hair nearer has."""
    grid = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)
    system, state = make(grid, cutoff=js.fluid.PlainCutoff(1.5), pairs=js.fluid.NeighbourList(16, 0.5))
    np.testing.assert_allclose(components(system.force(state)), slide_force(grid, np.ones(49), reach=1.5), atol=1e-13)
    for r, acts in ((2.0, False), (2.0 - 1e-12, True)):
        pair, apart = make(np.array([[0.0, 0.0], [r, 0.0]]), cutoff=js.fluid.PlainCutoff(2.0), pairs=js.fluid.NeighbourList(8, 0.5))
        assert bool(pair.force(apart).x[0] != 0) == acts


@pytest.mark.slow
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_g10_list_equals_all_pairs(dim, dtype, rng):
    """At the same cut-off to 1e-12 in float64 and 1e-5 in float32, also far from the origin of the cells, energy included."""
    points = ((blob(rng, 300, dim, spacing=1.1) if dim > 1 else blob(rng, 40, 1, spacing=1.1)) - 7.3).astype(dtype)
    mass = rng.uniform(0.5, 2, len(points)).astype(dtype)
    options = {"mass": mass, "cutoff": js.fluid.ShiftedForce(2.5)}
    listed, state = make(points, pairs=js.fluid.NeighbourList(80, 0.3), **options)
    everyone, _ = make(points, **options)

    @jax.jit
    def both(state):
        begun = listed.bind(state.dtype).begin(state)
        fluid = listed.bind(state.dtype).forces[0]
        return (fluid.force(begun), fluid.energy(begun), begun.memory[0].value.near.needed), (
            everyone.force(state),
            everyone.energy(state).total,
        )

    (ours, energy, needed), (exact, exact_energy) = both(state)
    ours, exact = components(ours), components(exact)
    tolerance = 1e-12 if dtype == np.float64 else 1e-5
    assert np.abs(ours - exact).max() < tolerance * np.abs(exact).max()
    assert int(needed) <= 80
    assert float(energy) == pytest.approx(float(exact_energy), rel=tolerance * 10)


def test_g8_no_particle_at_all():
    """A net without a node is refused when it is built, so that no fluid can be on it."""
    with pytest.raises(ValueError, match="n_nodes = 0"):
        make(np.zeros((0, 2)))


TRACED = {
    "epsilon": lambda bad: js.Fluid(js.fluid.LennardJones(bad, 1.0)),
    "sigma": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, bad)),
    "alpha": lambda bad: js.Fluid(js.fluid.SlideLaw(bad, 1.0)),
    "beta": lambda bad: js.Fluid(js.fluid.UnitVectorLaw(1.0, bad)),
    "radius": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.PlainCutoff(bad)),
    "on": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.Switched(bad, 2.5)),
    "off": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.Switched(1.5, bad)),
    "skin": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), js.fluid.PlainCutoff(2.5), js.fluid.NeighbourList(4, bad)),
    "drag": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), drag=js.fluid.PairDrag(bad, 1.5)),
    "drag.radius": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), drag=js.fluid.PairDrag(1.0, bad)),
    "core": lambda bad: js.Fluid(js.fluid.LennardJones(1.0, 1.0), core=bad),
    "zeta": lambda bad: js.Fluid(js.fluid.SlideLaw(1.0, 1.0, bad)),
}
MAY_BE_ZERO = ("drag", "zeta")


def is_refused(build, value):
    """Whether the fluid that `build` makes of a traced value says that it is invalid."""
    return bool(jax.jit(lambda v: build(v).invalid())(value))


def test_g9_a_run_with_a_traced_constant_of_the_wrong_sign():
    """The status of a run says INVALID, before the first step, and which force."""
    net = free_net(2)
    state = js.State.from_points(net, [[0.0, 0.0], [1.2, 0.0]])
    status = jax.jit(lambda v: js.rollout(js.System(net, 1.0, TRACED["epsilon"](v)), state, js.SymplecticEuler(), 1e-4, 1).status)
    assert not status(1.0).has(js.Flag.INVALID)
    refused = status(-1.0)
    assert refused.has(js.Flag.INVALID)
    assert (int(refused.step), int(refused.effect)) == (0, 0)


@pytest.mark.parametrize("name", TRACED)
def test_g9_traced_constants_of_the_wrong_sign(name):
    """Below zero, zero (but for drag and zeta) and NaN are INVALID where the constructor cannot look; a good value is not."""
    good = {"radius": 2.5, "on": 1.5, "off": 2.5}.get(name, 0.9)
    assert not is_refused(TRACED[name], good)
    for bad in (-1.0, np.nan, *(() if name in MAY_BE_ZERO else (0.0,))):
        assert is_refused(TRACED[name], bad), bad
    if name in MAY_BE_ZERO:
        assert not is_refused(TRACED[name], 0.0)


def test_g9_traced_distances_beyond_the_reach():
    """A cut-off below r_0, the core or the list's drag, and a switch that ends before it begins, are INVALID; one at r_0 is none."""
    lj, r_0 = js.fluid.LennardJones(1.0, 1.0), 2 ** (1 / 6)
    assert is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(c)), 0.5)
    assert not is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(c)), r_0)
    assert not is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(c)), np.float32(r_0))
    assert is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(2.5), core=c), 2.6)
    assert is_refused(lambda c: js.Fluid(lj, js.fluid.Switched(c, 2.5)), 2.6)
    assert is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(2.5), js.fluid.NeighbourList(4, 0.3), js.fluid.PairDrag(1.0, c)), 2.6)
    assert not is_refused(lambda c: js.Fluid(lj, js.fluid.PlainCutoff(2.5), drag=js.fluid.PairDrag(1.0, c)), 2.6)
