"""Which of the compiler's own flags pay, and what do they change?

    python -m benchmarks.flags [--quick] [--only WORD ...]

Cloths of n x n nodes (structural, shear and bend springs), symplectic Euler, float32, statuses on, and the gradient by every k and l. Each
set of flags is in `XLA_FLAGS` of a process of its own; the processes take turns, one run each per round. About six minutes on two cores.

Read, for every workload: `speed` is the time without flags over the time with them, the median of the rounds' pairs (above 1 the flags
pay), with the lowest and the highest; the second row, a further run without flags, says what the machine alone does. `compile_s` is the
seconds to trace, lower and compile, and for the gradient `first_gradient_s` with its first run. `difference` is the largest difference of
the result from that without flags, over its range (a gradient: over its largest entry); what float32 itself is off by stands in the
benchmarks `explicit` and `gradient`. `tells_nan` says whether a run that blows up still has NONFINITE in its status. A set that the
installed jaxlib does not know is left out, and its message printed.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from .measure import Panel, draw, show, write

ROOT = Path(__file__).resolve().parents[1]
PAUSE_S = 0.02  # threads of the process before that still wait in a loop are asleep after this
NONE, AGAIN = "no flags", "no flags, again"
# What may change only the order of sums and products: NaN, infinities, divisions and functions stay as they are.
ROUNDING = "--xla_cpu_enable_fast_math=true"
SETS: dict[str, str] = {
    NONE: "",
    "vectors of 512 bits": "--xla_cpu_prefer_vector_width=512",
    "sums and products in any order": ROUNDING,
    "approximate functions": f"{ROUNDING} --xla_cpu_fast_math_honor_functions=false --xla_cpu_fast_math_honor_division=false",
    "512 bits, any order": f"--xla_cpu_prefer_vector_width=512 {ROUNDING}",
    "schedule for concurrency": "--xla_cpu_scheduler_type=CPU_SCHEDULER_TYPE_CONCURRENCY_OPTIMIZED",
    "older emitters": "--xla_cpu_use_fusion_emitters=false",
    "code in one piece": "--xla_cpu_parallel_codegen_split_count=1",
    "the compiler's preset for speed": "--xla_cpu_opt_preset=CPU_OPT_PRESET_FAST_RUNTIME",
}
# Name -> (n, steps, steps of the quick look). A run takes a tenth of a second or two.
CLOTHS = {"cloth 32": (32, 8000, 500), "cloth 128": (128, 800, 100), "cloth 512": (512, 60, 10), "cloth 1024": (1024, 12, 4)}
GRADIENT = "gradient 128"
SIZES = {**CLOTHS, GRADIENT: (128, 100, 20)}


def serve(folder: Path, quick: bool) -> None:
    """Answer each line, the name of a workload, with the seconds of one run; the first time build it, run it and keep its result."""
    import jax

    import jaxspring as js
    from jaxspring.progress import Stopwatch

    from . import explicit, scenes

    built: dict[str, Any] = {}
    for line in sys.stdin:
        name = line.strip()
        if name == "ready":
            print(json.dumps(float(jax.jit(lambda x: x + 1)(0.0))), flush=True)
            continue
        if name == "tells nan":
            program, (arrays, state, _) = built["cloth 32"]
            print(json.dumps(bool(program(arrays, state, np.float32(50)).status.has(js.Flag.NONFINITE))), flush=True)
            continue
        clock = Stopwatch()
        if name in built:
            program, arguments = built[name]
            jax.block_until_ready(program(*arguments))
            print(json.dumps(clock.seconds), flush=True)
            continue
        n, n_steps, few = SIZES[name]
        make = scenes.gradient_program if name == GRADIENT else scenes.program
        function, arguments = make(*scenes.sheet(n), explicit.DT, few if quick else n_steps)
        clock = Stopwatch()
        program = function.lower(*arguments).compile()
        compile_s = clock.seconds
        found = jax.block_until_ready(program(*arguments))
        first_s = clock.seconds
        built[name] = program, arguments
        np.savez(folder / f"{name}.npz", *map(np.asarray, found if name == GRADIENT else [found.state.points]))
        print(json.dumps({"compile_s": compile_s, "first_s": first_s}), flush=True)


class Worker:
    """A process with one set of flags. It holds every workload that it was asked for."""

    def __init__(self, flags: str, folder: Path, quick: bool):
        folder.mkdir()
        self.folder = folder
        given = " ".join(filter(None, [os.environ.get("XLA_FLAGS", ""), flags]))
        command = [sys.executable, "-m", "benchmarks.flags", "--serve", str(folder), *(["--quick"] if quick else [])]
        with (folder / "log").open("w") as log:
            self.process = subprocess.Popen(
                command,
                cwd=ROOT,
                env={**os.environ, "XLA_FLAGS": given},
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )

    def ask(self, name: str) -> Any:
        """The answer to one line, or None where the process has ended."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            print(name, file=self.process.stdin, flush=True)
            line = self.process.stdout.readline()
        except BrokenPipeError:
            return None
        return json.loads(line) if line else None

    def is_ready(self) -> bool:
        """Whether its jaxlib knows the flags: a compilation asks."""
        return self.ask("ready") is not None

    def last_words(self) -> str:
        """What it said before it ended."""
        lines = [line.strip() for line in (self.folder / "log").read_text().splitlines() if line.strip()]
        return lines[-1][:200] if lines else "no message"

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.communicate()


