"""Preconditioners: positive definite, exact where they claim to be, and multigrid independent of the mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse

import jaxspring as js
from jaxspring.linalg.aggregation import Springs, coarser
from jaxspring.linalg.cg import CG
from jaxspring.linalg.multigrid import Multigrid
from jaxspring.linalg.multigrid_graph import GraphHierarchy
from jaxspring.linalg.multigrid_lattice import Axes, LatticeHierarchy, LatticeSprings, prolong, restrict
from jaxspring.linalg.operators import Blocks, NodeDyads, SpringMatrix
from jaxspring.linalg.preconditioners import BlockFactors, BlockJacobi, Jacobi, Unpreconditioned
from tests.step_matrices import Step, flat, near_grid, random_vector, spring_blocks, stiff_step

FAMILIES = js.STRUCTURAL + js.SHEAR + js.BEND
POINTS = np.random.default_rng(4).random((200, 2)) * 14


@eqx.filter_jit
def solve(solver, matrix, b):
    """Compiled, as a step calls it."""
    return solver.solve_in_step(matrix, b, None, None)[:2]


@eqx.filter_jit
def as_dense(preconditioner, matrix):
    """(N D, N D) array of the map, rows and columns by node and then by coordinate."""
    n, dim, layout = int(np.prod(matrix.like.shape)), matrix.dim, matrix.layout
    apply = preconditioner.build(matrix)

    def column(points):
        z = apply(js.Vector(tuple(layout.unflatten(points[:, i]) for i in range(dim))))
        return jnp.stack([layout.flatten(a) for a in z], axis=-1).ravel()

    return jax.lax.map(column, jnp.eye(n * dim, dtype=matrix.like.dtype).reshape(n * dim, n, dim)).T


@eqx.filter_jit
def applied(preconditioner, matrix, r):
    """The map, of one vector."""
    return preconditioner.build(matrix)(r)


to_dense = eqx.filter_jit(SpringMatrix.to_dense)
factors_of = eqx.filter_jit(BlockFactors.of)


def lattice_case(rng, shape=(12, 13), **options):
    """A lattice and a stiff matrix on it."""
    net = js.lattice(shape, FAMILIES if len(shape) > 1 else js.STRUCTURAL + js.BEND)
    return net, stiff_step(net, near_grid(net, rng, options.pop("dim", 3)), rng, **options)


def graph_case(rng, **options):
    """A Delaunay graph and a stiff matrix on it."""
    net = js.delaunay(POINTS)
    return net, stiff_step(net, np.c_[POINTS, 0.1 * rng.standard_normal(len(POINTS))], rng, **options)


def squeezed(net, step):
    """The same matrix with weights so negative that it is indefinite."""
    springs = step.matrix.blocks.springs[0]
    pushing = eqx.tree_at(lambda s: s.weight, springs, springs.weight - 2.0 * springs.slope)
    matrix = eqx.tree_at(lambda m: m.blocks.springs, step.matrix, (pushing,))
    return Step(matrix, scipy.sparse.csr_array(np.asarray(to_dense(matrix))))


cases = pytest.mark.parametrize("case", [lattice_case, graph_case], ids=["lattice", "graph"])


@pytest.mark.slow
@cases
@pytest.mark.parametrize("is_definite", [True, False], ids=["definite", "squeezed"])
def test_every_map_is_symmetric_and_positive_definite(rng, case, is_definite):
    """Also for an indefinite matrix, with held coordinates: those are left alone, and coupled with nothing."""
    net, step = case(rng, dt_over_limit=10.0)
    step = step if is_definite else squeezed(net, step)
    free = rng.random(net.n_nodes) > 0.2
    step = step.holding(net, free, None, free)
    held = np.stack([~free, np.zeros_like(free), ~free], axis=-1).ravel()
    assert (np.linalg.eigvalsh(step.dense)[0] > 0) == is_definite
    for preconditioner in (Unpreconditioned(), Jacobi(), BlockJacobi(), Multigrid(net, 1), Multigrid(net)):
        m = np.asarray(as_dense(preconditioner, step.matrix))
        np.testing.assert_allclose(m, m.T, atol=2e-6 * np.abs(m).max())
        assert np.linalg.eigvalsh(m + m.T)[0] > 0
        np.testing.assert_array_equal(m[held], np.eye(len(m))[held])


def test_jacobi_divides_by_the_diagonal_and_blocks_solve_with_them(rng):
    """Against numpy.linalg.inv of each node's block, one coordinate of one node held."""
    net, step = lattice_case(rng, (3, 4))
    mask = np.ones(12, bool)
    mask[5] = False
    step = step.holding(net, mask, None, None)
    b = random_vector(net, rng)
    np.testing.assert_allclose(flat(net, applied(Jacobi(), step.matrix, b)), flat(net, b) / np.diag(step.dense), rtol=1e-13)
    blocks = [step.dense[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(12)]
    expected = np.concatenate([np.linalg.solve(block, r) for block, r in zip(blocks, flat(net, b).reshape(12, 3), strict=True)])
    np.testing.assert_allclose(flat(net, applied(BlockJacobi(), step.matrix, b)), expected, rtol=1e-12)
    assert Unpreconditioned().build(step.matrix)(b) is b


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e13])
def test_block_factors_are_numpys_inverse_without_overflow(rng, dtype, dim, size):
    """For blocks of any size, also where a determinant would overflow in float32."""
    root = rng.standard_normal((7, dim, dim)) + 2 * np.eye(dim)
    blocks = (size * root @ root.transpose(0, 2, 1)).astype(dtype)
    r = rng.standard_normal((7, dim)).astype(dtype)
    rows = tuple(js.Vector(tuple(jnp.asarray(blocks[:, i, j]) for j in range(dim))) for i in range(dim))
    x = eqx.filter_jit(BlockFactors.solve)(factors_of(rows), js.Vector(tuple(jnp.asarray(r[:, i]) for i in range(dim))))
    expected = np.linalg.solve(blocks.astype(float), r.astype(float)[:, :, None])[:, :, 0]
    scale = np.abs(expected).max()
    np.testing.assert_allclose(np.stack(list(x), -1) / scale, expected / scale, rtol=0, atol=1e-3 if dtype == np.float32 else 1e-11)


