"""Further nets over the nodes of a net: `with_edges`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

RNG = np.random.default_rng(11)
SQUARE = RNG.random((30, 2))
BASES = {
    "lattice": js.lattice((5, 6)),
    "graph": js.delaunay(SQUARE),
    "few": js.Graph.from_edges([(0, 1)], 30),
}
SEAM = np.array([[0, 29], [7, 22], [29, 3]])
MANY = np.array([p for p in RNG.integers(0, 30, (80, 2)) if p[0] != p[1]])


def scene(base, edges, points=None):
    """The springs over the base, and the same as a net of their own."""
    points = np.random.default_rng(5).normal(size=(30, 3)) if points is None else points
    k, c = np.linspace(1, 9, len(edges)), np.linspace(0.1, 0.5, len(edges))
    found = []
    for first, net in ((base, base.with_edges(edges)), (js.Graph.from_edges(edges, 30),) * 2):
        system = js.System(first, 1.0, (js.Springs(net, k, 0.7), js.Dashpots(net, c)), free=np.arange(30) > 0)
        found.append((system, js.State.from_points(first, points, points[::-1])))
    return found


@pytest.mark.parametrize("edges", [SEAM, MANY], ids=["seam", "many"])
@pytest.mark.parametrize("base", BASES.values(), ids=BASES)
def test_an_overlay_is_the_net_of_its_springs(base, edges):
    """Forces, energies, lengths and edges are those of a graph of the same springs; nodes beside it feel nothing."""
    (over, state), (alone, own) = scene(base, edges)
    np.testing.assert_array_equal(over.forces[0].net.edges, edges)
    for a, b in zip(over.force(state), alone.force(own), strict=True):
        np.testing.assert_allclose(base.flatten_nodes(a), alone.net.flatten_nodes(b), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(over.energy(state).total, alone.energy(own).total, rtol=1e-13)
    lengths = np.linalg.norm(own.points[edges[:, 1]] - own.points[edges[:, 0]], axis=1)
    np.testing.assert_allclose(over.forces[0].net.lengths(own.points), lengths, rtol=1e-13)
    beside = np.setdiff1d(np.arange(30), edges)
    assert not np.stack([base.flatten_nodes(a) for a in over.force(state)])[:, beside].any()


@pytest.mark.slow
@pytest.mark.parametrize("edges", [SEAM, MANY], ids=["seam", "many"])
@pytest.mark.parametrize("base", list(BASES.values())[:2], ids=["lattice", "graph"])
def test_implicit_steps_and_gradients(base, edges):
    """Backward Euler by conjugate gradients and by Skyline of both nets, and gradients by every constant, are those of the graph alone."""
    (over, state), (alone, own) = scene(base, edges)
    net = over.forces[0].net
    quick = {"xla_backend_optimization_level": 0}  # each program runs once, for milliseconds

    def ended(system, state, stepper):
        return jax.jit(lambda s: js.rollout(system, s, stepper, 0.05, 4), compiler_options=quick)(state)

    wanted = ended(alone, own, js.BackwardEuler())
    for solver in (js.JaxCG(), js.Skyline(base, net)):
        found = ended(over, state, js.BackwardEuler(solver))
        js.raise_for_status(found)
        np.testing.assert_allclose(found.state.points, wanted.state.points, atol=1e-8)

    # One program for each net: a step that is stored is not compiled again for the way back.
    def end(k, system, state):
        run = js.rollout(js.replace(system, stiffness=k), state, js.VelocityVerlet(), 0.02, 10, adjoint=js.StoreAll())
        return jnp.sum(run.state.points**2)

    def derivatives(k, system, state):
        gradient = jax.grad(end)(k, system, state)
        twice = jax.grad(lambda k: jnp.sum(jax.grad(end)(k, system, state) ** 2))(k)
        return end(k, system, state), gradient, jax.jacfwd(end)(k, system, state), twice

    k = jnp.linspace(1, 9, len(edges))
    of_over = jax.jit(lambda k: derivatives(k, over, state), compiler_options=quick)
    of_alone = jax.jit(lambda k: derivatives(k, alone, own), compiler_options=quick)
    (_, *first, twice), (_, *known, known_twice) = of_over(k), of_alone(k)
    for derivative, expected in zip(first, known, strict=True):
        np.testing.assert_allclose(derivative, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(twice, known_twice, rtol=1e-8, atol=1e-10)
    lanes = jax.jit(jax.vmap(lambda k: end(k, over, state)), compiler_options=quick)(jnp.stack([k, 2 * k]))
    np.testing.assert_allclose(lanes[1], of_over(2 * k)[0], rtol=1e-12)


class Snapping(js.Rule):
    """Springs of this net break beyond a length."""

    net: js.topology.Topology
    longest: jax.Array

    def begin(self, state):
        """Every spring has its bit."""
        return state.with_alive(self.net, state.alive_of(self.net))

    def update(self, step, state):
        """Long springs break."""
        lengths = self.net.difference(state.position).map(lambda d: d.norm())
        alive = self.net.map_springs(lambda a, l: a & (l <= self.longest), state.alive_of(self.net), lengths)
        return state.with_alive(self.net, alive), js.Status.ok()


@pytest.mark.slow
@pytest.mark.parametrize("base", list(BASES.values())[:2], ids=["lattice", "graph"])
def test_each_net_breaks_by_itself(base, tmp_path):
    """Two nets over one set of nodes break apart: each loses the springs that are too long for it, pulls with the others, and is saved."""
    seam, many = base.with_edges(SEAM), base.with_edges(MANY)
    points = np.random.default_rng(5).normal(size=(30, 3))
    forces = (js.Springs(seam, 1.0, 1.0), js.Springs(many, 1.0, 1.0), js.Springs(base, 1.0, 1.0))
    system = js.System(base, 1.0, forces, rules=(Snapping(many, jnp.asarray(2.0)), Snapping(seam, jnp.asarray(3.0))))
    end = js.rollout(system, js.State.from_points(base, points), js.Still(), 0.1, 1).state
    for net, longest in ((many, 2.0), (seam, 3.0)):
        np.testing.assert_array_equal(net.flatten(end.alive_of(net)), net.lengths(points) <= longest)
        assert not net.flatten(end.alive_of(net)).all() or net is seam
    assert base.flatten(end.alive_of(base)).all()
    tension = np.asarray(many.flatten(system.bind(float).forces[1].tension(end)))
    assert ((tension == 0) == (many.lengths(points) > 2.0)).all()
    js.save(tmp_path / "end.npz", end)
    back = js.load(tmp_path / "end.npz", like=end)
    np.testing.assert_array_equal(many.flatten(back.alive_of(many)), many.flatten(end.alive_of(many)))


def test_fusing_two_nets(user_mode):
    """Two nets fuse at melting points of their own, in one run."""
    sheet = js.lattice(3)
    bend = sheet.with_edges([(0, 2)])
    forces = (js.Springs(sheet, 1.0, 1.0), js.Springs(bend, 1.0, 2.0))
    system = js.System(sheet, 1.0, forces, rules=(js.Fusing(sheet, 350.0), js.Fusing(bend, 450.0)))
    hot = js.State.from_points(sheet, sheet.grid(), temperature=[300.0, 500.0, 500.0])
    end = js.rollout(system, hot, js.Still(), 0.1, 1).state
    assert sheet.flatten(end.alive_of(sheet)).tolist() == [False, False]
    assert bend.flatten(end.alive_of(bend)).tolist() == [True]


def test_a_field_of_no_net_of_the_system_is_refused():
    """Broken springs of a net that no part has would be read by none: refused, by name."""
    net, other = js.lattice(3), js.lattice(3).with_edges([(0, 2)])
    state = js.State.from_points(net, net.grid()).with_alive(other, other.own([jnp.zeros(1, bool)]))
    system = js.System(net, 1.0, js.Springs(net, 1.0, 1.0))
    for take in (lambda: system.force(state), lambda: js.rollout(system, state, js.SymplecticEuler(), 0.1, 1)):
        with pytest.raises(ValueError, match=r"state\.alive tells about the springs of another net .*Overlay of 3 nodes"):
            take()
    assert js.rollout(system, dataclasses.replace(state, alive=None), js.SymplecticEuler(), 0.1, 1) is not None


def test_periods_and_empty_nets():
    """A box wraps the further net's springs too; a net without springs pulls at nothing."""
    ring = js.lattice(4, periodic=True, box=(4.0,))
    across = ring.with_edges([(0, 3)])
    assert across.lengths(ring.grid()).tolist() == [1.0]
    nothing = ring.with_edges(np.zeros((0, 2), int))
    state = js.State.from_points(ring, ring.grid())
    assert not js.System(ring, 1.0, js.Springs(nothing, 1.0, 1.0)).force(state).x.any()


@pytest.mark.parametrize(
    ("edges", "message"), [([(0, 30)], "names node 30"), ([(2, 2)], "joins"), ([(0, 1, 2)], "edges"), ([(-1, 0)], "-1")]
)
def test_wrong_edges_are_refused(edges, message):
    """Nodes that do not exist, a spring from a node to itself, another shape: named."""
    with pytest.raises(ValueError, match=message):
        BASES["lattice"].with_edges(edges)
