"""The energy of a height field whose springs may be broken, and by how much it changes with any set of them, exactly.

    energy of the fit            E = sum k/2 (z_i - z_j)^2 over whole springs + sum k_d/2 (z_i - d_i)^2
    balance                      A z = k_d d,   A = diag(k_d) + sum k b b',   b' z = z_j - z_i
    a set of springs toggled     dE = 1/2 e' (diag(+-1/k) + B' A^-1 B)^-1 e,   e = B' z        + made whole, - broken

Source: the Woodbury identity on the minimum of a quadratic form.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..._arrays import Numbers, on_host
from ..._checks import finite, has_shape, nonnegative
from ...topology.base import Topology
from .given import differences, factored

# A spring is not broken where it alone holds a part that has no data: there 1/k - b' A^-1 b is rounding.
LOOSE = 1e-9


@dataclass(frozen=True)
class HeightField:
    """A net whose nodes move along z, on the host, in double precision.

    Attributes:
        edges: (E, 2) tail and head of each spring.
        points: (N, D) places of the nodes, of at most two coordinates [m].
        stiffness: (E,) k [N/m].
        data_stiffness: (N,) k_d [N/m].
        data: (N,) d, 0 where there is none.
    """

    edges: np.ndarray
    points: np.ndarray
    stiffness: np.ndarray
    data_stiffness: np.ndarray
    data: np.ndarray

    @staticmethod
    def of(net: Topology, points: Numbers, data: Numbers, stiffness: Numbers, data_stiffness: Numbers) -> HeightField:
        """Of what a user gives: see `find_breaks`."""
        n, springs = net.n_nodes, net.n_springs
        places = on_host("points", points).astype(np.float64)
        if places.ndim != 2 or places.shape[0] != n:
            raise ValueError(f"points has shape {places.shape}; expected ({n}, D), one row for each node.")
        finite("points", places)
        kd = on_host("data_stiffness", data_stiffness).astype(np.float64)
        has_shape("data_stiffness", kd, {"one number": (), "one per node": (n,)})
        nonnegative("data_stiffness", kd, "A negative data spring pushes away from the data.")
        kd = np.broadcast_to(kd, n)
        k = on_host("stiffness", stiffness).astype(np.float64)
        has_shape("stiffness", k, {"one number": (), "one per spring": (springs,)})
        nonnegative("stiffness", k, "A negative spring pushes its ends apart.")
        d = on_host("data", data).astype(np.float64)
        has_shape("data", d, {"one per node": (n,)})
        if not (kd > 0).any():
            raise ValueError("data_stiffness is 0 everywhere: no height is known. Give some node a data spring.")
        # A hole may hold anything: it is not read.
        d = np.where(kd > 0, d, 0.0)
        finite("data", d)
        return HeightField(np.asarray(net.edges), places[:, :2], np.broadcast_to(k, springs), kd, d)


class Fitted:
    """The surface in balance with some springs broken, and A^-1 b of springs as it is asked for."""

    def __init__(self, field: HeightField, broken: np.ndarray):
        from scipy.sparse import diags_array

        self._field, difference = field, differences(field.edges, len(field.data))
        k = np.where(broken, 0.0, field.stiffness)
        matrix = difference.T @ diags_array(k) @ difference + diags_array(field.data_stiffness)
        # A whole net without data anywhere in a piece has no height there: a hair of its own diagonal chooses one.
        self._lu = factored(matrix, 1e-14)
        self.z = self._lu.solve(field.data_stiffness * field.data)
        self.extension = difference @ self.z
        self.energy = float(0.5 * k @ self.extension**2 + 0.5 * field.data_stiffness @ (self.z - field.data) ** 2)
        self.broken, self._answers = broken, {}

    def answer(self, spring: int) -> np.ndarray:
        """(N,) A^-1 b of a spring."""
        if spring not in self._answers:
            b = np.zeros(len(self.z))
            b[self._field.edges[spring]] = -1.0, 1.0
            self._answers[spring] = self._lu.solve(b)
        return self._answers[spring]

    def coupling(self, one: int, others: list[int]) -> np.ndarray:
        """How far a pull at `one` stretches the others [m/N]."""
        tail, head = self._field.edges[np.asarray(others, int)].T
        answer = self.answer(one)
        return answer[head] - answer[tail]

    def change(self, springs: list[int]) -> float:
        """By how much the energy changes, prices aside, where whole ones of these springs break and broken ones are made whole.

        Infinite where a part without data would be left alone.
        """
        if not springs:
            return 0.0
        signed = np.where(self.broken[springs], 1.0, -1.0) / self._field.stiffness[springs]
        matrix = np.diag(signed) + np.stack([self.coupling(spring, springs) for spring in springs])
        whole = ~self.broken[springs]
        if whole.any():
            # Breaking those that are whole must leave 1/k - B' A^-1 B positive.
            least = np.linalg.eigvalsh(-matrix[np.ix_(whole, whole)]).min()
            if least <= LOOSE * np.abs(signed).max():
                return np.inf
        extension = self.extension[springs]
        return float(0.5 * extension @ np.linalg.solve(matrix, extension))


__all__ = ["LOOSE", "Fitted", "HeightField"]
