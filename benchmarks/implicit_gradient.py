"""What does the gradient of implicit steps cost beside the steps themselves, and in how much memory?

    python -m benchmarks.implicit_gradient [--quick]

A stiff cloth of 64 x 64 nodes, structural and shear springs, held by two corners, crumpled, at ten times the explicit limit; backward
Euler with block-Jacobi conjugate gradients, one tolerance for solves and adjoints. The gradient is that of the mean square displacement
by every stiffness. Two ways to remember are timed beside the forward run, in interleaved rounds. Read: `backward` is
(gradient - forward) / forward in seconds; wanted are at most 1.5 for `StoreStates` (x, v and the solution of every step) and 2.7 for
`Checkpointed` (about 2 sqrt(T) states). `agreement` is the largest difference of the gradient from that of `Checkpointed`, over its norm.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

from .measure import Case, Panel, arguments, draw, measure, show, write

TOLERANCE = 1e-6
DT_OVER_LIMIT = 10.0
WAYS = {"StoreStates": js.StoreStates(), "Checkpointed": js.Checkpointed()}


def cloth(n: int) -> tuple[js.System, js.State, np.ndarray, float]:
    """The cloth, its start, a stiffness per spring [N/m], and dt [s]."""
    net = js.lattice((n, n), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.concatenate([net.grid(0.1), np.zeros((n * n, 1))], axis=1)
    rng = np.random.default_rng(3)
    stiffness = 1e4 * rng.uniform(0.5, 1.5, net.n_springs)
    free = np.ones(n * n, bool)
    free[[0, n - 1]] = False
    springs = js.Springs(net, stiffness, net.lengths(flat))
    system = js.System(net, 0.01, (springs, js.Gravity([0.0, 0.0, -9.81])), free=free)
    start = js.State.from_points(net, flat + 0.005 * rng.standard_normal(flat.shape))
    return system, start, stiffness, DT_OVER_LIMIT * float(js.stable_dt(system, start, js.SymplecticEuler()))


def cases(n: int, n_steps: int) -> list[Case]:
    """The forward run and a gradient for each way to remember."""
    system, start, stiffness, dt = cloth(n)
    stepper = js.BackwardEuler(js.CG(tolerance=TOLERANCE))

    def loss(k: jax.Array, adjoint: Any) -> jax.Array:
        run = js.rollout(js.replace(system, stiffness=k), start, stepper, dt, n_steps, adjoint=adjoint)
        moved = run.state.position - start.position
        return jnp.mean(moved.dot(moved))

    k = jnp.asarray(stiffness)
    forward = Case("forward", jax.jit(lambda k: loss(k, js.Checkpointed())), (k,))
    backward = [Case(name, jax.jit(jax.grad(lambda k, way=way: loss(k, way))), (k,)) for name, way in WAYS.items()]
    return [forward, *backward]


def main() -> None:
    """Measure, print, write and draw."""
    jax.config.update("jax_enable_x64", True)
    quick = arguments(__doc__).quick
    table, n_steps, rounds = [], (20 if quick else 100), (3 if quick else 5)
    for n in (16, 32) if quick else (16, 32, 64):
        made = cases(n, n_steps)
        rows = measure(made, rounds)
        gradients = {case.name: np.asarray(case.function(*case.arguments)) for case in made[1:]}
        base, reference = rows["forward"], gradients["Checkpointed"]
        for name, row in rows.items():
            differs = np.max(np.abs(gradients[name] - reference)) / np.linalg.norm(reference) if name in gradients else None
            table.append(
                {
                    "n": n,
                    "way": name,
                    "seconds": row.run_s,
                    "backward": None if name == "forward" else row.run_s / base.run_s - 1,
                    "temporary_mib": row.temporary_mib,
                    "compile_s": row.compile_s,
                    "first_gradient_s": None if name == "forward" else row.first_s,
                    "agreement": None if differs is None else float(differs),
                }
            )
        show(f"{n} x {n} nodes, {n_steps} steps", [row for row in table if row["n"] == n])
    path = write("implicit_gradient", {"n_steps": n_steps, "tolerance": TOLERANCE, "dt_over_limit": DT_OVER_LIMIT}, {"rows": table})

    def curve(way: str, column: str) -> tuple[list[float], list[float]]:
        rows = [row for row in table if row["way"] == way]
        return [row["n"] ** 2 for row in rows], [row[column] for row in rows]

    cost = Panel(
        "Backward pass", "forward runs", {(way, style): curve(way, "backward") for way, style in zip(WAYS, ("o-", "s-"), strict=True)}
    )
    memory = Panel(
        "Memory",
        "temporary MiB",
        {(way, style): curve(way, "temporary_mib") for way, style in zip(WAYS, ("o-", "s-"), strict=True)},
        log=True,
    )
    draw([cost, memory], path.with_suffix(".png"))
    print(f"\n{path}, {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
