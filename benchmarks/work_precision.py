"""What does accuracy cost in time?

    python -m benchmarks.work_precision [--quick] [--scene chain] [--scene cloth] [--scene mesh]

A hanging chain, a stiff pinned cloth, the reconstruction mesh (`accuracy_scenes.py`), float64. Every stepper here over a range of dt,
and diffrax over tolerances. One compilation serves every dt of a method: a loop over `rollout`s of 16 steps, each resuming the one
before; `loop_over_rollout` is its time over that of one `rollout` of all steps. Read: `error` is the root mean square error of the last
positions over that of the displacement, against diffrax Dopri8 at a relative and absolute tolerance of 1e-12; RungeKutta4 at its smallest
dt checks that reference. `gradient_error` is the relative error of the derivative of the mean square displacement by one constant
(stiffness; k_max on the mesh), in forward mode by jax.jvp through the run. Runs longer than `LONG` are timed once and get no derivative,
nor do those methods that `Scene.without_derivative` names, to spare their compilation; the quick look has none at all. `run_s` is
the median of three, after compilation, and blocks. A run is `unstable` where its status is an error or where it has moved more than 2.5
times as far as the reference; it stays in the table, and is a cross at the picture's top.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxspring as js
from jaxspring.progress import Stopwatch
from jaxspring.status import WARNINGS

from . import accuracy_scenes
from .accuracy_scenes import Scene
from .measure import show, write

BLOCK = 16  # steps of one rollout in the loop
LONG = 2.0  # seconds
FARTHEST = 2.5  # displacement over that of the reference; a slow chain at its lowest has 2.2 times that of one on its way up
REFERENCE = 1e-12
SCENES = {"chain": accuracy_scenes.chain, "cloth": accuracy_scenes.cloth, "mesh": accuracy_scenes.mesh}
STEPPERS: dict[str, tuple[Any, int]] = {
    "ForwardEuler": (js.ForwardEuler(), 1),
    "SymplecticEuler": (js.SymplecticEuler(), 1),
    "VelocityVerlet": (js.VelocityVerlet(), 2),
    "RungeKutta4": (js.RungeKutta4(), 4),
    "SemiImplicit": (js.SemiImplicit(), 1),
    "BackwardEuler": (js.BackwardEuler(), 1),
    "BackwardEuler, Newton": (js.BackwardEuler(newton=True), 1),
    "ImplicitMidpoint": (js.ImplicitMidpoint(), 2),
    "BDF2": (js.BDF2(), 2),
}
IS_EXPLICIT = ("ForwardEuler", "SymplecticEuler", "VelocityVerlet", "RungeKutta4", "SemiImplicit")
COLORS = ("C0", "C1", "C2", "C3", "C4", "C5", "C6", "C9", "C8", "black", "navy", "darkgreen")
SOLVERS: dict[str, tuple[Any, tuple[float, ...]]] = {
    "Tsit5": (diffrax.Tsit5(), (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)),
    "Dopri8": (diffrax.Dopri8(), (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)),
    "Kvaerno5": (diffrax.Kvaerno5(), (1e-2, 1e-4, 1e-6)),
}


@dataclass
class Method:
    """How one line of the picture is computed: run(constant, setting) -> (last position, status flags, steps)."""

    name: str
    run: Callable[[jax.Array, Any], tuple[js.Vector, jax.Array, jax.Array]]
    settings: list[tuple[str, Any]]
    order: int | None


def with_stepper(scene: Scene, stepper: Any, constant: Any, setting: Any) -> tuple[js.Vector, jax.Array, jax.Array]:
    """A loop of rollouts; setting is (dt, number of blocks)."""
    dt, n_blocks = setting
    system = scene.system(constant)
    first = js.rollout(system, scene.start, stepper, dt, 0)

    def block(_: Any, carry: Any) -> Any:
        state, resume, status = carry
        result = js.rollout(system, state, stepper, dt, BLOCK, resume=resume)
        return result.state, result.resume, status.then(result.status)

    state, resume, status = lax.fori_loop(0, n_blocks, block, (first.state, first.resume, first.status))
    return state.position, status.flags, resume.step


def with_diffrax(scene: Scene, solver: Any, constant: Any, setting: Any) -> tuple[js.Vector, jax.Array, jax.Array]:
    """Adaptive steps; setting is the relative and absolute tolerance."""
    controller = diffrax.PIDController(rtol=setting, atol=setting)
    most = scene.most_kvaerno if isinstance(solver, diffrax.Kvaerno5) else 200_000
    adjoint = diffrax.ForwardMode()
    result = js.diffeqsolve(
        scene.system(constant), scene.start, scene.t1, solver, stepsize_controller=controller, adjoint=adjoint, max_steps=most
    )
    return result.state.position, result.status.flags, result.info.n_steps


def methods(scene: Scene, quick: bool) -> Iterator[Method]:
    """Every stepper and solver on a scene."""
    for name, (stepper, order) in STEPPERS.items():
        counts = scene.explicit if name in IS_EXPLICIT else scene.implicit
        counts = counts[:2] if quick else counts
        settings = [(f"dt = {scene.t1 / n:.3g}", (jnp.asarray(scene.t1 / n), jnp.asarray(n // BLOCK, jnp.int32))) for n in counts]
        yield Method(name, partial(with_stepper, scene, stepper), settings, order)
    for name, (solver, tolerances) in SOLVERS.items():
        chosen = tolerances[:2] if quick else tolerances
        yield Method(f"diffrax {name}", partial(with_diffrax, scene, solver), [(f"tol = {t:g}", jnp.asarray(t)) for t in chosen], None)


def differentiated(scene: Scene, run: Callable[..., Any]) -> Callable[..., Any]:
    """The loss, its derivative by the constant, and the last position, in forward mode."""

    def program(constant: Any, setting: Any) -> Any:
        def loss(constant: Any) -> Any:
            position, *_ = run(constant, setting)
            return scene.loss(position), position

        _, derivative, position = jax.jvp(loss, (constant,), (jnp.ones_like(constant),), has_aux=True)
        return derivative, position

    return program


def reference(scene: Scene) -> tuple[np.ndarray, float]:
    """Last points and derivative."""
    program = jax.jit(differentiated(scene, partial(with_diffrax, scene, diffrax.Dopri8())))
    derivative, position = program(jnp.asarray(scene.value), jnp.asarray(REFERENCE))
    return points(scene, position), float(derivative)


def points(scene: Scene, position: js.Vector) -> np.ndarray:
    """(N, D) points."""
    return np.stack([np.ravel(a) for a in position], axis=-1)


def rows_of(scene: Scene, method: Method, expected: tuple[np.ndarray, float], has_gradient: bool) -> list[dict]:
    """One row per setting."""
    constant, clock = jnp.asarray(scene.value), Stopwatch()
    run = jax.jit(method.run).lower(constant, method.settings[0][1]).compile()
    compile_s, slope, first_gradient_s, rows = clock.seconds, None, None, []
    start = points(scene, scene.start.position)
    displacement = np.sqrt(np.mean((expected[0] - start) ** 2))
    for text, setting in method.settings:
        (position, flags, steps), run_s = timed(run, constant, setting)
        found = points(scene, position)
        error = float(np.sqrt(np.mean((found - expected[0]) ** 2)) / displacement)
        is_ok = not int(flags) & ~int(WARNINGS)
        moved = float(np.sqrt(np.mean((found - start) ** 2)) / displacement)
        is_unstable = not (is_ok and moved < FARTHEST)
        row = {"method": method.name, "setting": text, "steps": int(steps), "run_s": run_s, "error": error}
        gradient_s = gradient_error = None
        if has_gradient and not is_unstable and run_s < LONG:
            first = Stopwatch()
            slope = slope or jax.jit(differentiated(scene, method.run)).lower(constant, setting).compile()
            if first_gradient_s is None:
                jax.block_until_ready(slope(constant, setting))
                first_gradient_s = first.seconds
            (derivative, _), gradient_s = timed(slope, constant, setting, 1)
            gradient_error = abs(float(derivative) / expected[1] - 1)
        row |= {"gradient_s": gradient_s, "gradient_error": gradient_error, "status": str(js.Flag(int(flags)).name or "OK")}
        row |= {"compile_s": compile_s, "first_gradient_s": first_gradient_s}
        rows.append(row | {"unstable": "UNSTABLE" if is_unstable else ""})
    print(f"{scene.name:6s} {method.name:22s} {clock.seconds:6.1f} s, compile {compile_s:.1f} s", flush=True)
    return rows


def timed(run: Callable[..., Any], constant: Any, setting: Any, rounds: int = 3) -> tuple[Any, float]:
    """The result, and the median of some runs after the first; the first alone where it is long."""
    seconds, result = [], None
    for i in range(rounds + 1):
        clock = Stopwatch()
        result = jax.block_until_ready(run(constant, setting))
        seconds.append(clock.seconds)
        if i == 0 and seconds[0] > LONG:
            break
    return result, float(np.median(seconds[1:] or seconds))


def loop_over_rollout(scene: Scene) -> float:
    """Time of the loop of rollouts over that of one `rollout` of all steps, for VelocityVerlet: the least of seven runs of each."""
    n = scene.explicit[-2]
    stepper, dt = js.VelocityVerlet(), jnp.asarray(scene.t1 / n)
    whole = jax.jit(lambda k, setting: js.rollout(scene.system(k), scene.start, stepper, setting[0], n).state.position)
    loop = jax.jit(partial(with_stepper, scene, stepper))
    given = (jnp.asarray(scene.value), (dt, jnp.asarray(n // BLOCK, jnp.int32)))
    times = [[timed(run, *given, 1)[1] for run in (loop, whole)] for _ in range(7)]
    return float(np.divide(*np.min(times, axis=0)))


def picture(scene: Scene, rows: list[dict], path: Path) -> None:
    """Errors against seconds and against dt; unstable runs are crosses at the top."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    names = list(dict.fromkeys(row["method"] for row in rows))
    for i, name in enumerate(names):
        of = [row for row in rows if row["method"] == name]
        is_adaptive = name.startswith("diffrax")
        kind = "-" if name in IS_EXPLICIT else ":" if is_adaptive else "--"
        marker, color = "os^vDsP*Xos^"[i], COLORS[i]
        for axes, x in ((left, [row["run_s"] for row in of]), (right, [scene.t1 / row["steps"] for row in of])):
            if axes is right and is_adaptive:
                continue
            good = [(a, row["error"]) for a, row in zip(x, of, strict=True) if not row["unstable"]]
            axes.loglog(*zip(*good, strict=True) if good else ([], []), kind + marker, color=color, ms=4, lw=1, label=name)
            bad = [a for a, row in zip(x, of, strict=True) if row["unstable"]]
            axes.plot(bad, [2.0 * 1.25 ** (i % 6) for _ in bad], "x", color=color, ms=6)
    dts = np.array([scene.t1 / scene.explicit[-1], scene.t1 / min(scene.implicit)])
    for order, at in ((1, 0.5), (2, 0.5), (4, 0.5)):
        right.plot(dts, at * (dts / dts[1]) ** order, color="0.75", lw=0.8, zorder=0)
        right.annotate(f"order {order}", (dts[0] * 2, at * (2 * dts[0] / dts[1]) ** order), fontsize=7, color="0.5")
    least = min((row["error"] for row in rows if row["error"] > 0), default=1e-12)
    left.set(xlabel="seconds of a run", ylabel="relative error of the last positions", title=scene.title, ylim=(max(least / 3, 1e-12), 10))
    right.set(xlabel="dt [s]", title="x: unstable")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, fontsize=7, loc="outside right center")
    figure.savefig(path, dpi=100)


