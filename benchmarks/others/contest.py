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


def fastest_forms(contender: str, scene: Path, folder: Path) -> list[str]:
    """The two forms of a contender whose best of three runs are the fastest. A form that fails is passed over."""
    worker, found, failed = Worker(contender, scene, folder), {}, "it has no form of this"
    try:
        names = worker.ask("forms")
        if len(names) == 1:
            return names
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
    return sorted(found, key=found.__getitem__)[:2]


def contest(workload: Workload, n_steps: int, rounds: int, folder: Path) -> dict[str, Any]:
    """Who took part, and one row for each: all are built, then they take turns, then their results are compared with float64."""
    scene = workload.make()
    path = folder / "scene.npz"
    scene.with_steps(n_steps).save(path)
    workers: dict[tuple[str, str], Worker] = {}
    compiled, left_out = {}, {}
    try:
        for name in workload.contenders:
            try:
                for form in fastest_forms(name, path, folder):
                    workers[name, form] = Worker(name, path, folder)
                    compiled[name, form] = workers[name, form].ask("build", form=form)
            except LeftOut as reason:
                left_out[name] = str(reason)
                print(f"  {name} is left out of {workload.name}: {reason}", flush=True)
                for key in [key for key in workers if key[0] == name]:
                    workers.pop(key).close()
        taken = _turns(workers, rounds)
        expected, rows = workload.reference(scene, workload.checked), []
        items = workload.items(scene) if workload.items else float(workload.size)
        ours = next((times for (name, _), times in taken.items() if name == "jaxspring"), None)
        for key in _best_of_each(taken):
            found = _asked(workers[key], key[0], workload, expected)
            first = "first_gradient_s" if workload.name.startswith("gradient") else "compile_s"
            rows.append(_row(key, taken[key], ours, items * n_steps) | {first: compiled[key]} | found)
    finally:
        for worker in workers.values():
            worker.close()
    return {"left_out": left_out, "unit": workload.unit, "size": workload.size, "group": workload.group, "steps": n_steps, "rows": rows}


def _asked(worker: Worker, name: str, workload: Workload, expected: np.ndarray) -> dict[str, Any]:
    """Memory, error and version."""
    peak, before = worker.ask("memory")
    error = distance(np.load(worker.ask("result", n_steps=workload.checked)), expected, workload.name)
    package = environments.AT_HOME.get(name, environments.PACKAGES.get(name))
    version = worker.ask("version", package=package) if package else "cc"
    return {"peak_mib": peak, "built_mib": peak - before, "error": error, "version": version}


def _best_of_each(taken: dict[tuple[str, str], np.ndarray]) -> list[tuple[str, str]]:
    """The form of each contender with the lowest median."""
    best: dict[str, tuple[str, str]] = {}
    for name, form in sorted(taken, key=lambda key: float(np.median(taken[key]))):
        best.setdefault(name, (name, form))
    return [best[name] for name in dict.fromkeys(name for name, _ in taken)]


def _turns(workers: dict[tuple[str, str], Worker], rounds: int) -> dict[tuple[str, str], np.ndarray]:
    """Seconds of each contender in each round."""
    taken: dict[tuple[str, str], list[float]] = {key: [] for key in workers}
    for _ in range(rounds):
        for key, worker in workers.items():
            time.sleep(PAUSE_S)
            taken[key].append(worker.ask("run"))
    return {key: np.array(times) for key, times in taken.items()}


def _row(key: tuple[str, str], times: np.ndarray, ours: np.ndarray | None, counted: float) -> dict[str, Any]:
    """The first part of a line of the table."""
    low, median, high = np.quantile(times, [0.1, 0.5, 0.9])
    return {
        "contender": key[0],
        "form": key[1],
        "M": counted / float(median) / 1e6,
        "ratio": None if ours is None else float(np.median(ours / times)),
        "seconds": float(median),
        "low": float(low),
        "high": float(high),
    }


def distance(found: np.ndarray, expected: np.ndarray, name: str) -> float:
    """Largest difference: of a gradient over its largest entry, of anything else over its range (in space: the longest extent)."""
    difference = np.abs(found.astype(float) - expected)
    if name.startswith("gradient"):
        return float((difference.max(axis=1) / np.abs(expected).max(axis=1)).max())
    extent = np.ptp(expected, axis=-2).max() if expected.ndim > 1 else np.ptp(expected)
    return float(difference.max() / extent)
