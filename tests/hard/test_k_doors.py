"""Hard cases K1 and K10, and what stands at the same doors: work arrays, foreign arrays, x64 switched off, batches without `vmap`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import networkx
import numpy as np
import pytest
import scipy.sparse

import jaxspring as js
from tests.doors import at_offset, snapshot, spoil

NET = js.lattice(3)
ALONG = np.array([[0.0], [1.1], [2.3]])
SHEET = js.lattice((3, 3), springs=js.STRUCTURAL + js.SHEAR)
BY_FAMILY = {js.STRUCTURAL: 10.0, js.SHEAR: 3.0}


def scene(points=ALONG):
    return js.System(NET, 1.0, js.Springs(NET, 5.0, 1.0)), js.State.from_points(NET, points)


def sheet_state():
    return js.State.from_points(SHEET, np.c_[SHEET.grid(1.1), np.linspace(0, 0.5, 9)])


def test_k1_one_work_array_for_many_systems():
    """A parameter study that fills one array again and again gets the systems it asked for."""
    net = js.lattice(64)
    work, stiffnesses = at_offset(np.zeros(63), np.dtype("float32"), 0), (10.0, 20.0, 40.0)
    systems = []
    for k in stiffnesses:
        work[:] = k
        systems.append(js.System(net, 1.0, js.Springs(net, work, 1.0)))
    for k, system in zip(stiffnesses, systems, strict=True):
        np.testing.assert_array_equal(system.forces[0].stiffness, k)


@pytest.mark.slow
def test_k1_what_runs_and_fits_are_given_is_copied(dtype):
    """Times of a diffrax run, a load's amplitude, the start of a fit and what it carries: changed afterwards, they change nothing."""
    system, state = scene(ALONG.astype(dtype))
    force, start, carried = (at_offset(np.ones((3, 1)), dtype, 0) for _ in range(3))
    t1, frequency = (at_offset(np.asarray(0.125), dtype, 0) for _ in range(2))
    results = [
        js.frequency_response(system, state, frequency, force),
        js.diffeqsolve(system, state, t1, dt0=t1).state,
        js.fit(lambda p, c: (jnp.sum((p - 1.5) ** 2), (c, None)), start, n_iterations=0, carried=carried),
        js.lumped_mass(NET, force * np.arange(3.0, dtype=dtype)[:, None], 2.0),
    ]
    results[2] = (results[2].parameters, results[2].carried)
    before = snapshot(results)
    for array in (force, start, carried, t1, frequency):
        spoil(array)
    for a, b in zip(before, snapshot(results), strict=True):
        np.testing.assert_array_equal(a, b)


def test_k1_a_net_keeps_its_triangles():
    """The triangles of a net are its own, and read-only: nobody changes what plots and pressures are taken from."""
    triangles = np.array([[0, 1, 2]], np.int32)
    net = js.from_triangles(triangles, 3)
    triangles[:] = 0
    assert net.triangles.tolist() == [[0, 1, 2]]
    with pytest.raises(ValueError, match="read-only"):
        net.triangles[0, 0] = 2


EDGES = [(0, 1), (1, 2), (0, 2)]


@pytest.mark.parametrize(
    "edges",
    [
        zip([0, 1, 0], [1, 2, 2], strict=True),
        (edge for edge in EDGES),
        dict.fromkeys(EDGES, 5.0),
        networkx.Graph(EDGES).edges,
        np.array(EDGES, ">u4"),
        np.array(EDGES, object),
        np.array(EDGES, np.uint64),
        np.ma.masked_array(EDGES),
        [np.array(edge, np.int16) for edge in EDGES],
        jnp.array(EDGES),
    ],
    ids=["zip", "generator", "dict", "networkx", "big-endian", "objects", "uint64", "no mask", "list of arrays", "jax"],
)
def test_k10_edges_come_in_many_forms(edges):
    """Any series of pairs of whole numbers is a list of springs."""
    net = js.Graph.from_edges(edges, 3)
    assert {tuple(sorted(edge)) for edge in net.edges.tolist()} == set(EDGES)


