"""One contender in its own process: it reads commands from its standard input, and answers each with a line of JSON.

    python -m benchmarks.others.worker CONTENDER SCENE.npz FOLDER THREADS

    {"do": "forms"}                    the names of its forms of the scene's workload
    {"do": "build", "form": NAME}      seconds to make it and to run it once: what compiles, compiles here
    {"do": "run"}                      seconds of one run
    {"do": "result", "n_steps": 20}    a file with what comes out after so many steps
    {"do": "memory"}                   largest resident memory so far [MiB], and what it was before anything was built
    {"do": "version", "package": NAME}

An answer is {"value": ...} or {"error": why not}. The process keeps to as many processors as it may have threads. It is run by the
contender's own Python, with NumPy and nothing else of this project's. What a package prints goes to standard error.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.others.layouts import Forms, Program, Scene


class Contender:
    """Forms of a workload, and the one that was built."""

    def __init__(self, name: str, scene: Scene, folder: Path):
        self._folder, self._name, self._n_steps = folder, name, scene.number("n_steps")
        module = importlib.import_module(f"benchmarks.others.by_{name.replace('-', '_')}")
        self._forms: Forms = module.forms(scene)
        self._built: Program | None = None
        self._before = peak_mib()

    def answer(self, command: dict[str, Any]) -> Any:
        """What one command asks for."""
        if command["do"] == "forms":
            return list(self._forms)
        if command["do"] == "memory":
            return [peak_mib(), self._before]
        if command["do"] == "version":
            return importlib.metadata.version(command["package"])
        begin = time.perf_counter()
        if command["do"] == "build":
            self._built = self._forms[command["form"]]()
        assert self._built is not None, "build a form first"
        self._built.run(command.get("n_steps", self._n_steps))
        seconds = time.perf_counter() - begin
        if command["do"] == "result":
            path = self._folder / f"{self._name}.npy"
            np.save(path, np.asarray(self._built.result()))
            return str(path)
        return seconds


def peak_mib() -> float:
    """Largest resident memory of this process so far."""
    status = Path("/proc/self/status")
    if status.exists():  # `getrusage` begins with what the parent had when it forked
        lines = status.read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 2**10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # in bytes, on a Mac


def main() -> None:
    name, scene, folder, threads = sys.argv[1:]
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(threads)])
    # Answers have a channel of their own: packages print banners.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    contender = Contender(name, Scene.load(Path(scene)), Path(folder))
    for line in sys.stdin:
        try:
            answer = {"value": contender.answer(json.loads(line))}
        except (Exception, SystemExit) as error:  # whatever a peer raises is told, and the next command taken
            answer = {"error": f"{type(error).__name__}: {error}"[:300]}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
