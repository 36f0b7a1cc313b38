"""Particles for the tests of the fluid, and the sums over pairs in NumPy that they are compared with."""

import numpy as np

import jaxspring as js


def free_net(n):
    """`n` nodes without springs."""
    return js.Graph.from_edges(np.zeros((0, 2), int), n)


def make(points, mass=1.0, law=None, velocities=None, **options):
    """A system with one fluid, and its state."""
    net = free_net(len(points))
    fluid = js.Fluid(js.fluid.SlideLaw(1.0, 1.0, zeta=0.1) if law is None else law, **options)
    return js.System(net, mass=mass, forces=fluid), js.State.from_points(net, points, velocities)


def blob(rng, n, dim=3, spacing=1.0):
    """`n` points of a jittered cubic lattice in no order: a liquid's density, no two closer than 0.6 spacings."""
    side = int(np.ceil(n ** (1 / dim)))
    grid = np.stack(np.meshgrid(*[np.arange(side)] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    return (rng.permutation(grid)[:n] + rng.uniform(-0.2, 0.2, (n, dim))) * spacing


def slide_force(points, mass, alpha=1.0, beta=1.0, zeta=0.1, reach=np.inf):
    """(N, D) forces of the slides' law, pair by pair as printed."""
    d = points[:, None] - points[None]
    r = np.linalg.norm(d, axis=-1) + np.eye(len(points))
    bracket = -alpha / (r + zeta) ** 2 + beta / r**4
    weight = mass[:, None] * mass[None] * np.where(r < reach, bracket, 0)
    return np.sum(weight[..., None] * d, axis=1)


def components(vector):
    """A `Vector` as an (N, D) NumPy array."""
    return np.stack([np.ravel(a) for a in vector], axis=-1)