@pytest.mark.parametrize(
    ("edges", "error", "text"),
    [
        (np.ma.masked_array(EDGES, np.array(EDGES) == 2), ValueError, r"edges\[1, 1\] is masked"),
        ([(0, 1), (1,)], ValueError, "edges has rows of different lengths"),
        ([("a", "b")], TypeError, "edges has dtype.*text"),
        ([(0, None)], TypeError, r"edges\[0, 1\] = None"),
        ("01", TypeError, "edges is '01', a str"),
    ],
)
def test_k10_what_names_no_nodes_is_refused(edges, error, text):
    """Masked node numbers, ragged rows, text and None are refused by place."""
    with pytest.raises(error, match=text):
        js.Graph.from_edges(edges, 3)


def test_k10_gradients_by_numbers_in_lists():
    """A traced number in a list is differentiated like one in an array, at every depth."""
    state = scene()[1]

    def by_gravity(g):
        return js.System(NET, 2.0, js.Gravity([g])).force(state).x.sum()

    def by_points(a):
        return js.System(NET, 1.0, js.Springs(NET, [a, 2 * a], 1.0)).energy(js.State.from_points(NET, [[0.0], [a], [2.5]])).total

    assert float(jax.grad(by_gravity)(9.81)) == pytest.approx(6.0)  # three nodes of 2 kg
    a, h = 1.25, 1e-5
    assert float(jax.grad(by_points)(a)) == pytest.approx(float(by_points(a + h) - by_points(a - h)) / (2 * h), rel=1e-8)


@pytest.mark.parametrize("where", ["edges", "n_nodes", "shape"])
def test_nets_are_built_outside(where):
    """A net whose springs or shape are traced cannot be built; the sentence says where to build it."""
    build = {
        "edges": lambda a: js.Graph.from_edges(a, 3).tails,
        "n_nodes": lambda a: js.Graph.from_edges(EDGES, a[0, 1]).tails,
        "shape": lambda a: js.State.from_points(js.lattice((a[0, 1], 3)), ALONG).points,
    }[where]
    with pytest.raises(TypeError, match=f"{where} is traced.*Build the net outside"):
        jax.jit(build)(np.array(EDGES))


def doors_of_a_state(system, state):
    """Every entry that takes a state."""
    return {
        "rollout": lambda: js.rollout(system, state, js.SymplecticEuler(), 0.01, 1),
        "implicit": lambda: js.rollout(system, state, js.BackwardEuler(), 0.01, 1),
        "equilibrium": lambda: js.equilibrium(system, state),
        "diffeqsolve": lambda: js.diffeqsolve(system, state, 0.1),
        "normal_modes": lambda: js.normal_modes(system, state),
        "frequency_response": lambda: js.frequency_response(system, state, 1.0, np.ones((3, 1))),
        "stable_dt": lambda: js.stable_dt(system, state),
        "force": lambda: system.force(state),
        "acceleration": lambda: system.acceleration(state),
        "energy": lambda: system.energy(state),
        "momentum": lambda: system.momentum(state),
        "fit": lambda: js.fit(lambda k: system.energy(state).total * k, jnp.ones((), jnp.float32), n_iterations=1),
    }


ENTRIES = list(doors_of_a_state(None, None))


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_float64_state_without_x64(entry):
    """A state of float64 where x64 has been switched off meets a sentence about x64 at every entry."""
    system, state = scene()
    with jax.enable_x64(False), pytest.raises(TypeError, match="float64, but x64 is switched off"):
        doors_of_a_state(system, state)[entry]()


def test_x64_switched_between():
    """Constants of float64 and a float32 state run with x64 off; float32 constants and state run with it on; both as always."""
    wide = js.System(NET, np.ones(3), (js.Springs(NET, np.full(2, 5.0), 1.0), js.Drag(np.float64(0.1)), js.Gravity([-9.81])))
    with jax.enable_x64(False):
        narrow, state = js.System(NET, np.ones(3), wide.forces), js.State.from_points(NET, ALONG.astype(np.float32))
        off = js.rollout(wide, state, js.SymplecticEuler(), 0.01, 3)
    on = js.rollout(narrow, state, js.SymplecticEuler(), 0.01, 3)
    assert off.state.dtype == on.state.dtype == np.float32
    np.testing.assert_allclose(off.state.points, on.state.points, rtol=1e-6)


