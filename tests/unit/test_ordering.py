"""Orders of elimination, the envelope that they leave, and how it is stored."""

import numpy as np
import pytest

import jaxspring as js
from jaxspring.linalg.envelope import Envelope
from jaxspring.linalg.ordering import Given, Natural, Ordering, ReverseCuthillMcKee, first_places, smallest_profile
from jaxspring.linalg.skyline import Skyline

FAMILIES = {"structural": js.STRUCTURAL, "shear": js.STRUCTURAL + js.SHEAR, "bend": js.STRUCTURAL + js.SHEAR + js.BEND}
# Counted by hand: a row of the lower triangle reaches back n, n + 1 or 2n places, less at the rims.
COUNTS = {
    "structural": lambda n: n**3 + n - 1,
    "shear": lambda n: n**3 + n**2 - n,
    "bend": lambda n: 2 * n**3 - 2 * n**2 + 3 * n - 4,
}
BANDWIDTH = {"structural": lambda n: n, "shear": lambda n: n + 1, "bend": lambda n: 2 * n}


def random_graph(rng, n_nodes=40, n_springs=70):
    """Springs between random pairs, some repeated; some nodes may have none."""
    pairs = rng.integers(0, n_nodes, (n_springs, 2))
    return js.Graph.from_edges(pairs[pairs[:, 0] != pairs[:, 1]], n_nodes)


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("n", [3, 4, 10, 64])
def test_lattice_counts_are_exact(name, n):
    """Row by row, an n x n lattice keeps n^3 + n - 1, n^3 + n^2 - n or 2n^3 - 2n^2 + 3n - 4 entries."""
    profile = Skyline(js.lattice((n, n), FAMILIES[name]), order=Natural()).profile()
    assert profile.entries == COUNTS[name](n)
    assert profile.bandwidth == BANDWIDTH[name](n)


@pytest.mark.parametrize("ordering", [Natural(), ReverseCuthillMcKee()])
@pytest.mark.parametrize("coupled", [1, 3])
def test_profile_is_that_of_the_dense_matrix(rng, ordering, coupled):
    """Entries, bandwidth and work are those counted on a dense array, d x d blocks for coupled coordinates."""
    net = random_graph(rng)
    order = ordering.places(net.edges, net.n_nodes)
    place = np.argsort(order)
    nonzero = np.eye(net.n_nodes, dtype=bool)
    for tail, head in place[net.edges]:
        nonzero[tail, head] = nonzero[head, tail] = True
    nonzero = np.kron(nonzero, np.ones((coupled, coupled), bool))
    heights = np.array([j - np.flatnonzero(nonzero[: j + 1, j])[0] for j in range(len(nonzero))])
    profile = Skyline(net, order=ordering).profile(coupled)
    assert profile.entries == np.sum(heights + 1)
    assert profile.bandwidth == heights.max()
    assert profile.factor_work == np.sum(heights**2) // 2
    assert profile.solve_work == 2 * np.sum(heights)


def test_elimination_stays_within_the_envelope(rng):
    """The dense Cholesky factor of a random matrix of the net is zero before the first place of every row."""
    net = random_graph(rng)
    ordering, order, first = smallest_profile(net.edges, net.n_nodes, (Natural(), ReverseCuthillMcKee()))
    place = np.argsort(order)
    dense = np.zeros((net.n_nodes,) * 2)
    for tail, head in place[net.edges]:
        dense[tail, head] = dense[head, tail] = -rng.random()
    factor = np.linalg.cholesky(dense + np.diag(1 - dense.sum(axis=1)))
    reached = [np.flatnonzero(row)[0] for row in factor]
    assert np.all(np.array(reached) >= first)
    assert isinstance(ordering, Ordering)


@pytest.mark.parametrize(("name", "chosen"), [("structural", ReverseCuthillMcKee()), ("shear", Natural()), ("bend", ReverseCuthillMcKee())])
def test_the_smaller_profile_is_taken(name, chosen):
    """Without an order, natural or reverse Cuthill-McKee is taken, whichever keeps less: neither always does."""
    net = js.lattice((24, 24), FAMILIES[name])
    sizes = {ordering: Skyline(net, order=ordering).profile().entries for ordering in (Natural(), ReverseCuthillMcKee())}
    skyline = Skyline(net)
    assert skyline.ordering == chosen == min(sizes, key=sizes.get)
    assert skyline.profile().entries == min(sizes.values())


