"""Constants of springs, bending and masses from a fabric in measured units, and what the net then gives.

Square grid of spacing h, structural springs k1 (warp) and k2 (weft), both diagonals ks [N/m], joints along the rows:

    C11 = k1 + ks,  C22 = k2 + ks,  C12 = C33 = ks           D = diag(B1, B2, 0)
    k1 = C11 - ks,  k2 = C22 - ks,  ks = min(C33, 0.9 C11, 0.9 C22),    joints B1 and B2;    borders half of all, as of the mass

Triangles, springs along their sides and hinges across them, at an angle a from warp, S the area of the triangles at a side of length l:

    k = S / l^2 [e1 + (e0 - e1) f(a)]           f(a) = ((4 cos^2 a - 1) / 3)^2:  1 along warp, 0 at 60 degrees
    k_e = l^2 / S [b1 + (b0 - b1) f(a)]

e0 and e1 are such that the whole sheet has C11 and C22 as asked, b0 and b1 such that its inner triangles have B1 and B2: two equations of
two unknowns each, by the energies in `moduli.py`. On equilateral triangles with rows along warp they are

    e1 = 8/9 C22,  e0 = C11 - C22 / 9           C12 = C33 = C22 / 3;  for C11 = C22 isotropic, nu = 1/3, k = sqrt(3)/2 C11 (1 - nu^2)
    b0 = B2,  b1 = (9 B1 - B2) / 8              Poisson's ratio -1/3;  a hinge along warp bends weft alone, the others bend both ways

and with rows across warp the same with warp and weft exchanged. No side has less than a twentieth of the smaller modulus.
No springs give C12 another value than C33. What comes out, and what was asked, is in `Cloth`.

Source: Cauchy's relations for central forces; Van Gelder (1998), "Approximate simulation of elastic membranes by triangulated spring
meshes", for S / l^2; the rest from the energies in `moduli.py`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._arrays import Numbers, on_host
from .._checks import finite
from ..forces.base import Force
from ..forces.hinges import Hinges
from ..forces.joints import AngularJoints
from ..forces.springs import Springs
from ..topology.base import Topology
from ..topology.hinge_list import hinges_of
from ..topology.lattice import Lattice
from ..topology.mesh_checks import Sides, cut, triangles_of
from .materials import Fabric, Material
from .moduli import Moduli, matrix, stretches, turns, twice_areas

# Of the stretch stiffness, the least that is left to structural springs, and to springs and hinges along warp or across it.
LEAST_STRUCTURAL, LEAST = 0.1, 0.05
# A fit of two moduli is refused where their equations are this badly conditioned.
ILL_POSED = 1e9
# Sides of a grid may differ by this share of one.
EVEN = 1e-5


class Cloth(eqx.Module):
    """A net with the constants of a fabric.

    Attributes:
        fabric: what was asked for.
        net: the topology.
        springs: stretch and shear.
        bending: `Hinges` of triangles, `AngularJoints` of a grid.
        mass: (N,) [kg], in the user's order.
        realised: what springs and bending give in the flat shape.
    """

    fabric: Fabric
    net: Topology
    springs: Springs
    bending: Force
    mass: Array
    realised: Moduli

    @property
    def forces(self) -> tuple[Force, ...]:
        """Springs and bending, for a `System`."""
        return self.springs, self.bending

    def compared(self) -> dict[str, tuple[Array | None, Array]]:
        """What was asked for and what the net gives, by name: C11, C12, C22, C33 [N/m], B of warp and weft [N m], density [kg/m^2].

        C12 is None where it was not measured.
        """
        c, d, f = self.realised.membrane, self.realised.bending, self.fabric
        return {
            "C11": (f.stretch[0], c[0, 0]),
            "C12": (f.coupling, c[0, 1]),
            "C22": (f.stretch[1], c[1, 1]),
            "C33": (f.shear, c[2, 2]),
            "B warp": (f.bending[0], d[0, 0]),
            "B weft": (f.bending[1], d[1, 1]),
            "density": (f.density, self.realised.density),
        }

    def __str__(self) -> str:
        """A table of what was asked for and what is realised."""
        rows = [f"{'':8} {'asked':>10} {'realised':>10}"]
        for name, (asked, found) in self.compared().items():
            rows.append(f"{name:8} {'-' if asked is None else format(float(asked), '.4g'):>10} {format(float(found), '.4g'):>10}")
        rows.append(f"anisotropy of stretch {float(self.realised.stretch_anisotropy()):.3g}, of bending {self._bends()}")
        return "\n".join(rows)

    def _bends(self) -> str:
        return f"{float(self.realised.bending_anisotropy()):.3g}"


def fabric(net: Topology, points: Numbers, material: Material) -> Cloth:
    """A flat sheet of a fabric: springs, bending and masses on a square grid or on triangles.

    Differentiable in the fabric's constants, not in the points.

    Args:
        net: of triangles, as `js.cloth.rectangle`, `disc`, `outline` and `js.from_mesh` make, best equilateral with rows along x; or a
            square `js.lattice((ny, nx), js.STRUCTURAL + js.SHEAR)`.
        points: (N, 2) or (N, 3) places at rest [m], flat: warp runs along x, weft along y.
        material: a `Fabric`, `KES` or `FAST`, or one of the published ones, such as `js.cloth.INTERLOCK`.

    Returns:
        A `Cloth`, whose `forces` and `mass` go to a `System`; `print` shows what was asked for beside what the net gives.

    Raises:
        ValueError: points that are not flat; a lattice that is not square, wraps, or has other springs; a spring along no triangle.

    >>> net, points = js.cloth.rectangle(0.3, 0.3, 0.02)
    >>> print(fabric(net, points, js.cloth.DENIM))
                  asked   realised
    C11           205.4      205.4
    C12           10.23      317.1
    C22            1014       1014
    C33           26.69      317.1
    B warp     6.42e-05   6.42e-05
    B weft    1.982e-05  1.982e-05
    density       0.324      0.324
    anisotropy of stretch 4.94, of bending 3.67
    """
    made_of, places = material.fabric(), _flat(net, points)
    if isinstance(net, Lattice):
        return _on_grid(net, places, made_of)
    return _on_triangles(net, places, made_of)


def _on_grid(net: Lattice, places: np.ndarray, f: Fabric) -> Cloth:
    h = _spacing(net, places)
    shear = jnp.minimum(f.shear, (1 - LEAST_STRUCTURAL) * jnp.min(f.stretch))
    warp, weft = f.stretch - shear
    tail, head = places[net.edges].transpose(1, 0, 2)
    across = [np.isclose(head[:, k], tail[:, k], atol=0.1 * h) for k in range(2)]
    at_border = np.zeros(net.n_springs, bool)
    for k, same in enumerate(across):
        low, high = places[:, k].min(), places[:, k].max()
        at_border |= same & ((np.abs(tail[:, k] - low) < 0.1 * h) | (np.abs(tail[:, k] - high) < 0.1 * h))
    kind = np.where(across[1], 0, np.where(across[0], 1, 2))
    stiffness = jnp.stack([warp, weft, shear])[kind] * jnp.asarray(np.where(at_border, 0.5, 1.0), f.stretch.dtype)
    joints, share = _rows(net)
    along = np.repeat([0, 1], [len(rows) for rows in joints])
    bend = AngularJoints(net, f.bending[along] * jnp.asarray(np.concatenate(share), f.bending.dtype), np.concatenate(joints))
    zero = jnp.zeros((), f.bending.dtype)
    realised = jnp.diag(jnp.stack([f.bending[0], f.bending[1], zero]))
    # The mean of both ways to cut squares into triangles: with one alone, nodes at two corners would have twice the mass.
    own = np.mean([_own_area(net, places, np.concatenate(cut(net, other))) for other in (False, True)], axis=0)
    return _cloth(net, places, f, stiffness, bend, realised, own)


def _rows(net: Lattice) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Every three nodes in a row, along x and along y, and what share of a full row each stands for."""
    number = np.arange(net.n_nodes).reshape(net.shape)
    joints, share = [], []
    for rows in (number, number.T):
        found = np.stack([rows[:, :-2], rows[:, 1:-1], rows[:, 2:]], axis=-1)
        half = np.ones(found.shape[:2])
        half[[0, -1]] = 0.5
        joints.append(found.reshape(-1, 3))
        share.append(half.ravel())
    return joints, share


