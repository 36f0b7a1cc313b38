"""One contender in its own process: it reads commands from its standard input, and answers each with a line of JSON.

    python -m benchmarks.others.worker CONTENDER SCENE.npz FOLDER

    {"do": "forms"}                    the names of its forms of the scene's workload
    {"do": "build", "form": NAME}      seconds to make it and to run it once: what compiles, compiles here
    {"do": "run"}                      seconds of one run
    {"do": "result", "n_steps": 20}    a file with what comes out after so many steps
    {"do": "memory"}                   largest resident memory so far [MiB], and what it was before anything was built

It is run by the contender's own Python, with NumPy and nothing else of this project's. What a package prints goes to standard error.
"""

from __future__ import annotations

import importlib
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
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def main() -> None:
    name, scene, folder = sys.argv[1:]
    # Answers have a channel of their own: packages print banners.
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    contender = Contender(name, Scene.load(Path(scene)), Path(folder))
    for line in sys.stdin:
        print(json.dumps(contender.answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
