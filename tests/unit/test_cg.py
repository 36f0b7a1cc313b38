"""Guarded iterative solvers: right where they can be, and loud where they cannot."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax
import numpy as np
import pytest
import scipy.sparse.linalg

import jaxspring as js
from jaxspring.linalg.cg import CG, JaxCG
from jaxspring.linalg.lineax_solver import Lineax
from jaxspring.linalg.preconditioners import BlockJacobi, Jacobi, Unpreconditioned
from jaxspring.status import Flag
from jaxspring.vector import Vector
from tests.step_matrices import flat, near_grid, random_vector, stiff_step

each_solver = pytest.mark.parametrize("solver", [JaxCG, CG])
FAMILIES = js.STRUCTURAL + js.SHEAR + js.BEND


@pytest.fixture
def spd(rng):
    q, _ = np.linalg.qr(rng.standard_normal((30, 30)))
    return (q * np.linspace(1, 100, 30)) @ q.T


def times(matrix):
    """The product with a NumPy matrix."""
    return lambda v: jnp.asarray(matrix, v.dtype) @ v


@eqx.filter_jit
def solve_in_step(solver, matrix, b, guess=None):
    """Compiled, as a step calls it."""
    return solver.solve_in_step(matrix, b, guess, None)[:2]


@each_solver
def test_solution_is_numpys(spd, rng, solver):
    """The solution equals numpy.linalg.solve to the tolerance, and the residual reported is the true one."""
    b = rng.standard_normal(30)
    x, info = solver(tolerance=1e-12).solve(times(spd), jnp.asarray(b))
    np.testing.assert_allclose(x, np.linalg.solve(spd, b), rtol=1e-10)
    assert bool(info.status.is_ok)
    # Solved less tightly, so that NumPy's own rounding (a few 1e-15) is no part of the comparison.
    x, info = solver(tolerance=1e-6).solve(times(spd), jnp.asarray(b))
    assert float(info.residual) == pytest.approx(np.linalg.norm(b - spd @ np.asarray(x)) / np.linalg.norm(b), rel=1e-6)


@each_solver
def test_default_tolerances(spd, rng, dtype, solver):
    """1e-8 in float64 and 1e-5 in float32 are reached, and not much more."""
    _, info = solver().solve(times(spd), jnp.asarray(rng.standard_normal(30), dtype))
    goal = 1e-8 if dtype == np.float64 else 1e-5
    assert bool(info.status.is_ok)
    assert goal / 100 < float(info.residual) < 10 * goal
    assert info.residual.dtype == dtype


def test_iterations_are_those_of_the_textbook(spd, rng):
    """As many as SciPy's conjugate gradients need; one per distinct eigenvalue; JaxCG does not tell."""
    b = rng.standard_normal(30)
    count = []
    scipy.sparse.linalg.cg(spd, b, rtol=1e-8, callback=count.append)
    _, info = CG().solve(times(spd), jnp.asarray(b))
    assert abs(int(info.iterations) - len(count)) <= 1
    _, info = CG().solve(lambda v: jnp.asarray([1.0, 2.0, 5.0] * 10) * v, jnp.asarray(b))
    assert int(info.iterations) == 3
    _, info = JaxCG().solve(times(spd), jnp.asarray(b))
    assert int(info.iterations) == -1


@each_solver
def test_preconditioner_and_guess_change_the_work_only(spd, rng, solver):
    """With Jacobi and a warm start the solution is the same; from the solution itself there is nothing left to do."""
    b, inverse = jnp.asarray(rng.standard_normal(30)), jnp.asarray(1 / np.diag(spd))
    expected = np.linalg.solve(spd, b)
    x, _ = solver(tolerance=1e-12).solve(times(spd), b, lambda r: inverse * r, jnp.asarray(rng.standard_normal(30)))
    np.testing.assert_allclose(x, expected, rtol=1e-10)
    x, info = solver().solve(times(spd), b, x0=jnp.asarray(expected))
    np.testing.assert_array_equal(x, jnp.asarray(expected) / jnp.linalg.norm(b) * jnp.linalg.norm(b))
    assert int(info.iterations) <= 0


