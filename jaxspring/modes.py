"""Small motions about a state at rest: normal modes, and the response to a harmonic load.

    M u'' + G u' + K u = f            K = -dF/dx,  G = -dF/dv  at the state's positions and velocity zero
    K phi = w^2 M phi                 normal modes, phi' M phi = 1
    (K + i w G - w^2 M) U = F         u = Re U exp(i w t) under the load Re F exp(i w t)

K is exact, not clamped: squeezed springs may make it indefinite, and w^2 < 0 then tells of a motion that grows as exp(sqrt(-w^2) t). The
formulas hold where the forces balance; elsewhere they describe the motion about the state's own acceleration. Held coordinates take
no part.

Source: Bathe, Finite Element Procedures (1996), sections 9.3 and 10.2.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array

from ._arrays import Numbers, given
from ._checks import as_inexact, finite, has_shape, is_concrete, shape_of
from .bound import BoundSystem
from .forces.linearisation import ExactTangent
from .linalg.eigen import lowest_eigenpairs, symmetric_eigen
from .nodes import Nodes
from .numerics import is_traced
from .state import State
from .system import System
from .vector import Vector

# Unknowns (nodes times coordinates) of a dense matrix: 32 MiB in float64, some seconds for its eigenvalues.
LARGEST_DENSE = 2048


class Modes(eqx.Module):
    """Normal modes, the lowest first.

    Attributes:
        squared_frequencies: (n,) w^2 [rad^2/s^2]; negative where the state is unstable.
        shapes: (n, N, D) displacements in the user's node order [1/sqrt(kg)], with sum of m phi^2 = 1; zero where held.
    """

    squared_frequencies: Array
    shapes: Array

    @property
    def frequencies(self) -> Array:
        """(n,) w [rad/s]; -s stands for a motion that grows as exp(s t). Rounding makes a zero about sqrt(eps) of the highest one."""
        squared = self.squared_frequencies
        is_zero = squared == 0
        return jnp.where(is_zero, jnp.zeros_like(squared), jnp.sign(squared) * jnp.sqrt(jnp.abs(jnp.where(is_zero, 1, squared))))


def normal_modes(system: System, state: State, n_modes: int | None = None) -> Modes:
    """Frequencies and shapes of the small undamped motions about a state.

    Up to 2,048 unknowns (N D) the matrix is dense, and the result differentiable in the system and the state. Derivatives of squared
    frequencies are exact for an eigenvalue that stands alone, and sum up rightly over those that coincide (one by one they belong to
    the shapes that were found). Derivatives of shapes, and second ones, are exact where eigenvalues stand alone, and NaN where they
    coincide. Larger systems need `n_modes` and numbers: the lowest modes are found on the host by SciPy, without derivatives.

    Args:
        system: masses, forces and what is held; damping and motion are left out.
        state: where the forces are linearised; best where they balance.
        n_modes: how many, the lowest; None is all: the number of free coordinates. Where the system is an argument of `jit` and that
            number is not known, the modes beyond it have an infinite frequency and no shape.

    Returns:
        The modes, the lowest frequency first.

    Raises:
        TypeError: an `n_modes` that is no whole number.
        ValueError: more modes than free coordinates; a dF/dx that is not symmetric (under `jit` the frequencies are NaN then); a large
            system without `n_modes`, under a transformation, or with a force that does not name all its `stiffness_blocks`.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, mass=2.0, forces=js.Springs(net, 4.0, 1.0))
    >>> print(normal_modes(system, js.State.from_points(net, net.grid()), n_modes=2).frequencies.round(3))
    [0. 2.]
    """
    n = int(np.prod(state.checked().position.shape)) * state.dim
    n_free = _count_free(system, state)
    if not n_free:
        raise ValueError("Every coordinate is held, so that nothing moves and there are no modes. Free one, see `free` of System.")
    if n_modes is not None:
        if isinstance(n_modes, bool) or not isinstance(n_modes, (int, np.integer)):
            raise TypeError(f"n_modes = {n_modes!r}; expected a whole number, or None for all.")
        n_modes = int(n_modes)
    if n_modes is not None and not 0 < n_modes <= n_free:
        raise ValueError(f"n_modes = {n_modes}, but the system has {n_free} free coordinates; expected 1 to {n_free}.")
    if n > LARGEST_DENSE:
        return _on_the_host(system, state, n_modes)
    modes, asymmetry = _dense_modes(system, state, n_free if n_modes is None else n_modes)
    if not isinstance(asymmetry, Tracer) and bool(asymmetry > _slack(state)):
        raise ValueError(
            f"dF/dx is not symmetric (by {float(asymmetry):.2g} of its largest entry), so that there are no normal modes: a stiffness "
            "follows an image, or data springs pull along z alone (conservative=True makes them symmetric)."
        )
    return modes


def frequency_response(system: System, state: State, frequencies: Numbers, force: Numbers) -> Array:
    """Complex amplitudes of the steady motion under a harmonic load, damping included.

    A dense solve for each frequency: up to 2,048 unknowns (N D). Differentiable in everything. Without damping the amplitude at a
    normal mode's frequency is infinite, or as large as rounding lets it be.

    Args:
        system: masses, forces and what is held.
        state: where the forces are linearised, at velocity zero; best where they balance.
        frequencies: w [rad/s], one number or (F,).
        force: (N, D) amplitude of the load in the user's node order [N], real or complex (a phase).

    Returns:
        (N, D) or (F, N, D) complex displacements [m] in the user's node order: abs is the amplitude, the angle the phase before the load.
        Zero where held.

    Raises:
        ValueError: a load or frequencies of another shape; a system too large.

    >>> import jaxspring as js
    >>> net = js.lattice(2)
    >>> system = js.System(net, 1.0, (js.Springs(net, 4.0, 1.0), js.Drag(0.5)), free=np.array([False, True]))
    >>> u = frequency_response(system, js.State.from_points(net, net.grid()), 2.0, [[0.0], [3.0]])
    >>> print(f"{abs(u[1, 0]):.3f}")  # at resonance F / (c w)
    3.000
    """
    n = int(np.prod(state.checked().position.shape)) * state.dim
    if n > LARGEST_DENSE:
        raise ValueError(f"{n} unknowns (nodes times coordinates); the dense matrix of a frequency response may have {LARGEST_DENSE}.")
    load: Any = given("force", force)
    has_shape("force", load, {"per node and coordinate": (n // state.dim, state.dim)})
    parts = as_inexact("force", load.real, state.dtype), as_inexact("force", load.imag, state.dtype)
    frequencies = as_inexact("frequencies", frequencies, state.dtype)
    for name, value in (("force", parts[0]), ("force", parts[1]), ("frequencies", frequencies)):
        finite(name, value)
    if frequencies.ndim > 1:
        raise ValueError(f"frequencies has shape {frequencies.shape}; expected one number or (F,).")
    found = _responses(system, state, jnp.atleast_1d(frequencies), parts)
    return found if frequencies.ndim else found[0]


@eqx.filter_jit
def _dense_modes(system: System, state: State, count: int) -> tuple[Modes, Array]:
    bound = system.bind(state.dtype)
    state = bound.own(state)
    free, scale = _free(bound, state), 1 / jnp.sqrt(_masses(bound, state))
    stiffness, _ = _linearised(bound, state, with_damping=False)
    largest = jnp.max(jnp.abs(stiffness))
    asymmetry = jnp.max(jnp.abs(jnp.where(free[:, None] & free[None, :], stiffness - stiffness.T, 0)))
    asymmetry = asymmetry / jnp.where(largest > 0, largest, jnp.ones_like(largest))
    a = scale[:, None] * (0.5 * (stiffness + stiffness.T)) * scale[None, :]
    a = jnp.where(free[:, None] & free[None, :], a, jnp.zeros_like(a))
    # Above all eigenvalues, and each alone: so held coordinates come last, and repeat no eigenvalue.
    highest = lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(a), axis=1)))
    apart = jnp.where(highest > 0, highest, jnp.ones_like(highest)) * jnp.linspace(2.0, 3.0, len(a), dtype=a.dtype)
    a = a + jnp.diag(jnp.where(free, jnp.zeros_like(apart), apart))
    values, vectors = symmetric_eigen(jnp.where(asymmetry > _slack(state), jnp.full_like(a, jnp.nan), a))
    vectors = jnp.where(free[:, None], scale[:, None] * vectors, jnp.zeros_like(vectors)).T[:count]
    is_mode = jnp.arange(count) < jnp.sum(free)
    values = jnp.where(is_mode, values[:count], jnp.asarray(jnp.inf, a.dtype))
    vectors = jnp.where(is_mode[:, None], vectors, jnp.zeros_like(vectors))
    return Modes(values, vectors.reshape(count, -1, state.dim)), asymmetry


def _on_the_host(system: System, state: State, n_modes: int | None) -> Modes:
    """The lowest modes by SciPy."""
    if n_modes is None or is_traced(system, state):
        raise ValueError(
            f"This system has more than {LARGEST_DENSE} unknowns (nodes times coordinates): too large for a dense matrix, and so for all "
            "modes and for derivatives. Pass n_modes, and call normal_modes outside jit, grad and vmap."
        )
    bound = system.bind(state.dtype)
    state = bound.own(state)
    matrix = bound.matrix(bound.stiffness_blocks(state, ExactTangent()), state)
    probe = bound.hold(state.position.map(lambda a: jnp.asarray(np.random.default_rng(0).normal(size=a.shape), a.dtype)))
    named = bound.hold(matrix.blocks.product(probe))
    missing = named + bound.hold(jax.jvp(lambda x: bound.force(_at_rest(state, x)), (state.position,), (probe,))[1])
    if bool(jnp.max(missing.norm()) > _slack(state) * jnp.max(named.norm())):
        raise ValueError(
            "The stiffness blocks that the forces name are not their dF/dx: a stiffness follows an image, data springs pull along z alone, "
            f"or a force of your own does not name them. Systems of up to {LARGEST_DENSE} unknowns need no blocks."
        )
    free, scale = np.asarray(_free(bound, state)), 1 / np.sqrt(np.asarray(_masses(bound, state), np.float64))
    if n_modes >= free.sum():
        raise ValueError(f"n_modes = {n_modes}: of a system this large less than its {free.sum()} modes can be found.")
    a = matrix.to_scipy().astype(np.float64)[free][:, free].multiply(scale[free][:, None]).multiply(scale[free][None, :])
    values, vectors = lowest_eigenpairs(a.tocsc(), n_modes)
    shapes = np.zeros((n_modes, len(free)))
    shapes[:, free] = vectors.T * scale[free]
    return Modes(jnp.asarray(values, state.dtype), jnp.asarray(shapes.reshape(n_modes, -1, state.dim), state.dtype))


@eqx.filter_jit
def _responses(system: System, state: State, frequencies: Array, force: tuple[Array, Array]) -> Array:
    bound = system.bind(state.dtype)
    state = bound.own(state)
    free, mass = _free(bound, state), _masses(bound, state)
    stiffness, damping = _linearised(bound, state, with_damping=True)
    both = free[:, None] & free[None, :]
    unit = jnp.eye(len(free), dtype=state.dtype)
    load = lax.complex(*(jnp.where(free, part.ravel(), jnp.zeros_like(part.ravel())) for part in force))

    def solve(w: Array) -> Array:
        real = jnp.where(both, stiffness - jnp.diag(w * w * mass), unit)
        return jnp.linalg.solve(lax.complex(real, jnp.where(both, w * damping, jnp.zeros_like(damping))), load)

    return lax.map(solve, frequencies).reshape(len(frequencies), len(free) // state.dim, state.dim)


def _linearised(system: BoundSystem, state: State, *, with_damping: bool) -> tuple[Array, Array]:
    """(N D, N D) matrices K and G in the user's order; G is zero where it is not wanted."""
    layout, dim = state.layout, state.dim
    zero = jnp.zeros((int(np.prod(state.position.shape)), dim), state.dtype)

    def force(moved: Array, moving: Array) -> Array:
        x, v = (Vector(tuple(layout.unflatten(a[:, i]) for i in range(dim))) for a in (moved, moving))
        f = system.force(state.moved(state.position + x, v))
        return jnp.stack([layout.flatten(a) for a in f], axis=-1)

    _, change = jax.linearize(force, zero, zero)
    columns = jnp.eye(zero.size, dtype=state.dtype).reshape(zero.size, *zero.shape)

    def matrix(one: Any) -> Array:
        return -lax.map(one, columns, batch_size=128).reshape(zero.size, zero.size).T

    stiffness = matrix(lambda u: change(u, zero))
    return stiffness, matrix(lambda u: change(zero, u)) if with_damping else jnp.zeros_like(stiffness)