def test_singular_and_negative_blocks_get_finite_positive_pivots():
    """A flat sheet has no stiffness across, a mechanism no diagonal, a squeezed net a negative one."""
    blocks = [np.diag([2.0, 3.0, 0.0]), np.zeros((3, 3)), np.diag([-1.0, 2.0, 3.0]), np.ones((3, 3))]
    entries = np.stack(blocks)
    rows = tuple(js.Vector(tuple(jnp.asarray(entries[:, i, j]) for j in range(3))) for i in range(3))
    factors = factors_of(rows)
    assert all(np.isfinite(p).all() and (np.asarray(p) > 0).all() for p in factors.inverse_pivots)


@pytest.mark.parametrize(
    ("shape", "periodic"),
    [
        ((9,), False),
        ((10,), True),
        ((7, 8), False),
        ((8, 6), True),
        ((8, 7), (True, False)),
        ((2, 9), False),
        ((1, 6), False),
        ((4, 5, 6), False),
    ],
)
def test_interpolation_is_linear_and_restriction_its_transpose(rng, shape, periodic):
    """A linear field is kept where nothing wraps, a constant everywhere; <P v, r> = <v, P' r>."""
    wraps = periodic if isinstance(periodic, tuple) else (bool(periodic),) * len(shape)
    axes = Axes(shape, wraps)
    below = axes.coarser()
    up, down = jax.jit(lambda v: prolong(v, axes)), jax.jit(lambda r: restrict(r, axes))
    np.testing.assert_allclose(up(np.ones(below.shape)), np.ones(shape))
    for axis, wrap in enumerate(wraps):
        if not wrap and shape[axis] > 1:
            line = 2.0 * np.indices(below.shape)[axis]
            np.testing.assert_allclose(up(line), np.indices(shape)[axis])
    v, r = rng.standard_normal(below.shape), rng.standard_normal(shape)
    assert np.vdot(up(v), r) == pytest.approx(np.vdot(v, down(r)), rel=1e-12)


@pytest.mark.parametrize(
    ("shape", "periodic"), [((9,), False), ((10, 7), False), ((8, 6), True), ((2, 9), False), ((8, 7), (True, False)), ((4, 5, 6), False)]
)
def test_a_linear_displacement_has_the_same_energy_on_the_coarser_lattice(rng, shape, periodic):
    """With random blocks, all families, whatever the shape: the differences along a spring are its offset times the gradient."""
    wraps = periodic if isinstance(periodic, tuple) else (bool(periodic),) * len(shape)
    axes = Axes(shape, wraps)
    families = FAMILIES + js.BODY if len(shape) == 3 else FAMILIES if len(shape) == 2 else js.STRUCTURAL + js.BEND
    offsets = [o for o in families.offsets(len(shape)) if all(abs(k) < n for k, n in zip(o, shape, strict=True))]
    blocks = []
    for offset in offsets:
        cells = [n if w else n - abs(o) for n, o, w in zip(shape, offset, wraps, strict=True)]
        root = rng.standard_normal((2, 2, *cells))
        blocks.append(jnp.asarray(root + root.swapaxes(0, 1)))
    fine = LatticeSprings(axes, tuple(offsets), tuple(blocks), jnp.zeros((2, 2, *shape)))
    coarse = eqx.filter_jit(lambda springs: springs.coarser(axes.coarser()))(fine)
    gradient = rng.standard_normal((2, len(shape)))

    def energy(springs, spacing):
        jumps = [spacing * gradient @ np.array(offset) for offset in springs.offsets]
        return sum(jump @ np.asarray(b).reshape(2, 2, -1).sum(axis=-1) @ jump for jump, b in zip(jumps, springs.families, strict=True))

    assert energy(coarse, 2.0) == pytest.approx(energy(fine, 1.0), rel=1e-12)


