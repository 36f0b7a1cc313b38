"""Hard cases K4, K8, K11: a scene does not depend on how it was written down.

Each scene holds one group of effects. It is run once as it is, and once changed in a way that physics does not see: other numbers for
the nodes and springs, springs written head first, another place on the map, a second copy beside it, float32, another net of the same
springs. The last places, velocities and temperatures are the same, in the first scene's order.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxspring as js

N_STEPS = 12
SIDE = 3


@dataclasses.dataclass
class Drawn:
    """A scene on paper: nodes, springs, constants, in NumPy; `origin` is where on the map its corner lies."""

    points: np.ndarray
    velocities: np.ndarray
    edges: np.ndarray
    mass: np.ndarray
    per_spring: np.ndarray  # a number between 0 and 1
    temperature: np.ndarray
    free: np.ndarray
    moved: np.ndarray
    origin: np.ndarray
    dtype: type = np.float64

    @property
    def lengths(self):
        return np.linalg.norm((self.points[self.edges[:, 1]] - self.points[self.edges[:, 0]]), axis=1)

    def cast(self, array):
        return np.asarray(array, self.dtype)


def drawn() -> Drawn:
    """A jittered sheet of 3 x 3 nodes in space, structural springs first along x, then along y."""
    rng = np.random.default_rng(20260301)
    n = SIDE * SIDE
    y, x = (a.ravel() for a in np.mgrid[:SIDE, :SIDE])
    points = np.stack([x, y, 0 * x], axis=1) + 0.08 * rng.standard_normal((n, 3)) + 2.0
    index = np.arange(n).reshape(SIDE, SIDE)
    along_x = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], axis=1)
    along_y = np.stack([index[:-1].ravel(), index[1:].ravel()], axis=1)
    edges = np.concatenate([along_x, along_y])
    return Drawn(
        points=points,
        velocities=0.3 * rng.standard_normal((n, 3)),
        edges=edges,
        mass=rng.uniform(0.5, 1.5, n),
        per_spring=rng.random(len(edges)),
        temperature=np.linspace(290.0, 340.0, n) + rng.standard_normal(n),
        free=np.arange(n) != 0,
        moved=np.arange(n) == n - 1,
        origin=np.zeros(3),
    )


def at_rest(d: Drawn):
    return d.cast(0.95 * d.lengths)


def damped(d: Drawn, net):
    """Springs, every damper, weight; one node held, one on a schedule."""
    where = d.cast(d.points).T

    def path(time):
        shift = 0.1 * jnp.sin(3 * time)
        return js.Vector(tuple(net.node_field(jnp.asarray(a) + shift, "path") for a in where))

    springs = js.Springs(net, d.cast(20 + 10 * d.per_spring), at_rest(d))
    dampers = (js.Dashpots(net, d.cast(0.2 + d.per_spring)), js.Rayleigh(0.1, 0.01), js.Drag(d.cast(0.2 + 0.2 * d.mass)))
    moved = js.Motion(d.moved, path)
    return js.System(net, d.cast(d.mass), (springs, *dampers, js.Gravity([0.0, -9.81, 0.0])), free=d.free, motion=moved)


def over_an_image(d: Drawn, net):
    """Springs that follow an image, data springs and attraction."""
    rows, columns = np.mgrid[:12, :12] / 11.0
    pixels = d.cast(np.sin(5 * columns + 1) + np.cos(4 * rows) * columns)
    image = js.Image(pixels, spacing=d.dtype(0.6), origin=d.cast(d.origin[:2]))
    springs = js.Springs(net, js.ImageStiffness(image, 5.0, 40.0, 1.0), at_rest(d))
    return js.System(
        net, d.cast(d.mass), (springs, js.DataSprings(image, d.cast(2 + d.mass)), js.ImageAttraction(image, 0.5), js.Drag(0.3))
    )


def heated(d: Drawn, net):
    """Springs that conduct, expand, soften and fuse."""
    stiffness = js.thermal.ThermalStiffness(d.dtype(30.0), 300.0, 330.0)
    springs = js.Springs(net, stiffness, at_rest(d), expansion=js.thermal.ThermalExpansion(2e-3, 300.0))
    heat = js.Heat(net, d.cast(1 + d.mass), d.cast(0.5 + d.per_spring))
    return js.System(net, d.cast(d.mass), (springs, js.Drag(0.3)), rules=(heat, js.Fusing(net, 328.0)))


def fluid(d: Drawn, net):
    """Springs beside a particle fluid with a neighbour list."""
    law = js.Fluid(js.fluid.LennardJones(0.05, 0.8), cutoff=js.fluid.ShiftedForce(1.6), pairs=js.fluid.NeighbourList(capacity=24, skin=0.5))
    return js.System(net, d.cast(d.mass), (js.Springs(net, d.cast(5 + 5 * d.per_spring), at_rest(d)), law))


def bouncing(d: Drawn, net):
    """A net that falls onto a floor, with friction and restitution."""
    floor = js.Floor(d.cast(d.origin + np.array([0.0, 1.85, 0.0])), (0.0, 1.0, 0.0), 0.3, restitution=0.5)
    return js.System(
        net, d.cast(d.mass), (js.Springs(net, d.cast(20 + 10 * d.per_spring), at_rest(d)), js.Gravity([0.0, -9.81, 0.0])), rules=floor
    )


SCENES = {
    "damped": (damped, js.VelocityVerlet(), 0.02),
    "damped, implicit": (damped, js.BackwardEuler(js.CG(tolerance=1e-13)), 0.05),
    "image": (over_an_image, js.VelocityVerlet(), 0.02),
    "heated": (heated, js.SymplecticEuler(), 0.02),
    "fluid": (fluid, js.VelocityVerlet(), 0.02),
    "bouncing": (bouncing, js.SymplecticEuler(), 0.02),
}


def run(scene: str, d: Drawn, net=None):
    """Last points, velocities and temperatures, and which springs live, in the order of `d`."""
    build, stepper, dt = SCENES[scene]
    if isinstance(stepper, js.BackwardEuler) and d.dtype == np.float32:
        stepper = js.BackwardEuler()  # asks for what float32 can give
    net = js.Graph.from_edges(d.edges, len(d.points)) if net is None else net
    temperature = d.cast(d.temperature) if scene == "heated" else None
    state = js.State.from_points(net, d.cast(d.points), d.cast(d.velocities), temperature=temperature)
    result = js.rollout(build(d, net), state, stepper, dt, N_STEPS)
    js.raise_for_status(result)
    end = result.state
    alive = np.ones(len(d.edges), bool) if end.alive is None else np.asarray(net.flatten(end.alive))
    heat = np.zeros(len(d.points)) if end.temperature is None else np.asarray(end.temperatures)
    return np.asarray(end.points, float) - d.origin, np.asarray(end.velocities, float), heat, alive


@pytest.fixture(scope="module")
def plain():
    """What each scene does as it was drawn, run once."""
    return {scene: run(scene, drawn()) for scene in SCENES}


def agree(found, expected, rtol):
    for name, a, b in zip(("points", "velocities", "temperatures"), found[:3], expected[:3], strict=True):
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * np.abs(b).max(), err_msg=name)
    np.testing.assert_array_equal(found[3], expected[3])


each_scene = pytest.mark.parametrize("scene", SCENES)


@each_scene
def test_k4_scenes_are_not_at_rest(scene, plain):
    """Every scene moves by more than a tenth of a spacing: what follows compares motions, not standstill."""
    assert np.abs(plain[scene][0] - drawn().points).max() > 0.1
    if scene == "heated":
        assert 0 < plain[scene][3].sum() < len(plain[scene][3])  # some springs have fused


@each_scene
@pytest.mark.slow
def test_k8_numbers_of_nodes_and_springs_do_not_matter(scene, plain):
    """With nodes and springs numbered at random, and half of the springs written head first, the same happens."""
    rng = np.random.default_rng(5)
    d = drawn()
    node, spring = rng.permutation(len(d.points)), rng.permutation(len(d.edges))
    number = np.argsort(node)  # old number -> new number
    edges = number[d.edges[spring]]
    edges[::2] = edges[::2, ::-1]
    by_node = {name: getattr(d, name)[node] for name in ("points", "velocities", "mass", "temperature", "free", "moved")}
    shuffled = dataclasses.replace(d, edges=edges, per_spring=d.per_spring[spring], **by_node)
    x, v, heat, alive = run(scene, shuffled)
    agree((x[number], v[number], heat[number], alive[np.argsort(spring)]), plain[scene], 1e-10)


@each_scene
@pytest.mark.slow
def test_k11_the_place_on_the_map_does_not_matter(scene, plain):
    """A million metres away, in float64, the same happens to the rounding of the coordinates."""
    d = drawn()
    origin = np.array([1e6, -2e6, 0.0])
    if scene == "image":
        origin[2] = 0.0  # heights are values of the image
    moved = dataclasses.replace(d, points=d.points + origin, origin=origin)
    agree(run(scene, moved), plain[scene], 1e-7)


@each_scene
@pytest.mark.slow
def test_k8_a_second_copy_far_away_changes_nothing(scene, plain):
    """Two nets side by side in one scene, out of each other's reach: each does what it does alone."""
    d = drawn()
    n = len(d.points)
    far = np.array([0.0, 0.0, 50.0])  # every scene is uniform along z but for the heights over the image
    if scene == "image":
        far = np.zeros(3)
    twice = {name: np.concatenate([getattr(d, name)] * 2) for name in ("velocities", "mass", "temperature", "free", "moved", "per_spring")}
    points, edges = np.concatenate([d.points, d.points + far]), np.concatenate([d.edges, d.edges + n])
    x, v, heat, alive = run(scene, dataclasses.replace(d, points=points, edges=edges, **twice))
    half = len(d.edges)
    agree((x[:n], v[:n], heat[:n], alive[:half]), plain[scene], 1e-9)
    agree((x[n:] - far, v[n:], heat[n:], alive[half:]), plain[scene], 1e-9)


