"""Other programs on the same fluid: jax-md, Warp's hash grid, a cell list in numba. Each is left out where it is not installed.

Each gives a function of no arguments that computes the forces with whatever list it keeps ready, and one that returns them (N, 3).
Lennard-Jones with epsilon = sigma = 1, its force shifted to zero at the cut-off, in open space.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Peer = tuple[Callable[[], Any], Callable[[], np.ndarray]]


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


def jax_md(points: np.ndarray, reach: float, skin: float) -> Peer | None:
    """jax-md's dense neighbour list and its own pair sum, forces by its gradient; open space."""
    if load("jax_md") is None:
        return None
    energy, partition, space = (importlib.import_module(f"jax_md.{part}") for part in ("energy", "partition", "space"))
    displacement, _ = space.free()
    end = end_force(reach)

    def potential(dr: jax.Array, **_: Any) -> jax.Array:
        inverse = jnp.where(dr > 0, 1 / jnp.where(dr > 0, dr, 1), 0) ** 6
        return jnp.where((dr < reach) & (dr > 0), 4 * inverse * (inverse - 1) + end * dr, 0)

    pair = importlib.import_module("jax_md.smap").pair_neighbor_list(potential, space.canonicalize_displacement_or_metric(displacement))
    box = float(np.ptp(points, axis=0).max()) + 1
    at = jnp.asarray(points - points.min(axis=0) + 0.5, jnp.float32)
    neighbours = partition.neighbor_list(displacement, box, reach, dr_threshold=skin, fractional_coordinates=False).allocate(at)
    del energy
    force = jax.jit(lambda x, near: -jax.grad(lambda x: pair(x, neighbor=near))(x))
    return lambda: force(at, neighbours), lambda: np.asarray(force(at, neighbours))


def warp(points: np.ndarray, reach: float, skin: float) -> Peer | None:
    """Warp's hash grid on the CPU, queried by each particle; the grid is built before, as the lists are."""
    wp = load("warp")
    if wp is None:
        return None
    from . import fluid_warp

    return fluid_warp.make(wp, points, reach)


def numba(points: np.ndarray, reach: float, skin: float) -> Peer | None:
    """A list of neighbours in a compressed table, full, one core of numba; particles sorted by cell as here."""
    nb = load("numba")
    if nb is None:
        return None
    from scipy.spatial import cKDTree

    order = np.lexsort(np.floor(points / (reach + skin)).T)
    at = points[order].astype(np.float32)
    pairs = cKDTree(at).query_pairs(reach + skin, output_type="ndarray")
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))].astype(np.int32)
    start = np.searchsorted(both[:, 0], np.arange(len(at) + 1)).astype(np.int32)
    end, out = np.float32(end_force(reach)), np.zeros_like(at)

    @nb.njit(fastmath=True)
    def forces(at, start, heads, out):
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

    heads = np.ascontiguousarray(both[:, 1])

    def in_order() -> np.ndarray:
        forces(at, start, heads, out)
        result = np.empty_like(out)
        result[order] = out
        return result

    return lambda: forces(at, start, heads, out), in_order
