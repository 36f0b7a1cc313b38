"""Walking robots in Taichi: one kernel a step, all robots in parallel, gradients by its own tape with every step kept."""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false

import math
from typing import Any

import numpy as np
import taichi as ti

from .layouts import Forms, Program, Scene
from .robots import CHECKED_ROBOTS, PARTS, joined


@ti.func
def share(pull: ti.f32, along: ti.f32) -> ti.f32:
    """Which part of a velocity friction takes."""
    part = 0.0
    if ti.abs(along) > 0.0:
        part = ti.min(pull / ti.abs(along), 1.0)
    return part


def forms(scene: Scene) -> Forms:
    """By the scene's kind."""
    return {"tape": lambda: program(scene, str(scene["kind"]).startswith("gradient"))}


def program(scene: Scene, with_gradient: bool) -> Program:
    """Fields for a number of steps, made once for it; the last result."""
    made: dict[int, Any] = {}
    last: dict[str, Any] = {}

    def run(n_steps: int) -> None:
        if n_steps not in made:
            made[n_steps] = record(scene, n_steps, with_gradient)
        last["robots"] = made[n_steps]
        last["robots"]()

    return Program(run, lambda: last["robots"].result())


def record(scene: Scene, n_steps: int, with_gradient: bool) -> Any:
    """A run that goes forward, and back where the gradient is asked for."""
    weights = {name: scene[name].astype(np.float32) for name in PARTS}
    (n_robots, n_hidden, n_inputs), n_groups = weights["first"].shape, weights["second"].shape[1]
    n, m = len(scene["x"]), len(scene["edges"])
    k, c, mass, mu, g, dt, frequency, size, reach = (
        float(scene[name]) for name in ("k", "damping", "mass", "friction", "gravity", "dt", "frequency", "size", "reach")
    )
    to_speed, origin = 1 / (2 * math.pi * frequency * size), float(scene["x"][:, 0].mean())

    def numbers(*shape: int) -> Any:
        return ti.field(ti.f32, shape=shape, needs_grad=with_gradient)

    def vectors(*shape: int) -> Any:
        return ti.Vector.field(2, ti.f32, shape=shape, needs_grad=with_gradient)

    x, v = vectors(n_steps + 1, n_robots, n), vectors(n_steps + 1, n_robots, n)
    f, moved, place, speed, kick0, kick1, q0, q1 = (vectors(n_steps, n_robots, n) for _ in range(8))
    center, hidden, out = vectors(n_steps, n_robots), numbers(n_steps, n_robots, n_hidden), numbers(n_steps, n_robots, n_groups)
    rests = ti.field(ti.i32, shape=(n_steps, n_robots, n))
    first, first_bias = numbers(n_robots, n_hidden, n_inputs), numbers(n_robots, n_hidden)
    second, second_bias = numbers(n_robots, n_groups, n_hidden), numbers(n_robots, n_groups)
    ends, group, rest, start = ti.Vector.field(2, ti.i32, m), ti.field(ti.i32, m), ti.field(ti.f32, m), ti.Vector.field(2, ti.f32, n)
    waves, loss = ti.field(ti.f32, (n_steps, 4)), numbers()
    gained = numbers(n_robots)
    for field, values in ((ends, scene["edges"]), (group, scene["groups"])):
        field.from_numpy(np.asarray(values, np.int32))
    turns = 2 * math.pi * frequency * float(scene["dt"]) * np.arange(n_steps)[:, None] * np.array([1.0, 2.0])
    for field, values in (
        (rest, scene["l"]), (start, scene["x"]), (waves, np.concatenate([np.sin(turns), np.cos(turns)], axis=1)),
        *zip((first, first_bias, second, second_bias), weights.values(), strict=True),
    ):  # fmt: skip
        field.from_numpy(np.asarray(values, np.float32))

    @ti.kernel
    def begin():
        for b, i in ti.ndrange(n_robots, n):
            x[0, b, i] = start[i]
            v[0, b, i] = ti.Vector([0.0, 0.0])
        for t, b, i in f:
            f[t, b, i] = ti.Vector([0.0, 0.0])
            q0[t, b, i] = ti.Vector([0.0, 0.0])
            q1[t, b, i] = ti.Vector([0.0, 0.0])
        for t, b in center:
            center[t, b] = ti.Vector([0.0, 0.0])
        for t, b, h in hidden:
            hidden[t, b, h] = 0.0
        for t, b, o in out:
            out[t, b, o] = 0.0
        for b in gained:
            gained[b] = 0.0

    @ti.kernel
    def control(t: ti.i32):
        for b, i in ti.ndrange(n_robots, n):
            center[t, b] += x[t, b, i] / n
        for b, h, s in ti.ndrange(n_robots, n_hidden, 4):
            hidden[t, b, h] += first[b, h, s] * waves[t, s]
        for b, h, i in ti.ndrange(n_robots, n_hidden, n):
            at = (x[t, b, i] - center[t, b]) / size
            w = v[t, b, i] * to_speed
            by_place = first[b, h, 4 + i] * at[0] + first[b, h, 4 + n + i] * at[1]
            by_speed = first[b, h, 4 + 2 * n + i] * w[0] + first[b, h, 4 + 3 * n + i] * w[1]
            hidden[t, b, h] += by_place + by_speed
        for b, o, h in ti.ndrange(n_robots, n_groups, n_hidden):
            out[t, b, o] += second[b, o, h] * ti.tanh(hidden[t, b, h] + first_bias[b, h])

    @ti.kernel
    def pulls(t: ti.i32):
        for b, e in ti.ndrange(n_robots, m):
            i, j = ends[e][0], ends[e][1]
            d, w = x[t, b, j] - x[t, b, i], v[t, b, j] - v[t, b, i]
            l = rest[e]
            if group[e] >= 0:
                l = rest[e] * (1.0 + reach * ti.tanh(out[t, b, group[e]] + second_bias[b, group[e]]))
            p = k * (1.0 - l / d.norm()) * d + c * d.dot(w) / d.norm_sqr() * d
            f[t, b, i] += p
            f[t, b, j] -= p

    @ti.kernel
    def strike(t: ti.i32):
        for b, i in ti.ndrange(n_robots, n):
            at, before = x[t, b, i], v[t, b, i]
            a = f[t, b, i] / mass - ti.Vector([0.0, g])
            end = before + dt * a
            goes = at + dt * end
            moved[t, b, i] = goes
            here, now = goes, end
            jump = ti.Vector([0.0, 0.0])
            left, stays = 0.0, 0
            if goes[1] < 0.0:
                u, off = before + 0.5 * dt * a, -0.5 * dt * a
                time = 0.0
                # What lies on the ground meets it at once; a root there would have no derivative.
                if at[1] > 0.0 or u[1] > 0.0:
                    root = ti.sqrt(ti.max(u[1] * u[1] - 2.0 * a[1] * at[1], 1e-12))
                    if u[1] > 0.0:
                        time = (u[1] + root) / -a[1]
                    else:
                        time = 2.0 * at[1] / (root - u[1])
                left = dt - time
                w = u + time * a
                if a[1] < 0.0:
                    stays = 1
                    jump = ti.Vector([0.0, -(w[1] + off[1])])
                    free = w + left * a + off
                    part = share(mu * ti.max(-free[1], 0.0), free[0])
                    slid = w[0] + 0.5 * left * a[0] - 0.5 * part * free[0] + part * off[0]
                    here = ti.Vector([at[0] + time * (u[0] + 0.5 * time * a[0]) + left * slid, 0.0])
                    now = ti.Vector([(1.0 - part) * free[0], 0.0])
                else:
                    slip = w[0] + off[0]
                    jump = ti.Vector([-share(mu * ti.max(-w[1], 0.0), slip) * slip, -w[1]])
                    thrown = w + jump
                    flown = ti.Vector([at[0] + time * (u[0] + 0.5 * time * a[0]), 0.0])
                    here = flown + left * (thrown + 0.5 * left * a)
                    now = thrown + left * a + off
            rests[t, b, i] = stays
            place[t, b, i] = here
            speed[t, b, i] = now
            kick0[t, b, i] = left * jump
            kick1[t, b, i] = 0.5 * left * left * jump

    @ti.kernel
    def damp(t: ti.i32):
        for b, e in ti.ndrange(n_robots, m):
            i, j = ends[e][0], ends[e][1]
            d = moved[t, b, j] - moved[t, b, i]
            unit = c / d.norm_sqr() / mass * d
            p0 = d.dot(kick0[t, b, j] - kick0[t, b, i]) * unit
            p1 = d.dot(kick1[t, b, j] - kick1[t, b, i]) * unit
            q0[t, b, i] += p0
            q0[t, b, j] -= p0
            q1[t, b, i] += p1
            q1[t, b, j] -= p1

    @ti.kernel
    def finish(t: ti.i32):
        for b, i in ti.ndrange(n_robots, n):
            up = 1.0
            if rests[t, b, i] == 1:
                up = 0.0
            at = place[t, b, i] + ti.Vector([q1[t, b, i][0], up * q1[t, b, i][1]])
            x[t + 1, b, i] = ti.Vector([at[0], ti.max(at[1], 0.0)])
            v[t + 1, b, i] = speed[t, b, i] + ti.Vector([q0[t, b, i][0], up * q0[t, b, i][1]])

    @ti.kernel
    def measure():
        for b, i in ti.ndrange(n_robots, n):
            gained[b] += x[n_steps, b, i][0] / n

    @ti.kernel
    def total():
        for b in gained:
            loss[None] += gained[b]

    def steps() -> None:
        for t in range(n_steps):
            control(t)
            pulls(t)
            strike(t)
            damp(t)
            finish(t)
        measure()

    class Robots:
        """What runs, and what came out."""

        def __call__(self) -> None:
            begin()
            if not with_gradient:
                steps()
                ti.sync()
                return
            loss[None] = 0
            with ti.ad.Tape(loss):
                steps()
                total()
            ti.sync()

        def result(self) -> np.ndarray:
            if not with_gradient:
                return gained.to_numpy() - origin
            parts = (first, first_bias, second, second_bias)
            return joined({name: field.grad.to_numpy()[:CHECKED_ROBOTS] for name, field in zip(PARTS, parts, strict=True)})

    return Robots()
