"""How much of the body a node of a lattice stands for: equal cells, or half cells at borders.

    equal cells   V = h_x h_y h_z for every node; the body reaches half a spacing beyond its outer nodes
    half cells    half of it for each border that a node lies on; the body ends at its outer nodes

With equal cells, discrete cosines are the exact modes of a uniform insulated lattice. With half cells, the outer nodes lie on the surface,
where a temperature is given or heat enters. Links along a border have half the section there, too.

Source: finite volumes, cell-centred and vertex-centred.
"""

from __future__ import annotations

import abc
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, constant, has_shape, positive
from ..topology.base import Topology
from ..topology.lattice import Lattice


class Cells(eqx.Module):
    """The share of the body of each node of a lattice. Abstract: `EqualCells` and `HalfCells` are final."""

    @abc.abstractmethod
    def share(self, net: Lattice, axis: int) -> np.ndarray:
        """(n,) along an axis of the array: the share of a full spacing that each node has."""

    def volumes(self, net: Topology, spacing: Numbers, section: Numbers = 1.0) -> Array:
        """(N,) volume of each node [m^3].

        Args:
            net: a lattice.
            spacing: [m]: a number, or one for x (last axis), y, z, as in `net.grid`.
            section: what the lattice's dimensions lack of a volume: the thickness of a sheet [m], the cross-section of a chain [m^2].

        >>> import jaxspring as js
        >>> print(EqualCells().volumes(js.lattice(3), 2.0), HalfCells().volumes(js.lattice(3), 2.0))
        [2. 2. 2.] [1. 2. 1.]
        """
        net = on_lattice(net)
        steps = spacings(net, spacing)
        volume = section_of(section).astype(steps[0].dtype) * math.prod(steps[1:], start=steps[0])
        return volume * jnp.asarray(self.shares(net, range(len(net.shape))), volume.dtype).ravel()

    def shares(self, net: Lattice, axes: Any) -> np.ndarray:
        """Product of the shares along these axes, in node shape."""
        total = np.ones(net.shape)
        for axis in axes:
            shape = [1] * len(net.shape)
            shape[axis] = net.shape[axis]
            total = total * self.share(net, axis).reshape(shape)
        return total


class EqualCells(Cells):
    """The same volume for every node."""

    def share(self, net: Lattice, axis: int) -> np.ndarray:
        """A full spacing for every node."""
        return np.ones(net.shape[axis])


class HalfCells(Cells):
    """Half a cell at a border, a quarter at an edge, an eighth at a corner."""

    def share(self, net: Lattice, axis: int) -> np.ndarray:
        """One, and one half at the ends of an axis that does not wrap."""
        n = net.shape[axis]
        share = np.ones(n)
        if n > 1 and not net.periodic[axis]:
            share[[0, -1]] = 0.5
        return share


def capacities(
    net: Topology, density: Numbers, specific_heat: Numbers, spacing: Numbers, section: Numbers = 1.0, cells: Cells | None = None
) -> Array:
    """Heat capacities of the nodes of a lattice, C = density * specific heat * volume.

    Args:
        net: a lattice.
        density: [kg/m^3], a number or (N,).
        specific_heat: [J/(kg K)], a number or (N,).
        spacing: [m]: a number, or one for x, y, z.
        section: thickness of a sheet [m], cross-section of a chain [m^2].
        cells: `EqualCells()` unless said. Take the same for `conductances`.

    Returns:
        (N,) [J/K], in the user's order.

    Raises:
        ValueError: a value or section that is not positive, a shape that does not fit, a net that is no lattice.

    >>> import jaxspring as js
    >>> print(capacities(js.lattice((2, 2)), density=1000.0, specific_heat=4.0, spacing=0.1, section=0.01))
    [0.4 0.4 0.4 0.4]
    """
    volumes = (EqualCells() if cells is None else cells).volumes(net, spacing, section)
    for name, value in (("density", density), ("specific_heat", specific_heat)):
        value = as_inexact(name, value)
        has_shape(name, value, {"one number": (), "one per node": (net.n_nodes,)})
        positive(name, value, "A node without capacity would get an infinite temperature.")
        volumes = volumes * value.astype(volumes.dtype)
    return volumes


def on_lattice(net: Topology) -> Lattice:
    """The net, which must be a lattice."""
    if not isinstance(net, Lattice):
        raise ValueError(
            f"cells are those of a lattice; this net is a {type(net).__name__}. Give capacities and link_conductances from your own "
            f"volumes, areas and lengths."
        )
    return net


def spacings(net: Lattice, spacing: Any) -> tuple[Array, ...]:
    """Spacing along each axis of the array, slowest first [m]."""
    spacing = as_inexact("spacing", spacing)
    dim = len(net.shape)
    has_shape("spacing", spacing, {"one number": (), "one per axis, x first": (dim,)})
    positive("spacing", spacing, "A cell would have no volume.")
    return tuple(spacing if spacing.ndim == 0 else spacing[dim - 1 - axis] for axis in range(dim))


def section_of(section: Any) -> Array:
    """What the lattice's dimensions lack of a volume, which must be one positive number."""
    return constant("section", section, "A cell would have no volume.")


__all__ = ["Cells", "EqualCells", "HalfCells", "capacities", "on_lattice", "section_of", "spacings"]
