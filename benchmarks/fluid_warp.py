"""The fluid by Warp's hash grid. A file of its own: Warp reads a kernel's source and its annotations."""

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


def make(wp: Any, points: np.ndarray, reach: float) -> Any:
    """Forces with a grid that is ready, and the forces themselves."""
    from .fluid_peers import end_force

    wp.config.quiet = True
    wp.init()
    n = len(points)
    at = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    out = wp.zeros(n, dtype=wp.vec3, device="cpu")
    cells = max(8, min(128, int(np.ptp(points, axis=0).max() / reach) + 2))
    grid = wp.HashGrid(cells, cells, cells, device="cpu")
    grid.build(at, reach)

    def run() -> None:
        wp.launch(lennard_jones, dim=n, inputs=[grid.id, at, reach, end_force(reach), out], device="cpu")

    def forces() -> np.ndarray:
        run()
        return out.numpy()

    return run, forces
