"""Breaks of a height field: closed forms of the chain, gains against energies by dense algebra, lines where the steps are."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

import jaxspring as js
from jaxspring.scenes.reconstruction.break_energy import Fitted, HeightField
from jaxspring.scenes.reconstruction.break_lines import Faces

find_breaks, step_stiffness = js.reconstruction.find_breaks, js.reconstruction.step_stiffness
RATIOS = ((1.0, 44.7), (0.1, 15.6), (0.01, 5.0), (0.001, 1.6))  # k_d / k, and the share of a step that a whole spring shows [%]
SIDE = 31


def chain_fit(ratio, height, n=2000):
    """A long chain with a step in its middle, k = 2."""
    net = js.lattice(n)
    data = np.where(np.arange(n) < n // 2, 0.0, height)
    field = HeightField.of(net, net.grid(), data, 2.0, 2.0 * ratio)
    return net, field, Fitted(field, np.zeros(n - 1, bool)), n // 2 - 1


def dense_energy(field, broken):
    """Least energy by dense algebra."""
    k, b = np.where(broken, 0, field.stiffness), np.zeros((len(broken), len(field.data)))
    b[np.arange(len(broken)), field.edges[:, 0]], b[np.arange(len(broken)), field.edges[:, 1]] = -1, 1
    z = np.linalg.solve(b.T * k @ b + np.diag(field.data_stiffness), field.data_stiffness * field.data)
    return 0.5 * k @ (b @ z) ** 2 + 0.5 * field.data_stiffness @ (z - field.data) ** 2


@pytest.mark.parametrize(("ratio", "share"), RATIOS)
def test_step_of_a_long_chain(ratio, share):
    """A step H shows as H K / k, costs K H^2 / 2, and breaking it gains all of that."""
    _, _, fit, middle = chain_fit(ratio, 3.0)
    k = float(step_stiffness(2.0, 2.0 * ratio))
    assert fit.extension[middle] == pytest.approx(3.0 * k / 2.0, rel=1e-9)
    assert 100 * fit.extension[middle] / 3.0 == pytest.approx(share, abs=0.06)
    assert fit.energy == pytest.approx(k * 9 / 2, rel=1e-9)
    assert fit.change([middle]) == pytest.approx(-k * 9 / 2, rel=1e-9)


def test_a_chain_as_good_as_rigid():
    """For k far above k_d the unbroken fit costs sqrt(k_d k) H^2 / 4."""
    assert float(step_stiffness(1e6, 1.0)) == pytest.approx(np.sqrt(1e6) / 2, rel=2e-3)


def test_outermost_spring_of_a_chain():
    """Beyond it lies one node alone: 1/K = 1/k + 1/k_d + 1/S, well below the chain's K."""
    _, field, fit, _ = chain_fit(0.01, 0.0)
    k, kd = 2.0, 0.02
    side = (kd + np.sqrt(kd**2 + 4 * kd * k)) / 2
    own = k * (1 - k * fit.coupling(0, [0])[0])
    assert own == pytest.approx(1 / (1 / k + 1 / kd + 1 / side), rel=1e-9)
    assert own < float(step_stiffness(k, kd)) / 5
    del field


def test_stiffness_of_a_step_has_its_derivative():
    """Of K by k and k_d, against central differences."""
    check_grads(step_stiffness, (jnp.asarray([1.0, 3.0]), jnp.asarray([0.2, 0.01])), order=1, modes=("rev",), rtol=1e-4)


def test_change_of_energy_is_exact(rng):
    """Any set of springs broken and made whole: the formula is the difference of two dense fits."""
    net = js.from_triangles(js.delaunay(rng.random((25, 2))).triangles, 25)
    n = net.n_springs
    field = HeightField.of(net, rng.random((25, 2)), rng.random(25), rng.uniform(0.5, 2, n), rng.uniform(0.01, 1, 25))
    broken = rng.random(n) < 0.3
    fit = Fitted(field, broken)
    assert fit.energy == pytest.approx(dense_energy(field, broken), rel=1e-10)
    for size in (1, 2, 7):
        springs = [int(s) for s in rng.choice(n, size, replace=False)]
        after = broken.copy()
        after[springs] ^= True
        assert fit.change(springs) == pytest.approx(dense_energy(field, after) - dense_energy(field, broken), rel=1e-8)


