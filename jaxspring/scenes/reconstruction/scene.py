"""The scene: a lattice over an image, zero-rest-length springs in the plane, a border that slides, and heights along z.

In the plane the springs alone decide (slide "Adaptive Meshes"): with rest length zero every node is a weighted average of its neighbours,
k_i L_i is constant along a chain, and a planar mesh never folds. Left and right borders keep x, top and bottom keep y, corners both. Along
z each node is pulled to the image by a data spring and to its neighbours by springs whose stiffness is set apart.

The fictitious mass of a node is the sum of its springs' stiffnesses, as in dynamic relaxation: then every frequency is below sqrt(2) rad/s
whatever the stiffnesses are, and one dt serves all. The mesh at rest does not depend on it.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ...forces.adaptive import ImageStiffness
from ...forces.damping import Drag
from ...forces.data_springs import DataSprings
from ...forces.springs import Springs
from ...images.image import Image
from ...images.smoothing import smooth, smoothing_radius
from ...rollouts import Result, rollout
from ...state import State
from ...steppers.explicit import SymplecticEuler
from ...system import System
from ...topology.lattice import STRUCTURAL, Lattice, lattice
from ...vector import Vector
from .raster import PixelGrid
from .triangles import Node


class Relaxation(eqx.Module):
    """How the mesh is brought to rest.

    Attributes:
        n_steps: damped steps per rollout (static).
        dt: time step [s]. The stable limit is 4 / (c + sqrt(c^2 + 8)), with c the damping.
        damping: gamma / m of every node [1/s]. Critical for the slowest mode of n nodes in a row at about pi / n.
    """

    n_steps: int = eqx.field(static=True, default=100)
    dt: float = eqx.field(static=True, default=1.3)
    damping: float = eqx.field(static=True, default=0.06)


class Reconstruction(eqx.Module):
    """An image and the lattice that is to recover it.

    Args:
        image: the data, in any unit; holes count nowhere, and weights in every error and data spring.
        nodes: (ny, nx), nodes of the lattice along y and along x.

    Attributes:
        image: the data, scaled to [0, 1]; positions are in the unit of its spacing (pixels unless said).
        low, extent: value 0 and range of the scaled image in the image's own unit.
        net: structural springs on (ny, nx) nodes.
        grid: where the pixels are.
        rest: (x, y) of the uniform lattice [m].

    Raises:
        ValueError: fewer than two nodes along an axis, or an image of one pixel along one.
    """

    image: Image
    low: Array
    extent: Array
    net: Lattice
    grid: PixelGrid
    rest: Vector

    def __init__(self, image: Image, nodes: tuple[int, int] = (41, 41)):
        if len(nodes) != 2 or min(nodes) < 2:
            raise ValueError(f"nodes = {nodes}; a mesh over an image needs two numbers (ny, nx) of at least 2 each.")
        if min(image.shape) < 2:
            raise ValueError(f"The image has shape {image.shape}; a surface needs at least 2 pixels along each axis.")
        self.low = jnp.min(image.values)
        self.extent = jnp.max(image.values) - self.low
        self.image = image.normalised()
        self.net = lattice(nodes, STRUCTURAL)
        self.grid = PixelGrid.of(self.image)
        self.rest = Vector(self.grid.uniform_nodes(nodes))

    @property
    def spacing(self) -> float:
        """Geometric mean of the distances between nodes of the uniform lattice [m]."""
        x, y = (np.asarray(a) for a in self.rest)
        return float(np.sqrt((x[0, 1] - x[0, 0]) * (y[1, 0] - y[0, 0])))

    def sliding(self, dim: int) -> np.ndarray:
        """(N, D) booleans: which coordinates are free. Borders slide along themselves, corners stay, z is free."""
        free = np.ones((*self.net.node_shape, dim), bool)
        free[:, [0, -1], 0] = False
        free[[0, -1], :, 1] = False
        return free.reshape(-1, dim)

    def system(self, stiffness: Array | np.ndarray, mass_of: Array | np.ndarray, damping: float) -> System:
        """The mesh in the plane, positions (x, y): (E,) stiffness [N/m], and mass and drag by the stiffnesses `mass_of` (E,) [N/m]."""
        mass = self.net.incident_sum(self.net.split(jnp.asarray(mass_of)))
        springs = Springs(self.net, stiffness, 0.0, axes=(0, 1))
        return System(self.net, mass, (springs, Drag(damping * mass)), free=self.sliding(2))

    def adaptive_system(self, rule: ImageStiffness, k_height: Array, k_data: Array, gamma: Array, mass: Array) -> System:
        """The slides' mesh in space, positions (x, y, z): `rule` in the plane, `k_height` along z, data springs [N/m]; drag [N s/m]."""
        forces = (
            Springs(self.net, rule, 0.0, axes=(0, 1)),
            Springs(self.net, k_height, 0.0, axes=(2,)),
            DataSprings(self.image, k_data),
            Drag(gamma),
        )
        return System(self.net, mass, forces, free=self.sliding(3))

    def law(self, k_min: Array | float, k_max: Array | float, sigma: Array | float, radius: int | None = None) -> ImageStiffness:
        """The slides' stiffness law, observing the gradient of the smoothed image, |grad (G_sigma * d)|.

        The slides smooth the gradient instead, G_sigma * |grad d|, which on photographs observes noise too. Over a grid of settings its
        best mesh of the camera photograph had an error 1.16 times below the uniform mesh's, this one 1.25 times. `radius`: half width
        of the Gaussian in pixels, needed where sigma is traced.
        """
        return ImageStiffness(smooth(self.image, sigma, radius), k_min, k_max, 0.0, radius=0)

    def smoothing_radius(self, sigma: float) -> int:
        """Pixels that a Gaussian of `sigma` [m] needs."""
        sx, sy = self.image.spacing
        return smoothing_radius(sigma, (float(sx), float(sy)))

    def at_rest(self, x: Node, y: Node) -> State:
        """A state of the mesh in the plane, at rest."""
        position = Vector((x, y))
        return State(jnp.zeros((), x.dtype), position, Vector.zeros_like(position), self.net.layout)

    def relax(self, stiffness: Array | np.ndarray, start: State, relaxation: Relaxation, mass_of: Array | None = None) -> Result:
        """Damped steps from `start` toward the equilibrium of `stiffness` (E,) [N/m]; mass by `mass_of`, or by the springs themselves."""
        system = self.system(stiffness, stiffness if mass_of is None else mass_of, relaxation.damping)
        return rollout(system, start, SymplecticEuler(), dt=relaxation.dt, n_steps=relaxation.n_steps)

    def adapt(self, rule: ImageStiffness, relaxation: Relaxation, n_updates: int) -> tuple[Array, State]:
        """Stiffness and mesh of the law, by steps in which the stiffness follows the nodes, updated every few steps with the mass.

        Returns the last stiffness (E,) [N/m] and the mesh that it acts on. n_updates times `relaxation.n_steps` steps in all.
        """
        rule = rule.bind(self.net, self.rest.dtype)

        def stiffness(state: State) -> Array:
            return self.net.flatten(rule.stiffness(self.net, state))

        def update(state: State, _: None) -> tuple[State, None]:
            return self.relax(stiffness(state), state, relaxation).state, None

        state, _ = lax.scan(update, self.at_rest(*self.rest), None, length=n_updates)
        return stiffness(state), state
