"""Conductances of springs from the conductivity of the material.

    G_ij = c_ij A_ij / h_ij        1 / c_ij = (1 / c_i + 1 / c_j) / 2                   [W/K]

The harmonic mean is that of two half-links in series: the flux is the same in both, so the temperature of an interface is exact.

A tensor C conducts along diagonals too. The lattice's springs o with vectors h_o reproduce it where

    sum_o g_o h_o h_o' = V C        g of a diagonal: V |C_ab| / (h_a h_b);  g of an axis: V C_aa / h_a^2 less those of its diagonals

and no g is negative, without which heat could flow from cold to hot: C_aa / h_a >= sum over b of |C_ab| / h_b.

Source: slide "Heating and Melting" (nonhomogeneous, nonisotropic media); Patankar (1980), section 4.2, for the harmonic mean.
"""

from __future__ import annotations

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._arrays import Numbers
from .._checks import as_inexact, has_shape, nonnegative, positive
from ..topology.base import Topology
from ..topology.edge_field import EdgeField
from ..topology.lattice import Lattice
from .cells import Cells, EqualCells, on_lattice, section_of, spacings


def harmonic_mean(net: Topology, value: Any, name: str = "value") -> EdgeField:
    """Harmonic mean of a node value, zero or more, over the two ends of each spring; zero where an end is zero.

    Args:
        net: the topology.
        value: a number, or (N,) in the user's order.
        name: what it is called in an error.
    """
    value = as_inexact(name, value)
    nonnegative(name, value, "Heat would flow from cold to hot.")
    nodes = jnp.broadcast_to(net.node_field(value, name), net.node_shape)
    is_some = nodes > 0
    inverse = net.average(jnp.where(is_some, 1 / jnp.where(is_some, nodes, jnp.ones_like(nodes)), jnp.zeros_like(nodes)))
    without = net.average(jnp.where(is_some, jnp.zeros_like(nodes), jnp.ones_like(nodes)))

    def of_family(inverse: Array, without: Array) -> Array:
        conducts = (without == 0) & (inverse > 0)
        return jnp.where(conducts, 1 / jnp.where(conducts, inverse, jnp.ones_like(inverse)), jnp.zeros_like(inverse))

    return net.map_springs(of_family, inverse, without)


def link_conductances(net: Topology, conductivity: Numbers, area: Numbers, length: Numbers) -> EdgeField:
    """Conductances of the springs of any net: c A / h with the harmonic mean of the ends' conductivities.

    Args:
        net: the topology.
        conductivity: [W/(m K)]: a number, or (N,) in the user's order; zero insulates.
        area: section of each spring [m^2]: a number, (E,) in the user's order, or an edge field.
        length: of each spring [m], as `area`.

    Returns:
        An edge field [W/K].

    Raises:
        ValueError: a conductivity that is negative or infinite, an area that is negative, a length that is not positive.

    >>> import jaxspring as js
    >>> net = js.lattice(3)
    >>> print(net.flatten(link_conductances(net, np.array([1.0, 1.0, 3.0]), area=1.0, length=0.5)))
    [2. 3.]
    """
    fields = []
    for name, value, check in (("area", area, nonnegative), ("length", length, positive)):
        field = net.edge_field(value, name)
        for entry in field.families if isinstance(field, EdgeField) else (field,):
            check(name, entry, "A section is zero or more, a length more than zero.")
        fields.append(field)
    mean = harmonic_mean(net, conductivity, "conductivity")
    return net.map_springs(lambda c, a, h: c * (a / h).astype(c.dtype), mean, *fields)


