"""The scenes that are timed, and the bare hand-written scans that they are compared with."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxspring as js

FAMILIES = js.STRUCTURAL + js.SHEAR + js.BEND


def sheet(n: int, seed: int = 0) -> tuple[js.System, js.State]:
    """An n x n cloth in space, structural + shear + bend, a little out of place, float32."""
    rng = np.random.default_rng(seed)
    net = js.lattice((n, n), springs=FAMILIES)
    flat = np.concatenate([net.grid(), np.zeros((n * n, 1))], axis=1)
    rest = np.linalg.norm(flat[net.edges[:, 1]] - flat[net.edges[:, 0]], axis=1)
    return _hung(net, flat, rest, rng)


def mesh(n_nodes: int, seed: int = 0) -> tuple[js.System, js.State]:
    """Random points in a square, joined by Delaunay's triangulation, in space, float32."""
    rng = np.random.default_rng(seed)
    points = rng.random((n_nodes, 2)) * np.sqrt(n_nodes)
    return graph(np.concatenate([points, np.zeros((n_nodes, 1))], axis=1), delaunay_edges(points), rng)


def delaunay_edges(points: np.ndarray) -> np.ndarray:
    """(E, 2) edges of Delaunay's triangulation of (N, 2) or (N, 3) points."""
    from scipy.spatial import Delaunay

    corners = Delaunay(points).simplices
    pairs = [corners[:, [i, j]] for i in range(corners.shape[1]) for j in range(i)]
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def graph(points: np.ndarray, edges: np.ndarray, rng: np.random.Generator | None = None) -> tuple[js.System, js.State]:
    """Springs along (E, 2) edges between (N, 3) points, at rest there, pushed about a little; float32."""
    net = js.Graph.from_edges(edges, len(points))
    rest = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
    return _hung(net, points, rest, np.random.default_rng(0) if rng is None else rng, noise=0.01)


def _hung(net: Any, flat: np.ndarray, rest: np.ndarray, rng: np.random.Generator, noise: float = 0.05) -> tuple[js.System, js.State]:
    stiffness = (1 + 0.1 * rng.random(net.n_springs)).astype(np.float32)
    points = (flat + noise * rng.standard_normal(flat.shape)).astype(np.float32)
    system = js.System(net, mass=np.float32(1), forces=js.Springs(net, stiffness, rest.astype(np.float32)))
    return system, js.State.from_points(net, points)


def springs_of(system: js.System) -> js.Springs:
    """The springs of a scene, its first force."""
    (springs, *_) = (force for force in system.forces if isinstance(force, js.Springs))
    return springs


def rollout_positions(system: js.System, state: js.State, dt: Any, n_steps: int) -> js.Result:
    """A rollout as a user calls it, with its statuses on."""
    return js.rollout(system, state, js.SymplecticEuler(), dt, n_steps)


def program(system: js.System, state: js.State, dt: Any, n_steps: int) -> tuple[Any, tuple[Any, ...]]:
    """The rollout as a jitted function of arrays, and its arguments."""
    arrays, static = eqx.partition(system, eqx.is_array)

    def run(arrays: Any, state: js.State, dt: Any) -> js.Result:
        return rollout_positions(eqx.combine(arrays, static), state, dt, n_steps)

    return jax.jit(run), (arrays, state, dt)


def gradient_program(system: js.System, state: js.State, dt: Any, n_steps: int, observe: bool = False) -> tuple[Any, tuple[Any, ...]]:
    """The gradient of the sum of squared last positions with respect to every k and l, passed flat in the user's order."""
    arrays, static = eqx.partition(system, eqx.is_array)
    springs = springs_of(system)
    constants = (springs.stiffness, springs.rest_length)

    def loss(constants: Any, arrays: Any, state: js.State, dt: Any) -> Any:
        whole = eqx.combine(arrays, static)
        changed = eqx.tree_at(lambda s: (s.forces[0].stiffness, s.forces[0].rest_length), whole, constants)
        if observe:
            heights = js.rollout(changed, state, js.SymplecticEuler(), dt, n_steps, save_every=1, observe=_height).saved
            return jnp.sum(heights)
        last = rollout_positions(changed, state, dt, n_steps).state.position
        return sum(jnp.sum(a * a) for a in last)

    return jax.jit(jax.grad(loss)), (constants, arrays, state, dt)


def _height(state: js.State) -> jax.Array:
    return jnp.mean(state.position.z * state.position.z)


