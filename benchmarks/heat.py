"""What does heat cost on a lattice in space, and how accurate is it?

    python -m benchmarks.heat [--quick]

An insulated block of 64 x 64 x 64 nodes whose conductivity varies a hundredfold, with a smooth start, to one fixed time, by every scheme
at dt of 1/2 (explicit) and 4 to 64 times the explicit limit, in float64. The reference is Crank-Nicolson at half the limit.

Read: `seconds` is the whole run without compilation (`compile_s`, with the first run), `error` the largest distance from the reference
over the range of temperatures, `drift` the relative change of the body's heat. `seconds` over `error` tells which scheme to take.

Needs: pip install 'jaxspring[bench]'
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js
from jaxspring.progress import Stopwatch
from jaxspring.thermal.schemes import HeatScheme

from .measure import arguments, show, write

# Wanted residual of linear solves: below the error of any scheme here.
TOLERANCE = 1e-8


def block(n: int) -> tuple[js.Lattice, Any, np.ndarray]:
    """Net, conductances and temperatures of the block."""
    net = js.lattice((n, n, n))
    x, y, z = net.grid(1 / n).T
    conductivity = 10 ** (np.sin(5 * x) * np.cos(4 * y) + 0.5 * np.sin(7 * z) - 0.5)
    start = 300 + 100 * np.exp(-20 * ((x - 0.4) ** 2 + (y - 0.5) ** 2 + (z - 0.6) ** 2))
    return net, js.thermal.conductances(net, conductivity, 1.0), start


def grid_of(heat: js.Heat) -> np.ndarray:
    """Where the nodes of its lattice are, a metre apart."""
    assert isinstance(heat.net, js.Lattice)
    return heat.net.grid()


@eqx.filter_jit
def advance(heat: js.Heat, temperature: Any, dt: Any, n_steps: int) -> tuple[Any, Any, Any]:
    """Temperature, heat and status after the steps."""
    start = js.State.from_points(heat.net, grid_of(heat), temperature=temperature)
    run = js.rollout(js.System(heat.net, 1.0, rules=heat), start, js.Still(), dt, n_steps)
    return run.state.temperature, js.thermal.total_heat(heat, run.state) / js.thermal.total_heat(heat, start) - 1, run.status


def measured(name: str, heat: js.Heat, start: Any, end_time: float, n_steps: int, limit: float, reference: Any) -> dict[str, Any]:
    """One row: a run timed after its compilation."""
    clock = Stopwatch()
    dt = jnp.asarray(end_time / n_steps)
    end, drift, status = jax.block_until_ready(advance(heat, start, dt, n_steps))
    compile_s = clock.seconds
    seconds = []
    for _ in range(3):
        clock = Stopwatch()
        jax.block_until_ready(advance(heat, start, dt, n_steps))
        seconds.append(clock.seconds)
    row = {
        "scheme": name,
        "dt_over_limit": end_time / n_steps / limit,
        "steps": n_steps,
        "seconds": float(np.median(seconds)),
        "error": None if reference is None else float(jnp.max(jnp.abs(end - reference)) / np.ptp(start)),
        "drift": abs(float(drift)),
        "compile_s": compile_s,
        "status": status.describe().split(":")[0],
    }
    print({key: row[key] for key in ("scheme", "dt_over_limit", "seconds", "error", "compile_s", "status")}, flush=True)
    return row


def schemes(net: js.Lattice) -> dict[str, HeatScheme]:
    """Those for long steps."""
    plain, grids = js.JaxCG(TOLERANCE), js.JaxCG(TOLERANCE, preconditioner=js.linalg.Multigrid(net))
    return {
        "SplitHeat": js.thermal.SplitHeat(),
        "SymmetricSplitHeat": js.thermal.SymmetricSplitHeat(),
        "BackwardEulerHeat": js.thermal.BackwardEulerHeat(plain),
        "BackwardEulerHeat, Multigrid": js.thermal.BackwardEulerHeat(grids),
        "CrankNicolsonHeat": js.thermal.CrankNicolsonHeat(plain),
        "CrankNicolsonHeat, Multigrid": js.thermal.CrankNicolsonHeat(grids),
    }


def picture(rows: list[dict[str, Any]], path: Any) -> None:
    """Error over seconds, a curve per scheme."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 4.2), layout="constrained")
    axes = figure.subplots()
    for name in dict.fromkeys(row["scheme"] for row in rows):
        mine = [row for row in rows if row["scheme"] == name]
        axes.plot([r["seconds"] for r in mine], [r["error"] for r in mine], "o-", label=name)
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="error", title="heat on a block")
    axes.legend(fontsize=8)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    n = 16 if quick else 64
    with jax.enable_x64(True):
        net, conductance, start = block(n)
        system = js.System(net, 1.0, rules=js.Heat(net, 1.0, conductance))
        limit = float(js.stable_dt(system, js.State.from_points(net, net.grid(), temperature=start)))
        end_time = 64 * limit
        exact = js.Heat(net, 1.0, conductance, js.thermal.CrankNicolsonHeat(js.JaxCG(1e-11)))
        reference, _, _ = advance(exact, start, jnp.asarray(0.5 * limit), 128)
        rows = [measured("ExplicitHeat", js.Heat(net, 1.0, conductance), start, end_time, 128, limit, reference)]
        for name, scheme in schemes(net).items():
            # Multigrid takes long to compile, and pays for long steps alone.
            for times in (64,) if "Multigrid" in name else (4, 16, 64):
                heat = js.Heat(net, 1.0, conductance, scheme)
                rows.append(measured(name, heat, start, end_time, 64 // times, limit, reference))
    show(f"heat for 64 explicit limits, {n}^3 nodes", rows)
    path = write("heat", {"n": n, "dtype": "float64", "tolerance": TOLERANCE}, {"rows": rows})
    picture(rows, path.with_suffix(".png"))
    print(f"\nwritten: {path}")


if __name__ == "__main__":
    main()
