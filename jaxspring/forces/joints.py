"""Angular joints: bending of a chain, or of the rows of a grid, in the plane or in space.

    turning     phi = atan2(|t1 x t2|, t1 . t2)               [rad]   t1, t2 the directions before and after a node
    energy      k_theta / 2 phi^2                             [J]     moment k_theta phi
    forces      k_theta (phi / sin phi) times (c t2 - t1) / l2 and (t2 - c t1) / l1, c = cos phi                [N]
    blocks      k_theta (g g' + q q')                         [N/m]   g, q: the turning in two planes at right angles
    rod         EI = k_theta h                                        h the distance of the nodes; per width: B

At a clamp the chain leaves its end in a given direction. Half an element bends there, so that its joint has 2 k_theta: with k_theta the
error falls only as h.

A flexion spring from node i to i + 2 of rest length 2 h stores k h^2 phi^4 / 32: it has no bending stiffness where the chain is straight,
whatever k is. That is what joints are for.

Source: the discrete elastica, as in Hencky (1920); in space the angle alone, without twist, as the bending of Bergou and others (2008),
"Discrete Elastic Rods".
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers, as_indices, whole_number
from .._checks import as_inexact, finite, has_shape, is_concrete, nonnegative
from ..linalg.operators import Blocks, CellDyads
from ..state import State
from ..status import Flag
from ..topology.base import Topology
from ..topology.corners import Corners
from ..topology.lattice import Lattice
from ..topology.periods import minimum_image
from ..vector import Vector
from .base import Finding, Force, any_refused
from .linearisation import Linearisation
from .turning import Turn, turn


class AngularJoints(Force):
    """Bending of a chain, or of rows of a grid: every three nodes in a row resist turning. They are straight at rest.

    Positions have 2 or 3 coordinates. In space a joint resists turning out of its plane too, but no twist. The matrix of implicit steps
    leaves out what the moment does by turning with the elements, which vanishes where joints are straight; Newton's method has all of it.

    Where an element has no length, or lies folded onto the one before it, there is no plane to turn in: the joint does nothing, and the
    status says `DEGENERATE`. Damping of bending: `Rayleigh(0.0, time, joints)`.

    Attributes:
        net: whose nodes are bent.
        stiffness: k_theta, moment per angle [N m]: one number, or (J,), one per joint.
        joints: corners of the joints, and after them of the clamps.
        clamp: (C, D) direction at each clamp, of any length, or None.
        clamp_stiffness: of the clamps [N m]: one number, or (C,); None is twice the stiffness, which is then one number.

    >>> import jaxspring as js
    >>> chain = js.lattice(3)
    >>> joints = js.cloth.AngularJoints(chain, stiffness=0.5)
    >>> bent = js.State.from_points(chain, [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
    >>> print(joints.angles(bent).round(4), f"{joints.energy(bent):.4f}")
    [1.5708] 0.6169
    """

    net: Topology
    stiffness: Array
    joints: Corners
    clamp: Array | None
    clamp_stiffness: Array | None

    def __init__(
        self,
        net: Topology,
        stiffness: Numbers,
        joints: Numbers | Corners | None = None,
        clamp: Numbers | None = None,
        ends: Numbers | None = None,
        clamp_stiffness: Numbers | None = None,
        axis: int | None = None,
    ):
        """Find the joints.

        Args:
            net: whose nodes are bent.
            stiffness: k_theta [N m]: one number, or (J,), one per joint.
            joints: (J, 3) node numbers, three in a row each; None takes the rows of a lattice.
            clamp: (D,) or (C, D) direction in which the chain leaves an end that is clamped. Hold the end itself by `free`.
            ends: (C, 2) the clamped node and its neighbour; None takes the first two nodes of every row.
            clamp_stiffness: [N m]; None is twice the stiffness.
            axis: the axis of a lattice along which rows run; None is every axis.

        Raises:
            ValueError: a net that is no lattice, without joints; no three nodes in a row; a clamp without a direction, or a direction
                without length; a stiffness that is negative or not finite.
        """
        self.net = net
        given = None if clamp is None else as_inexact("clamp", clamp)
        if isinstance(joints, Corners):
            self.joints, n_clamps = joints, 0 if given is None else given.shape[0]
        else:
            self.joints, n_clamps = _corners(net, joints, given is not None, ends, axis)
        n_joints = self.joints.cells.shape[-1] - n_clamps
        self.clamp = None if given is None else _directions(given, n_clamps)
        self.stiffness = _constant("stiffness", stiffness, "joint", n_joints)
        self.clamp_stiffness = None if clamp_stiffness is None else _constant("clamp_stiffness", clamp_stiffness, "clamp", n_clamps)
        if n_clamps and clamp_stiffness is None and self.stiffness.ndim:
            raise ValueError("stiffness is given per joint; say clamp_stiffness too, twice what a joint of that element has.")

    @staticmethod
    def from_bending(
        net: Topology,
        points: Numbers,
        bending: Numbers,
        joints: Numbers | None = None,
        clamp: Numbers | None = None,
        ends: Numbers | None = None,
        axis: int | None = None,
    ) -> AngularJoints:
        """Joints of a rod: k_theta = EI / h, h the mean length of both elements at rest, half of one at a clamp.

        Args:
            net: whose nodes are bent.
            points: (N, D) places at rest [m].
            bending: EI [N m^2], one number: of a strip of cloth B times its width, in a grid B times the distance of the rows.
            joints: as in `AngularJoints`.
            clamp: as in `AngularJoints`.
            ends: as in `AngularJoints`.
            axis: as in `AngularJoints`.

        Raises:
            ValueError: as `AngularJoints`; elements without length.

        >>> import jaxspring as js
        >>> chain = js.lattice(3)
        >>> print(js.cloth.AngularJoints.from_bending(chain, chain.grid(0.5), 0.25, clamp=(1.0, 0.0)).stiffness)
        [0.5]
        """
        unscaled = AngularJoints(net, 1.0, joints, clamp, ends, axis=axis)
        first, second = unscaled._elements(net.vector_field(points))
        n = unscaled.n_joints
        half = 0.5 * second.norm()
        length = half[:n] + 0.5 * first.norm()[:n]
        if is_concrete(half) and not bool(jnp.all(length > 0) & jnp.all(half[n:] > 0)):
            raise ValueError("points puts two nodes that are next to each other at one place: no k_theta follows from EI.")
        b = as_inexact("bending", bending)
        has_shape("bending", b, {"one number": ()})
        b = b.astype(half.dtype)
        clamps = None if clamp is None else b / half[n:]
        return AngularJoints(net, b / length, unscaled.joints, unscaled.clamp, clamp_stiffness=clamps)

    @property
    def n_joints(self) -> int:
        """Number of joints J, without the clamps."""
        return self.joints.cells.shape[-1] - (0 if self.clamp is None else self.clamp.shape[-2])

    @property
    def nodes(self) -> np.ndarray:
        """(J, 3) nodes of each joint in the user's numbering."""
        return self.joints.nodes(self.net)[: self.n_joints]

    @property
    def pairs(self) -> Topology:
        """A net of every pair of a joint's corners, for `Skyline(net, joints.pairs)`."""
        return self.joints.coupled()

    def angles(self, state: State) -> Array:
        """(J + C,) phi of each joint, and then of each clamp [rad], from 0 to pi."""
        return jnp.sqrt(self._now(state).squared)

    def force(self, state: State) -> Vector:
        """Sum of the forces of the joints at each node [N]."""
        k, now = self._stiffness(state), self._now(state)
        before, after = now.gradient
        return self.joints.sum(_at_corners(k * before, k * after))

    def energy(self, state: State) -> Array:
        """k_theta / 2 phi^2, summed [J]."""
        return jnp.sum(0.5 * self._stiffness(state) * self._now(state).squared)

    def stiffness_blocks(self, state: State, linearisation: Linearisation) -> Blocks:
        """Blocks k_theta (g g' + q q') of the three corners [N/m], whatever the linearisation: exact where joints are straight."""
        now = self._now(state)
        k = self._resisting(state, now)
        forms = [_at_corners(now.per_length[0] * one, -(now.per_length[1] * other)) for one, other in now.frames]
        return Blocks(cells=(CellDyads(self.joints, (k,) * len(forms), tuple(forms)),))

    def stiffness_bound(self, state: State) -> Array:
        """Upper bound of the row sums: k_theta |g_i| sum of |g_j|, and what the moment does by turning [N/m]."""
        now = self._now(state)
        k, (one, other) = self._resisting(state, now), now.per_length
        moment = k * jnp.sqrt(now.squared)
        total, turning = 2 * k * (one + other), (2 * moment * one * one, 2 * moment * other * other)
        rows = (total * one + turning[0], total * (one + other) + turning[0] + turning[1], total * other + turning[1])
        return self.joints.sum(rows)

    def diagnose(self, state: State) -> tuple[Finding, ...]:
        """DEGENERATE: joints at an element without length, or whose elements are folded onto each other, and the node of the first."""
        bad = self._now(state).is_degenerate
        return (Finding(Flag.DEGENERATE, jnp.sum(bad, dtype=jnp.int32), self.joints.cells[1][jnp.argmax(bad)]),)

    def rounding(self, state: State) -> Array:
        """The largest coordinate's rounding over the shortest element."""
        per = jnp.max(jnp.maximum(*self._now(state).per_length))
        return state.position.largest() * jnp.asarray(jnp.finfo(state.dtype).eps, state.dtype) * per

    def invalid(self) -> Array:
        """Whether a stiffness is negative or not finite, or a clamp's direction has no length or is not finite."""
        bad = any_refused(self.stiffness, self.clamp_stiffness)
        if self.clamp is None:
            return bad
        squared = jnp.sum(self.clamp * self.clamp, axis=-1)
        return bad | ~jnp.all((squared > 0) & jnp.isfinite(squared))

    def _elements(self, x: Vector) -> tuple[Vector, Vector]:
        """The elements before and after each joint [m]; what is before a clamp means nothing."""
        a, b, c = self.joints.at(x)
        both = b - a, c - b
        return both if self.joints.box is None else (minimum_image(both[0], self.joints.box), minimum_image(both[1], self.joints.box))

    def _now(self, state: State) -> Turn:
        if state.dim == 1:
            raise ValueError("AngularJoints bend in the plane or in space; these positions have 1 coordinate.")
        (first, second), n = self._elements(state.position), self.n_joints
        if self.clamp is not None:
            if self.clamp.shape[-1] != state.dim:
                raise ValueError(f"clamp has {self.clamp.shape[-1]} coordinates, the positions have {state.dim}.")
            given = [self.clamp[:, i].astype(state.dtype) for i in range(state.dim)]
            first = Vector(tuple(jnp.concatenate([e[:n], g]) for e, g in zip(first, given, strict=True)))
        return turn(first, second, jnp.arange(first.shape[0]) < n)

    def _stiffness(self, state: State) -> Array:
        """(J + C,) k_theta of each joint and clamp."""
        n, k = self.n_joints, self.stiffness.astype(state.dtype)
        each = jnp.broadcast_to(k, (n,))
        if self.clamp is None:
            return each
        clamps = 2 * k if self.clamp_stiffness is None else self.clamp_stiffness.astype(state.dtype)
        return jnp.concatenate([each, jnp.broadcast_to(clamps, (self.clamp.shape[0],))])

    def _resisting(self, state: State, now: Turn) -> Array:
        k = self._stiffness(state)
        return jnp.where(now.is_degenerate, jnp.zeros_like(k), k)


def _at_corners(before: Vector, after: Vector) -> tuple[Vector, Vector, Vector]:
    """Pulls on the elements, which act on their ends: minus the derivative by each corner of a form of both elements."""
    return before, after - before, -after


def _corners(net: Topology, joints: Any, is_clamped: bool, ends: Any, axis: int | None) -> tuple[Corners, int]:
    """The corners of joints and clamps, and the number of clamps. Of the node before a clamp, which there is none of, nothing is read."""
    if joints is None:
        rows, first = _rows(net, axis)
    else:
        rows, first = as_indices("joints", joints), None
        if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows):
            raise ValueError(f"joints has shape {rows.shape}; expected (J, 3): three nodes in a row for each of J >= 1 joints.")
    if ends is not None and not is_clamped:
        raise ValueError("ends are given, but no direction in which the chain leaves them. Pass clamp=.")
    if not is_clamped:
        return Corners(rows, net, with_pairs=True), 0
    pairs = first if ends is None else as_indices("ends", ends)
    if pairs is None:
        raise ValueError("clamp is given for joints of your own. Say which nodes are clamped: ends=, (C, 2), the end and its neighbour.")
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ValueError(f"ends has shape {pairs.shape}; expected (C, 2): the clamped node and its neighbour.")
    other = [next(n for n in range(3) if n not in pair) for pair in pairs.tolist()]
    return Corners(np.concatenate([rows, np.column_stack([other, pairs])]), net, with_pairs=True), len(pairs)


def _rows(net: Topology, axis: int | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Three nodes in a row along an axis of a lattice, or along all; and the first two nodes of each row, where one axis is meant."""
    if not isinstance(net, Lattice):
        raise ValueError(f"a {type(net).__name__} has no rows. Pass joints=, (J, 3): three nodes in a row for each joint.")
    dim = len(net.shape)
    chosen = range(dim) if axis is None else (whole_number("axis", axis),)
    numbers, found = np.arange(net.n_nodes).reshape(net.shape), []
    for a in chosen:
        if not -dim <= a < dim:
            raise ValueError(f"axis = {a}, but the lattice has {dim} axes, 0 to {dim - 1}.")
        line = np.moveaxis(numbers, a, -1)
        line = np.concatenate([line, line[..., :2]], axis=-1) if net.periodic[a] else line
        found.append(np.stack([line[..., :-2], line[..., 1:-1], line[..., 2:]], axis=-1).reshape(-1, 3))
    rows = np.concatenate(found)
    if not len(rows):
        raise ValueError(f"the lattice of shape {net.shape} has no three nodes in a row there: nothing bends.")
    if len(chosen) > 1 or net.periodic[chosen[0]]:
        return rows, None
    return rows, np.moveaxis(numbers, chosen[0], -1).reshape(-1, net.shape[chosen[0]])[:, :2]


def _directions(clamp: Array, count: int) -> Array:
    """(C, D) directions from (D,) or (C, D)."""
    name = "one per clamp"
    has_shape("clamp", clamp, {"one for all": (clamp.shape[-1] if clamp.ndim else 2,), name: (count, clamp.shape[-1] if clamp.ndim else 2)})
    finite("clamp", clamp)
    if is_concrete(clamp) and not bool(jnp.all(jnp.sum(clamp * clamp, axis=-1) > 0)):
        raise ValueError("clamp has a direction without length. Pass the direction in which the chain leaves its end, e.g. (1.0, 0.0).")
    return jnp.broadcast_to(clamp, (count, clamp.shape[-1]))


def _constant(name: str, value: Any, each: str, count: int) -> Array:
    value = as_inexact(name, value)
    has_shape(name, value, {"one number": (), f"one per {each}": (count,)})
    finite(name, value)
    nonnegative(name, value, "A joint of negative stiffness bends by itself.")
    return value


__all__ = ["AngularJoints"]
