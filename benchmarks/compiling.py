"""How long does it take to compile a rollout, its gradient and its Hessian-vector product?

    python -m benchmarks.compiling [--quick]

A sheet of 6 x 6 nodes, 60 steps, in float64: what takes time is the size of the program, not that of the scene. Each program is made in a
process of its own, where nothing has been traced before. Read: `trace`, `lower` and `compile` are the seconds of Python, of the lowering
and of XLA, `total` their sum by the clock; `lines` is the length of the lowered program. The Hessian-vector product through Newton's
steps should stay below 10 s on two cores.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

import jaxspring as js
from jaxspring.progress import Stopwatch

from .measure import arguments, show, write

N_STEPS = 60
STEPPERS: dict[str, Callable[[], js.Stepper]] = {
    "SymplecticEuler": js.SymplecticEuler,
    "BackwardEuler, linear": js.BackwardEuler,
    "BackwardEuler, Newton": lambda: js.BackwardEuler(newton=True),
}
DERIVATIVES = ("value", "gradient", "Hessian-vector product")


def program(stepper: str, derivative: str) -> Callable[[jax.Array], Any]:
    """A function of one stiffness [N/m]."""
    net = js.lattice((6, 6))
    start = js.State.from_points(net, 1.02 * net.grid())
    drag, weight = js.Drag(0.1), js.Gravity((0.0, -9.81))

    def run(k: jax.Array) -> js.Result:
        system = js.System(net, 1.0, (js.Springs(net, k, 1.0), drag, weight))
        return js.rollout(system, start, STEPPERS[stepper](), 0.01, N_STEPS)

    def loss(k: jax.Array) -> jax.Array:
        return jnp.sum(run(k).state.position.x ** 2)

    ways = {"value": run, "gradient": jax.grad(loss), "Hessian-vector product": lambda k: jax.jvp(jax.grad(loss), (k,), (jnp.ones(()),))[1]}
    return ways[derivative]


def compiled(stepper: str, derivative: str) -> dict[str, Any]:
    """One row, made here."""
    whole, clock = Stopwatch(), Stopwatch()
    traced = jax.jit(program(stepper, derivative)).trace(jnp.asarray(100.0))
    trace, clock = clock.seconds, Stopwatch()
    lowered = traced.lower()
    lower, clock = clock.seconds, Stopwatch()
    lowered.compile()
    row = {"stepper": stepper, "derivative": derivative, "trace": trace, "lower": lower, "compile": clock.seconds, "total": whole.seconds}
    return {**row, "lines": len(lowered.as_text().splitlines())}


def in_a_process(stepper: str, derivative: str) -> dict[str, Any]:
    """One row, made in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.compiling", "--one", stepper, derivative]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def picture(rows: list[dict[str, Any]], path: Path) -> None:
    """Bars, one per program, cut into the three parts."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 0.35 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    names, left = [f"{row['stepper']}: {row['derivative']}" for row in rows], [0.0] * len(rows)
    for part in ("trace", "lower", "compile"):
        width = [row[part] for row in rows]
        axes.barh(names, width, left=left, label=part)
        left = [a + b for a, b in zip(left, width, strict=True)]
    axes.invert_yaxis()
    axes.set_xlabel("time to compile (s)")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure, print, write and draw."""
    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(compiled(*sys.argv[2:])))
        return
    quick = arguments(__doc__).quick
    rows = [in_a_process(stepper, derivative) for stepper in STEPPERS for derivative in DERIVATIVES[: 1 if quick else None]]
    show("to compile", rows)
    picture(rows, write("compiling", {"nodes": 36, "n_steps": N_STEPS}, {"rows": rows}).with_suffix(".png"))


if __name__ == "__main__":
    main()
