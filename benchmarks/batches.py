"""How fast are many scenes at once, in chunks and on two devices?

    python -m benchmarks.batches [--quick]

1,024 cloths of 16 x 16 (structural, shear, bend; every scene with its own start and stiffness), symplectic Euler, 100 steps, float32, with
statuses. Read: `M` is million node-steps a second, `over_vmap` the time over that of `jax.vmap` in the same interleaved rounds. Then
weak scaling: 512 scenes on one host device and one core, 1,024 on two, each in a process of its own; `efficiency` is the time on one over
that on two.
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

N, STEPS = 16, 100
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


def on_devices(n_devices: int, n_scenes: int, rounds: int) -> dict:
    """Weak scaling, in a process with so many host devices, and as many cores."""
    flags = f"--xla_force_host_platform_device_count={n_devices} --xla_cpu_multi_thread_eigen=false"
    cores = ",".join(str(core) for core in sorted(os.sched_getaffinity(0))[:n_devices])
    command = ["taskset", "-c", cores, sys.executable, "-m", "benchmarks.batches", "--devices", str(n_scenes), str(rounds)]
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, "XLA_FLAGS": flags}, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def serve(n_scenes: int, rounds: int) -> None:
    """What `on_devices` starts: a line of JSON."""
    mesh = jax.make_mesh((jax.device_count(),), ("scenes",))
    timed = measure([Case("batch", jax.jit(js.batch(scene, mesh=mesh)), inputs(n_scenes))], rounds)["batch"]
    rate = n_scenes * N * N * STEPS / timed.run_s / 1e6
    print(json.dumps({"devices": jax.device_count(), "scenes": n_scenes, "seconds": timed.run_s, "M": rate}))


def main() -> None:
    """Measure, print, write the table and the picture."""
    if sys.argv[1:2] == ["--devices"]:
        serve(int(sys.argv[2]), int(sys.argv[3]))
        return
    quick = parsed(__doc__).quick
    n_scenes, rounds = (128, 3) if quick else (1024, 7)
    table = chunks(n_scenes, rounds)
    show(f"{n_scenes} cloths of {N} x {N}", table)
    scaling = [on_devices(n, n * n_scenes // 2, rounds) for n in (1, 2)]
    for row in scaling:
        row["efficiency"] = scaling[0]["seconds"] / row["seconds"]
    show("weak scaling over host devices", scaling)
    settings = {"dtype": "float32", "rounds": rounds, "scenes": n_scenes, "steps": STEPS}
    write("batches", settings, {"chunks": table, "scaling": scaling})
    sizes = [float(row["way"].split("=")[1]) for row in table[2:]]
    curves = {("js.batch", "o-"): (sizes, [row["M"] for row in table[2:]]), ("jax.vmap", "s"): ([float(n_scenes)], [table[0]["M"]])}
    devices = {("weak scaling", "o-"): ([float(row["devices"]) for row in scaling], [float(row["M"]) for row in scaling])}
    speed = "million node-steps / s"
    panels = [Panel(f"{n_scenes} cloths of 16 x 16", speed, curves, xlabel="scenes in a chunk")]
    draw([*panels, Panel("512 cloths per device", speed, devices, xlabel="devices")], RESULTS / "batches.png")


if __name__ == "__main__":
    main()
