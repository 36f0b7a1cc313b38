"""The spring lens: what it delivers, that it folds nothing, that its maps are each other's inverses, and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse
import scipy.sparse.linalg

import jaxspring as js
from jaxspring.scenes.lens.feasible import ideal_anisotropy

SIDE = 65
MIDDLE = (SIDE - 1) / 2
LENS = js.lens.Lens((SIDE, SIDE))
SMOOTH = scipy.ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(48, 60)), 4)
SMALL = js.lens.Lens((48, 60), nodes=13, n_passes=6, sampling=js.images.CubicSpline(), solver=js.JaxCG(tolerance=1e-13))


@jax.jit
def warped(centre, radius, magnification):
    """A disc, rim as it comes: one program for all."""
    return LENS.warp(js.lens.Disc(centre, radius, magnification))


def disc(radius, magnification, at=(1.0, 1.0)):
    """The same with a radius and place over those of the sheet."""
    return warped(MIDDLE * jnp.array(at), MIDDLE * jnp.asarray(radius), jnp.asarray(magnification))


def pixels():
    y, x = np.indices((SIDE, SIDE), dtype=float)
    return jnp.asarray(x), jnp.asarray(y)


CASES = [(0.3, 1.5), (0.3, 2.0), (0.2, 3.0), (0.3, 0.5)]


@pytest.mark.parametrize(("radius", "magnification"), CASES)
def test_the_magnification_is_delivered_without_a_fold(radius, magnification):
    """Calibrated, every cell inside the disc has the magnification within 2 %; areas, border and certificate against NumPy."""
    warp = disc(radius, magnification)
    assert bool(warp.status.is_ok)
    assert float(warp.delivered[0]) == pytest.approx(magnification, rel=0.02)
    x, y = (np.asarray(a) for a in warp.position)
    corners = [np.stack([x[i], y[i]]) for i in (np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, 1:], np.s_[1:, :-1])]
    shoelace = 0.5 * sum(a[0] * b[1] - a[1] * b[0] for a, b in zip(corners, corners[1:] + corners[:1], strict=True))
    assert np.asarray(warp.magnification) == pytest.approx(np.sqrt(shoelace) / (SIDE - 1) * 32, rel=1e-10)
    centres = np.indices((32, 32)) + 0.5 - 16
    inside = np.hypot(*centres) < radius * 16 - np.sqrt(0.5)
    assert np.asarray(warp.magnification)[inside] == pytest.approx(magnification, rel=0.02)
    # Convex cells stay convex or not, but no triangle of either cut in use turns over, and the border stays in order.
    certificate = warp.certificate()
    assert bool(certificate.is_one_to_one)
    assert float(certificate.least_area) > 0
    assert np.all(np.diff(x[[0, -1]], axis=1) > 0)
    assert np.all(np.diff(y[:, [0, -1]], axis=0) > 0)


def test_the_certificate_sees_a_fold():
    """One node dragged across its neighbour is found, and counted."""
    warp = disc(0.3, 1.5)
    x = warp.position.x.at[16, 16].add(3 * MIDDLE / 16)
    folded = eqx.tree_at(lambda w: w.position, warp, js.Vector((x, warp.position.y)))
    assert int(folded.certificate().n_folds) > 0
    assert not bool(folded.certificate().is_one_to_one)


@pytest.mark.parametrize(("radius", "magnification"), CASES[1:3])
def test_the_maps_are_inverses(radius, magnification):
    """Inverse of forward, and forward of inverse, within 0.01 pixels at every pixel; the search loses none."""
    warp, (x, y) = disc(radius, magnification), pixels()
    there, back = jax.jit(lambda w: (w.inverse(*w.forward(x, y)), w.forward(*w.inverse(x, y))))(warp)
    for found in (*there, *back):
        assert bool(jnp.all(jnp.isfinite(found)))
    for found in (there, back):
        assert float(jnp.max(jnp.hypot(found[0] - x, found[1] - y))) < 1e-8


def test_the_search_of_pixels_finds_what_that_of_points_does():
    """`apply` starts its search from a coarse one; the places are the same."""
    warp, (x, y) = disc(0.3, 2.0, at=(0.5, 1.2)), pixels()
    image = jnp.asarray(np.random.default_rng(0).normal(size=(SIDE, SIDE)))
    expected = js.Image(image).sample(*warp.inverse(x, y))
    np.testing.assert_allclose(warp.apply(image), expected, atol=1e-9)


def test_the_mesh_is_the_balance_of_its_springs():
    """The tension per length alone, solved by SciPy along x and along y, gives the mesh; with rest lengths the net pulls nowhere."""
    warp = disc(0.3, 2.0, at=(0.7, 1.1))
    net = warp.mesh.net
    weights, (tail, head) = np.asarray(net.flatten(warp.stiffness)), net.edges.T
    assert weights.min() == 0
    assert np.all(weights[weights > 0] > 1e-3)
    n = net.n_nodes
    entries = np.r_[weights, weights, -weights, -weights]
    matrix = scipy.sparse.csr_matrix((entries, (np.r_[tail, head, tail, head], np.r_[tail, head, head, tail])), (n, n))
    for given, free, found in zip((warp.mesh.x, warp.mesh.y), warp.mesh.is_free, warp.position, strict=True):
        at, free = np.ravel(given).copy(), np.ravel(free)
        at[free] = scipy.sparse.linalg.spsolve(matrix[free][:, free].tocsc(), -matrix[free][:, ~free] @ at[~free])
        np.testing.assert_allclose(np.ravel(found), at, atol=1e-6)
    system = warp.system().bind(float)
    start = js.State.from_points(net, np.stack([np.ravel(a) for a in warp.position], axis=1))
    pull = system.hold(system.force(start))
    assert float(pull.largest()) < 1e-6 * float(jnp.max(jnp.asarray(weights))) * SIDE
    springs = warp.system().forces[0]
    rest = np.asarray(net.flatten(springs.rest_length))[weights > 0]
    stretched = np.asarray(net.flatten(net.difference(start.position).map(lambda d: jnp.sqrt(d.dot(d)))))[weights > 0]
    assert np.all(rest < stretched)
    assert rest.max() > 0.85 * 2.0 * (SIDE - 1) / 32


def test_any_springs_under_tension_fold_nothing(rng):
    """Tutte: stiffnesses over four decades at random, and the certificate holds."""
    mesh = SMALL.mesh
    factors = mesh.net.split(jnp.asarray(10 ** rng.uniform(-2, 2, mesh.net.n_springs)))
    weights, still = mesh.stiffness.map(lambda k, f: k * f, factors), js.Vector((0 * mesh.x, 0 * mesh.x))
    moved, info = mesh.balance(weights, still, js.JaxCG(tolerance=1e-12))
    assert bool(info.status.is_ok)
    x, y = mesh.x + moved.x, mesh.y + moved.y
    zeros = jnp.zeros_like(x)
    warp = js.lens.Warp(SMALL.shape, SMALL.sampling, mesh, js.Vector((x, y)), mesh.stiffness, zeros, zeros, (zeros,), js.Status.ok())
    assert bool(warp.certificate().is_one_to_one)
    assert float(moved.largest()) > 2.0


def test_anisotropy_is_that_of_the_singular_values():
    """Against NumPy's singular values of every triangle's map; and near the radial ideal's, which no lens of springs can know."""
    warp = disc(0.3, 2.0)
    x, y = (np.asarray(a) for a in warp.position)
    h = (SIDE - 1) / 32
    # The upper triangle of cell (8, 8) is cut nw-se: nw, ne, se.
    first = np.array([[x[8, 9] - x[8, 8], x[9, 9] - x[8, 9]], [y[8, 9] - y[8, 8], y[9, 9] - y[8, 9]]]) / h
    largest, least = np.linalg.svd(first, compute_uv=False)
    assert float(warp.anisotropy[0, 8, 8]) == pytest.approx(largest / least, rel=1e-9)
    assert [ideal_anisotropy(m, 0.3) for m in (1.5, 2.0, 3.0)] == pytest.approx([2.57, 5.69, 43.1], rel=2e-3)
    assert float(jnp.max(warp.anisotropy)) < 3 * ideal_anisotropy(2.0, 0.3)
    assert ideal_anisotropy(3.0, 0.5) == np.inf


