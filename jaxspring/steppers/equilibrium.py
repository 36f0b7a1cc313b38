"""Static shapes: where all forces balance. `equilibrium`.

    F(x) = 0 where free                            the unknown
    K d = F, |d| <= radius                         K = -dF/dx exact; conjugate gradients, cut at the radius and at negative curvature
    ratio = (E(x) - E(x + d)) / (F d - d'K d / 2)  how well the model foretold the energy: sets the radius, and whether d is taken

Every step lowers the energy, so the shape found is a minimum and no saddle that Newton's method happens upon. Where a force has no
potential, |F| takes the place of E and the clamped tangent that of K. The derivative is implicit: one linear solve with the exact K.

Source: Steihaug (1983) for the truncated iteration; Conn, Gould and Toint, Trust-Region Methods (2000), algorithms 6.1.1 and 7.5.1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array

from ..bound import BoundSystem
from ..forces.base import SPOILT
from ..forces.linearisation import Tangent
from ..linalg.base import SolveInfo
from ..linalg.exact import Converged, ExactSolver
from ..linalg.implicit import implicitly
from ..linalg.iterative import dot, norm
from ..linalg.operators import Blocks, SpringMatrix, isotropic
from ..linalg.preconditioners import BlockJacobi, Preconditioner
from ..numerics import stopped
from ..state import State
from ..status import Flag, Status
from ..system import System, as_system
from ..topology.periods import box_of
from ..vector import Vector
from .truncated import Ended, truncated_cg

# A net that has moved this many times its own size has nothing to hold it.
_RUNAWAY = 1e6


class Equilibrium(eqx.Module):
    """What `equilibrium` returns.

    Attributes:
        state: the static shape, at rest.
        info: net force over the size of the forces; iterations of conjugate gradients.
        newton_iterations: steps of the trust region.
        status: OK, or MECHANISM, UNSTABLE, SOLVER, NONFINITE, BOX; see `raise_for_status`.
        effects: names of the system's forces, for messages (static).
    """

    state: State
    info: SolveInfo
    newton_iterations: Array
    status: Status
    effects: tuple[str, ...] = eqx.field(static=True)


def equilibrium(
    system: System,
    state: State,
    tolerance: float | None = None,
    max_iter: int = 5000,
    preconditioner: Preconditioner | None = None,
    adjoint: ExactSolver | None = None,
) -> Equilibrium:
    """The static shape nearest downhill from a state; held coordinates stay where they are.

    Differentiable in the system's constants and in the places of held coordinates, in forward and reverse mode and to any order. It does
    not depend on where free nodes start. Where the status is not OK the derivative is NaN.

    Args:
        system: what is in balance. Velocities, and forces of the velocity, are taken as zero; loads and moved nodes at the state's time.
        state: where to start from.
        tolerance: wanted net force over the size of the forces on free nodes; None is 1e-10 in float64 and 1e-5 in float32. No less than
            rounding of the positions allows.
        max_iter: most steps of the trust region.
        preconditioner: of the linear solves; None is `BlockJacobi()`.
        adjoint: solver of the derivative; None is `ExactSolver()`.

    Returns:
        An `Equilibrium`. Its status says MECHANISM where the net can move without a force, or where its energy falls without end, and
        UNSTABLE where forces balance but the shape is no minimum, as in a straight chain under pressure: push it a little. BOX: a spring
        of a periodic net came to half a period, and turned.

    Raises:
        ValueError: a tolerance or a number of iterations that is not positive.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, (js.Springs(net, 100.0, 1.0), js.Gravity((0.0, -9.81))), free=np.array([False, True]))
    >>> hanging = js.equilibrium(system, js.State.from_points(net, [[0.0, 0.0], [0.1, -1.0]]))
    >>> print(hanging.state.points[1].round(4) + 0.0)
    [ 0.     -1.0981]
    """
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0):
        raise ValueError(f"tolerance = {tolerance}, but a relative force must be positive and finite. Pass e.g. tolerance=1e-8.")
    if max_iter < 1:
        raise ValueError(f"max_iter = {max_iter}: without a step nothing is found. Pass 1 or more.")
    search = _Search(
        BlockJacobi() if preconditioner is None else preconditioner, ExactSolver() if adjoint is None else adjoint, tolerance, max_iter
    )
    return _find(search, as_system(system), state.checked())


class _Scene(eqx.Module):
    """What is given: the system, and the state at which displacements are zero."""

    system: BoundSystem
    start: State

    def at(self, u: Vector) -> State:
        """The state displaced by `u` [m] where free, at rest."""
        moved = self.start.position + self.system.hold(u)
        return self.start.moved(moved, Vector.zeros_like(moved))

    def force(self, u: Vector) -> Vector:
        """Net force where free, zero where held [N]."""
        return self.system.hold(self.system.force(self.at(u)))

    def energy(self, u: Vector) -> Array | None:
        """Potential energy [J]; None where a force has none."""
        return self.system.incremental_potential(self.at(u), jnp.ones((), u.dtype))

    def matrix(self, u: Vector) -> SpringMatrix:
        """Clamped tangent stiffness [N/m], made definite by a tenth of its mean diagonal: only ever a preconditioner."""
        state = self.at(u)
        blocks = self.system.stiffness_blocks(state, Tangent())
        diagonal = self.system.matrix(blocks, state).diagonal()
        mean = dot(diagonal, diagonal.map(jnp.ones_like)) / (diagonal.dim * max(math.prod(diagonal.shape), 1))
        shift = jnp.where(mean > 0, 0.1 * mean, jnp.ones_like(mean))
        return lax.optimization_barrier(self.system.matrix(blocks + Blocks((isotropic(shift, u),)), state))


class _Balance(Converged):
    """The equations -F(u) = 0 where free, u = 0 where held."""

    def residual(self, scene: _Scene, u: Vector) -> Vector:
        """Minus the net force [N]."""
        return scene.system.matrix(Blocks(), scene.start).pick(-scene.force(u), u)

    def nearby(self, scene: _Scene, u: Vector) -> tuple[SpringMatrix, bool]:
        """The preconditioner's matrix."""
        return scene.matrix(u), scene.system.is_symmetric


