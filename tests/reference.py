"""What tests compare with: forces in NumPy from an edge list, small scenes, counted compiles.

The references use none of the library's own arithmetic.
"""

import numpy as np

import jaxspring as js


def chaotic_net(rng, n=24, jitter=0.1):
    """A sheet of n x n nodes far from rest, whose motion is chaotic, as a system and a state (k = 100 N/m, l = 1 m, m = 1 kg)."""
    net = js.lattice((n, n), js.STRUCTURAL + js.SHEAR)
    rest = net.lengths(net.grid())
    state = js.State.from_points(net, net.grid() + jitter * rng.normal(size=(n * n, 2)))
    return js.System(net, 1.0, js.Springs(net, 100.0, rest)), state


def spring_forces(points, edges, stiffness, rest_length):
    """(N, D) forces of Hooke springs, one spring after the other in float64, the slides' formula; a spring of no length pulls nothing."""
    x, edges = np.asarray(points, float), np.asarray(edges)
    k, l = (np.broadcast_to(np.asarray(a, float), len(edges)) for a in (stiffness, rest_length))
    d = x[edges[:, 1]] - x[edges[:, 0]]
    length = np.sqrt((d * d).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        pull = np.where(length > 0, k * (1 - l / length), 0)[:, None] * d
    force = np.zeros_like(x)
    np.add.at(force, edges[:, 0], pull)
    np.subtract.at(force, edges[:, 1], pull)
    return force


def central_difference(function, at, step):
    """Derivative of a scalar function of one number, of order step^2."""
    return (float(function(at + step)) - float(function(at - step))) / (2 * step)


def relative_error(got, expected):
    """Largest difference over largest expected number."""
    got, expected = np.asarray(got, float), np.asarray(expected, float)
    return np.abs(got - expected).max() / np.abs(expected).max()


class Traces:
    """Counts how often a Python function is traced: wrap what a compiled program calls."""

    def __init__(self):
        self.count = 0

    def __call__(self, *_):
        self.count += 1