def test_springs_between_groups_are_those_of_the_triple_product(rng):
    """P' D' B D P, one number per spring, against the matrices multiplied by SciPy; P spreads a constant."""
    net = js.delaunay(POINTS)
    springs = Springs(*net.edges.T, net.n_nodes)
    found = coarser(springs)
    assert found.springs.n < net.n_nodes / 4
    np.testing.assert_allclose(found.spread.sum(axis=1), 1.0)
    weight = rng.random(net.n_springs)

    def laplacian(s, w):
        n_springs = len(s.tails)
        number = np.arange(n_springs)
        d = scipy.sparse.csr_array(
            (np.repeat([-1.0, 1.0], n_springs), (np.tile(number, 2), np.r_[s.tails, s.heads])), shape=(n_springs, s.n)
        )
        return d.T @ (w[:, None] * d)

    expected = found.spread.T.toarray() @ laplacian(springs, weight) @ found.spread.toarray()
    np.testing.assert_allclose(laplacian(found.springs, found.combination @ weight).toarray(), expected, atol=1e-12)


@pytest.mark.slow
@cases
def test_the_finest_level_multiplies_like_the_matrix(rng, case):
    """Also with held nodes and node dyads."""
    net, step = case(rng)
    free = rng.random(net.n_nodes) > 0.2
    matrix = step.holding(net, free, free, free).matrix
    dyad = NodeDyads(jnp.ones(net.node_shape), matrix.like)
    matrix = SpringMatrix(matrix.blocks + Blocks(dyads=(dyad,)), matrix.free, matrix.like, matrix.layout)
    hierarchy = Multigrid(net).hierarchy

    @eqx.filter_jit
    def products(matrix, v):
        levels, _ = hierarchy.build(matrix, jnp.float64)
        v = matrix.pick(v, js.Vector.zeros_like(matrix.like))
        return hierarchy.leave(levels[0].product(hierarchy.enter(v)), v), matrix(v)

    got, expected = products(matrix, random_vector(net, rng))
    np.testing.assert_allclose(flat(net, got), flat(net, expected), atol=1e-5 * np.abs(flat(net, expected)).max())


def test_springs_of_another_net_add_to_the_nodes_alone(rng):
    """A net that wraps is another one: its springs appear in the blocks of their ends, and nowhere else."""
    net, step = lattice_case(rng)
    wrapping = js.lattice((12, 13), periodic=True, box=(13.0, 12.0, 0.0))
    more, _ = spring_blocks(wrapping, np.zeros((156, 3)), np.ones(wrapping.n_springs))
    matrix = SpringMatrix(Blocks(springs=(more,)), (None,) * 3, step.matrix.like, net.layout)
    (level,) = eqx.filter_jit(lambda matrix: Multigrid(net).hierarchy.build(matrix, jnp.float64)[0])(matrix)
    np.testing.assert_array_equal(level.centre[0, 0], np.full((12, 13), 4.0))
    assert level.families == ()


ODD = [
    ("chain", lambda: js.lattice(300, js.STRUCTURAL + js.BEND), 2, 20),
    ("thin", lambda: js.lattice((2, 150), js.STRUCTURAL + js.SHEAR), 3, 20),
    ("block", lambda: js.lattice((8, 7, 9), js.STRUCTURAL + js.BODY), 3, 15),
    ("wrapped", lambda: js.lattice((24, 20), js.STRUCTURAL + js.SHEAR, periodic=True, box=(20.0, 24.0, 0.0)), 3, 15),
    ("wrapped, odd", lambda: js.lattice((15, 15), FAMILIES, periodic=(True, False), box=(0.0, 15.0, 0.0)), 3, 20),
    ("small", lambda: js.lattice((3, 3)), 3, 10),
    ("one node", lambda: js.lattice((1, 1)), 3, 10),
    ("star", lambda: js.Graph.from_edges([(0, i) for i in range(1, 1000)], 1000), 3, 10),
    ("pairs", lambda: js.Graph.from_edges(np.arange(600).reshape(-1, 2), 600), 3, 15),
    ("no spring", lambda: js.Graph.from_edges(np.zeros((0, 2), int), 300), 3, 10),
    ("loose nodes", lambda: js.Graph.from_edges([(i, i + 1) for i in range(200)], 400), 3, 80),
]