def mixed_loss(parameters):
    """Through the warped image, both maps and the nodes, by a disc and an importance image."""
    focus = js.lens.Disc(parameters["centre"], parameters["radius"], parameters["magnification"], rim=6.0)
    painted = js.lens.Importance(js.Image(parameters["importance"]), parameters["most"])
    warp = SMALL.warp((focus, painted))
    x, _ = warp.forward(jnp.linspace(5.0, 50.0, 7), jnp.linspace(40.0, 6.0, 7))
    weights = jnp.sin(jnp.arange(48.0) / 7)[:, None] * jnp.cos(jnp.arange(60.0) / 9)[None, :]
    return jnp.sum(weights * warp.apply(jnp.asarray(SMOOTH))) + 0.1 * jnp.sum(x * jnp.arange(7.0)) + 1e-3 * jnp.sum(warp.position.y**2)


def test_gradients_are_those_of_differences(rng):
    """By centre, radius, both magnifications and the importance image, to 1e-5 of central differences."""
    at = {
        "centre": jnp.array([27.3, 22.1]),
        "radius": jnp.asarray(12.2),
        "magnification": jnp.asarray(1.7),
        "importance": jnp.asarray(scipy.ndimage.gaussian_filter(rng.uniform(size=SMALL.shape), 3)),
        "most": jnp.asarray(1.3),
    }
    both = jax.jit(jax.value_and_grad(mixed_loss))
    slope = both(at)[1]
    for name, value in at.items():
        along = jnp.asarray(rng.normal(size=value.shape))
        h = 2e-6
        there, here = (float(both({**at, name: value + sign * h * along})[0]) for sign in (1, -1))
        assert (there - here) / (2 * h) == pytest.approx(float(jnp.sum(slope[name] * along)), rel=1e-5), name