@pytest.mark.parametrize("entry", ENTRIES)
def test_many_states_without_vmap(entry):
    """States stacked on a leading axis meet a sentence that says `vmap`, at every entry; silent sums over the batch before."""
    system, state = scene()
    states = jax.tree.map(lambda a: jnp.stack([a, a]), state)
    with pytest.raises(ValueError, match=r"these are many states.*vmap"):
        doors_of_a_state(system, states)[entry]()


@pytest.mark.parametrize("net", [NET, js.Graph.from_edges([(0, 1), (1, 2)], 3)], ids=["lattice", "graph"])
def test_many_systems_without_vmap(net):
    """Stacked systems meet a sentence that says `vmap`, under which they run as one by one."""
    systems = [js.System(net, 1.0, js.Springs(net, k, 1.0)) for k in (5.0, 9.0)]
    state = js.State.from_points(net, ALONG)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *systems)
    for take in (lambda s: s.energy(state), lambda s: js.rollout(s, state, js.SymplecticEuler(), 0.01, 1)):
        with pytest.raises(ValueError, match=r"these are many systems.*vmap"):
            take(stacked)
    energies = jax.vmap(lambda s: s.energy(state).total)(stacked)
    np.testing.assert_allclose(energies, [s.energy(state).total for s in systems], rtol=1e-14)


def test_numbers_by_family():
    """Numbers by family act as the same numbers written out spring by spring, in every result that reads a spring's constants."""
    written = np.repeat([10.0, 10.0, 3.0, 3.0], SHEET.family_sizes)
    state = sheet_state()
    short, long = (
        js.Springs(SHEET, BY_FAMILY, {js.STRUCTURAL: 1.0, js.SHEAR: 2**0.5}),
        js.Springs(SHEET, written, np.where(written > 5, 1.0, 2**0.5)),
    )
    for read in (
        lambda s: s.force(state),
        lambda s: s.energy(state),
        lambda s: s.stiffness_bound(state),
        lambda s: s.bind(jnp.float64).force(state),
        lambda s: s.rounding(state),
        lambda s: SHEET.flatten(s.tension(state)),
        lambda s: s.invalid(),
    ):
        for a, b in zip(jax.tree.leaves(read(short)), jax.tree.leaves(read(long)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(SHEET.flatten(short.stiffness), written)
    for make in (lambda c: js.Dashpots(SHEET, c), lambda c: js.Heat(SHEET, 1.0, c)):
        a, b = (jax.tree.leaves(make(c).bind(jnp.float64)) for c in (BY_FAMILY, written))
        for one, other in zip(a[-4:], b[-4:], strict=True):
            assert one.shape == other.shape


def test_gradients_by_family():
    """The gradient by a family's number is the sum of those by its springs."""
    state = sheet_state()

    def energy(springs):
        return springs.energy(state)

    by_spring = jax.grad(lambda k: energy(js.Springs(SHEET, k, 1.0)))(np.repeat([10.0, 10.0, 3.0, 3.0], SHEET.family_sizes))
    sums = [part.sum() for part in np.split(np.asarray(by_spring), np.cumsum(SHEET.family_sizes)[:-1])]
    by_family = eqx.filter_grad(energy)(js.Springs(SHEET, BY_FAMILY, 1.0)).stiffness
    np.testing.assert_allclose(by_family.families, sums, rtol=1e-12)
    by_number = jax.grad(lambda k: energy(js.Springs(SHEET, {js.STRUCTURAL: k, js.SHEAR: 3.0}, 1.0)))(10.0)
    assert float(by_number) == pytest.approx(sums[0] + sums[1], rel=1e-12)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        ({js.STRUCTURAL: 1.0}, ValueError, r"stiffness says nothing of the springs along \(1, 1\)"),
        ({**BY_FAMILY, js.BEND: 1.0}, ValueError, "stiffness names BEND, but this lattice has no such springs"),
        ({**BY_FAMILY, js.STRUCTURAL + js.SHEAR: 1.0}, ValueError, "twice"),
        ({"STRUCTURAL": 1.0}, TypeError, "has the key 'STRUCTURAL'; expected families"),
        ({js.STRUCTURAL: -1.0, js.SHEAR: 1.0}, ValueError, r"stiffness.families\[0\] = -1.0"),
        ({js.STRUCTURAL: [1.0, 2.0], js.SHEAR: 1.0}, ValueError, "stiffness is an edge field|one number"),
    ],
)
def test_wrong_numbers_by_family(value, error, text):
    """Families left out, unknown, named twice, of the wrong sign: refused by name."""
    with pytest.raises(error, match=text):
        js.Springs(SHEET, value, 1.0)
    with pytest.raises(TypeError, match="a Graph has no families"):
        js.Springs(js.Graph.from_edges(EDGES, 3), BY_FAMILY, 1.0)