def compare(name: str, workers: dict[str, Worker], rounds: int) -> list[dict[str, Any]]:
    """One row per set of flags."""
    first = {key: worker.ask(name) for key, worker in workers.items() if key != AGAIN}
    first[AGAIN] = first[NONE]
    taken: dict[str, list[float]] = {key: [] for key in workers}
    for _ in range(rounds):
        for key, worker in workers.items():
            time.sleep(PAUSE_S)
            taken[key].append(worker.ask(name))
    rows = []
    for key, worker in workers.items():
        speed = np.divide(taken[NONE], taken[key])
        row = {
            "flags": key,
            "seconds": float(np.median(taken[key])),
            "speed": float(np.median(speed)),
            "low": float(speed.min()),
            "high": float(speed.max()),
            "compile_s": first[key]["compile_s"],
        }
        row |= {"first_gradient_s": first[key]["first_s"]} if name == GRADIENT else {}
        rows.append(row | {"difference": difference(workers[NONE].folder, worker.folder, name)})
    return rows


def difference(base: Path, other: Path, name: str) -> float:
    """Largest difference of what two processes computed, over the range of the first."""
    with np.load(base / f"{name}.npz") as expected, np.load(other / f"{name}.npz") as found:
        pairs = [(expected[key].astype(float), found[key].astype(float)) for key in expected.files]
    size = [np.abs(a).max() if name == GRADIENT else np.ptp(a, axis=0).max() for a, _ in pairs]
    return float(max(np.abs(a - b).max() / s for (a, b), s in zip(pairs, size, strict=True)))


def main() -> None:
    """Serve, or measure, print, write the tables and the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps and rounds, without n = 1024, for a look")
    parser.add_argument("--only", action="extend", nargs="+", metavar="WORD", help="only sets with one of these words in their name")
    parser.add_argument("--serve", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve is not None:
        serve(given.serve, given.quick)
        return
    chosen = {name: flags for name, flags in SETS.items() if name == NONE or any(word in name for word in given.only or [""])}
    names, rounds = [*list(CLOTHS)[: 3 if given.quick else 4], GRADIENT], 3 if given.quick else 9
    tables: dict[str, list[dict[str, Any]]] = {}
    workers: dict[str, Worker] = {}
    settings = {"rounds": rounds, "quick": given.quick, "sets": chosen}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for number, (name, flags) in enumerate(chosen.items()):
                workers[name] = Worker(flags, Path(folder) / str(number), given.quick)
                if not workers[name].is_ready():
                    print(f"{name} ({flags}) is left out: {workers[name].last_words()}", flush=True)
                    workers.pop(name).close()
                elif name == NONE:
                    workers[AGAIN] = workers[NONE]
            for name in names:
                tables[name] = compare(name, workers, rounds)
                show(name, tables[name])
                write("flags", settings, {"workloads": tables})  # what is done is kept where the rest is interrupted
            told = [{"flags": key, "tells_nan": worker.ask("tells nan")} for key, worker in workers.items()]
            show("a run that blows up", told)
        finally:
            for worker in set(workers.values()):
                worker.close()
    path = write("flags", settings, {"workloads": tables, "blown_up": told})
    draw([picture(tables)], path.with_suffix(".png"))


def picture(tables: dict[str, list[dict[str, Any]]]) -> Panel:
    """Speed over the size of the cloth, a curve for each set."""
    cloths = [name for name in tables if name in CLOTHS]
    sizes = [float(CLOTHS[name][0] ** 2) for name in cloths]
    keys = [row["flags"] for row in tables[cloths[0]] if row["flags"] != NONE]
    styles = ("o-", "s--", "^-", "v--", "d-", "x:", "+:", "*-.", "<--", ">:", "p-", "h--")
    curves = {
        (key, style): (sizes, [next(row["speed"] for row in tables[name] if row["flags"] == key) for name in cloths])
        for key, style in zip(keys, styles, strict=False)
    }
    return Panel("cloths, with flags", "speed over that without", curves)


if __name__ == "__main__":
    main()