@pytest.mark.slow
@pytest.mark.parametrize(("make", "dim", "most"), [case[1:] for case in ODD], ids=[case[0] for case in ODD])
def test_multigrid_on_nets_of_every_kind(rng, make, dim, most):
    """Chains, blocks, nets that wrap, hubs, loose nodes: solved, in few iterations."""
    net = make()
    points = near_grid(net, rng, dim) if isinstance(net, js.Lattice) else rng.standard_normal((net.n_nodes, dim))
    step, b = stiff_step(net, points, rng), random_vector(net, rng, dim)
    x, info = solve(CG(preconditioner=Multigrid(net)), step.matrix, b)
    assert bool(info.status.is_ok)
    assert int(info.iterations) <= most
    assert np.linalg.norm(step.sparse @ flat(net, x) - flat(net, b)) < 1e-7 * np.linalg.norm(flat(net, b))


def cloth_iterations(n, rng):
    """Iterations of CG with multigrid on an n x n cloth."""
    net = js.lattice((n, n), FAMILIES)
    corners = np.ones(n * n, bool)
    corners[[0, n - 1]] = False
    step = stiff_step(net, near_grid(net, rng, noise=0.02), rng).holding(net, corners, corners, corners)
    _, info = solve(CG(tolerance=1e-6, preconditioner=Multigrid(net)), step.matrix, random_vector(net, rng))
    assert bool(info.status.is_ok)
    return int(info.iterations)


def graph_iterations(n, rng):
    """Iterations of CG with multigrid on a Delaunay graph of n nodes."""
    points = rng.random((n, 2)) * np.sqrt(n)
    net = js.delaunay(points)
    step = stiff_step(net, np.c_[points, 0.1 * rng.standard_normal(n)], rng)
    _, info = solve(CG(tolerance=1e-6, preconditioner=Multigrid(net)), step.matrix, random_vector(net, rng))
    assert bool(info.status.is_ok)
    return int(info.iterations)


@pytest.mark.slow
@pytest.mark.parametrize(("iterations", "sizes"), [(cloth_iterations, (16, 64)), (graph_iterations, (1000, 8000))], ids=["cloth", "graph"])
def test_iterations_do_not_grow_with_the_mesh(rng, iterations, sizes):
    """At most 1.5 times as many on the larger mesh (block-Jacobi: about three times); the order in which groups are found makes one more or
    less.
    """
    few, many = (iterations(n, rng) for n in sizes)
    assert many <= 1.5 * few
    assert many < 40


@pytest.mark.slow
@cases
def test_multigrid_under_vmap_and_in_float32(rng, case):
    """A batch of matrices equals the loop; float32 reaches its own tolerance."""
    net, step = case(rng)
    solver, b = CG(preconditioner=Multigrid(net)), random_vector(net, rng)
    factors = jnp.asarray([1.0, 3.0])

    def solution(matrix, factor):
        scaled = eqx.tree_at(lambda m: m.blocks, matrix, matrix.blocks.scaled(factor))
        return solver.solve_in_step(scaled, b, None, None)[0]

    x = eqx.filter_jit(eqx.filter_vmap(solution, in_axes=(None, 0)))(step.matrix, factors)
    single = eqx.filter_jit(solution)
    for lane, factor in enumerate(factors):
        alone = single(step.matrix, factor)
        np.testing.assert_allclose(x.x[lane], alone.x, atol=1e-6 * np.abs(alone.x).max())
    net, step = case(rng, dtype=np.float32)
    _, info = solve(CG(preconditioner=Multigrid(net)), step.matrix, random_vector(net, rng, dtype=np.float32))
    assert bool(info.status.is_ok)
    assert info.residual.dtype == jnp.float32


def test_multigrid_says_what_it_cannot_take(rng):
    """No sweep, a matrix of another net, a graph that is traced: an error that says what to do."""
    net = js.lattice((4, 5))
    with pytest.raises(ValueError, match="n_sweeps = 0"):
        Multigrid(net, 0)
    _, step = lattice_case(rng, (3, 4))
    with pytest.raises(ValueError, match=r"\(3, 4\), but Multigrid was made for \(4, 5\)"):
        Multigrid(net).build(step.matrix)
    with pytest.raises(TypeError, match="outside jit"):
        eqx.filter_jit(Multigrid)(js.delaunay(POINTS))
    assert isinstance(eqx.filter_jit(Multigrid)(net).hierarchy, LatticeHierarchy)
    assert isinstance(Multigrid(js.delaunay(POINTS)).hierarchy, GraphHierarchy)