def test_flat_is_flat():
    """`flatten` gives back what is flat already, and repeats one number; another length is refused."""
    np.testing.assert_array_equal(SHEET.flatten(np.arange(20.0)), np.arange(20.0))
    np.testing.assert_array_equal(SHEET.flatten(2.5), np.full(20, 2.5))
    with pytest.raises(ValueError, match="field has shape"):
        SHEET.flatten(np.zeros(19))


def test_a_matrix_with_stored_zeros_and_small_types():
    """A stored zero is a spring on whichever side of the diagonal; what is stored twice is summed without wrapping round."""
    row, column = [0, 0, 1, 1, 2], [1, 1, 0, 0, 1]
    matrix = scipy.sparse.coo_array((np.array([200, 100, 200, 100, 0], np.uint8), (row, column)), shape=(3, 3))
    for stored in (matrix, matrix.T):
        net, weights = js.topology.from_scipy(stored)
        assert (net.edges.tolist(), weights.tolist()) == ([[0, 1], [1, 2]], [300.0, 0.0])
    net, weights = js.topology.from_scipy(np.array([[False, True], [True, False]]))
    assert (net.n_springs, weights.tolist()) == (1, [1.0])


@pytest.mark.parametrize(
    ("matrix", "error", "text"),
    [
        (np.array([[0, 1j], [1j, 0]]), TypeError, "complex"),
        (np.array([[0, np.nan], [np.nan, 0]]), ValueError, r"entries of matrix\[0\] = nan"),
        (np.ma.masked_equal([[0, 1], [1, 0]], 1), ValueError, r"matrix\[0, 1\] is masked"),
    ],
)
def test_a_matrix_without_numbers(matrix, error, text):
    """Complex, missing and masked weights are refused."""
    with pytest.raises(error, match=text):
        js.topology.from_scipy(matrix)


def test_networkx_attributes():
    """One name is one attribute; None, text, NaN and a missing attribute are refused by edge, also among keys of mixed kinds."""
    graph = networkx.Graph()
    graph.add_edge("a", 1, stiffness=3.0)
    assert js.topology.from_networkx(graph, "stiffness")[2][0].tolist() == [3.0]
    for value, error in ((None, TypeError), ("3", TypeError), (np.nan, ValueError), ([1.0, 2.0], TypeError)):
        graph["a"][1]["stiffness"] = value
        with pytest.raises(error, match=r"stiffness.*edge \('a', 1\)|edge \('a', 1\).*stiffness"):
            js.topology.from_networkx(graph, ("stiffness",))
    graph["a"][1][7] = 1.0
    with pytest.raises(ValueError, match="has no attribute 'mass'; it has 'stiffness', 7"):
        js.topology.from_networkx(graph, ("mass",))
    with pytest.raises(TypeError, match=r"expected a networkx\.Graph"):
        js.topology.from_networkx([(0, 1)])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_bad_numbers_under_jit_are_a_status(bad):
    """What a constructor would refuse, traced: never OK at the end of a run."""
    state = js.State.from_points(NET, np.c_[ALONG, np.zeros((3, 2))])
    image = js.Image(np.arange(9.0).reshape(3, 3))
    builds = {
        "stiffness": lambda v: js.Springs(NET, v, 1.0),
        "rest_length": lambda v: js.Springs(NET, 1.0, v),
        "damping": lambda v: js.Dashpots(NET, v),
        "gamma": lambda v: js.Drag(v),
        "mass_rate": lambda v: js.Rayleigh(v, 0.0),
        "data": lambda v: js.DataSprings(image, v),
        "k_min": lambda v: js.Springs(NET, js.ImageStiffness(image, v, 2.0, 1.0), 1.0),
    }

    @jax.jit
    def flags(v):
        return [js.rollout(js.System(NET, 1.0, build(v)), state, js.SymplecticEuler(), 0.01, 1).status.is_ok for build in builds.values()]

    found = dict(zip(builds, flags(bad), strict=True))
    assert not any(found.values()), found


