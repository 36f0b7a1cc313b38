"""The direct solver against NumPy, SciPy's banded solver and SuperLU; its failures, its memory and its shapes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse.linalg

import jaxspring as js
from jaxspring.linalg.assembly import alike_coordinates
from jaxspring.linalg.operators import Blocks, NodeDyads, SpringMatrix
from jaxspring.linalg.ordering import Natural, ReverseCuthillMcKee
from jaxspring.linalg.skyline import Skyline
from jaxspring.status import Flag
from tests.step_matrices import flat, in_numpy, near_grid, random_vector, spring_blocks, stiff_step

FAMILIES = js.STRUCTURAL + js.SHEAR + js.BEND


@pytest.fixture
def sheet(rng):
    """A lattice of 6 x 7, a stiff matrix of three coupled coordinates on it, and a right-hand side."""
    net = js.lattice((6, 7), FAMILIES)
    return net, stiff_step(net, near_grid(net, rng), rng), random_vector(net, rng)


@eqx.filter_jit
def solve(skyline, matrix, b, memory=None):
    """Compiled, as a step calls it, once for all tests of one shape."""
    return skyline.solve_in_step(matrix, b, None, memory)


def error(net, x, expected):
    """Distance from the expected flat solution, over its length."""
    return np.linalg.norm(flat(net, x) - expected) / np.linalg.norm(expected)


def residual(net, sparse, x, b):
    """|b - A x| / |b| in NumPy."""
    return np.linalg.norm(flat(net, b) - sparse @ flat(net, x)) / np.linalg.norm(flat(net, b))


both_kinds = pytest.mark.parametrize("scalar", [False, True], ids=["blocks", "scalar"])


@both_kinds
@pytest.mark.parametrize("shape", [(2, 2), (6, 7), pytest.param((64, 64), marks=pytest.mark.slow)])
def test_residual_on_lattices(rng, shape, scalar):
    """A step 100 times the explicit limit, structural + shear + bend: residual below 1e-12 up to 64 per side, and it is told truly."""
    net = js.lattice(shape, FAMILIES)
    step, b = stiff_step(net, near_grid(net, rng), rng, scalar=scalar), random_vector(net, rng)
    x, info, _ = solve(Skyline(net), step.matrix, b)
    true = residual(net, step.sparse, x, b)
    assert true < 1e-12
    assert true / 3 < float(info.residual) < 3 * true
    assert bool(info.status.is_ok)


@pytest.mark.slow
def test_residual_on_a_delaunay_graph(rng):
    """On 5,000 random points joined by Delaunay's triangulation, the residual is below 1e-12, and the solution is SuperLU's."""
    points = np.c_[rng.random((5000, 2)) * 70, 0.1 * rng.standard_normal(5000)]
    net = js.delaunay(points[:, :2])
    step, b = stiff_step(net, points, rng), random_vector(net, rng)
    x, info, _ = solve(Skyline(net), step.matrix, b)
    assert residual(net, step.sparse, x, b) < 1e-12
    assert bool(info.status.is_ok)
    assert error(net, x, scipy.sparse.linalg.splu(step.sparse.tocsc()).solve(flat(net, b))) < 1e-10


@both_kinds
def test_agrees_with_scipys_banded_solver(rng, scalar):
    """The solution equals scipy.linalg.solveh_banded of the same matrix."""
    net = js.lattice((6, 7), FAMILIES)
    step, b = stiff_step(net, near_grid(net, rng), rng, scalar=scalar), random_vector(net, rng)
    lower = scipy.sparse.tril(step.sparse).tocoo()
    banded = np.zeros((int((lower.row - lower.col).max()) + 1, lower.shape[0]))
    banded[lower.row - lower.col, lower.col] = lower.data
    x, _, _ = solve(Skyline(net), step.matrix, b)
    assert error(net, x, scipy.linalg.solveh_banded(banded, flat(net, b), lower=True)) < 1e-11


@pytest.mark.parametrize(("dim", "scalar"), [(1, False), (2, False), (3, False), (3, True)], ids=["1", "2", "3", "3 scalar"])
def test_agrees_with_numpy_in_every_dimension(rng, dim, scalar):
    """One, two and three coordinates, on a graph of several pieces and nodes without a spring: numpy.linalg.solve."""
    pairs = rng.integers(0, 14, (24, 2))
    pairs = np.concatenate([pairs[pairs[:, 0] != pairs[:, 1]], [[20, 21], [21, 22]]])
    net = js.Graph.from_edges(pairs, 25)
    step = stiff_step(net, rng.standard_normal((25, dim)), rng, scalar=scalar, dt_over_limit=3.0)
    b = random_vector(net, rng, dim)
    x, info, _ = solve(Skyline(net), step.matrix, b)
    assert error(net, x, np.linalg.solve(step.dense, flat(net, b))) < 1e-12
    assert bool(info.status.is_ok)


@pytest.mark.parametrize(
    ("net", "dim"),
    [
        (js.lattice(1), 1),
        (js.lattice(1), 3),
        (js.lattice(2), 2),
        (js.lattice(40, js.STRUCTURAL + js.BEND), 3),
        (js.lattice((3, 3, 4), js.STRUCTURAL + js.BODY), 3),
        (js.lattice((5, 6), js.STRUCTURAL, periodic=(False, True), box=[6.0, 0.0]), 2),
    ],
    ids=["point", "point in space", "pair", "chain", "block", "wrapped"],
)
def test_agrees_with_numpy_on_every_lattice(rng, net, dim):
    """A single node, two nodes, a chain, a lattice in space, and one that wraps: numpy.linalg.solve."""
    step, b = stiff_step(net, near_grid(net, rng, dim), rng, dt_over_limit=10.0), random_vector(net, rng, dim)
    x = Skyline(net).factor(step.matrix).solve(b)
    assert error(net, x, np.linalg.solve(step.dense, flat(net, b))) < 1e-11


@pytest.mark.parametrize(
    ("order", "block"), [(Natural(), 1), (ReverseCuthillMcKee(), 7), (np.random.default_rng(3).permutation(42), 500)], ids=["1", "7", "500"]
)
def test_order_and_panels_change_the_work_only(sheet, block, order):
    """Any order of elimination and any size of panel give the same solution."""
    net, step, b = sheet
    x = Skyline(net, order=order, block=block).factor(step.matrix).solve(b)
    assert error(net, x, np.linalg.solve(step.dense, flat(net, b))) < 1e-11


def test_factor_is_the_dense_cholesky_factor(sheet):
    """What is stored within the envelope is numpy.linalg.cholesky of the permuted dense matrix, entry for entry."""
    net, step, _ = sheet
    skyline = Skyline(net, order=ReverseCuthillMcKee(), block=7)
    order = skyline.envelope.order.order
    unknowns = (order[:, None] * 3 + np.arange(3)).ravel()
    dense = np.linalg.cholesky(step.dense[np.ix_(unknowns, unknowns)])
    rows, columns = np.nonzero(dense)
    stored = np.asarray(skyline.factor(step.matrix).panels[0][0]).ravel()
    np.testing.assert_allclose(stored[skyline.envelope.panels(3).address(rows, columns)], dense[rows, columns], rtol=1e-9, atol=1e-12)


def test_alike_coordinates_share_one_factor(rng):
    """Decoupled coordinates with the same masses and masks are served by one scalar factor; a mask of its own needs its own factor."""
    net = js.lattice((6, 5), FAMILIES)
    step, b = stiff_step(net, near_grid(net, rng), rng, scalar=True), random_vector(net, rng)
    held = rng.random(30) > 0.3
    cases = {"alike": (None,) * 3, "one mask": (held,) * 3, "z apart": (held, held, None), "all apart": (None, held, ~held)}
    for (name, masks), n_factors in zip(cases.items(), (1, 1, 2, 3), strict=True):
        case = step.holding(net, *masks)
        factor = Skyline(net).factor(case.matrix)
        assert [panels.shape[0] for panels in factor.panels] == [n_factors], name
        assert error(net, factor.solve(b), np.linalg.solve(case.dense, flat(net, b))) < 1e-11, name


def test_only_coupled_coordinates_are_factored_together(rng):
    """Springs in the plane couple x and y; z, which has scalar springs, gets a scalar factor; a dyad at every node couples all."""
    net = js.lattice((6, 5), FAMILIES)
    points, b = near_grid(net, rng), random_vector(net, rng)
    weight, slope, upright = 1 + rng.random(net.n_springs), rng.random(net.n_springs), rng.random(net.n_springs)
    mass, tilt = 0.1 + rng.random((30, 3)), rng.random(30)
    flat_blocks, _ = spring_blocks(net, points, weight, slope, (0, 1))
    upward, like = spring_blocks(net, points, upright, None, (2,))
    diagonal = js.Vector(tuple(net.node_field(mass[:, i]) for i in range(3)))
    matrix = SpringMatrix(Blocks((diagonal,), (), (flat_blocks, upward)), (None,) * 3, like, net.layout)
    assert alike_coordinates(matrix) == (((0, 1),), ((2,),))
    tilted = eqx.tree_at(lambda m: m.blocks.dyads, matrix, (NodeDyads(net.node_field(tilt), like),))
    assert alike_coordinates(tilted) == (((0, 1, 2),),)
    dense, node = np.zeros((30, 3, 30, 3)), np.arange(30)
    dense[:, :2, :, :2] = in_numpy(net, points[:, :2], weight, slope, np.zeros(30)).toarray().reshape(30, 2, 30, 2)
    dense[:, 2, :, 2] = in_numpy(net, points[:, :1], upright, 0 * upright, np.zeros(30)).toarray()
    dense[node, :, node, :] += mass[:, :, None] * np.eye(3)
    dense_tilted = dense.copy()
    dense_tilted[node, :, node, :] += tilt[:, None, None] * points[:, :, None] * points[:, None, :]
    for case, expected, n_kinds in ((matrix, dense, 2), (tilted, dense_tilted, 1)):
        factor = Skyline(net).factor(case)
        assert [panels.shape[0] for panels in factor.panels] == [1] * n_kinds
        assert error(net, factor.solve(b), np.linalg.solve(expected.reshape(90, 90), flat(net, b))) < 1e-11


def test_coordinates_with_the_same_springs_share(rng):
    """Scalar springs in x and y only: those two share a factor, and z, which has none, is diagonal."""
    net = js.lattice((4, 4), js.STRUCTURAL)
    points, weight, mass = near_grid(net, rng), rng.random(net.n_springs), 1 + rng.random(16)
    blocks, like = spring_blocks(net, points, weight, None, (0, 1))
    matrix = SpringMatrix(Blocks((js.Vector((net.node_field(mass),) * 3),), (), (blocks,)), (None,) * 3, like, net.layout)
    assert alike_coordinates(matrix) == (((0,), (1,)), ((2,),))
    x, b = Skyline(net).factor(matrix).solve(b := random_vector(net, rng)), b
    plane = in_numpy(net, points[:, :1], weight, 0 * weight, mass).toarray()
    for found, right_side in ((x.x, b.x), (x.y, b.y)):
        np.testing.assert_allclose(found.ravel(), np.linalg.solve(plane, right_side.ravel()), rtol=1e-11)
    np.testing.assert_allclose(x.z.ravel(), b.z.ravel() / mass, rtol=1e-14)


@both_kinds
def test_held_coordinates_pass_through_exactly(rng, scalar):
    """Where a coordinate is held the solution is b, bit for bit, and the others solve their own equations; on a graph."""
    net = js.delaunay(rng.random((30, 2)))
    step, b = stiff_step(net, rng.random((30, 3)), rng, scalar=scalar), random_vector(net, rng)
    masks = (rng.random(30) > 0.3, None, rng.random(30) > 0.3)
    held = step.holding(net, *masks)
    x, info, _ = solve(Skyline(net), held.matrix, b)
    is_held = np.stack([np.zeros(30, bool) if m is None else ~m for m in masks], axis=-1).ravel()
    np.testing.assert_array_equal(flat(net, x)[is_held], flat(net, b)[is_held])
    assert error(net, x, np.linalg.solve(held.dense, flat(net, b))) < 1e-11
    assert bool(info.status.is_ok)


def test_every_node_held(sheet):
    """The matrix is the identity: x is b, the status OK."""
    net, step, b = sheet
    x, info, _ = solve(Skyline(net), step.holding(net, *(np.zeros(42, bool),) * 3).matrix, b)
    np.testing.assert_array_equal(flat(net, x), flat(net, b))
    assert bool(info.status.is_ok)
    assert float(info.residual) == 0


def test_several_nets(rng):
    """Springs of two nets on the same nodes: the envelope has room for both, and a net that was not named is refused."""
    near, far = js.lattice((5, 6), js.STRUCTURAL), js.lattice((5, 6), js.BEND)
    points = near_grid(near, rng)
    first, second = (stiff_step(net, points, rng) for net in (near, far))
    matrix = SpringMatrix(first.matrix.blocks + second.matrix.blocks, first.matrix.free, first.matrix.like, near.layout)
    b = random_vector(near, rng)
    x = Skyline(near, far).factor(matrix).solve(b)
    assert error(near, x, np.linalg.solve(first.dense + second.dense, flat(near, b))) < 1e-11
    with pytest.raises(ValueError, match=r"not made for.*Skyline\(net, other_net\)"):
        Skyline(near).factor(matrix)


def first_bad_pivot(dense):
    """Row of the first pivot that is not positive, by elimination in NumPy."""
    rest = dense.copy()
    for j in range(len(rest)):
        if not rest[j, j] > 0:
            return j
        rest[j:, j:] -= np.outer(rest[j:, j], rest[j:, j]) / rest[j, j]
    return -1


@both_kinds
def test_a_pivot_that_is_not_positive_names_its_node(scalar):
    """An indefinite matrix gives NaN and the status PIVOT, with the node (the user's number) where NumPy's elimination fails first."""
    rng = np.random.default_rng(5)
    net = js.delaunay(rng.random((60, 2)))
    step = stiff_step(net, rng.random((60, 2)), rng, scalar=scalar, dt_over_limit=3.0)
    b = random_vector(net, rng, 2)
    skyline = Skyline(net, block=8)
    order = skyline.envelope.order.order
    unknowns = order if scalar else (order[:, None] * 2 + np.arange(2)).ravel()
    named = []
    for node in rng.permutation(60)[:6]:
        bad = step.plus(net, np.where(np.arange(60)[:, None] == node, -1e3, [0.0, 0.0]))
        dense = bad.dense[::2, ::2] if scalar else bad.dense
        expected = order[first_bad_pivot(dense[np.ix_(unknowns, unknowns)]) // (1 if scalar else 2)]
        x, info, _ = solve(skyline, bad.matrix, b)
        assert Flag(int(info.status.flags)) == Flag.PIVOT
        assert int(info.status.node) == expected
        assert np.all(np.isnan(flat(net, x)))
        named.append(expected)
        with pytest.raises(js.SimulationError, match=f"PIVOT.*node {expected}"):
            js.raise_for_status(info)
    assert len(set(named)) > 3


def test_the_second_of_two_factors_may_fail(rng):
    """Where each coordinate has its own factor, a bad pivot of any of them is told, with its node."""
    net = js.lattice((4, 5), js.STRUCTURAL)
    step = stiff_step(net, near_grid(net, rng), rng, scalar=True)
    bad = step.plus(net, np.where(np.arange(20)[:, None] == 7, [0.0, -1e3, 0.0], 0.0))
    status = Skyline(net, order=Natural()).factor(bad.matrix).status
    assert Flag(int(status.flags)) == Flag.PIVOT
    assert int(status.node) == 7


@both_kinds
def test_a_singular_matrix_is_never_silent(rng, scalar):
    """A free net without masses has no solution: PIVOT, or SOLVER where rounding left a positive pivot; never OK."""
    net = js.lattice((6, 7), FAMILIES)
    nothing = js.Vector((jnp.zeros((6, 7)),) * 3)
    for _ in range(4):
        step, b = stiff_step(net, near_grid(net, rng), rng, scalar=scalar), random_vector(net, rng)
        free = eqx.tree_at(lambda m: m.blocks.diagonal, step.matrix, (nothing,))
        _, info, _ = solve(Skyline(net), free, b)
        assert bool(info.status.has(Flag.PIVOT | Flag.SOLVER))
        assert not bool(info.status.is_ok)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite(sheet, value):
    """NaN or infinity in the matrix is NONFINITE at its node; in the right-hand side, NONFINITE."""
    net, step, b = sheet
    (mass,) = step.matrix.blocks.diagonal
    at_node = jnp.asarray(np.where(np.arange(42).reshape(6, 7) == 16, value, mass.y))
    spoiled = eqx.tree_at(lambda m: m.blocks.diagonal, step.matrix, (js.Vector((mass.x, at_node, mass.z)),))
    _, info, _ = solve(Skyline(net), spoiled, b)
    assert Flag(int(info.status.flags)) == Flag.NONFINITE
    assert int(info.status.node) == 16
    x, info, _ = solve(
        Skyline(net), step.matrix, js.Vector((jnp.asarray(np.where(np.arange(42).reshape(6, 7) == 0, value, b.x)), b.y, b.z))
    )
    assert Flag(int(info.status.flags)) == Flag.NONFINITE
    assert not np.all(np.isfinite(flat(net, x)))


def test_memory_is_kept_while_the_matrix_stands(sheet):
    """With the same matrix the factor in memory is used, even if it were wrong; a changed entry makes a new one."""
    net, step, b = sheet
    step = step.plus(net, np.zeros((42, 3)))
    skyline = Skyline(net)
    memory = skyline.init(step.matrix)
    spoiled = eqx.tree_at(lambda m: m.factor.panels, memory, tuple(2 * p for p in memory.factor.panels))
    x, info, kept = solve(skyline, step.matrix, b, spoiled)
    assert error(net, x, np.linalg.solve(step.dense, flat(net, b)) / 4) < 1e-10
    assert Flag(int(info.status.flags)) == Flag.SOLVER  # the residual tells
    np.testing.assert_array_equal(kept.factor.panels[0], spoiled.factor.panels[0])
    changed = step.plus(net, 1e-6 * (np.arange(126).reshape(42, 3) == 100))
    changed = eqx.tree_at(lambda m: m.blocks.diagonal, step.matrix, (changed.matrix.blocks.diagonal[0], changed.matrix.blocks.diagonal[2]))
    x, info, renewed = solve(skyline, changed, b, spoiled)
    assert bool(info.status.is_ok)
    assert float(info.residual) < 1e-12
    again, _, _ = solve(skyline, changed, b, renewed)
    np.testing.assert_array_equal(flat(net, x), flat(net, again))


def test_memory_is_carried_through_a_scan(sheet):
    """Twenty steps of x <- A^-1 x in a scan equal twenty dense solves, whether the matrix stands or changes at every step."""
    net, step, b = sheet
    skyline = Skyline(net)

    @jax.jit
    def run(matrix, b, growth):
        def advance(carry, i):
            x, memory = carry
            more = Blocks((js.Vector((growth * i * jnp.ones((6, 7)),) * 3),))
            now = SpringMatrix(more + matrix.blocks, matrix.free, matrix.like, matrix.layout)
            x, info, memory = skyline.solve_in_step(now, x, None, memory)
            return (x, memory), info.status.is_ok

        begin = skyline.init(SpringMatrix(matrix.blocks, matrix.free, matrix.like, matrix.layout))
        (x, _), ok = jax.lax.scan(advance, (b, begin), jnp.arange(20.0))
        return x, ok

    for growth in (0.0, 0.01):
        x, ok = run(step.matrix, b, growth)
        expected = flat(net, b)
        for i in range(20):
            expected = np.linalg.solve(step.dense + growth * i * np.eye(126), expected)
        assert error(net, x, expected) < 1e-10
        assert np.all(ok)


def test_memory_of_another_kind_of_matrix_is_refused(rng):
    """A factor that serves all coordinates cannot serve a matrix whose coordinates differ: ValueError, not a wrong answer."""
    net = js.lattice((4, 4), js.STRUCTURAL)
    step, b = stiff_step(net, near_grid(net, rng), rng, scalar=True), random_vector(net, rng)
    memory = Skyline(net).init(step.matrix)
    with pytest.raises(ValueError, match="in the same way"):
        Skyline(net).solve_in_step(step.holding(net, np.arange(16) > 0, None, None).matrix, b, None, memory)


@pytest.mark.slow
def test_float32_stays_float32(rng):
    """Float32 in, float32 out; the correction brings the error of a stiff step below 1e-4 of the solution."""
    net = js.lattice((32, 32), FAMILIES)
    step, b = stiff_step(net, near_grid(net, rng), rng, dtype=np.float32), random_vector(net, rng, dtype=np.float32)
    x, info, memory = solve(Skyline(net), step.matrix, b)
    assert {leaf.dtype for leaf in (*x, *memory.factor.panels, *memory.entries, info.residual)} == {np.dtype(np.float32)}
    expected = scipy.sparse.linalg.spsolve(step.sparse.astype(float).tocsc(), flat(net, b).astype(float))
    assert error(net, x, expected) < 1e-4
    assert float(info.residual) < 1e-4
    assert int(info.iterations) == 1
    assert bool(info.status.is_ok)


def test_as_users_run_it(user_mode, rng):
    """Under JAX's own defaults, not jitted, without memory."""
    net = js.lattice((3, 4), js.STRUCTURAL)
    step, b = stiff_step(net, near_grid(net, rng), rng, dtype=np.float32), random_vector(net, rng, dtype=np.float32)
    x, info, _ = Skyline(net).solve_in_step(step.matrix, b, None, None)
    assert residual(net, step.sparse, x, b) < 1e-3
    assert bool(info.status.is_ok)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-200, 1e200])