@pytest.mark.parametrize("ratio", [0.3, 0.01])
def test_a_chain_breaks_above_the_step_and_not_below(ratio):
    """The threshold is sharp: H > step."""
    n = 300
    net = js.lattice(n)
    for height, count in ((0.99, 0), (1.01, 1)):
        data = np.where(np.arange(n) < 150, 0.0, height)
        found = find_breaks(net, net.grid(), data, 1.0, ratio, step=1.0)
        assert found.n_broken == count
    assert found.broken[149]
    np.testing.assert_allclose(found.heights, data, atol=1e-9)
    assert found.gain == pytest.approx(float(step_stiffness(1.0, ratio)) * 1.01**2 / 2, rel=1e-9)


def smooth(p):
    """A surface below the steepest slope."""
    return 0.2 * np.sin(p[:, 0] / 13) + 0.15 * np.cos(p[:, 1] / 11)


FAULTS = {  # height above the smooth surface, and distance from the nearest edge, at points
    "straight": (lambda p: 1.0 * (p[:, 0] > 14.5), lambda p: np.abs(p[:, 0] - 14.5)),
    "diagonal": (lambda p: 1.0 * (p[:, 0] > p[:, 1] + 0.5), lambda p: np.abs(p[:, 0] - p[:, 1] - 0.5) / np.sqrt(2)),
    "oblique": (lambda p: 1.0 * (p[:, 0] > 0.4 * p[:, 1] + 8), lambda p: np.abs(p[:, 0] - 0.4 * p[:, 1] - 8) / np.hypot(1, 0.4)),
    "at the border": (lambda p: 1.0 * (p[:, 0] > 0.5), lambda p: np.abs(p[:, 0] - 0.5)),
    "crossing": (
        lambda p: 1.0 * (p[:, 0] > 14.5) + 0.8 * (p[:, 1] > 12.5),
        lambda p: np.minimum(np.abs(p[:, 0] - 14.5), np.abs(p[:, 1] - 12.5)),
    ),
}


def away_from_ring(p):
    """Points more than a cell from the ring, which never breaks."""
    return (np.abs(p - (SIDE - 1) / 2) < (SIDE - 1) / 2 - 1.1).all(axis=1)


def is_found(net, p, name, noise, seed, smoothness=0.3):
    """The fault broken within a cell of the truth, the ring kept, the error across it a third at most."""
    height, distance = FAULTS[name]
    truth = smooth(p) + height(p)
    data = truth + noise * np.random.default_rng(seed).standard_normal(len(p))
    found = find_breaks(net, p, data, 1.0, smoothness, step=0.5)
    ring = Faces.of(net).ring
    assert not found.broken[ring].any()
    on_lines = np.concatenate(found.lines)
    assert distance(on_lines[away_from_ring(on_lines)]).max(initial=0) < 1
    ends = np.asarray(net.edges)
    straddling = (height(p)[ends[:, 0]] != height(p)[ends[:, 1]]) & ~ring & away_from_ring(0.5 * (p[ends[:, 0]] + p[ends[:, 1]]))
    if name == "at the border":
        # Beside the ring: all springs between it and its neighbours.
        assert found.n_broken == SIDE - 2
        np.testing.assert_allclose(on_lines[:, 0], 0.5)
    else:
        assert found.broken[straddling].mean() > 0.95
        whole = Fitted(HeightField.of(net, p, data, 1.0, smoothness), np.zeros(net.n_springs, bool)).z
        near = (distance(p) < 2) & away_from_ring(p)
        error, before = (np.sqrt(np.mean((z - truth)[near] ** 2)) for z in (found.heights, whole))
        assert error < before / 3
    return found


@pytest.mark.parametrize("noise", [0.01, 0.05])
@pytest.mark.parametrize("name", FAULTS)
def test_faults_break_where_they_are(name, noise):
    """On a lattice: along rows, along the diagonal, between, beside the ring, and where two cross."""
    net = js.lattice((SIDE, SIDE))
    found = is_found(net, net.grid(), name, noise, seed=1)
    assert found.gain > found.price > 0


