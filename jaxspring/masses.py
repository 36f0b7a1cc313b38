"""Masses of nodes from a density.

    along springs       m_i = sum over the springs of node i of density [kg/m] times length / 2
    over triangles      m_i = sum over the triangles of node i of density [kg/m^2] times area / 3

Source: row sums of the consistent mass matrix of linear elements (lumping).
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from ._arrays import Numbers
from ._checks import as_inexact, finite, has_shape, positive, triangle_indices
from .topology.base import Topology, about_middle
from .topology.periods import box_of, check_dim, nearest_image


def lumped_mass(net: Topology, points: Numbers, density: Numbers, triangles: Numbers | None = None) -> Array:
    """Node masses from a density.

    Along springs (density [kg/m]) each spring gives half its mass to either end. With triangles (density [kg/m^2]) each triangle gives
    a third to each corner.

    Args:
        net: the topology.
        points: (N, D) rest positions [m].
        density: one number.
        triangles: (T, 3) node numbers, or None for a density along springs.

    Returns:
        (N,) [kg], in the user's order.

    Raises:
        ValueError: a density that is not positive, points of another number, a triangle that names a node that does not exist.
    """
    points = as_inexact("points", about_middle(points))
    density = as_inexact("density", density, points.dtype)
    has_shape("density", density, {"one number": ()})
    positive("density", density, "A node without mass would get an infinite acceleration.")
    if points.ndim != 2 or points.shape[0] != net.n_nodes:
        raise ValueError(f"points has shape {points.shape}; expected ({net.n_nodes}, D): a position for each node.")
    finite("points", points)
    if triangles is None:
        lengths = net.lengths(points)
        return net.flatten_nodes(net.incident_sum(net.split(0.5 * density * lengths)))
    corners = triangle_indices("triangles", triangles, net.n_nodes)
    a, b, c = (points[corners[:, i]] for i in range(3))
    u, v = (_nearest(net, side) for side in (b - a, c - a))
    squared = jnp.sum(u * u, axis=1) * jnp.sum(v * v, axis=1) - jnp.sum(u * v, axis=1) ** 2
    share = density * jnp.sqrt(jnp.maximum(squared, jnp.zeros((), squared.dtype))) / 6
    return jnp.zeros(net.n_nodes, points.dtype).at[corners.ravel()].add(jnp.repeat(share, 3))


def _nearest(net: Topology, side: Array) -> Array:
    """(T, D) sides of triangles, through the walls of the net's box where that is nearer."""
    box = box_of(net)
    if box is None:
        return side
    check_dim(box, side.shape[1])
    return jnp.stack([nearest_image(side[:, i], period) for i, period in enumerate(box)], axis=1)
