"""The body of a robot: square or cubic cells, as drawn, and a spring between every two corners of a cell.

sides        along the axes, one actuator each
diagonals    of faces and cubes, which nobody drives: they keep the cells from folding
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ...forces.actuation import PASSIVE
from ...topology.graph import Graph

CELL = "#"


@dataclass(frozen=True)
class Body:
    """A net with the places of its nodes and the actuators of its springs.

    Attributes:
        net: the springs.
        points: (N, D) at rest [m]: x along the way, the last coordinate up, the lowest nodes at zero.
        groups: (E,) actuator of each spring, -1 where it has none.
    """

    net: Graph
    points: np.ndarray
    groups: np.ndarray


def body_of_cells(drawing: tuple[str, ...], size: float, depth: int = 0) -> Body:
    """The body in a drawing.

    Args:
        drawing: rows of cells from the top down, `#` where there is a cell: `("####", "#..#")` is a back on two legs.
        size: of a cell [m].
        depth: cells across the way; 0 makes the body flat, in two dimensions.

    Returns:
        A `Body`: net, points [m], and the actuator of each spring.

    Raises:
        ValueError: no cell, rows of different length, other characters, a negative depth.

    >>> body = body_of_cells(("##",), size=0.1)
    >>> print(body.points.shape, body.net.n_springs, body.groups.max() + 1)
    (6, 2) 11 7
    """
    _check(drawing, depth)
    rows = len(drawing)
    flat = [(column, rows - 1 - row) for row, line in enumerate(drawing) for column, mark in enumerate(line) if mark == CELL]
    cells = flat if depth == 0 else [(x, y, z) for x, z in flat for y in range(depth)]
    dim = len(cells[0])
    corners = np.array(list(itertools.product((0, 1), repeat=dim)))
    nodes: dict[tuple[int, ...], int] = {}
    springs: dict[tuple[int, int], bool] = {}
    for cell in cells:
        at = [tuple(int(i) for i in corner) for corner in np.array(cell) + corners]
        for one, other in itertools.combinations(at, 2):
            tail, head = sorted(nodes.setdefault(place, len(nodes)) for place in (one, other))
            springs[tail, head] = sum(a != b for a, b in zip(one, other, strict=True)) == 1
    is_side = np.array(list(springs.values()))
    groups = np.where(is_side, np.cumsum(is_side) - 1, PASSIVE)
    points = size * np.array(list(nodes), float)
    points[:, -1] -= points[:, -1].min()
    return Body(Graph.from_edges(np.array(list(springs)), len(nodes)), points, groups)


def _check(drawing: tuple[str, ...], depth: int) -> None:
    lengths = {len(line) for line in drawing}
    marks = set("".join(drawing))
    if CELL not in marks or len(lengths) != 1 or marks - {CELL, "."}:
        raise ValueError(f"body = {drawing}; expected rows of one length of # (a cell) and . (none), with a cell, e.g. ('####', '#..#').")
    if int(depth) != depth or depth < 0:
        raise ValueError(f"depth = {depth}; expected a whole number of cells, 0 for a flat body.")


__all__ = ["Body", "body_of_cells"]