def bare_sheet(system: js.System, n_steps: int) -> Any:
    """The same arithmetic by hand: component arrays, shifted slices, padded sums, the unguarded k (1 - l rsqrt), nothing else."""
    net = system.net
    assert isinstance(net, js.Lattice)
    shapes = [tuple(n - abs(o) for n, o in zip(net.shape, offset, strict=True)) for offset in net.offsets]
    sizes = np.cumsum([0, *(int(np.prod(s)) for s in shapes)])

    def cut(flat: Any) -> list[Any]:
        return [jnp.asarray(flat[a:b]).reshape(s) for a, b, s in zip(sizes[:-1], sizes[1:], shapes, strict=True)]

    springs = springs_of(system)
    k, l = cut(springs.stiffness), cut(springs.rest_length)

    def step(carry: Any, k: Any, l: Any, dt: Any) -> Any:
        x, v = carry
        force = [jnp.zeros_like(a) for a in x]
        for offset, ki, li in zip(net.offsets, k, l, strict=True):
            d = [_slice(a, offset, net.shape, head=True) - _slice(a, offset, net.shape, head=False) for a in x]
            w = ki * (1 - li * lax.rsqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]))
            force = [f + _pad(w * a, offset) for f, a in zip(force, d, strict=True)]
        v = [a + dt * f for a, f in zip(v, force, strict=True)]
        return [a + dt * b for a, b in zip(x, v, strict=True)], v

    def run(x: Any, v: Any, k: Any, l: Any, dt: Any) -> Any:
        return lax.scan(lambda c, _: (step(c, k, l, dt), None), (x, v), None, length=n_steps)[0][0]

    return jax.jit(run), k, l


def bare_edge_list(edges: np.ndarray, n_steps: int) -> Any:
    """The usual first program: stacked (N, 3) positions, an edge list, and `.at[].add`."""

    def force(x: Any, k: Any, l: Any) -> Any:
        d = x[edges[:, 1]] - x[edges[:, 0]]
        pull = (k * (1 - l * lax.rsqrt(jnp.sum(d * d, axis=1))))[:, None] * d
        return jnp.zeros_like(x).at[edges[:, 0]].add(pull).at[edges[:, 1]].add(-pull)

    def run(x: Any, v: Any, k: Any, l: Any, dt: Any) -> Any:
        def step(carry: Any, _: None) -> Any:
            x, v = carry
            v = v + dt * force(x, k, l)
            return (x + dt * v, v), None

        return lax.scan(step, (x, v), None, length=n_steps)[0][0]

    return jax.jit(run)


def bare_mesh(system: js.System, state: js.State, dt: Any, n_steps: int) -> tuple[Any, tuple[Any, ...]]:
    """Component arrays on the graph's own order, gathers and scatter-add, unguarded; and the arguments."""
    net, springs = system.net, springs_of(system)
    assert isinstance(net, js.Graph)
    tails, heads = net.ends.tails, net.ends.heads
    k, l = (net.split(a).families[0] for a in (springs.stiffness, springs.rest_length))

    def run(x: Any, v: Any, k: Any, l: Any, dt: Any) -> Any:
        def step(carry: Any, _: None) -> Any:
            x, v = carry
            d = [a[heads] - a[tails] for a in x]
            w = k * (1 - l * lax.rsqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]))
            force = [jnp.zeros_like(a).at[tails].add(w * b).at[heads].add(-(w * b)) for a, b in zip(x, d, strict=True)]
            v = [a + dt * f for a, f in zip(v, force, strict=True)]
            return ([a + dt * b for a, b in zip(x, v, strict=True)], v), None

        return lax.scan(step, (x, v), None, length=n_steps)[0][0]

    return jax.jit(run), (list(state.position), list(state.velocity), k, l, dt)


def numpy_positions(system: js.System, state: js.State, dt: float, n_steps: int) -> np.ndarray:
    """The same steps in NumPy and float64, by bincount: the reference for every error quoted."""
    springs = springs_of(system)
    tail, head = system.net.edges.T
    k, l = (np.asarray(a, float) for a in (springs.stiffness, springs.rest_length))
    x, v = (np.asarray(a, float) for a in (state.points, state.velocities))
    for _ in range(n_steps):
        d = x[head] - x[tail]
        pull = (k * (1 - l / np.linalg.norm(d, axis=1)))[:, None] * d
        for i in range(3):
            v[:, i] += dt * (np.bincount(tail, pull[:, i], len(x)) - np.bincount(head, pull[:, i], len(x)))
        x += dt * v
    return x


def _slice(a: Any, offset: tuple[int, ...], shape: tuple[int, ...], *, head: bool) -> Any:
    cut = []
    for o, n in zip(offset, shape, strict=True):
        o = o if head else -o
        cut.append(slice(max(o, 0), n + min(o, 0)))
    return a[tuple(cut)]


def _pad(p: Any, offset: tuple[int, ...]) -> Any:
    zero = np.zeros((), p.dtype)
    tail = lax.pad(p, zero, [(max(-o, 0), max(o, 0), 0) for o in offset])
    return tail - lax.pad(p, zero, [(max(o, 0), max(-o, 0), 0) for o in offset])
