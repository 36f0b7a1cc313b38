"""What is right, in float64 and plain NumPy or SciPy: every contender's result after a few steps is compared with these."""

from __future__ import annotations

from typing import Any

import numpy as np

from .layouts import Scene


def _sum_to_nodes(edges: np.ndarray, pulls: np.ndarray, n_nodes: int) -> np.ndarray:
    """(N, D): each spring's pull added at its tail, taken at its head."""
    tail, head = edges.T
    return np.stack([np.bincount(tail, p, n_nodes) - np.bincount(head, p, n_nodes) for p in pulls.T], axis=1)


def _start(scene: Scene) -> tuple[np.ndarray, ...]:
    return tuple(scene[name].astype(float) for name in ("x", "v", "k", "l"))


def _path(scene: Scene, n_steps: int) -> list[np.ndarray]:
    """(N, 3) positions at every step."""
    edges, dt = scene["edges"], float(scene["dt"])
    x, v, k, l = _start(scene)
    path = [x]
    for _ in range(n_steps):
        d = x[edges[:, 1]] - x[edges[:, 0]]
        v = v + dt * _sum_to_nodes(edges, (k * (1 - l / np.linalg.norm(d, axis=1)))[:, None] * d, len(x))
        x = x + dt * v
        path.append(x)
    return path


def positions(scene: Scene, n_steps: int) -> np.ndarray:
    """(N, 3) after the steps."""
    return _path(scene, n_steps)[-1]


def many_positions(scene: Scene, n_steps: int) -> np.ndarray:
    """(B, N, 3), each cloth by itself."""
    ends = []
    for x, v, k in zip(scene["x"], scene["v"], scene["k"], strict=True):
        ends.append(positions(Scene({"x": x, "v": v, "k": k, "l": scene["l"], "edges": scene["edges"], "dt": scene["dt"]}), n_steps))
    return np.stack(ends)


def gradient(scene: Scene, n_steps: int) -> np.ndarray:
    """(2, E) of the sum of squared last positions by every k and l: the adjoint, step by step backwards."""
    edges, dt = scene["edges"], float(scene["dt"])
    _, _, k, l = _start(scene)
    path = _path(scene, n_steps)
    of_x, of_v = 2 * path[-1], np.zeros_like(path[-1])
    of_k, of_l = np.zeros_like(k), np.zeros_like(l)
    for x in path[-2::-1]:
        of_v = of_v + dt * of_x
        d = x[edges[:, 1]] - x[edges[:, 0]]
        a = dt * (of_v[edges[:, 0]] - of_v[edges[:, 1]])
        length = np.linalg.norm(d, axis=1)
        along = np.sum(d * a, axis=1)
        of_k += (1 - l / length) * along
        of_l -= k / length * along
        of_d = (k * (1 - l / length))[:, None] * a + (k * l * along / length**3)[:, None] * d
        of_x = of_x - _sum_to_nodes(edges, of_d, len(x))
    return np.stack([of_k, of_l])


def temperatures(scene: Scene, n_steps: int) -> np.ndarray:
    """(N,) after steps forward in time; unit capacity."""
    edges, g, dt = scene["edges"], scene["g"].astype(float), float(scene["dt"])
    t = scene["start"].astype(float)
    for _ in range(n_steps):
        t = t + dt * _sum_to_nodes(edges, (g * (t[edges[:, 1]] - t[edges[:, 0]]))[:, None], len(t))[:, 0]
    return t


def _cell(scene: Scene) -> tuple[np.ndarray, ...]:
    """Fractions along x and y, and the four pixels around each point."""
    image, x, y = (scene[name].astype(float) for name in ("image", "x", "y"))
    i, j = (np.minimum(a.astype(int), n - 2) for a, n in ((x, image.shape[1]), (y, image.shape[0])))
    return x - i, y - j, image[j, i], image[j, i + 1], image[j + 1, i], image[j + 1, i + 1]


def samples(scene: Scene, n_steps: int) -> np.ndarray:
    """(P,) bilinear values."""
    tx, ty, a, b, c, d = _cell(scene)
    return (1 - ty) * ((1 - tx) * a + tx * b) + ty * ((1 - tx) * c + tx * d)


def slopes(scene: Scene, n_steps: int) -> np.ndarray:
    """(2, P) of the sum of squared values, by each point's x and y."""
    tx, ty, a, b, c, d = _cell(scene)
    twice = 2 * samples(scene, n_steps)
    return np.stack([twice * ((1 - ty) * (b - a) + ty * (d - c)), twice * ((1 - tx) * (c - a) + tx * (d - b))])


