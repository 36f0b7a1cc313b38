"""The fluid by Warp's hash grid. A file of its own: Warp reads a kernel's source and its annotations."""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp


@wp.kernel
def lennard_jones(grid: wp.uint64, at: wp.array(dtype=wp.vec3), reach: float, end: float, out: wp.array(dtype=wp.vec3)):
    """Force on one particle from all nearer than the cut-off."""
    i = wp.hash_grid_point_id(grid, wp.tid())
    x = at[i]
    total = wp.vec3(0.0, 0.0, 0.0)
    for j in wp.hash_grid_query(grid, x, reach):
        d = x - at[j]
        squared = wp.dot(d, d)
        if j != i and squared < reach * reach:
            inverse = 1.0 / squared
            sixth = inverse * inverse * inverse
            total += (24.0 * inverse * sixth * (2.0 * sixth - 1.0) - end * wp.sqrt(inverse)) * d
    out[i] = total


@wp.kernel
def drift(at: wp.array(dtype=wp.vec3), speed: wp.array(dtype=wp.vec3), force: wp.array(dtype=wp.vec3), dt: float):
    """First half of a step of velocity Verlet: half a kick and a drift."""
    i = wp.tid()
    speed[i] = speed[i] + 0.5 * dt * force[i]
    at[i] = at[i] + dt * speed[i]


@wp.kernel
def kick(speed: wp.array(dtype=wp.vec3), force: wp.array(dtype=wp.vec3), dt: float):
    """Second half of a step: half a kick."""
    i = wp.tid()
    speed[i] = speed[i] + 0.5 * dt * force[i]


def make(wp: Any, points: np.ndarray, speeds: np.ndarray, reach: float) -> Any:
    """Forces with a grid that is ready, the forces themselves, and full steps."""
    from .fluid_peers import Peer, end_force

    wp.config.quiet = True
    wp.init()
    n = len(points)
    start_at, start_speed = (wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (points, speeds))
    out = wp.zeros(n, dtype=wp.vec3, device="cpu")
    cells = max(8, min(128, int(np.ptp(points, axis=0).max() / reach) + 2))

    def new_grid() -> Any:
        grid = wp.HashGrid(cells, cells, cells, device="cpu")
        grid.build(start_at, reach)
        return grid

    ready = new_grid()

    def fill(grid: Any, at: Any, out: Any) -> None:
        wp.launch(lennard_jones, dim=n, inputs=[grid.id, at, reach, end_force(reach), out], device="cpu")

    def forces() -> np.ndarray:
        fill(ready, start_at, out)
        return out.numpy()

    def steps(dt: float, n_steps: int) -> Callable[[], tuple[Any, int]]:
        grid = new_grid()

        def run() -> tuple[Any, int]:
            at, speed, force = wp.clone(start_at), wp.clone(start_speed), wp.zeros(n, dtype=wp.vec3, device="cpu")
            grid.build(at, reach)
            fill(grid, at, force)
            for _ in range(n_steps):
                wp.launch(drift, dim=n, inputs=[at, speed, force, dt], device="cpu")
                grid.build(at, reach)
                fill(grid, at, force)
                wp.launch(kick, dim=n, inputs=[speed, force, dt], device="cpu")
            return at.numpy(), n_steps

        return run

    return Peer(lambda: fill(ready, start_at, out), forces, steps)