def _on_triangles(net: Topology, places: np.ndarray, f: Fabric) -> Cloth:
    triangles = triangles_of(net, None)
    own = _own_area(net, places, triangles)
    sides = places[net.edges[:, 1]] - places[net.edges[:, 0]]
    per_modulus = _area_at(net, triangles, np.abs(twice_areas(places, triangles)) / 2) / np.einsum("ed,ed->e", sides, sides)
    rows = stretches(places, net.edges, float(own.sum()))
    stiffness = _fitted(f.stretch, per_modulus, _near_warp(sides), rows)
    nodes = hinges_of(triangles)
    edges = places[nodes[:, 1]] - places[nodes[:, 0]]
    both = np.abs(twice_areas(places, nodes[:, [0, 1, 2]])) + np.abs(twice_areas(places, nodes[:, [0, 1, 3]]))
    rows = turns(places, nodes, triangles)
    per_modulus = 2 * np.einsum("hd,hd->h", edges, edges) / both
    bend = Hinges(net, _fitted(f.bending, per_modulus, _near_warp(edges), rows), triangles=triangles)
    return _cloth(net, places, f, stiffness, bend, matrix(bend.stiffness, rows), own)


def _fitted(asked: Array, per_modulus: np.ndarray, near_warp: np.ndarray, rows: np.ndarray) -> Array:
    """Stiffness of each spring, or hinge, such that the sheet has both moduli as asked, where that needs none too small."""
    shares = per_modulus * np.stack([near_warp, 1 - near_warp])
    gives = np.einsum("ce,ei->ic", shares, rows[:, :2] ** 2)
    if np.linalg.cond(gives) > ILL_POSED:
        raise ValueError("all sides of the triangles lie at one angle to warp, so that warp and weft cannot differ. Turn the pattern.")
    found = jnp.matmul(jnp.asarray(np.linalg.inv(gives), asked.dtype), asked)
    each = jnp.asarray(shares, asked.dtype)
    # Of the sides that there are: with rows across warp no side has e0 itself, which may then be negative.
    return jnp.maximum(jnp.matmul(found, each), LEAST * jnp.min(asked) * jnp.sum(each, axis=0))


