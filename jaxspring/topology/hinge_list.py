"""Which two triangles meet at which edge: hinges of a mesh, found on the host.

An edge that three triangles share has no angle, and is refused. The windings of the triangles need not agree, and the mesh may have one
side only, as a Moebius strip: each hinge is oriented by itself, by the triangle of the lower number.
"""

from __future__ import annotations

import numpy as np


def hinges_of(triangles: np.ndarray) -> np.ndarray:
    """(T, 3) triangles -> (H, 4) nodes of the hinges: the edge from a to b, as the triangle of the lower number goes round it, that
    triangle's third corner, and the other's. In the order of the edges, lower node first.

    Raises:
        ValueError: an edge of three triangles or more, a triangle given twice, a mesh without a hinge.
    """
    n = len(triangles)
    sides = np.concatenate([np.roll(triangles, -i, axis=1) for i in range(3)])
    owner = np.tile(np.arange(n), 3)
    low, high = np.sort(sides[:, :2], axis=1).T
    order = np.lexsort((owner, high, low))
    sides, owner = sides[order], owner[order]
    _, start, count = np.unique(np.stack([low, high])[:, order], axis=1, return_index=True, return_counts=True)
    if (count > 2).any():
        first = start[np.argmax(count > 2)]
        several = owner[first : first + count[np.argmax(count > 2)]].tolist()
        raise ValueError(
            f"the edge between nodes {sides[first, 0]} and {sides[first, 1]} belongs to {len(several)} triangles, numbers {several}: a "
            f"hinge joins two. Leave triangles out, or give the sheets that meet there nodes of their own and join them by springs."
        )
    one, other = start[count == 2], start[count == 2] + 1
    hinges = np.concatenate([sides[one], sides[other][:, 2:]], axis=1)
    same = hinges[:, 2] == hinges[:, 3]
    if same.any():
        i = int(np.argmax(same))
        raise ValueError(
            f"triangles {owner[one[i]]} and {owner[other[i]]} have the same three corners, {sorted(hinges[i, :3].tolist())}: a hinge "
            f"between them would be folded flat. Leave one of them out."
        )
    if not len(hinges):
        raise ValueError(f"no two of the {n} triangles share an edge, so that there is no hinge. Triangles share nodes by their numbers.")
    return hinges


__all__ = ["hinges_of"]