class _Progress(eqx.Module):
    """Where the search stands. Before the first pass nothing is known: merit is infinite.

    Attributes:
        u: displacement [m].
        force: net force [N].
        merit: energy [J], or |F| [N].
        goal: net force that counts as none [N].
        radius: of the trust region, in the preconditioner's norm.
        passes, iterations: of the search; of conjugate gradients.
        curvature: least relative curvature that the probe met; NaN before.
        is_drifting: whether a net force pulls the whole where nothing resists.
    """

    u: Vector
    force: Vector
    merit: Array
    goal: Array
    radius: Array
    passes: Array
    iterations: Array
    curvature: Array
    is_drifting: Array

    @property
    def is_balanced(self) -> Array:
        """Whether the forces balance."""
        return norm(self.force) <= self.goal


class _Search(eqx.Module):
    """How the search is done: the arguments of `equilibrium`."""

    preconditioner: Preconditioner
    adjoint: ExactSolver
    tolerance: float | None = eqx.field(static=True)
    max_iter: int = eqx.field(static=True)

    def run(self, scene: _Scene) -> _Progress:
        """Passes: the first evaluates the start, the last probes the shape that was found; one program serves all."""
        zero = Vector.zeros_like(scene.start.position)
        size, n_nodes = _size(scene), max(math.prod(zero.shape), 2)
        stiffness = norm(scene.system.hold(scene.matrix(zero).diagonal()))
        # At first every node may move by about the distance of two.
        radius = size * n_nodes ** (-1 / zero.dim) * jnp.sqrt(stiffness * math.sqrt(n_nodes))
        none = jnp.zeros((), jnp.int32)
        unknown = jnp.full_like(radius, jnp.inf)
        never = jnp.zeros((), bool)
        begin = _Progress(zero, zero, unknown, -jnp.ones_like(radius), radius, none, none, jnp.full_like(radius, jnp.nan), never)
        smallest = float(jnp.finfo(zero.dtype).eps) ** 2 * radius

        def goes_on(at: _Progress) -> Array:
            is_first = at.passes == 0
            is_sound = jnp.isfinite(at.merit) & (at.radius > smallest) & ~_ran_away(scene, at)
            return is_first | (is_sound & jnp.isnan(at.curvature) & (at.is_balanced | (at.passes <= self.max_iter)))

        return lax.while_loop(goes_on, lambda at: self._pass(scene, stiffness, at), begin)

    def _pass(self, scene: _Scene, stiffness: Array, at: _Progress) -> _Progress:
        size, dtype = norm(at.force), at.goal.dtype
        is_probe = at.is_balanced
        # Inexact far from the goal, tighter near it, so that convergence stays faster than linear.
        loose = jnp.minimum(jnp.asarray(0.1, dtype), jnp.sqrt(size * self.tolerance_for(dtype) / jnp.abs(at.goal)))
        push = _push(scene.system, at.u)
        right_side = jax.tree.map(lambda p, f: jnp.where(is_probe, p, f), push, at.force)
        enough = jnp.where(is_probe, 1e-3 * norm(push), jnp.maximum(loose * size, 0.1 * at.goal))
        far = jnp.asarray(float(jnp.finfo(dtype).eps) ** -2, dtype)
        matrix = scene.matrix(at.u)
        product = self._model(scene, at.u)
        found = truncated_cg(product, right_side, self.preconditioner.build(matrix), jnp.where(is_probe, far, at.radius), enough)
        curvature = jnp.where(is_probe, found.curvature, at.curvature)
        new = self._moved(scene, stiffness, at, found)
        after = self._judged(scene, at, new, found)
        kept = eqx.tree_at(lambda p: (p.passes, p.iterations), at, (new.passes, new.iterations))
        after = jax.tree.map(lambda a, b: jnp.where(is_probe, a, b), kept, after)
        drifts = _drifts(at, scene.system.hold(at.force.map(lambda a: jnp.full_like(a, jnp.mean(a)))), product, stiffness)
        return eqx.tree_at(lambda p: (p.curvature, p.is_drifting), after, (curvature, drifts))

    def _moved(self, scene: _Scene, stiffness: Array, at: _Progress, found: Ended) -> _Progress:
        """Everything at the end of the step that was found."""
        u = at.u + found.d
        force, energy, state = scene.force(u), scene.energy(u), scene.at(u)
        # Each effect by itself, so that a balance of large forces is not taken for their absence.
        sizes = (norm(scene.system.hold(f.force(state))) for f in scene.system.forces)
        # Positions are rounded, and stiff springs feel it.
        rounding = 8 * float(jnp.finfo(u.dtype).eps) * stiffness * state.position.largest()
        goal = self.tolerance_for(u.dtype) * sum(sizes, start=jnp.zeros((), u.dtype)) + rounding
        merit = norm(force) if energy is None else energy
        return _Progress(u, force, merit, goal, at.radius, at.passes + 1, at.iterations + found.iterations, at.curvature, at.is_drifting)

    def _judged(self, scene: _Scene, at: _Progress, new: _Progress, found: Ended) -> _Progress:
        """The new place with a new radius, or the old one with a smaller radius."""
        size = norm(at.force)
        foretold = 0.5 * dot(found.d, at.force + found.left) if self._has_energy(scene) else size - norm(found.left)
        # Near the minimum the energy, a sum of terms that cancel, tells no more; the forces still do.
        noise = 10 * float(jnp.finfo(size.dtype).eps) * jnp.abs(at.merit)
        ratio = (at.merit - new.merit + noise) / (foretold + noise)
        ratio = jnp.where(norm(new.force) <= 0.5 * size, jnp.maximum(ratio, 0.5), ratio)
        is_first = at.passes == 0
        is_taken = ((ratio > 1e-4) & jnp.isfinite(new.merit) & jnp.isfinite(norm(new.force))) | is_first
        wider = jnp.where((ratio > 0.75) & found.is_cut, 2 * at.radius, at.radius)
        radius = jnp.where(is_taken & (ratio > 0.25), wider, 0.25 * jnp.minimum(found.length, at.radius))
        kept = eqx.tree_at(lambda p: (p.passes, p.iterations), at, (new.passes, new.iterations))
        best = jax.tree.map(lambda a, b: jnp.where(is_taken, a, b), new, kept)
        return eqx.tree_at(lambda p: p.radius, best, jnp.where(is_first, at.radius, radius))

    def _model(self, scene: _Scene, u: Vector) -> Callable[[Vector], Vector]:
        """The product with K: exact where there is an energy, clamped where there is none."""
        if not self._has_energy(scene):
            state = scene.at(u)
            return scene.system.matrix(scene.system.stiffness_blocks(state, Tangent()), state)
        _, product = jax.linearize(scene.force, u)
        return lambda p: -product(p)

    def _has_energy(self, scene: _Scene) -> bool:
        return jax.eval_shape(scene.energy, scene.start.position) is not None

    def tolerance_for(self, dtype: DTypeLike) -> float:
        """Net force over the size of the forces."""
        return self.tolerance or (1e-10 if dtype == jnp.float64 else 1e-5)


