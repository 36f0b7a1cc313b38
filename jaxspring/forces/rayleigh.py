"""Rayleigh damping: proportional to mass and stiffness.

    f = -(a M + b K) v                                  [N]     a [1/s], b [s]
    zeta = a / (2 w) + b w / 2                                  damping ratio of the mode of frequency w [rad/s]

K is the stiffness of the forces in the present state, with the blocks of the springs clamped positive semi-definite: f . v <= 0 always.

What turns: a spring at its rest length resists only a change of its length, so that a body at rest length turns undamped by b K. A
stretched spring has stiffness sideways too, k (1 - l / r), and its turning is then damped as well: angular momentum is not kept (momentum
is, unless a force ties nodes to a place). `Dashpots` with c = b k damp the lengths alone, whatever the state. The term a M damps
every motion.

Source: Rayleigh, The Theory of Sound (1877), section 81; the clamped tangent as in Choi and Ko (2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, fits_nodes, node_values, nonnegative
from ..linalg.operators import Blocks, isotropic
from ..numerics import cast_inexact
from ..state import State
from ..topology.base import Topology
from ..vector import Vector
from .base import Force, Scene, any_refused
from .linearisation import Tangent


class Rayleigh(Force):
    """Damping proportional to mass and stiffness.

    Attributes:
        mass_rate: a [1/s], one number.
        stiffness_time: b [s], one number.
        forces: whose stiffness is meant: those that name their `stiffness_blocks`. None: all other forces of the system, with their
            present constants. Forces given here are copies of their own, which `js.replace` does not reach.
        mass: [kg], one number or a node array; `System` fills it in.

    Raises:
        ValueError: a negative or non-finite coefficient.

    >>> damping = Rayleigh.from_ratios((1.0, 0.05), (3.0, 0.05))
    >>> print(f"{damping.damping_ratio(3.0):.3f}")
    0.050
    """

    mass_rate: Array
    stiffness_time: Array
    forces: tuple[Force, ...] | None
    mass: Array | None

    def __init__(
        self, mass_rate: Numbers, stiffness_time: Numbers, forces: Force | Sequence[Force] | None = None, mass: Numbers | None = None
    ):
        self.mass_rate = _coefficient("mass_rate", mass_rate)
        self.stiffness_time = _coefficient("stiffness_time", stiffness_time)
        self.forces = (forces,) if isinstance(forces, Force) else None if forces is None else tuple(forces)
        self.mass = None if mass is None else node_values("mass", mass)

    @staticmethod
    def from_ratios(
        first: tuple[Numbers, Numbers], second: tuple[Numbers, Numbers], forces: Force | Sequence[Force] | None = None
    ) -> Rayleigh:
        """The damping with given ratios at two frequencies; between them it is less, outside more.

        Args:
            first: (w [rad/s], zeta) of one mode.
            second: of another; the frequencies must differ.
            forces: as in `Rayleigh`.

        Raises:
            ValueError: ratios that need a negative coefficient (they must not rise faster than w nor fall faster than 1 / w).
        """
        (w, z), (w2, z2) = ((as_inexact("frequency", w), as_inexact("ratio", z)) for w, z in (first, second))
        span = w2 * w2 - w * w
        return Rayleigh(2 * w * w2 * (z * w2 - z2 * w) / span, 2 * (z2 * w2 - z * w) / span, forces)

    def damping_ratio(self, frequency: Numbers) -> Array:
        """Damping ratio zeta = a / (2 w) + b w / 2 at frequencies [rad/s]; 1 is critical."""
        w = as_inexact("frequency", frequency)
        return self.mass_rate.astype(w.dtype) / (2 * w) + 0.5 * self.stiffness_time.astype(w.dtype) * w

    @property
    def net(self) -> Topology | None:
        """The topology of the forces that were given."""
        nets = (getattr(force, "net", None) for force in self.forces or ())
        return next((net for net in nets if net is not None), None)

    def bind(self, scene: Scene) -> Rayleigh:
        """The same damping of the masses and the other forces of the scene; masses and forces that were given stay."""
        if self.forces is None:
            forces = tuple(scene.bound(i) for i, f in enumerate(scene.forces) if not isinstance(f, Rayleigh))
        else:
            forces = tuple(f.bind(scene) for f in self.forces)
        mass = scene.mass if self.mass is None else self.mass
        return cast_inexact(Rayleigh(self.mass_rate, self.stiffness_time, forces, mass), scene.dtype)

    def force(self, state: State) -> Vector:
        """-(a M + b K) v [N]."""
        return -self.damping_blocks(state).product(state.velocity)

    def damping_blocks(self, state: State) -> Blocks:
        """Blocks of a M + b K in this state [N s/m]."""
        mass, forces = self._bound()
        fits_nodes("mass", mass, state)
        blocks = Blocks((isotropic(self.mass_rate * mass, state.position),))
        for force in forces:
            stiffness = force.stiffness_blocks(state, Tangent())
            if stiffness is not None:
                blocks = blocks + stiffness.scaled(self.stiffness_time)
        return blocks

    @property
    def can_feed(self) -> bool:
        """Whether the force can raise the energy: both terms take energy out."""
        return False

    def damping_bound(self, state: State) -> Array:
        """Upper bound a m + b times the bound of the stiffness [N s/m]."""
        mass, forces = self._bound()
        bounds = [force.stiffness_bound(state) for force in forces if force.stiffness_blocks(state, Tangent()) is not None]
        start = (self.mass_rate * mass).astype(state.dtype)
        return sum((self.stiffness_time * bound for bound in bounds if bound is not None), start=start)

    def damping_floor(self, state: State) -> Array:
        """Lower bound a m [N s/m]."""
        return (self.mass_rate * self._bound()[0]).astype(state.dtype)

    def invalid(self) -> Array:
        """Whether a coefficient is negative or not finite, or a given force has a bad constant."""
        bad = any_refused(self.mass_rate, self.stiffness_time)
        for found in (force.invalid() for force in self.forces or ()):
            bad = bad if found is None else bad | found
        return bad

    def _bound(self) -> tuple[Array, tuple[Force, ...]]:
        if self.mass is None or self.forces is None:
            raise ValueError("Rayleigh damping has no masses or no forces yet. Put it in a System, or pass both.")
        return self.mass, self.forces


def _coefficient(name: str, value: Any) -> Array:
    value = as_inexact(name, value)
    if value.ndim:
        raise ValueError(f"{name} has shape {value.shape}; expected one number. For several materials use one Rayleigh for each.")
    nonnegative(name, value, "A negative damping feeds energy in.")
    return value


__all__ = ["Rayleigh"]
