"""What does a second of measured cloth cost, explicit and implicit, forward and with a gradient, and which is cheaper for an error of 1 %?

    python -m benchmarks.cloth [--quick]

A sheet of interlock jersey, 30 cm square, a lattice of n x n nodes with springs along rows and diagonals and joints along rows, n = 32 to
256, held level by two corners and let go, float64. Explicit: symplectic Euler at 0.9 of `stable_dt`. Implicit: backward Euler at 1/100 s.
The gradient is that of the mean height at the end by both B and the density. What is compared is the library with itself: the peers of
`benchmarks.peers` have no joints of a measured B.

Read: `per_second` is seconds per simulated second, the median of interleaved rounds; `backward` the gradient's over the forward run's;
`error` the root mean square distance from velocity Verlet at a quarter of the explicit dt, over that of the reference from its start. The
second table is one simulated second of the 64 x 64 sheet, each stepper at several dt, and the cheapest of those within 1 %. The third is
Cusick's coefficient of this fabric, from ten random starts, on three meshes.

Needs: pip install 'jaxspring[bench]'
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

from .measure import Case, Panel, arguments, draw, measure, show, write

SIDE, GRAVITY = 0.3, 9.81
SAFE, DT = 0.9, 0.01
ENOUGH = 0.01
SPACINGS = (0.025, 0.018, 0.0125)
N_STARTS = 10


def sheet(n: int) -> tuple[Any, np.ndarray, np.ndarray]:
    """Net, flat points, and which nodes are free."""
    net = js.lattice((n, n), springs=js.STRUCTURAL + js.SHEAR)
    flat = np.pad(net.grid(SIDE / (n - 1)), ((0, 0), (0, 1)))
    free = np.ones(n * n, bool)
    free[[-n, -1]] = False
    return net, flat, free


def system_of(parts: tuple[Any, np.ndarray, np.ndarray], numbers: dict[str, Any]) -> js.System:
    """The sheet of a fabric with these numbers."""
    net, flat, free = parts
    jersey = js.cloth.INTERLOCK.fabric()
    cloth = js.cloth.fabric(net, flat, js.cloth.Fabric(numbers["density"], jersey.stretch, jersey.shear, numbers["bending"]))
    return js.System(net, cloth.mass, (*cloth.forces, js.Gravity((0.0, 0.0, -GRAVITY))), free=free)


def given() -> dict[str, Any]:
    """What the gradient is taken by."""
    jersey = js.cloth.INTERLOCK.fabric()
    return {"density": jersey.density, "bending": jersey.bending}


def runs(parts: tuple[Any, np.ndarray, np.ndarray], stepper: js.Stepper, dt: float, seconds: float) -> tuple[Any, Any]:
    """The run as a function of the numbers, to its places; and the gradient of their mean height."""
    start, n_steps = js.State.from_points(parts[0], parts[1]), max(1, round(seconds / dt))

    def places(numbers: dict[str, Any]) -> jax.Array:
        return js.rollout(system_of(parts, numbers), start, stepper, seconds / n_steps, n_steps).state.points

    return jax.jit(places), jax.jit(jax.value_and_grad(lambda numbers: jnp.mean(places(numbers)[:, 2])))


def limit(parts: tuple[Any, np.ndarray, np.ndarray]) -> float:
    """The largest stable explicit dt [s]."""
    return float(js.stable_dt(system_of(parts, given()), js.State.from_points(parts[0], parts[1])))


def distance(found: Any, reference: np.ndarray, start: np.ndarray) -> float:
    """Root mean square of the distance, over that of the reference from the start."""
    return float(np.linalg.norm(np.asarray(found) - reference) / np.linalg.norm(reference - start))


def sizes(quick: bool) -> list[dict[str, Any]]:
    """Every size, explicit and implicit, forward and gradient."""
    table, seconds = [], 0.1 if quick else 0.2
    for n in (16, 32) if quick else (32, 64, 128, 256):
        parts = sheet(n)
        explicit = SAFE * limit(parts)
        fine = np.asarray(runs(parts, js.VelocityVerlet(), explicit / 4, seconds)[0](given()))
        cases = []
        for name, stepper, dt in (("explicit", js.SymplecticEuler(), explicit), ("implicit", js.BackwardEuler(), DT)):
            forward, gradient = runs(parts, stepper, dt, seconds)
            cases += [Case(name, forward, (given(),)), Case(f"{name} gradient", gradient, (given(),))]
        rows = measure(cases, 3 if quick else 5)
        for name, dt in (("explicit", explicit), ("implicit", DT)):
            ahead, back = rows[name], rows[f"{name} gradient"]
            table.append(
                {
                    "n": n,
                    "way": name,
                    "dt": dt,
                    "per_second": ahead.run_s / seconds,
                    "gradient_per_second": back.run_s / seconds,
                    "backward": back.run_s / ahead.run_s,
                    "compile_s": ahead.compile_s,
                    "first_gradient_s": back.first_s,
                    "temporary_mib": back.temporary_mib,
                    "error": distance(runs_again(cases, name), fine, parts[1]),
                }
            )
        show(f"{n} x {n} nodes, {seconds} s", [row for row in table if row["n"] == n])
    return table


def runs_again(cases: list[Case], name: str) -> Any:
    """The places of a case."""
    (case,) = [case for case in cases if case.name == name]
    return case.function(*case.arguments)


def for_one_percent(quick: bool) -> list[dict[str, Any]]:
    """One simulated second of a sheet, each stepper at several dt: seconds and errors."""
    n, seconds = (16, 0.3) if quick else (64, 1.0)
    parts = sheet(n)
    explicit = SAFE * limit(parts)
    fine = np.asarray(runs(parts, js.VelocityVerlet(), explicit / 4, seconds)[0](given()))
    tried = [("symplectic Euler", js.SymplecticEuler(), explicit), ("velocity Verlet", js.VelocityVerlet(), explicit)]
    tried += [("backward Euler", js.BackwardEuler(), 0.01 / 4**i) for i in range(4)]
    tried += [
        (name, stepper, 0.01 / 4**i) for name, stepper in (("BDF2", js.BDF2()), ("midpoint", js.ImplicitMidpoint())) for i in range(3)
    ]
    cases = [Case(f"{name} {dt:.3g}", runs(parts, stepper, dt, seconds)[0], (given(),)) for name, stepper, dt in tried]
    rows = measure(cases, 1 if quick else 3)
    table = []
    for case, (name, _, dt) in zip(cases, tried, strict=True):
        wrong = distance(runs_again(cases, case.name), fine, parts[1])
        table.append({"stepper": name, "dt": dt, "seconds": rows[case.name].run_s, "error": wrong, "enough": str(wrong <= ENOUGH)})
    show(f"{n} x {n} nodes, {seconds} s; explicit limit {explicit / SAFE:.3g} s", table)
    enough = [row for row in table if row["error"] <= ENOUGH]
    print("cheapest within 1 %:", min(enough, key=lambda row: row["seconds"])["stepper"] if enough else "none")
    return table


def drapes(quick: bool) -> list[dict[str, Any]]:
    """Cusick's coefficient from random starts, on meshes of three spacings."""
    table = []
    for spacing in SPACINGS[: 1 if quick else None]:
        scene = js.cloth.cusick(js.cloth.ClothSettings(spacing=spacing))
        overhangs = np.hypot(scene.points[:, 0], scene.points[:, 1]) > 0.09 + 1e-9

        @jax.jit
        def rest(heights: jax.Array, scene: js.cloth.ClothScene = scene) -> Any:
            start = js.State.from_points(scene.cloth.net, jnp.asarray(scene.points).at[:, 2].set(heights))
            found = js.equilibrium(scene.system, start, tolerance=1e-7)
            return js.cloth.drape_coefficient(scene, found.state), found.status.is_ok

        found = []
        for seed in range(N_STARTS):
            heights = np.where(overhangs, 1e-3 * np.random.default_rng(seed).normal(size=len(scene.points)), 0.0)
            coefficient, is_ok = rest(heights)
            found += [float(coefficient)] if is_ok else []
        low, middle, high = (float(q) for q in np.quantile(found, [0, 0.5, 1]))
        spread = float(np.std(found))
        row = {"spacing": spacing, "nodes": len(scene.points), "at_rest": len(found), "median": middle}
        table.append({**row, "low": low, "high": high, "deviation": spread})
    show(f"Cusick's coefficient of interlock, {N_STARTS} random starts", table)
    return table