def one_scene(scene: Scene, quick: bool) -> dict[str, Any]:
    """Every row of a scene, printed, written and drawn."""
    clock = Stopwatch()
    expected = reference(scene)
    print(f"{scene.name:6s} reference {clock.seconds:.1f} s", flush=True)
    settings, rows = {"block": BLOCK, "dtype": "float64", "t1": scene.t1, "quick": quick}, []
    for method in methods(scene, quick):
        rows += rows_of(scene, method, expected, not quick and method.name not in scene.without_derivative)
        write(f"work_precision_{scene.name}", settings, {"rows": rows})  # what is done is kept where the rest is interrupted
    finest = [row for row in rows if row["method"] == "RungeKutta4"][-1]
    check = {
        "reference": f"Dopri8 at {REFERENCE:g}",
        "runge_kutta_disagrees_by": finest["error"],
        "its_derivative_by": finest["gradient_error"],
        "loop_over_rollout": loop_over_rollout(scene),
        "seconds": clock.seconds,
    }
    show(scene.title, rows)
    show("reference", [check])
    path = write(f"work_precision_{scene.name}", settings, {"rows": rows, **check})
    picture(scene, rows, path.with_suffix(".png"))
    return check


def main() -> None:
    """Measure, print, write the tables and the pictures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two settings per method, no derivatives")
    parser.add_argument("--scene", action="append", choices=list(SCENES), help="only this one; may be repeated")
    chosen = parser.parse_args()
    with jax.enable_x64(True):
        for name in chosen.scene or SCENES:
            one_scene(SCENES[name](), chosen.quick)


if __name__ == "__main__":
    main()
