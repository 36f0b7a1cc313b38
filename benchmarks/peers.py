"""How fast are jaxspring, other packages, and C by hand, at the same things on the same machine?

    python -m benchmarks.peers --setup                                   environments for the peers in .cache/peers, once: 5 GB, minutes
    python -m benchmarks.peers [--workload NAME ...] [--quick]

Cloths of n x n nodes (structural, shear and bend springs), Delaunay meshes, their gradients by every stiffness and rest length (loss: sum
of squared last positions), 1,024 small cloths at once, heat in a block, samples of an image and their slopes by the points, a
Lennard-Jones liquid, and implicit steps. All in float32, unit masses, symplectic Euler unless said, on two threads where a contender can
use them. jaxspring is called as a user calls it, with its statuses on.

Contenders, each a process of its own Python: Warp, Newton (its semi-implicit solver), numba, Taichi, jax-md, PyTorch, SciPy, and C that is
compiled here. Each brings every form of the workload that is known to be fast for it (`benchmarks/others/by_*.py`); the two that are
fastest in three runs take part, and of these the one with the lower median stands in the table. One run of each is timed in each round.

Read: `M` is million node-steps (points, pairs) a second, the median of the rounds, with `low` and `high` of the seconds (10 and 90 %).
`ratio` is jaxspring's time over the contender's, the median of the rounds' pairs: above 1, the contender is faster. `error` is the largest
difference from float64 NumPy after 20 steps, over the range of the result (gradients: over the largest entry). compile_s is all that
comes between imports and the second run: tables, compilation, first run; for a gradient it is called first_gradient_s. peak_mib is the
process's largest resident memory, built_mib what of it came after its imports.

Left out: MuJoCo, whose flexible bodies take no stiffness for each spring and move each node as a rigid body with three joints; PyTorch and
jax-md for springs, which have no compiled loop over steps or none of springs that is meant to be fast on a CPU.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from .measure import RESULTS, Panel, draw, show, write
from .others import environments
from .others.contest import contest
from .others.workloads import every

STYLES = {"jaxspring": "C0o-", "warp": "C1^--", "newton": "C2v--", "numba": "C3x:", "taichi": "C4s--", "c": "C5d-."}


def so_far() -> dict[str, Any]:
    """Workloads that an earlier run has written."""
    path = RESULTS / "peers.json"
    return json.loads(path.read_text())["workloads"] if path.exists() else {}


def pictures(found: dict[str, Any], path: Path) -> None:
    """Rates over sizes where there are several; bars for all else."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in found.values():
        groups.setdefault(one["group"], []).append(one)
    panels = [Panel(group, mine[0]["unit"], curves(mine), log=True) for group, mine in groups.items() if len(mine) > 1 and group != "image"]
    if panels:
        draw(panels, path)
    rest = {name: one for name, one in found.items() if len(groups[one["group"]]) == 1 or one["group"] == "image"}
    if rest:
        bars(rest, path.with_name("peers_others.png"))


def curves(found: list[dict[str, Any]]) -> dict[tuple[str, str], tuple[list[float], list[float]]]:
    """Rate of each contender over the number of nodes."""
    lines: dict[tuple[str, str], tuple[list[float], list[float]]] = {}
    for one in sorted(found, key=lambda one: one["size"]):
        for row in one["rows"]:
            sizes, rates = lines.setdefault((row["contender"], STYLES[row["contender"]]), ([], []))
            sizes.append(one["size"])
            rates.append(row["M"])
    return lines


def bars(found: dict[str, Any], path: Path) -> None:
    """One diagram a workload."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(found), 3.2), layout="constrained")
    for axes, (name, one) in zip(figure.subplots(1, len(found), squeeze=False)[0], found.items(), strict=True):
        rows = one["rows"]
        colours = ["C0" if row["contender"] == "jaxspring" else "0.7" for row in rows]
        axes.bar([row["contender"] for row in rows], [row["M"] for row in rows], color=colours)
        axes.set(title=name, ylabel=one["unit"])
        axes.tick_params(axis="x", labelrotation=45)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Set up, or measure, print, and write after every workload."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--setup", action="store_true", help="make the peers' environments, and end")
    parser.add_argument("--workload", action="extend", nargs="+", metavar="NAME", help="only these; their earlier results are replaced")
    parser.add_argument("--quick", action="store_true", help="few steps and rounds, for a look")
    given = parser.parse_args()
    if given.setup:
        environments.set_up()
        return
    table = {workload.name: workload for workload in every()}
    names = given.workload or list(table)
    unknown = sorted(set(names) - set(table))
    if unknown:
        parser.error(f"no workload {', '.join(unknown)}; there are: {', '.join(table)}")
    rounds, found = 3 if given.quick else 9, so_far()
    for name in names:
        workload = table[name]
        n_steps = workload.quick_steps if given.quick else workload.n_steps
        with tempfile.TemporaryDirectory() as folder:
            result = contest(workload, n_steps, rounds, Path(folder))
        show(f"{name}, {n_steps} steps, M in {workload.unit}", result["rows"])
        found[name] = {**result, "rounds": rounds, "quick": given.quick}
        ordered = {key: found[key] for key in table if key in found}
        path = write("peers", {"dtype": "float32", "threads": 2}, {"workloads": ordered})
        pictures(ordered, path.with_suffix(".png"))


if __name__ == "__main__":
    main()
