"""How fast are many scenes at once, in chunks and on two devices?

    python -m benchmarks.batches [--quick]

1,024 cloths of 16 x 16 (structural, shear, bend; every scene with its own start and stiffness), symplectic Euler, 100 steps, float32, with
statuses. Read: `M` is million node-steps a second, `over_vmap` the time over that of `jax.vmap` in the same interleaved rounds. Then
weak scaling, each in a process of its own: 512 scenes on one host device and one core, 1,024 on two; one cloth of 256 rows of 1,024
nodes on one, of 512 rows on two. `efficiency` is the time on one over that on two.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

from . import scenes
from .measure import RESULTS, Case, Panel, draw, measure, show, write
from .measure import arguments as parsed

N, STEPS, COLUMNS = 16, 100, 1024
ROOT = Path(__file__).resolve().parents[1]


def inputs(n_scenes: int) -> tuple[Any, Any]:
    """Starts (B, N, 3) and stiffnesses (B, E)."""
    net, rng = js.lattice((N, N), springs=scenes.FAMILIES), np.random.default_rng(0)
    grid = np.pad(net.grid(), ((0, 0), (0, 1)))
    points = grid + 0.05 * rng.standard_normal((n_scenes, N * N, 3))
    return jnp.asarray(points, jnp.float32), jnp.asarray(1 + 0.1 * rng.random((n_scenes, net.n_springs)), jnp.float32)


def scene(points: Any, k: Any) -> Any:
    """One cloth: its last points and its status."""
    net = js.lattice((N, N), springs=scenes.FAMILIES)
    system = js.System(net, 1.0, js.Springs(net, k, jnp.float32(1)))
    run = js.rollout(system, js.State.from_points(net, points), js.SymplecticEuler(), 0.05, STEPS)
    return run.state.points, run.status


def chunks(n_scenes: int, rounds: int) -> list[dict]:
    """One row per way."""
    given = inputs(n_scenes)
    ways = {"jax.vmap": jax.vmap(scene), "js.batch": js.batch(scene)}
    ways |= {f"js.batch, chunk={c}": js.batch(scene, chunk=c) for c in (1, 8, 32, 128)}
    timed = measure([Case(name, jax.jit(way), given) for name, way in ways.items()], rounds)
    work, plain = n_scenes * N * N * STEPS, timed["jax.vmap"].run_s
    return [
        {
            "way": name,
            "M": work / row.run_s / 1e6,
            "over_vmap": row.run_s / plain,
            "compile_s": row.compile_s,
            "temporary_mib": row.temporary_mib,
        }
        for name, row in timed.items()
    ]


def on_devices(what: str, n_devices: int, size: int, rounds: int) -> dict:
    """Weak scaling, in a process with so many host devices, and as many cores."""
    flags = f"--xla_force_host_platform_device_count={n_devices} --xla_cpu_multi_thread_eigen=false"
    cores = ",".join(str(core) for core in sorted(os.sched_getaffinity(0))[:n_devices])
    command = ["taskset", "-c", cores, sys.executable, "-m", "benchmarks.batches", what, str(size), str(rounds)]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def serve(what: str, size: int, rounds: int) -> None:
    """What `on_devices` starts: a line of JSON."""
    mesh = jax.make_mesh((jax.device_count(),), ("shared",))
    if what == "--scenes":
        case, nodes = Case(what, jax.jit(js.batch(scene, mesh=mesh)), inputs(size)), size * N * N
    else:
        case, nodes = Case(what, *large(size, mesh)), size * COLUMNS
    row = measure([case], rounds)[what]
    rate = nodes * STEPS / row.run_s / 1e6
    print(json.dumps({"devices": jax.device_count(), "nodes": nodes, "seconds": row.run_s, "M": rate, "compile_s": row.compile_s}))


def large(rows: int, mesh: Any) -> tuple[Any, tuple[Any, ...]]:
    """One cloth of so many rows, shared out."""
    net, rng = js.lattice((rows, COLUMNS), springs=scenes.FAMILIES), np.random.default_rng(0)
    points = np.pad(net.grid(), ((0, 0), (0, 1))) + 0.05 * rng.standard_normal((rows * COLUMNS, 3))
    state = js.domain(js.State.from_points(net, points.astype(np.float32)), mesh)
    k = jnp.asarray(1 + 0.1 * rng.random(net.n_springs), jnp.float32)

    def run(k: Any, state: js.State) -> Any:
        return js.rollout(js.System(net, 1.0, js.Springs(net, k, jnp.float32(1))), state, js.SymplecticEuler(), 0.05, STEPS)

    return jax.jit(run), (k, state)


def main() -> None:
    """Measure, print, write the table and the picture."""
    if sys.argv[1:2] in (["--scenes"], ["--rows"]):
        serve(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
        return
    quick = parsed(__doc__).quick
    n_scenes, rounds = (128, 3) if quick else (1024, 7)
    table = chunks(n_scenes, rounds)
    show(f"{n_scenes} cloths of {N} x {N}", table)
    scaling, rows = [], 128 if quick else 256
    for what, size in (("--scenes", n_scenes // 2), ("--rows", rows)):
        one, two = (on_devices(what, n, n * size, rounds) for n in (1, 2))
        scaling += [{"what": what[2:], **row, "efficiency": one["seconds"] / row["seconds"]} for row in (one, two)]
    show("weak scaling over host devices", scaling)
    settings = {"dtype": "float32", "rounds": rounds, "scenes": n_scenes, "steps": STEPS, "rows": rows, "columns": COLUMNS}
    write("batches", settings, {"chunks": table, "scaling": scaling})
    sizes = [float(row["way"].split("=")[1]) for row in table[2:]]
    curves = {("js.batch", "o-"): (sizes, [row["M"] for row in table[2:]]), ("jax.vmap", "s"): ([float(n_scenes)], [table[0]["M"]])}
    of = {what: [row for row in scaling if row["what"] == what] for what in ("scenes", "rows")}
    names = {"scenes": "js.batch: 512 cloths per device", "rows": "js.domain: 256 rows per device"}
    at = [1.0, 2.0]
    devices = {(names[what], style): (at, [row["M"] for row in of[what]]) for what, style in (("scenes", "o-"), ("rows", "s-"))}
    speed = "million node-steps / s"
    panels = [Panel(f"{n_scenes} cloths of 16 x 16", speed, curves, xlabel="scenes in a chunk")]
    draw([*panels, Panel("weak scaling", speed, devices, xlabel="devices")], RESULTS / "batches.png")


if __name__ == "__main__":
    main()