def test_a_traced_time_that_is_none():
    """A state whose time is NaN, traced: NONFINITE before the first step."""
    system = scene()[0]

    @jax.jit
    def status(time):
        return js.rollout(system, js.State.from_points(NET, ALONG, time=time), js.SymplecticEuler(), 0.01, 1).status

    assert status(0.5).is_ok
    assert status(np.nan).has(js.Flag.NONFINITE)
    assert status(np.nan).step == 0


def test_constants_of_nodes_fit_the_nodes():
    """A constant of each node in another shape would be stretched over the nodes, in silence: refused by name."""
    chain, sheet = js.State.from_points(NET, np.zeros((3, 3)), np.ones((3, 3))), js.lattice((2, 2))
    image = js.Image(np.ones((3, 3)))
    for force, name in (
        (js.Drag(np.ones((3, 1))), "gamma"),
        (js.DataSprings(image, np.ones((3, 1))), "stiffness"),
        (js.Gravity([0.0, 0.0, 1.0], np.ones((3, 1))), "mass"),
    ):
        with pytest.raises(ValueError, match=rf"{name} has shape \(3, 1\); expected \(\)"):
            js.System(NET, 1.0, force).force(chain)
    with pytest.raises(ValueError, match="gamma has shape"):
        js.System(sheet, 1.0, js.Drag([1.0, 2.0])).force(js.State.from_points(sheet, sheet.grid(), np.ones((4, 2))))


def test_moved_nodes_are_told_by_a_mask():
    """Node numbers and masks of another length are refused; numbers moved nothing, in silence."""

    def path(time):
        return js.Vector((time * jnp.ones(3),))

    for moved, error in (([0], TypeError), (np.array([True, False]), ValueError)):
        with pytest.raises(error, match=r"motion.moved has"):
            js.System(NET, 1.0, motion=js.Motion(moved, path))


def test_lists_of_points_are_sampled():
    """An image reads lists of coordinates as it reads arrays."""
    image = js.Image(np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(image.sample([0.0, 1.5], [1.0, 2.0]), image.sample(np.array([0.0, 1.5]), np.array([1.0, 2.0])))


def test_small_doors_name_what_they_refuse():
    """Coordinates that do not exist, times that are lists, lengths of many states: a sentence each; one number flattens to all nodes."""
    system, state = scene()
    with pytest.raises(ValueError, match=r"axes = \(0, 5\)"):
        js.Springs(NET, 1.0, 1.0, axes=(0, 5))
    with pytest.raises(ValueError, match=r"axes = \(0, 1\), but the positions have 1"):
        js.System(NET, 1.0, js.Springs(NET, 1.0, 1.0, axes=(0, 1))).force(state)
    with pytest.raises(ValueError, match="t1 has shape"):
        js.diffeqsolve(system, state, [1.0])
    with pytest.raises(ValueError, match=r"position has shape \(2, 3\).*vmap"):
        NET.lengths(jax.tree.map(lambda a: jnp.stack([a, a]), state.position))
    np.testing.assert_array_equal(NET.flatten_nodes(js.System(NET, 2.0).mass), [2.0, 2.0, 2.0])