def _at_rest(state: State, position: Vector) -> State:
    return state.moved(position, Vector.zeros_like(position))


def _count_free(system: Nodes, state: State) -> int:
    """How many coordinates are free; all of them where that is not known."""
    masks, shape = system.free_masks(state.dim), shape_of(state.position[0])
    known = (np.broadcast_to(m, shape) if m is not None and is_concrete(m) else np.ones(shape, bool) for m in masks)
    return sum(int(m.sum()) for m in known)


def _free(system: Nodes, state: State) -> Array:
    """(N D,) booleans in the user's order."""
    shape = shape_of(state.position[0])
    masks = (jnp.ones(shape, bool) if m is None else jnp.broadcast_to(m, shape) for m in system.free_masks(state.dim))
    return jnp.stack([state.layout.flatten(m) for m in masks], axis=-1).ravel()


def _masses(system: Nodes, state: State) -> Array:
    """(N D,) masses in the user's order [kg]."""
    mass = state.layout.flatten(jnp.broadcast_to(system.mass.astype(state.dtype), state.position.shape))
    return jnp.repeat(mass, state.dim)


def _slack(state: State) -> float:
    """Difference of two matrices, over their size, that rounding explains."""
    return float(jnp.finfo(state.dtype).eps) ** 0.5


__all__ = ["Modes", "frequency_response", "normal_modes"]