def conductances(net: Topology, conductivity: Numbers, spacing: Numbers, section: Numbers = 1.0, cells: Cells | None = None) -> EdgeField:
    """Conductances of a lattice's springs.

    With a scalar conductivity the structural springs conduct; all others get zero. With a tensor the diagonals of squares (SHEAR) conduct
    what it has off its diagonal.

    Args:
        net: a lattice with structural springs.
        conductivity: [W/(m K)]: a number, or (N,) in the user's order; or a symmetric positive tensor, (D, D) or (N, D, D), in x, y, z,
            where D, two or three, is the number of the lattice's dimensions. Zero insulates.
        spacing: [m]: a number, or one for x, y, z.
        section: thickness of a sheet [m], cross-section of a chain [m^2].
        cells: `EqualCells()` unless said. Take the same for `capacities`.

    Returns:
        An edge field [W/K].

    Raises:
        ValueError: a negative or infinite conductivity; a section that is not one positive number; a tensor that is not symmetric, or
            that needs a negative conductance or springs that the net lacks; a net that is no lattice.

    >>> import jaxspring as js
    >>> net = js.lattice((2, 2))
    >>> print(net.flatten(conductances(net, conductivity=4.0, spacing=0.1, section=0.01)))
    [0.04 0.04 0.04 0.04]
    """
    net = on_lattice(net)
    conductivity = as_inexact("conductivity", conductivity)
    dim, steps = len(net.shape), spacings(net, spacing)
    cells = EqualCells() if cells is None else cells
    volume = section_of(section).astype(steps[0].dtype) * math.prod(steps[1:], start=steps[0])
    if conductivity.shape[-2:] == (dim, dim) and conductivity.ndim in (2, 3) and dim > 1:
        per_axis, per_diagonal = _of_tensor(net, conductivity, steps)
    else:
        has_shape("conductivity", conductivity, {"one number": (), "one per node": (net.n_nodes,), "a tensor": (dim, dim)})
        per_axis, per_diagonal = [conductivity / h.astype(conductivity.dtype) ** 2 for h in steps], {}
    families = []
    for family, offset in enumerate(net.offsets):
        moving = [axis for axis, o in enumerate(offset) if o]
        across = [axis for axis in range(dim) if axis not in moving]
        if len(moving) == 1 and abs(offset[moving[0]]) == 1:
            node = per_axis[moving[0]]
        elif len(moving) == 2 and per_diagonal:
            a, b = moving
            node = per_diagonal[a, b][offset[a] * offset[b]]
        else:
            families.append(jnp.zeros(net.family_shapes[family], volume.dtype))
            continue
        g = harmonic_mean(net, node, "conductivity")[family]
        share = net.average(jnp.asarray(cells.shares(net, across), g.dtype))[family]
        families.append(g * share * volume.astype(g.dtype))
    return EdgeField(tuple(families))


def _of_tensor(net: Lattice, tensor: Array, steps: tuple[Array, ...]) -> tuple[list[Array], dict[tuple[int, int], dict[int, Array]]]:
    """Conductance over volume [W/(K m^3)] at each node: along the axes, and along the rising and falling diagonals of each plane."""
    dim = len(steps)
    has_shape("conductivity", tensor, {"a tensor": (dim, dim), "one per node": (net.n_nodes, dim, dim)})
    if not isinstance(tensor, Tracer) and not _is_symmetric(np.asarray(tensor)):
        raise ValueError("conductivity is not symmetric: the tensor of heat conduction must be. Pass (C + C.T) / 2 if that is meant.")
    # The tensor counts x, y, z; the array's axes run the other way.
    scaled = {
        (a, b): tensor[..., dim - 1 - a, dim - 1 - b] / (steps[a] * steps[b]).astype(tensor.dtype) for a in range(dim) for b in range(dim)
    }
    per_axis, per_diagonal = [], {}
    for a in range(dim):
        rest = scaled[a, a]
        for b in range(dim):
            if b != a:
                rest = rest - jnp.abs(scaled[a, b])
        positive_enough = "the tensor is too oblique for this lattice: a conductance would be negative. Choose a spacing nearer its axes."
        nonnegative(f"conductance over volume along axis {a}", rest, positive_enough[0].upper() + positive_enough[1:])
        per_axis.append(rest)
    for a in range(dim):
        for b in range(a + 1, dim):
            off = scaled[a, b]
            zero = jnp.zeros_like(off)
            per_diagonal[a, b] = {1: jnp.maximum(off, zero), -1: jnp.maximum(-off, zero)}
            has_springs = any(o[a] and o[b] and sum(map(abs, o)) == 2 for o in net.offsets)
            if not has_springs and not (not isinstance(off, Tracer) and bool(np.all(np.asarray(off) == 0))):
                raise ValueError(
                    f"conductivity has an entry off its diagonal, but the net has no springs along the diagonals of axes {a} and {b}. "
                    f"Build it with STRUCTURAL + SHEAR."
                )
    return per_axis, per_diagonal


def _is_symmetric(tensor: np.ndarray) -> bool:
    """Whether each tensor is, to a millionth of its largest entry, whatever its unit."""
    largest = np.max(np.abs(tensor), axis=(-2, -1), keepdims=True)
    return bool(np.all(np.abs(tensor - np.swapaxes(tensor, -1, -2)) <= 1e-6 * largest))


__all__ = ["conductances", "harmonic_mean", "link_conductances"]