def test_natural_is_the_numbering_of_the_user(rng):
    """On a graph, whose nodes are renumbered inside, the natural order is the user's: a chain keeps 2 N - 1 entries."""
    n = 30
    net = js.Graph.from_edges(np.stack([np.arange(n - 1), np.arange(1, n)], axis=-1)[rng.permutation(n - 1)], n)
    assert Skyline(net, order=Natural()).profile().entries == 2 * n - 1
    assert Skyline(net, order=rng.permutation(n)).profile().entries > 2 * n - 1


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (np.arange(3), r"order has shape \(3,\)"),
        (np.arange(4.0), "float64"),
        (np.array([0, 1, 2, 7]), r"order\[3\] = 7, but nodes are 0 to 3"),
        (np.array([0, 1, 1, 2]), "names node 1 2 times and node 3 not at all"),
    ],
)
def test_an_order_that_is_no_permutation_is_refused(order, message):
    """A missing, doubled or foreign node would lose an equation: ValueError names it."""
    with pytest.raises(ValueError, match=message):
        Skyline(js.lattice(4), order=order)


@pytest.mark.parametrize("block", [1, 5, 16, 1000, None])
@pytest.mark.parametrize("coupled", [1, 2, 3])
def test_storage_is_the_profile_and_the_padding_of_panels(rng, block, coupled):
    """Each entry of the envelope has one place; what is stored beyond is at most B per row beyond the longest row of each panel."""
    net = random_graph(rng)
    _, order, first = smallest_profile(net.edges, net.n_nodes, (ReverseCuthillMcKee(),))
    envelope = Envelope(order, first, block)
    panels, profile = envelope.panels(coupled), envelope.profile(coupled)
    begins = np.repeat(coupled * first, coupled)
    rows = np.concatenate([np.full(i - b + 1, i) for i, b in enumerate(begins)])
    columns = np.concatenate([np.arange(b, i + 1) for i, b in enumerate(begins)])
    places = panels.address(rows, columns)
    assert len(rows) == profile.entries == len(np.unique(places))
    assert places.min() >= 0
    assert places.max() < profile.stored == panels.size * panels.total
    longest = [begins[s : s + panels.size].min() for s in range(0, panels.n, panels.size)]
    kept = sum(panels.size * (panels.size * (i + 1) - min(b, panels.size * i)) for i, b in enumerate(longest))
    assert profile.stored == kept + panels.size * panels.width


def test_storage_of_a_large_lattice_is_near_the_profile():
    """At 64 per side with bend springs and three coupled coordinates, padding adds less than a quarter."""
    profile = Skyline(js.lattice((64, 64), FAMILIES["bend"])).profile(3)
    assert profile.entries < profile.stored < 1.25 * profile.entries


@pytest.mark.parametrize("coupled", [1, 3])
def test_kernels_are_wide_enough_and_few(coupled):
    """Every panel takes the smallest compiled kernel that holds its rows; there are at most four sizes."""
    panels = Skyline(js.lattice((40, 40), FAMILIES["structural"])).envelope.panels(coupled)
    widths = np.array(panels.widths)
    assert len(widths) <= 4
    assert widths[-1] == panels.width
    assert np.all(widths[panels.kinds] >= panels.active)
    smaller = np.where(panels.kinds > 0, widths[panels.kinds - 1], 0)
    assert np.all(panels.active > smaller - (panels.kinds == 0))


def test_analyses_compare_by_content():
    """Equal nets give equal, equally hashed analyses, so that a jitted function is not compiled anew; other orders differ."""
    net, same = (js.lattice((5, 4), js.STRUCTURAL) for _ in range(2))
    assert Skyline(net) == Skyline(same)
    assert hash(Skyline(net).envelope) == hash(Skyline(same).envelope)
    assert Skyline(net, order=Natural()) != Skyline(net, order=np.arange(20)[::-1])
    assert Skyline(net, order=np.arange(20)) == Skyline(net, order=Given(list(range(20))))
    assert Skyline(net) != Skyline(net, block=3)
    assert Envelope(np.arange(3), np.array([0, 0, 1]), None) != Envelope(np.arange(3), np.array([0, 1, 1]), None)
    places = first_places(np.zeros((0, 2), int), np.arange(3))
    assert places.tolist() == [0, 1, 2]
