"""What does contact cost over a bare step, by obstacle, forward and in the gradient?

    python -m benchmarks.contact [--quick]

A sheet of 1e2 to 1e5 nodes with structural and shear springs and weight, in space, float32, symplectic Euler, 50 steps; it lies on the
obstacle, so that about half of the nodes touch. One row for each obstacle, as a penalty without and with damper and friction; `Floor`, the
rule that splits the step at an impact; contact of nodes with nodes by a list. Every one at 1e3 and 1e5 nodes, those of FEW at 1e2 and 1e4
too: compiling 26 programs at a size is most of the time. Rows are printed as they are measured. A list sorts nodes into cells as if they
filled space, so that for a flat sheet it wants a capacity of 76 at 1e3 nodes, 120 at 1e4 and 270 at 1e5, where it is left out here.

Read: ns is what the obstacle adds to a step, per node; `ratio` the whole step over the bare one, the median of interleaved rounds; and
the same for the gradient of the squared places by the start. `touch` is the share of nodes inside, `error` the largest difference of the
obstacle's force from float64, over the largest force. Draws the ratios.

Needs: pip install 'jaxspring[bench]'
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxspring as js

from .measure import RESULTS, Case, Panel, arguments, draw, measure, show, write

N_STEPS, SPACING, DT = 50, 0.1, 1e-4
STIFFNESS, ONSET = 500.0, 5e-3
MOST_LISTED = 20_000
FEW = ("bare", "Floor", "plane", "sphere, friction", "nodes, list")


def ball() -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a rough ball, 320 triangles, of radius 1."""
    golden = (1 + 5**0.5) / 2
    points = np.array([[s, t * golden, 0] for s in (-1, 1) for t in (-1, 1)])
    points = np.concatenate([np.roll(points, i, axis=1) for i in range(3)])
    from scipy.spatial import ConvexHull

    for _ in range(2):
        points = points / np.linalg.norm(points, axis=1, keepdims=True)
        corners = points[ConvexHull(points).simplices]
        points = np.concatenate([points, np.unique(np.round((corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2, 12), axis=0)])
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    found = ConvexHull(points)
    outward = np.einsum("fd,fd->f", np.cross(*np.diff(points[found.simplices], axis=1).transpose(1, 0, 2)), found.equations[:, :3]) > 0
    return points, np.where(outward[:, None], found.simplices, found.simplices[:, ::-1])


def obstacles(size: float) -> dict[str, js.contact.Obstacle]:
    """Obstacles whose top is at z = 0, below a sheet of this size [m]."""
    c, big = js.contact, 50 * size
    middle = (0.5 * size, 0.5 * size)
    x, y = np.meshgrid(np.linspace(0, 1, 32), np.linspace(0, 1, 32))
    vertices, faces = ball()
    return {
        "plane": c.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        "half-spaces": c.HalfSpaces([(0.0, 0.0, 0.0)] * 2, [(0.0, 0.0, 1.0), (0.02, 0.0, 1.0)]),
        "sphere": c.Sphere((*middle, -big), big),
        "box": c.Box((*middle, -1.0), (size, size, 1.0)),
        "capsule": c.Capsule((-big, middle[1], -big), (big, middle[1], -big), big),
        "cylinder": c.Cylinder((-big, middle[1], -big), (big, middle[1], -big), big),
        "height field": c.HeightField(js.Image(0.01 * np.sin(9 * x) * np.cos(7 * y), spacing=size / 31)),
        "mesh": c.MeshField(vertices * size * 3 + [*middle, -2.95 * size], faces, size / 4),
        "moving plane": c.Moving(c.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), lambda t: jnp.stack([t, t * 0, t * 0])),
    }