@each_solver
@pytest.mark.parametrize("far", [1e12, np.nan, np.inf])
def test_a_useless_guess_is_dropped(spd, rng, solver, far):
    """A guess worse than zero, or none at all, costs neither digits nor the solve."""
    b = rng.standard_normal(30)
    x, info = solver(tolerance=1e-12).solve(times(spd), jnp.asarray(b), x0=jnp.full(30, far))
    np.testing.assert_allclose(x, np.linalg.solve(spd, b), rtol=1e-9)
    assert bool(info.status.is_ok)


@each_solver
def test_vectors_are_solved_as_they_are(rng, solver):
    """A right-hand side in several arrays comes back in the same arrays."""
    b = Vector((jnp.asarray(rng.standard_normal((3, 4))), jnp.asarray(rng.standard_normal((3, 4)))))
    x, _ = solver().solve(lambda v: 3.0 * v, b)
    np.testing.assert_allclose(x.y, b.y / 3, rtol=1e-12)


@each_solver
@pytest.mark.parametrize("scale", [1e-30, 1e-200, 1e200])
def test_scale_of_the_right_hand_side_does_not_matter(spd, rng, scale, solver):
    """The solution is linear in b over 400 decades: nothing underflows."""
    b = rng.standard_normal(30)
    x, info = solver(tolerance=1e-12).solve(times(spd), jnp.asarray(b * scale))
    np.testing.assert_allclose(np.asarray(x) / scale, np.linalg.solve(spd, b), rtol=1e-9)
    assert bool(info.status.is_ok)


@each_solver
def test_zero_right_hand_side_gives_zeros(spd, solver):
    """0 in, exactly 0 out after 0 iterations, status OK and gradient finite, even from a warm start."""

    def energy(b):
        x, info = solver().solve(times(spd), b, x0=jnp.ones(30))
        return jnp.sum(x * x), (x, info)

    gradient, (x, info) = jax.grad(energy, has_aux=True)(jnp.zeros(30))
    assert not np.any(x)
    assert not np.any(gradient)
    assert bool(info.status.is_ok)
    assert int(info.iterations) == 0
    assert float(info.residual) == 0


@each_solver
def test_too_few_iterations_are_reported(spd, rng, solver):
    """One iteration on a matrix of condition 100: CG_MAXITER, with the true residual."""
    b = rng.standard_normal(30)
    x, info = solver(max_iter=1).solve(times(spd), jnp.asarray(b))
    assert bool(info.status.has(Flag.CG_MAXITER))
    assert float(info.residual) == pytest.approx(np.linalg.norm(b - spd @ np.asarray(x)) / np.linalg.norm(b))
    with pytest.raises(js.SimulationError, match="CG_MAXITER"):
        js.raise_for_status(info)


@each_solver
def test_tolerance_below_rounding_is_reported(spd, rng, solver):
    """Float32 cannot reach 1e-10: the status says so, though the recursion believes it did."""
    _, info = solver(tolerance=1e-10).solve(times(spd), jnp.asarray(rng.standard_normal(30), jnp.float32))
    assert bool(info.status.has(Flag.CG_MAXITER))
    _, info = solver(tolerance=1e-30).solve(times(spd), jnp.asarray(rng.standard_normal(30)))
    assert int(info.status.flags) == Flag.CG_MAXITER


@each_solver
@pytest.mark.parametrize("matrix", [np.diag([-1.0, -2.0, -3.0]), np.zeros((3, 3))], ids=["negative", "zero"])
def test_indefinite_matrix_is_reported(matrix, solver):
    """Negative energy, or a breakdown to NaN: CG_INDEFINITE."""
    _, info = solver().solve(times(matrix), jnp.ones(3))
    assert int(info.status.flags) == Flag.CG_INDEFINITE


def test_iteration_stops_at_negative_curvature():
    """On diag(2, 1, -1) CG keeps the last iterate of positive curvature; JaxCG "converges" with x'A x > 0 and cannot know."""
    b = jnp.asarray([3.0, 1.0, 0.5])
    x, info = CG().solve(times(np.diag([2.0, 1.0, -1.0])), b)
    assert int(info.status.flags) == Flag.CG_INDEFINITE
    # One step of steepest descent is (b'b / b'A b) b; the second direction has negative curvature.
    np.testing.assert_allclose(x, b * float(b @ b) / (18.0 + 1.0 - 0.25), rtol=1e-12)
    assert int(info.iterations) == 2


