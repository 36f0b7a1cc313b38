"""At which dt and stiffness does each stepper hold?

    python -m benchmarks.stability_map [--quick]

A pinned sheet of 6 x 6 nodes, structural and shear springs, unit masses and spacing, crumpled by a twentieth of the spacing, nothing that
feeds energy in. Each stepper runs 100 steps for every stiffness and dt of a grid, in float64. Read, per cell:

    falls     the energy never rose by more than a hundredth of what there was at the start
    swings    it rose, but stayed below ten times the start: what a method that keeps a nearby energy does
    told      it rose beyond that, and the status is an error or a warning
    silent    it rose beyond that, and the status is OK: there must be none
    blew up   not finite, or a million times the start; the status says so

The line is omega dt = 2, omega the highest frequency of the sheet at rest, from its matrix. The JSON file holds every cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch

from .measure import arguments, show, write

N, N_STEPS, CRUMPLE = 6, 100, 0.05
STEPPERS: dict[str, js.Stepper] = {
    "ForwardEuler": js.ForwardEuler(),
    "SymplecticEuler": js.SymplecticEuler(),
    "VelocityVerlet": js.VelocityVerlet(),
    "RungeKutta4": js.RungeKutta4(),
    "BackwardEuler, Secant": js.BackwardEuler(stiffness=js.steppers.Secant()),
    "BackwardEuler": js.BackwardEuler(),
    "BackwardEuler, Newton": js.BackwardEuler(newton=True),
    "ImplicitMidpoint": js.ImplicitMidpoint(),
    "BDF2": js.BDF2(),
}
OUTCOMES = ("falls", "swings", "told", "silent", "blew up")
COLORS = ("#3b7a57", "#a8d5a2", "#f2c14e", "#8e44ad", "#b03a2e")


def sheet() -> tuple[js.System, js.State, float]:
    """The sheet with stiffness 1, its start, and its highest frequency at rest [1/s] for that stiffness."""
    net = js.lattice((N, N), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.concatenate([net.grid(1.0), np.zeros((N * N, 1))], axis=1)
    free = np.ones(N * N, bool)
    free[[0, N - 1]] = False
    system = js.System(net, 1.0, js.Springs(net, 1.0, net.lengths(flat)), free=free)
    bumps = CRUMPLE * np.random.default_rng(3).standard_normal(flat.shape)
    highest = float(js.normal_modes(system, js.State.from_points(net, flat)).frequencies[-1])
    return system, js.State.from_points(net, flat + free[:, None] * bumps), highest


@eqx.filter_jit
def outcome(system: js.System, start: js.State, stepper: js.Stepper, k: jax.Array, dt: jax.Array) -> jax.Array:
    """(L,) index into `OUTCOMES` for L pairs of stiffness [N/m] and dt [s]."""

    def one(k: jax.Array, dt: jax.Array) -> jax.Array:
        lane = js.replace(system, stiffness=k)
        run = js.rollout(lane, start, stepper, dt, N_STEPS, save_every=1, observe=lambda s: lane.energy(s).total)
        first = lane.energy(start).total
        highest = jnp.max(jnp.where(jnp.isfinite(run.saved), run.saved, jnp.inf)) / first
        rise = jnp.max(jnp.diff(jnp.concatenate([first[None], run.saved]))) / first
        silent = run.status.flags == jnp.zeros((), jnp.uint32)
        grown = jnp.where(silent, 3, 2)
        calm = jnp.where(rise < 1e-2, 0, 1)
        return jnp.where(highest > 1e6, jnp.where(silent, 3, 4), jnp.where(highest > 10, grown, calm))

    # One lane after the other: side by side all would wait for the slowest solve.
    return jax.lax.map(lambda pair: one(*pair), (k, dt))


def draw(maps: dict[str, np.ndarray], k: np.ndarray, dt: np.ndarray, highest: float, path: Path) -> None:
    """One panel per stepper."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 9.5), layout="constrained")
    norm, colors = BoundaryNorm(np.arange(len(OUTCOMES) + 1) - 0.5, len(OUTCOMES)), ListedColormap(COLORS)
    grid: Any = figure.subplots(3, 3, sharex=True, sharey=True)
    mesh: Any = None
    for axes, (name, cells) in zip(grid.ravel(), maps.items(), strict=True):
        mesh = axes.pcolormesh(k, dt, cells.T, cmap=colors, norm=norm, shading="nearest")
        axes.plot(k, 2 / (highest * np.sqrt(k)), "k--", linewidth=1, label="omega dt = 2")
        axes.set(title=name, xscale="log", yscale="log", ylim=(dt[0], dt[-1]))
    for axes in grid[-1]:
        axes.set_xlabel("stiffness [N/m]")
    for axes in grid[:, 0]:
        axes.set_ylabel("dt [s]")
    grid[0, 0].legend(loc="lower left", fontsize=8)
    bar = figure.colorbar(mesh, ax=grid, ticks=range(len(OUTCOMES)), shrink=0.5)
    bar.ax.set_yticklabels(OUTCOMES)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Compute, print, write and draw."""
    quick = arguments(__doc__).quick
    jax.config.update("jax_enable_x64", True)
    side = 7 if quick else 21
    system, start, highest = sheet()
    k, dt = np.logspace(0, 6, side), np.logspace(-4, 1, side)
    maps, rows = {}, []
    for name, stepper in STEPPERS.items():
        clock = Stopwatch()
        lanes = [jnp.asarray(a.ravel()) for a in np.meshgrid(k, dt, indexing="ij")]
        jitted: Any = outcome
        program = jitted.lower(system, start, stepper, *lanes).compile()
        compile_s = clock.seconds
        maps[name] = np.asarray(program(system, start, stepper, *lanes)).reshape(side, side)
        counts = {word: int(np.sum(maps[name] == i)) for i, word in enumerate(OUTCOMES)}
        rows.append({"stepper": name, **counts, "seconds": clock.seconds - compile_s, "compile_s": compile_s})
    show(f"{side} x {side} runs of {N_STEPS} steps each", rows)
    tables = {"stiffness": k, "dt": dt, "outcomes": OUTCOMES, "maps": {name: cells.tolist() for name, cells in maps.items()}, "rows": rows}
    path = write("stability_map", {"n": N, "n_steps": N_STEPS, "crumple": CRUMPLE}, tables)
    draw(maps, k, dt, highest, path.with_suffix(".png"))
    print(f"\n{path}, {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