def contacts(net: js.Lattice, points: np.ndarray, size: float) -> dict[str, tuple[tuple[js.Force, ...], tuple[js.Rule, ...]]]:
    """Forces and rules that stand for contact, by name."""
    c = js.contact
    found: dict[str, Any] = {"bare": ((), ()), "Floor": ((), (js.Floor((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),))}
    for name, obstacle in obstacles(size).items():
        found[name] = ((c.Penalty(obstacle, STIFFNESS, onset=ONSET),), ())
    rough = c.Penalty(c.Sphere((0.5 * size, 0.5 * size, -50 * size), 50 * size), STIFFNESS, 1.0, 0.3, ONSET, 0.1)
    found["sphere, friction"] = ((rough,), ())
    if net.n_nodes > MOST_LISTED:
        return found
    lists = js.fluid.NeighbourList(120 if net.n_nodes > 2000 else 76, 0.3 * SPACING)
    found["nodes, list"] = ((c.NodeContact(net, 0.45 * SPACING, STIFFNESS, onset=ONSET, rest=points, pairs=lists),), ())
    return found


def force_error(force: js.Force | None, net: js.Lattice, points: np.ndarray) -> tuple[float | None, float | None]:
    """Largest difference from float64 over the largest force, and the share of nodes that touch."""
    if force is None:
        return None, None
    ends = []
    for wide in (False, True):
        with jax.enable_x64(wide):
            part = jax.tree.map(lambda a: a.astype(float) if eqx.is_inexact_array(a) else a, force) if wide else force
            system = js.System(net, 1.0, part)
            ends.append(
                np.stack(
                    [
                        np.asarray(net.flatten_nodes(a))
                        for a in system.force(js.State.from_points(net, points.astype(float) if wide else points))
                    ],
                    axis=-1,
                )
            )
    largest = np.abs(ends[1]).max()
    return (float(np.abs(ends[0] - ends[1]).max() / largest) if largest else 0.0, float((np.abs(ends[1]).max(axis=1) > 0).mean()))


def one_size(side: int, rounds: int, few: bool) -> list[dict]:
    """A row for each obstacle under a sheet of side x side nodes, or for those of FEW."""
    net, plain = js.lattice((side, side), js.STRUCTURAL + js.SHEAR), js.lattice((side, side))
    size, rng = (side - 1) * SPACING, np.random.default_rng(0)
    flat = np.c_[plain.grid(SPACING), np.zeros(side * side)].astype(np.float32)
    points = flat + rng.uniform(-0.02, 0.02, flat.shape).astype(np.float32)
    state = js.State.from_points(net, points)
    cases, parts = [], {name: parts for name, parts in contacts(net, flat, size).items() if not few or name in FEW}
    for name, (forces, rules) in parts.items():
        system = js.System(net, 0.01, (js.Springs(net, 20.0, net.lengths(flat)), js.Gravity((0.0, 0.0, -10.0)), *forces), rules=rules)
        cases += [Case(f"{name}: {what}", run, (state,)) for what, run in programs(system).items()]
    rows, found = measure(cases, rounds), []
    for name, (forces, _) in parts.items():
        row: dict[str, Any] = {"n": side * side, "obstacle": name}
        for what in ("forward", "gradient"):
            mine, bare = rows[f"{name}: {what}"], rows[f"bare: {what}"]
            row |= {f"{what}_ns": 1e9 * (mine.run_s - bare.run_s) / N_STEPS / side**2, f"{what}_ratio": mine.run_s / bare.run_s}
        error, touch = force_error(forces[0] if forces else None, net, points)
        found.append({**row, "touch": touch, "error": error, "compile_s": rows[f"{name}: gradient"].compile_s})
    show(f"{side**2} nodes, {N_STEPS} steps of symplectic Euler, float32", found)
    return found


def programs(system: js.System) -> dict[str, Callable[..., Any]]:
    """The run, and the gradient of a loss of it by the start."""

    def end(state: js.State) -> js.Vector:
        return js.rollout(system, state, js.SymplecticEuler(), DT, N_STEPS).state.position

    def loss(position: js.Vector, state: js.State) -> jax.Array:
        x = end(state.moved(position, state.velocity))
        return jnp.sum(x.dot(x))

    return {"forward": jax.jit(end), "gradient": jax.jit(lambda state: jax.grad(loss)(state.position, state))}


def main() -> None:
    """Measure, print, write the table and the picture."""
    quick = arguments(__doc__).quick
    sizes, rounds = ([(10, False), (32, True)], 3) if quick else ([(10, True), (32, False), (100, True), (316, False)], 5)
    rows = [row for side, few in sizes for row in one_size(side, rounds, few)]
    write("contact", {"steps": N_STEPS, "dt": DT, "spacing": SPACING, "stiffness": STIFFNESS, "onset": ONSET}, {"rows": rows})
    panels = [Panel(what, "time over a bare step", curves(rows, what)) for what in ("forward", "gradient")]
    draw(panels, RESULTS / "contact.png")


def curves(rows: list[dict], what: str) -> dict[tuple[str, str], tuple[list[float], list[float]]]:
    """Ratio over the number of nodes, one curve for each obstacle."""
    found = {}
    for i, name in enumerate(dict.fromkeys(row["obstacle"] for row in rows)):
        mine = [row for row in rows if row["obstacle"] == name]
        found[name, "osv^Dx+*phd<>"[i % 13] + "-"] = ([row["n"] for row in mine], [row[f"{what}_ratio"] for row in mine])
    return found


if __name__ == "__main__":
    main()
