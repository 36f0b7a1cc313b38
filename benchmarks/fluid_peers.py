"""Other programs on the same fluid: jax-md, Warp's hash grid, a cell list in numba. Each is left out where it is not installed.

Lennard-Jones with epsilon = sigma = 1, unit masses, its force shifted to zero at the cut-off, in open space. Full steps: velocity Verlet.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Peer(NamedTuple):
    """Another program, ready to run.

    Attributes:
        force: computes the forces with whatever list it keeps ready.
        forces: the same as an array (N, 3).
        steps: (dt, n_steps) -> a function that takes these steps from the start, its list remade when it must be, and gives the points
            (N, 3) and how often it was remade.
    """

    force: Callable[[], Any]
    forces: Callable[[], np.ndarray]
    steps: Callable[[float, int], Callable[[], tuple[Any, int]]]


def end_force(reach: float) -> float:
    """Force of the law at the cut-off [N]."""
    return 24 * (2 * reach**-12 - reach**-6) / reach


def load(name: str) -> Any | None:
    """A module, or None where it cannot be imported."""
    try:
        return importlib.import_module(name)
    except Exception as error:  # a peer made for another jax may fail in any way
        print(f"  {name} is left out: {type(error).__name__}: {error}")
        return None


def jax_md(points: np.ndarray, speeds: np.ndarray, reach: float, skin: float) -> Peer | None:
    """The dense neighbour list of jax-md and its own pair sum, forces by its gradient; open space."""
    if load("jax_md") is None:
        return None
    partition, space = (importlib.import_module(f"jax_md.{part}") for part in ("partition", "space"))
    displacement, _ = space.free()
    end = end_force(reach)

    def potential(dr: jax.Array, **_: Any) -> jax.Array:
        inverse = jnp.where(dr > 0, 1 / jnp.where(dr > 0, dr, 1), 0) ** 6
        return jnp.where((dr < reach) & (dr > 0), 4 * inverse * (inverse - 1) + end * dr, 0)

    pair = importlib.import_module("jax_md.smap").pair_neighbor_list(potential, space.canonicalize_displacement_or_metric(displacement))
    margin = 2.0
    box = float(np.ptp(points, axis=0).max()) + 2 * margin
    corner = points.min(axis=0) - margin
    at, speed = jnp.asarray(points - corner, jnp.float32), jnp.asarray(speeds, jnp.float32)
    neighbours = partition.neighbor_list(displacement, box, reach, dr_threshold=skin, fractional_coordinates=False).allocate(at)

    def acceleration(x: jax.Array, near: Any) -> jax.Array:
        return -jax.grad(lambda x: pair(x, neighbor=near))(x)

    force = jax.jit(acceleration)

    def steps(dt: float, n_steps: int) -> Callable[[], tuple[Any, int]]:
        def step(_: Any, state: Any) -> Any:
            x, v, a, near, remade = state
            x = x + dt * v + dt * dt / 2 * a
            fresh = near.update(x)
            new = acceleration(x, fresh)
            remade = remade + jnp.any(fresh.reference_position != near.reference_position).astype(jnp.int32)
            return x, v + dt / 2 * (a + new), new, fresh, remade

        @jax.jit
        def whole(x: jax.Array, v: jax.Array, near: Any) -> Any:
            return jax.lax.fori_loop(0, n_steps, step, (x, v, acceleration(x, near), near, jnp.asarray(0, jnp.int32)))

        def run() -> tuple[Any, int]:
            x, _, _, near, remade = jax.block_until_ready(whole(at, speed, neighbours))
            if bool(near.did_buffer_overflow):
                raise RuntimeError("jax-md's list overflowed: its steps are wrong.")
            return np.asarray(x) + corner, int(remade)

        return run

    return Peer(lambda: force(at, neighbours), lambda: np.asarray(force(at, neighbours)), steps)


def warp(points: np.ndarray, speeds: np.ndarray, reach: float, skin: float) -> Peer | None:
    """Warp's hash grid on the CPU, queried by each particle; built before, as the lists are, and in full steps anew in each."""
    wp = load("warp")
    if wp is None:
        return None
    from . import fluid_warp

    return fluid_warp.make(wp, points, speeds, reach)


def numba(points: np.ndarray, speeds: np.ndarray, reach: float, skin: float) -> Peer | None:
    """A full list of neighbours in a compressed table, made by SciPy's tree, one core of numba; particles sorted by cell as here."""
    nb = load("numba")
    if nb is None:
        return None
    from scipy.spatial import KDTree

    order = np.lexsort(np.floor(points / (reach + skin)).T)
    start_at, start_speed = points[order].astype(np.float32), speeds[order].astype(np.float32)
    end = np.float32(end_force(reach))

    @nb.njit(fastmath=True)
    def fill(at, start, heads, out):
        one, two, twenty_four = np.float32(1), np.float32(2), np.float32(24)
        for i in range(len(at)):
            fx = fy = fz = np.float32(0)
            for k in range(start[i], start[i + 1]):
                j = heads[k]
                x, y, z = at[i, 0] - at[j, 0], at[i, 1] - at[j, 1], at[i, 2] - at[j, 2]
                squared = x * x + y * y + z * z
                if squared < np.float32(reach * reach):
                    inverse = one / squared
                    sixth = inverse * inverse * inverse
                    w = twenty_four * inverse * sixth * (two * sixth - one) - end * np.sqrt(inverse)
                    fx, fy, fz = fx + w * x, fy + w * y, fz + w * z
            out[i, 0], out[i, 1], out[i, 2] = fx, fy, fz

    def find(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = KDTree(at).query_pairs(reach + skin, output_type="ndarray")
        both = np.concatenate([pairs, pairs[:, ::-1]])
        both = both[np.lexsort((both[:, 1], both[:, 0]))].astype(np.int32)
        return np.searchsorted(both[:, 0], np.arange(len(at) + 1)).astype(np.int32), np.ascontiguousarray(both[:, 1])

    def unsorted(values: np.ndarray) -> np.ndarray:
        result = np.empty_like(values)
        result[order] = values
        return result

    ready, out = find(start_at), np.zeros_like(start_at)

    def forces() -> np.ndarray:
        fill(start_at, *ready, out)
        return unsorted(out)

    def steps(given_dt: float, n_steps: int) -> Callable[[], tuple[Any, int]]:
        dt = np.float32(given_dt)

        def run() -> tuple[Any, int]:
            x, v, near, reference, remade = start_at.copy(), start_speed.copy(), ready, start_at, 0
            old, new = np.zeros_like(x), np.zeros_like(x)
            fill(x, *near, old)
            for _ in range(n_steps):
                x += dt * v + dt * dt / 2 * old
                if np.max(np.sum((x - reference) ** 2, axis=1)) > (skin / 2) ** 2:
                    near, reference, remade = find(x), x.copy(), remade + 1
                fill(x, *near, new)
                v += dt / 2 * (old + new)
                old, new = new, old
            return unsorted(x), remade

        return run

    return Peer(lambda: fill(start_at, *ready, out), forces, steps)
