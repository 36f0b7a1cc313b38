"""Contenders in processes of their own, one run each in turn."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from . import environments
from .workloads import Workload

ROOT = Path(__file__).parents[2]
THREADS = 2
# After this long without an answer a contender is ended.
PATIENCE_S = 600.0
# Threads of the contender before that still wait in a loop are asleep after this.
PAUSE_S = 0.02


class LeftOut(Exception):
    """A contender that cannot take part, and why."""


class Worker:
    """A contender in its own process; see `worker.py` for what it is asked."""

    def __init__(self, contender: str, scene: Path, folder: Path):
        python = environments.python_of(contender)
        if python is None:
            raise LeftOut("it is not installed" if contender != "c" else "there is no C compiler named cc")
        self._log = folder / f"{contender}.log"
        command = [str(python), "-m", "benchmarks.others.worker", contender, str(scene), str(folder), str(THREADS)]
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                command, cwd=ROOT, env=_surroundings(folder), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )

    def ask(self, do: str, **more: Any) -> Any:
        """Send a command and wait for its answer."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        timer = threading.Timer(PATIENCE_S, self._process.kill)
        timer.start()
        try:
            print(json.dumps({"do": do, **more}), file=self._process.stdin, flush=True)
            line = self._process.stdout.readline()
        except BrokenPipeError:
            line = ""
        finally:
            timer.cancel()
        if not line:
            raise LeftOut(self._last_words())
        answer = json.loads(line)
        if "error" in answer:
            raise LeftOut(answer["error"])
        return answer["value"]

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()

    def _last_words(self) -> str:
        self._process.wait(10)
        lines = [line.strip() for line in self._log.read_text().splitlines() if line.strip()]
        return f"it ended with {self._process.returncode}: {lines[-1] if lines else 'no message'}"


def _surroundings(folder: Path) -> dict[str, str]:
    """Two threads each, no accelerator, and no cache of earlier compilations."""
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    caches = folder / f"cache {time.monotonic_ns()}"
    return {
        **{name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"},
        **dict.fromkeys(names, str(THREADS)),
        "WARP_CACHE_PATH": str(caches),
        "CUDA_VISIBLE_DEVICES": "",
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": str(ROOT),
    }


def fastest_form(contender: str, scene: Path, folder: Path) -> str:
    """The form of a contender whose best of three runs is the fastest. A form that fails is passed over."""
    worker, found, failed = Worker(contender, scene, folder), {}, "it has no form of this"
    try:
        names = worker.ask("forms")
        if len(names) == 1:
            return names[0]
        for name in names:
            try:
                worker.ask("build", form=name)
                found[name] = min(worker.ask("run") for _ in range(3))
            except LeftOut as reason:
                failed = str(reason)
    finally:
        worker.close()
    if not found:
        raise LeftOut(failed)
    return min(found, key=found.__getitem__)


def contest(workload: Workload, n_steps: int, rounds: int, folder: Path) -> dict[str, Any]:
    """Who took part, and one row for each: all are built, then they take turns, then their results are compared with float64."""
    scene = workload.make()
    path = folder / "scene.npz"
    scene.with_steps(n_steps).save(path)
    workers, built, left_out = {}, {}, {}
    try:
        for name in workload.contenders:
            try:
                form = fastest_form(name, path, folder)
                workers[name] = Worker(name, path, folder)
                built[name] = {"form": form, "compile_s": workers[name].ask("build", form=form)}
            except LeftOut as reason:
                left_out[name] = str(reason)
                print(f"  {name} is left out of {workload.name}: {reason}", flush=True)
                if name in workers:
                    workers.pop(name).close()
        taken = _turns(workers, rounds)
        expected = workload.reference(scene, workload.checked)
        rows = []
        for name, worker in workers.items():
            peak, before = worker.ask("memory")
            result = np.load(worker.ask("result", n_steps=workload.checked))
            package = environments.AT_HOME.get(name, environments.PACKAGES.get(name))
            built[name] |= {"peak_mib": peak, "built_mib": peak - before, "error": distance(result, expected, workload.name)}
            rows.append({"contender": name, **built[name], "version": worker.ask("version", package=package) if package else "cc"})
    finally:
        for worker in workers.values():
            worker.close()
    items = workload.items(scene) if workload.items else float(workload.size)
    table = [_row(row, taken, items * n_steps, workload.unit) for row in rows]
    return {"left_out": left_out, "unit": workload.unit, "size": workload.size, "group": workload.group, "steps": n_steps, "rows": table}


def _turns(workers: dict[str, Worker], rounds: int) -> dict[str, np.ndarray]:
    """Seconds of each contender in each round."""
    taken: dict[str, list[float]] = {name: [] for name in workers}
    for _ in range(rounds):
        for name, worker in workers.items():
            time.sleep(PAUSE_S)
            taken[name].append(worker.ask("run"))
    return {name: np.array(times) for name, times in taken.items()}


def _row(built: dict[str, Any], taken: dict[str, np.ndarray], counted: float, unit: str) -> dict[str, Any]:
    """One line of the table."""
    name = built["contender"]
    times, ours = taken[name], taken.get("jaxspring")
    low, median, high = np.quantile(times, [0.1, 0.5, 0.9])
    return {
        "contender": name,
        "form": built["form"],
        "M": counted / float(median) / 1e6,
        "ratio": None if ours is None else float(np.median(ours / times)),
        "seconds": float(median),
        "low": float(low),
        "high": float(high),
        **{key: built[key] for key in ("compile_s", "peak_mib", "built_mib", "error", "version")},
    }


def distance(found: np.ndarray, expected: np.ndarray, name: str) -> float:
    """Largest difference: of a gradient over its largest entry, of anything else over its range (in space: the longest extent)."""
    difference = np.abs(found.astype(float) - expected)
    if name.startswith("gradient"):
        return float((difference.max(axis=1) / np.abs(expected).max(axis=1)).max())
    extent = np.ptp(expected, axis=-2).max() if expected.ndim > 1 else np.ptp(expected)
    return float(difference.max() / extent)