def test_faults_of_an_irregular_net(rng):
    """On a Delaunay mesh as well; spacings there are of about one."""
    p = np.asarray(js.lattice((SIDE, SIDE)).grid()) + 0.0
    inner = away_from_ring(p)
    p[inner] += rng.uniform(-0.3, 0.3, p[inner].shape)
    is_found(js.delaunay(p), p, "oblique", 0.05, seed=1)


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_no_break_without_a_fault(noise):
    """A smooth surface below the steepest slope stays whole, as it does with a step lower than the noise."""
    net = js.lattice((SIDE, SIDE))
    p = net.grid()
    for seed in range(5):
        data = smooth(p) + noise * np.random.default_rng(seed).standard_normal(len(p))
        found = find_breaks(net, p, data, 1.0, 0.3, step=0.5)
        assert found.n_broken == 0
        assert found.lines == ()
    assert np.hypot(0.2 / 13, 0.15 / 11) < found.steepest
    low = np.where(p[:, 0] > 14.5, 0.5 * noise, 0.0) + noise * np.random.default_rng(0).standard_normal(len(p))
    assert find_breaks(net, p, low, 1.0, 0.3, step=max(3 * noise, 1e-3)).n_broken == 0


def test_no_single_change_lowers_the_energy(rng):
    """At the end neither a spring made whole nor a node that changes sides pays."""
    net = js.lattice((12, 12))
    p = net.grid()
    data = 1.0 * (p[:, 0] > 0.6 * p[:, 1] + 2) + 0.05 * rng.standard_normal(len(p))
    found = find_breaks(net, p, data, 1.0, 0.3, step=0.5)
    field = HeightField.of(net, p, data, 1.0, 0.3)
    fit = Fitted(field, found.broken)
    price = float(step_stiffness(1.0, 0.3)) * 0.25 / 2
    for spring in np.flatnonzero(found.broken):
        assert fit.change([int(spring)]) >= price
    assert found.price == pytest.approx(price * found.n_broken)
    assert found.gain == pytest.approx(dense_energy(field, np.zeros_like(found.broken)) - dense_energy(field, found.broken), rel=1e-9)


@pytest.mark.slow
def test_the_rest_of_the_library_takes_the_breaks():
    """A state with `whole` comes to rest at the same heights, with the derivative of the data springs' stiffness."""
    net = js.lattice((6, 7))
    p = np.asarray(net.grid())
    pixels = np.where(p[:, 0] > 2.5, 1.0, 0.1).reshape(6, 7) + 0.002 * np.arange(42.0).reshape(6, 7)
    found = find_breaks(net, p, pixels.ravel(), 1.0, 0.2, step=0.4)
    assert found.n_broken >= 4
    free = np.zeros((42, 3), bool)
    free[:, 2] = True
    start = js.State.from_points(net, np.column_stack([p, np.zeros(42)])).with_alive(net, found.whole)

    def heights(kd):
        forces = (js.Springs(net, 1.0, 0.0, axes=(2,)), js.DataSprings(js.Image(pixels), kd))
        return js.equilibrium(js.System(net, 1.0, forces, free=free), start).state.points[:, 2]

    z, slope = jax.jit(lambda kd: jax.jvp(heights, (kd,), (jnp.ones(()),)))(jnp.asarray(0.2))
    np.testing.assert_allclose(z, found.heights, atol=1e-8)
    low, high = (Fitted(HeightField.of(net, p, pixels.ravel(), 1.0, kd), found.broken).z for kd in (0.2 - 1e-5, 0.2 + 1e-5))
    np.testing.assert_allclose(slope, (high - low) / 2e-5, atol=1e-6)


def test_lines_are_traced_through_all_breaks(rng):
    """Each pair of broken springs at one face is joined once; a closed line comes back to its start."""
    net = js.lattice((20, 20))
    p = net.grid()
    found = find_breaks(net, p, 1.0 * (np.hypot(p[:, 0] - 9.3, p[:, 1] - 9.6) < 5.2), 1.0, 0.3, step=0.5)
    (line,) = found.lines
    np.testing.assert_allclose(line[0], line[-1])
    assert len(line) == found.n_broken + 1
    assert np.abs(np.hypot(*(line - [9.3, 9.6]).T) - 5.2).max() < 1
    del rng