def test_a_layer_batches_and_undoes():
    """A batch of images and lenses is the loop over them; undone, a smooth image comes back; without magnification nothing moves."""
    images = jnp.asarray(np.stack([SMOOTH, SMOOTH[::-1]]))
    centres = jnp.array([[25.0, 20.0], [33.0, 27.0]])

    def layer(image, centre, magnification):
        warp = SMALL.warp(js.lens.Disc(centre, 12.0, magnification))
        return warp.apply(image), warp.undo(warp.apply(image))

    shown, undone = jax.jit(jax.vmap(layer))(images, centres, jnp.array([1.8, 1.0]))
    one = jax.jit(layer)
    for i, m in enumerate((1.8, 1.0)):
        alone = one(images[i], centres[i], jnp.asarray(m))
        np.testing.assert_allclose(shown[i], alone[0], atol=1e-9)
    scale = float(jnp.max(jnp.abs(images)))
    assert float(jnp.max(jnp.abs(shown[0] - images[0]))) > 0.2 * scale
    # What is lost is lost where the context is squeezed, and read between its pixels twice.
    assert float(jnp.max(jnp.abs(undone - images))) < 0.05 * scale
    np.testing.assert_allclose(shown[1], images[1], atol=1e-9)


def test_a_stack_and_an_image_are_warped_alike():
    """`js.Image`, one array and a stack of them share one warp."""
    warp = disc(0.3, 1.5)
    x, y = pixels()
    stack = jnp.stack([x, y])
    shown = warp.apply(stack)
    np.testing.assert_array_equal(warp.apply(js.Image(y)).values, shown[1])
    np.testing.assert_array_equal(warp.apply(x), shown[0])
    with pytest.raises(ValueError, match="65"):
        warp.apply(x[:5])


@pytest.mark.slow
def test_eshelby():
    """Rest lengths m times longer in a small disc of an isotropic sheet: two thirds of it are delivered, and R^2 / r of that around."""
    sheet = js.lens.Lens((401, 401), nodes=41)
    warp = js.lens.by_rest_lengths(sheet, js.lens.Disc((200.0, 200.0), 40.0, 1.02, rim=0.1))
    assert bool(warp.status.is_ok)
    strain = float(warp.delivered[0]) - 1
    assert strain == pytest.approx(2 / 3 * 0.02, rel=0.05)
    x = np.asarray(warp.position.x)[20] - np.asarray(sheet.mesh.x)[20]
    # At 8 and 10 cells, with the mirror images of a border at 20 cells.
    for cells in (6, 8):
        assert x[20 + cells] == pytest.approx(strain * 40.0**2 / (10 * cells), rel=0.2)
    held = js.lens.by_rest_lengths(sheet, js.lens.Disc((200.0, 200.0), 60.0, 2.0, rim=40.0), tension=1.0, n_steps=3)
    assert int(held.certificate().n_folds) == 0
    assert float(held.delivered[0]) > 1.8