def _push(system: BoundSystem, like: Vector) -> Vector:
    """A fixed force that feels every direction in which the net may give way."""
    keys = jax.random.split(jax.random.key(0), like.dim)
    return system.hold(Vector(tuple(jax.random.normal(key, like.shape, like.dtype) for key in keys)))


@eqx.filter_jit
def _find(search: _Search, system: System, state: State) -> Equilibrium:
    ready = system.bind(state.dtype)
    # A cache is kept up to date by rollout alone: without it each evaluation makes its own. Histories are held,
    # and so are the commands of this state.
    start = ready.commanded(ready.alone(state))
    # Free nodes end at the same place wherever they start; only held ones carry a derivative.
    anchor = ready.matrix(Blocks(), start).pick(stopped(start.position), start.position)
    scene = _Scene(ready, start.moved(anchor, Vector.zeros_like(anchor)))
    still = stopped(scene)
    end = search.run(still)
    status = _status(still, end).then(_in_box(still, end)).then(_precision(still, end))
    trust = jnp.where(status.is_ok, jnp.ones_like(end.goal), jnp.full_like(end.goal, jnp.nan))
    u = implicitly(_Balance(search.adjoint, trust), scene, end.u)
    relative = search.tolerance_for(end.goal.dtype) * norm(end.force) / jnp.where(end.goal > 0, end.goal, jnp.ones_like(end.goal))
    info = SolveInfo(relative, end.iterations, status)
    n_steps = jnp.maximum(end.passes - 1 - (~jnp.isnan(end.curvature)).astype(jnp.int32), 0)
    return Equilibrium(scene.at(u), info, n_steps, status, tuple(type(f).__name__ for f in system.forces))