def test_a_broken_surface_over_an_image():
    """A disc over a coarse mesh: breaks within half a cell; what is left are pixels that the straight pieces of the line put aside."""
    y, x = np.mgrid[:100, :110]
    r = np.hypot(x - 54, y - 48)
    image = js.Image(1.0 * (r < 30) + 0.1 * np.sin(x / 30))
    places = np.stack(np.meshgrid(np.linspace(0, 109, 23), np.linspace(0, 99, 21)), axis=-1).reshape(-1, 2)
    triangles = js.delaunay(places).triangles
    found = js.reconstruction.break_surface(image, places, triangles, step=0.4)
    unbroken = found.unbroken.errors(image)
    assert found.rmse < unbroken.rmse / 2
    wrong = np.abs(found.drawn - np.asarray(image.values)) > 0.5
    assert wrong.sum() < 25
    assert np.abs(r[wrong] - 30).max() < 1
    line = np.concatenate(found.breaks.lines)
    assert np.abs(np.hypot(*(line - [54, 48]).T) - 30).max() < 2.5
    assert np.isfinite(found.drawn).all()
    assert unbroken.outside == unbroken.folds == 0


def test_a_surface_without_an_edge_stays_whole(rng):
    """Then it is the least-squares surface, as `fitted_tin` finds it."""
    y, x = np.mgrid[:40, :40]
    image = js.Image(0.5 * np.sin(x / 20) * np.cos(y / 15) + 0.01 * rng.standard_normal((40, 40)))
    places = np.stack(np.meshgrid(np.linspace(0, 39, 9), np.linspace(0, 39, 9)), axis=-1).reshape(-1, 2)
    triangles = js.delaunay(places).triangles
    found = js.reconstruction.break_surface(image, places, triangles, step=0.4)
    assert found.breaks.n_broken == 0
    np.testing.assert_allclose(found.tin.points, js.reconstruction.fitted_tin(image, places, triangles).points)
    assert found.rmse == pytest.approx(found.tin.errors(image).rmse)


REFUSED = {
    "positive": {"step": -1.0},
    "no side|side of no face|no faces|has no spring": {"net": js.lattice((4, 4), js.STRUCTURAL + js.SHEAR)},
    "data_stiffness is 0 everywhere": {"data_stiffness": 0.0},
    "stiffness.* must be zero or more": {"stiffness": -1.0},
    "data has shape": {"data": np.zeros(3)},
    "must be finite": {"data": np.full(16, np.nan)},
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_break_is_refused(why):
    """By name."""
    net = js.lattice((4, 4))
    good = {"net": net, "points": net.grid(), "data": np.zeros(16), "stiffness": 1.0, "data_stiffness": 0.1, "step": 1.0}
    with pytest.raises(ValueError, match=why):
        find_breaks(**(good | REFUSED[why]))


def test_holes_in_the_data_are_not_read():
    """A node whose data spring is 0 may hold NaN."""
    net = js.lattice((5, 5))
    data, kd = np.zeros(25), np.full(25, 0.1)
    data[7], kd[7] = np.nan, 0.0
    found = find_breaks(net, net.grid(), data, 1.0, kd, step=1.0)
    np.testing.assert_allclose(found.heights, 0, atol=1e-9)
    assert dataclasses.is_dataclass(found)


def test_faces_of_a_lattice_and_of_triangles():
    """Every inner spring has two faces, every spring of the ring one."""
    for net in (js.lattice((4, 5)), js.delaunay(np.array(list(itertools.product(range(4), range(5))), float) ** 1.01)):
        faces = Faces.of(net)
        assert ((faces.beside >= 0).sum(axis=1) == np.where(faces.ring, 1, 2)).all()


def test_a_steep_slope_over_an_image_is_mended():
    """Nodes alone would break it; the pixels are nearer to the surface in one piece, so it stays, and a fault breaks."""
    x = np.mgrid[:60, :60][1]
    places = np.stack(np.meshgrid(np.linspace(0, 59, 13), np.linspace(0, 59, 13)), axis=-1).reshape(-1, 2)
    triangles = js.delaunay(places).triangles
    slope = 0.1 * np.clip(x - 35, 0, 15)
    found = js.reconstruction.break_surface(js.Image(slope), places, triangles, step=0.4)
    assert found.breaks.steepest < 0.1 * 59 / 12
    net = js.from_triangles(triangles, len(places))
    assert find_breaks(net, places, np.asarray(js.Image(slope).sample(*places.T)), 1.0, 1.0, 0.4).n_broken > 10
    assert found.breaks.n_broken == 0
    both = js.reconstruction.break_surface(js.Image(slope + 1.0 * (x < 17)), places, triangles, step=0.4)
    assert both.breaks.n_broken > 10
    assert np.abs(np.concatenate(both.breaks.lines)[:, 0] - 16.5).max() < 5
    assert both.rmse < both.unbroken.errors(js.Image(slope + 1.0 * (x < 17))).rmse