def test_scale_of_the_right_hand_side_does_not_matter(sheet, scale):
    """The solution is linear in b over 400 decades; 0 in, exactly 0 out, and status OK."""
    net, step, b = sheet
    x, info, _ = solve(Skyline(net), step.matrix, b * scale)
    expected = np.linalg.solve(step.dense, flat(net, b))
    assert np.linalg.norm(flat(net, x) / (scale or 1) - (expected if scale else 0)) < 1e-11 * np.linalg.norm(expected)
    assert bool(info.status.is_ok)
    assert float(info.residual) < 1e-11


def test_many_right_hand_sides(sheet, rng):
    """`vmap` over right-hand sides with one factor gives what one after the other gives."""
    net, step, _ = sheet
    several = jax.tree.map(lambda *a: jnp.stack(a), *[random_vector(net, rng) for _ in range(5)])
    factor = Skyline(net, order=ReverseCuthillMcKee(), block=7).factor(step.matrix)
    together = jax.vmap(factor.solve)(several)
    for i in range(5):
        one = factor.solve(jax.tree.map(lambda a, i=i: a[i], several))
        assert error(net, jax.tree.map(lambda a, i=i: a[i], together), flat(net, one)) < 1e-12


@both_kinds
def test_lanes_of_a_batch_do_not_meet(rng, scalar):
    """`vmap` over matrices: each lane equals its own solve, and an indefinite lane fails alone, naming its node, also with memory."""
    net = js.lattice((5, 4), FAMILIES)
    steps = [stiff_step(net, near_grid(net, rng), rng, scalar=scalar) for _ in range(3)]
    steps = [step.plus(net, np.where(np.arange(20)[:, None] == 13, -1e6 * (i == 1), 0.0) * np.ones(3)) for i, step in enumerate(steps)]
    b = [random_vector(net, rng) for _ in steps]
    skyline = Skyline(net, order=Natural())

    def twice(matrix, b):
        x, info, memory = skyline.solve_in_step(matrix, b, None, skyline.init(matrix))
        return skyline.solve_in_step(matrix, x, None, memory)[0], x, info

    stacked = jax.tree.map(lambda *a: jnp.stack(a), *[step.matrix for step in steps]), jax.tree.map(lambda *a: jnp.stack(a), *b)
    second, first, info = jax.jit(jax.vmap(twice))(*stacked)
    assert np.asarray(info.status.is_ok).tolist() == [True, False, True]
    assert int(info.status.node[1]) == 13
    assert np.all(np.isnan(first.x[1]))
    for i in (0, 2):
        once = np.linalg.solve(steps[i].dense, flat(net, b[i]))
        assert error(net, jax.tree.map(lambda a, i=i: a[i], first), once) < 1e-11
        assert error(net, jax.tree.map(lambda a, i=i: a[i], second), np.linalg.solve(steps[i].dense, once)) < 1e-11


