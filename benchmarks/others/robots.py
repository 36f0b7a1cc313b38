"""Walking robots in float64 and plain NumPy: what every contender's robots are compared with.

A step is the library's: commands of a network at its beginning, springs and dashpots, symplectic Euler; then the step is split where a
node meets the ground, it slides with Coulomb's friction for the rest, and dashpots feel what the ground did.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .layouts import Scene

CHECKED_ROBOTS = 4
H = 1e-5
PARTS = ("first", "first_bias", "second", "second_bias")


class Physics:
    """The numbers of a scene, and one step of many robots (L, N, 2)."""

    def __init__(self, scene: Scene):
        self.start, self.edges = scene["x"].astype(float), scene["edges"]
        self.rest, self.groups = scene["l"].astype(float), scene["groups"]
        self.number = {
            name: float(scene[name]) for name in ("k", "damping", "mass", "friction", "gravity", "dt", "frequency", "size", "reach")
        }
        self.incidence = np.zeros((len(self.start), len(self.edges)))
        self.incidence[self.edges[:, 0], np.arange(len(self.edges))] = 1
        self.incidence[self.edges[:, 1], np.arange(len(self.edges))] = -1

    def lengths(self, weights: dict[str, np.ndarray], x: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
        """(L, E) rest lengths by the network's commands."""
        n = self.number
        turns = 2 * np.pi * n["frequency"] * time * np.array([1.0, 2.0])
        waves = np.broadcast_to(np.concatenate([np.sin(turns), np.cos(turns)]), (len(x), 4))
        places = (x - x.mean(axis=1, keepdims=True)) / n["size"]
        speeds = v / (2 * np.pi * n["frequency"] * n["size"])
        seen = np.concatenate([waves, places[..., 0], places[..., 1], speeds[..., 0], speeds[..., 1]], axis=1)
        hidden = np.tanh(np.einsum("lhs,ls->lh", weights["first"], seen) + weights["first_bias"])
        commands = 1 + n["reach"] * np.tanh(np.einsum("lgh,lh->lg", weights["second"], hidden) + weights["second_bias"])
        return self.rest * np.where(self.groups < 0, 1.0, commands[:, self.groups])

    def dashpots(self, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Their force on each node [N]."""
        d, w = (a[:, self.edges[:, 1]] - a[:, self.edges[:, 0]] for a in (x, v))
        along = np.sum(d * w, axis=-1) / np.sum(d * d, axis=-1)
        return np.einsum("ne,led->lnd", self.incidence, self.number["damping"] * along[..., None] * d)

    def step(self, weights: dict[str, np.ndarray], x: np.ndarray, v: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Places and velocities a step later."""
        n = self.number
        d = x[:, self.edges[:, 1]] - x[:, self.edges[:, 0]]
        pulls = n["k"] * (1 - self.lengths(weights, x, v, time) / np.linalg.norm(d, axis=-1))[..., None] * d
        force = np.einsum("ne,led->lnd", self.incidence, pulls) + self.dashpots(x, v)
        a = force / n["mass"] - np.array([0.0, n["gravity"]])
        end = v + n["dt"] * a
        return self.struck(x, x + n["dt"] * end, v, end, a)

    def struck(self, x: np.ndarray, moved: np.ndarray, v: np.ndarray, end: np.ndarray, a: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What the ground makes of a step; nothing of it bounces."""
        dt, mu = self.number["dt"], self.number["friction"]
        u, off, height = v + dt * a / 2, -dt * a / 2, x[..., 1]
        meets = moved[..., 1] < 0
        with np.errstate(all="ignore"):
            root = np.sqrt(np.maximum(u[..., 1] ** 2 - 2 * a[..., 1] * height, 0))
            t = np.where(u[..., 1] > 0, (u[..., 1] + root) / -a[..., 1], 2 * height / (root - u[..., 1]))
        t = np.where(meets & np.isfinite(t), t, 0.0)
        left, w = dt - t, u + t[..., None] * a
        rests = meets & (a[..., 1] < 0)
        # One that the forces lift again loses its speed into the ground, and slips with the friction of that.
        slip = w[..., 0] + off[..., 0]
        kick = np.stack([-share(mu * np.maximum(-w[..., 1], 0), slip) * slip, -w[..., 1]], axis=-1)
        thrown = w + kick
        flown = x + t[..., None] * (u + t[..., None] * a / 2)
        flown[..., 1] = 0.0
        free = w + left[..., None] * a + off
        part = share(mu * np.maximum(-free[..., 1], 0), free[..., 0])
        slid = w[..., 0] + left * a[..., 0] / 2 - part * free[..., 0] / 2 + part * off[..., 0]
        zero = np.zeros_like(slid)
        held_x = np.stack([flown[..., 0] + left * slid, zero], axis=-1)
        held_v = np.stack([(1 - part) * free[..., 0], zero], axis=-1)
        free_x, free_v = flown + left[..., None] * (thrown + left[..., None] * a / 2), thrown + left[..., None] * a + off
        kick = np.where(rests[..., None], np.stack([zero, -(w + off)[..., 1]], axis=-1), kick)
        kick = np.where(meets[..., None], kick, 0.0)
        rest, hit = rests[..., None], meets[..., None]
        place = np.where(hit, np.where(rest, held_x, free_x), moved)
        speed = np.where(hit, np.where(rest, held_v, free_v), end)
        per_mass, up = 1 / self.number["mass"], np.array([1.0, 0.0])
        by_speed, by_place = (per_mass * self.dashpots(moved, part[..., None] * kick) for part in (left, left * left / 2))
        place = place + np.where(rest, by_place * up, by_place)
        speed = speed + np.where(rest, by_speed * up, by_speed)
        place[..., 1] = np.maximum(place[..., 1], 0)
        return place, speed


def share(pull: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Which part of a velocity friction takes."""
    speed = np.abs(along)
    return np.where(speed > 0, np.minimum(pull / np.where(speed > 0, speed, 1), 1), 0)


def walked(scene: Scene, weights: dict[str, np.ndarray], n_steps: int) -> np.ndarray:
    """(L,) what the mean of x gains [m]."""
    physics = Physics(scene)
    x = np.broadcast_to(physics.start, (len(weights["first"]), *physics.start.shape))
    v = np.zeros_like(x)
    for s in range(n_steps):
        x, v = physics.step(weights, x, v, s * physics.number["dt"])
    return x[..., 0].mean(axis=1) - physics.start[:, 0].mean()


def distances(scene: Scene, n_steps: int) -> np.ndarray:
    """(B,) of all robots."""
    return walked(scene, {name: scene[name].astype(float) for name in PARTS}, n_steps)


def gradients(scene: Scene, n_steps: int) -> np.ndarray:
    """(CHECKED_ROBOTS, W) of the first robots' distances by all their weights, by central differences."""
    rows = []
    for robot in range(CHECKED_ROBOTS):
        parts = [scene[name][robot].astype(float) for name in PARTS]
        flat = np.concatenate([part.ravel() for part in parts])
        moved = np.concatenate([flat + H * np.eye(flat.size), flat - H * np.eye(flat.size)])
        ends = walked(scene, split(moved, [part.shape for part in parts]), n_steps)
        rows.append((ends[: flat.size] - ends[flat.size :]) / (2 * H))
    return np.stack(rows)


def split(flat: np.ndarray, shapes: list[tuple[int, ...]]) -> dict[str, Any]:
    """(L, W) weights in a row as the parts of a network."""
    cuts = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1]
    parts = np.split(flat, cuts, axis=1)
    return {name: part.reshape(-1, *shape) for name, part, shape in zip(PARTS, parts, shapes, strict=True)}


def joined(parts: dict[str, np.ndarray]) -> np.ndarray:
    """(B, W) the parts of networks in a row."""
    return np.concatenate([np.asarray(parts[name]).reshape(len(parts[name]), -1) for name in PARTS], axis=1)
