"""Is this checkout slower than another one?

    git worktree add ../before v0.1.0
    python -m benchmarks.against ../before [--workload NAME ...] [--rounds 9]

Three processes hold the same workloads: this checkout, this checkout once more, and the other one. They take turns, one run each per
round. Read: `ratio` is the time of this checkout over the other's, the median of the rounds' pairs, with the lowest and the highest;
`itself` is the same for this checkout against itself, so that its spread says what the machine alone does. A workload counts as slower
where its median is above 1.03 and above the spread of `itself`; then the exit code is 1. `compile` is the same ratio of the seconds to
trace, compile and run once (`compile_s`; of a gradient `first_gradient_s`), of as many first runs as `--first` says, each after all
programs were dropped.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SLOWER = 1.03
FIRST = "first "


def workloads() -> dict[str, Callable[[], Callable[[], Any]]]:
    """Name -> a function that builds the workload and returns what is timed. Only names that both checkouts have."""
    import jaxspring as js
    from benchmarks import explicit, scenes

    def rollout(make: Any, size: int, n_steps: int) -> Any:
        system, state = make(size)
        return lambda: scenes.rollout_positions(system, state, explicit.DT, n_steps)

    def gradient(make: Any, size: int, n_steps: int) -> Any:
        system, state = make(size)
        function, arrays = scenes.gradient_program(system, state, explicit.DT, n_steps)
        return lambda: function(*arrays)

    def implicit(size: int, n_steps: int) -> Any:
        system, state = scenes.sheet(size)
        return lambda: js.rollout(system, state, js.BackwardEuler(), 1.0, n_steps)

    def fluid(n: int, n_steps: int) -> Any:
        import numpy as np

        rng = np.random.default_rng(0)
        side = round(n ** (1 / 3))
        grid = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3) * 1.1
        points = (grid + 0.05 * rng.standard_normal(grid.shape)).astype(np.float32)
        net = js.Graph.from_edges(np.zeros((0, 2), int), len(points))
        named: Any = getattr(js, "fluid", js)  # an older checkout has these names at the top
        law = js.Fluid(named.LennardJones(1.0, 1.0), named.ShiftedForce(2.5), named.NeighbourList(capacity=96, skin=0.3))
        system = js.System(net, 1.0, law)
        state = js.State.from_points(net, points)
        return lambda: js.rollout(system, state, js.VelocityVerlet(), 2e-3, n_steps)

    kinds = {"rollout": rollout, "gradient": gradient}
    steps = {
        ("rollout", "lattice"): {32: 1000, 128: 1000, 512: 400},
        ("rollout", "mesh"): {1000: 1000, 10_000: 300, 100_000: 50},
        ("gradient", "lattice"): {32: 1000, 128: 400, 512: 50},
        ("gradient", "mesh"): {1000: 1000, 10_000: 100, 100_000: 20},
    }
    makers = {"lattice": scenes.sheet, "mesh": scenes.mesh}
    table = {
        f"{kind} {shape} {size}": lambda kind=kind, shape=shape, size=size, n=n: kinds[kind](makers[shape], size, n)
        for (kind, shape), sizes in steps.items()
        for size, n in sizes.items()
    }
    return {**table, "implicit lattice 64": lambda: implicit(64, 20), "fluid 8000": lambda: fluid(8000, 20)}


def serve() -> None:
    """Answer each line, a name, with the seconds of one run; after "first" with those of a run that compiles."""
    import jax

    from jaxspring.progress import Stopwatch

    table, built = workloads(), {}
    print(json.dumps(sorted(table)), flush=True)
    for line in sys.stdin:
        is_first, name = line.startswith(FIRST), line.removeprefix(FIRST).strip()
        if name not in built:
            built.clear()  # one workload at a time stays in memory
            built[name] = table[name]()
        if is_first:
            jax.clear_caches()
        clock = Stopwatch()
        jax.block_until_ready(built[name]())
        print(clock.seconds, flush=True)


class Worker:
    """A process that holds the workloads of one checkout."""

    def __init__(self, root: Path):
        path = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
        command = [sys.executable, str(Path(__file__).resolve()), "--serve"]
        environment = {**os.environ, "PYTHONPATH": path}
        self.process = subprocess.Popen(command, cwd=root, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.names = json.loads(self._line())

    def seconds(self, name: str) -> float:
        """One run of the workload."""
        print(name, file=self.process.stdin, flush=True)
        return float(self._line())

    def _line(self) -> str:
        line = self.process.stdout.readline() if self.process.stdout else ""
        if not line:
            raise SystemExit("a process of the comparison ended early; its message stands above")
        return line


def compare(names: list[str], other: Path, rounds: int, n_first: int) -> list[dict[str, Any]]:
    """One row per workload."""
    import numpy as np

    def seconds(prefix: str, name: str) -> list[float]:
        return [worker.seconds(prefix + name) for worker in (there, here, again)]

    here, again, there = Worker(ROOT), Worker(ROOT), Worker(other)
    rows = []
    for name in names or [n for n in here.names if n in there.names]:
        seconds(FIRST, name)  # what a process does once
        first = np.array([seconds(FIRST, name) for _ in range(n_first)])
        taken = np.array([seconds("", name) for _ in range(rounds)])
        ratios, itself = taken[:, 1] / taken[:, 0], taken[:, 2] / taken[:, 1]
        row = {
            "workload": name,
            "seconds": float(np.median(taken[:, 1])),
            "ratio": float(np.median(ratios)),
            "low": float(ratios.min()),
            "high": float(ratios.max()),
            "itself": float(np.median(itself)),
            "itself_low": float(itself.min()),
            "itself_high": float(itself.max()),
            "compile": float(np.median(first[:, 1] / first[:, 0])),
            "compile_itself": float(np.median(first[:, 2] / first[:, 1])),
            "compile_s": None if name.startswith("gradient") else float(np.median(first[:, 1])),
            "first_gradient_s": float(np.median(first[:, 1])) if name.startswith("gradient") else None,
        }
        row["slower"] = bool(row["ratio"] > max(SLOWER, row["itself_high"], 1 / row["itself_low"]))
        rows.append(row)
        print(f"{name}: {row['ratio']:.3f} ({row['low']:.3f} to {row['high']:.3f}), compile {row['compile']:.2f}", flush=True)
    return rows


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Ratios with their spread, and the spread of the checkout against itself behind them."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 0.35 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    for i, row in enumerate(rows):
        axes.plot([row["itself_low"], row["itself_high"]], [i, i], color="0.8", linewidth=8, solid_capstyle="butt")
        axes.plot([row["low"], row["high"]], [i, i], color="C0")
        axes.plot(row["ratio"], i, "o", color="C3" if row["slower"] else "C0")
    axes.axvline(1.0, color="0.5", linewidth=0.8)
    axes.axvline(SLOWER, color="0.5", linewidth=0.8, linestyle="--")
    axes.set_yticks(range(len(rows)), [row["workload"] for row in rows])
    axes.set_xlabel("time of this checkout / time of the other (grey: this checkout against itself)")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Serve, or measure, print, write the table and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, nargs="?", help="the folder of the other checkout")
    parser.add_argument("--workload", action="append", help="only this one; may be given again")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--first", type=int, default=3, help="runs that compile")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve()
        return
    if given.other is None or not (given.other / "jaxspring").is_dir():
        parser.error("name the folder of another checkout of this project")
    from benchmarks.measure import show, write

    rows = compare(given.workload, given.other.resolve(), given.rounds, given.first)
    show("this checkout against the other", rows)
    picture(rows, write("against", {"rounds": given.rounds}, {"rows": rows}).with_suffix(".png"))
    sys.exit(any(row["slower"] for row in rows))


if __name__ == "__main__":
    main()