def _cloth(net: Topology, places: np.ndarray, f: Fabric, stiffness: Array, bend: Force, realised: Array, own: np.ndarray) -> Cloth:
    """From the springs' stiffness, the bending and its moduli, and each node's own area."""
    tail, head = net.edges.T
    springs = Springs(net, stiffness, jnp.asarray(np.linalg.norm(places[head] - places[tail], axis=1), stiffness.dtype))
    mass = f.density * jnp.asarray(own, f.density.dtype)
    moduli = Moduli(matrix(stiffness, stretches(places, net.edges, float(own.sum()))), realised, jnp.sum(mass) / float(own.sum()))
    return Cloth(f, net, springs, bend, mass, moduli)


def _own_area(net: Topology, places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(N,) a third of the triangles at each node, as in `lumped_mass`."""
    return np.bincount(triangles.ravel(), np.repeat(np.abs(twice_areas(places, triangles)) / 6, 3), net.n_nodes)


def _near_warp(d: np.ndarray) -> np.ndarray:
    """f of differences in the plane: 1 along x, 0 at 60 degrees from it."""
    cosine = d[:, 0] ** 2 / np.einsum("ed,ed->e", d, d)
    return ((4 * cosine - 1) / 3) ** 2


def _area_at(net: Topology, triangles: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """(E,) area of the triangles along each spring."""
    sides = Sides(triangles)
    total = np.bincount(sides.of, np.tile(areas, 3))
    n = net.n_nodes
    keys, wanted = sides.pairs @ [n, 1], np.sort(net.edges.astype(np.int64), axis=1) @ [n, 1]
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    if (keys[at] != wanted).any():
        i = int(np.argmax(keys[at] != wanted))
        raise ValueError(
            f"spring {i}, between nodes {tuple(net.edges[i].tolist())}, runs along no triangle, so that no area gives it a stiffness. "
            f"Leave it out, or make it part of a net of its own: net.with_edges."
        )
    return total[at]


def _flat(net: Topology, points: Numbers) -> np.ndarray:
    """(N, 2) places, once seen to be flat."""
    places = on_host("points", points)
    if places.shape not in ((net.n_nodes, 2), (net.n_nodes, 3)):
        raise ValueError(f"points has shape {places.shape}; expected ({net.n_nodes}, 2), or ({net.n_nodes}, 3) with one z for all.")
    finite("points", places)
    if places.shape[1] == 3 and np.ptp(places[:, 2]) > EVEN * np.ptp(places[:, :2], axis=0).max():
        i = int(np.argmax(np.abs(places[:, 2] - places[0, 2])))
        raise ValueError(
            f"points[{i}] has z = {places[i, 2]:.6g} and points[0] {places[0, 2]:.6g}: a fabric is cut flat, where warp and weft have a "
            f"direction. Pass the flat pattern here, and the shape in space to the State."
        )
    # About its middle: areas are differences of products, which lose digits far from the origin.
    flat = places[:, :2].astype(np.float64)
    return flat - 0.5 * (flat.min(axis=0) + flat.max(axis=0))


def _spacing(net: Lattice, places: np.ndarray) -> float:
    """The spacing of a square grid with structural and shear springs."""
    wanted = {(0, 1), (1, 0), (1, 1), (1, -1)}
    if len(net.shape) != 2 or min(net.shape) < 3 or any(net.periodic) or set(net.offsets) != wanted:
        raise ValueError(
            f"net is a lattice of shape {net.shape} with springs along {net.offsets}; expected two axes of 3 nodes or more that do not "
            f"wrap, with js.STRUCTURAL + js.SHEAR. Springs (i, i + 2) have no bending stiffness: fabric adds joints."
        )
    grid = places.reshape(*net.shape, 2)
    steps: Any = [np.diff(grid, axis=1).reshape(-1, 2), np.diff(grid, axis=0)[..., ::-1].reshape(-1, 2)]
    h = float(np.mean([step[:, 0].mean() for step in steps]))
    if h <= 0 or any(np.abs(step - [h, 0.0]).max() > EVEN * h for step in steps):
        raise ValueError("points is no square grid, x along the last axis and y along the first. Pass net.grid(spacing).")
    return h


__all__ = ["Cloth", "fabric"]