@each_solver
@pytest.mark.parametrize("where", ["matrix", "right side"])
def test_nan_is_reported_as_such(spd, rng, solver, where):
    """NaN in the matrix or in b: NONFINITE, at once."""
    b = rng.standard_normal(30)
    if where == "matrix":
        spd[3, 4] = np.nan
    else:
        b[5] = np.nan
    _, info = solver().solve(times(spd), jnp.asarray(b))
    assert int(info.status.flags) == Flag.NONFINITE
    assert int(info.iterations) <= 1


@each_solver
def test_singular_matrices(solver):
    """C9: a free chain at rest: solved where the forces add up to nothing, an error where they push the whole, zeros for zero."""
    d = np.diff(np.eye(10), axis=0)
    chain = d.T @ d
    balanced = np.zeros(10)
    balanced[[0, -1]] = 1, -1
    x, info = solver().solve(times(chain), jnp.asarray(balanced))
    assert bool(info.status.is_ok)
    assert float(info.residual) < 1e-8
    np.testing.assert_allclose(d @ np.asarray(x), -np.ones(9), rtol=1e-6)
    _, info = solver().solve(times(chain), jnp.ones(10))
    assert bool(info.status.has(Flag.CG_INDEFINITE) | info.status.has(Flag.CG_MAXITER))
    x, info = solver().solve(times(chain), jnp.zeros(10))
    assert not np.any(x)
    assert bool(info.status.is_ok)


@each_solver
def test_lanes_finish_as_if_alone(solver):
    """A lane that is done stays bitwise the same whatever its neighbours do, and counts its own iterations."""
    easy, hard = np.ones(40), np.linspace(1, 1e6, 40)
    b = jnp.sin(jnp.arange(40.0))

    @jax.jit
    def solve(diagonals):
        return jax.vmap(lambda d: solver(tolerance=1e-10).solve(lambda v: d * v, b))(diagonals)

    x, info = solve(jnp.asarray([easy, hard, easy]))
    calm, calm_info = solve(jnp.asarray([easy, easy, easy]))
    np.testing.assert_array_equal(x[0], calm[0])
    np.testing.assert_array_equal(x[2], calm[2])
    np.testing.assert_array_equal(info.iterations[0], calm_info.iterations[0])
    assert info.residual.shape == (3,)
    _, alone = solver(tolerance=1e-10).solve(lambda v: jnp.asarray(hard) * v, b)
    assert abs(int(info.iterations[1]) - int(alone.iterations)) <= 1
    np.testing.assert_allclose(x[1], np.asarray(b) / hard, rtol=1e-6)


def test_a_failing_lane_leaves_the_others_alone(spd, rng):
    """NaN in one lane, an indefinite matrix in the next: the third is solved, bitwise as without them."""
    b = jnp.asarray(rng.standard_normal(30))
    solve = jax.jit(jax.vmap(lambda a: CG().solve(lambda v: a @ v, b)))
    x, info = solve(jnp.asarray([spd * np.nan, -spd, spd]))
    good, _ = solve(jnp.asarray([spd, spd, spd]))
    np.testing.assert_array_equal(x[2], good[2])
    assert [Flag(int(f)) for f in info.status.flags] == [Flag.NONFINITE, Flag.CG_INDEFINITE, Flag.OK]


@pytest.fixture
def sheet(rng):
    """A lattice of 6 x 7, a stiff matrix with a held corner and a held coordinate, a right-hand side."""
    net = js.lattice((6, 7), FAMILIES)
    corner, sliding = np.ones(42, bool), np.ones(42, bool)
    corner[0] = sliding[[0, 6]] = False
    return net, stiff_step(net, near_grid(net, rng), rng).holding(net, sliding, corner, corner), random_vector(net, rng)