@each_scene
@pytest.mark.slow
def test_k4_float32_is_float64_to_its_digits(scene, plain):
    """In float32 the same happens to four digits."""
    agree(run(scene, dataclasses.replace(drawn(), dtype=np.float32)), plain[scene], 2e-4)


@each_scene
@pytest.mark.slow
def test_k8_a_lattice_is_its_graph(scene, plain):
    """The same springs as a lattice, each constant in the lattice's order: the same happens."""
    d = drawn()
    net = js.lattice((SIDE, SIDE), springs=js.STRUCTURAL)
    key = {tuple(sorted(edge)): i for i, edge in enumerate(d.edges.tolist())}
    order = np.array([key[tuple(sorted(edge))] for edge in np.asarray(net.edges).tolist()])
    x, v, heat, alive = run(scene, dataclasses.replace(d, edges=np.asarray(net.edges), per_spring=d.per_spring[order]), net)
    agree((x, v, heat, alive[np.argsort(order)]), plain[scene], 1e-10)


@pytest.mark.parametrize(
    "stepper", [js.SymplecticEuler(), js.VelocityVerlet(), js.RungeKutta4(), js.SemiImplicit()], ids=lambda s: type(s).__name__
)
def test_k4_one_node_without_springs(stepper):
    """A single node under weight and drag falls as NumPy's steps of the scalar equation say."""
    net = js.Graph.from_edges(np.zeros((0, 2), int), 1)
    system = js.System(net, 2.0, (js.Springs(net, np.zeros(0), np.zeros(0)), js.Gravity([0.0, -10.0]), js.Drag(0.0)))
    result = js.rollout(system, js.State.from_points(net, [[0.0, 1.0]], [[1.0, 0.0]]), stepper, 0.01, 10)
    js.raise_for_status(result)
    late = 0.5 * 10 * 0.1 * 0.01 if isinstance(stepper, js.SymplecticEuler | js.SemiImplicit) else 0.0  # order 1: g t dt / 2 too deep
    np.testing.assert_allclose(result.state.points, [[0.1, 1 - 5 * 0.1**2 - late]], rtol=1e-12)