def test_program_does_not_grow_with_the_mesh(rng):
    """The compiled loop is the same for 8 and for 40 nodes per side: as many operations, no unrolling."""
    counts = []
    for n in (8, 40):
        net = js.lattice((n, n), js.STRUCTURAL)
        step, b = stiff_step(net, near_grid(net, rng), rng), random_vector(net, rng)
        skyline = Skyline(net, order=Natural(), block=24)
        program = jax.jit(lambda m, b, skyline=skyline: skyline.solve_in_step(m, b, None, None)[0]).lower(step.matrix, b)
        counts.append(program.as_text().count(" = "))
        assert len(skyline.envelope.panels(3).widths) == 1
    assert abs(counts[0] - counts[1]) < 5  # a constant may be shared or not


def test_one_trace_for_equal_solvers(sheet):
    """A solver made anew on an equal net, as in a notebook cell that is run again, traces and compiles nothing new."""
    _, step, b = sheet
    traced = []

    @eqx.filter_jit
    def run(skyline, matrix, b):
        traced.append(1)
        return skyline.solve_in_step(matrix, b, None, None)[0]

    for _ in range(2):
        run(Skyline(js.lattice((6, 7), FAMILIES)), step.matrix, b)
    assert len(traced) == 1


def test_refusals():
    """Nets of different nodes, a panel without rows, and a traced net are refused with what to do."""
    with pytest.raises(ValueError, match="same nodes"):
        Skyline(js.lattice((3, 4)), js.lattice((4, 3)))
    with pytest.raises(ValueError, match="block = 0"):
        Skyline(js.lattice(3), block=0)
    graph = js.Graph.from_edges([(0, 1), (1, 2)], 3)
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda net: Skyline(net).profile().entries)(graph)