def main() -> None:
    """Measure, print, write and draw."""
    jax.config.update("jax_enable_x64", True)
    quick = arguments(__doc__).quick
    by_size, by_dt, draped = sizes(quick), for_one_percent(quick), drapes(quick)
    path = write("cloth", {"side": SIDE, "quick": quick}, {"sizes": by_size, "one_percent": by_dt, "drape": draped})

    def curve(way: str, column: str) -> tuple[list[float], list[float]]:
        rows = [row for row in by_size if row["way"] == way]
        return [row["n"] ** 2 for row in rows], [row[column] for row in rows]

    ways = (("explicit", "o-"), ("implicit", "s-"))
    cost = Panel("Seconds per simulated second", "s", {(way, style): curve(way, "per_second") for way, style in ways}, log=True)
    back = Panel("Gradient over forward", "ratio", {(way, style): curve(way, "backward") for way, style in ways})
    names = list(dict.fromkeys(row["stepper"] for row in by_dt))
    of = {name: [row for row in by_dt if row["stepper"] == name] for name in names}
    errors = {(name, "o-"): ([row["seconds"] for row in rows], [row["error"] for row in rows]) for name, rows in of.items()}
    draw([cost, back, Panel("Error over cost", "error", errors, log=True, bound=ENOUGH, xlabel="seconds")], path.with_suffix(".png"))
    print(f"\n{path}, {path.with_suffix('.png')}")


if __name__ == "__main__":
    main()