def _liquid(x: np.ndarray, reach: float) -> tuple[np.ndarray, int]:
    """(N, 3) forces of Lennard-Jones, shifted to zero at the cut-off, and the number of pairs within it."""
    from scipy.spatial import KDTree

    pairs = KDTree(x).query_pairs(reach, output_type="ndarray")
    d = x[pairs[:, 0]] - x[pairs[:, 1]]
    squared = np.sum(d * d, axis=1)
    end = 24 * (2 * reach**-12 - reach**-6) / reach
    weight = 24 / squared * (2 * squared**-6 - squared**-3) - end / np.sqrt(squared)
    return _sum_to_nodes(pairs, weight[:, None] * d, len(x)), len(pairs)


def n_pairs(scene: Scene) -> float:
    """Pairs within the cut-off at the start."""
    return float(_liquid(scene["x"].astype(float), float(scene["reach"]))[1])


def flow(scene: Scene, n_steps: int) -> np.ndarray:
    """(N, 3) positions after steps of velocity Verlet."""
    x, v, reach, dt = scene["x"].astype(float), scene["v"].astype(float), float(scene["reach"]), float(scene["dt"])
    force, _ = _liquid(x, reach)
    for _ in range(n_steps):
        v = v + dt / 2 * force
        x = x + dt * v
        force, _ = _liquid(x, reach)
        v = v + dt / 2 * force
    return x


class Implicit:
    """One linear backward Euler step of a spring net: (I/dt + dt K) v' = v/dt + f, with K the tangent, no spring below zero.

    The pattern of the matrix is made once; each step fills its numbers.
    """

    def __init__(self, edges: np.ndarray, n_nodes: int, dtype: Any):
        import scipy.sparse

        i, j = edges.T
        rows = np.concatenate([i, j, i, j])[:, None, None] * 3 + np.arange(3)[:, None]
        columns = np.concatenate([i, j, j, i])[:, None, None] * 3 + np.arange(3)
        shape = (len(rows), 3, 3)
        flat_rows, flat_columns = (np.broadcast_to(a, shape).ravel() for a in (rows, columns))
        diagonal = np.arange(3 * n_nodes)
        keys = np.concatenate([flat_rows, diagonal]).astype(np.int64) * (3 * n_nodes) + np.concatenate([flat_columns, diagonal])
        unique, self._place = np.unique(keys, return_inverse=True)
        self._indices = (unique % (3 * n_nodes)).astype(np.int32)
        self._starts = np.searchsorted(unique // (3 * n_nodes), np.arange(3 * n_nodes + 1)).astype(np.int32)
        self._matrix, self._edges, self._n, self._dtype = scipy.sparse.csr_array, edges, n_nodes, dtype

    def system(self, x: np.ndarray, v: np.ndarray, k: np.ndarray, l: np.ndarray, dt: Any) -> tuple[Any, np.ndarray]:
        """Matrix and right-hand side."""
        d = x[self._edges[:, 1]] - x[self._edges[:, 0]]
        length = np.linalg.norm(d, axis=1)
        u = d / length[:, None]
        slack = 1 - l / length
        across = (k * np.maximum(slack, 0))[:, None, None] * np.eye(3, dtype=x.dtype)
        blocks = across + (k - k * np.maximum(slack, 0))[:, None, None] * (u[:, :, None] * u[:, None, :])
        numbers = np.concatenate([dt * blocks, dt * blocks, -dt * blocks, -dt * blocks]).ravel()
        numbers = np.concatenate([numbers, np.full(3 * self._n, 1 / dt)])
        data = np.bincount(self._place, numbers, len(self._indices)).astype(self._dtype)
        matrix = self._matrix((data, self._indices, self._starts), shape=(3 * self._n, 3 * self._n))
        force = _sum_to_nodes(self._edges, (k * slack)[:, None] * d, self._n)
        return matrix, (v / dt + force).astype(self._dtype).ravel()


def implicit(scene: Scene, n_steps: int) -> np.ndarray:
    """(N, 3) after steps of backward Euler, each one linear solve by SuperLU."""
    from scipy.sparse.linalg import spsolve

    x, v, k, l = _start(scene)
    dt, step = float(scene["dt"]), Implicit(scene["edges"], len(x), float)
    for _ in range(n_steps):
        matrix, right = step.system(x, v, k, l, dt)
        v = np.asarray(spsolve(matrix.tocsc(), right)).reshape(-1, 3)
        x = x + dt * v
    return x
