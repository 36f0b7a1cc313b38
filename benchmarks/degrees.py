"""How fast is a graph, by how many springs its nodes have?

    python -m benchmarks.degrees [--quick]

Nets of about 1e4 nodes (--quick: 1e3), symplectic Euler, float32: Delaunay in two and three dimensions, random points within a radius (12
and 30 springs at a node, on average), a power law (each new node joins three older ones, by their number of springs), a star, a chain, a
binary tree. Read: `M springs` is million spring-steps a second with statuses on; `over_bare` the time over that of the bare scan, which
gathers both ends and adds by scatter; `gradient` the time of the gradient by every k and l over that of the rollout; `padded` the share of
the entries that hold no spring.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from . import scenes
from .measure import Case, Panel, arguments, draw, measure, show, write

DT = np.float32(0.02)


def nets(n: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name -> points (N, 3) and edges (E, 2)."""
    rng = np.random.default_rng(0)
    flat, solid = rng.random((n, 2)) * n**0.5, rng.random((n, 3)) * n ** (1 / 3)
    flat = np.pad(flat, ((0, 0), (0, 1)))
    around = {k: _within(flat, (k / np.pi) ** 0.5) for k in (12, 30)}
    return {
        "Delaunay 2-D": (flat, scenes.delaunay_edges(flat[:, :2])),
        "Delaunay 3-D": (solid, scenes.delaunay_edges(solid)),
        "radius, 12": (flat, around[12]),
        "radius, 30": (flat, around[30]),
        "power law": (flat, _power_law(n, rng)),
        "star": (flat, np.stack([np.zeros(n - 1, int), np.arange(1, n)], axis=1)),
        "chain": (flat, np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)),
        "tree": (flat, np.stack([(np.arange(1, n) - 1) // 2, np.arange(1, n)], axis=1)),
    }


def _within(points: np.ndarray, reach: float) -> np.ndarray:
    from scipy.spatial import KDTree

    return KDTree(points).query_pairs(reach, output_type="ndarray")


def _power_law(n: int, rng: np.random.Generator) -> np.ndarray:
    ends = [0, 1, 1, 2, 2, 0]
    for i in range(3, n):
        for j in sorted({ends[k] for k in rng.integers(0, len(ends), 3)}):
            ends += [i, j]
    return np.reshape(ends, (-1, 2))


def rows(n: int, n_steps: int, rounds: int) -> list[dict]:
    """One row per net."""
    found = []
    for name, (points, edges) in nets(n).items():
        system, state = scenes.graph(points, edges)
        net: Any = system.net
        entries, classes = net.ends.entries.size, len(net.ends.classes)
        timed = measure(
            [
                Case("bare", *scenes.bare_mesh(system, state, DT, n_steps)),
                Case("rollout", *scenes.program(system, state, DT, n_steps)),
                Case("gradient", *scenes.gradient_program(system, state, DT, n_steps)),
            ],
            rounds,
        )
        run = timed["rollout"].run_s
        found.append(
            {
                "net": name,
                "nodes": n,
                "springs": len(edges),
                "most": int(np.bincount(edges.ravel()).max()),
                "classes": classes,
                "padded": 1 - 2 * len(edges) / entries,
                "M springs": len(edges) * n_steps / run / 1e6,
                "over_bare": run / timed["bare"].run_s,
                "gradient": timed["gradient"].run_s / run,
                "compile_s": timed["rollout"].compile_s,
                "first_gradient_s": timed["gradient"].first_s,
            }
        )
        show(name, found[-1:])
    return found


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    n, n_steps, rounds = (1000, 200, 3) if quick else (10_000, 200, 5)
    table = rows(n, n_steps, rounds)
    show("graphs by their springs", table)
    path = write("degrees", {"dt": DT, "dtype": "float32", "rounds": rounds, "steps": n_steps}, {"graphs": table})
    picture(table, path.with_suffix(".png"))


def picture(table: list[dict], path: Path) -> None:
    """Rate and cost of the gradient against springs per node."""
    mean = [2 * row["springs"] / row["nodes"] for row in table]
    order = np.argsort(mean)
    of = {key: [table[i][key] for i in order] for key in ("M springs", "gradient")}
    at = [mean[i] for i in order]
    bare = [table[i]["M springs"] * table[i]["over_bare"] for i in order]
    rate = {("rollout, statuses on", "o"): (at, of["M springs"]), ("bare scan, scatter-add", "^"): (at, bare)}
    cost = {("gradient by every k and l", "o"): (at, of["gradient"])}
    panels = [
        Panel(f"graphs of {table[0]['nodes']} nodes", "million spring-steps / s", rate, log=True, xlabel="springs at a node, mean"),
        Panel("cost of the gradient", "time / rollout", cost, xlabel="springs at a node, mean"),
    ]
    draw(panels, path)


if __name__ == "__main__":
    main()