@pytest.mark.slow
@each_solver
@pytest.mark.parametrize("preconditioner", [Unpreconditioned(), Jacobi(), BlockJacobi()], ids=["none", "Jacobi", "blocks"])
def test_solving_in_a_step(sheet, solver, preconditioner):
    """With every preconditioner the solution is NumPy's; held coordinates are those of b, bitwise."""
    net, step, b = sheet
    x, info = solve_in_step(solver(tolerance=1e-12, preconditioner=preconditioner), step.matrix, b, b)
    np.testing.assert_allclose(flat(net, x), np.linalg.solve(step.dense, flat(net, b)), rtol=1e-8, atol=1e-10)
    assert bool(info.status.is_ok)
    assert float(x.y[0, 0]) == float(b.y[0, 0])
    assert float(x.x[0, 6]) == float(b.x[0, 6])


def test_everything_held_needs_no_iteration(sheet):
    """C8: with every coordinate held the solution is b, after 0 iterations."""
    net, step, b = sheet
    nothing = np.zeros(42, bool)
    x, info = solve_in_step(CG(), step.holding(net, nothing, nothing, nothing).matrix, b)
    np.testing.assert_array_equal(flat(net, x), flat(net, b))
    assert int(info.iterations) == 0
    assert bool(info.status.is_ok)


LINEAX = [lineax.CG(rtol=1e-10, atol=1e-12), lineax.Cholesky(), lineax.LU(), lineax.GMRES(rtol=1e-10, atol=1e-12)]


@pytest.mark.slow
@pytest.mark.parametrize("solver", LINEAX, ids=lambda s: type(s).__name__)
def test_any_lineax_solver(sheet, solver):
    """Iterative or direct, the solution is NumPy's, and so is the derivative of its square by the size of the matrix."""
    net, step, b = sheet

    def energy(size):
        matrix = eqx.tree_at(lambda m: m.blocks, step.matrix, step.matrix.blocks.scaled(size))
        x, info, _ = Lineax(solver).solve_in_step(matrix, b, None, None)
        return sum(jnp.sum(a * a) for a in x), (x, info)

    gradient, (x, info) = jax.jit(jax.grad(energy, has_aux=True))(1.0)
    expected = np.linalg.solve(step.dense, flat(net, b))
    np.testing.assert_allclose(flat(net, x), expected, rtol=1e-6, atol=1e-8)
    assert bool(info.status.is_ok)
    # Free coordinates fall as 1 / size, held ones do not change.
    held = np.diag(step.dense) == 1
    assert float(gradient) == pytest.approx(-2 * np.sum(expected[~held] ** 2), rel=1e-6)


@pytest.mark.slow
def test_failures_of_lineax_are_statuses(sheet):
    """Too few steps, and NaN: CG_MAXITER and NONFINITE, in place of lineax's exceptions."""
    _, step, b = sheet
    _, info = solve_in_step(Lineax(lineax.CG(rtol=1e-10, atol=1e-12, max_steps=2)), step.matrix, b)
    assert bool(info.status.has(Flag.CG_MAXITER))
    _, info = solve_in_step(Lineax(lineax.CG(rtol=1e-10, atol=1e-12)), step.matrix, b * jnp.nan)
    assert bool(info.status.has(Flag.NONFINITE))
    _, info = solve_in_step(Lineax(lineax.CG(rtol=1e-2, atol=1e-12), tolerance=1e-8), step.matrix, b)
    assert bool(info.status.has(Flag.SOLVER))


def test_lineax_needs_an_absolute_tolerance():
    """With `rtol` alone lineax stops at once where a coordinate is zero: refused."""
    with pytest.raises(ValueError, match="atol=1e-12"):
        Lineax(lineax.CG(rtol=1e-8, atol=0))


@each_solver
@pytest.mark.parametrize("wrong", [{"tolerance": 0.0}, {"tolerance": float("nan")}, {"adjoint_tolerance": -1.0}, {"max_iter": 0}])
def test_wrong_settings_are_refused(wrong, solver):
    """A tolerance or a count that cannot work is a ValueError that names it."""
    with pytest.raises(ValueError, match=next(iter(wrong))):
        solver(**wrong)