def _status(scene: _Scene, end: _Progress) -> Status:
    """Whether the forces balance, and whether the shape resists every push."""
    eps = float(jnp.finfo(end.goal.dtype).eps)
    is_number = jnp.isfinite(end.merit) & jnp.isfinite(norm(end.force))
    ran_away = is_number & _ran_away(scene, end)
    is_settled = end.is_balanced & ~ran_away
    # Curvature over that of the preconditioner: about 1 in most directions, 1e-6 in the softest mode of a thousand nodes in a row;
    # exactly 0 becomes rounding. Less than minus the square root of that is no rounding of a tension.
    is_unstable = is_settled & (end.curvature < -math.sqrt(eps))
    is_loose = ran_away | (is_settled & ~is_unstable & (end.curvature <= 100 * eps))
    status = Status.when(Flag.NONFINITE, ~is_number).then(Status.when(Flag.MECHANISM, is_loose))
    return status.then(Status.when(Flag.UNSTABLE, is_unstable)).then(Status.when(Flag.SOLVER, is_number & ~is_settled & ~ran_away))


def _in_box(scene: _Scene, end: _Progress) -> Status:
    """BOX where a spring of a periodic net has come to half a period, or turned to another image."""
    status, state = Status.ok(), scene.at(end.u)
    if box_of(scene.system.net) is None:
        return status
    for i, force in enumerate(scene.system.forces):
        for found in (*force.diagnose(state), *force.diagnose_since(scene.start, state)):
            if found.flag == Flag.BOX:
                status = status.then(Status.when(found.flag, found.count > 0, effect=i, count=found.count))
    return status


def _precision(scene: _Scene, end: _Progress) -> Status:
    """PRECISION where the coordinates are too large for the springs between them."""
    status, state = Status.ok(), scene.at(end.u)
    for i, force in enumerate(scene.system.forces):
        error = force.rounding(state)
        if error is not None:
            status = status.then(Status.when(Flag.PRECISION, error > SPOILT, effect=i))
    return status


def _drifts(at: _Progress, along: Vector, product: Callable[[Vector], Vector], stiffness: Array) -> Array:
    """Whether the forces add up to a pull along a translation that no spring resists."""
    length = norm(along)
    is_pulled = dot(at.force, along) > at.goal * length
    resistance = norm(product(along)) * math.sqrt(along.dim * math.prod(along.shape))
    return is_pulled & (resistance <= 1e4 * float(jnp.finfo(length.dtype).eps) * stiffness * length)


def _ran_away(scene: _Scene, at: _Progress) -> Array:
    """Whether the net has left: nothing holds it."""
    far, size = at.u.largest(), _size(scene)
    return (far > _RUNAWAY * size) | (at.is_drifting & (far > size))


def _size(scene: _Scene) -> Array:
    """Extent of the net [m]; 1 where all nodes coincide."""
    extents = jnp.stack([jnp.max(a) - jnp.min(a) for a in scene.start.position])
    largest = jnp.max(extents)
    return jnp.where(largest > 0, largest, jnp.ones_like(largest))


__all__ = ["Equilibrium", "equilibrium"]
